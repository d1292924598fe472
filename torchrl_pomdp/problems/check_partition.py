"""How a partition divides the states that occur, and whether its stages are in the right order (paper, Section V)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_callable, check_instance, check_integer
from torchrl_pomdp.config import MAX_STATES
from torchrl_pomdp.envs.belief_model import BeliefModel, StateGenerator
from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.envs.rows import random_control, take_rows
from torchrl_pomdp.modules.policies import Policy, check_policy, controls_of
from torchrl_pomdp.modules.rollout import MAX_STEPS
from torchrl_pomdp.noise import fold, seed_keys, uniform

__all__ = ["PartitionReport", "check_partition"]

# What the uniforms of a trajectory are for; those of its stages are no start state's.
_START, _STAGES, _STEP, _CONTROL = range(4)


@dataclass(frozen=True)
class PartitionReport:
    """What was found of a partition; as a text it is a table.

    Attributes:
        names: names of the parts.
        stages: number of the stage of each part, in the order of training.
        start: share of each part among the start states that are not terminal.
        visited: share of each part among the states that are not terminal on the trajectories.
        transitions: how often one part (first index) led to another, terminal states left out.
        violations: pairs of parts, one of which led to the other though that belongs to a later stage, with how often.
    """

    names: tuple[str, ...]
    stages: tuple[int, ...]
    start: tuple[float, ...]
    visited: tuple[float, ...]
    transitions: tuple[tuple[int, ...], ...]
    violations: dict[tuple[str, str], int]

    def __str__(self) -> str:
        """A table of the parts, and what breaks the order of the stages."""
        width = max(4, *map(len, self.names))
        lines = [f"{'part':<{width}}  stage  start  visited"]
        for name, stage, start, visited in zip(self.names, self.stages, self.start, self.visited, strict=True):
            lines.append(f"{name:<{width}}  {stage:5d}  {start:5.1%}  {visited:7.1%}")
        total = sum(map(sum, self.transitions))
        broken = sum(self.violations.values())
        lines.append(f"{broken} of {total} transitions lead to a later stage" + (":" if broken else ""))
        lines += [f"  {first} -> {second}: {count}" for (first, second), count in self.violations.items()]
        return "\n".join(lines)


def check_partition(
    model: BeliefModel,
    start: StateGenerator,
    policy: Policy | None = None,
    *,
    num_states: int = 1000,
    max_steps: int = 50,
    seed: int = 0,
) -> PartitionReport:
    """Shares of a model's parts among start states and visited states, and transitions against the order of the stages.

    Training asks that states of a stage lead only to parts of the same or earlier stages, and that every part occurs. Nothing
    is raised where they do not: the report says so.

    Args:
        model: the belief model, with a partition.
        start: generator of start states.
        policy: the policy that is followed; None: random legal controls.

    Keyword Args:
        num_states: number of start states, with one trajectory from each.
        max_steps: stages of a trajectory, unless it reaches a terminal state.
        seed: seed of start states, random controls and observations.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if the model has no partition, a number is out of range, or a start state is none of the model's.

    Examples:
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> report = check_partition(problem.model, problem.start, GreedyRepair(problem.model), num_states=200)
        >>> print(report)
        part                stage  start  visited
        ...
        0 of ... transitions lead to a later stage
    """
    check_instance("model", model, BeliefModel)
    check_callable("start", start)
    if policy is not None:
        check_policy("policy", policy, model)
    if model.partition is None:
        raise ValueError("model must have a partition, got one without: use model.with_partition(...)")
    num_states = check_integer("num_states", num_states, 1, MAX_STATES)
    max_steps = check_integer("max_steps", max_steps, 0, MAX_STEPS)
    keys = seed_keys(check_integer("seed", seed), torch.arange(num_states, device=model.device))
    with torch.no_grad():
        return _report(model.partition, *_counts(model, start, policy, keys, max_steps))


def _report(partition: Partition, start: Tensor, visited: Tensor, moves: Tensor) -> PartitionReport:
    count = partition.num_parts
    stage = {part: number for number, stage in enumerate(partition.stages) for part in stage}
    broken = {
        (partition.names[a], partition.names[b]): int(moves[a, b])
        for a in range(count)
        for b in range(count)
        if stage[b] > stage[a] and moves[a, b]
    }
    return PartitionReport(
        names=tuple(partition.names),
        stages=tuple(stage[part] for part in range(count)),
        start=_shares(start),
        visited=_shares(visited),
        transitions=tuple(tuple(row) for row in moves.tolist()),
        violations=broken,
    )


def _shares(counts: Tensor) -> tuple[float, ...]:
    return tuple((counts / counts.sum().clamp_min(1)).tolist())


def _counts(
    model: BeliefModel, start: StateGenerator, policy: Policy | None, keys: Tensor, max_steps: int
) -> tuple[Tensor, Tensor, Tensor]:
    """How often each part starts, is visited, ``[N]``, and follows each, ``[N, N]``; terminal states left out."""
    choose = _random_controls(model) if policy is None else lambda y, _: controls_of("policy", policy, y.copy())
    y = model.derive(model.drawn(start, fold(keys, _START), "start"))
    y, keys, part = _alive(model, y, keys)
    first = _number(model, part)
    visited, moves = first.clone(), torch.zeros(len(first), len(first), dtype=torch.int64)
    for step in range(max_steps):
        if not len(keys):
            break
        now = fold(fold(keys, _STAGES), step)
        u = choose(y, fold(now, _CONTROL))
        model.check_controls(y, u)
        noise = uniform(fold(now, _STEP).unsqueeze(-1), torch.arange(model.noise_dim, device=keys.device))
        before, rows = part, torch.arange(len(keys), device=keys.device)
        y, rows, part = _alive(model, model.advance(y, u, noise.to(model.dtype))[1], rows)
        keys = keys[rows]
        visited += _number(model, part)
        pair = before[rows] * len(first) + part
        moves += torch.bincount(pair, minlength=moves.numel()).cpu().view(moves.shape)
    return first, visited, moves


def _alive(model: BeliefModel, y: TensorDictBase, keys: Tensor) -> tuple[TensorDictBase, Tensor, Tensor]:
    """States that are not terminal, with their keys and parts."""
    rows = (~model.is_terminal(y)).nonzero().squeeze(-1)
    y = take_rows(y, rows)
    return y, keys[rows], y.get("partition")


def _number(model: BeliefModel, part: Tensor) -> Tensor:
    assert model.partition is not None
    return torch.bincount(part, minlength=model.partition.num_parts).cpu()


def _random_controls(model: BeliefModel) -> Callable[[TensorDictBase, Tensor], Tensor]:
    def choose(y: TensorDictBase, keys: Tensor) -> Tensor:
        return random_control(y.get("action_mask"), model.control_noise(keys, 0))

    return choose
