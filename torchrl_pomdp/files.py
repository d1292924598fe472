"""Files that are whole or absent, checked before they are read, and tensors that are loaded without unpickling."""

from __future__ import annotations

import io
import json
import math
import os
import secrets
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_pomdp.checks import check_choice, check_instance, check_path, shown
from torchrl_pomdp.tensor_checks import check_device

if TYPE_CHECKING:
    import torch

__all__ = [
    "DamagedFileError",
    "check_folder",
    "claim",
    "load_tensors",
    "parse_tensors",
    "read_json",
    "read_text",
    "save_tensors",
    "tensor_bytes",
    "write_bytes",
    "write_json",
]


# Larger text files are no problems that anyone has written.
_MOST_BYTES = 1 << 27
# So many differences inside of an entry are named one by one.
_FEW = 4


class DamagedFileError(ValueError):
    """A file is not what was written; the message names it and says what to do."""


def write_bytes(path: str | PathLike[str], content: bytes) -> None:
    """Write ``content`` to a new temporary file beside ``path``, then rename it: ``path`` is never seen half written.

    The temporary file has a random name and is made, never opened through something that lies there.

    Args:
        path: the file to make or replace; its folder is made if it is not there.
        content: what it shall hold.

    Raises:
        TypeError: if ``path`` is no path or ``content`` no bytes.
        OSError: if the file cannot be written; nothing is left behind.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_bytes(Path(folder) / "a.txt", b"whole")
        ...     (Path(folder) / "a.txt").read_text()
        'whole'
    """
    with _written(check_path("path", path), check_instance("content", content, bytes)) as temporary:
        os.replace(temporary, path)


@contextmanager
def _written(path: Path, content: bytes) -> Iterator[Path]:
    """A new temporary file beside ``path`` with ``content``; removed afterwards if it is still there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem[:64]}.{secrets.token_hex(8)}{path.suffix}")
    handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(handle)
        yield temporary
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def check_folder(name: str, path: str | PathLike[str]) -> Path:
    """A folder that can be written, or made; nothing is left in it.

    Args:
        name: name of the argument.
        path: the folder, which need not be there.

    Raises:
        TypeError: if it is no path.
        ValueError: if it is no folder, or nothing can be written there.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     check_folder("out", Path(folder) / "run").exists()
        False
    """
    path = check_path(name, path)
    try:
        there = next(p for p in (path, *path.absolute().parents) if p.exists())
        with tempfile.TemporaryFile(dir=there):
            return path
    except OSError as error:
        raise ValueError(f"{name} must be a folder that can be written, {path} cannot: {error.strerror or error}") from error


def write_json(path: str | PathLike[str], content: Any) -> None:
    """Write ``content`` as JSON, atomically; numbers that are not finite, which JSON does not have, become null.

    Raises:
        TypeError: if ``path`` is no path or ``content`` nothing that JSON has.
        OSError: if the file cannot be written.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_json(Path(folder) / "a.json", {"error": math.nan})
        ...     read_json(Path(folder) / "a.json")
        {'error': None}
    """
    write_bytes(path, _json("content", content).encode())


def _json(name: str, content: Any) -> str:
    try:
        return json.dumps(_finite(content), indent=2, allow_nan=False) + "\n"
    except (TypeError, ValueError, RecursionError) as error:
        raise TypeError(f"{name} must be what JSON has, got {shown(content)}: {error}") from error


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def read_json(path: str | PathLike[str]) -> dict[str, Any]:
    """Read an object that :func:`write_json` wrote.

    Raises:
        TypeError: if ``path`` is no path.
        DamagedFileError: if the file holds anything else.
    """
    path = check_path("path", path)
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(f"{path} is damaged, it holds no JSON ({error}): restore it or name another folder") from error
    if not isinstance(content, dict):
        raise DamagedFileError(f"{path} is damaged, it holds no JSON object: restore it or name another folder")
    return content


def read_text(path: str | PathLike[str], encoding: str = "utf-8") -> str:
    r"""The text of a file that a user has written, without a byte order mark.

    Args:
        path: the file.
        encoding: ``utf-8``, or ``latin-1`` for what may have any bytes.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``path`` is no plain file, is larger than 128 MiB, or is not text in this encoding.
        OSError: if it cannot be read.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_bytes(Path(folder) / "a.txt", b"\xef\xbb\xbfdiscount: 0.9")
        ...     read_text(Path(folder) / "a.txt")
        'discount: 0.9'
    """
    path = check_path("path", path)
    check_choice("encoding", encoding, ("utf-8", "latin-1"))
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    # What is no plain file, such as a pipe, might never end.
    if not path.is_file():
        raise ValueError(f"path must be a file, {path} is none")
    if path.stat().st_size > _MOST_BYTES:
        raise ValueError(f"{path} must hold at most {_MOST_BYTES} bytes, got {path.stat().st_size}")
    try:
        return path.read_bytes().removeprefix(b"\xef\xbb\xbf").decode(encoding).replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: must be text in UTF-8: {error}") from error


def claim(path: str | PathLike[str], identity: dict[str, Any]) -> None:
    """Write down whose folder it is, or make sure that it is still the same one's.

    Args:
        path: the record, a JSON file.
        identity: all that decides the results of what is kept beside it, as JSON.

    Raises:
        TypeError: if ``path`` is no path or ``identity`` is not what JSON has.
        ValueError: if the record says otherwise or is damaged; it is left as it is.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     claim(Path(folder) / "config.json", {"seed": 0})
        ...     claim(Path(folder) / "config.json", {"seed": 0})
        ...     sorted(path.name for path in Path(folder).iterdir())
        ['config.json']
    """
    path = check_path("path", path)
    text = _json("identity", check_instance("identity", identity, dict))
    if path.is_file() or not _write_new(path, text.encode()):
        _check_same(path, identity)


def check_claim(path: str | PathLike[str], identity: dict[str, Any]) -> None:
    """Raise where a record that is there says that the folder is another one's, see :func:`claim`; nothing is written.

    Args:
        path: the record.
        identity: whose the folder should be.

    Raises:
        TypeError: if ``path`` is no path or ``identity`` is not what JSON has.
        ValueError: if the record says otherwise or is damaged.
    """
    path = check_path("path", path)
    check_instance("identity", identity, dict)
    if path.is_file():
        _check_same(path, identity)


def _check_same(path: Path, identity: dict[str, Any]) -> None:
    differing = _differing(read_json(path), json.loads(_json("identity", identity)))
    if differing:
        what = ", ".join(differing)
        raise ValueError(f"run folder {path.parent} holds another run, which differs in {what}: name another folder")


def _differing(found: dict[str, Any], given: dict[str, Any]) -> list[str]:
    """Names of the entries that differ, those inside of an entry after a dot if they are few."""
    nothing, names = object(), []
    for key in sorted({*found, *given}):
        one, other = found.get(key, nothing), given.get(key, nothing)
        inside = _differing(one, other) if isinstance(one, dict) and isinstance(other, dict) else []
        if one != other:
            names += [f"{key}.{name}" for name in inside] if 0 < len(inside) <= _FEW else [key]
    return names


def _write_new(path: Path, content: bytes) -> bool:
    """Write a file that nobody else has written meanwhile, whole or not at all; False where somebody has."""
    try:
        with _written(path, content) as temporary:
            _link_new(temporary, path)
    except FileExistsError:
        return False
    return True


def _link_new(temporary: Path, path: Path) -> None:
    """Give a file another name, which is new; a ``FileExistsError`` where it is not."""
    try:
        # Unlike a renaming, a link does not replace what is there.
        os.link(temporary, path)
    except FileExistsError:
        raise
    except OSError:
        # File systems without links: an empty file takes the name first. Whoever reads it meanwhile, or after a kill, finds
        # it damaged.
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        os.replace(temporary, path)


def check_claimed(path: Path, cause: BaseException | None = None) -> None:
    """Raise a ``FileNotFoundError`` if the record that :func:`claim` has written is gone."""
    if not path.is_file():
        what = f"run folder {path.parent} was deleted or moved while the run went on"
        raise FileNotFoundError(f"{what}: delete what is left of it and start the run again") from cause


def save_tensors(path: str | PathLike[str], content: dict[str, Any]) -> None:
    """Write nested dictionaries of tensors, numbers and texts, atomically; equal content gives equal bytes.

    Raises:
        TypeError: if ``path`` is no path or ``content`` holds anything else.
        OSError: if the file cannot be written.

    Examples:
        >>> import tempfile, torch
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_tensors(Path(folder) / "a.pt", {"x": torch.arange(3)})
        ...     load_tensors(Path(folder) / "a.pt")["x"].tolist()
        [0, 1, 2]
    """
    write_bytes(path, tensor_bytes(content))


def tensor_bytes(content: dict[str, Any]) -> bytes:
    """What :func:`save_tensors` writes.

    Raises:
        TypeError: if ``content`` holds anything but tensors, numbers, texts and dictionaries of them.

    Examples:
        >>> import torch
        >>> tensor_bytes({"x": torch.arange(3)}) == tensor_bytes({"x": torch.arange(3)})
        True
    """
    import torch

    _check_content("content", check_instance("content", content, dict), torch.Tensor)
    # Saved to a path, the archive would hold the name of the temporary file.
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()


def _check_content(name: str, value: Any, tensor: type) -> None:
    if isinstance(value, dict):
        for key, entry in value.items():
            _check_content(f"{name}[{shown(key)}]", entry, tensor)
    elif not isinstance(value, tensor) and type(value) not in (str, int, float, bool, type(None)):
        raise TypeError(f"{name} must be a tensor, a number, a text or a dictionary of them, got {shown(value)}")


def load_tensors(path: str | PathLike[str], device: torch.device | str = "cpu") -> Any:
    """Read what :func:`save_tensors` wrote; nothing is unpickled.

    Raises:
        TypeError: if ``path`` is no path.
        DamagedFileError: if the file is not as it was written, or of another kind.
        ValueError: if there is no such device.
    """
    path = check_path("path", path)
    return parse_tensors(path.read_bytes(), path, device)


def parse_tensors(content: bytes, path: str | PathLike[str], device: torch.device | str = "cpu") -> Any:
    """What the content of a file stands for that :func:`save_tensors` wrote.

    PyTorch does not look at the check sums that an archive has for its files, so they are compared first.

    Args:
        content: the bytes.
        path: the file that they are of, for messages.
        device: where tensors are put.

    Raises:
        TypeError: if ``content`` is no bytes or ``path`` no path.
        DamagedFileError: if they are not as they were written, or of another kind.
        ValueError: if there is no such device.
    """
    import torch

    path, device = check_path("path", path), check_device("device", device)
    check_instance("content", content, bytes)
    try:
        _check_archive(content)
        return torch.load(io.BytesIO(content), map_location=device, weights_only=True)
    except Exception as error:  # torch.load raises whatever a foreign file happens to trigger
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise DamagedFileError(f"{path} is damaged or no file of this library: {reason}") from error


def _check_archive(content: bytes) -> None:
    """Raise unless ``content`` is an archive of stored files that agree with their check sums."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        files = archive.infolist()
        # Readers differ in which of several archives they take: it must be one, from the first byte to the last.
        if not files or min(file.header_offset for file in files) != 0 or content[-22:-18] != b"PK\5\6":
            raise ValueError("there is something before or behind the archive")
        # Tensors are stored as they are; a small archive that unfolds to a huge one is none of ours.
        if any(file.compress_type != zipfile.ZIP_STORED or file.file_size > len(content) for file in files):
            raise ValueError("the archive holds compressed files")
        damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"the check sum of {damaged} is wrong")
