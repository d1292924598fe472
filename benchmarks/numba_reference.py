"""The greedy rollout on a line as a hand-written scalar loop: what one core does when nothing general is asked of it."""

from __future__ import annotations

import numba
import numpy as np

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


@numba.njit(inline="always")
def _uniform(key, counter):
    x = key + (counter + np.uint64(1)) * _GOLDEN
    x = (x ^ (x >> np.uint64(30))) * _FIRST
    x = (x ^ (x >> np.uint64(27))) * _SECOND
    x = x ^ (x >> np.uint64(31))
    return np.float32(x >> np.uint64(40)) * np.float32(2.0**-24)


@numba.njit(inline="always")
def _greedy(intact, place, size):
    """-1 left, 0 repair, 1 right: the nearest possibly damaged location, ties to the lower index."""
    if intact[place] < 1.0:
        return 0
    for distance in range(1, size):
        if place - distance >= 0 and intact[place - distance] < 1.0:
            return -1
        if place + distance < size and intact[place + distance] < 1.0:
            return 1
    return -1 if place > 0 else 1


@numba.njit(fastmath=False)
def greedy_rollout(beliefs, places, keys, rise, costs, discount, max_steps, terminal_probability):
    """Discounted costs ``[N]`` and the number of belief steps, of planes ``[N, K, L]`` that are overwritten."""
    count, levels, size = beliefs.shape
    total = np.zeros(count, np.float32)
    steps = 0
    for row in range(count):
        belief, place, weight, seen = beliefs[row], places[row], np.float32(1.0), np.uint64(0)
        for step in range(max_steps):
            intact = np.float32(1.0)
            for location in range(size):
                intact *= belief[0, location]
            if np.float32(1.0) - intact <= terminal_probability:
                break
            steps += 1
            control = _greedy(belief[0], place, size)
            cost = np.float32(0.0)
            for level in range(levels - 1, 0, -1):
                stay, come, price = np.float32(1.0) - rise[level], rise[level - 1], costs[level]
                for location in range(size):
                    here = belief[level, location]
                    cost += here * price
                    belief[level, location] = here * stay + belief[level - 1, location] * come
            for location in range(size):
                cost += belief[0, location] * costs[0]
                belief[0, location] *= np.float32(1.0) - rise[0]
            total[row] += weight * cost
            weight *= discount
            place += control
            observed = 0
            bit = np.uint64(1) << np.uint64(place % 63)
            if control != 0:
                # The first observation of a location is the scenario's, later ones are the step's.
                counter = np.uint64(place) if seen & bit == 0 else np.uint64(1 << 32) + np.uint64(step)
                threshold, cumulative = _uniform(keys[row], counter), belief[0, place]
                while observed < levels - 1 and cumulative <= threshold:
                    observed += 1
                    cumulative += belief[observed, place]
            seen |= bit
            for level in range(levels):
                belief[level, place] = np.float32(1.0) if level == observed else np.float32(0.0)
    return total, steps
