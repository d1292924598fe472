"""The problem that a text on the command line names."""

from __future__ import annotations

import importlib
import inspect
import sys
from pathlib import Path

import torch

from torchrl_pomdp.checks import check_text, shown
from torchrl_pomdp.problems.presets import PRESETS, make_problem
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.problems.problem_file import read_problem

__all__ = ["find_problem"]


def find_problem(text: str, device: torch.device | str = "cpu") -> Problem:
    """The problem that a text names: a preset, a file, or ``module:function`` of the user's own code.

    Args:
        text: the name of a preset; the path of a file ``.toml`` or ``.POMDP``; or a module, importable from the present
            folder, and a function in it that takes no arguments and returns a :class:`Problem`.
        device: where the model computes; a function of the user's own decides for itself.

    Raises:
        TypeError: if the function returns no problem.
        ValueError: if there is no such problem, or its file is wrong.

    Examples:
        >>> find_problem("tiger").name
        'tiger'
    """
    check_text("problem", text)
    if text in PRESETS:
        return make_problem(text, device=device)
    if Path(text).suffix.lower() in (".toml", ".pomdp"):
        return read_problem(text, device=device)
    if ":" in text and not Path(text).exists():
        return _own_problem(text)
    known = ", ".join(sorted(PRESETS))
    raise ValueError(f"problem must be a preset ({known}), a file .toml or .POMDP, or module:function, got {shown(text)}")


def _own_problem(text: str) -> Problem:
    name, _, attribute = text.partition(":")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        make = getattr(importlib.import_module(name), attribute)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        where = "the present folder is searched too"
        raise ValueError(f"problem must name a module and a function in it, got {shown(text)}: {error}; {where}") from error
    if not callable(make):
        raise TypeError(f"{text} must be a function, got {shown(make)}")
    try:
        inspect.signature(make).bind()
    except (TypeError, ValueError) as error:  # the latter where Python does not know the arguments
        raise TypeError(f"{text} must be a function without arguments: {error}") from error
    problem = make()
    if not isinstance(problem, Problem):
        raise TypeError(f"{text} must return a Problem, got {shown(problem)}")
    return problem
