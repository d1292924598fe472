"""Files that are whole or absent, and tensors that are loaded without unpickling."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

__all__ = ["claim", "load_tensors", "save_tensors", "write_atomically", "write_json"]


def write_atomically(path: Path, write: Callable[[Path], Any]) -> None:
    """Let ``write`` make a temporary file beside ``path``, then rename it: ``path`` is never seen half written.

    Args:
        path: the file to make or replace; its folder is made if it is not there.
        write: called with the temporary path, which has the suffix of ``path``.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_atomically(Path(folder) / "a.txt", lambda path: path.write_text("whole"))
        ...     (Path(folder) / "a.txt").read_text()
        'whole'
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, content: Any) -> None:
    """Write ``content`` as JSON, atomically."""
    write_atomically(path, lambda temporary: temporary.write_text(json.dumps(content, indent=2) + "\n"))


def claim(path: Path, identity: dict[str, Any]) -> None:
    """Write down whose folder it is, or make sure that it is still the same one's.

    Args:
        path: the record, a JSON file.
        identity: all that decides the results of what is kept beside it, as JSON.

    Raises:
        ValueError: if the record says otherwise; it is left as it is.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     claim(Path(folder) / "config.json", {"seed": 0})
        ...     claim(Path(folder) / "config.json", {"seed": 0})
        ...     sorted(path.name for path in Path(folder).iterdir())
        ['config.json']
    """
    if not path.is_file():
        write_json(path, identity)
        return
    found, given = json.loads(path.read_text()), json.loads(json.dumps(identity))
    differing = sorted(key for key in {*found, *given} if found.get(key) != given.get(key))
    if differing:
        what = ", ".join(differing)
        raise ValueError(f"run folder {path.parent} holds another run, which differs in {what}: name another folder")


def save_tensors(path: Path, content: Any) -> None:
    """Write nested dictionaries of tensors, numbers and texts, atomically.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_tensors(Path(folder) / "a.pt", {"x": torch.arange(3)})
        ...     load_tensors(Path(folder) / "a.pt")["x"].tolist()
        [0, 1, 2]
    """
    write_atomically(path, lambda temporary: torch.save(content, temporary))


def load_tensors(path: Path, device: torch.device | str = "cpu") -> Any:
    """Read what :func:`save_tensors` wrote; nothing is unpickled."""
    return torch.load(path, map_location=device, weights_only=True)
