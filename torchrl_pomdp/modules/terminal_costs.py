r"""Terminal cost approximations :math:`\hat J` for truncated rollout (paper, Section III)."""

from __future__ import annotations

from abc import abstractmethod

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pomdp.checks import check_callable, check_instance, check_integer, shown
from torchrl_pomdp.envs.belief import BeliefModel, take_rows
from torchrl_pomdp.envs.partition import location_costs
from torchrl_pomdp.envs.repair import RepairModel
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.modules.rollout import CHUNK_ROWS, MAX_TRAJECTORIES, Policy, TerminalCost, TruncatedRollout, check_finite
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.modules.threads import blocks, map_threads
from torchrl_pomdp.modules.truncation import Truncation
from torchrl_pomdp.noise import fold

__all__ = ["ClosedFormCost", "NeverRepairCost", "PolicyCost", "SteadyStateCost", "ZeroCost"]


class ClosedFormCost(TensorDictModuleBase):
    """Base of the terminal costs that are computed from the belief alone; they write ``"state_value"`` ``[*B]``."""

    in_keys = ["belief"]
    out_keys = ["state_value"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"state_value"`` ``[*B]``."""
        check_instance("tensordict", tensordict, TensorDictBase)
        return tensordict.set("state_value", self.costs(tensordict))

    @abstractmethod
    def costs(self, y: TensorDictBase) -> Tensor:
        """Costs ``[*B]`` of feature states ``[*B]``."""


class ZeroCost(ClosedFormCost):
    r""":math:`\hat J=0`: what follows a cut is left out, on purpose.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> ZeroCost().costs(make_problem("line3").start(torch.arange(2))).tolist()
        [0.0, 0.0]
    """

    def costs(self, y: TensorDictBase) -> Tensor:
        """Zeros ``[*B]`` of the belief's type."""
        return _belief(y).new_zeros(y.batch_size)


class SteadyStateCost(ClosedFormCost):
    r""":math:`\hat J(y)=\hat g(y)/(1-\alpha)`: the present stage cost for ever, as if damage neither grew nor was repaired.

    Args:
        model: the repair model; its stage cost does not depend on the control.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> problem = make_problem("line3")
        >>> y = SteadyStateCost(problem.model)(problem.start(torch.arange(2)))
        >>> torch.allclose(y["state_value"] * 0.01, problem.model.expected_cost(y))
        True
    """

    def __init__(self, model: RepairModel) -> None:
        super().__init__()
        self.model = check_instance("model", model, RepairModel)

    def costs(self, y: TensorDictBase) -> Tensor:
        """Costs ``[*B]``."""
        _belief(y)
        return self.model.expected_cost(y) / (1.0 - self.model.discount)


class NeverRepairCost(ClosedFormCost):
    r"""Exact cost of never repairing, the sum over locations of :math:`b\,(I-\alpha P)^{-1}c`, with P the damage chain.

    Args:
        model: the repair model.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> problem = make_problem("line3")
        >>> y = problem.start(torch.arange(2))
        >>> bool((NeverRepairCost(problem.model).costs(y) >= SteadyStateCost(problem.model).costs(y)).all())
        True
    """

    def __init__(self, model: RepairModel) -> None:
        super().__init__()
        chain = check_instance("model", model, RepairModel).chain.double()
        system = torch.eye(model.num_levels, dtype=chain.dtype, device=chain.device) - model.discount * chain
        # Discounted cost of one location that starts at each level.
        level_costs = torch.linalg.solve(system, model.costs.double()).to(model.dtype)
        check_finite(f"costs of the model for ever must be finite in {model.dtype}", level_costs)
        self.level_costs = tuple(level_costs.tolist())

    def costs(self, y: TensorDictBase) -> Tensor:
        """Costs ``[*B]``."""
        # Planes [L, K, *B] are summed in the same order whatever the batch.
        belief = _belief(y)
        if belief.shape[y.ndim + 1 :] != (len(self.level_costs),):
            raise ValueError(f"entry 'belief' of y must end in {len(self.level_costs)} levels, got {tuple(belief.shape)}")
        return sum_first(location_costs(belief.movedim((-2, -1), (0, 1)), self.level_costs))


def _belief(y: TensorDictBase) -> Tensor:
    belief = check_instance("y", y, TensorDictBase).get("belief", None)
    if not isinstance(belief, Tensor) or not belief.is_floating_point():
        raise ValueError(f"y must hold the beliefs as entry 'belief', got {shown(belief)}")
    return belief


class PolicyCost(TensorDictModuleBase):
    r""":math:`J_\mu(y)`, the mean cost of simulated trajectories of a policy; cut ones end with :math:`\hat J`.

    It labels states with the policy's cost-to-go; its method :meth:`costs` is a terminal cost. The noise of a trajectory is
    a function of (seed, state, trajectory, step) alone, the state being identified by its content, so that an estimate
    depends neither on the batch nor on who computes it.

    Args:
        model: the belief model.
        policy: :math:`\mu`, writes ``"action"``.

    Keyword Args:
        trajectories: simulated trajectories from each state.
        truncation: see :class:`TruncatedRollout`.
        terminal_cost: :math:`\hat J`, see :class:`TruncatedRollout`.
        max_steps: largest m, see :class:`TruncatedRollout`.
        seed: seed of the simulations.
        chunk_rows: see :class:`TruncatedRollout`; on a CPU each of ``torch.get_num_threads()`` threads has such a chunk.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if a number is not positive, or by :class:`TruncatedRollout`; when called, if a state does not fit the
            model, or by :class:`TruncatedRollout`.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> from torchrl_pomdp.modules import GreedyRepair
        >>> problem = make_problem("line3")
        >>> cost = PolicyCost(problem.model, GreedyRepair(problem.model), trajectories=5)
        >>> y = cost(problem.start(torch.arange(400)))
        >>> bool((y["cost_to_go"].mean() - 195).abs() < 15)
        True
    """

    out_keys = ["cost_to_go"]

    def __init__(
        self,
        model: BeliefModel,
        policy: Policy,
        *,
        trajectories: int = 1,
        truncation: Truncation | None = None,
        terminal_cost: TerminalCost | None = None,
        max_steps: int = 400,
        seed: int = 0,
        chunk_rows: int = CHUNK_ROWS,
    ) -> None:
        super().__init__()
        self.model = check_instance("model", model, BeliefModel)
        self.in_keys = list(model.state_keys)
        self.trajectories = check_integer("trajectories", trajectories, 1, MAX_TRAJECTORIES)
        self.seed = check_integer("seed", seed)
        check_callable("policy", policy)
        self.rollout = TruncatedRollout(
            model, policy, max_steps=max_steps, truncation=truncation, terminal_cost=terminal_cost, chunk_rows=chunk_rows
        )

    @property
    def simulated_steps(self) -> int:
        """Belief steps simulated so far."""
        return self.rollout.simulated_steps

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"cost_to_go"`` ``[*B]``."""
        check_instance("tensordict", tensordict, TensorDictBase)
        return tensordict.set("cost_to_go", self.costs(tensordict))

    @torch.no_grad()
    def costs(self, y: TensorDictBase) -> Tensor:
        """Estimated costs ``[*B]`` of feature states ``[*B]``."""
        self.model.check_state(y)
        if y.batch_size.numel() == 0:
            return torch.zeros(y.batch_size, dtype=self.model.dtype, device=self.model.device)
        flat = self.model.derive(y, self.model.state_keys).reshape(-1)
        size, threads = blocks(flat.shape[0], self.trajectories, self.rollout.chunk_rows, self.model.device)
        return torch.cat(map_threads(self._costs, flat.split(size), threads)).view(y.batch_size)

    def _costs(self, y: TensorDictBase) -> Tensor:
        """Costs ``[N]`` of a flat batch."""
        count = self.trajectories
        groups = fold(self.model.fingerprint(y), self.seed).repeat(count)
        members = torch.arange(count, device=y.device).repeat_interleave(y.shape[0])
        scenarios = Scenarios(fold(groups, members), groups, members, torch.zeros_like(groups))
        rows = take_rows(y, torch.arange(y.shape[0], device=y.device).repeat(count))
        return sum_first(self.rollout(rows, scenarios, count).view(count, -1)) / count
