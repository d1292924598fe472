"""One vocabulary of checks on what callers give, so that every refusal names the argument, what was given and what is allowed.

A wrong kind of thing is a ``TypeError``, a wrong value a ``ValueError``. PyTorch is imported when a tensor is checked, not
before: the command line checks its numbers without it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any

__all__ = [
    "check_callable",
    "check_choice",
    "check_flag",
    "check_instance",
    "check_integer",
    "check_label",
    "check_mapping",
    "check_number",
    "check_path",
    "check_seed",
    "check_sequence",
    "check_sizes",
    "check_text",
]


def shown(value: Any) -> str:
    """A short text of what was given, for messages.

    Examples:
        >>> shown("x" * 100)
        "'xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx..."
    """
    if (
        not isinstance(value, type)
        and type(value).__module__.startswith(("torch", "tensordict"))
        and hasattr(value, "shape")
        and getattr(value, "ndim", False)
    ):
        return f"a {type(value).__name__} of shape {tuple(value.shape)}"
    try:
        text = " ".join(repr(value).split())
    except Exception:  # a foreign object may fail to say what it is
        text = f"a {type(value).__name__}"
    return text if len(text) <= 60 else f"{text[:58]}..."


def check_integer(name: str, value: Any, least: int | None = None, most: int | None = None) -> int:
    """An integer within bounds, as ``int``.

    Args:
        name: name of the argument.
        value: what was given; booleans are no integers.
        least: smallest value allowed.
        most: largest value allowed.

    Raises:
        TypeError: if it is no integer.
        ValueError: if it is out of bounds.

    Examples:
        >>> check_integer("states", 3, 1)
        3
        >>> check_integer("states", 0, 1)
        Traceback (most recent call last):
        ValueError: states must be at least 1, got 0
    """
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise TypeError(f"{name} must be an integer, got {shown(value)}")
    number = int(value)
    if least is not None and number < least:
        raise ValueError(f"{name} must be at least {least}, got {shown(value)}")
    if most is not None and number > most:
        raise ValueError(f"{name} must be at most {most}, got {shown(value)}")
    return number


def check_seed(name: str, value: Any) -> int:
    """A seed: any integer that PyTorch's generators take, 0 to 2**63 - 1.

    Raises:
        TypeError: if it is no integer.
        ValueError: if it is out of bounds.

    Examples:
        >>> check_seed("seed", 7)
        7
    """
    return check_integer(name, value, 0, 2**63 - 1)


def check_number(name: str, value: Any, interval: str = "(-inf, inf)") -> float:
    """A finite number in an interval, as ``float``.

    Args:
        name: name of the argument.
        value: what was given; booleans are no numbers.
        interval: such as ``"[0, 1)"`` or ``"(0, inf)"``.

    Raises:
        TypeError: if it is no number.
        ValueError: if it is not finite or lies outside.

    Examples:
        >>> check_number("discount", 0.9, "(0, 1)")
        0.9
        >>> check_number("discount", 1, "(0, 1)")
        Traceback (most recent call last):
        ValueError: discount must be in (0, 1), got 1
    """
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number in {interval}, got {shown(value)}")
    low, high = (float(bound) for bound in interval[1:-1].split(","))
    try:
        number = float(value)
    except OverflowError:  # an integer that is no float
        number = math.inf
    above = low < number or (interval[0] == "[" and number == low)
    below = number < high or (interval[-1] == "]" and number == high)
    if interval == "[0, inf)" and number < 0:
        raise ValueError(f"{name} must not be negative, got {shown(value)}")
    if not (above and below and math.isfinite(number)):
        raise ValueError(f"{name} must be in {interval}, got {shown(value)}")
    return number


def check_flag(name: str, value: Any) -> bool:
    """True or False.

    Raises:
        TypeError: if it is neither.

    Examples:
        >>> check_flag("progress", True)
        True
    """
    if not isinstance(value, bool):
        raise TypeError(f"{name} must be True or False, got {shown(value)}")
    return value


def check_choice(name: str, value: Any, allowed: Iterable[str]) -> str:
    """One of several names.

    Raises:
        TypeError: if it is no text.
        ValueError: if it is not among them; the message lists them.

    Examples:
        >>> check_choice("loss", "l3", ("l1", "l2"))
        Traceback (most recent call last):
        ValueError: loss must be one of l1, l2, got 'l3'
    """
    allowed = list(allowed)
    message = f"{name} must be one of {', '.join(allowed)}, got {shown(value)}"
    if not isinstance(value, str):
        raise TypeError(message)
    if value not in allowed:
        raise ValueError(message)
    return value


def check_text(name: str, value: Any) -> str:
    """A text of one line that a terminal can show.

    Raises:
        TypeError: if it is no text.
        ValueError: if it is empty or holds characters that are not printable.

    Examples:
        >>> check_text("name", "line of 3")
        'line of 3'
    """
    if not isinstance(value, str):
        raise TypeError(f"{name} must be a text, got {shown(value)}")
    if not value or not value.isprintable():
        raise ValueError(f"{name} must be a text of printable characters, got {shown(value)}")
    return value


def check_label(name: str, value: Any) -> str:
    """A text that files and folders are called by: at most 100 bytes of UTF-8, not beginning with a dot, no slashes.

    Raises:
        TypeError: if it is no text.
        ValueError: if it is no such text.

    Examples:
        >>> check_label("name", "5 x 4 grid")
        '5 x 4 grid'
        >>> check_label("name", "../x")
        Traceback (most recent call last):
        ValueError: name must have at most 100 bytes in UTF-8, no slash, and no dot in front, ...
    """
    if len(check_text(name, value).encode()) > 100 or value.startswith(".") or set(value) & set("/\\"):
        rule = "at most 100 bytes in UTF-8, no slash, and no dot in front, since files are called by it"
        raise ValueError(f"{name} must have {rule}, got {shown(value)}")
    return value


def check_path(name: str, value: Any) -> Path:
    """A path, from a text or a path.

    Raises:
        TypeError: if it is neither.
        ValueError: if it is empty or no path can be so.

    Examples:
        >>> check_path("out", "runs/first").name
        'first'
    """
    if not isinstance(value, (str, os.PathLike)):
        raise TypeError(f"{name} must be a path, got {shown(value)}")
    text = os.fspath(value)
    if not isinstance(text, str):
        raise TypeError(f"{name} must be a path, got {shown(value)}")
    if not text.strip() or "\0" in text:
        raise ValueError(f"{name} must be a path, got {shown(text)}")
    return Path(text)


def check_instance(name: str, value: Any, kind: type | tuple[type, ...]) -> Any:
    """An object of a class, or of one of several.

    Raises:
        TypeError: if it is of another class.

    Examples:
        >>> check_instance("number", 3, int)
        3
    """
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        raise TypeError(f"{name} must be a {' or '.join(k.__name__ for k in kinds)}, got {shown(value)}")
    return value


def check_callable(name: str, value: Any) -> Any:
    """Something that can be called.

    Raises:
        TypeError: if it cannot.

    Examples:
        >>> check_callable("policy", len)
        <built-in function len>
    """
    if not callable(value):
        raise TypeError(f"{name} must be callable, got {shown(value)}")
    return value


def check_sequence(name: str, value: Any, kind: type, least: int = 0) -> Sequence[Any]:
    """A sequence of objects of a class; a text is none.

    Args:
        name: name of the argument.
        value: what was given.
        kind: class of its members.
        least: how many there are at least.

    Raises:
        TypeError: if it is no sequence, or a member is of another class.
        ValueError: if there are too few.

    Examples:
        >>> check_sequence("problems", ("line3", 3), str)
        Traceback (most recent call last):
        TypeError: problems[1] must be a str, got 3
    """
    if isinstance(value, (str, bytes)) or not isinstance(value, Sequence):
        raise TypeError(f"{name} must be a sequence of {kind.__name__}, got {shown(value)}")
    if len(value) < least:
        raise ValueError(f"{name} must hold at least {least} {kind.__name__}, got {shown(value)}")
    for i, member in enumerate(value):
        check_instance(f"{name}[{i}]", member, kind)
    return value


def check_mapping(name: str, value: Any, kind: type | tuple[type, ...]) -> Mapping[str, Any]:
    """A mapping from texts to objects of a class.

    Raises:
        TypeError: if it is none.

    Examples:
        >>> check_mapping("costs", {"greedy": 3}, float)
        Traceback (most recent call last):
        TypeError: costs['greedy'] must be a float, got 3
    """
    if not isinstance(value, Mapping):
        raise TypeError(f"{name} must be a mapping from names, got {shown(value)}")
    for key, member in value.items():
        check_instance(f"key of {name}", key, str)
        check_instance(f"{name}[{shown(key)}]", member, kind)
    return value


def check_sizes(name: str, value: Any, most: int = 1 << 20) -> tuple[int, ...]:
    """Sizes of layers: at least one positive integer.

    Raises:
        TypeError: if it is no sequence of integers.
        ValueError: if it is empty or a size is out of bounds.

    Examples:
        >>> check_sizes("hidden", [256, 64])
        (256, 64)
    """
    if isinstance(value, (str, bytes)) or not isinstance(value, Sequence):
        raise TypeError(f"{name} must be a sequence of positive integers, got {shown(value)}")
    if not value:
        raise ValueError(f"{name} must hold at least one positive integer, got {shown(value)}")
    return tuple(check_integer(f"{name}[{i}]", size, 1, most) for i, size in enumerate(value))
