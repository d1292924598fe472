"""Names of controls and observations, for people and robots; inside they are numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_pomdp.checks import check_choice, check_integer, check_sequence

__all__ = ["name_of", "number_of"]


def name_of(number: int, names: Sequence[str] | None) -> str:
    """The name of a control or observation; its number where there are no names.

    Examples:
        >>> name_of(1, ("listen", "open left")), name_of(1, None)
        ('open left', '1')
    """
    return str(number) if names is None else names[number]


def number_of(what: str, given: Any, names: Sequence[str] | None, count: int) -> int:
    """The number of a control or observation that is given by number or name.

    Args:
        what: name of the argument.
        given: a number, also as a tensor of no dimension, or a name.
        names: the names, where there are some.
        count: how many there are.

    Raises:
        TypeError: if it is neither.
        ValueError: if there is no such control or observation; the message says which there are.

    Examples:
        >>> number_of("control", "listen", ("listen", "open left"), 2)
        0
        >>> number_of("observation", torch.tensor(1), None, 2)
        1
        >>> number_of("observation", 5, None, 2)
        Traceback (most recent call last):
        ValueError: observation must be at most 1, got 5
    """
    if names is not None:
        check_sequence(f"names of {what}s", names, str, count)
    if isinstance(given, Tensor) and given.shape == () and given.dtype == torch.int64:
        given = int(given)
    if not isinstance(given, str):
        return check_integer(what, given, 0, count - 1)
    if names is None:
        raise ValueError(f"{what} must be a number in 0..{count - 1}, got {given!r}: the model has no names for it")
    return list(names).index(check_choice(what, given, names))
