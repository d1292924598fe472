r"""Simulated trajectories of the repair problem that cost what their events cost: a compiled loop.

With :math:`C_{nk}=\sum_{i<n}\alpha^i(P^ic)_k`, a location that is seen at level k at stage s costs
:math:`\alpha^sC_{t-s,k}` until it is seen again at stage t. A trajectory remembers when each location was last seen, and at
which level; its cost is a sum over looks, not over stages, locations and levels.

The noise is that of :mod:`~torchrl_pomdp.modules.scenarios`, the rules are those of
:class:`~torchrl_pomdp.modules.TruncatedRollout`; beliefs and costs are computed in double precision.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_pomdp.modules.repair.scalar.events import (
    bits_after,
    interval_cost,
    look,
    moved,
    set_intact,
    take_in,
    terminal,
)
from torchrl_pomdp.modules.repair.scalar.view import View, legal, part_of, probability
from torchrl_pomdp.scalar.compiling import inner, outer, shared
from torchrl_pomdp.scalar.noise import Noise
from torchrl_pomdp.scalar.twins import choose

__all__ = [
    "FINE",
    "ILLEGAL",
    "NEVER",
    "Limits",
    "Trajectories",
    "Work",
    "begin",
    "continued",
    "set_initial",
    "simulate",
    "trajectory",
]

# Steps after which no rule cuts.
NEVER = 1 << 60
_NEVER_SEEN = -1
# What ends a trajectory.
_TERMINAL, _CUT, _GOES_ON = 0, 1, 2
# Whether all is well, or a policy has chosen an illegal control.
FINE, ILLEGAL = 0, 1


class Limits(NamedTuple):
    """When trajectories end, and what a cut adds.

    Attributes:
        max_steps: largest number of steps.
        entering: bits of the parts that cut.
        leaving: whether leaving the first part cuts.
        closed: whether a cut adds ``constant`` and ``level_costs``; else cut trajectories report their states.
        constant: cost of a cut.
        level_costs: cost of a cut by the level of each location, ``[L, K]``; ``[L, 0]`` where it depends on none.
    """

    max_steps: int
    entering: int
    leaving: bool
    closed: bool
    constant: float
    level_costs: NDArray[np.float64]


class Work(NamedTuple):
    """Memory of a trajectory, used again by the next one."""

    location: NDArray[np.int64]
    initial: NDArray[np.int64]
    level: NDArray[np.int64]
    since: NDArray[np.int64]
    intact: NDArray[np.floating]
    controls: NDArray[np.int64]
    seen: NDArray[np.int64]
    numbers: NDArray[np.float32]
    row: NDArray[np.float64]


class Trajectories(NamedTuple):
    """Trajectories that start in states of their own.

    Attributes:
        beliefs: ``[N, L, K]``, overwritten by the beliefs of the trajectories that are cut and lack a terminal cost.
        locations: ``[N, R]``, overwritten likewise.
        keys: uint64 ``[N]``.
        groups: uint64 ``[N]``.
        members: ``[N]``.
        seen: uint64 ``[N]``.
        after: steps after which the rules cut each of them, ``[N]``.
        total: gets the costs, ``[N]``.
        cut: gets the steps of those that are cut and lack a terminal cost, else -1, ``[N]``.
    """

    beliefs: NDArray[np.float64]
    locations: NDArray[np.int64]
    keys: NDArray[np.uint64]
    groups: NDArray[np.uint64]
    members: NDArray[np.int64]
    seen: NDArray[np.uint64]
    after: NDArray[np.int64]
    total: NDArray[np.float64]
    cut: NDArray[np.int64]


@inner
def set_initial(start, initial):
    """Put the levels that are certain into ``initial``, and -1 for others."""
    for place in range(start.shape[0]):
        known = _NEVER_SEEN
        for k in range(start.shape[1]):
            if start[place, k] == 1.0:
                known = k
        initial[place] = known


@shared
def _closed_cost(view, limits):
    """Terminal cost in closed form."""
    total = limits.constant
    for place in range(len(view.level)):
        for k in range(limits.level_costs.shape[1]):
            total += probability(view, place, k) * limits.level_costs[place, k]
    return total


@inner
def _ends(view, limits, after, age, own_part, witness):
    """Whether a trajectory goes on, and which part it has started in and what :func:`terminal` remembers."""
    if view.tables.ends:
        over, witness = terminal(view, witness)
        if over:
            return _TERMINAL, own_part, witness
    cut = age == limits.max_steps or age >= after
    if limits.entering != 0 or limits.leaving:
        part = part_of(view)
        if age == 0:
            own_part = part
        cut = cut or (limits.entering >> part) & 1 == 1 or (limits.leaving and part != own_part)
    return _CUT if cut else _GOES_ON, own_part, witness


@inner
def begin(work, start, origin):
    """Put the state at stage 0 into ``work``."""
    for robot in range(len(origin)):
        work.location[robot] = origin[robot]
    for place in range(start.shape[0]):
        work.level[place], work.since[place], work.intact[place] = work.initial[place], 0, start[place, 0]


@inner
def continued(policy, tables, limits, after, work, start, stage, cost, first, forced, noise):
    """The rest of a :func:`trajectory` whose state at ``stage`` is in ``work``, and which has cost ``cost`` so far.

    What locations cost is added when they are seen again, and at the end: until then ``cost`` lacks it.
    """
    size, robots = start.shape[0], len(work.location)
    steps, seen, own_part, witness = 0, noise.seen, 0, 0
    while True:
        view = View(stage, work.location, work.level, work.since, work.intact, start, tables, work.numbers, noise.key)
        age = stage - 1 if first else stage
        if not tables.steady and stage > 0:
            set_intact(view)
        if age >= 0:
            ended, own_part, witness = _ends(view, limits, after, age, own_part, witness)
            if ended != _GOES_ON:
                break
            choose(policy, view, work.controls)
            for robot in range(robots):
                if not legal(view, robot, work.controls[robot]):
                    return cost, steps, False, stage, ILLEGAL
            steps += 1
        moved(view, work.controls)
        if not (forced and age < 0):
            look(view, work.controls, work.seen, noise, seen, age)
        seen = bits_after(view, seen)
        cost += take_in(view, work.seen)
        stage += 1
    for place in range(size):
        if not tables.free or work.intact[place] < 1.0:
            cost += interval_cost(view, place, stage)
    cut = ended == _CUT
    if cut and limits.closed:
        cost += tables.discounts[stage] * _closed_cost(view, limits)
    return cost, steps, cut, stage, FINE


@inner
def trajectory(policy, tables, limits, after, work, start, origin, first, forced, noise):
    """One trajectory from a state, for which :func:`set_initial` has been called.

    Args:
        policy: pair of twin and data.
        tables: the model.
        limits: when it ends.
        after: steps after which the rules cut it.
        work: memory.
        start: belief ``[L, K]``.
        origin: locations ``[R]``.
        first: whether the controls of the first stage are those in ``work.controls``; ages count from the state after it.
        forced: whether what is observed then is in ``work.seen``.
        noise: the scenario.

    Returns:
        its cost from ``start`` on, its steps, whether it was cut, at which stage it ended, and whether all was well.
    """
    begin(work, start, origin)
    return continued(policy, tables, limits, after, work, start, 0, 0.0, first, forced, noise)


@shared
def _keep_state(tables, work, belief, location, stage):
    """Put a trajectory's state into ``belief``, its start until now, and ``location``."""
    view = View(stage, work.location, work.level, work.since, work.intact, belief, tables, work.numbers, np.uint64(0))
    for place in range(belief.shape[0]):
        for k in range(belief.shape[1]):
            work.row[k] = probability(view, place, k)
        for k in range(belief.shape[1]):
            belief[place, k] = work.row[k]
    for robot in range(len(location)):
        location[robot] = work.location[robot]


@outer
def simulate(policy, tables, limits, work, rows, count):
    """Cost of one trajectory from every row.

    Args:
        policy: pair of twin and data.
        tables: the model.
        limits: when trajectories end.
        work: memory.
        rows: the trajectories.
        count: number of trajectories of an estimate.

    Returns:
        the number of steps, and the row where a control was illegal, or -1.
    """
    steps = 0
    for row in range(len(rows.total)):
        start, origin = rows.beliefs[row], rows.locations[row]
        noise = Noise(rows.keys[row], rows.groups[row], rows.members[row], count, rows.seen[row])
        set_initial(start, work.initial)
        cost, made, cut, stage, state = trajectory(
            policy, tables, limits, rows.after[row], work, start, origin, False, False, noise
        )
        if state == ILLEGAL:
            return steps, row
        steps += made
        rows.total[row], rows.cut[row] = cost, -1
        if cut and not limits.closed:
            rows.cut[row] = stage
            _keep_state(tables, work, start, origin, stage)
    return steps, -1
