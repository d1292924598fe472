"""Logs of losses, one set of files for each trained part."""

from __future__ import annotations

import shutil
from pathlib import Path

from torchrl.record import CSVLogger
from torchrl.record.loggers import Logger

__all__ = ["clear_log"]


def clear_log(logger: Logger | None, name: str) -> None:
    r"""Remove what a CSV logger has kept of a part that is trained anew; it would append the same rows again.

    Args:
        logger: any logger; all but TorchRL's ``CSVLogger`` are left alone.
        name: the part, as its scalars are called before the last slash.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     logger = CSVLogger("log", log_dir=folder)
        ...     logger.log_scalar("part/loss", 1.0, step=50)
        ...     clear_log(logger, "part")
        ...     logger.log_scalar("part/loss", 2.0, step=50)
        ...     (Path(folder) / "log" / "scalars" / "part" / "loss.csv").read_text()
        '50,2.0\n'
    """
    if not isinstance(logger, CSVLogger):
        return
    folder = Path(logger.experiment.log_dir) / "scalars" / name
    # The logger keeps the files open that it has written to.
    files = logger.experiment.files
    for path in [path for path in list(files) if Path(path).is_relative_to(folder)]:
        files.pop(path).close()
    shutil.rmtree(folder, ignore_errors=True)
