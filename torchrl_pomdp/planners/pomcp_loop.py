"""POMCP's search as a compiled loop over a tree in flat arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_pomdp.scalar.compiling import inner, outer
from torchrl_pomdp.scalar.models import costs, mask, move, over, remaining, see, seen_after, settle, start
from torchrl_pomdp.scalar.noise import Noise, finished, fold

__all__ = ["Path", "Tree", "put_edges", "search"]

_EMPTY = -1


class Tree(NamedTuple):
    """Histories that have been met: node n, control u and observation z lead to the node that ``children`` names.

    Attributes:
        size: number of nodes, ``[1]``.
        spread: lowest and highest cost of the simulations from the root, ``[2]``.
        counts: simulations that took a control, ``[N, U]``.
        means: their mean cost, ``[N, U]``.
        costs: expected stage costs, ``[N, U]``.
        legal: ``[N, U]``.
        ended: whether no cost follows, ``[N]``.
        names: of the edges, a hash table with open addresses, ``[H]``.
        children: the nodes that they lead to, -1 where the table is empty, ``[H]``.
    """

    size: NDArray[np.int64]
    spread: NDArray[np.float64]
    counts: NDArray[np.int64]
    means: NDArray[np.float64]
    costs: NDArray[np.float64]
    legal: NDArray[np.bool_]
    ended: NDArray[np.bool_]
    names: NDArray[np.uint64]
    children: NDArray[np.int64]


class Path(NamedTuple):
    """The nodes and the controls of a simulation, ``[m]``."""

    nodes: NDArray[np.int64]
    controls: NDArray[np.int64]


@inner
def _slot(tree, name):
    """Where the edge is in the table, or would be."""
    last = np.uint64(len(tree.names) - 1)
    slot = finished(name) & last
    while tree.children[slot] != _EMPTY and tree.names[slot] != name:
        slot = (slot + np.uint64(1)) & last
    return slot


@outer
def put_edges(tree, names, children):
    """Put the edges of another table into the tree's, which is empty."""
    for i in range(len(names)):
        if children[i] != _EMPTY:
            slot = _slot(tree, names[i])
            tree.names[slot], tree.children[slot] = names[i], children[i]


@inner
def _add(model, state, tree):
    """A node for the history of the state."""
    node = tree.size[0]
    tree.size[0] += 1
    tree.ended[node] = over(model, state)
    if not tree.ended[node]:
        mask(model, state, tree.legal[node])
        costs(model, state, tree.costs[node])
    return node


@inner
def _select(tree, node, exploration):
    """The control of the lowest optimistic cost (UCB1); one that was never taken comes first."""
    counts, total = tree.counts[node], 0
    for count in counts:
        total += count
    best, lowest = -1, np.inf
    spread = exploration * np.sqrt(np.log(np.float64(max(total, 1))))
    for u in range(len(counts)):
        if not tree.legal[node, u]:
            continue
        if counts[u] == 0:
            return u
        cost = tree.means[node, u] - spread / np.sqrt(np.float64(counts[u]))
        if best < 0 or cost < lowest:
            best, lowest = u, cost
    return best


@inner
def _back_up(tree, path, depth, value, discount):
    """Add a simulation that went on at cost ``value`` to the nodes of its path."""
    for i in range(depth - 1, -1, -1):
        node, u = path.nodes[i], path.controls[i]
        value = tree.costs[node, u] + discount * value
        tree.counts[node, u] += 1
        tree.means[node, u] += (value - tree.means[node, u]) / tree.counts[node, u]
    tree.spread[0], tree.spread[1] = min(tree.spread[0], value), max(tree.spread[1], value)


@outer
def search(model, policy, state, tree, path, key, first, last, exploration, discount, num_observations):
    """Simulations number ``first`` to ``last`` from the root.

    Args:
        model: scalar model.
        policy: rollout policy, pair of twin and data.
        state: of the model, with the root in it.
        tree: the tree; empty before the first simulation.
        path: memory of a simulation.
        key: of the root, unsigned.
        first: number of the first simulation.
        last: number after the last one.
        exploration: constant of UCB1, as a fraction of the range of the simulations' costs.
        discount: of the model.
        num_observations: of the model.

    Returns:
        the number of the next simulation, which is below ``last`` where the tree is full; the number of steps; and whether
        all controls of the rollout policy were legal.
    """
    steps, nothing, one = 0, np.uint64(0), 1
    if tree.size[0] == 0:
        start(model, state)
        _add(model, state, tree)
    if tree.ended[0]:
        return last, steps, True
    for number in range(first, last):
        if tree.size[0] == len(tree.ended):
            return number, steps, True
        stream, seen = fold(key, np.uint64(number)), nothing
        start(model, state)
        node, depth, value, spread = 0, 0, 0.0, exploration * max(tree.spread[1] - tree.spread[0], 0.0)
        while not tree.ended[node]:
            u = _select(tree, node, spread)
            path.nodes[depth], path.controls[depth] = node, u
            depth += 1
            move(model, state, u)
            z = see(model, state, Noise(stream, key, 0, one, seen))
            seen = seen_after(model, state, seen)
            settle(model, state, z)
            name = (np.uint64(node) * np.uint64(tree.legal.shape[1]) + np.uint64(u)) * np.uint64(num_observations) + np.uint64(
                z
            )
            slot = _slot(tree, name)
            node = tree.children[slot]
            if node == _EMPTY:
                node = _add(model, state, tree)
                tree.names[slot], tree.children[slot] = name, node
                if not tree.ended[node]:
                    value, more, well = remaining(model, policy, state, Noise(stream, key, 0, one, seen))
                    if not well:
                        return number, steps, False
                    steps += more
                break
        steps += depth
        _back_up(tree, path, depth, value, discount)
    return last, steps, True
