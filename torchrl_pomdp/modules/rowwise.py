"""Linear layers whose output for a row depends on that row alone, to the last bit.

A label must not depend on the batch that it is computed in, but the products of a BLAS do: the rows at the end of a matrix,
rows at odd addresses, single columns and sums of many terms on many threads go through kernels that round differently. With
numbers of rows and columns that are multiples of 16, rows that are multiples of 4 numbers long, and double precision sums in
blocks, all rows go through the same one.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

__all__ = ["RowLinear", "affine", "align", "align_terms", "product", "rowwise"]

_SIZE, _LENGTH = 16, 4
# Double precision sums of more terms are shared out among threads, as many of them as there are.
_TERMS = 128


def align(size: int, multiple: int = _SIZE) -> int:
    """The next multiple of 16, or of another number, from ``size`` on; never 0.

    Examples:
        >>> align(1), align(16), align(17)
        (16, 16, 32)
    """
    return max(1, -(-size // multiple)) * multiple


def align_terms(size: int) -> int:
    """The length of a row that holds ``size`` terms of a product.

    Examples:
        >>> align_terms(15), align_terms(16)
        (16, 16)
    """
    return align(size, _LENGTH)


def affine(x: Tensor, weight: Tensor, bias: Tensor, out: Tensor | None = None) -> Tensor:
    """``bias + x @ weight``, each row independent of the others.

    Args:
        x: ``[M, K]``; M and N multiples of 16, K of 4.
        weight: ``[K, N]``.
        bias: ``[N]``.
        out: where to put it, ``[M, N]``; None for a new tensor.
    """
    terms = _TERMS if x.dtype == torch.float64 else x.shape[1]
    result = torch.addmm(bias, x[:, :terms], weight[:terms], out=out)
    for start in range(terms, x.shape[1], terms):
        block = x[:, start : start + terms], weight[start : start + terms]
        result = torch.addmm(result, *block, out=out)
    return result


class RowLinear(nn.Linear):
    """A linear layer, padded with zeros inside so that an output does not depend on the rows beside it.

    Examples:
        >>> layer, x = RowLinear(5, 1), torch.arange(100.0).view(20, 5)
        >>> torch.equal(rowwise(layer, x)[3:4], rowwise(layer, x[3:4]))
        True
    """

    def forward(self, input: Tensor) -> Tensor:
        """Outputs ``[M, out_features]`` of inputs ``[M, in_features]``, M a multiple of 16."""
        wide, high = align_terms(self.in_features) - self.in_features, align(self.out_features) - self.out_features
        x = _padded(input, (0, wide))
        weight, bias = _padded(self.weight, (0, wide, 0, high)), _padded(self.bias, (0, high))
        return affine(x, weight.T, bias)[:, : self.out_features]


def product(x: Tensor, weight: Tensor) -> Tensor:
    """``x @ weight`` ``[M, N]`` of ``[M, K]`` and ``[K, N]``: a row's product does not depend on M."""
    rows, columns = align(x.shape[0]) - x.shape[0], align(weight.shape[1]) - weight.shape[1]
    terms = align_terms(x.shape[1]) - x.shape[1]
    x, weight = _padded(x, (0, terms, 0, rows)), _padded(weight, (0, columns, 0, terms))
    result = affine(x, weight, weight.new_zeros(weight.shape[1]))
    return result[: result.shape[0] - rows, : result.shape[1] - columns]


def rowwise(network: nn.Module, features: Tensor) -> Tensor:
    """``network``, made of :class:`RowLinear` layers, on ``[M, F]``: a row's output does not depend on M."""
    count = features.shape[0]
    return cast(Tensor, network(_padded(features, (0, 0, 0, align(count) - count))))[:count]


def _padded(x: Tensor, sizes: tuple[int, ...]) -> Tensor:
    return nn.functional.pad(x, sizes) if any(sizes) else x
