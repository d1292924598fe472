r"""What names and a configuration stand for: encoders, base policies, untrained partitioned networks (paper, Section V)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from torchrl_pomdp.checks import check_instance, check_seed
from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.envs.presets import Problem
from torchrl_pomdp.envs.repair import RepairModel
from torchrl_pomdp.modules import (
    ClosedFormCost,
    Encoder,
    FlatEncoder,
    GreedyRepair,
    NeverRepairCost,
    PartitionedPolicy,
    PartitionedValue,
    PolicyNetwork,
    RelativeEncoder,
    UrgencyRepair,
    ValueNetwork,
)

__all__ = ["BASE_POLICIES", "ENCODERS", "make_networks", "make_values", "partition_of"]

ENCODERS: dict[str, Callable[..., Encoder]] = {"flat": FlatEncoder, "relative": RelativeEncoder}
"""The encoders by name."""

BASE_POLICIES: dict[str, Callable[..., TensorDictModuleBase]] = {"greedy": GreedyRepair, "urgency": UrgencyRepair}
"""The base policies by name; made from the model."""


def make_networks(
    problem: Problem, config: PolicyIterationConfig, seed: int, encoder: Encoder | None = None
) -> PartitionedPolicy:
    """An untrained partitioned policy: one policy network for each part of the problem's partition.

    Args:
        problem: the problem.
        config: sizes and encoding.
        seed: seed of the initial weights.
        encoder: encoder that the networks share; by default a new one as the configuration says.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if ``seed`` is out of range, or the problem's model has no partition.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> len(make_networks(make_problem("linear20"), PolicyIterationConfig(), seed=0).policies)
        6
    """
    model, encoder = _checked(problem, config, seed, encoder)
    generator = torch.Generator(device=model.device).manual_seed(seed)
    parts = range(partition_of(problem).num_parts)
    return PartitionedPolicy([PolicyNetwork(encoder, model.num_controls, config.hidden, generator=generator) for _ in parts])


def make_values(
    problem: Problem,
    config: PolicyIterationConfig,
    seed: int,
    encoder: Encoder | None = None,
    scale: ClosedFormCost | None = None,
) -> PartitionedValue:
    """An untrained partitioned value: one value network for each part, in multiples of the cost of never repairing.

    Args:
        problem: the problem.
        config: sizes and encoding.
        seed: seed of the initial weights.
        encoder: encoder that the networks share; by default a new one as the configuration says.
        scale: scale that the networks share; by default a new one, the cost of never repairing.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if ``seed`` is out of range, or the problem's model has no partition.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> len(make_values(make_problem("linear20"), PolicyIterationConfig(), seed=0).values)
        6
    """
    model, encoder = _checked(problem, config, seed, encoder)
    generator = torch.Generator(device=model.device).manual_seed(seed)
    scale = NeverRepairCost(model) if scale is None else check_instance("scale", scale, ClosedFormCost)
    parts = range(partition_of(problem).num_parts)
    return PartitionedValue([ValueNetwork(encoder, scale, config.value_hidden, generator=generator) for _ in parts])


def _checked(problem: Any, config: Any, seed: Any, encoder: Any) -> tuple[RepairModel, Encoder]:
    """Model and encoder of networks."""
    check_instance("problem", problem, Problem)
    check_instance("config", config, PolicyIterationConfig)
    check_seed("seed", seed)
    if encoder is None:
        encoder = ENCODERS[config.encoder](problem.model)
    return problem.model, check_instance("encoder", encoder, Encoder)


def partition_of(problem: Problem) -> Partition:
    """The partition of the problem's model; a ``ValueError`` if it has none."""
    if problem.model.partition is None:
        raise ValueError(f"the model of problem {problem.name!r} has no partition; give it one, SinglePart() for none")
    return problem.model.partition
