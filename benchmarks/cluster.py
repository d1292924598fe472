"""A step of policy iteration on a cluster by discrete events: labels by workers, then training by an actor for each part."""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heapify, heappop, heappush


@dataclass(frozen=True)
class Costs:
    """What was measured, in seconds and bytes."""

    submit: float  # driver, for each task
    collect: float  # driver, for each result
    compute: float  # worker, for each block of labels
    add: float  # actor, for each block that it takes in
    step: float  # actor, for each optimisation step
    block: float  # bytes of a block
    bandwidth: float = float("inf")  # bytes per second into a machine; on one machine blocks are shared


@dataclass(frozen=True)
class Step:
    """The time of a step, when its labels were there, and what its busiest machine received."""

    seconds: float
    labelled: float
    driver_bytes: float
    actor_bytes: float


def simulate(costs: Costs, workers: int, parts: int, blocks: int, steps: int, images: int = 2, ahead: int = 2) -> Step:
    """A step for so many parts, each with so many blocks of labels and optimisation steps.

    The driver gives out ``ahead`` tasks of each part for each worker, then one for each result that it collects, part by part.
    """
    driver, free, done = 0.0, [0.0] * workers, [[0.0] * blocks for _ in range(parts)]

    def give_out(part: int, block: int) -> None:
        nonlocal driver
        driver += costs.submit
        finish = max(driver, heappop(free)) + costs.compute
        heappush(free, finish)
        done[part][block] = finish

    window = min(blocks, ahead * workers)
    for part in range(parts):
        for block in range(window):
            give_out(part, block)
    for part in range(parts):
        for block in range(blocks):
            driver = max(driver, done[part][block]) + costs.collect
            if block + window < blocks:
                give_out(part, block + window)
    taken = images * blocks
    training = taken * (costs.block / costs.bandwidth + costs.add) + steps * costs.step
    actors = [driver] * min(workers, parts)
    heapify(actors)
    for _ in range(parts):
        heappush(actors, heappop(actors) + training)
    return Step(max(actors), driver, parts * blocks * costs.block, taken * costs.block)
