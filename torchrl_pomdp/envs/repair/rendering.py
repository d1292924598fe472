"""Pictures of repair problems; matplotlib, the extra ``plot``, is imported when one is drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.envs.repair.model import REPAIR, RepairModel
from torchrl_pomdp.pictures import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["trajectory_figure"]


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
    damage = trajectory["belief"] @ torch.arange(model.num_levels, dtype=model.dtype, device=model.device)
    figure = new_figure(max(5.0, 0.14 * steps + 2.5), max(2.5, 0.16 * model.num_locations + 1.2))
    axes = figure.add_subplot()
    image = axes.imshow(
        damage.T.cpu().numpy(), aspect="auto", cmap="YlOrRd", vmin=0, vmax=model.num_levels - 1, interpolation="nearest"
    )
    figure.colorbar(image, ax=axes, label="expected damage level")
    controls = model.split_controls(trajectory["action"])
    for robot in range(model.num_robots):
        path = trajectory["location"][:, robot].cpu().numpy()
        axes.plot(range(steps), path, color="#1f4e79", linewidth=1.2, label=f"robot {robot + 1}")
        repairs = (controls[:, robot] == REPAIR).nonzero().squeeze(-1).cpu().numpy()
        axes.scatter(repairs, path[repairs], marker="P", s=44, color="#1f4e79", edgecolor="white", linewidth=0.6)
    axes.scatter([], [], marker="P", color="#1f4e79", label="repair")
    axes.legend(loc="upper right", fontsize="small")
    axes.set(xlabel="stage", ylabel="location", title=title)
    axes.locator_params(integer=True)
    return figure
