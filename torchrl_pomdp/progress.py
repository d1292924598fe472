"""Progress bars: on a terminal, and nowhere else."""

from __future__ import annotations

from tqdm import tqdm

__all__ = ["progress_bar"]


def progress_bar(total: int | None, unit: str, desc: str, show: bool, *, smoothing: float = 0.3, leave: bool = False) -> tqdm:
    """A progress bar on standard error, silent where that is no terminal.

    Args:
        total: how many units there will be; None if that is not known, then large numbers are abbreviated.
        unit: what is counted.
        desc: what is done.
        show: whether to show it at all.

    Keyword Args:
        smoothing: weight of the latest rate in the rate that is shown; 0 for the mean over the whole time.
        leave: whether the bar stays once it is full.

    Examples:
        >>> with progress_bar(2, "state", "label", show=False) as bar:
        ...     _ = bar.update(2)
    """
    # None: tqdm looks whether there is a terminal.
    disable = None if show else True
    return tqdm(total=total, unit=unit, desc=desc, disable=disable, unit_scale=total is None, smoothing=smoothing, leave=leave)
