"""DESPOT's search as a compiled loop over a tree in flat arrays.

All sums are weighted: those of a node over its scenarios, times the discount of its depth, over the number of all scenarios.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_pomdp.scalar.compiling import inner, outer, shared
from torchrl_pomdp.scalar.models import (
    costs,
    keep,
    mask,
    move,
    over,
    preferred,
    recall,
    relaxed,
    remaining,
    see,
    seen_after,
    settle,
    start,
)
from torchrl_pomdp.scalar.noise import Noise, fold

__all__ = ["CROSSED", "FINE", "ILLEGAL", "OVER", "Despot", "Options", "answer", "expand", "walk"]

# How a call of expand ends.
FINE, ILLEGAL, CROSSED = range(3)
# What walk gives in place of a node: the exploration is over.
OVER = -1
# What rounding may do to bounds, relative to them.
_ROUNDING = 1e-9


class Options(NamedTuple):
    """Numbers of a search; see :class:`~torchrl_pomdp.planners.DESPOT`.

    ``tight``: whether the model's relaxation bounds costs; ``random``: whether the base policy draws its controls.
    """

    scenarios: int
    depth: int
    regularisation: float
    gap: float
    discount: float
    tight: bool
    random: bool


class Despot(NamedTuple):
    """The tree: histories that some scenario leads to.

    Attributes:
        size: numbers of nodes and of entries of ``members`` in use, ``[2]``.
        chosen: control of the base policy at the root, -1 where it is drawn, ``[1]``.
        rows: states of the model, ``[N, W]``.
        seen: variables that its scenarios have seen, ``[N]``.
        parents: ``[N]``.
        depths: ``[N]``.
        first: where its scenarios begin in ``members``, ``[N]``.
        counts: how many they are, ``[N]``.
        members: numbers of scenarios, ``[M]``.
        lower: of the regularised cost of the best policy tree, ``[N]``.
        upper: cost of the best policy tree found, regularised, ``[N]``.
        base: cost of the base policy, ``[N]``.
        gaps: between that and the lower bound at first, ``[N]``.
        ended: whether no cost follows, ``[N]``.
        open: whether it has no children yet and may get some, ``[N]``.
        legal: ``[N, U]``.
        costs: stage costs of the controls, weighted, ``[N, U]``.
        children: the first child by each control; they lie side by side, ``[N, U]``.
        branches: their number, ``[N, U]``.
    """

    size: NDArray[np.int64]
    chosen: NDArray[np.int64]
    rows: NDArray[np.float64]
    seen: NDArray[np.uint64]
    parents: NDArray[np.int64]
    depths: NDArray[np.int64]
    first: NDArray[np.int64]
    counts: NDArray[np.int64]
    members: NDArray[np.int64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    base: NDArray[np.float64]
    gaps: NDArray[np.float64]
    ended: NDArray[np.bool_]
    open: NDArray[np.bool_]
    legal: NDArray[np.bool_]
    costs: NDArray[np.float64]
    children: NDArray[np.int64]
    branches: NDArray[np.int64]


@inner
def _scenario(key, member, options, seen):
    return Noise(fold(key, np.uint64(member)), key, member, options.scenarios, seen)


@inner
def _weight(tree, node, options):
    """Of one scenario at a node."""
    return options.discount ** tree.depths[node] / options.scenarios


@shared
def _evaluate(model, policy, state, tree, node, key, options, least):
    """First bounds of a node whose state is in ``state``: by the base policy, and by the model."""
    tree.ended[node] = over(model, state)
    tree.open[node], steps = not tree.ended[node], 0
    if tree.ended[node]:
        tree.base[node], tree.lower[node], tree.upper[node], tree.gaps[node] = 0.0, 0.0, 0.0, 0.0
        return steps, FINE
    mask(model, state, tree.legal[node])
    weight, seen = _weight(tree, node, options), tree.seen[node]
    low, high = 0.0, 0.0
    for i in range(tree.counts[node]):
        noise = _scenario(key, tree.members[tree.first[node] + i], options, seen)
        low += relaxed(model, state, noise) if options.tight else least
    for i in range(tree.counts[node]):
        if i > 0:
            recall(model, state, tree.rows[node])
        noise = _scenario(key, tree.members[tree.first[node] + i], options, seen)
        cost, more, well = remaining(model, policy, state, noise)
        if not well:
            return steps, ILLEGAL
        high += cost
        steps += more
    if low > high + _ROUNDING * (abs(low) + abs(high)):
        return steps, CROSSED
    tree.base[node], tree.upper[node] = weight * high, weight * high
    tree.gaps[node] = max(weight * (high - low), 0.0)
    tree.lower[node] = min(weight * low + options.regularisation, weight * high)
    return steps, FINE


@shared
def _branch(model, state, tree, node, u, key, options, numbers):
    """Make the children of a node by a control, one for each observation of its scenarios; returns how many they are.

    ``numbers`` ``[2, K]`` is memory: observations of the scenarios, and those that have been given to a child.
    """
    recall(model, state, tree.rows[node])
    move(model, state, u)
    seen, count = tree.seen[node], tree.counts[node]
    after = seen_after(model, state, seen)
    for i in range(count):
        numbers[i] = see(model, state, _scenario(key, tree.members[tree.first[node] + i], options, seen))
    made = 0
    for i in range(count):
        z = numbers[i]
        if z < 0:
            continue
        child, first = tree.size[0], tree.size[1]
        last = first
        for j in range(i, count):
            if numbers[j] == z:
                tree.members[last] = tree.members[tree.first[node] + j]
                numbers[j] = -1
                last += 1
        tree.size[0], tree.size[1] = child + 1, last
        tree.parents[child], tree.depths[child], tree.seen[child] = node, tree.depths[node] + 1, after
        tree.first[child], tree.counts[child] = first, last - first
        # Until its state is put there: the observation that leads to it.
        tree.rows[child, 0] = z
        made += 1
    return made


@shared
def _plant(model, policy, state, tree, options):
    """Put the root, with all scenarios, into the tree."""
    start(model, state)
    tree.chosen[0] = -1 if options.random else preferred(model, policy, state)
    start(model, state)
    keep(model, state, tree.rows[0])
    tree.size[0], tree.size[1], tree.parents[0], tree.depths[0], tree.seen[0] = 1, options.scenarios, -1, 0, np.uint64(0)
    tree.first[0], tree.counts[0] = 0, options.scenarios
    for member in range(options.scenarios):
        tree.members[member] = member


@outer
def expand(model, policy, state, tree, numbers, key, node, options, least):
    """Give a node its children by all legal controls; there is room for them. The tree of no nodes gets its root.

    Args:
        model: scalar model.
        policy: base policy, pair of twin and data.
        state: of the model, with the root in it.
        tree: the tree.
        numbers: memory, int64 ``[K]``.
        key: of the root, unsigned.
        node: the node; -1 for the root of an empty tree.
        options: of the search.
        least: a cost below that of any policy from any state; the lower bound unless ``options.tight``.

    Returns:
        number of steps, and how it has ended.
    """
    steps, new = 0, tree.size[0]
    if node < 0:
        _plant(model, policy, state, tree, options)
        if tree.chosen[0] < 0 and not options.random and not over(model, state):
            return steps, ILLEGAL
    else:
        weight = _weight(tree, node, options) * tree.counts[node]
        tree.open[node] = False
        recall(model, state, tree.rows[node])
        costs(model, state, tree.costs[node])
        for u in range(tree.legal.shape[1]):
            tree.branches[node, u], tree.children[node, u] = 0, tree.size[0]
            tree.costs[node, u] *= weight
            if tree.legal[node, u]:
                tree.branches[node, u] = _branch(model, state, tree, node, u, key, options, numbers)
    u = 0
    for child in range(new, tree.size[0]):
        if node >= 0:
            while child >= tree.children[node, u] + tree.branches[node, u]:
                u += 1
            recall(model, state, tree.rows[node])
            move(model, state, u)
            settle(model, state, np.int64(tree.rows[child, 0]))
            keep(model, state, tree.rows[child])
        more, how = _evaluate(model, policy, state, tree, child, key, options, least)
        steps += more
        if how != FINE:
            return steps, how
    return steps, FINE


@inner
def _through(tree, node, u, bounds):
    """The sum of a bound over the children by a control."""
    total, first = 0.0, tree.children[node, u]
    for child in range(first, first + tree.branches[node, u]):
        total += bounds[child]
    return total


@shared
def _best(tree, node, bounds, options):
    """The control that is best by a bound, and its cost with the regularisation."""
    best, lowest = -1, np.inf
    for u in range(tree.legal.shape[1]):
        if tree.legal[node, u]:
            cost = tree.costs[node, u] + options.regularisation + _through(tree, node, u, bounds)
            if best < 0 or cost < lowest:
                best, lowest = u, cost
    return best, lowest


@inner
def _excess(tree, node, options):
    """By how much the gap of a node exceeds its share of what is wanted at the root."""
    wanted = options.gap * (tree.upper[0] - tree.lower[0]) * tree.counts[node] / options.scenarios
    return tree.upper[node] - tree.lower[node] - wanted


@inner
def _blocked(tree, node, options):
    """Whether more of the tree below an ancestor cannot pay for its size."""
    if options.regularisation == 0.0:
        return False
    # The node's own test is that of its first bounds.
    ancestor, nodes = tree.parents[node], 2
    while ancestor >= 0:
        if tree.gaps[ancestor] <= options.regularisation * nodes:
            return True
        ancestor, nodes = tree.parents[ancestor], nodes + 1
    return False


@inner
def _close(tree, node):
    """The base policy is followed from a node on."""
    tree.open[node] = False
    tree.lower[node] = tree.base[node]
    tree.upper[node] = tree.base[node]


@shared
def _back_up(tree, node, options):
    """Bounds from those of the children, up to the root; returns whether they have crossed."""
    while node >= 0:
        _, low = _best(tree, node, tree.lower, options)
        _, high = _best(tree, node, tree.upper, options)
        tree.lower[node] = min(max(tree.lower[node], low), tree.base[node])
        tree.upper[node] = min(tree.upper[node], high)
        if tree.lower[node] > tree.upper[node] + _ROUNDING * (abs(tree.lower[node]) + abs(tree.upper[node])):
            return True
        node = tree.parents[node]
    return False


@outer
def walk(tree, node, options):
    """Go down from the root, or on from a node that has just got its children, to a node that shall get some.

    Args:
        tree: the tree; its bounds are brought up to date.
        node: the node, or -1 to begin at the root.
        options: of the search.

    Returns:
        the node, or :data:`OVER`; and whether a lower bound exceeds an upper one.
    """
    if node >= 0 and _back_up(tree, node, options):
        return OVER, True
    node = max(node, 0)
    while True:
        if tree.open[node]:
            if tree.depths[node] < options.depth and not _blocked(tree, node, options):
                return node, False
            _close(tree, node)
            return OVER, node > 0 and _back_up(tree, tree.parents[node], options)
        if tree.ended[node]:
            return OVER, False
        u, _ = _best(tree, node, tree.lower, options)
        following, most = -1, 0.0
        for child in range(tree.children[node, u], tree.children[node, u] + tree.branches[node, u]):
            excess = _excess(tree, child, options)
            if excess > most:
                following, most = child, excess
        if following < 0:
            return OVER, False
        node = following


@outer
def answer(tree, options, q):
    """Put into ``q`` ``[U]`` the cost of each legal control of a root with children, in the best tree that starts with it."""
    for u in range(len(q)):
        if tree.legal[0, u]:
            q[u] = tree.costs[0, u] + options.regularisation + _through(tree, 0, u, tree.upper)
    # The base policy is one way to go on after its own control; random play has none.
    if tree.chosen[0] >= 0:
        q[tree.chosen[0]] = min(q[tree.chosen[0]], tree.base[0])
