"""Compilation of hot functions, where it is possible."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch

__all__ = ["compiled"]


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """``torch.compile(function)`` for batches of any size; where it cannot be compiled a warning is given and it runs as it is.

    Compiling takes some ten seconds at the first call and needs a C++ compiler on a CPU. Results agree up to rounding.

    Args:
        function: a function of tensors and TensorDicts.

    Examples:
        >>> compiled(torch.neg)
        <function compiled.<locals>.call at ...>
    """
    fast: Callable[..., Any] | None = torch.compile(function, dynamic=True)

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
