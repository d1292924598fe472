"""Graphs that robots move on, as the tables the kernels need (paper, Section VI: pipelines, lines and grids)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Graph", "grid", "line"]


@dataclass(frozen=True, eq=False)
class Graph:
    """An undirected, connected graph, with one control slot per direction of movement.

    Control 0 of a robot is *repair*; control ``1 + s`` moves along slot ``s``.

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
        ValueError: if an edge leaves the graph or a node cannot be reached from node 0.

    Examples:
        >>> line(4).distances[0].tolist(), line(4).first_controls[2].tolist()
        ([0, 1, 2, 3], [1, 1, 0, 2])
    """

    name: str
    neighbours: Tensor
    slot_names: tuple[str, ...]
    columns: Tensor
    rows: Tensor
    distances: Tensor
    first_controls: Tensor

    @classmethod
    def from_slots(
        cls,
        name: str,
        neighbours: Sequence[Sequence[int]],
        slot_names: Sequence[str],
        columns: Sequence[float],
        rows: Sequence[float],
    ) -> Graph:
        """Build a graph from its slot table ``neighbours[node][slot]`` (-1 for no edge).

        Raises:
            ValueError: if a neighbour is not a node or a node is unreachable.
        """
        size = len(neighbours)
        if size == 0:
            raise ValueError("neighbours is empty: a graph needs at least one location")
        table = torch.tensor(neighbours, dtype=torch.int64).reshape(size, len(slot_names))
        if ((table < -1) | (table >= size)).any():
            raise ValueError(f"neighbours must hold locations 0..{size - 1} or -1, got {table.tolist()}")
        distances = _distances(table)
        return cls(
            name=name,
            neighbours=table,
            slot_names=tuple(slot_names),
            columns=torch.tensor(columns, dtype=torch.float32),
            rows=torch.tensor(rows, dtype=torch.float32),
            distances=distances,
            first_controls=_first_controls(table, distances),
        )

    @classmethod
    def from_edges(cls, name: str, num_locations: int, edges: Iterable[tuple[int, int]]) -> Graph:
        """Build an arbitrary undirected graph from pairs of 0-based locations; slots are the sorted neighbours.

        Raises:
            ValueError: if an edge names a location outside the graph or a location is unreachable.

        Examples:
            >>> Graph.from_edges("triangle", 3, [(0, 1), (1, 2), (2, 0)]).neighbours.tolist()
            [[1, 2], [0, 2], [0, 1]]
        """
        adjacent: list[set[int]] = [set() for _ in range(num_locations)]
        for a, b in edges:
            if not (0 <= a < num_locations and 0 <= b < num_locations) or a == b:
                raise ValueError(f"edges holds {(a, b)}, allowed are pairs of different locations 0..{num_locations - 1}")
            adjacent[a].add(b)
            adjacent[b].add(a)
        degree = max((len(nodes) for nodes in adjacent), default=0)
        table = [sorted(nodes) + [-1] * (degree - len(nodes)) for nodes in adjacent]
        places = list(range(num_locations))
        return cls.from_slots(name, table, [f"neighbour {s}" for s in range(degree)], places, [0] * num_locations)

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
        num_locations: L, at least 1.

    Raises:
        ValueError: if ``num_locations`` is not positive.

    Examples:
        >>> line(3).neighbours.tolist()
        [[-1, 1], [0, 2], [1, -1]]
    """
    _check_positive(num_locations=num_locations)
    table = [[i - 1, i + 1 if i + 1 < num_locations else -1] for i in range(num_locations)]
    return Graph.from_slots(f"line of {num_locations}", table, ("left", "right"), range(num_locations), [0] * num_locations)


def grid(width: int, height: int) -> Graph:
    """A rectangular grid, numbered row by row; controls are repair, left, right, up, down.

    Args:
        width: number of columns, at least 1.
        height: number of rows, at least 1.

    Raises:
        ValueError: if a size is not positive.

    Examples:
        >>> grid(3, 2).neighbours[4].tolist()
        [3, 5, 1, -1]
    """
    _check_positive(width=width, height=height)
    places = [(column, row) for row in range(height) for column in range(width)]

    def at(column: int, row: int) -> int:
        return row * width + column if 0 <= column < width and 0 <= row < height else -1

    table = [[at(c - 1, r), at(c + 1, r), at(c, r - 1), at(c, r + 1)] for c, r in places]
    columns, rows = zip(*places, strict=True)
    return Graph.from_slots(f"{width} x {height} grid", table, ("left", "right", "up", "down"), columns, rows)


def _check_positive(**sizes: int) -> None:
    for name, value in sizes.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")


def _distances(table: Tensor) -> Tensor:
    """All-pairs shortest path lengths by breadth-first search; raises on unreachable nodes."""
    neighbours = [[node for node in row if node >= 0] for row in table.tolist()]
    result = []
    for origin in range(len(neighbours)):
        distance = {origin: 0}
        frontier = [origin]
        while frontier:
            reached = dict.fromkeys(n for node in frontier for n in neighbours[node] if n not in distance)
            distance |= dict.fromkeys(reached, distance[frontier[0]] + 1)
            frontier = list(reached)
        unreachable = next((node for node in range(len(neighbours)) if node not in distance), None)
        if unreachable is not None:
            raise ValueError(f"location {unreachable} is unreachable from location {origin}: the graph must be connected")
        result.append([distance[node] for node in range(len(neighbours))])
    return torch.tensor(result, dtype=torch.int64)


def _first_controls(table: Tensor, distances: Tensor) -> Tensor:
    """First control of a shortest path for every (origin, target), ties to the lower control."""
    size, slots = table.shape
    if slots == 0:
        return torch.zeros(size, size, dtype=torch.int64)
    after = distances[table.clamp_min(0)].masked_fill((table < 0).unsqueeze(-1), size + 1)
    return (after.argmin(1) + 1).fill_diagonal_(0)
