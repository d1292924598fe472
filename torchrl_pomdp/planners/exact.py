r"""Certified bounds of the optimal cost of small problems, by point-based value iteration (paper, Sections I and II)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from time import monotonic
from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pomdp.checks import check_flag, check_instance, check_number
from torchrl_pomdp.envs.tabular import TabularModel
from torchrl_pomdp.planners.joint_table import JointTable
from torchrl_pomdp.planners.point_based import ANY, DIGITS, Node, Search
from torchrl_pomdp.progress import progress_bar
from torchrl_pomdp.tensor_checks import check_distributions, check_entries, check_tensor

__all__ = ["AlphaVectorPolicy", "Interval", "Solution", "solve"]

# Vectors whose costs agree up to this share, times 1 - discount, are equal: the first of them is taken.
_EQUAL = 1e-10
_NO_PLAN = "y has a belief at which no plan is legal"
# A trial halves the gap where it starts.
_TRIAL = 0.5


class Interval(NamedTuple):
    """A number that is known to lie between two.

    Attributes:
        lower: the lower bound.
        upper: the upper bound.
    """

    lower: float
    upper: float

    @property
    def relative_gap(self) -> float:
        """Width, as a share of the larger absolute value of the two; zero for an interval that is zero.

        Examples:
            >>> Interval(199.0, 200.0).relative_gap
            0.005
        """
        return (self.upper - self.lower) / (max(abs(self.lower), abs(self.upper)) or 1.0)


class AlphaVectorPolicy(TensorDictModuleBase):
    r"""The policy of a set of alpha vectors, each the cost of a plan by state; a base policy for tabular models.

    The plan of a belief b is that of the least :math:`\sum_i b(i)\,\alpha(i)`; its first control is taken. Plans that may
    meet an illegal control cost ``+inf`` in the states where they do, and are not taken where such a state is possible.

    Args:
        model: the tabular model.
        vectors: costs ``[N, n]`` by plan and state, ``+inf`` where the plan is illegal.
        controls: first control of each plan, int64 ``[N]``; -1: the first legal one.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if shapes do not fit, a cost is NaN or ``-inf``, or there is no such control; when called, if no plan is
            legal at a belief.

    Examples:
        >>> from torchrl_pomdp.problems import tiger
        >>> problem = tiger()
        >>> policy = AlphaVectorPolicy(problem.model, torch.tensor([[20.0, 20.0], [100.0, -10.0]]), torch.tensor([0, 1]))
        >>> policy(problem.start(torch.arange(2)))["action"].tolist()
        [0, 0]
    """

    out_keys = ["action"]
    _costs: Tensor
    _illegal: Tensor
    controls: Tensor

    def __init__(self, model: TabularModel, vectors: Tensor, controls: Tensor) -> None:
        super().__init__()
        self.model = check_instance("model", model, TabularModel)
        self.in_keys = list(model.state_keys)
        vectors = check_tensor("vectors", vectors, (None, model.num_states), finite=False).detach().double()
        if not len(vectors) or bool((vectors.isnan() | (vectors == -torch.inf)).any()):
            raise ValueError("vectors must hold at least one vector of numbers and +inf, no NaN and no -inf")
        controls = check_tensor("controls", controls, (len(vectors),), torch.int64)
        if int(controls.min()) < ANY or int(controls.max()) >= model.num_controls:
            raise ValueError(f"controls must be in -1..{model.num_controls - 1}, got {controls.tolist()}")
        self.register_buffer("_costs", vectors.nan_to_num(posinf=0.0).T.to(model.device), persistent=False)
        self.register_buffer("_illegal", vectors.isinf().T.float().to(model.device), persistent=False)
        self.register_buffer("controls", controls.to(model.device, copy=True), persistent=False)
        self._equal = _tolerance(model.discount, model.num_states)

    def __len__(self) -> int:
        """The number of vectors."""
        return len(self.controls)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"``, int64 ``[*B]``."""
        cost = self._plan_costs(tensordict)
        least = cost.amin(-1, keepdim=True)
        # Rounding depends on the batch: of nearly equal ones the first.
        u = self.controls[(cost <= least + self._equal * least.abs()).to(torch.int8).argmax(-1)]
        mask = self.model.action_mask(tensordict)
        if bool(((u == ANY) & ~mask.any(-1)).any()):
            raise ValueError(_NO_PLAN)
        return tensordict.set("action", torch.where(u == ANY, mask.to(torch.int8).argmax(-1), u))

    def cost(self, y: TensorDictBase) -> Tensor:
        """Cost of the best plan, float64 ``[*B]``.

        The policy costs no more if each plan goes on, after every observation, with one of these vectors, as those of
        :func:`solve` do.

        Args:
            y: feature states ``[*B]``.

        Raises:
            ValueError: if no plan is legal at a belief.

        Examples:
            >>> from torchrl_pomdp.problems import tiger
            >>> problem = tiger()
            >>> policy = AlphaVectorPolicy(problem.model, torch.tensor([[20.0, 20.0], [100.0, -10.0]]), torch.tensor([0, 1]))
            >>> policy.cost(problem.start(torch.arange(2))).tolist()
            [20.0, 20.0]
        """
        return self._plan_costs(y).amin(-1)

    def _plan_costs(self, y: TensorDictBase) -> Tensor:
        """Costs ``[*B, N]`` of all plans, at least one of them finite."""
        belief = check_entries("y", y, self.in_keys).get("belief")
        if belief.shape != (*y.batch_size, self.model.num_states):
            raise ValueError(
                f"entry 'belief' of y must have shape {(*y.batch_size, self.model.num_states)}, got {tuple(belief.shape)}; "
                "for a repair model see joint_belief"
            )
        check_tensor("entry 'belief' of y", belief)
        # The marks of illegal plans are small whole numbers, which a product of matrices adds without rounding.
        cost = (belief.double() @ self._costs).masked_fill((belief > 0).float() @ self._illegal > 0, torch.inf)
        if bool(cost.isinf().all(-1).any()):
            raise ValueError(_NO_PLAN)
        return cost


@dataclass(frozen=True, eq=False)
class Solution:
    r"""What is known of the optimum :math:`J^*`.

    Attributes:
        interval: bounds of the optimal cost, the mean over the start beliefs.
        by_start: bounds for each start belief.
        policy: a policy that costs no more than the upper bounds.
        seconds: time that the search took.
    """

    interval: Interval
    by_start: tuple[Interval, ...]
    policy: AlphaVectorPolicy
    seconds: float

    @property
    def lower(self) -> float:
        """Lower bound of the optimal cost."""
        return self.interval.lower

    @property
    def upper(self) -> float:
        """Upper bound of the optimal cost, and of that of the policy."""
        return self.interval.upper


def solve(
    model: TabularModel, belief: Tensor, *, relative_gap: float = 0.005, seconds: float = 120.0, progress: bool = False
) -> Solution:
    r"""Bounds of the optimal cost :math:`J^*(b)` and a policy that meets the upper one, for small tabular models.

    The method is HSVI2 (Smith and Simmons 2005) in costs: the upper bound is the least of alpha vectors; the lower bound is
    the sawtooth over known beliefs, its corners from the fast informed bound. Controls are those legal in every state of the
    support; negative costs are rewards. All is computed in double precision, with the tables of the model.

    The bounds are certified: each holds at any time, whatever the search has seen, as long as no legal control leads to where
    there is none. For rounding, the interval is widened by
    the most that it can do to first order, :math:`(16k\epsilon+4s\,10^{-14}+t)\,h/(1-\alpha)`, though never to more than costs
    can add up to. At most k numbers of precision :math:`\epsilon` are added up; s is the size of the largest support that was
    met, beliefs that agree to 14 digits are one; the policy takes plans for equal whose costs agree up to a share t, the larger
    of :math:`10^{-10}(1-\alpha)` and 4n :math:`\epsilon`; and h bounds the costs to go at the beliefs that count: the largest
    stage cost, plus what no belief costs more than, plus the size of the least entry of a bound. Rows of tables are scaled to
    sum to one; a model in float32 has tables that were rounded before.

    Args:
        model: the model.
        belief: start belief ``[n]``, or several ``[S, n]``, each as likely as another.

    Keyword Args:
        relative_gap: the search ends when the interval's width is this share of its larger absolute value, in (0, 1); or when
            time is over or rounding is all that is left, with a wider interval.
        seconds: the search ends after so many seconds at the latest, but for the step that it is in.
        progress: whether to show the trials and the interval on a terminal.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``belief`` is no distribution over the states, if the search comes to a belief from where a legal control
            leads to one whose states share no legal control, if the model's costs add up to more than a number can hold, or a
            number is out of range.

    Examples:
        >>> from torchrl_pomdp.problems import tiger
        >>> problem = tiger()
        >>> solution = solve(problem.model, torch.tensor([0.5, 0.5]))
        >>> solution.lower <= -19.371368 <= solution.upper, solution.interval.relative_gap <= 0.005
        (True, True)
        >>> solution.policy(problem.start(torch.arange(2)))["action"].tolist()
        [0, 0]
    """
    check_instance("model", model, TabularModel)
    beliefs = _beliefs(model, belief)
    check_number("relative_gap", relative_gap, "(0, 1)")
    begin = monotonic()
    until = begin + check_number("seconds", seconds, "(0, inf)")
    check_flag("progress", progress)
    table = JointTable(model)
    largest = max(abs(table.lowest), abs(table.highest))
    # Bounds are added up and subtracted.
    if not math.isfinite(4.0 * largest / (1.0 - table.discount)):
        raise ValueError(f"model must have smaller costs, got a discounted sum of up to {largest:g}: it overflows")
    search = Search(table, until)
    roots = [search.start(row) for row in beliefs]
    with progress_bar(None, "trial", "solve", progress) as bar:
        while _widened(_mean(roots), search).relative_gap > relative_gap and monotonic() < until:
            root = max(roots, key=lambda node: node.gap)
            if root.gap <= _rounding(search):
                break
            search.trial(root, _TRIAL * root.gap, until)
            bar.update()
            bar.set_postfix_str("{:.6g} to {:.6g}".format(*_mean(roots)), refresh=False)
    by_start = (Interval(root.lower, root.upper) for root in roots)
    whole, *each = (_widened(interval, search) for interval in (_mean(roots), *by_start))
    return Solution(whole, tuple(each), _policy(model, search), monotonic() - begin)


def _beliefs(model: TabularModel, belief: Tensor) -> np.ndarray:
    rows = check_tensor("belief", belief)
    if rows.ndim not in (1, 2) or rows.shape[-1] != model.num_states or not rows.numel():
        allowed = f"({model.num_states},) or (any, {model.num_states})"
        raise ValueError(f"belief must have shape {allowed}, at least one row, got {tuple(rows.shape)}")
    rows = check_distributions("belief", rows.detach().cpu().double()).reshape(-1, model.num_states)
    return (rows / rows.sum(-1, keepdim=True)).numpy()


def _mean(roots: list[Node]) -> Interval:
    return Interval(float(np.mean([root.lower for root in roots])), float(np.mean([root.upper for root in roots])))


def _widened(interval: Interval, search: Search) -> Interval:
    """An interval with all that rounding can do; costs add up to no more than the table's bounds."""
    by, table = _rounding(search), search.table
    return Interval(float(max(interval.lower - by, table.lowest)), float(min(interval.upper + by, table.highest)))


def _rounding(search: Search) -> float:
    """The most that rounding can do to a bound, to first order, and plans that are taken for equal to the policy.

    A bound holds if it does stage by stage, each time up to an error; errors add up to a stage's over 1 - discount. That of a
    stage is a share of the absolute numbers that are added up, where the policy, or for the lower bound the best one, comes to.
    By the signs of costs these are at most four times the sum below.
    """
    table = search.table
    size = table.largest_cost + max(0.0, search.top) + max(0.0, -search.bottom)
    sums = 4 * table.terms * np.finfo(np.float64).eps + search.largest_support * 10.0**-DIGITS
    return float((4.0 * sums + _tolerance(table.discount, table.num_states)) * size / (1.0 - table.discount))


def _tolerance(discount: float, num_states: int) -> float:
    """Up to which share costs of plans are equal: in all stages together little, but not less than they are rounded by."""
    return max(_EQUAL * (1.0 - discount), 4 * num_states * float(np.finfo(np.float64).eps))


def _policy(model: TabularModel, search: Search) -> AlphaVectorPolicy:
    kept = search.kept()
    vectors = torch.from_numpy(search.vectors.rows[kept])
    return AlphaVectorPolicy(model, vectors, torch.tensor([search.controls[k] for k in kept]))
