"""Compilation of hot functions, where it is possible."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from types import FunctionType, MethodType
from typing import Any

import torch

__all__ = ["compiled"]

# Reductions over the locations, unlike the compiler's own loops for them, are fast when written out.
_OPTIONS: dict[str, str | int | bool | Callable[..., Any]] = {"unroll_reductions_threshold": 64}


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """``torch.compile(function)`` for batches of any size; where it cannot be compiled a warning is given and it runs as it is.

    Compiling takes some ten seconds at the first call and needs a C++ compiler on a CPU. Results agree up to rounding.

    Args:
        function: a function of tensors and TensorDicts.

    Examples:
        >>> compiled(torch.neg)
        <function compiled.<locals>.call at ...>
    """
    fast: Callable[..., Any] | None = torch.compile(_own_code(function), dynamic=True, options=_OPTIONS)

    def call(*args: Any) -> Any:
        nonlocal fast
        if fast is not None:
            try:
                return fast(*args)
            except RuntimeError as error:
                # An error of the function itself is raised again by the plain call.
                reason = str(error).strip().splitlines()[0]
                fast = None
                result = function(*args)
                warnings.warn(f"compile=True has no effect, the step could not be compiled: {reason}", stacklevel=2)
                return result
        return function(*args)

    return call


def _own_code(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function`` with a code object of its own.

    The compiler counts by code object how often it has compiled, and gives up at a limit; the same function of many objects,
    such as the step of many rollouts, would reach it.
    """
    if isinstance(function, MethodType):
        return MethodType(_own_code(function.__func__), function.__self__)
    if not isinstance(function, FunctionType):
        return function
    copy = FunctionType(
        function.__code__.replace(), function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__kwdefaults__ = function.__kwdefaults__
    return copy
