"""Graphs that robots move on, as the tables the kernels need (paper, Section VI: pipelines, lines and grids)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchrl_pomdp.checks import check_integer, check_text, shown
from torchrl_pomdp.tensor_checks import check_tensor

__all__ = ["MAX_LOCATIONS", "Graph", "grid", "line"]

MAX_LOCATIONS = 1024
"""Largest number of locations: all distances are tabulated, which takes seconds then."""


@dataclass(frozen=True, eq=False)
class Graph:
    """An undirected, connected graph, with one control slot per direction of movement.

    Control 0 of a robot is *repair*; control ``1 + s`` moves along slot ``s``. A graph is made from its slot table, here or by
    :meth:`from_slots`, or from its edges by :meth:`from_edges`; the last two attributes follow.

    Attributes:
        name: how the graph calls itself in descriptions.
        neighbours: int64 ``[L, S]``; node reached from a node along a slot, or -1 where there is no edge.
        slot_names: the ``S`` names of the directions.
        columns: float32 ``[L]``; the horizontal coordinate, for drawing and for "left" and "right" damage.
        rows: float32 ``[L]``; the vertical coordinate, for drawing.
        distances: int64 ``[L, L]``; number of moves between two nodes.
        first_controls: int64 ``[L, L]``; the robot control that starts a shortest path from a node (first index) to a
            node (second index), ties to the lower control; 0 (repair) on the diagonal.

    Raises:
        TypeError: if an argument is of the wrong kind, such as a node that is no integer.
        ValueError: if there are no or too many nodes, an edge leaves the graph, leads back to its node or only one way, a node
            cannot be reached from node 0, lengths differ, or two nodes have the same coordinates.

    Examples:
        >>> line(4).distances[0].tolist(), line(4).first_controls[2].tolist()
        ([0, 1, 2, 3], [1, 1, 0, 2])
    """

    name: str
    neighbours: Tensor
    slot_names: tuple[str, ...]
    columns: Tensor
    rows: Tensor
    distances: Tensor = field(init=False)
    first_controls: Tensor = field(init=False)

    def __post_init__(self) -> None:
        check_text("name", self.name)
        table = _slot_table(self.neighbours)
        size, num_slots = table.shape
        names = tuple(_sequence("slot_names", self.slot_names))
        if len(names) != num_slots:
            raise ValueError(f"slot_names must hold {num_slots} names, one for each slot of neighbours, got {len(names)}")
        for slot, slot_name in enumerate(names):
            check_text(f"slot_names[{slot}]", slot_name)
        columns, rows = (check_tensor(n, c, (size,)) for n, c in (("columns", self.columns), ("rows", self.rows)))
        columns, rows = (check_tensor(n, c.float()) for n, c in (("columns", columns), ("rows", rows)))
        _check_distinct(columns, rows)
        distances = _distances(table)
        derived = {"distances": distances, "first_controls": _first_controls(table, distances)}
        given = {"neighbours": table, "slot_names": names, "columns": columns, "rows": rows}
        for key, value in {**given, **derived}.items():
            object.__setattr__(self, key, value)

    @classmethod
    def from_slots(
        cls,
        name: str,
        neighbours: Sequence[Sequence[int]],
        slot_names: Sequence[str],
        columns: Sequence[float],
        rows: Sequence[float],
    ) -> Graph:
        """Build a graph from its slot table ``neighbours[node][slot]`` (-1 for no edge), in plain sequences.

        Raises:
            TypeError: if an argument is of the wrong kind.
            ValueError: if this is no graph, see the class.

        Examples:
            >>> Graph.from_slots("pipe", [[1], [0]], ["across"], [0, 1], [0, 0]).distances.tolist()
            [[0, 1], [1, 0]]
        """
        values: Any = (neighbours, slot_names, columns, rows)
        return cls(name, *values)

    @classmethod
    def from_edges(
        cls,
        name: str,
        num_locations: int,
        edges: Iterable[tuple[int, int]],
        *,
        columns: Sequence[float] | None = None,
        rows: Sequence[float] | None = None,
    ) -> Graph:
        """Build an arbitrary undirected graph from pairs of 0-based locations; slots are the sorted neighbours.

        Args:
            name: how the graph calls itself.
            num_locations: L.
            edges: pairs of different locations.

        Keyword Args:
            columns: horizontal coordinates; None: the numbers of the locations.
            rows: vertical coordinates; None: zeros.

        Raises:
            TypeError: if an argument is of the wrong kind, such as a location that is no integer.
            ValueError: if an edge names a location outside the graph or a location is unreachable.

        Examples:
            >>> Graph.from_edges("triangle", 3, [(0, 1), (1, 2), (2, 0)]).neighbours.tolist()
            [[1, 2], [0, 2], [0, 1]]
        """
        check_integer("num_locations", num_locations, 1, MAX_LOCATIONS)
        adjacent: list[set[int]] = [set() for _ in range(num_locations)]
        if not isinstance(edges, Iterable) or isinstance(edges, (str, bytes)):
            raise TypeError(f"edges must hold pairs of locations, got {shown(edges)}")
        for number, edge in enumerate(edges):
            ends = _sequence(f"edges[{number}]", edge)
            allowed = f"allowed are pairs of different locations 0..{num_locations - 1}"
            if len(ends) != 2:
                raise ValueError(f"edges holds {shown(edge)}, {allowed}")
            a, b = (check_integer(f"edges[{number}]", end) for end in ends)
            if not (0 <= a < num_locations and 0 <= b < num_locations) or a == b:
                raise ValueError(f"edges holds {(a, b)}, {allowed}")
            adjacent[a].add(b)
            adjacent[b].add(a)
        degree = max(len(nodes) for nodes in adjacent)
        table = [sorted(nodes) + [-1] * (degree - len(nodes)) for nodes in adjacent]
        columns = list(range(num_locations)) if columns is None else columns
        rows = [0] * num_locations if rows is None else rows
        return cls.from_slots(name, table, [f"neighbour {s}" for s in range(degree)], columns, rows)

    @property
    def num_locations(self) -> int:
        """L, the number of nodes."""
        return self.neighbours.shape[0]

    @property
    def control_names(self) -> tuple[str, ...]:
        """Names of one robot's controls: repair, then the moves."""
        return ("repair", *self.slot_names)


def line(num_locations: int) -> Graph:
    """A linear pipeline; controls are repair, left, right.

    Args:
        num_locations: L, 1 to 1024.

    Raises:
        TypeError: if ``num_locations`` is no integer.
        ValueError: if it is out of bounds.

    Examples:
        >>> line(3).neighbours.tolist()
        [[-1, 1], [0, 2], [1, -1]]
    """
    check_integer("num_locations", num_locations, 1, MAX_LOCATIONS)
    table = [[i - 1, i + 1 if i + 1 < num_locations else -1] for i in range(num_locations)]
    return Graph.from_slots(f"line of {num_locations}", table, ("left", "right"), range(num_locations), [0] * num_locations)


def grid(width: int, height: int) -> Graph:
    """A rectangular grid, numbered row by row; controls are repair, left, right, up, down.

    Args:
        width: number of columns, at least 1.
        height: number of rows, at least 1; there are at most 1024 locations.

    Raises:
        TypeError: if a size is no integer.
        ValueError: if a size is not positive or there are too many locations.

    Examples:
        >>> grid(3, 2).neighbours[4].tolist()
        [3, 5, 1, -1]
    """
    check_integer("width", width, 1, MAX_LOCATIONS)
    check_integer("height", height, 1, MAX_LOCATIONS)
    if width * height > MAX_LOCATIONS:
        raise ValueError(f"width times height must be at most {MAX_LOCATIONS} locations, got {width} x {height}")
    places = [(column, row) for row in range(height) for column in range(width)]

    def at(column: int, row: int) -> int:
        return row * width + column if 0 <= column < width and 0 <= row < height else -1

    table = [[at(c - 1, r), at(c + 1, r), at(c, r - 1), at(c, r + 1)] for c, r in places]
    columns, rows = zip(*places, strict=True)
    return Graph.from_slots(f"{width} x {height} grid", table, ("left", "right", "up", "down"), columns, rows)


def _sequence(name: str, value: Any) -> Sequence[Any]:
    if isinstance(value, (str, bytes)) or not isinstance(value, Sequence):
        raise TypeError(f"{name} must be a sequence, got {shown(value)}")
    return value


def _slot_table(neighbours: Any) -> Tensor:
    """The slot table as int64 ``[L, S]``; raises unless its edges are those of an undirected graph."""
    nodes = _sequence("neighbours", neighbours.tolist() if hasattr(neighbours, "tolist") else neighbours)
    if not 1 <= len(nodes) <= MAX_LOCATIONS:
        raise ValueError(f"neighbours must hold 1 to {MAX_LOCATIONS} locations, got {len(nodes)}")
    rows = [_sequence(f"neighbours[{node}]", row) for node, row in enumerate(nodes)]
    for node, row in enumerate(rows):
        if len(row) != len(rows[0]) or len(row) >= MAX_LOCATIONS:
            expected = f"{len(rows[0])} slots as the first, fewer than {MAX_LOCATIONS}"
            raise ValueError(f"neighbours[{node}] must have {expected}, got {len(row)}")
        for slot, to in enumerate(row):
            if not -1 <= check_integer(f"neighbours[{node}][{slot}]", to) < len(rows) or to == node:
                allowed = f"another location in 0..{len(rows) - 1} or -1"
                raise ValueError(f"neighbours must hold {allowed}, got {to} at neighbours[{node}][{slot}]")
    reached = [set(row) for row in rows]
    for node, row in enumerate(rows):
        back = next((to for to in row if to >= 0 and node not in reached[to]), None)
        if back is not None:
            raise ValueError(f"neighbours leads from location {node} to {back} but not back: every edge must go both ways")
    return torch.tensor([list(map(int, row)) for row in rows], dtype=torch.int64)


def _check_distinct(columns: Tensor, rows: Tensor) -> None:
    seen: dict[tuple[float, float], int] = {}
    for node, place in enumerate(zip(columns.tolist(), rows.tolist(), strict=True)):
        if place in seen:
            both = f"locations {seen[place]} and {node}"
            raise ValueError(f"columns and rows must give every location a place of its own, {both} are both at {place}")
        seen[place] = node


def _distances(table: Tensor) -> Tensor:
    """All-pairs shortest path lengths by breadth-first search; raises on unreachable nodes."""
    # Sets of nodes are the bits of integers: a union with a node's neighbours is one operation.
    neighbours = [sum(1 << node for node in {*row} if node >= 0) for row in table.tolist()]
    size, result = len(neighbours), []
    for origin in range(size):
        distance = [-1] * size
        frontier, seen, steps = 1 << origin, 1 << origin, 0
        while frontier:
            reached = 0
            while frontier:
                node = frontier.bit_length() - 1
                frontier ^= 1 << node
                distance[node] = steps
                reached |= neighbours[node]
            frontier = reached & ~seen
            seen |= frontier
            steps += 1
        if -1 in distance:
            unreachable = distance.index(-1)
            raise ValueError(f"location {unreachable} is unreachable from location {origin}: edges must connect all locations")
        result.append(distance)
    return torch.tensor(result, dtype=torch.int64)


def _first_controls(table: Tensor, distances: Tensor) -> Tensor:
    """First control of a shortest path for every (origin, target), ties to the lower control."""
    size, num_slots = table.shape
    result = torch.zeros(size, size, dtype=torch.int64)
    for node, row in enumerate(table):
        slots = (row >= 0).nonzero().squeeze(-1)
        if len(slots):
            # The slot decides between equal distances.
            rank = distances[row[slots]] * num_slots + slots.unsqueeze(-1)
            result[node] = rank.amin(0) % num_slots + 1
    return result.fill_diagonal_(0)
