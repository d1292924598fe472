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

from torchrl_pomdp.modules.repair.scalar.view import View, legal, part_of, probability
from torchrl_pomdp.scalar.compiling import inner, outer, shared
from torchrl_pomdp.scalar.noise import scenario_noise, variable_bit
from torchrl_pomdp.scalar.twins import choose

__all__ = ["FINE", "ILLEGAL", "NEVER", "Limits", "Noise", "Trajectories", "Work", "set_initial", "simulate", "trajectory"]

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
        level_costs: cost of a cut by the level of each location, ``[K]``; ``[0]`` where it depends on none.
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
    intact: NDArray[np.float32]
    controls: NDArray[np.int64]
    seen: NDArray[np.int64]
    numbers: NDArray[np.float32]
    row: NDArray[np.float64]
    mask: NDArray[np.bool_]


class Noise(NamedTuple):
    """The scenario of a trajectory, see :class:`~torchrl_pomdp.modules.scenarios.Scenarios`.

    Attributes:
        key: its stream.
        group: key of the estimate.
        member: its number in the estimate.
        of: number of trajectories of the estimate.
        seen: bits of the variables that have been observed.
    """

    key: np.uint64
    group: np.uint64
    member: int
    of: int
    seen: np.uint64


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
def _set_intact(view):
    """Bring up to date, for all locations, the probability that they are intact."""
    for place in range(len(view.level)):
        view.intact[place] = np.float32(probability(view, place, 0))


@inner
def _terminal(view, witness):
    """Whether the state is terminal, see :meth:`~torchrl_pomdp.envs.repair.RepairModel.is_terminal`; a witness if it is not.

    A single location that may be damaged tells that it is not; the one that did so last is asked first.
    """
    product, size = 1.0, len(view.level)
    for i in range(size):
        place = witness + i if witness + i < size else witness + i - size
        product *= view.intact[place]
        if not 1.0 - product <= view.tables.terminal_probability:
            return False, place
    return True, witness


@inner
def _draw_level(view, place, noise):
    """Level that a robot sees at ``place`` at the next stage."""
    tables, levels = view.tables, view.start.shape[1]
    n, known = view.stage + 1 - view.since[place], view.level[place]
    if known >= 0:
        threshold = noise * tables.cumulative[n, known, levels - 1]
        for level in range(levels - 1):
            if tables.cumulative[n, known, level] > threshold:
                return level
        return levels - 1
    threshold, reached, possible = np.float64(noise), 0.0, 0
    for level in range(levels):
        here = 0.0
        for k in range(levels):
            here += view.start[place, k] * tables.powers[n, k, level]
        reached += here
        if here > 0.0:
            possible = level
            if reached > threshold:
                break
    # Marginals sum to one but for rounding: what is left belongs to the last level that is possible.
    return possible


@inner
def _interval_cost(view, place, stage):
    """Discounted cost of a location from when it was last seen until ``stage``."""
    tables, since, known = view.tables, view.since[place], view.level[place]
    n = stage - since
    if known >= 0:
        return tables.discounts[since] * tables.interval_costs[n, known]
    total = 0.0
    for k in range(view.start.shape[1]):
        total += view.start[place, k] * tables.interval_costs[n, k]
    return total


@shared
def _closed_cost(view, limits):
    """Terminal cost in closed form."""
    total = limits.constant
    for place in range(len(view.level)):
        for k in range(len(limits.level_costs)):
            total += probability(view, place, k) * limits.level_costs[k]
    return total


@inner
def _look(view, controls, levels, forced, noise, seen, age):
    """The robots move and look: puts what they see into ``levels``; returns the variables that have been seen."""
    tables, robots = view.tables, len(view.location)
    after = seen
    for robot in range(robots):
        view.location[robot] = tables.destinations[view.location[robot], controls[robot]]
    for robot in range(robots):
        place = view.location[robot]
        bit = variable_bit(place)
        first, after = (seen & bit) == 0, after | bit
        if forced:
            continue
        level = 0 if tables.steady and view.intact[place] == 1.0 else -1
        for other in range(robots):
            if view.location[other] == place and controls[other] == 0:
                level = 0
        for other in range(robot):
            if view.location[other] == place:
                level = levels[other]
        if level < 0:
            number = scenario_noise(noise.key, noise.group, noise.member, noise.of, first, place, age * robots + robot)
            level = _draw_level(view, place, number)
        levels[robot] = level
    return after


@inner
def _ends(view, limits, after, age, own_part, witness):
    """Whether a trajectory goes on, and which part it has started in and what :func:`_terminal` remembers."""
    if view.tables.absorbing:
        over, witness = _terminal(view, witness)
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
    size, robots = start.shape[0], len(origin)
    location, level, since, known = work.location, work.level, work.since, work.intact
    for robot in range(robots):
        location[robot] = origin[robot]
    for place in range(size):
        level[place], since[place], known[place] = work.initial[place], 0, np.float32(start[place, 0])
    cost, steps, stage, seen, own_part, witness = 0.0, 0, 0, noise.seen, 0, 0
    while True:
        view = View(stage, location, level, since, known, start, tables, work.numbers)
        age = stage - 1 if first else stage
        if not tables.steady and stage > 0:
            _set_intact(view)
        if age >= 0:
            ended, own_part, witness = _ends(view, limits, after, age, own_part, witness)
            if ended != _GOES_ON:
                break
            choose(policy, view, work.controls)
            for robot in range(robots):
                if not legal(view, robot, work.controls[robot]):
                    return cost, steps, False, stage, ILLEGAL
            steps += 1
        seen = _look(view, work.controls, work.seen, forced and age < 0, noise, seen, age)
        for robot in range(robots):
            place = location[robot]
            if not tables.free or known[place] < 1.0:
                cost += _interval_cost(view, place, stage + 1)
            if tables.steady:
                known[place] = 1.0 if work.seen[robot] == 0 else 0.0
            level[place], since[place] = work.seen[robot], stage + 1
        stage += 1
    for place in range(size):
        if not tables.free or known[place] < 1.0:
            cost += _interval_cost(view, place, stage)
    cut = ended == _CUT
    if cut and limits.closed:
        cost += tables.discounts[stage] * _closed_cost(view, limits)
    return cost, steps, cut, stage, FINE


@shared
def _keep_state(tables, work, belief, location, stage):
    """Put a trajectory's state into ``belief``, its start until now, and ``location``."""
    view = View(stage, work.location, work.level, work.since, work.intact, belief, tables, work.numbers)
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
