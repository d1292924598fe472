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
# Columns of vectors that are compared at once.
_COLUMNS = 16
# Rows without a use that are borne in any case.
_SPARE = 256


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

    def keep(self, which: NDArray[np.bool_]) -> None:
        """Drop all other rows."""
        kept = self.rows[which]
        self._all[: len(kept)] = kept
        self.count = len(kept)

    @property
    def rows(self) -> NDArray:
        return self._all[: self.count]


@dataclass(eq=False, slots=True)
class Node:
    """A belief, by the states of its support and their probabilities, with its bounds.

    ``best`` is the vector of the upper bound, ``point`` the node's own point of the lower one, -1 for none; ``vectors`` and
    ``points`` say how many of each have been looked at. ``edges`` are, once it is expanded, for each control that may be best
    the stage cost and for each observation its number, probability and next belief.
    """

    states: Integers
    probs: Floats
    bits: NDArray[np.uint8]
    corners: float
    lower: float
    upper: float = np.inf
    best: int = 0
    point: int = -1
    vectors: int = 0
    points: int = 0
    edges: list[tuple[int, float, list[tuple[int, float, Node]]]] | None = None

    @property
    def gap(self) -> float:
        """Upper minus lower bound."""
        return self.upper - self.lower


class Search:
    """Bounds of the optimal cost at start beliefs, and the trials that tighten them.

    Plans that cost no less than a later one in any state give way to it, and points of a belief to its later ones.

    Args:
        table: the model.
        until: when the first bounds are left as they are.

    Attributes:
        vectors: costs of plans by state, ``[N, n]``; the first one is that of any legal policy.
        controls: first control of each plan.
        successors: for each plan the plans that it goes on with, by observation.
        largest_support: the most states that a belief was spread over.
        top: a number that the least of the vectors that are kept exceeds at no belief.
        bottom: the least number of all vectors and of the informed bound.
    """

    def __init__(self, table: JointTable, until: float) -> None:
        self.table = table
        n = table.num_states
        self.informed = table.informed(until)
        self.corner: Floats = self.informed.min(1)
        self.vectors = _Rows(n)
        self.controls: list[int] = []
        self.successors: list[Integers] = []
        # For each vector the one that it gave way to, or itself, and whether it did not; which points are the latest of their
        # beliefs.
        self._instead: list[int] = []
        self._alive = _Rows(1, np.bool_)
        self._latest: list[bool] = []
        self._beaten = self._outdated = 0
        self._inverse, self._bits, self._gain = _Rows(n), _Rows(-(-n // 8), np.uint8), _Rows(1)
        self._nodes: dict[bytes, Node] = {}
        self.largest_support = 0
        self.bottom = float(self.informed.min())
        self._flattest, self.top = 0, np.inf
        worst = table.worst(until)
        self._add_vector(ANY, worst, np.zeros(0, np.int64))
        for u in range(table.num_controls):
            vector = table.constant(u, worst, until)
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
            branches = [(int(z), float(probs[z]), self.node(spread[z] / probs[z])) for z in seen]
            # Whoever may take any legal control may take this one.
            for _, _, child in branches:
                if child.lower == np.inf:
                    raise _stuck(child)
            node.edges.append((u, cost, branches))
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
        # A discount near 1 makes walks long.
        for node in reversed(path):
            if monotonic() >= until:
                break
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
                chosen[z] = self._current(child.best)
            u = node.edges[number][0]
            vector = self.table.backup(u, self.vectors.rows, chosen)
            # By rounding it may be none the better.
            if float(vector[node.states] @ node.probs) < node.upper:
                self._add_vector(u, vector, chosen)
        self.refresh(node)
        self._tidy()

    # ---- what is kept ----------------------------------------------------------------------------------------------

    def kept(self) -> list[int]:
        """Numbers of the vectors that are best somewhere and of those that they go on with.

        What they are worth, the least of them at each belief, is then no less than what following them costs.
        """
        found: set[int] = set()
        waiting = {0, self._flattest} | {node.best for node in self._nodes.values() if node.edges is not None}
        while waiting := {self._current(number) for number in waiting} - found:
            found |= waiting
            waiting = set(np.unique(np.concatenate([self.successors[number] for number in waiting])).tolist())
        return sorted(found, reverse=True)

    def _add_vector(self, control: int, vector: Floats, successors: Integers) -> None:
        number, left = self.vectors.count, np.flatnonzero(self._alive.rows)
        for first in range(0, len(vector), _COLUMNS):
            part = slice(first, first + _COLUMNS)
            left = left[(self.vectors.rows[left, part] >= vector[part]).all(1)]
        for beaten in left.tolist():
            self._instead[beaten] = number
        self._alive.rows[left] = False
        self._beaten += len(left)
        self._alive.append(np.ones(1, np.bool_))
        self.vectors.append(vector)
        self.controls.append(control)
        self.successors.append(successors)
        self._instead.append(number)
        self.bottom = min(self.bottom, float(vector.min()))
        if vector.max() < self.top:
            self._flattest, self.top = number, float(vector.max())

    def _current(self, number: int) -> int:
        """The vector that a vector gave way to, or itself."""
        instead = self._instead
        while instead[number] != number:
            instead[number] = number = instead[instead[number]]
        return number

    def _add_point(self, node: Node, lower: float) -> None:
        node.lower = lower
        inverse = np.full(self.table.num_states, np.inf)
        inverse[node.states] = 1.0 / node.probs
        if node.point >= 0:
            self._latest[node.point] = False
            self._outdated += 1
        node.point = self._bits.count
        self._latest.append(True)
        self._inverse.append(inverse)
        self._bits.append(node.bits)
        self._gain.append(np.array([lower - node.corners]))

    def _tidy(self) -> None:
        """Drop vectors that gave way and points that are outdated, once there are more of them than of all else."""
        fewest = max(_SPARE, len(self._nodes))
        if self._beaten > max(fewest, self.vectors.count // 2):
            self._drop_vectors()
        if self._outdated > max(fewest, self._bits.count // 2):
            self._drop_points()

    def _drop_vectors(self) -> None:
        current = [self._current(number) for number in range(self.vectors.count)]
        keep = self._alive.rows[:, 0].copy()
        # How many are kept of the first so many; of one that is kept that is its new number.
        number = np.concatenate([[0], keep.cumsum()])
        for node in self._nodes.values():
            node.best, node.vectors = int(number[current[node.best]]), int(number[node.vectors])
        self._flattest = int(number[current[self._flattest]])
        self.vectors.keep(keep)
        self._alive.keep(keep)
        self.controls = [control for control, kept in zip(self.controls, keep, strict=True) if kept]
        renamed = number[current]
        self.successors = [renamed[each] for each, kept in zip(self.successors, keep, strict=True) if kept]
        self._instead, self._beaten = list(range(self.vectors.count)), 0

    def _drop_points(self) -> None:
        keep = np.array(self._latest)
        number = np.concatenate([[0], keep.cumsum()])
        for node in self._nodes.values():
            node.points = int(number[node.points])
            node.point = -1 if node.point < 0 else int(number[node.point])
        for rows in (self._inverse, self._bits, self._gain):
            rows.keep(keep)
        self._latest, self._outdated = [True] * self._bits.count, 0


def _stuck(node: Node) -> ValueError:
    return ValueError(
        "belief must not lead to one whose states share no legal control: "
        f"one of the states {node.states.tolist()} is such a belief, or leads to one whatever is done"
    )
