r"""Multistep lookahead: an :math:`\ell`-step problem with rollout at its end (paper, Sections II and III)."""

from __future__ import annotations

from time import perf_counter

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance, check_integer, check_number
from torchrl_pomdp.envs.rows import flat_rows, inverse_cdf, take_rows
from torchrl_pomdp.modules.lookahead import RolloutPolicy
from torchrl_pomdp.modules.qfactors import cheapest, check_q_factors
from torchrl_pomdp.noise import fold, uniform
from torchrl_pomdp.tensor_checks import check_distributions

__all__ = ["MultistepLookahead"]

# Root states that are expanded at once.
_BLOCK = 256
# With no time left, a state still gets the first trajectories.
_LEAST_SECONDS = 1e-6
# Stream of the drawn observations of a tree, apart from those of its trajectories, which are numbered from 0.
_OBSERVATIONS = 1 << 32


class MultistepLookahead(TensorDictModuleBase):
    r"""Lookahead over several steps, minimising over the tree; the last step is one-step lookahead with rollout.

    .. math:: Q_\ell(y,u)=\hat g(y,u)+\alpha\sum_z\hat p(z\mid b_y,u)\,\min_{u'}Q_{\ell-1}\bigl(F(y,u,z),u'\bigr)

    with :math:`Q_1` of the rollout policy. Illegal controls, observations of probability zero and terminal states are not
    expanded; equal states of a tree are expanded once. All states of a tree share their scenarios. Controls that are clearly
    inferior by their one-step Q-factors can be left out as well, see ``margin``.

    Args:
        policy: the rollout policy of the last step.
        depth: :math:`\ell`, 1 to 3.
        branches: up to so many observations of a control are expanded exactly; of more, so many are drawn, stratified.
        margin: a control is dominated, and not expanded, if its :math:`Q_1` exceeds the smallest one by more than this
            fraction of it. The preliminary Q-factors cost a step of rollout for every state that is expanded. None: all legal
            controls are expanded.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``depth`` is not 1, 2 or 3, ``branches`` is not in 1 to 256, or ``margin`` is negative.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> problem = make_problem("line3")
        >>> policy = MultistepLookahead(RolloutPolicy(problem.model, GreedyRepair(problem.model)), depth=2)
        >>> policy(problem.start(torch.arange(4)))["q_factors"].shape
        torch.Size([4, 3])
    """

    out_keys = ["action", "q_factors"]

    def __init__(self, policy: RolloutPolicy, depth: int = 2, branches: int = 5, margin: float | None = None) -> None:
        super().__init__()
        self.policy = check_instance("policy", policy, RolloutPolicy)
        if check_integer("depth", depth) not in (1, 2, 3):
            raise ValueError(f"depth must be 1, 2 or 3, got {depth}")
        self.depth = depth
        self.branches = check_integer("branches", branches, 1, _BLOCK)
        self.margin = None if margin is None else check_number("margin", margin, "[0, inf)")
        self.model, self.in_keys = policy.model, policy.in_keys

    @property
    def simulated_steps(self) -> int:
        """Belief steps simulated so far, see :class:`~torchrl_pomdp.modules.TruncatedRollout`."""
        return self.policy.simulated_steps

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"q_factors"`` ``[*B, U]``, see :meth:`q_factors`, and ``"action"`` ``[*B]`` (ties to the lower)."""
        q = self.q_factors(tensordict)
        return tensordict.update({"action": cheapest(q), "q_factors": q})

    @torch.no_grad()
    def q_factors(self, y: TensorDictBase) -> Tensor:
        r""":math:`Q_\ell(y,u)` ``[*B, U]``, costs; ``+inf`` where the control is illegal or, with a margin, dominated."""
        self.model.check_state(y)
        flat = flat_rows(y.select(*self.model.state_keys))
        if flat.batch_size[0] == 0:
            return self.policy.q_factors(y)
        # With a time for each decision, roots have trees of their own.
        size = _BLOCK if self.policy.seconds is None else 1
        q = [self._expand(block, self.policy.keys(block), self.depth, perf_counter()) for block in flat.split(size)]
        return torch.cat(q).view(*y.batch_size, -1)

    def _expand(self, y: TensorDictBase, keys: Tensor, depth: int, begin: float) -> Tensor:
        """Q-factors ``[N, U]`` of states whose trees have the keys ``keys`` ``[N]`` and were begun at ``begin``."""
        if depth == 1:
            return self._rolled_out(y, keys, begin)
        model, mask = self.model, self._worthwhile(y, keys, begin)
        state, u = mask.nonzero(as_tuple=True)
        pairs = take_rows(y, state)
        pair, observation, weight = self._observations(
            check_distributions("observation_probs", model.observation_probs(pairs, u)),
            fold(fold(keys[state], _OBSERVATIONS), depth),
        )
        successors = model.estimator(take_rows(pairs, pair), u[pair], observation)
        value = self._values(successors, keys[state[pair]], depth - 1, begin)
        # [P, branches]: summed in a fixed order.
        ranks = torch.arange(pair.numel(), device=u.device) - torch.searchsorted(pair, pair)
        terms = value.new_zeros(int(ranks.max()) + 1, u.numel())
        terms[ranks, pair] = weight * value
        total = terms[0]
        for term in terms[1:]:
            total = total + term
        q = torch.full(mask.shape, torch.inf, dtype=value.dtype, device=value.device)
        q[state, u] = model.expected_cost(pairs, u) + model.discount * total
        check_q_factors(q, mask)
        return q

    def _rolled_out(self, y: TensorDictBase, keys: Tensor, begin: float) -> Tensor:
        """One-step Q-factors ``[N, U]`` of states of a tree, which share what is left of the decision's time."""
        if self.policy.seconds is None:
            return self.policy.q_factors(y, keys)
        left = max(_LEAST_SECONDS, self.policy.seconds - (perf_counter() - begin))
        calls = 1 if self.margin is None else self.depth
        return self.policy.q_factors(y, keys, left / (calls * max(1, keys.numel())))

    def _worthwhile(self, y: TensorDictBase, keys: Tensor, begin: float) -> Tensor:
        """Controls that are expanded, bool ``[N, U]``: the legal ones that are not dominated."""
        if self.margin is None:
            mask = self.model.action_mask(y)
            if not bool(mask.any(-1).all()):
                raise ValueError("action_mask must allow at least one control in every state, got none")
            return mask
        q = self._rolled_out(y, keys, begin)
        best = q.amin(-1, keepdim=True)
        return torch.isfinite(q) & (q <= best + self.margin * best.abs())

    def _observations(self, probs: Tensor, keys: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Pairs, observations and weights of the branches of P pairs with distributions ``probs`` ``[P, Z]``."""
        many = (probs > 0).sum(-1) > self.branches
        pair, observation = ((probs > 0) & ~many.unsqueeze(-1)).nonzero(as_tuple=True)
        each = torch.arange(self.branches, device=probs.device)
        rows = many.nonzero().squeeze(-1)
        noise = (each + uniform(keys[rows].unsqueeze(-1), each)) / self.branches
        drawn = inverse_cdf(probs[rows].unsqueeze(1).expand(-1, self.branches, -1), noise.clamp_max(1.0 - 2.0**-24))
        pair = torch.cat([pair, rows.repeat_interleave(self.branches)])
        weight = torch.cat([probs[(probs > 0) & ~many.unsqueeze(-1)], probs.new_full((drawn.numel(),), 1.0 / self.branches)])
        order = pair.argsort(stable=True)
        return pair[order], torch.cat([observation, drawn.flatten()])[order], weight[order]

    def _values(self, y: TensorDictBase, keys: Tensor, depth: int, begin: float) -> Tensor:
        """Smallest Q-factors ``[N]``, zero at terminal states; equal states of a tree are expanded once."""
        value = torch.zeros(keys.shape, dtype=self.model.dtype, device=keys.device)
        live = (~self.model.is_terminal(y)).nonzero().squeeze(-1)
        if live.numel() == 0:
            return value
        same, inverse = fold(keys[live], self.model.fingerprint(y)[live]).unique(return_inverse=True)
        place = torch.empty_like(same).scatter_(0, inverse, torch.arange(live.numel(), device=same.device))
        chosen = live[place]
        value[live] = self._expand(take_rows(y, chosen), keys[chosen], depth, begin).amin(-1)[inverse]
        return value
