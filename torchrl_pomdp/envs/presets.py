"""The paper's problems by name, with their default parameters (Section VI)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from torchrl_pomdp.envs.belief import StateGenerator
from torchrl_pomdp.envs.generators import CalibratedStart, InPart, RandomState, UniformStart
from torchrl_pomdp.envs.graphs import Graph, grid, line
from torchrl_pomdp.envs.partition import RepairPartition
from torchrl_pomdp.envs.repair import RepairModel, damage_chain

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
    """

    name: str
    model: RepairModel
    start: StateGenerator
    training: tuple[StateGenerator, ...]


def make_problem(name: str, *, device: torch.device | str = "cpu") -> Problem:
    """Build a problem by name.

    Args:
        name: one of :data:`PRESETS`.
        device: where the model computes.

    Raises:
        ValueError: if there is no such preset; the message lists the known ones.

    Examples:
        >>> make_problem("linear20").model.describe()
        'line of 20, 1 robot: 1.9e+15 states, 3 controls, 5 observations, discount 0.99'
    """
    if name not in PRESETS:
        raise ValueError(f"unknown preset {name!r}; known presets: {', '.join(sorted(PRESETS))}")
    return PRESETS[name](name, torch.device(device))


def _repair_model(graph: Graph, num_robots: int, device: torch.device) -> RepairModel:
    costs = torch.tensor(COSTS)
    partition = RepairPartition(graph, costs, device=device)
    return RepairModel(
        graph, damage_chain(DEGRADATION), costs, DISCOUNT, num_robots=num_robots, partition=partition, device=device
    )


def _training(model: RepairModel) -> tuple[StateGenerator, ...]:
    """Random states of every part; the phase is proposed, the density class is met by rejection."""
    startgame, endgame = RandomState(model, (0.5, 1.0)), RandomState(model, (0.0, 0.5))
    parts = range(6)
    return tuple(InPart(model, startgame if part < 3 else endgame, part) for part in parts)


def _repair_problem(name: str, graph: Graph, num_robots: int, device: torch.device) -> Problem:
    model = _repair_model(graph, num_robots, device)
    return Problem(name, model, CalibratedStart(model), _training(model))


def _line3(name: str, device: torch.device) -> Problem:
    model = _repair_model(line(3), 1, device)
    return Problem(name, model, UniformStart(model), _training(model))


PRESETS: dict[str, Callable[[str, torch.device], Problem]] = {
    "line3": _line3,
    "linear20": lambda name, device: _repair_problem(name, line(20), 1, device),
    "grid5x4": lambda name, device: _repair_problem(name, grid(5, 4), 1, device),
    "grid6x6": lambda name, device: _repair_problem(name, grid(6, 6), 1, device),
    "two_robots20": lambda name, device: _repair_problem(name, line(20), 2, device),
}
"""Builders of the known problems, by name."""
