"""Counter-based random numbers: every uniform is a pure function of integers.

Common random numbers need noise that belongs to *(seed, state, trajectory, step)* and not to a generator, a worker or a
batch split. SplitMix64 (Steele, Lea and Flood 2014) on int64 tensors gives exactly that: a 64-bit key identifies a
stream, a counter the number within it, and nothing has a state that could be advanced by accident.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_integer
from torchrl_pomdp.tensor_checks import check_keys, device_of

__all__ = ["fingerprint", "fold", "permuted", "seed_keys", "uniform"]


def _signed(value: int) -> int:
    """The int64 with the same 64 bits as ``value`` modulo 2**64."""
    value %= 1 << 64
    return value - (1 << 64) if value >= 1 << 63 else value


GOLDEN = 0x9E3779B97F4A7C15
_FIRST, _SECOND = _signed(0xBF58476D1CE4E5B9), _signed(0x94D049BB133111EB)
_LOW_34, _LOW_37, _LOW_33 = (1 << 34) - 1, (1 << 37) - 1, (1 << 33) - 1
_UNIT = 2.0**-24
# Rounds of a permutation: pairs of members that no round tells apart are a fraction of 4**-12. Their numbers come from Knuth's
# linear congruential generator.
ROUNDS, FACTOR, STEP = 12, 6364136223846793005, 1442695040888963407


def _mix(x: Tensor) -> Tensor:
    """SplitMix64's finaliser, a bijection of 64-bit integers (``>>`` is arithmetic, the masks make it logical)."""
    x = (x ^ ((x >> 30) & _LOW_34)) * _FIRST
    x = (x ^ ((x >> 27) & _LOW_37)) * _SECOND
    return x ^ ((x >> 31) & _LOW_33)


def fold(keys: Tensor, data: int | Tensor) -> Tensor:
    """Derive new keys from ``keys`` and integer ``data``, elementwise with broadcasting.

    Args:
        keys: int64 ``[*B]``.
        data: an integer, or int64 broadcastable with ``keys``.

    Returns:
        int64 keys of the broadcast shape.

    Examples:
        >>> fold(torch.tensor([1, 2]), 7).tolist() == [int(fold(torch.tensor(k), 7)) for k in (1, 2)]
        True
    """
    step = _signed((data + 1) * GOLDEN) if isinstance(data, int) else (data + 1) * _signed(GOLDEN)
    return _mix(keys + step)


def uniform(keys: Tensor, counter: int | Tensor) -> Tensor:
    """The uniform number with index ``counter`` in the stream of each key.

    Args:
        keys: int64 ``[*B]``.
        counter: an integer, or int64 broadcastable with ``keys``.

    Returns:
        float32 in [0, 1), of 24 random bits, so that 1 - 2**-24 is the largest value.

    Examples:
        >>> u = uniform(torch.arange(100_000), 0)
        >>> bool((u >= 0).all() and (u < 1).all()), round(float(u.mean()), 2)
        (True, 0.5)
    """
    return ((fold(keys, counter) >> 40) & 0xFFFFFF).to(torch.float32) * _UNIT


def permuted(keys: Tensor, members: Tensor, count: int) -> Tensor:
    """Places of ``members`` in random permutations of 0..count-1, one permutation for each key.

    A rotation, then rounds of the swap-or-not shuffle (Hoang, Morris and Rogaway 2012), which computes the place of one member
    without the others. The rotation alone makes every place equally likely, and is all there is to permute for two members.

    Args:
        keys: int64 ``[*B]`` as :func:`fold` gives them; equal keys have the same permutation, different ones independent ones.
        members: int64 ``[*B]`` in 0..count-1.
        count: number of members, at most 2**24.

    Returns:
        int64 ``[*B]`` in 0..count-1.

    Examples:
        >>> sorted(permuted(torch.full((5,), 7), torch.arange(5), 5).tolist())
        [0, 1, 2, 3, 4]
    """
    place = (members + (((keys >> 40) & 0xFFFFFF) * count >> 24)) % count
    if count < 3:
        return place
    state = keys
    for _ in range(ROUNDS):
        state = state * FACTOR + STEP
        partner = (((state >> 33) & 0x7FFFFFFF) * count >> 31) - place
        partner = partner + (count & (partner >> 63))
        # A pair is swapped, or not, by a bit of its larger place.
        swap = (state ^ torch.maximum(place, partner) * _signed(GOLDEN)) * _FIRST < 0
        place = torch.where(swap, partner, place)
    return place


def seed_keys(seed: int, index: Tensor) -> Tensor:
    """Keys of items ``index`` under ``seed``: the same item has the same key in whichever batch it is drawn.

    Args:
        seed: any integer.
        index: int64 ``[*B]``.

    Returns:
        int64 ``[*B]``.

    Raises:
        TypeError: if ``seed`` is no integer or ``index`` no int64 tensor.

    Examples:
        >>> torch.equal(seed_keys(3, torch.arange(10))[4:], seed_keys(3, torch.arange(4, 10)))
        True
    """
    seed = check_integer("seed", seed)
    return fold(fold(torch.full_like(check_keys("index", index), _signed(seed)), 0), index)


def fingerprint(y: TensorDictBase) -> Tensor:
    """Hash the content of every row of ``y`` to a key: equal rows have equal keys, in any batch and memory layout.

    It makes the noise of a planner a function of the feature state itself, so that a decision can be computed again
    from a stored state alone.

    Args:
        y: feature states ``[*B]``.

    Returns:
        int64 ``[*B]``.

    Examples:
        >>> from tensordict import TensorDict
        >>> y = TensorDict({"belief": torch.rand(6, 3)}, [6])
        >>> torch.equal(fingerprint(y)[2:5], fingerprint(y[2:5]))
        True
    """
    total = torch.zeros(y.batch_size, dtype=torch.int64, device=device_of(y))
    offset = 0
    for key in sorted(y.keys(include_nested=True, leaves_only=True), key=str):
        leaf = y.get(key)
        double = leaf.dtype == torch.float64
        if leaf.is_floating_point():
            # Adding zero turns -0.0, which compares equal to 0.0, into 0.0.
            leaf = (leaf + 0.0).contiguous().view(torch.int64 if double else torch.int32)
        bits = leaf.reshape(*y.batch_size, leaf.shape[y.ndim :].numel()).to(torch.int64)
        if double:
            # The low bits of numbers such as 0.5 and 1 are all zero, and those of sums of their multiples would be.
            bits = _mix(bits)
        index = torch.arange(offset, offset + bits.shape[-1], device=bits.device)
        total = total + (bits * (_mix(index + 1) | 1)).sum(-1)
        offset += bits.shape[-1]
    return _mix(total)
