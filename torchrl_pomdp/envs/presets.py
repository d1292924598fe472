"""The paper's problems by name, with their default parameters (Section VI)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from torchrl_pomdp.checks import check_callable, check_flag, check_instance, check_text, shown
from torchrl_pomdp.envs.belief import BeliefModel, StateGenerator
from torchrl_pomdp.envs.chains import damage_chain
from torchrl_pomdp.envs.generators import CalibratedStart, InPart, Mixture, RandomState, UniformStart
from torchrl_pomdp.envs.graphs import Graph, grid, line
from torchrl_pomdp.envs.partition import Partition, RepairPartition, SinglePart
from torchrl_pomdp.envs.repair import RepairModel
from torchrl_pomdp.tensor_checks import check_device

__all__ = ["PRESETS", "Problem", "make_problem"]

COSTS = (0.0, 0.1, 1.0, 10.0, 100.0)
DEGRADATION = (0.0, 0.02, 0.03, 0.05)
DISCOUNT = 0.99


@dataclass(frozen=True, eq=False)
class Problem:
    """A model with the distributions that go with it.

    Attributes:
        name: the preset's name.
        model: the belief model.
        start: start states of play and evaluation.
        training: one generator of random training states for each part of the model's partition.
        partitioned: whether the model has the preset's partition, or a single part.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if there is not one training generator for each part.
    """

    name: str
    model: RepairModel
    start: StateGenerator
    training: tuple[StateGenerator, ...]
    partitioned: bool = True

    def __post_init__(self) -> None:
        check_text("name", self.name)
        check_instance("model", self.model, BeliefModel)
        check_callable("start", self.start)
        check_flag("partitioned", self.partitioned)
        check_instance("training", self.training, (tuple, list))
        object.__setattr__(self, "training", tuple(self.training))
        for part, generator in enumerate(self.training):
            check_callable(f"training[{part}]", generator)
        parts = 1 if self.model.partition is None else self.model.partition.num_parts
        # Without a partition there are no parts to train; what needs them says so.
        if len(self.training) != parts and not (self.model.partition is None and not self.training):
            raise ValueError(f"training must hold {parts} generators, one for each part, got {len(self.training)}")


@dataclass(frozen=True)
class _Preset:
    """A graph, the number of robots, and the distribution of start states of a model."""

    graph: Graph
    num_robots: int = 1
    start: Callable[[RepairModel], StateGenerator] = CalibratedStart


PRESETS: dict[str, _Preset] = {
    "line3": _Preset(line(3), start=UniformStart),
    "linear20": _Preset(line(20)),
    "grid5x4": _Preset(grid(5, 4)),
    "grid6x6": _Preset(grid(6, 6)),
    "two_robots20": _Preset(line(20), num_robots=2),
}
"""The known problems by name."""


def make_problem(name: str, *, partitioned: bool = True, device: torch.device | str = "cpu") -> Problem:
    """Build a problem by name.

    Args:
        name: one of :data:`PRESETS`.
        partitioned: whether the model has the six parts of Section VI-B, or a single one. The training states of the single
            part are those of the six, in equal shares.
        device: where the model computes.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if there is no such problem, the message lists the known ones, or no such device.

    Examples:
        >>> make_problem("linear20").model.describe()
        'line of 20, 1 robot: 1.9e+15 states, 3 controls, 5 observations, discount 0.99'
        >>> make_problem("grid5x4", partitioned=False).model.partition.num_parts
        1
    """
    check_text("name", name)
    check_flag("partitioned", partitioned)
    device = check_device("device", device)
    if name not in PRESETS:
        known = ", ".join(sorted(PRESETS))
        raise ValueError(f"name must be that of a problem: unknown preset {shown(name)}; known presets: {known}")
    preset = PRESETS[name]
    six = RepairPartition(preset.graph, torch.tensor(COSTS), device=device)
    model = _repair_model(preset, six, device)
    training = _training(model)
    if not partitioned:
        model, training = _repair_model(preset, SinglePart(), device), (Mixture(training, [1.0] * len(training)),)
    return Problem(name, model, preset.start(model), training, partitioned)


def _repair_model(preset: _Preset, partition: Partition, device: torch.device | str) -> RepairModel:
    chain, costs = damage_chain(DEGRADATION), torch.tensor(COSTS)
    return RepairModel(preset.graph, chain, costs, DISCOUNT, num_robots=preset.num_robots, partition=partition, device=device)


def _training(model: RepairModel) -> tuple[StateGenerator, ...]:
    """Random states of every part; the phase is proposed, the density class is met by rejection."""
    startgame, endgame = RandomState(model, (0.5, 1.0)), RandomState(model, (0.0, 0.5))
    parts = range(6)
    return tuple(InPart(model, startgame if part < 3 else endgame, part) for part in parts)
