r"""The untrained networks of a partitioned architecture, as a configuration describes them (paper, Section V)."""

from __future__ import annotations

import torch

from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.envs.presets import Problem
from torchrl_pomdp.modules import (
    Encoder,
    FlatEncoder,
    NeverRepairCost,
    PartitionedPolicy,
    PartitionedValue,
    PolicyNetwork,
    RelativeEncoder,
    ValueNetwork,
)
from torchrl_pomdp.trainers.config import PolicyIterationConfig

__all__ = ["ENCODERS", "make_networks", "make_values", "partition_of"]

ENCODERS = {"flat": FlatEncoder, "relative": RelativeEncoder}
"""The encoders by name."""


def make_networks(
    problem: Problem, config: PolicyIterationConfig, seed: int, encoder: Encoder | None = None
) -> PartitionedPolicy:
    """An untrained partitioned policy: one policy network for each part of the problem's partition.

    Args:
        problem: the problem.
        config: sizes and encoding.
        seed: seed of the initial weights.
        encoder: encoder that the networks share; by default a new one as the configuration says.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> len(make_networks(make_problem("linear20"), PolicyIterationConfig(), seed=0).policies)
        6
    """
    model = problem.model
    generator = torch.Generator(device=model.device).manual_seed(seed)
    encoder = encoder or ENCODERS[config.encoder](model)
    parts = range(partition_of(problem).num_parts)
    return PartitionedPolicy([PolicyNetwork(encoder, model.num_controls, config.hidden, generator=generator) for _ in parts])


def make_values(problem: Problem, config: PolicyIterationConfig, seed: int, encoder: Encoder | None = None) -> PartitionedValue:
    """An untrained partitioned value: one value network for each part, in multiples of the cost of never repairing.

    Args:
        problem: the problem.
        config: sizes and encoding.
        seed: seed of the initial weights.
        encoder: encoder that the networks share; by default a new one as the configuration says.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> len(make_values(make_problem("linear20"), PolicyIterationConfig(), seed=0).values)
        6
    """
    model = problem.model
    generator = torch.Generator(device=model.device).manual_seed(seed)
    encoder = encoder or ENCODERS[config.encoder](model)
    parts, scale = range(partition_of(problem).num_parts), NeverRepairCost(model)
    return PartitionedValue([ValueNetwork(encoder, scale, config.value_hidden, generator=generator) for _ in parts])


def partition_of(problem: Problem) -> Partition:
    """The partition of the problem's model; a ``ValueError`` if it has none."""
    if problem.model.partition is None:
        raise ValueError(f"the model of problem {problem.name!r} has no partition; give it one, SinglePart() for none")
    return problem.model.partition
