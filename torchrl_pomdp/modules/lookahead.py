r"""One-step lookahead with rollout at its leaves: the policy :math:`\tilde\mu` (paper, Section III and equation (1))."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pomdp.envs.belief import BeliefModel, inverse_cdf, take_rows
from torchrl_pomdp.modules.rollout import Policy, TerminalCost, TruncatedRollout
from torchrl_pomdp.noise import fold, uniform

__all__ = ["RolloutPolicy"]


class _Leaves(NamedTuple):
    """Sampled first observations: ``pair[i]`` is the state-control pair of leaf i, which counts with ``weight[i]``."""

    pair: Tensor
    trajectory: Tensor
    observation: Tensor
    weight: Tensor


class RolloutPolicy(TensorDictModuleBase):
    r"""The rollout policy: minimise the Q-factors of a base policy over the legal controls.

    .. math:: \tilde Q(y,u)=\hat g(y,u)+\alpha\sum_z\hat p(z\mid b_y,u)\,\tilde J\bigl(F(y,u,z)\bigr)

    with :math:`\tilde J` the mean cost of simulated trajectories of the base policy. All controls of a state are compared
    under common random numbers: the noise of a trajectory is a function of (seed, state, trajectory, step) alone, the
    state being identified by its content. Labels therefore do not depend on the batch, its order, or who computes them.

    Args:
        model: the belief model.
        base_policy: :math:`\mu`, writes ``"action"``.

    Keyword Args:
        trajectories: simulated trajectories from each leaf.
        leaves: what a leaf is. ``"control"``: every control gets ``trajectories`` trajectories, their first observations
            stratified over :math:`\hat p`. ``"observation"``: every (control, observation) of positive probability gets
            them, and the expectation over the first observation is exact.
        max_steps: m, see :class:`TruncatedRollout`.
        terminal_cost: :math:`\hat J`, see :class:`TruncatedRollout`.
        seed: seed of the simulations.
        chunk_rows: largest number of trajectories simulated at once; bounds the memory, never changes the result.

    Raises:
        ValueError: if a number is not positive or ``leaves`` is unknown; when called, if a state does not fit the model.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> from torchrl_pomdp.modules import GreedyRepair
        >>> problem = make_problem("linear20")
        >>> policy = RolloutPolicy(problem.model, GreedyRepair(problem.model), trajectories=10)
        >>> y = policy(problem.start(torch.arange(4)))
        >>> y["q_factors"].shape, bool((y["q_factors"].argmin(-1) == y["action"]).all())
        (torch.Size([4, 3]), True)
    """

    out_keys = ["action", "q_factors"]

    def __init__(
        self,
        model: BeliefModel,
        base_policy: Policy,
        *,
        trajectories: int = 10,
        leaves: Literal["control", "observation"] = "control",
        max_steps: int = 400,
        terminal_cost: TerminalCost | None = None,
        seed: int = 0,
        chunk_rows: int = 8192,
    ) -> None:
        super().__init__()
        for name, value in (("trajectories", trajectories), ("chunk_rows", chunk_rows)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        if leaves not in ("control", "observation"):
            raise ValueError(f"leaves must be 'control' or 'observation', got {leaves!r}")
        self.in_keys = list(model.state_keys)
        self.model = model
        self.cost_to_go = TruncatedRollout(model, base_policy, max_steps=max_steps, terminal_cost=terminal_cost)
        self.trajectories, self.leaves, self.seed, self.chunk_rows = trajectories, leaves, seed, chunk_rows

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"q_factors"`` ``[*B, U]`` (costs, ``+inf`` where illegal) and ``"action"`` ``[*B]`` (ties to the lower)."""
        q = self.q_factors(tensordict)
        return tensordict.update({"action": q.argmin(-1), "q_factors": q})

    @torch.no_grad()
    def q_factors(self, y: TensorDictBase) -> Tensor:
        r""":math:`\tilde Q(y,u)` ``[*B, U]``, ``+inf`` where the control is illegal."""
        self.model.check_state(y)
        shape = (*y.batch_size, self.model.num_controls)
        if y.batch_size.numel() == 0:
            return torch.zeros(shape, dtype=self.model.dtype, device=self.model.device)
        flat = self.model.with_features(y, ("action_mask",)).reshape(-1)
        branches = self.model.num_controls * (self.model.num_observations if self.leaves == "observation" else 1)
        size = max(1, self.chunk_rows // (self.trajectories * branches))
        parts = [self._q_factors(flat[start : start + size]) for start in range(0, flat.shape[0], size)]
        q = (
            torch.cat(parts)
            if parts
            else torch.zeros(0, self.model.num_controls, dtype=self.model.dtype, device=self.model.device)
        )
        return q.view(*y.batch_size, self.model.num_controls)

    def _q_factors(self, y: TensorDictBase) -> Tensor:
        """Q-factors ``[N, U]`` of a flat batch that is simulated at once."""
        model = self.model
        state, u = y.get("action_mask").nonzero(as_tuple=True)
        core = y.select(*model.state_keys)
        # [N, n]: one key for each state and trajectory, shared by the state's controls.
        keys = fold(fold(model.fingerprint(core), self.seed).unsqueeze(-1), self._trajectory_index)
        pairs = take_rows(core, state)
        leaves = self._sample_leaves(model.observation_probs(pairs, u), keys[state])
        successors = model.estimator(take_rows(pairs, leaves.pair), u[leaves.pair], leaves.observation)
        cost = self.cost_to_go(successors, fold(keys[state[leaves.pair], leaves.trajectory], 1)) * leaves.weight
        expected = torch.zeros(u.shape, dtype=cost.dtype, device=cost.device).index_add_(0, leaves.pair, cost)
        q = torch.full(y.get("action_mask").shape, torch.inf, dtype=cost.dtype, device=cost.device)
        q[state, u] = model.expected_cost(pairs, u) + model.discount * expected
        return q

    @property
    def _trajectory_index(self) -> Tensor:
        return torch.arange(self.trajectories, device=self.model.device)

    def _sample_leaves(self, probs: Tensor, keys: Tensor) -> _Leaves:
        """First observations of P pairs from their probabilities ``[P, Z]`` and keys ``[P, n]``."""
        count = self.trajectories
        if self.leaves == "observation":
            pair, observation = (probs > 0).nonzero(as_tuple=True)
            weight = probs[pair, observation] / count
            each = self._trajectory_index.repeat(pair.numel())
            return _Leaves(
                pair.repeat_interleave(count),
                each,
                observation.repeat_interleave(count),
                weight.repeat_interleave(count),
            )
        # Trajectory j draws from the j-th of n equal slices of the distribution function.
        noise = (self._trajectory_index + uniform(keys, 0)) / count
        observation = inverse_cdf(probs.unsqueeze(1).expand(-1, count, -1), noise)
        pair = torch.arange(probs.shape[0], device=probs.device).repeat_interleave(count)
        each = self._trajectory_index.repeat(probs.shape[0])
        weight = torch.full(pair.shape, 1.0 / count, dtype=probs.dtype, device=probs.device)
        return _Leaves(pair, each, observation.flatten(), weight)
