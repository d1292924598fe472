"""The repair problem for tree searches: the operations of :mod:`torchrl_pomdp.scalar.models`.

A history is kept as what it changes: when each location was last seen, at which level, and where the robots are.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_pomdp.modules.repair.scalar.events import (
    bits_after,
    interval_cost,
    level_at,
    look,
    moved,
    set_intact,
    take_in,
    terminal,
)
from torchrl_pomdp.modules.repair.scalar.trajectories import FINE, NEVER, Work, begin, continued, set_initial
from torchrl_pomdp.modules.repair.scalar.view import View, expected, expected_cost, jointly_legal, legal, split
from torchrl_pomdp.modules.scenarios import BITS
from torchrl_pomdp.scalar.compiling import inner
from torchrl_pomdp.scalar.models import ScalarModel
from torchrl_pomdp.scalar.noise import scenario_noise, variable_bit
from torchrl_pomdp.scalar.twins import choose

__all__ = ["History", "repair_model"]


class History(NamedTuple):
    """The state of one history at a time.

    Attributes:
        belief: at the root, ``[L, K]``.
        origin: locations at the root, ``[R]``.
        stage: ``[1]``.
        work: the rest.
    """

    belief: NDArray[np.float64]
    origin: NDArray[np.int64]
    stage: NDArray[np.int64]
    work: Work


@inner
def _view(tables, state, key):
    work = state.work
    return View(state.stage[0], work.location, work.level, work.since, work.intact, state.belief, tables, work.numbers, key)


@inner
def _joined(digits, base):
    number = 0
    for digit in digits:
        number = number * base + digit
    return number


def _start(data, state):
    set_initial(state.belief, state.work.initial)
    begin(state.work, state.belief, state.origin)
    state.stage[0] = 0


def _keep(data, state, row):
    work, robots, size = state.work, len(state.origin), state.belief.shape[0]
    row[0] = state.stage[0]
    for robot in range(robots):
        row[1 + robot] = work.location[robot]
    for place in range(size):
        row[1 + robots + place], row[1 + robots + size + place] = work.level[place], work.since[place]


def _recall(data, state, row):
    work, robots, size = state.work, len(state.origin), state.belief.shape[0]
    state.stage[0] = np.int64(row[0])
    for robot in range(robots):
        work.location[robot] = np.int64(row[1 + robot])
    for place in range(size):
        level = np.int64(row[1 + robots + place])
        work.level[place], work.since[place] = level, np.int64(row[1 + robots + size + place])
        # Right where no level leads to level 0; else all are computed anew.
        work.intact[place] = state.belief[place, 0] if level < 0 else 1.0 if level == 0 else 0.0
    _refresh(data[0], state)


@inner
def _refresh(tables, state):
    if not tables.steady and state.stage[0] > 0:
        set_intact(_view(tables, state, np.uint64(0)))


def _mask(data, state, legal_controls):
    view, controls = _view(data[0], state, np.uint64(0)), state.work.controls
    for u in range(len(legal_controls)):
        legal_controls[u] = jointly_legal(view, u, controls)


def _costs(data, state, out):
    tables, _ = data
    view, total = _view(tables, state, np.uint64(0)), 0.0
    for place in range(state.belief.shape[0]):
        if not tables.free or view.intact[place] < 1.0:
            total += expected_cost(view, place)
    for u in range(len(out)):
        out[u] = total


def _over(data, state):
    tables, limits = data
    if state.stage[0] >= limits.max_steps:
        return True
    return tables.ends and terminal(_view(tables, state, np.uint64(0)), 0)[0]


def _move(data, state, u):
    tables, _ = data
    split(u, tables.destinations.shape[1], state.work.controls)
    moved(_view(tables, state, np.uint64(0)), state.work.controls)


def _see(data, state, noise):
    tables, _ = data
    look(_view(tables, state, noise.key), state.work.controls, state.work.seen, noise, noise.seen, state.stage[0])
    return _joined(state.work.seen, state.belief.shape[1])


def _seen_after(data, state, seen):
    return bits_after(_view(data[0], state, np.uint64(0)), seen)


def _settle(data, state, z):
    split(z, state.belief.shape[1], state.work.seen)
    take_in(_view(data[0], state, np.uint64(0)), state.work.seen)
    state.stage[0] += 1
    _refresh(data[0], state)


def _remaining(data, policy, state, noise):
    tables, limits = data
    view, before = _view(tables, state, noise.key), 0.0
    for place in range(state.belief.shape[0]):
        if not tables.free or view.intact[place] < 1.0:
            before += interval_cost(view, place, view.stage)
    cost, steps, _, _, well = continued(
        policy, tables, limits, NEVER, state.work, state.belief, view.stage, -before, False, False, noise
    )
    return cost / tables.discounts[view.stage], steps, well == FINE


def _preferred(data, policy, state):
    view = _view(data[0], state, np.uint64(0))
    choose(policy, view, state.work.controls)
    for robot in range(len(state.origin)):
        if not legal(view, robot, state.work.controls[robot]):
            return -1
    return _joined(state.work.controls, data[0].destinations.shape[1])


@inner
def _arrival_cost(view, noise, place, n):
    """The least that a location costs, undiscounted, at the stage ``n`` from now when a robot can first see it."""
    tables, levels = view.tables, view.start.shape[1]
    # Else another location shares its bit, and it may be drawn as if it had been seen.
    alone = place < BITS and place + BITS >= len(view.level)
    if alone and (noise.seen & variable_bit(place)) == 0:
        # Seen later, it is found in no lower a level; not seen now, it costs what is expected.
        number = scenario_noise(noise.key, noise.group, noise.member, noise.of, True, place, 0)
        lowest = level_at(view, place, view.stage + n, number)
    else:
        lowest = max(view.level[place], 0)
        while view.level[place] < 0 and lowest < levels - 1 and view.start[place, lowest] == 0.0:
            lowest += 1
    cost = expected(view, place, view.stage + n, tables.stage_costs)
    return min(cost, tables.stage_costs[tables.kind[place], 0, lowest])


def _relaxed(data, state, noise):
    tables, limits = data
    view = _view(tables, state, noise.key)
    now, size = view.stage, state.belief.shape[0]
    if not tables.upward:
        rest = (1.0 - tables.discounts[limits.max_steps - now]) / (1.0 - tables.discounts[1])
        return size * min(0.0, tables.least_cost) * rest
    total = 0.0
    for place in range(size):
        if tables.free and view.intact[place] == 1.0:
            continue
        away = limits.max_steps - now
        for robot in range(len(state.origin)):
            away = min(away, tables.distances[view.location[robot], place])
        # No robot has been there until then, so that it costs what is expected now; no attempt to repair works earlier.
        last = now + max(away, 1)
        total += interval_cost(view, place, last) - interval_cost(view, place, now)
        if away > 0 and last < limits.max_steps:
            total += tables.discounts[last] * _arrival_cost(view, noise, place, away)
            last += 1
        # From then on it costs at least what it costs intact, for as long as simulations go on.
        intact_cost = tables.stage_costs[tables.kind[place], 0, 0]
        total += intact_cost * (tables.discounts[last] - tables.discounts[limits.max_steps]) / (1.0 - tables.discounts[1])
    # All is over once damage is improbable enough, wherever it is: what it would have cost until a robot came is not paid.
    return max(total / tables.discounts[now] - tables.forgiven, 0.0)


repair_model = ScalarModel(
    start=_start,
    keep=_keep,
    recall=_recall,
    mask=_mask,
    costs=_costs,
    over=_over,
    move=_move,
    see=_see,
    seen_after=_seen_after,
    settle=_settle,
    remaining=_remaining,
    relaxed=_relaxed,
    preferred=_preferred,
)
"""The repair model; its data are the tables and the limits."""
