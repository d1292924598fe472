"""A tabular model for tree searches: the operations of :mod:`torchrl_pomdp.scalar.models`, and twins of policies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_pomdp.scalar.compiling import inner
from torchrl_pomdp.scalar.models import ScalarModel
from torchrl_pomdp.scalar.noise import CONTROLS, Noise, fold, scenario_noise, uniform, variable_bit
from torchrl_pomdp.scalar.twins import choose, scalar_twin

__all__ = ["TabularHistory", "TabularTables", "TabularView", "myopic", "random", "tabular_model"]


class TabularTables(NamedTuple):
    """What searches read of a model.

    Attributes:
        transition: ``[U, n, n]``.
        observation: ``[U, n, Z]``.
        costs: ``[U, n]``.
        illegal: ``[n, U]``.
        going: whether a state is not terminal, ``[n]``.
        discount: of the model.
        max_steps: stages after which simulations end.
        least: no policy costs less from any state.
    """

    transition: NDArray[np.float64]
    observation: NDArray[np.float64]
    costs: NDArray[np.float64]
    illegal: NDArray[np.bool_]
    going: NDArray[np.bool_]
    discount: float
    max_steps: int
    least: float


class TabularHistory(NamedTuple):
    """The state of one history at a time.

    Attributes:
        root: belief at the root, ``[n]``.
        belief: ``[n]``.
        predicted: belief at the next stage before an observation, ``[n]``.
        probs: of the observations then, ``[Z]``.
        numbers: the stage, and the control that was taken, ``[2]``.
        controls: memory, ``[1]``.
        legal: memory, ``[U]``.
    """

    root: NDArray[np.float64]
    belief: NDArray[np.float64]
    predicted: NDArray[np.float64]
    probs: NDArray[np.float64]
    numbers: NDArray[np.int64]
    controls: NDArray[np.int64]
    legal: NDArray[np.bool_]


class TabularView(NamedTuple):
    """What a scalar twin sees of a simulated trajectory of a tabular model, see :func:`torchrl_pomdp.scalar.scalar_twin`.

    Attributes:
        stage: stages since the root.
        belief: ``[n]``.
        legal: the legal controls, ``[U]``.
        tables: the model.
        key: the trajectory's stream of random numbers, uint64.
    """

    stage: int
    belief: NDArray[np.float64]
    legal: NDArray[np.bool_]
    tables: TabularTables
    key: np.uint64


@inner
def _expected(values, belief):
    total = 0.0
    for i in range(len(belief)):
        if belief[i] > 0.0:
            total += belief[i] * values[i]
    return total


def _start(data, state):
    state.numbers[0] = 0
    for i in range(len(state.root)):
        state.belief[i] = state.root[i]


def _keep(data, state, row):
    row[0] = state.numbers[0]
    for i in range(len(state.belief)):
        row[1 + i] = state.belief[i]


def _recall(data, state, row):
    state.numbers[0] = np.int64(row[0])
    for i in range(len(state.belief)):
        state.belief[i] = row[1 + i]


@inner
def _legal(tables, belief, legal):
    for u in range(len(legal)):
        legal[u] = True
        for i in range(len(belief)):
            if belief[i] > 0.0 and tables.illegal[i, u]:
                legal[u] = False
                break


def _mask(data, state, legal):
    _legal(data[0], state.belief, legal)


def _costs(data, state, out):
    for u in range(len(out)):
        out[u] = _expected(data[0].costs[u], state.belief)


@inner
def _ended(tables, state):
    if state.numbers[0] >= tables.max_steps:
        return True
    going = 0
    for i in range(len(state.belief)):
        going += state.belief[i] > 0.0 and tables.going[i]
    return going == 0


def _over(data, state):
    return _ended(data[0], state)


@inner
def _take(tables, state, u):
    state.numbers[1] = u
    size = len(state.belief)
    for j in range(size):
        state.predicted[j] = 0.0
    for i in range(size):
        weight = state.belief[i]
        if weight > 0.0:
            for j in range(size):
                state.predicted[j] += weight * tables.transition[u, i, j]
    for z in range(len(state.probs)):
        state.probs[z] = 0.0
    for j in range(size):
        weight = state.predicted[j]
        if weight > 0.0:
            for z in range(len(state.probs)):
                state.probs[z] += weight * tables.observation[u, j, z]


def _move(data, state, u):
    _take(data[0], state, u)


@inner
def _observation(state, noise):
    """The observation that a scenario gives: its distribution function is inverted."""
    first = (noise.seen & variable_bit(0)) == 0
    number = scenario_noise(noise.key, noise.group, noise.member, noise.of, first, 0, state.numbers[0])
    total = 0.0
    for prob in state.probs:
        total += prob
    threshold, reached, possible = np.float64(number) * total, 0.0, 0
    for z in range(len(state.probs)):
        reached += state.probs[z]
        if state.probs[z] > 0.0:
            possible = z
            if reached > threshold:
                break
    return possible


def _see(data, state, noise):
    return _observation(state, noise)


def _seen_after(data, state, seen):
    return seen | variable_bit(0)


@inner
def _condition(tables, state, z):
    u, total = state.numbers[1], 0.0
    for j in range(len(state.belief)):
        state.belief[j] = state.predicted[j] * tables.observation[u, j, z]
        total += state.belief[j]
    for j in range(len(state.belief)):
        state.belief[j] /= total
    state.numbers[0] += 1


def _settle(data, state, z):
    _condition(data[0], state, z)


@inner
def _choice(tables, policy, state, key):
    """The control of a policy, and whether it is legal."""
    _legal(tables, state.belief, state.legal)
    choose(policy, TabularView(state.numbers[0], state.belief, state.legal, tables, key), state.controls)
    u = state.controls[0]
    return u, 0 <= u < len(state.legal) and state.legal[u]


def _remaining(data, policy, state, noise):
    (tables,) = data
    cost, weight, steps, seen = 0.0, 1.0, 0, noise.seen
    while not _ended(tables, state):
        u, well = _choice(tables, policy, state, noise.key)
        if not well:
            return cost, steps, False
        cost += weight * _expected(tables.costs[u], state.belief)
        _take(tables, state, u)
        z = _observation(state, Noise(noise.key, noise.group, noise.member, noise.of, seen))
        seen |= variable_bit(0)
        _condition(tables, state, z)
        weight *= tables.discount
        steps += 1
    return cost, steps, True


def _relaxed(data, state, noise):
    (tables,) = data
    lowest = np.inf
    _legal(tables, state.belief, state.legal)
    for u in range(len(state.legal)):
        if state.legal[u]:
            lowest = min(lowest, _expected(tables.costs[u], state.belief))
    return lowest + tables.discount * tables.least


def _preferred(data, policy, state):
    u, well = _choice(data[0], policy, state, np.uint64(0))
    return u if well else -1


tabular_model = ScalarModel(
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
"""A tabular model; its data are the tables."""


@scalar_twin
def random(data, view, controls):
    """Any legal control, all equally likely."""
    number, count = uniform(fold(view.key, CONTROLS), np.uint64(view.stage)), 0
    for flag in view.legal:
        count += flag
    left = np.int64(number * np.float32(count))
    for u in range(len(view.legal)):
        if view.legal[u]:
            controls[0] = u
            left -= 1
            if left < 0:
                break


@scalar_twin
def myopic(data, view, controls):
    """The legal control of least stage cost, the first of equal ones."""
    lowest = np.inf
    for u in range(len(view.legal)):
        if view.legal[u]:
            cost = _expected(view.tables.costs[u], view.belief)
            if cost < lowest:
                lowest, controls[0] = cost, u
