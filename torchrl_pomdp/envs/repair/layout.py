"""Places for the locations of a graph that has no coordinates, from its distances alone."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["places"]


def places(distances: Tensor) -> tuple[Tensor, Tensor]:
    """Columns and rows that say how near each location is to some that are far apart, whatever the numbers of locations.

    The column goes from one of two locations farthest apart, the poles, to the other: "left" is what is nearer to the first
    pole than to the second, compared with where one stands. The row does so for two poles across, far apart in the graph
    though not in their columns. On a line the columns are its positions; on a grid the places are the grid, turned. Locations
    that these four poles do not tell apart are set a little below one another. All numbers are small fractions of powers of
    two, the same on any machine.

    Args:
        distances: number of moves between two locations, int64 ``[L, L]``.

    Returns:
        columns and rows, float32 ``[L]``; no two locations are at one place.

    Examples:
        >>> line = torch.tensor([[0, 2, 1], [2, 0, 1], [1, 1, 0]])
        >>> columns, rows = places(line)
        >>> columns.tolist(), rows.tolist()
        ([0.0, 2.0, 1.0], [0.0, 0.0, 0.0])
    """
    # Doubled, so that they are integers.
    across = _between(distances, distances)
    apart = 2 * distances - (across.unsqueeze(0) - across.unsqueeze(1)).abs()
    # Of equal ones those that are farther apart; none where all locations lie between the first two poles.
    down = _between(distances, apart * len(distances) + distances * (apart > 0))
    _, place = torch.stack([across, down], -1).unique(dim=0, return_inverse=True)
    same = place.unsqueeze(0) == place.unsqueeze(1)
    rank = same.tril(-1).sum(-1)
    steps = 2 ** int(rank.max()).bit_length()
    return across.float() / 2, down.float() / 2 + rank.float() / (2 * steps)


def _between(distances: Tensor, score: Tensor) -> Tensor:
    """Twice the way from the first to the second location of the pair with the largest score, ``[L]``; ties to the lower."""
    first, second = (score == score.max()).nonzero()[0]
    return distances[first] - distances[second] + distances[first, second]
