r"""Plans of an iteration: which parts are trained on what, one step after the other (paper, Sections V and VI)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torchrl_pomdp.checks import check_instance, check_integer, check_sequence, shown
from torchrl_pomdp.modules import Truncation
from torchrl_pomdp.problems.problem import Problem

__all__ = ["Evaluate", "Improve", "Step", "checked_plan"]


@dataclass(frozen=True)
class _Step:
    parts: tuple[int, ...]
    truncation: Truncation | None = None

    def __post_init__(self) -> None:
        if isinstance(self.parts, str) or not isinstance(self.parts, Sequence):
            raise TypeError(f"parts must be a sequence of numbers of parts, got {shown(self.parts)}")
        parts = tuple(check_integer("parts", part, 0) for part in self.parts)
        if not parts or len(set(parts)) < len(parts):
            raise ValueError(f"parts must hold at least one part, and each once, got {parts}")
        object.__setattr__(self, "parts", parts)
        if self.truncation is not None:
            check_instance("truncation", self.truncation, Truncation)


class Improve(_Step):
    """Step of a plan: teach the policy networks of some parts the rollout control of the current policy.

    Attributes:
        parts: the parts, which are trained independently of each other.
        truncation: rule that cuts the simulations; the current values are the terminal cost. None: no truncation.
    """


class Evaluate(_Step):
    """Step of a plan: teach the value networks of some parts the cost of the current (global) policy.

    Attributes:
        parts: the parts, which are trained independently of each other.
        truncation: as for :class:`Improve`.
    """


Step = Improve | Evaluate


def checked_plan(plan: Sequence[Step], problem: Problem) -> tuple[Step, ...]:
    """The plan, if its steps are for parts of the problem's partition."""
    steps = tuple(check_sequence("plan", plan, _Step))
    if not steps:
        raise ValueError("plan is empty: an iteration needs at least one step")
    for step in steps:
        for part in step.parts:
            check_integer("parts of the plan", part, 0, problem.partition.num_parts - 1)
        if step.truncation is not None:
            step.truncation.check_model(problem.model)
    return steps
