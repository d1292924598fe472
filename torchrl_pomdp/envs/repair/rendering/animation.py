"""Trajectories that move: beliefs, the truth beside them, and Q-factors."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tensordict import TensorDictBase

from torchrl_pomdp.checks import check_instance, check_mapping, check_number, check_path
from torchrl_pomdp.envs.repair.model import RepairModel
from torchrl_pomdp.envs.repair.rendering.figures import is_wide, new_panels
from torchrl_pomdp.envs.repair.rendering.network import ROBOT, draw_network
from torchrl_pomdp.envs.repair.rendering.played import Played, played
from torchrl_pomdp.files import write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["save_animation"]

# Trajectories of an animation.
_MOST = 12
# Of a GIF: dots per inch, and colours of its one palette. Of a film: dots per inch.
_DPI, _COLOURS, _FILM_DPI = 80, 160, 120
# Milliseconds that the last frame of a GIF stays longer.
_PAUSE = 2000
_BAR = "#9aa5b1"
# What may be shown of a trajectory, from top to bottom.
_KINDS = ("belief", "truth", "bars")


def save_animation(
    path: str | PathLike[str],
    model: RepairModel,
    trajectories: Mapping[str, TensorDictBase],
    *,
    frames_per_second: float = 2.0,
) -> None:
    """Write trajectories as an animated GIF or as an MP4: one frame for each stage, drawn as :func:`network_figure` does.

    A trajectory with hidden states, under ``hidden``, is shown twice: what is known, and the truth. One with ``q_factors`` of
    at most 32 controls has a bar for each control, eight at most: its Q-factor above the least one; the chosen control is bold.
    :func:`~torchrl_pomdp.trajectories.play` gives both.

    Several trajectories are beside each other, with the truth and the bars below; where the graph is much wider than high all
    is below each other. Under each are its stage and the discounted cost of the stages before. Where one is shorter, it stays
    at its last state. Equal input gives equal GIFs on one machine.

    Args:
        path: the file to make or replace, which ends in ``.gif``, or in ``.mp4`` where the program ffmpeg is installed.
        model: the repair model.
        trajectories: by name, 1 to 12 times ``[T]`` with ``belief``, ``location`` and ``action``, as ``BeliefEnv.rollout``
            and :func:`~torchrl_pomdp.trajectories.play` give them. The state after the last control is shown if it is there,
            under ``next``.

    Keyword Args:
        frames_per_second: how fast it goes, in [0.1, 50].

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if there are no or too many trajectories, one is empty or none of the model, the path does not end in
            ``.gif`` or ``.mp4``, ffmpeg is needed and not installed, or ``frames_per_second`` is out of bounds.
        ImportError: if matplotlib, the extra ``plot``, is not installed.
        OSError: if the file cannot be written; nothing is left behind.

    Examples:
        >>> import tempfile, torch
        >>> from pathlib import Path
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.trajectories import play
        >>> problem, key = make_problem("line3"), torch.tensor(0)
        >>> trajectory = play(problem.model, problem.base_policies["greedy"], problem.start(key), key, max_steps=2)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_animation(Path(folder) / "greedy.gif", problem.model, {"greedy": trajectory})
        ...     (Path(folder) / "greedy.gif").read_bytes()[:6]
        b'GIF89a'
    """
    path = check_film("path", path)
    check_instance("model", model, RepairModel)
    check_mapping("trajectories", trajectories, TensorDictBase)
    if not 1 <= len(trajectories) <= _MOST:
        raise ValueError(f"trajectories must hold 1 to {_MOST} trajectories, got {len(trajectories)}")
    pace = check_number("frames_per_second", frames_per_second, "[0.1, 50]")
    shown = [played(model, name, trajectory) for name, trajectory in trajectories.items()]
    figure, panels = _panels(model, shown)
    frames = _frames(model, panels, shown)
    write_bytes(path, _gif(figure, frames, pace) if path.suffix.lower() == ".gif" else _mp4(figure, frames, pace))


def check_film(name: str, path: str | PathLike[str]) -> Path:
    """The path of an animation; raises unless it ends as one, and what writes it is installed."""
    file = check_path(name, path)
    if file.suffix.lower() not in (".gif", ".mp4"):
        raise ValueError(f"{name} must end in .gif or .mp4, got {str(path)!r}")
    if file.suffix.lower() == ".mp4":
        from matplotlib.animation import FFMpegWriter

        if not FFMpegWriter.isAvailable():
            raise ValueError(f"{name} ends in .mp4, which needs the program ffmpeg: install it, or name a .gif")
    return file


def _gif(figure: Figure, frames: Iterator[None], pace: float) -> bytes:
    """A GIF of a figure as it is after each of the frames, of one palette, so that it is small."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    figure.set_dpi(_DPI)
    canvas = FigureCanvasAgg(figure)
    images: list[Image.Image] = []
    palette = None
    for _ in frames:
        canvas.draw()
        # Nothing moves but the robots.
        figure.set_layout_engine("none")
        image = Image.frombuffer("RGBA", canvas.get_width_height(), canvas.buffer_rgba()).convert("RGB")
        if palette is None:
            # The bar has all the colours from the first frame on.
            palette = image.quantize(_COLOURS, method=Image.Quantize.MAXCOVERAGE)
        images.append(image.quantize(palette=palette, dither=Image.Dither.NONE))
    content = io.BytesIO()
    # At the end there is time to read it before it begins again.
    shown = [round(1000 / pace)] * (len(images) - 1) + [round(1000 / pace) + _PAUSE]
    images[0].save(content, format="GIF", save_all=True, append_images=images[1:], duration=shown, loop=0)
    return content.getvalue()


def _mp4(figure: Figure, frames: Iterator[None], pace: float) -> bytes:
    """An MP4 of a figure as it is after each of the frames."""
    from matplotlib.animation import FFMpegWriter

    # Any rate will do for ffmpeg.
    rate: Any = pace
    # Players want frames of even width and height, and this format of pixels.
    writer = FFMpegWriter(fps=rate, codec="h264", extra_args=["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"])
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "film.mp4"
        with writer.saving(figure, str(file), _FILM_DPI):
            for _ in frames:
                writer.grab_frame()
                figure.set_layout_engine("none")
        return file.read_bytes()


def _kinds(each: Played) -> list[str]:
    """The panels of a trajectory, from top to bottom."""
    return [kind for kind in _KINDS if kind == "belief" or getattr(each, kind) is not None]


def _panels(model: RepairModel, trajectories: Sequence[Played]) -> tuple[Figure, list[dict[str, Axes]]]:
    """A figure with the empty panels of each trajectory, by kind."""
    every = [kind for kind in _KINDS if any(kind in _kinds(each) for each in trajectories)]
    panels = [(number, kind) for kind in every for number in range(len(trajectories))]
    columns = len(trajectories) if len(trajectories) > 1 else len(every)
    if is_wide(model):
        columns, panels = 1, sorted(panels, key=lambda panel: panel[0])
    bars = max((len(stage) for each in trajectories for stage in each.bars or ()), default=0)
    rows = [0.2 * bars + 0.7 if kind == "bars" else None for _, kind in panels[::columns]]
    figure, axes = new_panels(model, columns, rows)
    found = dict(zip(panels, axes, strict=True))
    for number, kind in panels:
        if kind not in _kinds(trajectories[number]):
            found[number, kind].set_axis_off()
    return figure, [{kind: found[number, kind] for kind in _kinds(each)} for number, each in enumerate(trajectories)]


def _frames(model: RepairModel, panels: Sequence[dict[str, Axes]], trajectories: Sequence[Played]) -> Iterator[None]:
    """Draw stage after stage."""
    for stage in range(max(len(each.captions) for each in trajectories)):
        for axes, each in zip(panels, trajectories, strict=True):
            _draw(model, axes, each, min(stage, len(each.captions) - 1))
        yield


def _draw(model: RepairModel, panels: Mapping[str, Axes], each: Played, stage: int) -> None:
    """Draw a stage of a trajectory on its panels."""
    controls = each.controls[stage] if stage < len(each.controls) else None
    for kind, axes in panels.items():
        axes.clear()
        if kind == "belief":
            title = each.name if len(panels) == 1 else f"{each.name}: what is known"
            draw_network(axes, model, each.damage[stage], each.location[stage], controls, title)
        elif kind == "truth" and each.truth is not None:
            level = each.truth[stage].to(each.damage.dtype)
            draw_network(axes, model, level, each.location[stage], controls, f"{each.name}: the truth")
        elif each.bars is not None:
            _draw_bars(axes, each.bars[stage] if stage < len(each.bars) else [], max(map(len, each.bars)))
    # Below what is lowest.
    axes.set_xlabel(each.captions[stage])


def _draw_bars(axes: Axes, bars: Sequence[tuple[str, float, bool]], room: int) -> None:
    """A bar for each control, with room for as many as there ever are: its Q-factor above the least one."""
    axes.set_title("Q-factor above the least", fontsize="medium")
    most = max((value for _, value, _ in bars), default=0.0) or 1.0
    for place, (name, value, chosen) in enumerate(bars):
        axes.barh(place, value / most, 0.7, color=ROBOT if chosen else _BAR)
        weight = "bold" if chosen else "normal"
        axes.text(-0.02, place, name, ha="right", va="center", fontsize="small", weight=weight, parse_math=False)
        axes.text(value / most + 0.02, place, f"{value:.4g}", va="center", fontsize="small", weight=weight)
    # Room for the names, the same at every stage.
    axes.set(xlim=(-0.45, 1.25), ylim=(room - 0.4, -0.6), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
