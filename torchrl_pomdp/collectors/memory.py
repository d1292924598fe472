"""The memory of states that policies visit (paper, Section VI-C): a bounded random sample, part by part."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_callable, check_instance, check_integer, check_number
from torchrl_pomdp.envs.belief_model import BeliefModel, StateGenerator
from torchrl_pomdp.envs.rows import random_control, take_rows
from torchrl_pomdp.modules.policies import Policy, check_policy, controls_of
from torchrl_pomdp.modules.rollout import check_max_steps
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.modules.threads import rows_at_once
from torchrl_pomdp.noise import fold, uniform
from torchrl_pomdp.tensor_checks import check_keys
from torchrl_pomdp.workers import LOCAL, Workers

__all__ = ["StateMemory"]

# What a key's independent streams are for.
_START, _STEPS, _EXPLORE, _CONTROL, _PICK, _RETAIN = range(16, 22)
# Trajectories that are followed at once on a CPU.
_BLOCK = 8192


class StateMemory:
    """A random sample of the states that policies have visited, bounded in every part.

    Each visit retains its state with probability ``retain``, once however often it is retained: a state that is often
    visited is hardly ever missing. Of more than ``capacity`` retained states of a part a random subset is kept. What is kept
    is a function of the seed and of the visits alone, not of their order.

    Args:
        model: the belief model; without a partition all states are in part 0.
        capacity: largest number of states of a part.
        retain: probability that a visit retains its state, in (0, 1]; the paper's is about 0.1.
        seed: seed of the sample.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``capacity`` is not positive or ``retain`` is not in (0, 1].

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> problem = make_problem("linear20")
        >>> memory = StateMemory(problem.model, capacity=100)
        >>> memory.visit(GreedyRepair(problem.model), problem.start, torch.arange(200))
        >>> 0 < memory.count(1) <= 100, memory.generator(1)(torch.arange(3)).batch_size
        (True, torch.Size([3]))
    """

    def __init__(self, model: BeliefModel, capacity: int = 100_000, retain: float = 0.1, seed: int = 0) -> None:
        self.model = check_instance("model", model, BeliefModel)
        self.capacity = check_integer("capacity", capacity, 1)
        self.retain = check_number("retain", retain, "(0, 1]")
        self.seed = check_integer("seed", seed)
        parts = 1 if model.partition is None else model.partition.num_parts
        # For each part the states (core entries) and their priorities, ascending.
        self._kept: list[tuple[TensorDictBase, Tensor] | None] = [None] * parts
        # Retained states that are not merged with those yet.
        self._pending: list[TensorDictBase] = []
        # Parts that improve at their own pace read while others write.
        self._lock = threading.RLock()

    def count(self, part: int) -> int:
        """Number of states of a part.

        Raises:
            TypeError: if ``part`` is no integer.
            ValueError: if there is no such part.
        """
        kept = self._states_of(part)
        return 0 if kept is None else kept[1].numel()

    def visit(
        self,
        policy: Policy,
        start: StateGenerator,
        keys: Tensor,
        *,
        exploration: float = 0.0,
        max_steps: int | None = None,
        workers: Workers = LOCAL,
    ) -> None:
        """Follow a policy from start states and remember what it visits.

        Args:
            policy: the policy.
            start: generator of start states.
            keys: int64 ``[N]``, one for each trajectory.

        Keyword Args:
            exploration: probability of a random legal control at each step, in [0, 1].
            max_steps: length at which trajectories are cut; None: :attr:`BeliefModel.horizon`.
            workers: who follows it.

        Raises:
            TypeError: if an argument is of the wrong kind.
            ValueError: if ``exploration`` is not in [0, 1], ``max_steps`` is not positive, a start state does not fit the
                model or a control of the policy is illegal.
        """
        check_policy("policy", policy, self.model)
        check_callable("start", start)
        exploration = check_number("exploration", exploration, "[0, 1]")
        check_instance("workers", workers, Workers).check_device(self.model.device)
        max_steps = check_max_steps(max_steps, self.model)
        if check_keys("keys", keys).ndim != 1:
            raise ValueError(f"keys must have shape [N], got {tuple(keys.shape)}")
        shared = self.model, policy, start, exploration, max_steps, (self.retain, self.seed)
        blocks = keys.split(max(1, rows_at_once(_BLOCK, keys.device) // workers.pieces))
        for handle, found in workers.tasks(visits, shared, blocks, lambda own: f"visits of {len(own)} trajectories"):
            if found:
                self._add(workers.fetch(handle))

    def generator(self, part: int) -> StateGenerator:
        """Generator of the states of a part that are kept now, all equally likely.

        Raises:
            TypeError: if ``part`` is no integer.
            ValueError: if there are none, or there is no such part.
        """
        kept = self._states_of(part)
        if kept is None:
            raise ValueError(f"the memory holds no state of part {part}")
        states = kept[0]

        def draw(keys: Tensor) -> TensorDictBase:
            # Whole hashes: a uniform of 24 bits would not reach all of many states.
            index = fold(keys.reshape(-1), _PICK).remainder(states.batch_size[0])
            return take_rows(states, index).view(keys.shape)

        return draw

    def _states_of(self, part: int) -> tuple[TensorDictBase, Tensor] | None:
        with self._lock:
            self._merge()
        return self._kept[check_integer("part", part, 0, len(self._kept) - 1)]

    def _add(self, y: Any) -> None:
        """Remember ``y``; merge once more is pending than kept, so that what is kept is not copied at every call."""
        with self._lock:
            self._pending.append(y)
            kept = sum(priority.numel() for _, priority in filter(None, self._kept))
            if sum(pending.batch_size[0] for pending in self._pending) > kept:
                self._merge()

    def _merge(self) -> None:
        """Keep, of what is kept and what is pending, the states of lowest priority; equal states once."""
        if not self._pending:
            return
        y: Any = torch.cat(self._pending, 0)
        self._pending = []
        for part, kept in enumerate(self._kept):
            rows = (y.get("part") == part).nonzero().squeeze(-1)
            if rows.numel() == 0:
                continue
            states: Any = take_rows(y.select(*self.model.state_keys), rows)
            priority = y.get("priority")[rows]
            if kept is not None:
                states, priority = torch.cat([kept[0], states], 0), torch.cat([kept[1], priority])
            priority, order = priority.sort(stable=True)
            new = torch.ones_like(priority, dtype=torch.bool)
            new[1:] = priority.diff() != 0
            chosen = new.nonzero().squeeze(-1)[: self.capacity]
            self._kept[part] = take_rows(states, order[chosen]), priority[chosen]


def visits(shared: tuple[Any, ...], keys: Tensor) -> tuple[TensorDictBase | None, int]:
    """The retained states of every step of the trajectories with the given keys, with their priority and part; and how many.

    Args:
        shared: model, policy, start states, exploration, number of steps, and how states are retained: probability and seed.
        keys: keys of the trajectories, ``[N]``.
    """
    model, policy, start, exploration, max_steps, retention = shared
    with torch.no_grad():
        steps = _walk(model, policy, start, exploration, max_steps, keys)
        found: list[Any] = [_retained(model, y, visit, *retention) for y, visit in steps]
    states = torch.cat(found, 0) if found else None
    return states, 0 if states is None else len(states)


def _walk(
    model: BeliefModel, policy: Policy, start: StateGenerator, exploration: float, max_steps: int, keys: Tensor
) -> Iterator[tuple[TensorDictBase, Tensor]]:
    """The states of every step of the trajectories with the given keys, and a key of each visit."""
    y = model.derive(model.drawn(start, fold(keys, _START), "start"))
    scenarios = Scenarios.single(fold(keys, _STEPS))
    for step in range(max_steps):
        rest = (~model.is_terminal(y)).nonzero().squeeze(-1)
        if rest.numel() < keys.numel():
            y, keys, scenarios = take_rows(y, rest), keys[rest], scenarios.rows(rest)
        if keys.numel() == 0:
            return
        yield y, fold(fold(keys, _RETAIN), step)
        u = controls_of("policy", policy, y.copy())
        model.check_controls(y, u)
        random = random_control(y.get("action_mask"), model.control_noise(fold(keys, _CONTROL), step))
        u = torch.where(model.control_noise(fold(keys, _EXPLORE), step) < exploration, random, u)
        noise, scenarios = scenarios.draw(torch.full_like(keys, step), model.observed(y, u), 1)
        _, y = model.advance(y, u, noise)


def _retained(model: BeliefModel, y: TensorDictBase, visit: Tensor, retain: float, seed: int) -> TensorDictBase:
    """The rows of ``y`` that their visits retain, with their priority and part."""
    entries = y.select(*model.state_keys)
    priority = fold(model.fingerprint(entries), seed)
    part = y.get("partition") if model.partition is not None else torch.zeros_like(priority)
    rows = (uniform(fold(visit, seed), 0) < retain).nonzero().squeeze(-1)
    return take_rows(entries, rows).update({"priority": priority[rows], "part": part[rows]})
