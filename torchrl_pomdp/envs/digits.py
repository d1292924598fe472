"""Numbers of joint controls, observations and states, and their digits."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["digits", "joined"]


def digits(number: Tensor, base: int, count: int) -> Tensor:
    """Base-``base`` digits ``[*B, count]`` of ``number`` ``[*B]``, most significant first.

    Examples:
        >>> digits(torch.tensor(7), 3, 2).tolist()
        [2, 1]
    """
    if count == 1:
        return number.unsqueeze(-1)
    powers = base ** torch.arange(count - 1, -1, -1, device=number.device)
    return number.unsqueeze(-1) // powers % base


def joined(digit: Tensor, base: int) -> Tensor:
    """The numbers ``[*B]`` with base-``base`` digits ``[*B, count]``, most significant first; inverse of :func:`digits`.

    Examples:
        >>> joined(torch.tensor([2, 1]), 3).item()
        7
    """
    number = digit[..., 0]
    for k in range(1, digit.shape[-1]):
        number = number * base + digit[..., k]
    return number
