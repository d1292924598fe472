"""Sums whose rounding does not depend on the batch.

A label must be a function of its state alone, to the last bit. Libraries add a column's numbers in an order that depends on
the size of the batch and on the column's place in it; elementwise additions leave them no such choice.
"""

from __future__ import annotations

from torch import Tensor

__all__ = ["sum_first"]


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
    count = terms.shape[0]
    while count > 1:
        half = (count + 1) // 2
        terms[: count - half].add_(terms[half:count])
        count = half
    return terms[0]
