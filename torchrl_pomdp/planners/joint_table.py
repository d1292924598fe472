r"""A tabular model as arrays for exact planning, and the first bounds of its optimal cost (paper, Section II).

All of it is double precision on the CPU. The numbers that are kept are :math:`p_{ij}(u)\,p(z\mid j,u)`, those that are not
zero, sorted by control, state and observation.
"""

from __future__ import annotations

from itertools import pairwise
from time import monotonic
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchrl_pomdp.envs.tabular import TabularModel

__all__ = ["Floats", "Integers", "JointTable"]

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Where the first bounds stop to move: what is left to go, relative to their size, and stages at most.
_SETTLED, _MOST_ROUNDS = 1e-7, 20_000


class _Control(NamedTuple):
    """Numbers of one control: state, next state, observation and probability, sorted by state, then observation.

    ``rows`` says where each state begins; ``pairs`` where each pair of state and observation does, and ``pair_rows`` where
    each state begins among the pairs.
    """

    i: Integers
    j: Integers
    z: Integers
    p: Floats
    rows: Integers
    pairs: Integers
    pair_rows: Integers


class JointTable:
    r"""Arrays of a tabular model with n states, U controls and Z observations.

    Args:
        model: the model; its rows are scaled to sum to one in double precision.

    Attributes:
        cost: stage costs ``[U, n]``, ``+inf`` where a control is illegal.
        discount: :math:`\alpha`.
        free: states from which no cost follows, whatever is done, bool ``[n]``.
        largest_cost: the largest absolute value of a stage cost.
        lowest: a bound of all discounted sums of costs from below.
        highest: a bound of all discounted sums of costs from above.

    Examples:
        >>> from torchrl_pomdp.problems import tiger
        >>> table = JointTable(tiger(0.5).model)
        >>> listening_twice = table.backup(0, np.ones((1, 2)), np.zeros(2, np.int64))
        >>> listening_twice.tolist()
        [1.5, 1.5]
    """

    def __init__(self, model: TabularModel) -> None:
        self.discount = model.discount
        self.num_controls, self.num_states, self.num_observations = model.num_controls, model.num_states, model.num_observations
        legal = model.legal.cpu().numpy().T
        self.cost: Floats = np.where(legal, model.cost.detach().cpu().double().numpy(), np.inf)
        self.controls = [_control(*part, self.num_states) for part in _joined(model)]
        self.free = self._free()
        finite = self.cost[np.isfinite(self.cost)]
        self.largest_cost = float(np.abs(finite).max())
        lowest, highest = float(finite.min()), float(finite.max())
        # The quotient is rounded: a little further out, whatever the sign.
        little = 4.0 * float(np.finfo(np.float64).eps)
        self.lowest = (lowest - little * abs(lowest)) / (1.0 - self.discount)
        self.highest = (highest + little * abs(highest)) / (1.0 - self.discount)

    def spread(self, u: int, states: Integers, probs: Floats) -> Floats:
        """P(observation z, next state j) ``[Z, n]`` after control ``u`` at a belief, given by its support."""
        dense = np.zeros(self.num_states)
        dense[states] = probs
        each = self.controls[u]
        place = each.z * self.num_states + each.j
        size = self.num_observations * self.num_states
        summed: Floats = np.bincount(place, dense[each.i] * each.p, size).astype(np.float64, copy=False)
        return summed.reshape(self.num_observations, self.num_states)

    def backup(self, u: int, vectors: Floats, chosen: Integers) -> Floats:
        """Cost ``[n]`` of control ``u``, then of plan ``chosen[z]``; costs of plans are ``vectors`` ``[N, n]``."""
        each = self.controls[u]
        return self.cost[u] + self.discount * np.add.reduceat(each.p * vectors[chosen[each.z], each.j], each.rows)

    def worst(self, until: float) -> Floats:
        """Cost ``[n]`` of the worst legal play where the state is seen: no legal policy of any belief costs more.

        This bound and the next two never turn back, so that they may be stopped at any time and hold up to the rounding of a
        single stage; at the time ``until`` they are.
        """
        value = np.where(self.free, 0.0, self.highest)
        for _ in range(_MOST_ROUNDS):
            steps = self._steps(value).max(0, where=np.isfinite(self.cost), initial=-np.inf)
            before, value = value, np.where(self.free, 0.0, np.minimum(value, steps))
            if self._settled(before, value) or monotonic() >= until:
                break
        return value

    def constant(self, u: int, start: Floats, until: float) -> Floats:
        """Cost ``[n]`` of control ``u`` at all stages, from above; ``+inf`` where it becomes illegal some time."""
        value = np.where(self._lasting(u), start, np.inf)
        for _ in range(_MOST_ROUNDS):
            before, value = value, np.minimum(value, self._step(u, value))
            if self._settled(before, value) or monotonic() >= until:
                break
        return value

    def informed(self, until: float) -> Floats:
        r"""The fast informed bound ``[n, U]``: :math:`\min_u\sum_i b(i)Q(i,u)` is no more than the optimal cost of a belief.

        .. math:: Q(i,u)=g(i,u)+\alpha\sum_z\min_{u'}\sum_j p_{ij}(u)\,p(z\mid j,u)\,Q(j,u')

        It is approached from below.
        """
        q = np.where(np.isfinite(self.cost.T), np.where(self.free[:, None], 0.0, self.lowest), np.inf)
        for _ in range(_MOST_ROUNDS):
            steps = np.stack([self._informed_step(u, q) for u in range(self.num_controls)], 1)
            before, q = q, np.maximum(q, steps)
            if self._settled(before, q) or monotonic() >= until:
                break
        return q

    @property
    def terms(self) -> int:
        """The most numbers that are added up for one number of a backup or of a belief."""
        return self.num_states + max(int(np.diff(each.rows, append=len(each.p)).max()) for each in self.controls)

    def _settled(self, before: Floats, after: Floats) -> bool:
        """Whether a bound hardly moves any more: what is left to go is at most a stage's move over 1 - discount."""
        finite = np.isfinite(after)
        move, size = (np.abs(each).max(initial=0.0) for each in (before[finite] - after[finite], after[finite]))
        settled: bool = move <= _SETTLED * (1.0 - self.discount) * max(size, self.largest_cost)
        return settled

    def _steps(self, value: Floats) -> Floats:
        return np.stack([self._step(u, value) for u in range(self.num_controls)])

    def _step(self, u: int, value: Floats) -> Floats:
        each = self.controls[u]
        return self.cost[u] + self.discount * np.add.reduceat(each.p * value[each.j], each.rows)

    def _informed_step(self, u: int, q: Floats) -> Floats:
        each = self.controls[u]
        by_pair = np.add.reduceat(each.p[:, None] * q[each.j], each.pairs, axis=0).min(1)
        return self.cost[u] + self.discount * np.add.reduceat(by_pair, each.pair_rows)

    def _lasting(self, u: int) -> NDArray[np.bool_]:
        """States ``[n]`` from where control ``u`` stays legal for ever."""
        each, lasting = self.controls[u], np.isfinite(self.cost[u])
        while True:
            still = lasting & np.logical_and.reduceat(lasting[each.j], each.rows)
            if (still == lasting).all():
                return lasting
            lasting = still

    def _free(self) -> NDArray[np.bool_]:
        legal = np.isfinite(self.cost)
        free = ((self.cost == 0.0) | ~legal).all(0)
        while True:
            stays = [np.logical_and.reduceat(free[each.j], each.rows) for each in self.controls]
            still = free & (np.stack(stays) | ~legal).all(0)
            if (still == free).all():
                return free
            free = still


def _joined(model: TabularModel) -> list[tuple[Integers, Integers, Integers, Floats]]:
    """For each control the state, next state, observation and probability of what can happen."""
    moves, sees = (table.detach().cpu().double().to_sparse().coalesce() for table in (model.transition, model.observation))
    n = model.num_states
    count = torch.bincount(sees.indices()[0] * n + sees.indices()[1], minlength=model.num_controls * n)
    first = count.cumsum(0) - count
    u, i, j = moves.indices()
    number = count[u * n + j]
    entry = torch.arange(len(u)).repeat_interleave(number)
    rank = torch.arange(len(entry)) - (number.cumsum(0) - number)[entry]
    seen = first[(u * n + j)[entry]] + rank
    p = moves.values()[entry] * sees.values()[seen]
    parts = (u[entry], i[entry], j[entry], sees.indices()[2][seen], p)
    u_of, *rest = (part[p > 0].numpy() for part in parts)
    ends = [0, *np.bincount(u_of, minlength=model.num_controls).cumsum()]
    return [tuple(part[a:b] for part in rest) for a, b in pairwise(ends)]  # type: ignore[misc]


def _control(i: Integers, j: Integers, z: Integers, p: Floats, n: int) -> _Control:
    order = np.lexsort((j, z, i))
    i, j, z, p = i[order], j[order], z[order], p[order]
    p = p / np.bincount(i, p, n)[i]
    new = np.diff(i, prepend=-1) != 0
    pair = new | (np.diff(z, prepend=-1) != 0)
    pairs = np.flatnonzero(pair)
    return _Control(i, j, z, p, np.flatnonzero(new), pairs, np.flatnonzero(new[pairs]))
