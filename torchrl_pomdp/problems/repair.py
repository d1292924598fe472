"""Repair problems: the paper's by name, and one's own (Section VI)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast

import torch
from torch import Tensor

from torchrl_pomdp.checks import check_callable, check_flag, check_instance, check_integer, check_sequence, shown
from torchrl_pomdp.envs.belief_model import StateGenerator
from torchrl_pomdp.envs.generators import InPart
from torchrl_pomdp.envs.partition import Partition, SinglePart
from torchrl_pomdp.envs.repair import (
    CalibratedStart,
    Graph,
    RandomState,
    RepairModel,
    RepairPartition,
    UniformStart,
    damage_chain,
    grid,
    line,
    symmetries,
)
from torchrl_pomdp.modules.repair import (
    GreedyRepair,
    NeverRepairCost,
    RelativeEncoder,
    RobotEncoder,
    SteadyStateCost,
    UrgencyRepair,
)
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.tensor_checks import check_device, check_tensor

__all__ = ["REPAIR_PRESETS", "repair_problem"]

COSTS = (0.0, 0.1, 1.0, 10.0, 100.0)
DEGRADATION = (0.0, 0.02, 0.03, 0.05)
DISCOUNT = 0.99
_NETWORK32 = (
    "1-2 1-32 2-3 2-4 3-4 3-32 4-5 4-6 5-6 5-8 6-7 6-32 7-17 8-9 8-12 9-10 9-12 10-11 11-12 11-13 12-14 13-15 14-24 14-15 "
    "15-16 16-17 16-19 16-20 17-19 17-18 18-21 18-22 18-23 19-21 20-21 21-22 23-25 23-26 24-25 25-26 26-28 25-27 27-28 27-29 "
    "27-30 28-29 29-30 30-31 31-32"
)
# Where its locations are drawn, without crossings.
_PLACES = (
    *((3.5, 1.1), (2.5, 1.1), (3.1, 0.0), (1.5, 1.0), (1.4, 2.4), (2.8, 2.1), (3.4, 2.9), (0.0, 3.6)),
    *((0.8, 4.2), (1.5, 3.5), (1.4, 5.0), (0.5, 5.5), (2.1, 4.3), (2.4, 6.6), (2.0, 5.7), (2.7, 5.0)),
    *((3.6, 3.9), (4.6, 4.6), (3.7, 4.9), (3.0, 5.9), (4.0, 5.8), (5.0, 5.7), (5.6, 4.9), (4.6, 6.6)),
    *((6.3, 5.6), (6.4, 4.4), (7.3, 4.0), (5.8, 3.6), (6.7, 3.0), (7.2, 2.2), (5.7, 1.7), (4.5, 1.2)),
)
_OBSTACLES = ((1, 1), (1, 2), (3, 1), (4, 3), (4, 4), (2, 4))


def has_six_parts(graph: Graph) -> bool:
    """Whether each of the six parts of Section VI-B has states: three locations or more, not all in one column."""
    return graph.num_locations >= 3 and len(graph.columns.unique()) > 1


def repair_problem(
    graph: Graph,
    chain: Tensor,
    costs: Tensor | Sequence[float],
    discount: float,
    *,
    num_robots: int = 1,
    repair_probability: float = 1.0,
    start: Callable[[RepairModel], StateGenerator] = CalibratedStart,
    partition: Partition | None = None,
    name: str | None = None,
    device: torch.device | str = "cpu",
) -> Problem:
    r"""A repair problem with everything that training asks for: partition, training states, base policies, symmetries.

    Args:
        graph: where the robots move.
        chain: row-stochastic matrix ``[K, K]`` of the damage levels, see :func:`~torchrl_pomdp.envs.repair.damage_chain`; or
            ``[L, K, K]``, different by location.
        costs: cost of a location per stage at each level, ``[K]`` or ``[L, K]``.
        discount: :math:`\alpha` in (0, 1).

    Keyword Args:
        num_robots: R.
        repair_probability: that a repair works.
        start: what makes the start states from the model, such as
            :class:`~torchrl_pomdp.envs.repair.CalibratedStart`; of a user's own: a function that is given the model and
            returns a function from int64 keys ``[*B]`` to feature states ``[*B]``.
        partition: the parts; None: the six of Section VI-B, or a single one where there are fewer than three locations, or no
            left and right.
        name: what it is called; None: as the graph.
        device: where the model computes.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if an argument is out of range, see :class:`~torchrl_pomdp.envs.repair.RepairModel`.

    Examples:
        >>> hub = Graph.from_edges("hub", 5, [(0, 1), (0, 2), (0, 3), (3, 4)])
        >>> problem = repair_problem(hub, damage_chain((0.0, 0.1)), (0.0, 1.0, 10.0), 0.95, num_robots=2)
        >>> problem.model.partition.num_parts, list(problem.base_policies)
        (6, ['greedy', 'urgency'])
    """
    check_instance("graph", graph, Graph)
    check_callable("start", start)
    device = check_device("device", device)
    if partition is None:
        six = has_six_parts(graph)
        partition = RepairPartition(graph, check_tensor("costs", costs, finite=False), device=device) if six else SinglePart()
    model = RepairModel(
        graph,
        chain,
        costs,
        discount,
        num_robots=num_robots,
        repair_probability=repair_probability,
        partition=partition,
        device=device,
    )
    return Problem(
        model,
        start(model),
        name=graph.name if name is None else name,
        training=_training(model, partition),
        base_policies={"greedy": GreedyRepair(model), "urgency": UrgencyRepair(model)},
        pessimistic_cost=NeverRepairCost(model),
        symmetries=symmetries(model),
        encoder=RelativeEncoder,
        agent_encoder=RobotEncoder,
    )


def _training(model: RepairModel, partition: Partition) -> list[StateGenerator]:
    """Random states of every part: a phase is proposed, all else is met by rejection."""
    everywhere, startgame, endgame = (RandomState(model, share) for share in ((0.0, 1.0), (0.5, 1.0), (0.0, 0.5)))
    if isinstance(partition, RepairPartition):
        return [InPart(model, startgame if part < 3 else endgame, part) for part in range(partition.num_parts)]
    return [InPart(model, everywhere, part) for part in range(partition.num_parts)]


def _preset(
    graph: Graph,
    num_robots: int = 1,
    start: Callable[[RepairModel], StateGenerator] = CalibratedStart,
    *,
    repair_probability: float = 1.0,
    uneven: bool = False,
    name: str,
    device: torch.device,
) -> Problem:
    chain, costs = damage_chain(DEGRADATION), torch.tensor(COSTS)
    if check_flag("uneven", uneven):
        # Every third location fails three times as fast, every fourth costs four times as much.
        place = torch.arange(graph.num_locations)
        fast = damage_chain([3 * rate for rate in DEGRADATION])
        chain = torch.where((place % 3 == 1).view(-1, 1, 1), fast, chain)
        costs = torch.where((place % 4 == 2).view(-1, 1), 4 * costs, costs)
    return repair_problem(
        graph,
        chain,
        costs,
        DISCOUNT,
        num_robots=num_robots,
        repair_probability=repair_probability,
        start=start,
        name=name,
        device=device,
    )


def network32() -> Graph:
    """The network of 32 locations of arXiv:2011.04222; the edge 2-3 is read off a picture and uncertain.

    Examples:
        >>> graph = network32()
        >>> graph.num_locations, graph.location_names[0], len(graph.slot_names)
        (32, '1', 4)
    """
    ends = [[int(end) - 1 for end in edge.split("-")] for edge in _NETWORK32.split()]
    names = [str(location + 1) for location in range(32)]
    columns, rows = zip(*_PLACES, strict=True)
    return Graph.from_edges(
        "network of 32", 32, [(first, second) for first, second in ends], columns=columns, rows=rows, location_names=names
    )


def _network32(num_robots: int, *, name: str, device: torch.device) -> Problem:
    """The problems of arXiv:2011.04222: with many robots, repaired locations fail again.

    Its start states are not published. Here every location is possibly damaged, and the robots are anywhere.
    """
    few = num_robots <= 4
    problem = repair_problem(
        network32(),
        damage_chain(DEGRADATION if few else (0.01, *DEGRADATION[1:])),
        torch.tensor(COSTS),
        DISCOUNT if few else 0.95,
        num_robots=num_robots,
        start=partial(CalibratedStart, damaged_fraction=1.0),
        partition=SinglePart(),
        name=name,
        device=device,
    )
    # What they add where a simulation is cut.
    return replace(problem, pessimistic_cost=SteadyStateCost(cast(RepairModel, problem.model)))


def _edges(edges: Any, *, locations: int | None = None, columns: Any = None, rows: Any = None) -> Graph:
    """A graph by its edges, as files have it; there are as many locations as the edges name."""
    pairs = [tuple(pair) for pair in check_sequence("edges", edges, Sequence)]
    if any(len(pair) != 2 for pair in pairs):
        raise ValueError(f"edges must hold pairs of locations, got {shown(next(pair for pair in pairs if len(pair) != 2))}")
    ends = [check_integer("edges", end, 0) for pair in pairs for end in pair]
    size = max(ends, default=0) + 1 if locations is None else locations
    return Graph.from_edges("graph", size, pairs, columns=columns, rows=rows)


def _grid(size: Any, *, obstacles: Any = ()) -> Graph:
    if not isinstance(size, (list, tuple)) or len(size) != 2:
        raise ValueError(f"grid must be [width, height], got {shown(size)}")
    width, height = size
    return grid(width, height, obstacles)


GRAPHS: dict[str, Callable[..., Graph]] = {"line": line, "grid": _grid, "edges": _edges}
"""Graphs as problem files name them."""

STARTS: dict[str, Callable[..., StateGenerator]] = {"calibrated": CalibratedStart, "uniform": UniformStart}
"""Start states as problem files name them: of a model, and a fraction of the locations or the robots' locations."""


def chain_of(chain: Any, degradation: Any) -> Tensor:
    """The damage chain of a file: its matrix, or the probabilities that each level degrades to the next."""
    if chain is None:
        return damage_chain(degradation)
    try:
        return torch.tensor(chain, dtype=torch.float64)
    except (ValueError, TypeError, RuntimeError, OverflowError) as error:
        raise ValueError(f"chain must be rows of numbers, one for each level: {error}") from error


REPAIR_PRESETS: dict[str, Callable[..., Problem]] = {
    "line3": partial(_preset, line(3), start=UniformStart),
    "linear20": partial(_preset, line(20)),
    "grid5x4": partial(_preset, grid(5, 4)),
    "grid6x6": partial(_preset, grid(6, 6)),
    "two_robots20": partial(_preset, line(20), 2),
    "grid6x6_obstacles": partial(_preset, grid(6, 6, _OBSTACLES)),
    "linear20_uneven": partial(_preset, line(20), uneven=True),
    "linear20_slow_repair": partial(_preset, line(20), repair_probability=0.4),
    **{f"network32x{robots}": partial(_network32, robots) for robots in (4, 8, 10)},
}
"""The paper's problems by name; those of its follow-up with a number of robots; and its extensions: obstacles, slow repairs,
locations of several kinds."""
