"""An empty figure, and colours; matplotlib, the extra ``plot``, is imported when one is made."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["COLOURS", "new_figure"]

# Colours of lines and markers, told apart by colour-blind people too (Okabe and Ito, 2008).
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#56b4e9", "#cc79a7", "#000000")


def new_figure(width: float, height: float) -> Figure:
    """A figure of so many inches; an ``ImportError`` says what to install where matplotlib is missing."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("pictures need matplotlib: pip install '.[plot]' in the library's folder") from error
    return Figure(figsize=(width, height), layout="constrained", dpi=120)
