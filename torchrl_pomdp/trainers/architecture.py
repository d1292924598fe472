r"""Untrained partitioned networks, as a configuration describes them (paper, Section V)."""

from __future__ import annotations

from typing import Any, TypeVar

import torch

from torchrl_pomdp.checks import check_instance, check_seed
from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.modules import (
    AgentEncoder,
    AgentNetwork,
    ClosedFormCost,
    Encoder,
    FlatAgentEncoder,
    FlatEncoder,
    PartitionedPolicy,
    PartitionedValue,
    PolicyNetwork,
    ValueNetwork,
)
from torchrl_pomdp.problems.problem import Problem

__all__ = ["is_multiagent", "make_agent_encoder", "make_encoder", "make_networks", "make_values", "weightless"]


_E = TypeVar("_E", bound=Encoder)


def is_multiagent(problem: Problem, config: PolicyIterationConfig) -> bool:
    """Whether agents share one policy network and decide in turn: as the configuration says, or where there are too many."""
    return config.multiagent or not problem.model.enumerable


def make_encoder(problem: Problem, config: PolicyIterationConfig) -> Encoder:
    """The encoder that the configuration names: the problem's own, or the flat one."""
    if config.encoder != "own":
        return FlatEncoder(problem.model)
    return weightless(check_instance("encoder", problem.encoder(problem.model), Encoder))


def make_agent_encoder(problem: Problem, config: PolicyIterationConfig) -> AgentEncoder:
    """The encoder of a network that many agents share: the problem's own, or the flat one."""
    if config.encoder != "own":
        return FlatAgentEncoder(problem.model)
    return weightless(check_instance("encoder", problem.agent_encoder(problem.model), AgentEncoder))


def make_networks(
    problem: Problem, config: PolicyIterationConfig, seed: int, encoder: Encoder | None = None
) -> PartitionedPolicy:
    """An untrained partitioned policy: one policy network for each part of the problem's partition.

    Many agents share an :class:`~torchrl_pomdp.modules.AgentNetwork`, where the configuration says so or there are too many
    joint controls.

    Args:
        problem: the problem.
        config: sizes and encoding.
        seed: seed of the initial weights.
        encoder: encoder that the networks share, for many agents an :class:`~torchrl_pomdp.modules.AgentEncoder`; by default a
            new one as the configuration says.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if ``seed`` is out of range.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> len(make_networks(make_problem("linear20"), PolicyIterationConfig(), seed=0).policies)
        6
    """
    check_instance("problem", problem, Problem)
    check_instance("config", config, PolicyIterationConfig)
    parts, multiagent = range(problem.partition.num_parts), is_multiagent(problem, config)
    if encoder is None:
        encoder = make_agent_encoder(problem, config) if multiagent else make_encoder(problem, config)
    model, encoder = _checked(problem, config, seed, encoder)
    generator = torch.Generator(device=model.device).manual_seed(seed)
    if multiagent:
        own = check_instance("encoder", encoder, AgentEncoder)
        return PartitionedPolicy([AgentNetwork(own, config.hidden, generator=generator) for _ in parts])
    return PartitionedPolicy([PolicyNetwork(encoder, model.num_controls, config.hidden, generator=generator) for _ in parts])


def make_values(
    problem: Problem,
    config: PolicyIterationConfig,
    seed: int,
    encoder: Encoder | None = None,
    scale: ClosedFormCost | None = None,
) -> PartitionedValue:
    """An untrained partitioned value: one value network for each part, in multiples of the problem's pessimistic cost.

    Args:
        problem: the problem.
        config: sizes and encoding.
        seed: seed of the initial weights.
        encoder: encoder that the networks share; by default a new one as the configuration says.
        scale: scale that the networks share; by default the problem's pessimistic cost.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if ``seed`` is out of range.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> len(make_values(make_problem("linear20"), PolicyIterationConfig(), seed=0).values)
        6
    """
    model, encoder = _checked(problem, config, seed, encoder)
    generator = torch.Generator(device=model.device).manual_seed(seed)
    scale = problem.pessimistic_cost if scale is None else check_instance("scale", scale, ClosedFormCost)
    parts = range(problem.partition.num_parts)
    return PartitionedValue([ValueNetwork(encoder, scale, config.value_hidden, generator=generator) for _ in parts])


def _checked(problem: Any, config: Any, seed: Any, encoder: Any) -> tuple[BeliefModel, Encoder]:
    """Model and encoder of networks."""
    check_instance("problem", problem, Problem)
    check_instance("config", config, PolicyIterationConfig)
    check_seed("seed", seed)
    if encoder is None:
        encoder = make_encoder(problem, config)
    return problem.model, weightless(check_instance("encoder", encoder, Encoder))


def weightless(encoder: _E) -> _E:
    """An encoder that all networks share: training one would change the others, and checkpoints keep none of its weights."""
    kept = sorted(encoder.state_dict())
    if kept:
        raise ValueError(
            f"encoder must have no weights of its own, and only buffers that are not persistent: got {', '.join(kept)}; layers "
            "to be trained belong into the network"
        )
    return encoder
