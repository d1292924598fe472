"""The checks of :mod:`torchrl_pomdp.checks` that are about tensors."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_pomdp.checks import shown

__all__ = ["check_entries"]


def check_entries(name: str, value: Any, keys: Iterable[NestedKey]) -> TensorDictBase:
    """A TensorDict that has some entries; their shapes are not looked at, which costs nothing at every step of a simulation.

    Raises:
        TypeError: if it is no TensorDict.
        ValueError: if an entry is missing.

    Examples:
        >>> check_entries("y", {}, ["belief"])
        Traceback (most recent call last):
        TypeError: y must be a TensorDict, got {}
    """
    if not isinstance(value, TensorDictBase):
        raise TypeError(f"{name} must be a TensorDict, got {shown(value)}")
    for key in keys:
        if not isinstance(value.get(key, None), Tensor):
            raise ValueError(f"{name} lacks the entry {key!r}")
    return value
