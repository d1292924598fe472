"""Sums and products whose rounding does not depend on the batch.

A label must be a function of its state alone, to the last bit. Libraries add a column's numbers in an order that depends on
the size of the batch and on the column's place in it; elementwise operations leave them no such choice.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

__all__ = ["multiply_first", "sum_first"]


def sum_first(terms: Tensor) -> Tensor:
    """Sum over the first dimension by halving, in the same order for every column; overwrites ``terms``.

    Args:
        terms: ``[n, *B]``, n >= 1.

    Returns:
        ``[*B]``.

    Examples:
        >>> import torch
        >>> sum_first(torch.arange(10.0).view(5, 2)).tolist()
        [20.0, 25.0]
    """
    return _by_halves(terms, Tensor.add_)


def multiply_first(factors: Tensor) -> Tensor:
    """Product over the first dimension by halving, in the same order for every column; overwrites ``factors``.

    Args:
        factors: ``[n, *B]``, n >= 1.

    Returns:
        ``[*B]``.

    Examples:
        >>> import torch
        >>> multiply_first(torch.arange(1.0, 7.0).view(3, 2)).tolist()
        [15.0, 48.0]
    """
    return _by_halves(factors, Tensor.mul_)


def _by_halves(values: Tensor, join: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    count = values.shape[0]
    while count > 1:
        half = (count + 1) // 2
        join(values[: count - half], values[half:count])
        count = half
    return values[0]
