"""What results were taken with: commit, versions, hardware, threads."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from torchrl_pomdp.files import DamagedFileError, read_json, write_json

__all__ = ["known_provenance", "note_provenance", "provenance"]

_FILE = "provenance.json"
_PACKAGES = ("torchrl-pomdp", "torch", "torchrl", "tensordict")


def provenance(*packages: str) -> dict[str, Any]:
    """Commit, versions, hardware and threads, to put beside results.

    Args:
        packages: further packages whose versions matter.

    Examples:
        >>> sorted(provenance())
        ['commit', 'cores', 'cpu', 'python', 'threads', 'versions']
    """
    return {
        "commit": _commit(),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in (*_PACKAGES, *packages)},
    }


def note_provenance(folder: Path) -> None:
    """Add to a run folder's ``provenance.json`` this process's commit and machine, if it does not tell of them yet.

    Args:
        folder: the run folder.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     note_provenance(Path(folder))
        ...     note_provenance(Path(folder))
        ...     known_provenance(Path(folder)) == [provenance()]
        True
    """
    known, own = known_provenance(folder), provenance()
    if own not in known:
        write_json(folder / _FILE, {"computed_by": [*known, own]})


def known_provenance(folder: Path) -> list[dict[str, Any]]:
    """What has computed in a run folder, in order; empty where that is not known.

    Args:
        folder: the run folder.
    """
    path = folder / _FILE
    try:
        found: Any = read_json(path).get("computed_by") if path.is_file() else None
    except DamagedFileError:
        return []
    return list(found) if isinstance(found, list) and all(isinstance(each, dict) for each in found) else []


def _commit() -> str | None:
    """Commit of the checkout that this library runs from, ``-dirty`` if its files differ; None if it runs from none."""
    # The folder may lie in the checkout of something else, such as an environment's.
    if _git("ls-files", "--error-unmatch", Path(__file__).name) is None:
        return None
    commit, changed = _git("rev-parse", "HEAD"), _git("status", "--porcelain", "--untracked-files=no")
    return f"{commit}-dirty" if commit and changed else commit


def _git(*arguments: str) -> str | None:
    """What git prints about this file's folder; None where it fails or is not there."""
    # A hook that git runs is told of another repository in these.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    command = ["git", "-C", str(Path(__file__).parent), *arguments]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.decode(errors="replace").strip()


def _cpu() -> str:
    """Name of the processor, where the system tells."""
    table = Path("/proc/cpuinfo")
    lines = table.read_text().splitlines() if table.is_file() else []
    names = (line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())
