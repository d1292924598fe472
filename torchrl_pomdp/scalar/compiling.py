"""Compiled functions for fixed types of arguments: kept on disk, called without delay."""

from __future__ import annotations

import builtins
import dis
import logging
import sys
from collections.abc import Callable
from functools import cache
from threading import Timer
from types import FunctionType
from typing import Any

from numba import njit, typeof

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.identity import digest

__all__ = ["OPTIONS", "Loops", "code_digest", "entry", "inner", "outer", "products", "shared"]

_LOG = logging.getLogger(__name__)
# A compilation that takes longer, in seconds, is announced.
_SOON = 1.0

# Without reference counts: they cost more than the simulation, and nothing is allocated in a loop.
_BARE: dict[str, Any] = {"_nrt": False}
# Nobody calls a part of a loop but the loop: half of the time of compiling it would be spent on that.
_PART: dict[str, Any] = {"error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True, **_BARE}
OPTIONS: dict[str, Any] = {"forceinline": True, **_PART}
"""Options of a part of a loop."""


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a part of a loop, which becomes part of the code that calls it."""
    return _compiled(function, **OPTIONS)


def outer(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a loop, which other threads run beside."""
    return _compiled(function, error_model="numpy", nogil=True, **_BARE)


def shared(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a large part of several loops, which is compiled once and called."""
    return _compiled(function, **_PART)


def products(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile sums of products, which may be rounded once instead of twice."""
    return _compiled(function, fastmath={"contract"}, **_PART)


def _compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Compile a function; loops and their parts are kept on disk, so that a new policy alone is compiled in a new process.

    They are kept by name, which a digest of the code in them makes another one when that changes.
    """
    function = _as_it_is(check_instance("function", function, FunctionType))
    # Names of files may not be long.
    function.__qualname__ = f"{function.__name__[:64]}_{code_digest(function)}"
    compiled: Callable[..., Any]
    try:
        compiled = njit(cache=True, **options)(function)
    except RuntimeError:
        # There is no folder that can be written: each process compiles for itself.
        compiled = njit(**options)(function)
    if "." not in function.__code__.co_qualname:
        # It may call itself.
        function.__globals__[function.__name__] = compiled
    return compiled


def _as_it_is(function: FunctionType) -> FunctionType:
    """A copy that reads globals as they are now: numba reads them when it compiles, which is later than the digest.

    Raises:
        NameError: if it reads one that is not defined yet.
    """
    known = {function.__name__, *function.__globals__, *dir(builtins)}
    for each in dis.get_instructions(function):
        if each.opname == "LOAD_GLOBAL" and each.argval not in known:
            raise NameError(f"{function.__name__} reads {each.argval}, which must be defined above it: it is compiled as it is")
    copy = FunctionType(
        function.__code__, {**function.__globals__}, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__kwdefaults__, copy.__doc__ = function.__kwdefaults__, function.__doc__
    # Numba imports the module when it reads compiled code from disk; what ``exec`` defines may name one that is not there.
    copy.__module__ = function.__module__ if function.__module__ in sys.modules else "__main__"
    copy.__dict__.update(function.__dict__)
    return copy


def entry(function: Any, *args: Any) -> Callable[..., Any]:
    """A compiled loop for arguments of the types of ``args`` alone, compiled now or read from disk.

    Looking at the types of dozens of arguments takes longer than a decision; what is returned does not.

    Args:
        function: a loop made by :func:`outer`.
        args: examples of its arguments.
    """
    timer = Timer(_SOON, _announce)
    timer.daemon = True
    timer.start()
    try:
        compiled: Callable[..., Any] = function.compile(tuple(map(typeof, args)))
    finally:
        timer.cancel()
        timer.join()
    return compiled


@cache
def _announce() -> None:
    """Say once in a process what takes so long."""
    _LOG.warning("preparing compiled simulations: the first time up to 20 seconds for each kind of policy, later some seconds")


class Loops:
    """Compiled loops that are called again and again with arguments of the same types and memory layouts.

    Nothing checks these after the first call.
    """

    def __init__(self) -> None:
        self._entries: dict[Any, Callable[..., Any]] = {}

    def __call__(self, function: Any, *args: Any) -> Any:
        """What ``function``, a loop made by :func:`outer`, gives for the arguments."""
        if function not in self._entries:
            self._entries[function] = entry(function, *args)
        return self._entries[function](*args)


def code_digest(function: Any) -> str:
    """Digest of a function's code, and of all that it reads: functions, records, numbers, attributes of modules.

    Raises:
        TypeError: if it reads what cannot be told, such as an open file.
    """
    return digest(function, libraries=True)[:16]
