"""Feature states of the repair problem, one by one: whether they are any, and what tells them apart."""

from __future__ import annotations

import numpy as np

from torchrl_pomdp.scalar.compiling import outer
from torchrl_pomdp.scalar.noise import finished, fold, hash_numbers

__all__ = ["fingerprints", "valid"]


@outer
def fingerprints(bits, locations, seed, keys):
    """Put into ``keys`` ``[N]`` the keys of scenarios of feature states, as ``RolloutPolicy.keys`` gives them.

    Args:
        bits: of the beliefs, as integers, ``[N, L * K]``.
        locations: ``[N, R]``.
        seed: of the simulations, unsigned.
        keys: uint64 ``[N]``.
    """
    for row in range(len(keys)):
        total = hash_numbers(np.uint64(0), bits[row], 0, bits.itemsize == 8)
        total = hash_numbers(total, locations[row], bits.shape[1], False)
        keys[row] = fold(finished(total), seed)


@outer
def valid(beliefs, locations, tolerance):
    """Whether these are feature states: marginals ``[N, L, K]`` are distributions, locations ``[N, R]`` of the graph."""
    size = beliefs.shape[1]
    for row in range(beliefs.shape[0]):
        for place in range(size):
            total = 0.0
            for k in range(beliefs.shape[2]):
                if not beliefs[row, place, k] >= 0.0:
                    return False
                total += beliefs[row, place, k]
            if not abs(total - 1.0) <= tolerance:
                return False
        for robot in range(locations.shape[1]):
            if not 0 <= locations[row, robot] < size:
                return False
    return True
