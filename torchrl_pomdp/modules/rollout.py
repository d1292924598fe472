r"""The rollout engine: Monte-Carlo estimates of :math:`(T_\mu^m\hat J)(y)` (paper, Section III)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_pomdp.envs.belief import BeliefModel, take_rows
from torchrl_pomdp.noise import uniform

__all__ = ["Policy", "TerminalCost", "TruncatedRollout", "step_noise"]

Policy = Callable[[TensorDictBase], TensorDictBase]
"""A policy writes ``"action"``, int64 ``[*B]``, into a TensorDict of feature states; any TensorDictModule with that key."""

TerminalCost = Callable[[TensorDictBase], Tensor]
"""Terminal cost approximation: feature states ``[*B]`` to costs ``[*B]``."""

# Finished rows are dropped when they are more than this fraction of the batch; dropping more often costs more copies.
_DROP_FRACTION = 0.2


def step_noise(keys: Tensor, step: int, noise_dim: int) -> Tensor:
    """Uniforms ``[*B, noise_dim]`` of one step of the trajectories with int64 ``keys`` ``[*B]``."""
    first = step * noise_dim
    return torch.stack([uniform(keys, first + i) for i in range(noise_dim)], -1)


class TruncatedRollout(nn.Module):
    r"""Discounted cost of following a base policy from given feature states, one trajectory each.

    :math:`\sum_{k<m}\alpha^k\hat g(y_k,\mu(y_k))+\alpha^m\hat J(y_m)`; a trajectory that reaches a terminal state ends
    there without further cost. The stage cost is the belief's expectation, not a realised cost.

    Args:
        model: the belief model.
        base_policy: :math:`\mu`.

    Keyword Args:
        max_steps: m, the largest number of steps.
        terminal_cost: :math:`\hat J`, added at the cut; None is zero, right where m is large enough for discounting or
            the terminal states to make the rest insignificant.

    Raises:
        ValueError: if ``max_steps`` is not positive.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> from torchrl_pomdp.modules import GreedyRepair
        >>> problem = make_problem("line3")
        >>> cost = TruncatedRollout(problem.model, GreedyRepair(problem.model))
        >>> keys = torch.arange(2000)
        >>> bool((cost(problem.start(keys), keys).mean() - 195).abs() < 10)
        True
    """

    def __init__(
        self,
        model: BeliefModel,
        base_policy: Policy,
        *,
        max_steps: int = 400,
        terminal_cost: TerminalCost | None = None,
    ) -> None:
        super().__init__()
        if max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {max_steps}")
        self.model, self.base_policy = model, base_policy
        self.max_steps, self.terminal_cost = max_steps, terminal_cost
        # Features that nobody reads are not computed; a plain callable may read all of them.
        self._keys = tuple(getattr(base_policy, "in_keys", ())) or None

    @torch.no_grad()
    def forward(self, y: TensorDictBase, keys: Tensor) -> Tensor:
        """Cost of one trajectory from every row.

        Args:
            y: feature states ``[N]``.
            keys: int64 ``[N]``; step k of a row uses the uniforms of its key with counter k.

        Returns:
            costs ``[N]``.
        """
        total = torch.zeros(keys.shape, dtype=self.model.dtype, device=keys.device)
        live = torch.arange(keys.numel(), device=keys.device)
        y = self.model.with_features(y, self._keys)
        discount = 1.0
        for step in range(self.max_steps):
            y, keys, live, ended = self._drop_finished(y, keys, live)
            if live.numel() == 0:
                return total
            u = self.base_policy(y).get("action")
            cost, y = self.model.advance(y, u, step_noise(keys, step, self.model.noise_dim))
            total.index_add_(0, live, cost.masked_fill(ended, 0.0), alpha=discount)
            discount *= self.model.discount
        if self.terminal_cost is not None:
            rest = self.terminal_cost(y).masked_fill(self.model.is_terminal(y), 0.0)
            total.index_add_(0, live, rest, alpha=discount)
        return total

    def _drop_finished(self, y: TensorDictBase, keys: Tensor, live: Tensor) -> tuple[TensorDictBase, Tensor, Tensor, Tensor]:
        """Drop terminal rows once they are many; also returns which of the rows left are terminal."""
        ended = self.model.is_terminal(y)
        count = int(ended.sum())
        if count <= _DROP_FRACTION * ended.numel():
            return y, keys, live, ended
        rest = (~ended).nonzero().squeeze(-1)
        return take_rows(y, rest), keys[rest], live[rest], ended[rest]
