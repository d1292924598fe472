"""Tables of distributions by control and state, dense or sparse, and sums over them that do not depend on the batch.

Both kinds multiply and add number by number in an order that the table alone decides: a product of matrices would round by the
number of rows. Rows are grouped by control, so nothing of size ``[N, n, n]`` is ever made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.tensor_checks import check_tensor

__all__ = ["ROUNDING", "DenseTable", "SparseTable", "table"]

# How far a given row may be from summing to one; within the second bound, the rounding of its type, it is left as it is, so
# that a table which is written down and read again stays what it was.
_TOLERANCE, ROUNDING = 1e-5, {torch.float32: 1e-6, torch.float64: 1e-10}
# Dense tables of up to so many numbers for each control are gathered row by row, larger ones multiplied control by control.
_SMALL = 2048
# Numbers of a temporary array that are aimed at, and the fewest rows for which one is made.
_BUDGET, _LEAST_ROWS = 1 << 20, 32


class DenseTable(nn.Module):
    """Distributions ``[U, n, m]``, kept as an array.

    Args:
        rows: float64, nonnegative, rows sum to one.
        dtype: type in which they are kept.
        device: where they are kept.

    Examples:
        >>> eye = DenseTable(torch.eye(2, dtype=torch.float64).unsqueeze(0), torch.float32, "cpu")
        >>> eye.mix(torch.tensor([[0.25, 0.75]]), torch.tensor([0])).tolist()
        [[0.25, 0.75]]
    """

    rows: Tensor

    def __init__(self, rows: Tensor, dtype: torch.dtype, device: torch.device | str) -> None:
        super().__init__()
        self.shape = torch.Size(rows.shape)
        self.register_buffer("rows", rows.to(device, dtype), persistent=False)

    def mix(self, weight: Tensor, u: Tensor) -> Tensor:
        """Mixtures ``[N, m]`` of the rows of controls ``u`` int64 ``[N]``, with weights ``[N, n]``."""
        if self.shape[1:].numel() > _SMALL:
            return self._mix_grouped(weight, u)
        # Grouping would cost more than it saves.
        planes, rows = weight.T.unsqueeze(-1), self.rows.transpose(0, 1)
        return self._sum(lambda block: rows[block].index_select(1, u).mul_(planes[block]))

    @torch.compiler.disable
    def _mix_grouped(self, weight: Tensor, u: Tensor) -> Tensor:
        result = weight.new_empty(len(u), self.shape[2])
        for control, index in _by_control(u, _BUDGET // (self._block * self.shape[2])):
            planes, rows = weight.index_select(0, index).T.contiguous().unsqueeze(1), self.rows[control].unsqueeze(2)
            result[index] = self._sum(partial(_products, rows, planes)).T
        return result

    @property
    def _block(self) -> int:
        """States that are summed over at once; they decide the order of the sum."""
        return max(16, -(-self.shape[1] // 16))

    def _sum(self, terms: Callable[[slice], Tensor]) -> Tensor:
        """Sum over the n states of terms ``[block, *B]`` that are made for a block of states at a time."""
        total: Tensor | None = None
        for first in range(0, self.shape[1], self._block):
            part = sum_first(terms(slice(first, first + self._block)))
            total = part if total is None else total.add_(part)
        assert total is not None
        return total

    def column(self, u: Tensor, z: Tensor) -> Tensor:
        """Column ``z`` of the table of control ``u``, both int64 ``[N]``: ``[N, n]``."""
        return self.rows.transpose(1, 2)[u, z]

    def entries(self, control: int) -> tuple[Tensor, Tensor, Tensor]:
        """Row, column and value of a control's numbers that are not zero, row by row."""
        i, j = self.rows[control].nonzero(as_tuple=True)
        return i, j, self.rows[control, i, j]

    def diagonal(self) -> Tensor:
        """Probabilities of staying in a state, ``[U, n]``."""
        return self.rows.diagonal(dim1=1, dim2=2)

    def kept(self, states: Tensor) -> DenseTable:
        """The table where some states, bool ``[n]``, are never left by controls that hardly do; of ``[U, n, n]``."""
        stay = _hardly_left(self.diagonal(), states).unsqueeze(-1)
        rows = torch.where(stay, torch.eye(self.shape[1], dtype=self.rows.dtype, device=self.rows.device), self.rows)
        return DenseTable(rows, rows.dtype, rows.device)

    def given(self) -> Tensor:
        """The table in the form in which it was given, ``[U, n, m]``."""
        return self.rows


class SparseTable(nn.Module):
    """Distributions ``[U, n, m]`` of which only the numbers that are not zero are kept.

    A mixture needs the rows that lead to each column. Columns are kept in groups of equal numbers of them, filled up with
    zeros: groups are multiplied and added as arrays, at most a third of their terms for nothing.

    Args:
        shape: (U, n, m).
        index: control, row and column of each number, int64 ``[3, nnz]``, in that order and each once.
        values: the numbers, float64 ``[nnz]``, positive, rows sum to one.
        dtype: type in which they are kept.
        device: where they are kept.

    Examples:
        >>> index, half = torch.tensor([[0, 0, 0], [0, 0, 1], [0, 1, 0]]), torch.tensor([0.5, 0.5, 1.0])
        >>> table = SparseTable(torch.Size([1, 2, 2]), index, half.double(), torch.float32, "cpu")
        >>> table.mix(torch.tensor([[0.5, 0.5]]), torch.tensor([0])).tolist()
        [[0.75, 0.25]]
    """

    row: Tensor
    col: Tensor
    values: Tensor
    by_column: Tensor
    first_of_column: Tensor
    sources: Tensor
    weights: Tensor
    targets: Tensor

    def __init__(
        self, shape: torch.Size, index: Tensor, values: Tensor, dtype: torch.dtype, device: torch.device | str
    ) -> None:
        super().__init__()
        self.shape = torch.Size(shape)
        num_controls, _, m = self.shape
        (u, i, j), values = index.cpu(), values.cpu().to(dtype)
        self._ends = [0, *torch.bincount(u, minlength=num_controls).cumsum(0).tolist()]
        column = u * m + j
        by_column, sizes = column.argsort(stable=True), torch.bincount(column, minlength=num_controls * m)
        first = torch.cat([sizes.new_zeros(1), sizes.cumsum(0)])
        place, targets, self._layout = _grouped_columns(first, num_controls)
        entry, there = by_column[place.clamp_min(0)], place >= 0
        buffers = {
            "row": i, "col": j, "values": values,
            # For each column the places of its numbers, and where they begin.
            "by_column": by_column, "first_of_column": first,
            # The terms of all groups, and the columns that are their sums.
            "sources": i[entry], "weights": torch.where(there, values[entry], 0.0), "targets": targets,
        }  # fmt: skip
        for name, buffer in buffers.items():
            self.register_buffer(name, buffer.to(device), persistent=False)
        largest = max(depth * count for groups in self._layout for depth, count, *_ in groups)
        self._rows_at_once = max(_LEAST_ROWS, _BUDGET // max(largest, *self.shape[1:]))

    @torch.compiler.disable
    def mix(self, weight: Tensor, u: Tensor) -> Tensor:
        """Mixtures ``[N, m]`` of the rows of controls ``u`` int64 ``[N]``, with weights ``[N, n]``."""
        result = weight.new_empty(len(u), self.shape[2])
        for control, index in _by_control(u, self._rows_at_once):
            planes = weight.index_select(0, index).T.contiguous()
            mixed = weight.new_zeros(self.shape[2], len(index))
            for depth, count, term, target in self._layout[control]:
                places = slice(term, term + depth * count)
                terms = planes.index_select(0, self.sources[places]).mul_(self.weights[places].unsqueeze(1))
                mixed[self.targets[target : target + count]] = sum_first(terms.view(depth, count, -1))
            result[index] = mixed.T
        return result

    @torch.compiler.disable
    def column(self, u: Tensor, z: Tensor) -> Tensor:
        """Column ``z`` of the table of control ``u``, both int64 ``[N]``: ``[N, n]``."""
        column = u * self.shape[2] + z
        first, count = self.first_of_column[column], self.first_of_column[column + 1] - self.first_of_column[column]
        n = torch.arange(len(u), device=u.device).repeat_interleave(count)
        place = torch.arange(len(n), device=u.device) + (first - count.cumsum(0) + count)[n]
        entry = self.by_column[place]
        result = self.values.new_zeros(len(u), self.shape[1])
        result[n, self.row[entry]] = self.values[entry]
        return result

    def entries(self, control: int) -> tuple[Tensor, Tensor, Tensor]:
        """Row, column and value of a control's numbers that are not zero, row by row."""
        mine = slice(*self._ends[control : control + 2])
        return self.row[mine], self.col[mine], self.values[mine]

    def diagonal(self) -> Tensor:
        """Probabilities of staying in a state, ``[U, n]``."""
        stay = self.row == self.col
        result = self.values.new_zeros(self.shape[:2])
        result[self._controls()[stay], self.row[stay]] = self.values[stay]
        return result

    def kept(self, states: Tensor) -> SparseTable:
        """The table where some states, bool ``[n]``, are never left by controls that hardly do; of ``[U, n, n]``."""
        control, same = self._controls(), self.row == self.col
        stay = _hardly_left(self.diagonal(), states)[control, self.row]
        index, values = torch.stack([control, self.row, self.col]), self.values.masked_fill(stay, 1.0)
        left = ~stay | same
        return SparseTable(self.shape, index[:, left], values[left], values.dtype, values.device)

    def _controls(self) -> Tensor:
        count = torch.tensor(self._ends, device=self.row.device).diff()
        return torch.arange(len(count), device=self.row.device).repeat_interleave(count)

    def given(self) -> Tensor:
        """The table in the form in which it was given, sparse ``[U, n, m]``."""
        index = torch.stack([self._controls(), self.row, self.col])
        return torch.sparse_coo_tensor(index, self.values, self.shape, is_coalesced=True, check_invariants=False)


def table(
    name: str, given: Any, dtype: torch.dtype, device: torch.device | str, like: torch.Size | None = None
) -> DenseTable | SparseTable:
    """A table from an array ``[U, n, m]``, dense or sparse (COO); rows are scaled to sum to one.

    Args:
        name: name of the argument.
        given: what was given.
        dtype: type in which it is kept.
        device: where it is kept.
        like: (U, n) that it must have; None: any, and m = n.

    Raises:
        TypeError: if it is neither.
        ValueError: if the shape is another, or a row is no distribution.

    Examples:
        >>> type(table("transition", torch.eye(3).unsqueeze(0), torch.float32, "cpu")).__name__
        'DenseTable'
    """
    rows = check_tensor(name, given, finite=False, sparse=True)
    square = rows.ndim == 3 and rows.shape[1] == rows.shape[2]
    if 0 in rows.shape or (not square if like is None else rows.ndim != 3 or rows.shape[:2] != like):
        expected = "[U, n, n], at least one of each" if like is None else f"[{like[0]}, {like[1]}, Z]"
        raise ValueError(f"{name} must have shape {expected}, got {tuple(rows.shape)}")
    if rows.layout == torch.sparse_coo:
        return _sparse(name, rows.detach().cpu(), dtype, device)
    if rows.layout != torch.strided:
        raise TypeError(f"{name} must be dense or sparse in COO layout, got {rows.layout}")
    rows = rows.detach().double()
    sums = rows.sum(-1, keepdim=True)
    _check_rows(name, rows.amin(-1), sums.squeeze(-1))
    return DenseTable(torch.where(_off(sums, dtype), rows / sums, rows), dtype, device)


def _sparse(name: str, rows: Tensor, dtype: torch.dtype, device: torch.device | str) -> SparseTable:
    index, size = rows._indices(), torch.tensor(rows.shape).unsqueeze(1)
    if rows.dense_dim() or bool(((index < 0) | (index >= size)).any()):
        raise ValueError(f"{name} must be sparse in all dimensions, with indices within its shape {tuple(rows.shape)}")
    rows = torch.sparse_coo_tensor(index, rows._values().double(), rows.shape, check_invariants=False).coalesce()
    index, values = rows.indices(), rows.values()
    row = index[0] * rows.shape[1] + index[1]
    sums = torch.zeros(rows.shape[:2], dtype=torch.float64).flatten().index_add_(0, row, values)
    least = torch.zeros_like(sums).scatter_reduce_(0, row, values, "amin")
    _check_rows(name, least.view(rows.shape[:2]), sums.view(rows.shape[:2]))
    scaled = torch.where(_off(sums, dtype)[row], values / sums[row], values)
    return SparseTable(rows.shape, index[:, values > 0], scaled[values > 0], dtype, device)


def _check_rows(name: str, least: Tensor, sums: Tensor) -> None:
    """Raise unless rows with least numbers ``least`` and sums ``sums``, ``[U, n]``, are distributions up to rounding."""
    off = (sums - 1.0).abs()
    negative = ~(least >= 0)
    if bool(negative.any()) or not bool((off <= _TOLERANCE).all()):
        worst = negative.to(sums.dtype) if bool(negative.any()) else off.nan_to_num(torch.inf)
        where = tuple(int(k) for k in torch.unravel_index(worst.argmax(), sums.shape))
        found = f"has {float(least[where]):.7g}" if bool(negative[where]) else f"sums to {float(sums[where]):.7g}"
        raise ValueError(f"rows of {name} must be nonnegative and sum to 1; row {where} {found}")


def _off(sums: Tensor, dtype: torch.dtype) -> Tensor:
    """Which rows are to be scaled: their sum is off by more than rounding."""
    return (sums - 1.0).abs() > ROUNDING[dtype]


def _hardly_left(diagonal: Tensor, states: Tensor) -> Tensor:
    """Which states, bool ``[U, n]``, of some ``[n]`` each control leaves by no more than rounding."""
    return states & (diagonal >= 1.0 - ROUNDING[diagonal.dtype])


def _products(rows: Tensor, planes: Tensor, block: slice) -> Tensor:
    return rows[block] * planes[block]


def _by_control(u: Tensor, most: int) -> Iterator[tuple[int, Tensor]]:
    """Each control of ``u`` ``[N]`` with the places where it is, at most ``most`` of them at a time."""
    order = u.argsort(stable=True)
    controls, counts = u.unique(return_counts=True)
    for control, places in zip(controls.tolist(), order.split(counts.tolist()), strict=True):
        for part in places.split(max(1, most)):
            yield control, part


def _grouped_columns(first: Tensor, num_controls: int) -> tuple[Tensor, Tensor, list[list[tuple[int, int, int, int]]]]:
    """Columns of all controls in groups of about equal size.

    Args:
        first: where the numbers of each column begin, ``[U * m + 1]``.
        num_controls: U.

    Returns:
        places of the numbers, ``[depth, count]`` of each group with -1 for none, flat; the columns of the groups, flat; and for
        each control its groups: depth, count, and where they begin in the two.
    """
    sizes = first.diff()
    m = len(sizes) // num_controls
    places, targets, counts, depths = [], [], [], [0, *_depths(int(sizes.max()))]
    for below, depth in pairwise(depths):
        columns = ((sizes > below) & (sizes <= depth)).nonzero().squeeze(-1)
        step = torch.arange(depth).unsqueeze(1)
        place = torch.where(step < sizes[columns], first[columns] + step, -1)
        places.append(torch.stack([columns.expand(depth, -1) // m, place]).flatten(1))
        targets.append(columns)
        counts.append(torch.bincount(columns // m, minlength=num_controls))
    # From the groups of all controls to those of each: the order by depth, step and column stays.
    (control, place), target = torch.cat(places, 1), torch.cat(targets)
    place, target = place[control.argsort(stable=True)], target[(target // m).argsort(stable=True)] % m
    count_of = torch.stack(counts, 1)
    owner, group = count_of.nonzero(as_tuple=True)
    count, depth_of = count_of[owner, group], torch.tensor(depths[1:])[group]
    begins = ((depth_of * count).cumsum(0) - depth_of * count, count.cumsum(0) - count)
    layout: list[list[tuple[int, int, int, int]]] = [[] for _ in range(num_controls)]
    for control_of, *where in torch.stack([owner, depth_of, count, *begins], 1).tolist():
        layout[control_of].append(tuple(where))
    return place, target, layout


def _depths(most: int) -> list[int]:
    """1, 2, 3, 4, 6, 8, 12, 16, ... up to the first that is not less than ``most``."""
    depths = [1]
    while depths[-1] < most:
        last = depths[-1]
        depths.append(last * 4 // 3 if last % 3 == 0 else max(last * 3 // 2, last + 1))
    return depths
