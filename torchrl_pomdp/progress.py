"""Progress bars on a terminal, and a line now and then elsewhere."""

from __future__ import annotations

import sys
from typing import Any, TextIO

from tqdm import tqdm

__all__ = ["progress_bar"]

# Seconds between two lines where there is no terminal; what takes less is not told.
_SELDOM = 30.0


def progress_bar(
    total: int | None, unit: str, desc: str, show: bool, *, smoothing: float = 0.3, leave: bool = False, initial: int = 0
) -> tqdm:
    """A progress bar on standard error; where that is no terminal, such as a file, a line every half a minute.

    Args:
        total: how many units there will be; None if that is not known, then large numbers are abbreviated.
        unit: what is counted.
        desc: what is done.
        show: whether to show it at all.

    Keyword Args:
        smoothing: weight of the latest rate in the rate that is shown; 0 for the mean over the whole time.
        leave: whether the bar stays once it is full.
        initial: units that were done before, which say nothing about the rate.

    Examples:
        >>> with progress_bar(2, "state", "label", show=False) as bar:
        ...     _ = bar.update(2)
    """
    options: dict[str, Any] = {"leave": leave}
    if not sys.stderr.isatty():
        # Without a bar, and nothing at its end.
        options = {"leave": False, "ncols": 0, "file": _Lines(sys.stderr)}
        options |= {"mininterval": _SELDOM, "maxinterval": _SELDOM, "delay": _SELDOM}
    options |= {"initial": initial, "unit_scale": total is None, "smoothing": smoothing}
    return tqdm(total=total, unit=unit, desc=desc, disable=not show, **options)


class _Lines:
    """A stream on which each state of a bar is a line of its own, and does not overwrite the last one."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> None:
        """Write the text as a line, unless it is blank."""
        if text.strip():
            self.stream.write(f"{text.strip()}\n")

    def flush(self) -> None:
        """Flush the stream."""
        self.stream.flush()
