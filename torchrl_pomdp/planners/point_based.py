r"""Point-based search for an upper and a lower bound of the optimal cost (Smith and Simmons 2005, HSVI2; cited in Section I).

Upper bound: the least of many vectors ``[n]``, each the cost of a plan by state. Lower bound: the concave roof over the
corners, with costs from the fast informed bound, and over beliefs whose lower bound is known (*sawtooth*). A trial goes from a
start belief to where the bounds are farthest apart, and backs both of them up on its way home.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from torchrl_pomdp.planners.joint_table import Floats, Integers, JointTable

__all__ = ["ANY", "DIGITS", "Node", "Search"]

ANY = -1
"""Control of the vector that no legal policy exceeds: any legal one."""

# Beliefs that agree to so many digits are one.
DIGITS = 14


class _Rows:
    """Rows of equal length that are appended to."""

    def __init__(self, width: int, dtype: type = float) -> None:
        self._all: NDArray = np.empty((256, width), dtype)
        self.count = 0

    def append(self, row: NDArray) -> None:
        if self.count == len(self._all):
            self._all = np.concatenate([self._all, np.empty_like(self._all)])
        self._all[self.count] = row
        self.count += 1

    @property
    def rows(self) -> NDArray:
        return self._all[: self.count]


@dataclass(eq=False, slots=True)
class Node:
    """A belief, by the states of its support and their probabilities, with its bounds.

    ``best`` is the vector of the upper bound; ``vectors`` and ``points`` say how many of each have been looked at. ``edges``
    are, once it is expanded, for each control that may be best the stage cost and for each observation its number, probability
    and next belief.
    """

    states: Integers
    probs: Floats
    bits: NDArray[np.uint8]
    corners: float
    lower: float
    upper: float = np.inf
    best: int = 0
    vectors: int = 0
    points: int = 0
    edges: list[tuple[int, float, list[tuple[int, float, Node]]]] | None = None

    @property
    def gap(self) -> float:
        """Upper minus lower bound."""
        return self.upper - self.lower


class Search:
    """Bounds of the optimal cost at start beliefs, and the trials that tighten them.

    Args:
        table: the model.

    Attributes:
        vectors: costs of plans by state, ``[N, n]``; the first one is that of any legal policy.
        controls: first control of each plan.
        successors: for each plan the plans that it goes on with, by observation.
        largest_support: the most states that a belief was spread over.
    """

    def __init__(self, table: JointTable) -> None:
        self.table = table
        n = table.num_states
        self.informed = table.informed()
        self.corner: Floats = self.informed.min(1)
        self.vectors = _Rows(n)
        self.controls: list[int] = []
        self.successors: list[Integers] = []
        self._inverse, self._bits, self._gain = _Rows(n), _Rows(-(-n // 8), np.uint8), _Rows(1)
        self._nodes: dict[bytes, Node] = {}
        self.largest_support = 0
        worst = table.worst()
        self._add_vector(ANY, worst, np.zeros(0, np.int64))
        for u in range(table.num_controls):
            vector = table.constant(u, worst)
            if np.isfinite(vector).any():
                self._add_vector(u, vector, np.full(1, self.vectors.count))

    # ---- beliefs ---------------------------------------------------------------------------------------------------

    def node(self, belief: Floats) -> Node:
        """The node of a belief ``[n]`` that sums to one."""
        states = np.flatnonzero(belief)
        probs = belief[states]
        key = states.tobytes() + np.round(probs, DIGITS).tobytes()
        node = self._nodes.get(key)
        if node is None:
            bits = np.packbits(belief > 0)
            corners = float(self.corner[states] @ probs)
            informed = float((probs @ self.informed[states]).min())
            node = self._nodes[key] = Node(states, probs, bits, corners, max(corners, informed))
            self.largest_support = max(self.largest_support, len(states))
        self.refresh(node)
        return node

    def start(self, belief: Floats) -> Node:
        """The node of a start belief ``[n]``, expanded.

        Raises:
            ValueError: if its states share no legal control, or come to where they share none.
        """
        node = self.node(belief)
        if node.lower == np.inf:
            raise _stuck(node)
        if node.edges is None:
            self._expand(node)
        return node

    def refresh(self, node: Node) -> None:
        """Look at the vectors and points that are new since last time."""
        if node.vectors < self.vectors.count:
            values = self.vectors.rows[node.vectors :].take(node.states, 1) @ node.probs
            best = int(values.argmin())
            if values[best] < node.upper:
                node.upper, node.best = float(values[best]), node.vectors + best
            node.vectors = self.vectors.count
        if node.points < self._bits.count:
            inside = ~(self._bits.rows[node.points :] & ~node.bits).any(1)
            index = np.flatnonzero(inside) + node.points
            if len(index):
                shares = (self._inverse.rows[index].take(node.states, 1) * node.probs).min(1)
                node.lower = max(node.lower, node.corners + float((shares * self._gain.rows[index, 0]).max()))
            node.points = self._bits.count

    def _expand(self, node: Node) -> None:
        node.edges = []
        for u in range(self.table.num_controls):
            cost = float(self.table.cost[u, node.states] @ node.probs)
            if cost == np.inf:
                continue
            spread = self.table.spread(u, node.states, node.probs)
            probs = spread.sum(1)
            seen = np.flatnonzero(probs > 0)
            node.edges.append((u, cost, [(int(z), float(probs[z]), self.node(spread[z] / probs[z])) for z in seen]))
        if not node.edges:
            raise _stuck(node)

    # ---- trials ----------------------------------------------------------------------------------------------------

    def trial(self, root: Node, target: float, until: float) -> None:
        """Go where the gap is, up to beliefs whose gap weighs less than ``target`` at the root, and back the path up."""
        path, node = [], root
        while node.gap > target and monotonic() < until:
            path.append(node)
            target /= self.table.discount
            node = self._next(node, target)
        for node in reversed(path):
            self.backup(node)

    def _next(self, node: Node, target: float) -> Node:
        """The next belief: of the control with the least lower bound, where the gap above the target weighs most."""
        if node.edges is None:
            self._expand(node)
        _, _, branches = min(self._q(node), key=lambda q: q[0])
        return max(branches, key=lambda branch: branch[1] * (branch[2].gap - target))[2]

    def _q(self, node: Node) -> list[tuple[float, float, list[tuple[int, float, Node]]]]:
        """Lower and upper bound of each control that may be best, with what it leads to; drops those that cannot be."""
        assert node.edges is not None
        result, alpha = [], self.table.discount
        for _, cost, branches in node.edges:
            lower = upper = cost
            for _, p, child in branches:
                self.refresh(child)
                lower += alpha * p * child.lower
                upper += alpha * p * child.upper
            result.append((lower, upper, branches))
        best = min(result, key=lambda q: q[1])
        kept = [q is best or q[0] <= best[1] for q in result]
        if all(kept):
            return result
        node.edges = [edge for edge, keep in zip(node.edges, kept, strict=True) if keep]
        return [q for q, keep in zip(result, kept, strict=True) if keep]

    def backup(self, node: Node) -> None:
        """Tighten both bounds at an expanded node from those of its successors."""
        q = self._q(node)
        assert node.edges is not None
        self.refresh(node)
        lower = min(each[0] for each in q)
        if lower == np.inf:
            raise _stuck(node)
        if lower > node.lower:
            self._add_point(node, lower)
        number = min(range(len(q)), key=lambda k: q[k][1])
        if q[number][1] < node.upper:
            chosen = np.zeros(self.table.num_observations, np.int64)
            for z, _, child in q[number][2]:
                chosen[z] = child.best
            u = node.edges[number][0]
            self._add_vector(u, self.table.backup(u, self.vectors.rows, chosen), chosen)
        self.refresh(node)

    def kept(self) -> list[int]:
        """Numbers of the vectors that are best somewhere and of those that they go on with, but for those that others beat.

        What they are worth, the least of them at each belief, is then no less than what following them costs.
        """
        found: set[int] = set()
        waiting = {0} | {node.best for node in self._nodes.values() if node.edges is not None}
        while waiting:
            found |= waiting
            waiting = {int(k) for number in waiting for k in self.successors[number]} - found
        numbers = sorted(found, reverse=True)
        rows, kept = self.vectors.rows[numbers], np.ones(len(numbers), bool)
        for k, row in enumerate(rows):
            kept[k] = False
            kept[k] = not (kept & (rows <= row).all(1)).any()
        return [number for number, keep in zip(numbers, kept, strict=True) if keep]

    def _add_vector(self, control: int, vector: Floats, successors: Integers) -> None:
        self.vectors.append(vector)
        self.controls.append(control)
        self.successors.append(successors)

    def _add_point(self, node: Node, lower: float) -> None:
        node.lower = lower
        inverse = np.full(self.table.num_states, np.inf)
        inverse[node.states] = 1.0 / node.probs
        self._inverse.append(inverse)
        self._bits.append(node.bits)
        self._gain.append(np.array([lower - node.corners]))


def _stuck(node: Node) -> ValueError:
    return ValueError(f"belief must not lead to one whose states share no legal control, such as {node.states.tolist()}")
