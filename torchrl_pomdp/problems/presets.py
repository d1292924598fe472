"""The problems by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from difflib import get_close_matches
from functools import partial
from typing import Any

import torch

from torchrl_pomdp.checks import check_flag, check_text, shown
from torchrl_pomdp.problems.classic import crying_baby, tiger
from torchrl_pomdp.problems.maintenance import maintenance
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.problems.repair import REPAIR_PRESETS
from torchrl_pomdp.problems.rocksample import rocksample
from torchrl_pomdp.tensor_checks import check_device

__all__ = ["PRESETS", "fixed_options", "make_problem"]

PRESETS: dict[str, Callable[..., Problem]] = {
    **REPAIR_PRESETS,
    "tiger": tiger,
    "crying_baby": crying_baby,
    **{f"rocksample{n}x{k}": partial(rocksample, n=n, k=k) for n, k in ((7, 8), (11, 11), (15, 15))},
    **{f"maintenance{k}": partial(maintenance, k=k) for k in range(1, 6)},
}
"""The known problems: functions that make them from keyword arguments, ``name`` and ``device`` among them."""


def fixed_options(name: str) -> list[str]:
    """What the name of a preset says, and options therefore cannot.

    Examples:
        >>> fixed_options("maintenance3"), fixed_options("tiger")
        (['k'], [])
    """
    preset = PRESETS[name]
    return list(preset.keywords) if isinstance(preset, partial) else []


def make_problem(name: str, *, partitioned: bool = True, device: torch.device | str = "cpu", **options: Any) -> Problem:
    """Build a problem by name.

    Args:
        name: one of :data:`PRESETS`.

    Keyword Args:
        partitioned: whether the model has the problem's parts, or a single one, see :meth:`Problem.unpartitioned`.
        device: where the model computes.
        options: what else the problem's own function takes, but for what the name says.

    Raises:
        TypeError: if an argument is of the wrong kind, or the problem takes no such option.
        ValueError: if there is no such problem, the message lists the known ones, or no such device.

    Examples:
        >>> make_problem("linear20").model.describe()
        'line of 20, 1 robot: 1.9e+15 states, 3 controls, 5 observations, discount 0.99'
        >>> make_problem("grid5x4", partitioned=False).model.partition.num_parts
        1
    """
    check_text("name", name)
    check_flag("partitioned", partitioned)
    device = check_device("device", device)
    if name not in PRESETS:
        known, close = ", ".join(sorted(PRESETS)), get_close_matches(name, PRESETS, 1)
        hint = f"; do you mean {close[0]}?" if close else ""
        raise ValueError(f"name must be that of a problem: unknown preset {shown(name)}{hint}; known presets: {known}")
    if fixed := [option for option in fixed_options(name) if option in options]:
        raise TypeError(f"{name} takes no option {fixed[0]}, which its name says; got {shown(options[fixed[0]])}")
    problem = replace(PRESETS[name](name=name, device=device, **options), spec={"preset": name, **options})
    return problem if partitioned else problem.unpartitioned()
