"""An empty figure; matplotlib, the extra ``plot``, is imported when one is made."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["new_figure"]


def new_figure(width: float, height: float) -> Figure:
    """A figure of so many inches; an ``ImportError`` says what to install where matplotlib is missing."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("pictures need matplotlib: pip install 'torchrl-pomdp[plot]'") from error
    return Figure(figsize=(width, height), layout="constrained", dpi=120)
