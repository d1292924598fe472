"""The random numbers of :mod:`torchrl_pomdp.noise` and of scenarios, one at a time, for compiled loops.

They are those of the tensor functions to the last bit. Keys are unsigned here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchrl_pomdp.modules.scenarios import BITS, LARGEST, STEPS
from torchrl_pomdp.noise import FACTOR, GOLDEN, ROUNDS, STEP
from torchrl_pomdp.scalar.compiling import inner, outer

__all__ = ["CONTROLS", "Noise", "fold", "hash_numbers", "hash_words", "scenario_noise", "uniform", "variable_bit"]

_GOLDEN, _FIRST, _SECOND = np.uint64(GOLDEN), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_FACTOR, _STEP, _STEPS = np.uint64(FACTOR), np.uint64(STEP), np.uint64(STEPS)
CONTROLS = np.uint64(0x636F6E74)
"""Folded into a key, it sets the numbers of random controls apart from those of observations."""
_ONE, _HALF, _WORD, _ROUNDS, _BITS = np.uint64(1), np.uint64(16), np.uint64(0xFFFFFFFF), ROUNDS, BITS
_UNIT, _LARGEST = np.float32(2.0**-24), np.float32(LARGEST)


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


@inner
def _mix(x):
    x = (x ^ (x >> np.uint64(30))) * _FIRST
    x = (x ^ (x >> np.uint64(27))) * _SECOND
    return x ^ (x >> np.uint64(31))


@inner
def fold(key, data):
    """The key that :func:`torchrl_pomdp.noise.fold` derives, for unsigned ``key`` and ``data``."""
    return _mix(key + (data + _ONE) * _GOLDEN)


@inner
def uniform(key, counter):
    """The number that :func:`torchrl_pomdp.noise.uniform` gives, float32."""
    return np.float32(fold(key, counter) >> np.uint64(40)) * _UNIT


@inner
def _permuted(key, member, count):
    """The place that :func:`torchrl_pomdp.noise.permuted` gives."""
    place = (member + (np.int64(key >> np.uint64(40)) * count >> 24)) % count
    if count < 3:
        return place
    state = key
    for _ in range(_ROUNDS):
        state = state * _FACTOR + _STEP
        partner = (np.int64(state >> np.uint64(33)) * count >> 31) - place
        if partner < 0:
            partner += count
        bit = (state ^ (np.uint64(max(place, partner)) * _GOLDEN)) * _FIRST
        if bit >> np.uint64(63) != 0:
            place = partner
    return place


@inner
def variable_bit(name):
    """The bit by which a scenario remembers that a variable has been observed."""
    return _ONE << np.uint64(name % _BITS)


@inner
def scenario_noise(key, group, member, count, first, name, step):
    """The uniform of a scenario for the observation of a variable; see :meth:`~torchrl_pomdp.modules.scenarios.Scenarios.draw`.

    Args:
        key: of the trajectory.
        group: of the estimate.
        member: number of the trajectory in the estimate.
        count: number of trajectories of the estimate.
        first: whether the variable is observed for the first time.
        name: the variable.
        step: age of the trajectory times the number of robots, plus the robot's; -1 and the like before the start.
    """
    if not first:
        return uniform(key, _STEPS + np.uint64(step))
    noise = uniform(key, np.uint64(name))
    if count == 1:
        return noise
    place = np.float32(_permuted(fold(group, np.uint64(name)), member, count))
    return min((place + noise) / np.float32(count), _LARGEST)


@inner
def hash_numbers(total, bits, offset, double):
    """``total`` with the numbers ``bits``, entries from ``offset`` on, hashed into it; the last step is :func:`finished`.

    ``double``: whether they are the bits of numbers in double precision.
    """
    for i in range(len(bits)):
        number = np.uint64(bits[i])
        if double:
            number = _mix(number)
        total += number * (_mix(np.uint64(offset + i + 1)) | _ONE)
    return total


@outer
def hash_words(arrays):
    """Hash of several arrays of 32-bit words, uint32, as fast as they can be read."""
    total = np.uint64(0)
    for words in arrays:
        total = _mix(total)
        for i in range(len(words)):
            place = np.uint64(i) * _GOLDEN & _WORD
            total += np.uint64(words[i]) * (((place ^ (place >> _HALF)) * _SECOND & _WORD) | _ONE)
    return total


@inner
def finished(total):
    """The fingerprint that was summed in ``total``."""
    return _mix(total)
