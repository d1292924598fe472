r"""Q-factors of given controls by simulation (paper, Section III): what one-step lookahead with rollout compares."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pomdp.checks import check_choice, check_instance, check_integer, check_number
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.rows import flat_rows, take_rows
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.modules.policies import Policy, TerminalCost
from torchrl_pomdp.modules.rollout import MAX_TRAJECTORIES, TruncatedRollout
from torchrl_pomdp.modules.scalar import Allocation, ScalarEngine
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.modules.threads import blocks, map_threads
from torchrl_pomdp.modules.truncation import Truncation
from torchrl_pomdp.noise import fold
from torchrl_pomdp.tensor_checks import check_distributions

__all__ = ["SimulatedQFactors", "cheapest", "check_q_factors", "spread"]

_LEAVES, _ALLOCATIONS = ("control", "observation"), ("uniform", "adaptive")
# Rounds: trajectories of the first one; of further ones, a fraction of those so far. Standard errors by which one is beaten.
_FIRST_ROUND, _SLOWLY, _CLEARLY = 3, 8, 1.3


# For every leaf its pair, the place of its trajectory, its state, scenario and weight.
_Leaves = tuple[Tensor, Tensor, TensorDictBase, Scenarios, Tensor]


class SimulatedQFactors(TensorDictModuleBase):
    r"""Base of the rollout policies: Q-factors of controls, estimated by simulating a base policy after them.

    .. math:: \tilde Q(y,u)=\hat g(y,u)+\alpha\sum_z\hat p(z\mid b_y,u)\,\tilde J\bigl(F(y,u,z)\bigr)

    with :math:`\tilde J` the mean cost of simulated trajectories of the base policy. All controls of a state are compared
    in the same scenarios (see :mod:`~torchrl_pomdp.modules.scenarios`), whose noise is a function of seed, state, trajectory,
    and what is observed when, the state being identified by its content. Labels therefore do not depend on the batch, its
    order, or who computes them.

    Args:
        model: the belief model.
        base_policy: :math:`\mu`, writes ``"action"``.

    Keyword Args:
        trajectories: simulated trajectories from each leaf.
        leaves: what a leaf is. ``"control"``: every control gets ``trajectories`` trajectories, their first observations
            stratified over :math:`\hat p`. ``"observation"``: every (control, observation) of positive probability gets
            them, and the expectation over the first observation is exact.
        allocation: ``"uniform"``: every control gets all trajectories. ``"adaptive"``: they are spent in rounds, and a control
            that the best one clearly beats, by the differences of their paired trajectories, gets no more; a state whose
            decision is settled costs nothing further.
        seconds: time for the decision of a state. Trajectories are then made as long as it lasts, ``trajectories`` at most and
            the first three always, and the decision depends on the machine. None: as long as it takes.
        max_steps: largest m, see :class:`TruncatedRollout`.
        truncation: state-dependent m, see :class:`TruncatedRollout`.
        terminal_cost: :math:`\hat J`, see :class:`TruncatedRollout`.
        seed: seed of the simulations.
        chunk_rows: see :class:`TruncatedRollout`; on a CPU each of ``torch.get_num_threads()`` threads has such a chunk.
        compile: see :class:`TruncatedRollout`.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if a number is not positive, or ``leaves`` or ``allocation`` is unknown; when called, if a state does
            not fit the model, if the base policy's first controls are illegal, or if a cost is not finite.

    """

    out_keys = ["action", "q_factors"]

    def __init__(
        self,
        model: BeliefModel,
        base_policy: Policy,
        *,
        trajectories: int = 10,
        leaves: Literal["control", "observation"] = "control",
        allocation: Literal["uniform", "adaptive"] = "uniform",
        seconds: float | None = None,
        max_steps: int | None = None,
        truncation: Truncation | None = None,
        terminal_cost: TerminalCost | None = None,
        seed: int = 0,
        chunk_rows: int | None = None,
        compile: bool = False,
    ) -> None:
        super().__init__()
        self.model = check_instance("model", model, BeliefModel)
        self._check_model()
        self.in_keys = list(model.state_keys)
        self.trajectories = check_integer("trajectories", trajectories, 1, MAX_TRAJECTORIES)
        self.leaves = check_choice("leaves", leaves, _LEAVES)
        self.allocation = check_choice("allocation", allocation, _ALLOCATIONS)
        self.seconds = None if seconds is None else check_number("seconds", seconds, "(0, inf)")
        self.seed = check_integer("seed", seed)
        self.cost_to_go = TruncatedRollout(
            model,
            base_policy,
            max_steps=max_steps,
            truncation=truncation,
            terminal_cost=terminal_cost,
            chunk_rows=chunk_rows,
            compile=compile,
        )

    def _check_model(self) -> None:
        """Raise where the model is none for this policy."""

    @property
    def simulated_steps(self) -> int:
        """Belief steps simulated so far."""
        return self.cost_to_go.simulated_steps

    def keys(self, y: TensorDictBase) -> Tensor:
        """Keys of the scenarios of feature states, int64 ``[*B]``: functions of seed and content."""
        return fold(self.model.fingerprint(y), self.seed)

    def _factors(
        self, y: TensorDictBase, controls: Tensor | None, mask: Tensor | None, keys: Tensor | None, seconds: float | None
    ) -> Tensor:
        r""":math:`\tilde Q(y,u)` ``[N, C]`` of candidates, ``+inf`` where they are illegal.

        Args:
            y: feature states, N of them in any batch.
            controls: agents' controls of the candidates, ``[N, C, R]``; None: all joint controls, C = U.
            mask: which candidates are legal, bool ``[N, C]``; None: by the model, for all joint controls.
            keys: keys of the states' scenarios ``[N]``; None: those of :meth:`keys`.
            seconds: time for each state.
        """
        engine = self.cost_to_go.engine()
        if engine is not None and engine.closed:
            return self._compiled(engine, y, controls, keys, seconds)
        self.model.check_state(y)
        flat = flat_rows(self.model.derive(y, ("action_mask",) if mask is None else ()))
        mask = flat.get("action_mask") if mask is None else mask
        if mask.numel() == 0:
            return torch.zeros(mask.shape, dtype=self.model.dtype, device=self.model.device)
        leaves = mask.shape[1] * (self.model.num_observations if self.leaves == "observation" else 1)
        trajectories = leaves * int(self._allocation(seconds).rounds.max())
        size, threads = blocks(flat.shape[0], trajectories, self.cost_to_go.chunk_rows, self.model.device)
        keys = self.keys(flat) if keys is None else keys
        joint = None if controls is None else self.model.join_controls(controls)
        each = [None] * len(keys.split(size)) if joint is None else joint.split(size)
        parts = list(zip(flat.split(size), each, mask.split(size), keys.split(size), strict=True))
        return torch.cat(map_threads(lambda part: self._q_factors(*part, seconds), parts, threads))

    def _compiled(
        self, engine: ScalarEngine, y: TensorDictBase, controls: Tensor | None, keys: Tensor | None, seconds: float | None
    ) -> Tensor:
        """:meth:`_factors` by the compiled loop."""
        candidates = None if controls is None else np.ascontiguousarray(controls.numpy())
        q, steps = engine.q_factors(y, keys, self.seed, self._allocation(seconds), candidates)
        self.cost_to_go.count(steps)
        return torch.from_numpy(q.astype(np.float32) if self.model.dtype == torch.float32 else q)

    def _allocation(self, seconds: float | None) -> Allocation:
        return Allocation(
            *_plan(self.trajectories, self.allocation == "adaptive" or seconds is not None),
            observations=self.leaves == "observation",
            clearly=_CLEARLY if self.allocation == "adaptive" else np.inf,
            seconds=seconds,
        )

    def _q_factors(
        self, y: TensorDictBase, controls: Tensor | None, mask: Tensor, keys: Tensor, seconds: float | None
    ) -> Tensor:
        """:meth:`_factors` of candidates ``[N, C, *S]``, by tensors."""
        core = y.select(*self.model.state_keys)
        costs = torch.zeros((self.trajectories, *mask.shape), dtype=self.model.dtype, device=mask.device)
        made = torch.zeros_like(costs, dtype=torch.bool)
        rivals, spent = mask, 0
        allocation = self._allocation(None if seconds is None else seconds * keys.numel())
        for count in (int(count) for stretch in allocation.stretches() for count in stretch):
            state, u = rivals.nonzero(as_tuple=True)
            if state.numel() == 0:
                break
            joint = u if controls is None else controls[state, u]
            members = torch.from_numpy(allocation.order[spent : spent + count]).to(mask.device)
            spent += count
            costs[spent - count : spent, state, u] = self._trajectory_costs(core, state, joint, members, keys)
            made[spent - count : spent] = rivals
            if self.allocation == "adaptive":
                rivals = _rivals(costs[:spent], rivals)
        q = _combine(costs, made, mask)
        check_q_factors(q, mask)
        return q

    def _trajectory_costs(self, core: TensorDictBase, state: Tensor, u: Tensor, members: Tensor, keys: Tensor) -> Tensor:
        r""":math:`\hat g(y,u)+\alpha\tilde J` of P state-control pairs for the trajectories ``members`` ``[n]``: ``[n, P]``."""
        model, pairs = self.model, take_rows(core, state)
        leaves = self._enumerated if self.leaves == "observation" else self._stratified
        pair, each, successors, scenarios, weight = leaves(pairs, u, members, keys[state])
        cost = self.cost_to_go(successors, scenarios, self.trajectories) * weight
        total = torch.zeros(members.numel() * len(u), dtype=cost.dtype, device=cost.device)
        total.index_add_(0, each * len(u) + pair, cost)
        return (model.expected_cost(pairs, u) + model.discount * total.view(members.numel(), -1)).to(model.dtype)

    def _scenarios(self, pair: Tensor, each: Tensor, members: Tensor, keys: Tensor) -> Scenarios:
        """Scenarios of trajectory ``members[each]`` of the pairs ``pair``, whose states have the keys ``keys`` ``[P]``."""
        member = members[each]
        return Scenarios(fold(keys[pair], member), keys[pair], member, torch.zeros_like(pair))

    def _stratified(self, pairs: TensorDictBase, u: Tensor, members: Tensor, keys: Tensor) -> _Leaves:
        """One leaf for every pair and trajectory: the first observation is the scenario's."""
        model, device = self.model, u.device
        pair = torch.arange(len(u), device=device).repeat_interleave(members.numel())
        each = torch.arange(members.numel(), device=device).repeat(len(u))
        y, control = take_rows(pairs, pair), u[pair]
        scenarios = self._scenarios(pair, each, members, keys)
        # Ages count from the leaf; the step to it is the one before.
        noise, scenarios = scenarios.draw(torch.full_like(pair, -1), model.observed(y, control), self.trajectories)
        _, successors = model.advance(y, control, noise)
        return pair, each, successors, scenarios, torch.ones((), dtype=model.dtype, device=device)

    def _enumerated(self, pairs: TensorDictBase, u: Tensor, members: Tensor, keys: Tensor) -> _Leaves:
        """A leaf for every pair, observation of positive probability and trajectory, weighted by the probability."""
        model, device = self.model, u.device
        probs = check_distributions("observation_probs", model.observation_probs(pairs, u))
        pair, observation = (probs > 0).nonzero(as_tuple=True)
        weight = probs[pair, observation].repeat_interleave(members.numel())
        each = torch.arange(members.numel(), device=device).repeat(pair.numel())
        pair, observation = pair.repeat_interleave(members.numel()), observation.repeat_interleave(members.numel())
        y, control = take_rows(pairs, pair), u[pair]
        scenarios = self._scenarios(pair, each, members, keys).observe(model.observed(y, control))
        return pair, each, model.estimator(y, control, observation), scenarios, weight


@lru_cache(maxsize=64)
def _plan(trajectories: int, stepwise: bool) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The order of the trajectories, and the numbers that are made in every round."""
    rounds, left = [], trajectories
    while left:
        spent = trajectories - left
        rounds.append(min(left, max(1, spent // _SLOWLY) if spent else _FIRST_ROUND) if stepwise else left)
        left -= rounds[-1]
    return spread(trajectories).numpy(), np.array(rounds)


def _rivals(costs: Tensor, rivals: Tensor) -> Tensor:
    """Which controls ``[N, U]`` may still be best, given their paired costs ``[k, N, U]``; none where only one may.

    A control is beaten when the mean of its paired differences to the best one exceeds its standard error enough. One
    trajectory that says the contrary is added to them: where there is little to observe, a few trajectories agree, even
    to the last bit, and others do not.
    """
    count = costs.shape[0]
    if count < 2:
        return rivals
    mean = (sum_first(costs.clone()) / count).masked_fill(~rivals, torch.inf)
    difference = costs - costs.gather(-1, mean.argmin(-1, keepdim=True).expand(count, -1, 1))
    gap = sum_first(difference.clone()) / count
    difference = torch.cat([difference, -gap.unsqueeze(0)])
    mean = gap * ((count - 1) / (count + 1))
    variance = sum_first((difference - mean).square()) / count
    left = rivals & ~(mean > _CLEARLY * (variance / (count + 1)).sqrt())
    return left & (left.sum(-1, keepdim=True) > 1)


def _combine(costs: Tensor, made: Tensor, mask: Tensor) -> Tensor:
    """Q-factors ``[N, U]`` from the costs ``[n, N, U]`` of the trajectories that were ``made``; the others' are 0.

    A control that got fewer trajectories than the best one has the best one's Q-factor plus the mean difference of the
    trajectories that both have: the noise that they share cancels.
    """
    count = made.sum(0)
    mean = (sum_first(costs.clone()) / count).masked_fill(~mask, torch.inf)
    most = count.amax(-1, keepdim=True)
    best = mean.masked_fill(count < most, torch.inf).argmin(-1, keepdim=True)
    reference = costs.gather(-1, best.expand(costs.shape[0], -1, 1))
    gap = sum_first((costs - reference).masked_fill(~made, 0.0)) / count
    return torch.where((count < most) & mask, mean.gather(-1, best) + gap, mean)


def check_q_factors(q: Tensor, mask: Tensor) -> None:
    """Raise unless the Q-factors ``[N, U]`` of all controls of ``mask`` are finite."""
    wrong = mask & ~torch.isfinite(q)
    if bool(wrong.any()):
        state, u = wrong.nonzero()[0].tolist()
        raise ValueError(
            f"q_factors of legal controls must be finite, got {q[state, u].item()} for control {u} in state {state} of a "
            f"batch: the model's costs overflow {q.dtype} or are no numbers"
        )


def cheapest(q: Tensor) -> Tensor:
    """The control of the smallest Q-factor ``[*B]`` (ties to the lower) of Q-factors ``[*B, U]``.

    Raises:
        ValueError: if a state has no finite one, so that no legal control could be chosen.

    Examples:
        >>> cheapest(torch.tensor([[2.0, 1.0, 1.0]])).tolist()
        [1]
    """
    if q.numel() == 0:
        return torch.zeros(q.shape[:-1], dtype=torch.int64, device=q.device)
    # For a single state the time of every operation counts.
    values = q.detach().cpu().numpy()
    if not np.isfinite(np.minimum.reduce(values, -1)).all():
        raise ValueError("action_mask must allow at least one control in every state, got none")
    return torch.from_numpy(np.asarray(values.argmin(-1))).to(q.device)


def spread(count: int) -> Tensor:
    """The numbers 0..count-1 in an order of which every beginning is spread evenly (by the golden ratio).

    Examples:
        >>> spread(10).tolist()
        [0, 6, 2, 8, 4, 1, 7, 3, 9, 5]
    """
    return (torch.arange(count, dtype=torch.float64) * 0.6180339887498949 % 1.0).argsort().argsort()
