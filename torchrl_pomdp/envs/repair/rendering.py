"""Pictures of repair problems; matplotlib, the extra ``plot``, is imported when one is drawn."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance, check_mapping, check_number, check_path, check_text
from torchrl_pomdp.envs.entries import check_state_entries
from torchrl_pomdp.envs.repair.model import REPAIR, RepairModel
from torchrl_pomdp.files import write_bytes
from torchrl_pomdp.pictures import new_figure
from torchrl_pomdp.tensor_checks import check_distributions, check_tensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from PIL.Image import Image

__all__ = ["network_figure", "save_animation", "trajectory_figure"]

# Colours of damage, whose lightness falls all the way, and of what robots do.
_DAMAGE, _ROBOT, _EDGE = "YlOrRd", "#1f4e79", "#8a8f98"
_LABEL = "expected damage level"
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
# Of an animation, and the inches of a panel that its title needs.
_MOST_PANELS, _LEAST_WIDTH = 12, 2.8
# Of an animation: dots per inch, and colours of its one palette.
_DPI, _COLOURS = 80, 160


def trajectory_figure(model: RepairModel, trajectory: TensorDictBase, title: str = "") -> Figure:
    """One trajectory: locations by time, colour the expected damage, robots' paths over it, repairs marked.

    Args:
        model: the repair model.
        trajectory: ``[T]`` with ``belief``, ``location`` and ``action``, as ``BeliefEnv.rollout`` gives it.
        title: title of the figure.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if an entry is missing.
        ImportError: if matplotlib, the extra ``plot``, is not installed.
    """
    check_instance("model", model, RepairModel)
    check_instance("title", title, str)
    missing = [
        key for key in ("belief", "location", "action") if key not in check_instance("trajectory", trajectory, TensorDictBase)
    ]
    if missing:
        raise ValueError(f"trajectory must have the entry {missing[0]!r}, got {sorted(map(str, trajectory.keys()))}")
    steps = trajectory.batch_size[0]
    damage = _expected_damage(model, trajectory["belief"])
    figure = new_figure(max(5.0, 0.14 * steps + 2.5), max(2.5, 0.16 * model.num_locations + 1.2))
    axes = figure.add_subplot()
    image = axes.imshow(
        damage.T.cpu().numpy(), aspect="auto", cmap=_DAMAGE, vmin=0, vmax=model.num_levels - 1, interpolation="nearest"
    )
    figure.colorbar(image, ax=axes, label=_LABEL)
    controls = model.split_controls(trajectory["action"])
    for robot in range(model.num_robots):
        path = trajectory["location"][:, robot].cpu().numpy()
        axes.plot(range(steps), path, color=_ROBOT, linewidth=1.2, label=f"robot {robot + 1}")
        repairs = (controls[:, robot] == REPAIR).nonzero().squeeze(-1).cpu().numpy()
        axes.scatter(repairs, path[repairs], marker="P", s=44, color=_ROBOT, edgecolor="white", linewidth=0.6)
    axes.scatter([], [], marker="P", color=_ROBOT, label="repair")
    axes.legend(loc="upper right", fontsize="small")
    axes.set(xlabel="stage", ylabel="location", title=title)
    axes.locator_params(integer=True)
    return figure


def network_figure(model: RepairModel, y: TensorDictBase, *, control: Any = None, title: str = "") -> Figure:
    """One feature state on the graph: each location coloured by its expected damage, robots by number beside it.

    Locations are at the graph's columns and rows, rows downwards, and called by their names where there are at most 50.
    Robots are numbered from 1, side by side around their location.

    Args:
        model: the repair model.
        y: a feature state, of batch ``()``.

    Keyword Args:
        control: what the robots do now, drawn as a plus for repair and an arrow to the neighbour: an ``action`` of the model,
            the number of the joint control, or a number or name for each robot. None: nothing.
        title: title of the figure.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if ``y`` is no single feature state of the model, or there is no such control or move.
        ImportError: if matplotlib, the extra ``plot``, is not installed.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> figure = network_figure(problem.model, problem.start(torch.tensor(0)), control="repair", title="the start")
        >>> figure.axes[0].get_title()
        'the start'
    """
    check_instance("model", model, RepairModel)
    check_instance("title", title, str)
    model.check_state(y)
    if y.batch_size:
        raise ValueError(f"y must be a single feature state, of batch (), got batch {tuple(y.batch_size)}")
    controls = None
    if control is not None:
        controls = model.split_controls(model.given_control(control.tolist() if isinstance(control, Tensor) else control))
        _check_moves("control", model, y["location"], controls)
    figure, panels = _new_panels(model, 1)
    _draw_network(panels[0], model, _expected_damage(model, y["belief"]), y["location"], controls, title)
    return figure


def save_animation(
    path: str | PathLike[str],
    model: RepairModel,
    trajectories: Mapping[str, TensorDictBase],
    *,
    frames_per_second: float = 2.0,
) -> None:
    """Write trajectories as an animated GIF: one frame for each stage, drawn as :func:`network_figure` does.

    Trajectories are beside each other, or below each other where the graph is much wider than high, each with its name, its
    stage and the discounted cost of the stages before. Where one is shorter, it stays at its last state. Equal input gives
    equal files on one machine.

    Args:
        path: the file to make or replace, which ends in ``.gif``.
        model: the repair model.
        trajectories: by name, 1 to 12 times ``[T]`` with ``belief``, ``location`` and ``action``, as ``BeliefEnv.rollout``
            gives them. The state after the last control is shown if it is there, under ``next``.

    Keyword Args:
        frames_per_second: how fast it goes, in [0.1, 50].

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if there are no or too many trajectories, one is empty or none of the model, the path does not end in
            ``.gif``, or ``frames_per_second`` is out of bounds.
        ImportError: if matplotlib, the extra ``plot``, is not installed.
        OSError: if the file cannot be written; nothing is left behind.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from torchrl_pomdp.envs import BeliefEnv
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("line3")
        >>> trajectory = BeliefEnv(problem.model, problem.start, seed=0).rollout(2)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_animation(Path(folder) / "random.gif", problem.model, {"random": trajectory})
        ...     (Path(folder) / "random.gif").read_bytes()[:6]
        b'GIF89a'
    """
    path = check_path("path", path)
    if path.suffix.lower() != ".gif":
        raise ValueError(f"path must end in .gif, got {str(path)!r}")
    check_instance("model", model, RepairModel)
    check_mapping("trajectories", trajectories, TensorDictBase)
    if not 1 <= len(trajectories) <= _MOST_PANELS:
        raise ValueError(f"trajectories must hold 1 to {_MOST_PANELS} trajectories, got {len(trajectories)}")
    pace = check_number("frames_per_second", frames_per_second, "[0.1, 50]")
    frames = _frames(model, [_played(model, name, trajectory) for name, trajectory in trajectories.items()])
    content = io.BytesIO()
    next(frames).save(content, format="GIF", save_all=True, append_images=frames, duration=round(1000 / pace), loop=0)
    write_bytes(path, content.getvalue())


# ---- what is checked before it is drawn ------------------------------------------------------------------------------


class _Played(NamedTuple):
    """A trajectory of T controls, on the CPU; of its states the last one may be missing.

    Attributes:
        titles: one for each state.
        damage: expected damage levels ``[T + 1, L]``.
        location: int64 ``[T + 1, R]``.
        controls: the robots' controls, int64 ``[T, R]``.
    """

    titles: list[str]
    damage: Tensor
    location: Tensor
    controls: Tensor


def _played(model: RepairModel, name: str, trajectory: TensorDictBase) -> _Played:
    """A trajectory, checked, with the discounted cost before each stage."""
    check_text("key of trajectories", name)
    what = f"trajectories[{name!r}]"
    if len(trajectory.batch_size) != 1 or not trajectory.batch_size[0]:
        raise ValueError(f"{what} must be one trajectory of at least one stage, got batch {tuple(trajectory.batch_size)}")
    states = _states(model, what, trajectory)
    if "next" in trajectory:
        states = torch.cat([states, _states(model, f"next of {what}", trajectory["next"])[-1:]])
    shape = (*trajectory.batch_size, *model.control_shape)
    action = check_tensor(f"action of {what}", trajectory.get("action", None), shape, torch.int64)
    wrong = action[(action < 0) | (action >= model.control_range)]
    if len(wrong):
        raise ValueError(f"action of {what} must be in 0..{model.control_range - 1}, got {int(wrong[0])}")
    controls = model.split_controls(action.to(model.device))
    _check_moves(f"action of {what}", model, states["location"][: len(controls)], controls)
    # As the environment has it: no cost follows a terminal state.
    costs = model.expected_cost(states).masked_fill(model.is_terminal(states), 0.0).double()
    costs *= model.discount ** torch.arange(len(costs), device=model.device)
    before = (costs.cumsum(0) - costs).tolist()
    titles = [f"{name}\nstage {stage}, cost so far {cost:.5g}" for stage, cost in enumerate(before)]
    return _Played(titles, _expected_damage(model, states["belief"]).cpu(), states["location"].cpu(), controls.cpu())


def _states(model: RepairModel, what: str, given: TensorDictBase) -> TensorDictBase:
    """The core entries of feature states, on the model's device; raises where they are none of the model."""
    check_state_entries(what, given, model.state_spec(), "a feature state")
    check_distributions(f"entry 'belief' of {what}", given["belief"])
    return given.select(*model.state_keys).to(model.device)


def _check_moves(name: str, model: RepairModel, location: Tensor, controls: Tensor) -> None:
    """Raise unless robots' controls ``[*B, R]`` stay on the graph."""
    outside = (model.destinations[location, controls] < 0).nonzero()
    if len(outside):
        where = tuple(outside[0].tolist())
        control = model.graph.control_names[controls[where]]
        place = model.graph.location_names[location[where]]
        raise ValueError(
            f"{name} must move robots along edges, got {control!r} for robot {where[-1] + 1} at {place}, which has none there"
        )


def _expected_damage(model: RepairModel, belief: Tensor) -> Tensor:
    """Expected damage levels ``[*B, L]`` of beliefs ``[*B, L, K]``."""
    return belief @ torch.arange(model.num_levels, dtype=model.dtype, device=model.device)


# ---- what is drawn ---------------------------------------------------------------------------------------------------


def _frames(model: RepairModel, trajectories: Sequence[_Played]) -> Iterator[Image]:
    """Frames of an animation, of one palette."""
    figure, panels = _new_panels(model, len(trajectories))
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    figure.set_dpi(_DPI)
    canvas = FigureCanvasAgg(figure)
    palette = None
    for stage in range(max(len(each.titles) for each in trajectories)):
        for axes, each in zip(panels, trajectories, strict=True):
            now = min(stage, len(each.titles) - 1)
            controls = each.controls[now] if now < len(each.controls) else None
            axes.clear()
            _draw_network(axes, model, each.damage[now], each.location[now], controls, each.titles[now])
        canvas.draw()
        # Nothing moves but the robots.
        figure.set_layout_engine("none")
        frame = Image.frombuffer("RGBA", canvas.get_width_height(), canvas.buffer_rgba()).convert("RGB")
        if palette is None:
            # The bar has all the colours from the first frame on.
            palette = frame.quantize(_COLOURS, method=Image.Quantize.MAXCOVERAGE)
        yield frame.quantize(palette=palette, dither=Image.Dither.NONE)


def _new_panels(model: RepairModel, count: int) -> tuple[Figure, list[Axes]]:
    """A figure with so many empty panels for the graph, and what the colours and marks mean."""
    (left, right), (top, bottom), unit, _ = _scale(model)
    width, height = max(_LEAST_WIDTH, (right - left) / unit), (bottom - top) / unit + 0.6
    down = width > 2 * height
    rows, columns = (count, 1) if down else (1, count)
    figure = new_figure(columns * width + 1.0, max(2.4, rows * height + 0.4))
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    from matplotlib.cm import ScalarMappable

    figure.colorbar(ScalarMappable(_norm(model), _DAMAGE), ax=panels, label=_LABEL, aspect=30)
    marks = [
        panels[0].scatter([], [], marker=marker, s=size, color=_ROBOT, label=label)
        for marker, size, label in (("o", 60, "robot"), ("P", 36, "repair"), (r"$\rightarrow$", 90, "move"))
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=3, fontsize="small", frameon=False)
    return figure, panels


def _draw_network(
    axes: Axes, model: RepairModel, damage: Tensor, location: Tensor, controls: Tensor | None, title: str
) -> None:
    """Draw the graph with damage ``[L]``, robots at ``[R]`` and what they do ``[R]``, on empty axes."""
    from matplotlib.collections import LineCollection

    graph = model.graph
    scale = _scale(model)
    places = torch.stack([graph.columns, graph.rows], -1)
    nodes, slots = (graph.neighbours > torch.arange(graph.num_locations).unsqueeze(-1)).nonzero(as_tuple=True)
    ends = torch.stack([places[nodes], places[graph.neighbours[nodes, slots]]], 1)
    axes.add_collection(LineCollection(list(ends.numpy()), colors=_EDGE, linewidths=1.2, zorder=1))
    _add_discs(
        axes,
        places,
        scale.place,
        array=damage.cpu().numpy(),
        cmap=_DAMAGE,
        norm=_norm(model),
        edgecolors="#333333",
        linewidths=0.8,
        zorder=3,
    )
    if graph.num_locations <= _MOST_NAMES:
        _write_names(axes, model, damage, scale.place + 1.4 * _DISC * scale.unit)
    _draw_robots(axes, model, scale, location.cpu(), None if controls is None else controls.cpu())
    axes.set(xlim=scale.across, ylim=scale.down[::-1], aspect="equal")
    axes.set_axis_off()
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


def _draw_robots(axes: Axes, model: RepairModel, scale: _Scale, location: Tensor, controls: Tensor | None) -> None:
    """Numbered discs around the robots' locations; where there are controls, a plus beside or an arrow from each."""
    places = torch.stack([model.graph.columns, model.graph.rows], -1)
    here, disc = places[location], _DISC * scale.unit
    there = here if controls is None else places[model.destinations.cpu()[location, controls]]
    outwards, distance = _ring(location, there - here, scale.place, disc)
    spots = here + outwards * distance
    _add_discs(axes, spots, disc, facecolors=_ROBOT, edgecolors="white", linewidths=0.6, zorder=5)
    for robot, (x, y) in enumerate(spots.tolist()):
        number = axes.text(x, y, str(robot + 1), fontsize=6.2, color="white", weight="bold", zorder=6)
        number.set(ha="center", va="center_baseline")
    if controls is None:
        return
    repairs = controls == REPAIR
    x, y = (spots + 1.5 * disc * outwards)[repairs].T.numpy()
    axes.scatter(x, y, marker="P", s=46, color=_ROBOT, edgecolor="white", linewidth=0.6, zorder=6)
    # As far as the neighbour's circle; the arrow may pass below the one where the robot stands.
    way = there - spots
    way = (way - (scale.place + 0.15 * disc) * way / way.norm(dim=-1, keepdim=True))[~repairs]
    lengths: Any = {"angles": "xy", "scale_units": "xy", "scale": 1, "units": "xy", "width": 0.25 * disc, "minlength": 0}
    head: Any = {"headwidth": 5, "headlength": 6, "headaxislength": 5.5}
    axes.quiver(*spots[~repairs].T.numpy(), *way.T.numpy(), color=_ROBOT, zorder=2, **lengths, **head)


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


class _Scale(NamedTuple):
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


def _scale(model: RepairModel) -> _Scale:
    """The scale at which neighbours are well apart, in a picture that is not too large."""
    graph = model.graph
    nodes, slots = (graph.neighbours >= 0).nonzero(as_tuple=True)
    places = torch.stack([graph.columns, graph.rows], -1)
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
    return _Scale((left, right), (top, bottom), unit, place)


def _norm(model: RepairModel) -> Normalize:
    from matplotlib.colors import Normalize

    return Normalize(0, model.num_levels - 1)
