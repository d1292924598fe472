"""One picture of a feature state, or of a trajectory by time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.envs.repair.model import REPAIR, RepairModel
from torchrl_pomdp.envs.repair.rendering.network import DAMAGE, DAMAGE_LABEL, ROBOT, damage_norm, draw_network, scale_of
from torchrl_pomdp.envs.repair.rendering.played import check_moves, expected_damage, of_one_trajectory
from torchrl_pomdp.pictures import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["is_wide", "network_figure", "new_panels", "trajectory_figure"]

# Inches of a panel that its title needs, and of what is above and below its graph.
_LEAST_WIDTH, _TITLE = 2.8, 0.6
# The longest bar of colours, in inches.
_BAR = 4.0


def trajectory_figure(model: RepairModel, trajectory: TensorDictBase, title: str = "") -> Figure:
    """One trajectory: locations by time, colour the expected damage, robots' paths over it, repairs marked.

    Args:
        model: the repair model.
        trajectory: ``[T]`` with ``belief``, ``location`` and ``action``, as ``BeliefEnv.rollout`` gives it.
        title: title of the figure.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if an entry is missing or none of the model, or it is not a single trajectory.
        ImportError: if matplotlib, the extra ``plot``, is not installed.
    """
    check_instance("model", model, RepairModel)
    check_instance("title", title, str)
    missing = [
        key for key in ("belief", "location", "action") if key not in check_instance("trajectory", trajectory, TensorDictBase)
    ]
    if missing:
        raise ValueError(f"trajectory must have the entry {missing[0]!r}, got {sorted(map(str, trajectory.keys()))}")
    states, controls = of_one_trajectory(model, "trajectory", trajectory)
    steps, damage = trajectory.batch_size[0], expected_damage(model, states["belief"])
    figure = new_figure(max(5.0, 0.14 * steps + 2.5), max(2.5, 0.16 * model.num_locations + 1.2))
    axes = figure.add_subplot()
    image = axes.imshow(
        damage.T.cpu().numpy(), aspect="auto", cmap=DAMAGE, vmin=0, vmax=model.num_levels - 1, interpolation="nearest"
    )
    figure.colorbar(image, ax=axes, label=DAMAGE_LABEL)
    for robot in range(model.num_robots):
        path = trajectory["location"][:, robot].cpu().numpy()
        axes.plot(range(steps), path, color=ROBOT, linewidth=1.2, label=f"robot {robot + 1}")
        repairs = (controls[:, robot] == REPAIR).nonzero().squeeze(-1).cpu().numpy()
        axes.scatter(repairs, path[repairs], marker="P", s=44, color=ROBOT, edgecolor="white", linewidth=0.6)
    axes.scatter([], [], marker="P", color=ROBOT, label="repair")
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
        >>> import torch
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
        check_moves("control", model, y["location"], controls)
    figure, panels = new_panels(model, 1, [None])
    draw_network(panels[0], model, expected_damage(model, y["belief"]), y["location"], controls, title)
    return figure


def is_wide(model: RepairModel) -> bool:
    """Whether the graph is so wide that panels go below each other."""
    width, height = _panel(model)
    return width > 2 * height


def _panel(model: RepairModel) -> tuple[float, float]:
    """Width and height of a panel for the graph, in inches."""
    (left, right), (top, bottom), unit, _ = scale_of(model)
    return max(_LEAST_WIDTH, (right - left) / unit), (bottom - top) / unit + _TITLE


def new_panels(model: RepairModel, columns: int, rows: Sequence[float | None]) -> tuple[Figure, list[Axes]]:
    """A figure with empty panels row by row, and what the colours and marks mean.

    Args:
        model: the repair model.
        columns: panels of a row.
        rows: height of each row in inches; None: what the graph needs.
    """
    width, height = _panel(model)
    heights = [height if row is None else row for row in rows]
    figure = new_figure(columns * width + 1.0, max(2.4, sum(heights) + 0.4))
    panels = list(figure.subplots(len(rows), columns, squeeze=False, height_ratios=heights).flat)
    from matplotlib.cm import ScalarMappable

    shrink = min(1.0, _BAR / float(figure.get_figheight()))
    figure.colorbar(ScalarMappable(damage_norm(model), DAMAGE), ax=panels, label=DAMAGE_LABEL, aspect=30, shrink=shrink)
    marks = [
        panels[0].scatter([], [], marker=marker, s=size, color=ROBOT, label=label)
        for marker, size, label in (("o", 60, "robot"), ("P", 36, "repair"), (r"$\rightarrow$", 90, "move"))
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=3, fontsize="small", frameon=False)
    return figure, panels
