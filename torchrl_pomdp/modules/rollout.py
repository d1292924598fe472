r"""The rollout engine: Monte-Carlo estimates of :math:`(T_\mu^m\hat J)(y)` (paper, Section III)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_pomdp.envs.belief import BeliefModel, put_rows, take_rows
from torchrl_pomdp.modules.compiling import compiled
from torchrl_pomdp.noise import uniform

__all__ = ["Policy", "TerminalCost", "TruncatedRollout", "step_noise"]

Policy = Callable[[TensorDictBase], TensorDictBase]
"""A policy writes ``"action"``, int64 ``[*B]``, into a TensorDict of feature states; any TensorDictModule with that key."""

TerminalCost = Callable[[TensorDictBase], Tensor]
"""Terminal cost approximation: feature states ``[*B]`` to costs ``[*B]``."""

# Finished rows give way to waiting ones when they are this fraction of the live rows; doing it more often costs more copies.
_RENEW_FRACTION = 0.15


def step_noise(keys: Tensor, step: int | Tensor, noise_dim: int) -> Tensor:
    """Uniforms ``[*B, noise_dim]`` of one step, for all or for each of the trajectories with int64 ``keys`` ``[*B]``."""
    first = step * noise_dim
    return torch.stack([uniform(keys, first + i) for i in range(noise_dim)], -1)


class _Live(NamedTuple):
    """The trajectories that are simulated now: features, keys, number in the batch and steps made."""

    y: TensorDictBase
    keys: Tensor
    number: Tensor
    age: Tensor

    def rows(self, chosen: Tensor) -> _Live:
        index = chosen.nonzero().squeeze(-1)
        return _Live(take_rows(self.y, index), self.keys[index], self.number[index], self.age[index])

    def replace_rows(self, index: Tensor, other: _Live) -> _Live:
        rest = (mine.index_copy(0, index, theirs) for mine, theirs in zip(self[1:], other[1:], strict=True))
        return _Live(put_rows(self.y, index, other.y), *rest)


class TruncatedRollout(nn.Module):
    r"""Discounted cost of following a base policy from given feature states, one trajectory each.

    :math:`\sum_{k<m}\alpha^k\hat g(y_k,\mu(y_k))+\alpha^m\hat J(y_m)`; a trajectory that reaches a terminal state ends
    there without further cost. The stage cost is the belief's expectation, not a realised cost.

    At most ``chunk_rows`` trajectories are simulated at a time. As they finish, waiting ones take their place, so that
    every step works on a full chunk whatever the trajectories' lengths.

    Args:
        model: the belief model.
        base_policy: :math:`\mu`.

    Keyword Args:
        max_steps: m, the largest number of steps.
        terminal_cost: :math:`\hat J`, added at the cut; None is zero, right where m is large enough for discounting or
            the terminal states to make the rest insignificant.
        chunk_rows: largest number of trajectories simulated at once; bounds the memory, never changes the result.
        compile: whether to fuse policy and belief step by ``torch.compile``, see :func:`~.compiling.compiled`; worth its
            time for long runs with simple base policies.

    Raises:
        ValueError: if ``max_steps`` or ``chunk_rows`` is not positive.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> from torchrl_pomdp.modules import GreedyRepair
        >>> problem = make_problem("line3")
        >>> cost = TruncatedRollout(problem.model, GreedyRepair(problem.model))
        >>> keys = torch.arange(2000)
        >>> bool((cost(problem.start(keys), keys).mean() - 195).abs() < 10)
        True
    """

    _discounts: Tensor

    def __init__(
        self,
        model: BeliefModel,
        base_policy: Policy,
        *,
        max_steps: int = 400,
        terminal_cost: TerminalCost | None = None,
        chunk_rows: int = 16384,
        compile: bool = False,
    ) -> None:
        super().__init__()
        for name, value in (("max_steps", max_steps), ("chunk_rows", chunk_rows)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self.model, self.base_policy = model, base_policy
        self.max_steps, self.terminal_cost, self.chunk_rows = max_steps, terminal_cost, chunk_rows
        # Features that nobody reads are not computed; a plain callable may read all of them.
        self._keys = tuple(getattr(base_policy, "in_keys", ())) or None
        powers = model.discount ** torch.arange(max_steps + 1, dtype=torch.float64)
        self._transition = compiled(self._policy_and_step) if compile else self._policy_and_step
        self.register_buffer("_discounts", powers.to(model.device, model.dtype), persistent=False)

    def forward(self, y: TensorDictBase, keys: Tensor) -> Tensor:
        """Cost of one trajectory from every row.

        Args:
            y: feature states ``[N]``.
            keys: int64 ``[N]``; step k of a row uses the uniforms of its key with counter k.

        Returns:
            costs ``[N]``.
        """
        total = torch.zeros(keys.shape, dtype=self.model.dtype, device=keys.device)
        with torch.inference_mode():
            self._simulate(y, keys, total)
        return total

    def _simulate(self, y: TensorDictBase, keys: Tensor, total: Tensor) -> None:
        """Add the cost of every trajectory to ``total`` ``[N]``."""
        live, waiting = self._admit(y, keys, 0, self.chunk_rows), self.chunk_rows
        clock, cuts = 0, {self.max_steps}
        while True:
            ended, cut = self._ended(live), clock in cuts
            if cut or int(ended.sum()) > _RENEW_FRACTION * ended.numel():
                if cut:
                    self._add_terminal_costs(live.rows(live.age == self.max_steps), total)
                free = ended.nonzero().squeeze(-1)[: max(0, keys.numel() - waiting)]
                if free.numel():
                    live = live.replace_rows(free, self._admit(y, keys, waiting, waiting + free.numel()))
                    waiting += free.numel()
                    cuts.add(clock + self.max_steps)
                    ended = self._ended(live)
                if waiting >= keys.numel():
                    live, ended = live.rows(~ended), ended[~ended]
                if live.keys.numel() == 0:
                    return
            live = self._step(live, ended, total)
            clock += 1

    def _admit(self, y: TensorDictBase, keys: Tensor, first: int, last: int) -> _Live:
        """The trajectories number ``first`` to ``last``, at their start."""
        number = torch.arange(first, min(last, keys.numel()), device=keys.device)
        start = self.model.with_features(y[first:last].clone(), self._keys)
        return _Live(start, keys[first:last].clone(), number, torch.zeros_like(number))

    def _step(self, live: _Live, ended: Tensor, total: Tensor) -> _Live:
        """One step of all live trajectories; those that have ended add no cost."""
        cost, y = self._transition(live.y, live.keys, live.age)
        total.index_add_(0, live.number, cost.masked_fill(ended, 0.0))
        return live._replace(y=y, age=live.age + 1)

    def _policy_and_step(self, y: TensorDictBase, keys: Tensor, age: Tensor) -> tuple[Tensor, TensorDictBase]:
        """Discounted stage cost ``[N]`` and next feature states of rows that have made ``age`` ``[N]`` steps."""
        u = self.base_policy(y).get("action")
        cost, nxt = self.model.advance(y, u, step_noise(keys, age, self.model.noise_dim))
        return cost * self._discounts[age], nxt

    def _ended(self, live: _Live) -> Tensor:
        return self.model.is_terminal(live.y) | (live.age == self.max_steps)

    def _add_terminal_costs(self, live: _Live, total: Tensor) -> None:
        """Cut trajectories get the terminal cost, unless they have just reached a terminal state."""
        if self.terminal_cost is not None and live.keys.numel():
            cost = self.terminal_cost(live.y).masked_fill(self.model.is_terminal(live.y), 0.0)
            total.index_add_(0, live.number, cost * self._discounts[-1])
