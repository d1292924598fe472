"""What happens in a simulated trajectory of the repair problem: robots move, look, and what they see becomes known."""

from __future__ import annotations

import numpy as np

from torchrl_pomdp.modules.repair.scalar.view import expected, probability
from torchrl_pomdp.scalar.compiling import inner, shared
from torchrl_pomdp.scalar.noise import scenario_noise, variable_bit

__all__ = ["bits_after", "interval_cost", "level_at", "look", "moved", "set_intact", "take_in", "terminal"]


@shared
def set_intact(view):
    """Bring up to date, for all locations, the probability that they are intact."""
    for place in range(len(view.level)):
        view.intact[place] = probability(view, place, 0)


@inner
def terminal(view, witness):
    """Whether the state is terminal, see :meth:`~torchrl_pomdp.envs.repair.RepairModel.is_terminal`; a witness if it is not.

    A single location that may be damaged tells that it is not; the one that did so last is asked first.
    """
    product, size = 1.0, len(view.level)
    for i in range(size):
        place = witness + i if witness + i < size else witness + i - size
        product *= view.intact[place]
        if not 1.0 - product <= view.tables.terminal_probability:
            return False, place
    return True, witness


@inner
def level_at(view, place, stage, noise):
    """Level that a robot sees at ``place`` at a stage, in a scenario that draws the number ``noise``."""
    tables, levels = view.tables, view.start.shape[1]
    n, known, kind = stage - view.since[place], view.level[place], tables.kind[place]
    if known >= 0:
        threshold = noise * tables.cumulative[kind, n, known, levels - 1]
        for level in range(levels - 1):
            if tables.cumulative[kind, n, known, level] > threshold:
                return level
        return levels - 1
    threshold, reached, possible = np.float64(noise), 0.0, 0
    for level in range(levels):
        here = 0.0
        for k in range(levels):
            here += view.start[place, k] * tables.powers[kind, n, k, level]
        reached += here
        if here > 0.0:
            possible = level
            if reached > threshold:
                break
    # Marginals sum to one but for rounding: what is left belongs to the last level that is possible.
    return possible


@inner
def interval_cost(view, place, stage):
    """Discounted cost of a location from when it was last seen until ``stage``."""
    return view.tables.discounts[view.since[place]] * expected(view, place, stage, view.tables.interval_costs)


@inner
def moved(view, controls):
    """The robots move."""
    for robot in range(len(view.location)):
        view.location[robot] = view.tables.destinations[view.location[robot], controls[robot]]


@inner
def bits_after(view, seen):
    """The variables that have been seen once the robots have looked where they are."""
    for robot in range(len(view.location)):
        seen |= variable_bit(view.location[robot])
    return seen


@inner
def look(view, controls, levels, noise, seen, age):
    """The robots, which have moved, look: puts what they see into ``levels``."""
    tables, robots = view.tables, len(view.location)
    for robot in range(robots):
        place = view.location[robot]
        first = (seen & variable_bit(place)) == 0
        level = 0 if tables.steady and view.intact[place] == 1.0 else -1
        # Robots that repair one location together make one attempt.
        attempt = False
        for other in range(robots):
            attempt = attempt or (view.location[other] == place and controls[other] == 0)
        if attempt and tables.works == 1.0:
            level = 0
        for other in range(robot):
            if view.location[other] == place:
                level = levels[other]
        if level < 0:
            number = np.float64(
                scenario_noise(noise.key, noise.group, noise.member, noise.of, first, place, age * robots + robot)
            )
            if attempt and number < tables.works:
                level = 0
            else:
                # Where an attempt fails, what is left of the number tells the level that the chain leads to.
                left = (number - tables.works) / (1.0 - tables.works) if attempt else number
                level = level_at(view, place, view.stage + 1, left)
        levels[robot] = level


@inner
def take_in(view, levels):
    """What the robots see becomes known at the next stage; returns what their locations cost until then."""
    tables, cost = view.tables, 0.0
    for robot in range(len(view.location)):
        place = view.location[robot]
        if not tables.free or view.intact[place] < 1.0:
            cost += interval_cost(view, place, view.stage + 1)
        if tables.steady:
            view.intact[place] = 1.0 if levels[robot] == 0 else 0.0
        view.level[place], view.since[place] = levels[robot], view.stage + 1
    return cost
