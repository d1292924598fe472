"""Logs of losses, one set of files for each trained part."""

from __future__ import annotations

import shutil
from pathlib import Path

from torchrl.record import CSVLogger
from torchrl.record.loggers import Logger

__all__ = ["clear_log", "close_log"]


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
    close_log(logger, name)
    shutil.rmtree(_folder(logger, name), ignore_errors=True)


def close_log(logger: Logger | None, name: str) -> None:
    """Close the files of a part that is trained: a CSV logger keeps all open that it has written to, and their numbers.

    Args:
        logger: any logger; all but TorchRL's ``CSVLogger`` are left alone.
        name: the part, as its scalars are called before the last slash.
    """
    if not isinstance(logger, CSVLogger):
        return
    folder, experiment = _folder(logger, name), logger.experiment
    # Parts may be trained side by side.
    for path in [path for path in list(experiment.files) if Path(path).is_relative_to(folder)]:
        experiment.files.pop(path).close()
    for scalar in [scalar for scalar in list(experiment.scalars) if scalar.startswith(f"{name}/")]:
        del experiment.scalars[scalar]


def _folder(logger: CSVLogger, name: str) -> Path:
    return Path(logger.experiment.log_dir) / "scalars" / name
