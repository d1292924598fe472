"""Problems as files: TOML, or the format ``.POMDP``; errors name the file, the line and the entry."""

from __future__ import annotations

import re
import tomllib
from os import PathLike
from pathlib import Path
from typing import Any

import torch

from torchrl_pomdp.checks import check_path, shown
from torchrl_pomdp.files import read_text
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.problems.specs import SpecError, problem_from_spec

__all__ = ["read_problem"]

_KEY = re.compile(r"""\s*(?:"([^"]*)"|'([^']*)'|([A-Za-z0-9_-]+))\s*=""")
_SECTION = re.compile(r"\s*\[\s*([A-Za-z0-9_.-]+)\s*\]")


def read_problem(path: str | PathLike[str], *, device: torch.device | str = "cpu") -> Problem:
    """The problem that a file describes.

    A file ``.toml`` has the entries of :func:`problem_from_spec`; ``pomdp`` there is the path of a file ``.POMDP``, from the
    folder of the file. A file ``.POMDP`` can be given itself.

    Args:
        path: the file.

    Keyword Args:
        device: where the model computes.

    Raises:
        TypeError: if ``path`` is no path.
        ValueError: if it describes no problem; one line, with the file, the line and the entry where they are known.
        OSError: if it cannot be read.

    Examples:
        >>> import tempfile
        >>> text = "repair = {graph.edges = [[0, 1], [1, 2], [1,3]], degradation = [0, 0.1], costs = [0, 1, 5], discount = 0.9}"
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "pipes.toml"
        ...     _ = path.write_text(text)
        ...     problem = read_problem(path)
        >>> problem.name, problem.model.describe()
        ('pipes', 'graph, 1 robot: 3.2e+02 states, 4 controls, 3 observations, discount 0.9')
    """
    path = check_path("path", path)
    if path.suffix.lower() == ".pomdp":
        return _built({"pomdp": read_text(path, "latin-1")}, path, None, device)
    text = read_text(path)
    try:
        spec = tomllib.loads(text)
    except ValueError as error:
        raise ValueError(_syntax(path, text, str(error))) from error
    except RecursionError as error:
        raise ValueError(f"{path}: is nested too deeply") from error
    if isinstance(spec.get("pomdp"), str):
        try:
            spec["pomdp"] = read_text(path.parent / spec["pomdp"], "latin-1")
        except (OSError, ValueError) as error:
            where = f"{path}, line {_line_of(text, ('pomdp',))}"
            raise ValueError(f"{where}: pomdp: must be a file that can be read, got {shown(spec['pomdp'])}: {error}") from error
    return _built(spec, path, text, device)


def _syntax(path: Path, text: str, message: str) -> str:
    """What the parser says, with the line in front."""
    at = re.search(r" \(at (?:line (\d+), column \d+|end of document)\)$", message)
    if at is None:
        return f"{path}: {message}"
    line = at[1] or max(1, len(text.splitlines()))
    return f"{path}, line {line}: {message[: at.start()]}"


def _built(spec: dict[str, Any], path: Path, text: str | None, device: torch.device | str) -> Problem:
    try:
        return problem_from_spec({"name": path.stem, **spec}, device=device)
    except SpecError as error:
        if text is None:
            raise ValueError(f"{path}: {error.message}") from error
        line = _line_of(text, error.key)
        where = f"{path}, line {line}" if line else str(path)
        told = f"{'.'.join(error.key)}: {error.message}" if error.key else error.message
        raise ValueError(f"{where}: {' '.join(told.split())}") from error


def _line_of(text: str, key: tuple[str, ...]) -> int | None:
    """Number of the line where the entry ``key`` of a TOML text begins; that of its table where it is missing."""
    section: tuple[str, ...] = ()
    found = None
    for number, line in enumerate(text.splitlines(), 1):
        header, entry = _SECTION.match(line), _KEY.match(line)
        if header:
            section = tuple(header[1].split("."))
            place = section
        elif entry:
            place = (*section, next(name for name in entry.groups() if name is not None))
        else:
            continue
        # An entry may lie in a table that is written in one line.
        if place == key[: len(place)]:
            found = number
            if place == key:
                return number
    return found
