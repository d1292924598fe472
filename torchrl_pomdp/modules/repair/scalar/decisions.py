"""Q-factors of the repair problem by compiled simulations: all candidates of a state in the same scenarios.

A candidate is a joint control, given as those of the robots: there may be far too many joint controls to number.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_pomdp.modules.repair.scalar.trajectories import FINE, ILLEGAL, NEVER, set_initial, trajectory
from torchrl_pomdp.modules.repair.scalar.view import legal_at, split
from torchrl_pomdp.scalar.compiling import inner, outer
from torchrl_pomdp.scalar.noise import Noise, fold

__all__ = ["Decisions", "decide"]


class Decisions(NamedTuple):
    """States to decide in, and what is known of their Q-factors.

    Attributes:
        beliefs: ``[N, L, K]``.
        locations: ``[N, R]``.
        keys: uint64 ``[N]``.
        controls: the candidates, ``[N, C, R]``.
        legal: gets which of them are legal, bool ``[N, C]``.
        costs: of the trajectories that have been made, ``[N, n, C]``.
        made: how many each candidate has, ``[N, C]``; all zero for new states.
        rivals: the candidates that get more, bool ``[N, C]``; set for new states.
        q: gets the Q-factors, ``[N, C]``.
    """

    beliefs: NDArray[np.float64]
    locations: NDArray[np.int64]
    keys: NDArray[np.uint64]
    controls: NDArray[np.int64]
    legal: NDArray[np.bool_]
    costs: NDArray[np.float64]
    made: NDArray[np.int64]
    rivals: NDArray[np.bool_]
    q: NDArray[np.float64]


@inner
def _largest(values):
    largest = values[0]
    for value in values:
        largest = max(largest, value)
    return largest


@inner
def _some(flags):
    number = 0
    for flag in flags:
        number += flag
    return number > 0


@inner
def _control_mask(tables, precision, start, location, controls, mask):
    """Put into ``mask`` ``[C]`` which candidates ``[C, R]`` are legal; ``precision`` is the model's type of numbers."""
    for u in range(len(mask)):
        fits = True
        for robot in range(len(location)):
            place = location[robot]
            fits = fits and legal_at(tables, place, precision(start[place, 0]) == 1.0, controls[u, robot])
        mask[u] = fits


@inner
def _observation_weight(tables, work, start, origin):
    """Probability that the robots see ``work.seen`` after ``work.controls``."""
    weight, robots = 1.0, len(origin)
    for robot in range(robots):
        place = tables.destinations[origin[robot], work.controls[robot]]
        level, fixed = work.seen[robot], False
        together = -1
        for other in range(robots):
            if tables.destinations[origin[other], work.controls[other]] == place:
                fixed = fixed or work.controls[other] == 0
                if other < robot:
                    together = work.seen[other]
        if together >= 0:
            weight *= 1.0 if together == level else 0.0
        elif fixed and tables.works == 1.0:
            weight *= 1.0 if level == 0 else 0.0
        else:
            seen = 0.0
            for k in range(start.shape[1]):
                seen += start[place, k] * tables.powers[tables.kind[place], 1, k, level]
            if fixed:
                seen = (1.0 - tables.works) * seen + (tables.works if level == 0 else 0.0)
            weight *= seen
    return weight


@inner
def _pair_cost(policy, tables, limits, work, start, origin, control, noise, observations):
    """Cost of a candidate ``[R]`` and what follows it: in one trajectory, or in one from each observation, weighted."""
    levels, robots = start.shape[1], len(origin)
    total, steps = 0.0, 0
    for z in range(levels**robots if observations else 1):
        for robot in range(robots):
            work.controls[robot] = control[robot]
        weight = 1.0
        if observations:
            split(z, levels, work.seen)
            weight = _observation_weight(tables, work, start, origin)
        if weight > 0.0:
            cost, made, _, _, state = trajectory(policy, tables, limits, NEVER, work, start, origin, True, observations, noise)
            if state == ILLEGAL:
                return total, steps, state
            steps += made
            total += weight * cost
    return total, steps, FINE


@inner
def _drop_beaten(costs, spent, rivals, clearly):
    """Take from ``rivals`` ``[C]`` what ``costs`` ``[n, C]`` show to be clearly beaten, as ``lookahead._rivals`` does."""
    best, lowest = -1, np.inf
    for u in range(len(rivals)):
        if rivals[u]:
            mean = 0.0
            for i in range(spent):
                mean += costs[i, u]
            if mean < lowest:
                best, lowest = u, mean
    left = 0
    for u in range(len(rivals)):
        if not rivals[u]:
            continue
        gap = 0.0
        for i in range(spent):
            gap += costs[i, u] - costs[i, best]
        gap /= spent
        mean = gap * (spent - 1) / (spent + 1)
        variance = (-gap - mean) ** 2
        for i in range(spent):
            variance += (costs[i, u] - costs[i, best] - mean) ** 2
        variance /= spent
        rivals[u] = not mean > clearly * np.sqrt(variance / (spent + 1))
        left += rivals[u]
    if left <= 1:
        for u in range(len(rivals)):
            rivals[u] = False


@inner
def _combine(costs, made, mask, q):
    """Q-factors ``[C]`` from ``costs`` ``[n, C]``, of which each candidate has some, as ``lookahead._combine`` does."""
    most = _largest(made)
    best = -1
    for u in range(len(q)):
        q[u] = np.inf
        if mask[u] and made[u] == most:
            total = 0.0
            for i in range(most):
                total += costs[i, u]
            q[u] = total / most
            if best < 0 or q[u] < q[best]:
                best = u
    for u in range(len(q)):
        if mask[u] and made[u] < most:
            gap = 0.0
            for i in range(made[u]):
                gap += costs[i, u] - costs[i, best]
            q[u] = q[best] + gap / made[u]


@outer
def decide(policy, tables, limits, work, states, order, rounds, observations, clearly, largest):
    """Q-factors of states, or better ones of states that have been looked at before.

    Args:
        policy: pair of twin and data.
        tables: the model.
        limits: when trajectories end, with a terminal cost in closed form.
        work: memory.
        states: the states.
        order: the trajectories in the order in which they are made, ``[n]``.
        rounds: numbers of trajectories of each round now, of all ``n`` that there may be.
        observations: whether a leaf is an observation.
        clearly: standard errors by which a control is beaten; infinite: none ever is.
        largest: the largest number of the model's type.

    Returns:
        the number of steps, the state where a control was illegal, or -1, and whether all Q-factors of legal controls are
        finite.
    """
    steps, finite, nothing_seen = 0, True, np.uint64(0)
    for row in range(len(states.keys)):
        start, origin, key = states.beliefs[row], states.locations[row], states.keys[row]
        costs, made, rivals = states.costs[row], states.made[row], states.rivals[row]
        controls, mask = states.controls[row], states.legal[row]
        set_initial(start, work.initial)
        _control_mask(tables, work.intact.dtype.type, start, origin, controls, mask)
        spent = _largest(made)
        if spent == 0:
            for u in range(len(rivals)):
                rivals[u] = mask[u]
        for each in rounds:
            for u in range(len(rivals)):
                if not rivals[u]:
                    continue
                for i in range(spent, spent + each):
                    noise = Noise(fold(key, np.uint64(order[i])), key, order[i], len(order), nothing_seen)
                    cost, more, state = _pair_cost(
                        policy, tables, limits, work, start, origin, controls[u], noise, observations
                    )
                    if state == ILLEGAL:
                        return steps, row, True
                    costs[i, u] = cost
                    steps += more
                made[u] += each
            spent += each
            if clearly < np.inf and spent > 1:
                _drop_beaten(costs, spent, rivals, clearly)
            if not _some(rivals):
                break
        q = states.q[row]
        _combine(costs, made, mask, q)
        for u in range(len(q)):
            finite = finite and (not mask[u] or abs(q[u]) <= largest)
    return steps, -1, finite
