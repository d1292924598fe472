"""The tables of a ``.POMDP`` file while it is read: of what is written twice, the last counts.

Nothing is expanded that a file does not write: tables of probabilities are lists of their numbers, and rewards are looked up
only where something can happen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_ENTRIES", "MAX_ROWS", "Rewards", "Rows"]

MAX_ROWS, MAX_ENTRIES = 1 << 22, 1 << 24
"""Most rows of a table, and numbers that a file may write to it, wildcards and words such as ``uniform`` written out."""

# Cases, of state, control, next state and observation, that rewards are averaged over: in all, and at a time.
_MAX_CASES, _CASES = 1 << 26, 1 << 20

_Integers = NDArray[np.int64]
_Numbers = NDArray[np.float64]


class Rows:
    """Distributions ``[U, n, m]`` as they are written.

    A control or state of -1 stands for all of them. ``line`` is where in the file something is written.

    Args:
        num_controls: U.
        num_states: n.
        size: m.

    Examples:
        >>> rows = Rows(1, 2, 2)
        >>> rows.put_identity(-1)
        >>> rows.put_row(0, 1, np.array([0.5, 0.5]))
        >>> rows.put(0, 1, 1, 0.25)
        >>> rows.result()[1].tolist()
        [1.0, 0.5, 0.25]
    """

    def __init__(self, num_controls: int, num_states: int, size: int) -> None:
        self.num_controls, self.num_states, self.size = num_controls, num_states, size
        self.line, self._lines = 0, np.zeros(num_controls * num_states, np.int64)
        # What was written to a row before this place no longer counts.
        self._begins = np.zeros(num_controls * num_states, np.int64)
        self._written = self._spent = 0
        self._parts: list[tuple[_Integers, _Numbers]] = []
        self._keys: list[int] = []
        self._values: list[float] = []

    def put(self, control: int, state: int, column: int, value: float) -> None:
        """One number; a column of -1 stands for all."""
        if control >= 0 and state >= 0 and column >= 0:
            row = control * self.num_states + state
            self._lines[row] = self.line
            self._keys.append(row * self.size + column)
            self._values.append(value)
            self._written += 1
        elif column >= 0:
            rows = self._selected(control, state, 1)
            self._write(rows * self.size + column, np.full(len(rows), value))
        else:
            self.put_row(control, state, np.full(self.size, value))

    def put_row(self, control: int, state: int, values: _Numbers) -> None:
        """A row ``[m]``."""
        columns = values.nonzero()[0]
        rows = self._selected(control, state, len(columns))
        self._flush()
        self._begins[rows] = self._written
        self._write((rows[:, None] * self.size + columns).ravel(), np.tile(values[columns], len(rows)))

    def put_matrix(self, control: int, values: _Numbers) -> None:
        """All rows of a control, ``[n, m]``."""
        for state, row in enumerate(values):
            self.put_row(control, state, row)

    def put_identity(self, control: int) -> None:
        """All rows of a control: the states stay what they are."""
        rows = self._selected(control, -1, 1)
        self._flush()
        self._begins[rows] = self._written
        self._write(rows * self.size + rows % self.num_states, np.ones(len(rows)))

    def _selected(self, control: int, state: int, width: int) -> _Integers:
        """Numbers of the rows, each of which ``width`` numbers will be written to."""
        controls = np.arange(self.num_controls) if control < 0 else np.array([control])
        states = np.arange(self.num_states) if state < 0 else np.array([state])
        self._spent += len(controls) * len(states) * max(width, 1)
        if self._spent > MAX_ENTRIES:
            raise OverflowError(f"more than {MAX_ENTRIES} numbers are written to a table, wildcards written out")
        rows = (controls[:, None] * self.num_states + states).ravel()
        self._lines[rows] = self.line
        return rows

    def last_line(self, control: int, state: int) -> int:
        """Where a row was written last; 0 for never."""
        return int(self._lines[control * self.num_states + state])

    def _write(self, keys: _Integers, values: _Numbers) -> None:
        self._flush()
        self._parts.append((keys, values))
        self._written += len(keys)

    def _flush(self) -> None:
        if self._keys:
            self._parts.append((np.array(self._keys, np.int64), np.array(self._values)))
            self._keys, self._values = [], []

    def result(self) -> tuple[_Integers, _Numbers]:
        """Control, state and column of each number that is not zero, ``[3, nnz]``, row by row, and the numbers."""
        self._flush()
        if not self._parts:
            return np.zeros((3, 0), np.int64), np.zeros(0)
        keys, values = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        counts = np.arange(len(keys)) >= self._begins[keys // self.size]
        keys, values = keys[counts], values[counts]
        keys, last = np.unique(keys[::-1], return_index=True)
        values = values[::-1][last]
        keys, values = keys[values != 0], values[values != 0]
        row, column = np.divmod(keys, self.size)
        return np.stack([*np.divmod(row, self.num_states), column]), values


class Rewards:
    """Rewards by control, state, next state and observation as they are written; -1 stands for all.

    Args:
        shape: (U, n, n, Z).

    Examples:
        >>> rewards = Rewards((1, 2, 2, 1))
        >>> rewards.put((-1, -1, -1, -1), 1.0)
        >>> rewards.put((0, -1, 1, -1), 3.0)
        >>> moves = np.array([[0, 0, 0], [0, 0, 1], [0, 1, 1]]), np.array([0.5, 0.5, 1.0])
        >>> sees = np.array([[0, 0], [0, 1], [0, 0]]), np.ones(2)
        >>> rewards.expected(moves, sees).tolist()
        [[2.0, 3.0]]
    """

    def __init__(self, shape: tuple[int, int, int, int]) -> None:
        self.shape = shape
        # By which of the four are fixed: what they are, the place in the file, and the reward.
        self._written: dict[tuple[bool, ...], tuple[list[int], list[int], list[float]]] = {}
        self._count = 0

    def put(self, where: tuple[int, ...], value: float) -> None:
        """One reward."""
        u, i, j, z = where
        keys, places, values = self._written.setdefault((u >= 0, i >= 0, j >= 0, z >= 0), ([], [], []))
        keys.append(self._key((max(u, 0), max(i, 0), max(j, 0), max(z, 0))))
        places.append(self._count)
        values.append(value)
        self._count += 1

    def put_block(self, where: tuple[int, ...], block: _Numbers) -> None:
        """Rewards of all cases of the last one or two of the four."""
        for index, value in np.ndenumerate(block):
            self.put((*where, *index), float(value))

    def _key(self, where):
        """One number for control, state, next state and observation, which are numbers or arrays of them."""
        u, i, j, z = where
        return ((u * self.shape[1] + i) * self.shape[2] + j) * self.shape[3] + z

    def expected(self, moves: tuple[_Integers, _Numbers], sees: tuple[_Integers, _Numbers]) -> _Numbers:
        """Expected rewards ``[U, n]`` where rows of moves and observations are distributions up to a factor."""
        num_controls, n, _, _ = self.shape
        tables = self._tables()
        depth = max((max((k + 1 for k in range(4) if fixed[k]), default=0) for fixed, *_ in tables), default=0)
        if depth <= 2:
            u, i = np.divmod(np.arange(num_controls * n), n)
            return self._at(tables, (u, i, 0 * u, 0 * u)).reshape(num_controls, n)
        (u, i, j), prob = moves
        value = self._at(tables, (u, i, j, 0 * u)) if depth == 3 else self._by_observation(tables, moves[0], sees)
        starts = np.searchsorted(u * n + i, np.arange(num_controls * n))
        return _average(value, prob, starts).reshape(num_controls, n)

    def _by_observation(self, tables: list, moves: _Integers, sees: tuple[_Integers, _Numbers]) -> _Numbers:
        """Rewards of moves ``[3, M]``, averaged over what is observed."""
        (u_seen, j_seen, z_seen), prob = sees
        (u, i, j), n = moves, self.shape[1]
        first = np.searchsorted(u_seen * n + j_seen, np.arange(self.shape[0] * n + 1))
        begin, count = first[u * n + j], np.diff(first)[u * n + j]
        ends = np.cumsum(count)
        if ends[-1] > _MAX_CASES:
            raise OverflowError(f"rewards depend on the observation in more than {_MAX_CASES} cases")
        result, low = np.zeros(len(u)), 0
        while low < len(u):
            high = max(low + 1, int(np.searchsorted(ends, (ends[low - 1] if low else 0) + _CASES, "right")))
            part = slice(low, high)
            starts = ends[part] - count[part] - (ends[low] - count[low])
            move = np.repeat(np.arange(low, high), count[part])
            seen = np.arange(len(move)) - np.repeat(starts, count[part]) + begin[move]
            value = self._at(tables, (u[move], i[move], j[move], z_seen[seen]))
            result[part] = _average(value, prob[seen], starts)
            low = high
        return result

    def _tables(self) -> list[tuple[tuple[bool, ...], _Integers, _Integers, _Numbers]]:
        """What is written, sorted by its key, of each key the last."""
        tables = []
        for fixed, (keys, places, values) in self._written.items():
            key, last = np.unique(np.array(keys, np.int64)[::-1], return_index=True)
            tables.append((fixed, key, np.array(places, np.int64)[::-1][last], np.array(values)[::-1][last]))
        return tables

    def _at(self, tables: list, where: tuple[_Integers, ...]) -> _Numbers:
        """Rewards of cases: what was written last among all that speaks of them, else zero."""
        value, latest = np.zeros(len(where[0])), np.full(len(where[0]), -1)
        for fixed, keys, places, values in tables:
            key = self._key([one if it else 0 * one for one, it in zip(where, fixed, strict=True)])
            found = np.searchsorted(keys, key).clip(max=len(keys) - 1)
            newer = (keys[found] == key) & (places[found] > latest)
            value[newer], latest[newer] = values[found[newer]], places[found[newer]]
        return value


def _average(values: _Numbers, weights: _Numbers, starts: _Integers) -> _Numbers:
    """Weighted means of the segments that begin at ``starts``; of equal numbers just that number."""
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    with np.errstate(over="ignore", invalid="ignore"):
        mean = np.add.reduceat(values * weights, starts) / np.add.reduceat(weights, starts)
    return np.where(low == high, low, mean)
