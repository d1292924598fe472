"""The network on paper: locations in the colour of their damage, robots around them, and what they do."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchrl_pomdp.envs.repair.graphs import Graph
from torchrl_pomdp.envs.repair.model import REPAIR, RepairModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize

__all__ = ["DAMAGE", "DAMAGE_LABEL", "ROBOT", "Scale", "damage_norm", "draw_network", "edges_of", "places_of", "scale_of"]

# Colours of damage, whose lightness falls all the way, and of what robots do.
DAMAGE, ROBOT, _EDGE = "YlOrRd", "#1f4e79", "#8a8f98"
DAMAGE_LABEL = "expected damage level"
# Inches between neighbours, less where the graph would be larger than so many; inches of a robot's radius.
_SPACING, _MOST_INCHES, _DISC = 0.75, 10.0, 0.095
# Radius of a location, where neighbours are at a distance of one.
_PLACE = 0.22
# Larger graphs are drawn without names; longer names are written below their locations.
_MOST_NAMES, _SHORT = 50, 3
# Where a robot stands that has nowhere to go: at the upper right, where few edges are.
_REST = -math.pi / 4
# One that goes keeps to the right of its way by this angle: robots that change places are both seen.
_ASIDE = 0.6


def draw_network(axes: Axes, model: RepairModel, damage: Tensor, location: Tensor, controls: Tensor | None, title: str) -> None:
    """Draw the graph with damage ``[L]``, robots at ``[R]`` and what they do ``[R]``, on empty axes."""
    from matplotlib.collections import LineCollection

    graph = model.graph
    scale = scale_of(model)
    places = places_of(graph)
    ends = places[edges_of(graph)]
    axes.add_collection(LineCollection(list(ends.numpy()), colors=_EDGE, linewidths=1.2, zorder=1))
    _add_discs(
        axes,
        places,
        scale.place,
        array=damage.cpu().numpy(),
        cmap=DAMAGE,
        norm=damage_norm(model),
        edgecolors="#333333",
        linewidths=0.8,
        zorder=3,
    )
    if graph.num_locations <= _MOST_NAMES:
        _write_names(axes, model, damage, scale.place + 1.4 * _DISC * scale.unit)
    _draw_robots(axes, model, scale, location.cpu(), None if controls is None else controls.cpu())
    axes.set(xlim=scale.across, ylim=scale.down[::-1], aspect="equal")
    axes.set(xticks=[], yticks=[])
    # Unlike axes that are off, these can have a label below.
    axes.spines[:].set_visible(False)
    axes.set_title(title, fontsize="medium", parse_math=False)


def _write_names(axes: Axes, model: RepairModel, damage: Tensor, below: float) -> None:
    """The names of the locations, in their circles, or so far below that a robot between does not cover them."""
    graph = model.graph
    inside = max(map(len, graph.location_names)) <= _SHORT
    for node, name in enumerate(graph.location_names):
        dark = float(damage[node]) > 0.6 * (model.num_levels - 1)
        axes.text(
            float(graph.columns[node]),
            float(graph.rows[node]) + (0.0 if inside else below),
            name,
            fontsize=7,
            color="white" if inside and dark else "black",
            ha="center",
            va="center_baseline" if inside else "top",
            parse_math=False,
            zorder=4,
        )


def _draw_robots(axes: Axes, model: RepairModel, scale: Scale, location: Tensor, controls: Tensor | None) -> None:
    """Numbered discs around the robots' locations; where there are controls, a plus beside or an arrow from each."""
    places = places_of(model.graph)
    here, disc = places[location], _DISC * scale.unit
    there = here if controls is None else places[model.destinations.cpu()[location, controls]]
    outwards, distance = _ring(location, there - here, scale.place, disc)
    spots = here + outwards * distance
    _add_discs(axes, spots, disc, facecolors=ROBOT, edgecolors="white", linewidths=0.6, zorder=5)
    for robot, (x, y) in enumerate(spots.tolist()):
        number = axes.text(x, y, str(robot + 1), fontsize=6.2, color="white", weight="bold", zorder=6)
        number.set(ha="center", va="center_baseline")
    if controls is None:
        return
    repairs = controls == REPAIR
    x, y = (spots + 1.5 * disc * outwards)[repairs].T.numpy()
    axes.scatter(x, y, marker="P", s=46, color=ROBOT, edgecolor="white", linewidth=0.6, zorder=6)
    # As far as the neighbour's circle; the arrow may pass below the one where the robot stands.
    way = there - spots
    way = (way - (scale.place + 0.15 * disc) * way / way.norm(dim=-1, keepdim=True))[~repairs]
    lengths: Any = {"angles": "xy", "scale_units": "xy", "scale": 1, "units": "xy", "width": 0.25 * disc, "minlength": 0}
    head: Any = {"headwidth": 5, "headlength": 6, "headaxislength": 5.5}
    axes.quiver(*spots[~repairs].T.numpy(), *way.T.numpy(), color=ROBOT, zorder=2, **lengths, **head)


def _add_discs(axes: Axes, places: Tensor, radius: float, **style: Any) -> None:
    """Discs at places ``[N, 2]``, whose radius is in columns and rows like these."""
    from matplotlib.collections import EllipseCollection

    width = [2 * radius] * len(places)
    offsets: Any = {"offsets": places.numpy(), "offset_transform": axes.transData}
    axes.add_collection(EllipseCollection(width, width, [0.0] * len(places), units="xy", **offsets, **style))


def _ring(location: Tensor, ways: Tensor, place: float, disc: float) -> tuple[Tensor, Tensor]:
    """Directions ``[R, 2]`` and distances ``[R, 1]`` of robots from their locations, for discs that do not overlap.

    Robots at one location stand around it, as far as that goes on the side where their ways ``[R, 2]`` lead.
    """
    wish = torch.where((ways == 0).all(-1), _REST, torch.atan2(ways[:, 1], ways[:, 0]) + _ASIDE)
    together = location.unsqueeze(0) == location.unsqueeze(1)
    # In the order of their wishes, then of their numbers.
    order = wish.argsort(stable=True).argsort()
    count, rank = together.sum(-1), (together & (order.unsqueeze(0) < order.unsqueeze(1))).sum(-1)
    turn = 2 * math.pi * rank / count
    # Turned together, so that they are as near to their wishes as they can be.
    angle = turn + (together * (wish - turn)).sum(-1) / count
    apart = torch.where(count > 1, 1.08 * disc / torch.sin(math.pi / count), 0.0).clamp(min=place + 0.5 * disc)
    return torch.stack([angle.cos(), angle.sin()], -1), apart.unsqueeze(-1)


def places_of(graph: Graph) -> Tensor:
    """Column and row of each location, ``[L, 2]``."""
    return torch.stack([graph.columns, graph.rows], -1)


def edges_of(graph: Graph) -> Tensor:
    """Both ends of each edge, the smaller number first, int64 ``[E, 2]``."""
    nodes, slots = (graph.neighbours > torch.arange(graph.num_locations).unsqueeze(-1)).nonzero(as_tuple=True)
    return torch.stack([nodes, graph.neighbours[nodes, slots]], -1)


class Scale(NamedTuple):
    """How a graph comes to paper.

    Attributes:
        across: the columns that are drawn, from left to right.
        down: the rows that are drawn, from top to bottom.
        unit: what an inch is, in columns and rows.
        place: radius of a location, in columns and rows.
    """

    across: tuple[float, float]
    down: tuple[float, float]
    unit: float
    place: float


def scale_of(model: RepairModel) -> Scale:
    """The scale at which neighbours are well apart, in a picture that is not too large."""
    graph = model.graph
    nodes, slots = (graph.neighbours >= 0).nonzero(as_tuple=True)
    places = places_of(graph)
    lengths = (places[nodes] - places[graph.neighbours[nodes, slots]]).norm(dim=-1)
    typical = float(lengths.median()) if len(lengths) else 1.0
    low, high = places.amin(0), places.amax(0)
    unit = max(typical / _SPACING, float((high - low).max()) / _MOST_INCHES)
    # Room for all robots at one location, wherever it is.
    robots = torch.zeros(model.num_robots, dtype=torch.int64)
    place, disc = _PLACE * typical, _DISC * unit
    _, distance = _ring(robots, torch.zeros(model.num_robots, 2), place, disc)
    margin = float(distance.max()) + 2.5 * disc
    (left, top), (right, bottom) = (low - margin).tolist(), (high + margin).tolist()
    return Scale((left, right), (top, bottom), unit, place)


def damage_norm(model: RepairModel) -> Normalize:
    """From colours to damage levels."""
    from matplotlib.colors import Normalize

    return Normalize(0, model.num_levels - 1)
