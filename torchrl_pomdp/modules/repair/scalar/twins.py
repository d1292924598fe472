"""Scalar twins of the repair problem's base policies and networks; see :class:`~torchrl_pomdp.modules.repair.scalar.View`."""

from __future__ import annotations

import numpy as np

from torchrl_pomdp.modules.repair.scalar.view import (
    View,
    extra_cost,
    intact,
    jointly_legal,
    legal,
    part_of,
    probability,
    split,
)
from torchrl_pomdp.scalar.compiling import inner, products
from torchrl_pomdp.scalar.noise import CONTROLS, fold, uniform
from torchrl_pomdp.scalar.twins import choose, scalar_twin

__all__ = ["elsewhere", "greedy", "networks", "random", "urgency"]


@scalar_twin
def random(data, view, controls):
    """Each robot takes any of its legal controls, all equally likely."""
    key = fold(view.key, CONTROLS)
    for robot in range(len(controls)):
        number, count = uniform(key, np.uint64(view.stage * len(controls) + robot)), 0
        for control in range(view.tables.destinations.shape[1]):
            count += legal(view, robot, control)
        left = np.int64(number * np.float32(count))
        for control in range(view.tables.destinations.shape[1]):
            if legal(view, robot, control):
                controls[robot] = control
                left -= 1
                if left < 0:
                    break


@scalar_twin
def greedy(data, view, controls):
    """The nearest location that may be damaged; ``data`` is the threshold."""
    tables, (threshold,) = view.tables, data
    for robot in range(len(controls)):
        origin = view.location[robot]
        controls[robot] = tables.first_moves[origin]
        for i in range(tables.order.shape[1]):
            place = tables.order[origin, i]
            if not intact(view, place, threshold):
                controls[robot] = tables.first_controls[origin, place]
                break


@scalar_twin
def urgency(data, view, controls):
    """The location with the largest extra cost over a power of the distance.

    ``data`` holds these powers and the largest extra cost.
    """
    tables, (remoteness, highest) = view.tables, data
    rounded = view.intact.dtype.type
    targets = view.work
    for robot in range(len(controls)):
        origin = view.location[robot]
        best, chosen = 0.0, -1
        for i in range(tables.order.shape[1]):
            place = tables.order[origin, i]
            away = remoteness[origin, place]
            # What lies further away cannot be more urgent.
            if rounded(highest / away) < best:
                break
            if view.intact[place] == 1.0:
                continue
            taken = False
            for other in range(robot):
                taken = taken or targets[other] == place
            urgent = 0.0 if taken else rounded(extra_cost(view, place) / away)
            if urgent > best or (urgent == best and 0 <= place < chosen):
                best, chosen = urgent, place
        targets[robot] = chosen
        controls[robot] = tables.first_moves[origin] if chosen < 0 else tables.first_controls[origin, chosen]


@inner
def _features(view, columns, places, robot_features, whole, work, size):
    """Put what is not zero of the features into ``work``: where, then how much; returns how many there are.

    ``whole``: beliefs as they are, seen once; else by every robot, and of level 0 whether damage is possible.
    """
    levels, count = view.start.shape[1], 0
    for robot in range(len(view.location)):
        origin, first = view.location[robot], robot * robot_features
        for place in range(len(view.level) if robot == 0 or not whole else 0):
            if view.intact[place] == 1.0 and not whole:
                continue
            for k in range(levels):
                value = 1.0 if k == 0 and not whole else probability(view, place, k)
                if value > 0.0:
                    work[count], work[size + count] = first + columns[origin, place * levels + k], value
                    count += 1
        work[count], work[size + count] = first + places[origin], 1.0
        count += 1
    return count


@products
def _affine(weights, bias, rows, factors, out):
    """``out = bias + factors @ weights[rows]``, four rows at a time."""
    i, count = 0, len(rows)
    for j in range(len(out)):
        out[j] = bias[j]
    while i + 4 <= count:
        a, b, c, d = (
            weights[np.int64(rows[i])],
            weights[np.int64(rows[i + 1])],
            weights[np.int64(rows[i + 2])],
            weights[np.int64(rows[i + 3])],
        )
        p, q, r, s = factors[i], factors[i + 1], factors[i + 2], factors[i + 3]
        for j in range(len(out)):
            out[j] += (p * a[j] + q * b[j]) + (r * c[j] + s * d[j])
        i += 4
    while i < count:
        a, p = weights[np.int64(rows[i])], factors[i]
        for j in range(len(out)):
            out[j] += p * a[j]
        i += 1


@inner
def _positive(work, size, width):
    """The positive outputs of a layer become what is not zero of the next one's input."""
    count = 0
    for j in range(width):
        value = work[2 * size + j]
        if value > 0.0:
            work[count], work[size + count] = j, value
            count += 1
    return count


@inner
def _best_control(view, work, at, width, controls):
    """The legal joint control with the largest logit, ties to the lower."""
    base, best, highest = view.tables.destinations.shape[1], -1, -np.inf
    for u in range(width):
        if jointly_legal(view, u, controls) and work[at + u] > highest:
            best, highest = u, work[at + u]
    if best < 0 or highest == np.inf:
        # Logits that have overflowed choose nothing.
        for robot in range(len(controls)):
            controls[robot] = -1
    else:
        split(best, base, controls)


@scalar_twin
def networks(data, view, controls):
    """Policy networks, one for each part.

    ``data`` holds the number of each part's network, or -1 for the base policy; which feature is what, and of which kind; for
    every layer the weights ``[network, in, out]`` and biases; and the base policy. What is zero costs nothing.
    """
    numbers, columns, places, robot_features, whole, weights, biases, base = data
    own = numbers[part_of(view) if len(numbers) > 1 else 0]
    if own < 0:
        choose(base, view, controls)
        return
    # The memory of the twin: rows of the weights that are met, their factors, outputs of a layer.
    work, size = view.work, len(view.work) // 3
    count = _features(view, columns, places, robot_features, whole, work, size)
    last = len(weights) - 1
    for layer in range(last + 1):
        bias = biases[layer][own]
        _affine(weights[layer][own], bias, work[:count], work[size : size + count], work[2 * size : 2 * size + len(bias)])
        if layer < last:
            count = _positive(work, size, weights[layer].shape[2])
    _best_control(view, work, 2 * size, weights[last].shape[2], controls)


@inner
def _known_as(robot, lost):
    """The number that a robot had before the robot ``lost`` was lost; -1: none is."""
    return robot + 1 if 0 <= lost <= robot else robot


@scalar_twin
def elsewhere(data, view, controls):
    """A policy that knows another graph, and maybe a robot more; for a control that is illegal here, the first that is legal.

    ``data`` holds the tables that the policy sees, with the old graph; the policy; the lost robot, -1 for none, and where it
    stands; and how many numbers are for the policy's own use. Those after them are locations and controls of its robots.
    """
    tables, policy, lost, place, numbers = data
    robots = len(controls) + (1 if lost >= 0 else 0)
    own = view.work[numbers:].view(np.int64)
    location, chosen = own[:robots], own[robots : 2 * robots]
    for robot in range(len(controls)):
        location[_known_as(robot, lost)] = view.location[robot]
    if lost >= 0:
        location[lost] = place
    work = view.work[:numbers]
    seen = View(view.stage, location, view.level, view.since, view.intact, view.start, tables, work, view.key)
    choose(policy, seen, chosen)
    for robot in range(len(controls)):
        controls[robot] = chosen[_known_as(robot, lost)]
        # What is no control at all stays one that is refused.
        if controls[robot] >= 0 and not legal(view, robot, controls[robot]):
            controls[robot] = 0
            while not legal(view, robot, controls[robot]):
                controls[robot] += 1
