r"""Terminal cost approximations :math:`\hat J` for truncated rollout (paper, Section III)."""

from __future__ import annotations

from abc import abstractmethod

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pomdp.checks import check_callable, check_instance, check_integer, check_number
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.rows import flat_rows, take_rows
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.modules.policies import Policy, TerminalCost
from torchrl_pomdp.modules.rollout import MAX_TRAJECTORIES, TruncatedRollout
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.modules.threads import blocks, map_threads
from torchrl_pomdp.modules.truncation import Truncation
from torchrl_pomdp.noise import fold
from torchrl_pomdp.tensor_checks import check_representable, device_of

__all__ = ["ClosedFormCost", "ConstantCost", "PolicyCost", "ZeroCost"]


class ClosedFormCost(TensorDictModuleBase):
    """Base of the terminal costs that are computed from the feature state alone; they write ``"state_value"`` ``[*B]``.

    Subclasses set ``in_keys``, the entries that they read, and define :meth:`costs`.
    """

    out_keys = ["state_value"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"state_value"`` ``[*B]``."""
        check_instance("tensordict", tensordict, TensorDictBase)
        return tensordict.set("state_value", self.costs(tensordict))

    @abstractmethod
    def costs(self, y: TensorDictBase) -> Tensor:
        """Costs ``[*B]`` of feature states ``[*B]``."""


class ConstantCost(ClosedFormCost):
    r""":math:`\hat J` is one number for all states, such as a bound of all costs.

    Args:
        model: the belief model.
        cost: the number.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if the number is not finite.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("line3")
        >>> ConstantCost(problem.model, 7).costs(problem.start(torch.arange(2))).tolist()
        [7.0, 7.0]
    """

    def __init__(self, model: BeliefModel, cost: float) -> None:
        super().__init__()
        self.dtype = check_instance("model", model, BeliefModel).dtype
        self.in_keys = list(model.state_keys[:1])
        self._cost = check_representable("cost", check_number("cost", cost, "(-inf, inf)"), self.dtype)

    @property
    def cost(self) -> float:
        """The number; fixed, as compiled simulations have read it."""
        return self._cost

    def costs(self, y: TensorDictBase) -> Tensor:
        """The number, ``[*B]``."""
        check_instance("y", y, TensorDictBase)
        return torch.full(y.batch_size, self.cost, dtype=self.dtype, device=device_of(y))


class ZeroCost(ClosedFormCost):
    r""":math:`\hat J=0`: what follows a cut is left out, on purpose.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> ZeroCost().costs(make_problem("line3").start(torch.arange(2))).tolist()
        [0.0, 0.0]
    """

    in_keys: list[str] = []

    def costs(self, y: TensorDictBase) -> Tensor:
        """Zeros ``[*B]`` of the type of the state's floating entries."""
        kinds = [leaf.dtype for leaf in check_instance("y", y, TensorDictBase).values() if leaf.is_floating_point()]
        return torch.zeros(y.batch_size, dtype=kinds[0] if kinds else None, device=device_of(y))


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
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
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
        max_steps: int | None = None,
        seed: int = 0,
        chunk_rows: int | None = None,
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
        flat = flat_rows(self.model.derive(y, self.model.state_keys))
        size, threads = blocks(flat.shape[0], self.trajectories, self.rollout.chunk_rows, self.model.device)
        return torch.cat(map_threads(self._costs, flat.split(size), threads)).view(y.batch_size)

    def _costs(self, y: TensorDictBase) -> Tensor:
        """Costs ``[N]`` of a flat batch."""
        count = self.trajectories
        groups = fold(self.model.fingerprint(y), self.seed).repeat(count)
        members = torch.arange(count, device=device_of(y)).repeat_interleave(y.shape[0])
        scenarios = Scenarios(fold(groups, members), groups, members, torch.zeros_like(groups))
        rows = take_rows(y, torch.arange(y.shape[0], device=device_of(y)).repeat(count))
        return sum_first(self.rollout(rows, scenarios, count).view(count, -1)) / count
