"""Pictures of episodes as pixels and in a window; matplotlib, the extra ``plot``, is imported when one is drawn."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_pomdp.checks import check_choice
from torchrl_pomdp.envs.gym.simulation import Simulation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["FRAMES_PER_SECOND", "Window", "check_render_mode", "figure_pixels", "render_modes"]

FRAMES_PER_SECOND = 2
"""Stages a second, in windows and videos."""


def render_modes(simulation: Simulation) -> list[str]:
    """How episodes can be rendered here: not at all without a drawing of the problem; in windows where there is a display."""
    if not simulation.has_figure:
        return []
    display = sys.platform in ("win32", "darwin") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return ["rgb_array", "human"] if display else ["rgb_array"]


def check_render_mode(value: Any, simulation: Simulation, modes: list[str]) -> str | None:
    """A render mode, or None.

    Raises:
        TypeError: if it is no text.
        ValueError: if nothing can be rendered so; the message says why.
    """
    if value is None:
        return None
    if not simulation.has_figure:
        owner = type(simulation.model).__name__
        raise ValueError(f"render_mode must be None for this problem, got {value!r}: there is no drawing of a {owner}")
    if value == "human" and value not in modes:
        raise ValueError("render_mode must be one of rgb_array, got 'human': there is no display here for a window")
    return check_choice("render_mode", value, modes)


def figure_pixels(figure: Figure) -> np.ndarray:
    """A figure as pixels, uint8 ``[height, width, 3]``; both sizes are even, as codecs of videos want it.

    Examples:
        >>> from torchrl_pomdp.pictures import new_figure
        >>> figure_pixels(new_figure(1.0, 0.51)).shape
        (62, 120, 3)
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    return np.pad(pixels, ((0, pixels.shape[0] % 2), (0, pixels.shape[1] % 2), (0, 0)), mode="edge")


class Window:
    """A window of matplotlib's that shows one picture after the other."""

    def __init__(self) -> None:
        self._figure: Any = None

    def show(self, pixels: np.ndarray) -> None:
        """Show a picture for the time of one frame; one that has been closed by hand is opened again."""
        from matplotlib import pyplot

        if self._figure is None or not pyplot.fignum_exists(self._figure.number):
            height, width, _ = pixels.shape
            self._figure = pyplot.figure("torchrl_pomdp", figsize=(width / 100, height / 100), dpi=100, clear=True)
            axes = self._figure.add_axes((0, 0, 1, 1))
            axes.set_axis_off()
            self._image = axes.imshow(pixels)
        self._image.set_data(pixels)
        pyplot.pause(1 / FRAMES_PER_SECOND)

    def close(self) -> None:
        """Close the window; it may be closed already."""
        if self._figure is not None:
            from matplotlib import pyplot

            pyplot.close(self._figure)
            self._figure = None
