"""Results that a run keeps as it goes: a file says what it is a result of, and is used for that alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torchrl import logger

from torchrl_pomdp.files import DamagedFileError, load_tensors, save_tensors
from torchrl_pomdp.identity import digest

__all__ = ["keep", "kept", "own_result"]


def keep(path: Path, owner: str, content: dict[str, Any]) -> None:
    """Write a result, atomically.

    Args:
        path: the file.
        owner: digest of all that decides the result.
        content: nested dictionaries of tensors, numbers and texts.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     keep(Path(folder) / "a.pt", "mine", {"x": 1.0})
        ...     kept(Path(folder) / "a.pt", "mine"), kept(Path(folder) / "a.pt", "other"), kept(Path(folder) / "b.pt", "mine")
        ({'x': 1.0}, None, None)
    """
    save_tensors(path, {"owner": owner, "digest": digest(content), "content": content})


def kept(path: Path, owner: str, device: torch.device | str = "cpu") -> dict[str, Any] | None:
    """Read a result back; None, with a warning in the log, where the file is damaged or belongs to something else.

    Args:
        path: the file; None without a warning where there is none.
        owner: digest of all that decides the result.
        device: where tensors are put.
    """
    try:
        return own_result(path, owner, device)
    except DamagedFileError as error:
        logger.warning(f"{error}: made again")
        return None


def own_result(path: Path, owner: str, device: torch.device | str = "cpu") -> dict[str, Any] | None:
    """Read a result back; None where there is no file.

    Args:
        path: the file.
        owner: digest of all that decides the result.
        device: where tensors are put.

    Raises:
        DamagedFileError: if the file is damaged or belongs to something else.
    """
    if not path.is_file():
        return None
    found = load_tensors(path, device)
    if isinstance(found, dict) and found.get("owner") == owner and found.get("digest") == digest(found.get("content")):
        return found["content"]
    raise DamagedFileError(f"{path} is damaged or the result of another run")
