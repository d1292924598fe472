"""What a compiled simulation of the repair problem shows: the model as tables, and the state of a trajectory.

Between two looks at a location its belief evolves without noise. Its belief and its expected cost at any stage are thus read
from a table, given when and at which level it was last seen. Locations of one kind, that is of equal chains and costs, share
tables.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_pomdp.scalar.compiling import inner, shared

__all__ = [
    "Tables",
    "View",
    "expected",
    "expected_cost",
    "extra_cost",
    "intact",
    "jointly_legal",
    "legal",
    "legal_at",
    "part_of",
    "probability",
    "split",
]


class Tables(NamedTuple):
    r"""What simulations read of a model.

    Attributes:
        kind: of each location, a number below J, ``[L]``.
        powers: :math:`P^n`, by kind, ``[J, n, K, K]``.
        cumulative: the same, summed over the levels up to each, ``[J, n, K, K]``.
        stage_costs: :math:`(P^nc)_k`, by kind, ``[J, n, K]``.
        extra_costs: :math:`(P^n(c-c_0))_k`, by kind, ``[J, n, K]``.
        interval_costs: :math:`C_{nk}`, by kind, ``[J, n, K]``.
        discounts: :math:`\alpha^n`, ``[n]``.
        destinations: location after a robot's control, -1 where the move leaves the graph, ``[L, A]``.
        order: all locations by their distance from one, then by number, ``[L, L]``.
        distances: moves from one location to another, ``[L, L]``.
        first_controls: the control that starts a shortest path, ``[L, L]``.
        first_moves: the lowest move at a location, or repair where there is none, ``[L]``.
        unrestricted: whether intact locations may be repaired.
        columns: the partition's columns, ``[L]``.
        prices: cost of every level, as the partition has them, ``[L, K]``.
        damage: :math:`(P^np)_k` with these costs p, by kind, ``[J, n, K]``.
        works: :math:`\rho`, that an attempt to repair works.
        ends: whether level 0 is absorbing and costs nothing everywhere, so that there are terminal states.
        steady: whether level 0 is absorbing, and no other level leads to it, everywhere.
        free: whether, moreover, level 0 costs nothing anywhere.
        upward: whether levels never fall by themselves, higher ones cost no less, and none costs less than nothing.
        least_cost: of a level, anywhere.
        terminal_probability: :math:`\epsilon`.
        forgiven: the most, discounted, that damage of no more than this probability can cost; zero where nothing is terminal.
        damage_threshold: of the partition.
        low: density bound of the partition.
        high: the other one.
    """

    kind: NDArray[np.int64]
    powers: NDArray[np.float64]
    cumulative: NDArray[np.float64]
    stage_costs: NDArray[np.float64]
    extra_costs: NDArray[np.float64]
    interval_costs: NDArray[np.float64]
    discounts: NDArray[np.float64]
    destinations: NDArray[np.int64]
    order: NDArray[np.int64]
    distances: NDArray[np.int64]
    first_controls: NDArray[np.int64]
    first_moves: NDArray[np.int64]
    unrestricted: bool
    columns: NDArray[np.float64]
    prices: NDArray[np.float64]
    damage: NDArray[np.float64]
    works: float
    ends: bool
    steady: bool
    free: bool
    upward: bool
    least_cost: float
    terminal_probability: float
    forgiven: float
    damage_threshold: float
    low: float
    high: float


class View(NamedTuple):
    """What a scalar twin sees of a simulated trajectory, see :func:`torchrl_pomdp.scalar.scalar_twin`.

    Ask for beliefs by :func:`intact`, :func:`expected_cost`, :func:`extra_cost` and :func:`probability`.

    Attributes:
        stage: stages since the trajectory started.
        location: where the robots are, ``[R]``.
        level: level of every location when it was last seen, -1 where it has not been, ``[L]``.
        since: the stage of that, ``[L]``.
        intact: probability now that a location is intact, in the model's precision, ``[L]``.
        start: belief in which the trajectory started, ``[L, K]``.
        tables: the model.
        work: numbers for the twin's own use, which it finds as it left them in the same trajectory or in another one.
        key: the trajectory's stream of random numbers, uint64.
    """

    stage: int
    location: NDArray[np.int64]
    level: NDArray[np.int64]
    since: NDArray[np.int64]
    intact: NDArray[np.floating]
    start: NDArray[np.float64]
    tables: Tables
    work: NDArray[np.float32]
    key: np.uint64


@inner
def probability(view, place, level):
    """Probability now that a location is at a level."""
    n, known, kind = view.stage - view.since[place], view.level[place], view.tables.kind[place]
    if known >= 0:
        return view.tables.powers[kind, n, known, level]
    total = 0.0
    for k in range(view.start.shape[1]):
        total += view.start[place, k] * view.tables.powers[kind, n, k, level]
    return total


@inner
def expected(view, place, stage, numbers):
    """The mean, at a stage, of numbers ``[J, n, K]`` that depend on the level at the last look and on the stages since."""
    n, known, kind = stage - view.since[place], view.level[place], view.tables.kind[place]
    if known >= 0:
        return numbers[kind, n, known]
    total = 0.0
    for k in range(view.start.shape[1]):
        total += view.start[place, k] * numbers[kind, n, k]
    return total


@inner
def expected_cost(view, place):
    """Expected cost of a location at this stage."""
    return expected(view, place, view.stage, view.tables.stage_costs)


@inner
def extra_cost(view, place):
    """What a location is expected to cost at this stage more than if it were intact; exactly 0 where no level costs more."""
    return expected(view, place, view.stage, view.tables.extra_costs)


@inner
def intact(view, place, threshold):
    """Whether a location is intact but for a probability up to ``threshold``, in the model's precision."""
    return view.intact[place] + view.intact.dtype.type(threshold) >= 1.0


@inner
def legal_at(tables, place, known_intact, control):
    """Whether a robot may take a control at a location, which is known to be intact or not."""
    if not 0 <= control < tables.destinations.shape[1]:
        return False
    if control > 0:
        return tables.destinations[place, control] >= 0
    return not known_intact or tables.first_moves[place] == 0 or tables.unrestricted


@inner
def legal(view, robot, control):
    """Whether a robot may take a control."""
    place = view.location[robot]
    return legal_at(view.tables, place, view.intact[place] == 1.0, control)


@inner
def split(number, base, digits):
    """Put the base-``base`` digits of a joint control or observation into ``digits`` ``[R]``, robot 0 first."""
    for robot in range(len(digits) - 1, -1, -1):
        digits[robot] = number % base
        number //= base


@inner
def jointly_legal(view, u, controls):
    """Whether the robots may take joint control ``u``, which is put into ``controls`` ``[R]``."""
    split(u, view.tables.destinations.shape[1], controls)
    fits = True
    for robot in range(len(controls)):
        fits = fits and legal(view, robot, controls[robot])
    return fits


@shared
def part_of(view):
    """Part of a state, see :class:`~torchrl_pomdp.envs.repair.RepairPartition`."""
    tables, size, robots = view.tables, len(view.level), len(view.location)
    num_intact, centre = 0, 0.0
    for robot in range(robots):
        centre += tables.columns[view.location[robot]]
    left, right = 0.0, 0.0
    for place in range(size):
        if intact(view, place, tables.damage_threshold):
            num_intact += 1
        side = centre - tables.columns[place] * robots
        if side >= 1.0 or side <= -1.0:
            cost = 0.0
            if view.level[place] >= 0:
                cost = tables.damage[tables.kind[place], view.stage - view.since[place], view.level[place]]
            else:
                for k in range(view.start.shape[1]):
                    cost += probability(view, place, k) * tables.prices[place, k]
            if side >= 1.0:
                left += cost
            else:
                right += cost
    total = left + right
    density = 1 - int(left > tables.high * total) + int(left < tables.low * total)
    return density + (3 if 2 * num_intact > size else 0)
