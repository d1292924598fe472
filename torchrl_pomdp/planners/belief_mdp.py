r"""The beliefs that can be reached, where they are few, as a finite Markov decision problem (paper, Section II)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance, check_integer
from torchrl_pomdp.envs.tabular import TabularModel
from torchrl_pomdp.planners.joint_table import Floats, Integers, JointTable
from torchrl_pomdp.tensor_checks import check_distributions, check_tensor

__all__ = ["BeliefMDP", "belief_mdp"]

# Beliefs of the same states that agree to so many digits are one.
_DIGITS = 12
# Costs that differ by this share of what costs can add up to are equal: policy iteration then keeps its control.
_EQUAL = 1e-12


@dataclass(frozen=True, eq=False)
class BeliefMDP:
    r"""A finite set of beliefs that is closed under all legal controls, and the paper's operators on it.

    Functions of the belief are tensors ``[M]`` in float64; controls of a policy are int64 ``[M]``. The start is belief 0.

    Attributes:
        belief: the beliefs ``[M, n]``.
        cost: stage costs :math:`\hat g(b,u)` ``[M, U]``, ``+inf`` where the control is illegal.
        probs: :math:`\hat p(z\mid b,u)` ``[M, U, Z]``, zero where the control is illegal.
        after: number of the belief F(b, u, z) ``[M, U, Z]``, any where it is impossible.
        discount: :math:`\alpha`.
    """

    belief: Tensor
    cost: Tensor
    probs: Tensor
    after: Tensor
    discount: float

    def __len__(self) -> int:
        """M, the number of beliefs."""
        return len(self.belief)

    def states(self, dtype: torch.dtype = torch.float64) -> TensorDictBase:
        """The beliefs as feature states ``[M]`` of the tabular model, for policies and terminal costs.

        Args:
            dtype: the model's type.
        """
        return TensorDict({"belief": self.belief.to(dtype)}, [len(self)])

    def q_factors(self, values: Tensor) -> Tensor:
        r""":math:`\hat g(b,u)+\alpha\sum_z\hat p(z\mid b,u)\,J(F(b,u,z))` ``[M, U]`` for a function J ``[M]``.

        Raises:
            TypeError: if ``values`` is no tensor of numbers.
            ValueError: if its shape is another or a number is not finite.
        """
        values = check_tensor("values", values, (len(self),)).double()
        return self.cost + self.discount * (self.probs * values[self.after]).sum(-1)

    def policy_cost(self, controls: Tensor) -> Tensor:
        r""":math:`J_\mu` ``[M]`` of the policy with these controls ``[M]``, the solution of :math:`J=T_\mu J`.

        Raises:
            TypeError: if ``controls`` is no int64 tensor.
            ValueError: if there is not one for each belief, or one is illegal.
        """
        u = self.check_controls("controls", controls).unsqueeze(-1)
        probs, after = (
            table.gather(1, u.unsqueeze(-1).expand(-1, 1, table.shape[-1])).squeeze(1) for table in (self.probs, self.after)
        )
        system = torch.eye(len(self), dtype=torch.float64)
        system.scatter_add_(1, after, -self.discount * probs)
        return torch.linalg.solve(system, self.cost.gather(1, u).squeeze(1))

    def optimal_cost(self) -> Tensor:
        r""":math:`J^*` ``[M]``, by policy iteration; up to :math:`10^{-12}/(1-\alpha)^2` of the largest stage cost."""
        controls = self.cost.argmin(-1)
        equal = _EQUAL * self.cost[self.cost.isfinite()].abs().max() / (1.0 - self.discount)
        while True:
            values = self.policy_cost(controls)
            q = self.q_factors(values)
            better = q.amin(-1) < values - equal
            if not bool(better.any()):
                return values
            controls = torch.where(better, q.argmin(-1), controls)

    def check_controls(self, name: str, controls: Tensor) -> Tensor:
        """Controls ``[M]`` of a policy; raises unless there is a legal one for each belief."""
        u = check_tensor(name, controls, (len(self),), torch.int64)
        known = (u >= 0) & (u < self.cost.shape[1])
        legal = known & self.cost.gather(1, u.clamp(0, self.cost.shape[1] - 1).unsqueeze(-1)).squeeze(-1).isfinite()
        if not bool(legal.all()):
            where = int((~legal).nonzero()[0])
            allowed = self.cost[where].isfinite().nonzero().flatten().tolist()
            raise ValueError(f"{name} must be legal controls, got {int(u[where])} at belief {where}; legal there: {allowed}")
        return u


def belief_mdp(model: TabularModel, belief: Tensor, *, most: int = 2048) -> BeliefMDP:
    """All beliefs that legal controls can lead to from a start belief, where they are finitely many.

    They are computed in double precision; beliefs of the same states that agree to 12 digits are one.

    Args:
        model: the model.
        belief: the start belief ``[n]``.

    Keyword Args:
        most: the most beliefs there may be, 1 to 4096.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``belief`` is no distribution over the states, if it leads to one without a legal control, or to
            more than ``most``.

    Examples:
        >>> from torchrl_pomdp.problems import tiger
        >>> mdp = belief_mdp(tiger(0.75).model, torch.tensor([0.5, 0.5]))
        >>> round(float(mdp.optimal_cost()[0]), 6)
        -1.933439
    """
    check_instance("model", model, TabularModel)
    start = check_distributions("belief", check_tensor("belief", belief, (model.num_states,)).detach().cpu().double())
    check_integer("most", most, 1, 4096)
    table = JointTable(model)
    known: dict[bytes, int] = {}
    beliefs: list[Floats] = []

    def number(row: Floats) -> int:
        # Which states are possible decides which controls are legal.
        key = np.flatnonzero(row).tobytes() + np.round(row, _DIGITS).tobytes()
        if key not in known:
            known[key] = len(beliefs)
            beliefs.append(row)
        if len(beliefs) > most:
            raise ValueError(f"belief must lead to at most {most} beliefs (most), got more")
        return known[key]

    number((start / start.sum()).numpy())
    edges = [_edges(table, row, number) for row in beliefs]  # which grow while they are walked through
    cost, probs, after = (torch.from_numpy(np.stack(part)) for part in zip(*edges, strict=True))
    return BeliefMDP(torch.from_numpy(np.stack(beliefs)), cost, probs, after, model.discount)


def _edges(table: JointTable, belief: Floats, number: Callable[[Floats], int]) -> tuple[Floats, Floats, Integers]:
    """Stage costs ``[U]``, probabilities of observations and numbers of next beliefs ``[U, Z]``."""
    states = np.flatnonzero(belief)
    cost = table.cost[:, states] @ belief[states]
    if not np.isfinite(cost).any():
        raise ValueError(f"belief must not lead to one whose states share no legal control, such as {states.tolist()}")
    probs = np.zeros((table.num_controls, table.num_observations))
    after = np.zeros(probs.shape, np.int64)
    for u in np.flatnonzero(np.isfinite(cost)):
        spread = table.spread(int(u), states, belief[states])
        probs[u] = spread.sum(1)
        for z in np.flatnonzero(probs[u]):
            after[u, z] = number(spread[z] / probs[u, z])
    return cost, probs, after
