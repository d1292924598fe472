"""Graphs that robots move on, as the tables the kernels need (paper, Section VI: pipelines, lines and grids)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchrl_pomdp.checks import check_integer, check_number, check_text, shown
from torchrl_pomdp.envs.repair.layout import places
from torchrl_pomdp.tensor_checks import check_tensor

__all__ = ["MAX_LOCATIONS", "Graph", "grid", "line"]

MAX_LOCATIONS = 1024
"""Largest number of locations: all distances are tabulated, which takes seconds then."""


@dataclass(frozen=True, eq=False)
class Graph:
    """An undirected, connected graph, with one control slot per direction of movement.

    Control 0 of a robot is *repair*; control ``1 + s`` moves along slot ``s``. A graph is made from its slot table, here or by
    :meth:`from_slots`, from its edges by :meth:`from_edges`, or from a graph of NetworkX by :meth:`from_networkx`; the last two
    attributes follow. A graph that is given no coordinates gets them from its distances, see
    :func:`~torchrl_pomdp.envs.repair.layout.places`: left is then what is nearer to one end of the graph, right to the other.

    Attributes:
        name: how the graph calls itself in descriptions.
        neighbours: int64 ``[L, S]``; node reached from a node along a slot, or -1 where there is no edge.
        slot_names: the ``S`` names of the directions.
        columns: float32 ``[L]``; the horizontal coordinate, for drawing and for "left" and "right" damage.
        rows: float32 ``[L]``; the vertical coordinate, for drawing. Columns or rows alone: the others are zero.
        location_names: the ``L`` names of the locations; by default their numbers.
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
    columns: Tensor = None  # type: ignore[assignment]
    rows: Tensor = None  # type: ignore[assignment]
    location_names: tuple[str, ...] = ()
    distances: Tensor = field(init=False)
    first_controls: Tensor = field(init=False)

    def __post_init__(self) -> None:
        check_text("name", self.name)
        table = _slot_table(self.neighbours)
        size, num_slots = table.shape
        names = _names("slot_names", self.slot_names, num_slots)
        if "repair" in names:
            raise ValueError("slot_names must not hold 'repair', the name of the control that does not move")
        called = _sequence("location_names", self.location_names) or [str(location) for location in range(size)]
        called = _names("location_names", called, size)
        distances = _distances(table)
        columns, rows = _coordinates(self.columns, self.rows, distances)
        derived = {"distances": distances, "first_controls": _first_controls(table, distances)}
        given = {"neighbours": table, "slot_names": names, "columns": columns, "rows": rows, "location_names": called}
        for key, value in {**given, **derived}.items():
            object.__setattr__(self, key, value)

    @classmethod
    def from_slots(
        cls,
        name: str,
        neighbours: Sequence[Sequence[int]],
        slot_names: Sequence[str],
        columns: Sequence[float] | None = None,
        rows: Sequence[float] | None = None,
        location_names: Sequence[str] = (),
    ) -> Graph:
        """Build a graph from its slot table ``neighbours[node][slot]`` (-1 for no edge), in plain sequences.

        Raises:
            TypeError: if an argument is of the wrong kind.
            ValueError: if this is no graph, see the class.

        Examples:
            >>> Graph.from_slots("pipe", [[1], [0]], ["across"], [0, 1], [0, 0]).distances.tolist()
            [[0, 1], [1, 0]]
        """
        values: Sequence[Any] = (neighbours, slot_names, columns, rows, location_names)
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
        location_names: Sequence[str] = (),
    ) -> Graph:
        """Build an arbitrary undirected graph from pairs of 0-based locations; slots are the sorted neighbours.

        Args:
            name: how the graph calls itself.
            num_locations: L.
            edges: pairs of different locations.

        Keyword Args:
            columns: horizontal coordinates.
            rows: vertical coordinates. Without any, both follow from the distances.
            location_names: names of the locations; by default their numbers.

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
        return cls.from_slots(name, table, [f"neighbour {s}" for s in range(degree)], columns, rows, location_names)

    @classmethod
    def from_networkx(
        cls, graph: Any, *, name: str | None = None, positions: Mapping[Any, Sequence[float]] | None = None
    ) -> Graph:
        """Build a graph from one of NetworkX, or from anything with ``nodes`` and ``edges``; nodes may be any objects.

        Locations are numbered in the order of the nodes, and called what the nodes are as texts.

        Args:
            graph: the undirected graph.

        Keyword Args:
            name: how the graph calls itself; None: its number of locations.
            positions: column and row of every node; None: both follow from the distances.

        Raises:
            TypeError: if it is no graph, or an argument is of the wrong kind.
            ValueError: if it is directed, nodes are the same as texts, a node has no position, or by :meth:`from_edges`.

        Examples:
            >>> import networkx
            >>> plant = networkx.Graph([("pump", "tank"), ("tank", "valve")])
            >>> graph = Graph.from_networkx(plant)
            >>> graph.location_names, graph.columns.tolist()
            (('pump', 'tank', 'valve'), [0.0, 1.0, 2.0])
        """
        if not isinstance(getattr(graph, "nodes", None), Iterable) or not isinstance(getattr(graph, "edges", None), Iterable):
            raise TypeError(f"graph must have nodes and edges, as those of NetworkX have, got {shown(graph)}")
        if getattr(graph, "is_directed", bool)():
            raise ValueError(f"graph must be undirected, got {shown(graph)}: use its to_undirected()")
        nodes = list(graph.nodes)
        number = {node: location for location, node in enumerate(nodes)}
        columns, rows = (None, None) if positions is None else _positions(positions, nodes)
        return cls.from_edges(
            f"graph of {len(nodes)}" if name is None else name,
            len(nodes),
            [(number[first], number[second]) for first, second, *_ in graph.edges],
            columns=columns,
            rows=rows,
            location_names=[str(node) for node in nodes],
        )

    def without_edge(self, first: int, second: int) -> Graph:
        """The same graph with a blocked edge: locations, slots and places stay, so that an old policy still fits.

        Args:
            first: one end.
            second: the other end.

        Raises:
            TypeError: if an end is no integer.
            ValueError: if there is no such edge, or a location can no longer be reached.

        Examples:
            >>> grid(2, 2).without_edge(0, 1).neighbours.tolist()
            [[-1, -1, -1, 2], [-1, -1, -1, 3], [-1, 3, 0, -1], [2, -1, 1, -1]]
        """
        ends = [check_integer(name, end, 0, self.num_locations - 1) for name, end in (("first", first), ("second", second))]
        if ends[1] not in self.neighbours[ends[0]].tolist():
            raise ValueError(f"first and second must be the ends of an edge, got {first} and {second}")
        table = self.neighbours.clone()
        for one, other in (ends, ends[::-1]):
            table[one, table[one] == other] = -1
        name = f"{self.name} without {self.location_names[ends[0]]}-{self.location_names[ends[1]]}"
        return Graph(name, table, self.slot_names, self.columns, self.rows, self.location_names)

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


def grid(width: int, height: int, obstacles: Iterable[Sequence[int]] = ()) -> Graph:
    """A rectangular grid, numbered row by row; controls are repair, left, right, up, down.

    Args:
        width: number of columns, at least 1.
        height: number of rows, at least 1; there are at most 1024 locations.
        obstacles: cells ``(column, row)`` that are no locations; the others are numbered without them, and remain connected.

    Raises:
        TypeError: if a size is no integer, or an obstacle no pair of integers.
        ValueError: if a size is not positive, there are too many locations, an obstacle is no cell or is given twice, or the
            obstacles leave no location or tear the grid apart.

    Examples:
        >>> grid(3, 2).neighbours[4].tolist()
        [3, 5, 1, -1]
        >>> grid(3, 2, obstacles=[(1, 0)]).neighbours.tolist()
        [[-1, -1, -1, 2], [-1, -1, -1, 4], [-1, 3, 0, -1], [2, 4, -1, -1], [3, -1, 1, -1]]
    """
    check_integer("width", width, 1, MAX_LOCATIONS)
    check_integer("height", height, 1, MAX_LOCATIONS)
    if width * height > MAX_LOCATIONS:
        raise ValueError(f"width times height must be at most {MAX_LOCATIONS} locations, got {width} x {height}")
    blocked = _cells(obstacles, width, height)
    places = [(column, row) for row in range(height) for column in range(width) if (column, row) not in blocked]
    if not places:
        raise ValueError("obstacles must leave a location, got one on every cell")
    number = {place: location for location, place in enumerate(places)}
    table = [[number.get(to, -1) for to in ((c - 1, r), (c + 1, r), (c, r - 1), (c, r + 1))] for c, r in places]
    columns, rows = zip(*places, strict=True)
    name = f"{width} x {height} grid" + (f" with {len(blocked)} obstacles" if blocked else "")
    try:
        return Graph.from_slots(name, table, ("left", "right", "up", "down"), columns, rows)
    except ValueError as error:
        if not blocked:
            raise
        raise ValueError(f"obstacles must leave the grid connected: {error}") from error


def _cells(obstacles: Any, width: int, height: int) -> set[tuple[int, int]]:
    """Different cells of a grid."""
    if not isinstance(obstacles, Iterable) or isinstance(obstacles, (str, bytes)):
        raise TypeError(f"obstacles must hold cells (column, row), got {shown(obstacles)}")
    cells: set[tuple[int, int]] = set()
    for i, cell in enumerate(obstacles):
        pair = _sequence(f"obstacles[{i}]", cell)
        if len(pair) != 2:
            raise ValueError(f"obstacles[{i}] must be a cell (column, row), got {shown(cell)}")
        column, row = (check_integer(f"obstacles[{i}]", each) for each in pair)
        if not (0 <= column < width and 0 <= row < height) or (column, row) in cells:
            raise ValueError(f"obstacles must hold different cells of the {width} x {height} grid, got {(column, row)}")
        cells.add((column, row))
    return cells


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


def _names(name: str, value: Any, count: int) -> tuple[str, ...]:
    """So many different names."""
    names = tuple(_sequence(name, value))
    if len(names) != count:
        raise ValueError(f"{name} must hold {count} names, got {len(names)}")
    for i, each in enumerate(names):
        check_text(f"{name}[{i}]", each)
    if len(set(names)) < count:
        raise ValueError(f"{name} must hold different names, got {shown(names)}")
    return names


def _coordinates(columns: Any, rows: Any, distances: Tensor) -> tuple[Tensor, Tensor]:
    """Coordinates, from the distances where there are none; raises unless every location has a place of its own."""
    if columns is None and rows is None:
        return places(distances)
    size = len(distances)
    given = [("columns", [0] * size if columns is None else columns), ("rows", [0] * size if rows is None else rows)]
    across, down = (check_tensor(n, check_tensor(n, c, (size,)).float()).detach().clone() for n, c in given)
    _check_distinct(across, down)
    return across, down


def _positions(positions: Any, nodes: Sequence[Any]) -> tuple[list[float], list[float]]:
    """Columns and rows of the nodes."""
    if not isinstance(positions, Mapping):
        raise TypeError(f"positions must map nodes to column and row, got {shown(positions)}")
    pairs = []
    for node in nodes:
        place = positions.get(node, ())
        pair = _sequence(f"positions[{shown(node)}]", place.tolist() if hasattr(place, "tolist") else place)
        if len(pair) != 2:
            raise ValueError(f"positions must hold column and row of every node, got {shown(pair)} for {shown(node)}")
        pairs.append([check_number(f"position of {shown(node)}", number) for number in pair])
    return [column for column, _ in pairs], [row for _, row in pairs]


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
