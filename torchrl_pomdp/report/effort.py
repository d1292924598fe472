"""What training took: labels, belief steps and time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

from torchrl_pomdp.checks import check_mapping, check_sequence, shown

__all__ = ["Effort", "check_iterations", "effort", "effort_table"]

_NUMBERS = ("samples", "simulated_steps", "label_seconds", "train_seconds")


@dataclass(frozen=True)
class Effort:
    """What a training run took.

    Attributes:
        labels: labelled states.
        steps_per_label: belief steps behind a label of the last step of each iteration, that of the startgame; None where an
            iteration has one step alone.
        label_seconds: time of labelling.
        train_seconds: time of optimisation.
        parallel_seconds: both together, had every part a processor of its own: the longest part of every step counts.
    """

    labels: int
    steps_per_label: float | None
    label_seconds: float
    train_seconds: float
    parallel_seconds: float


def effort(iterations: Sequence[Mapping[str, Any]]) -> Effort:
    """The effort of a run from its iterations, as ``iterations.json`` has them.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if they are not what ``iterations.json`` has.

    Examples:
        >>> record = {"samples": 10, "simulated_steps": 400, "label_seconds": 2.0, "train_seconds": 1.0}
        >>> parts = {"iteration-1/1-improve-part-1": record, "iteration-1/2-improve-part-0": record}
        >>> effort([{"parts": parts}])
        Effort(labels=20, steps_per_label=40.0, label_seconds=4.0, train_seconds=2.0, parallel_seconds=6.0)
    """
    check_iterations("iterations", iterations)
    steps: dict[str, list[Mapping[str, Any]]] = {}
    last = []
    for iteration in iterations:
        for part, record in iteration["parts"].items():
            step = part.rsplit("-part-", 1)[0]
            steps.setdefault(step, []).append(record)
        last += steps[step]
    records = [record for found in steps.values() for record in found]
    return Effort(
        labels=sum(record["samples"] for record in records),
        steps_per_label=None
        if len(steps) == len(iterations)
        else sum(record["simulated_steps"] for record in last) / sum(record["samples"] for record in last),
        label_seconds=sum(record["label_seconds"] for record in records),
        train_seconds=sum(record["train_seconds"] for record in records),
        # The parts of a step do not wait for each other, steps do.
        parallel_seconds=sum(max(r["label_seconds"] + r["train_seconds"] for r in found) for found in steps.values()),
    )


def check_iterations(name: str, iterations: Any) -> None:
    """Raise unless these are iterations as a run's ``iterations.json`` has them."""
    for iteration in check_sequence(name, iterations, Mapping, least=1):
        parts = iteration.get("parts")
        records = list(parts.values()) if isinstance(parts, Mapping) else []
        if not records or not all(
            isinstance(r, Mapping) and all(isinstance(r.get(n), Real) for n in _NUMBERS) for r in records
        ):
            raise ValueError(f"{name} must be what a run's iterations.json holds, got {shown(iteration)} among them")


def effort_table(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Markdown table of what training took, for the iterations of runs by name.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if they are not what ``iterations.json`` has.

    Examples:
        >>> record = {"samples": 10, "simulated_steps": 400, "label_seconds": 2.0, "train_seconds": 1.0}
        >>> parts = {"iteration-1/1-improve-part-1": record, "iteration-1/2-improve-part-0": record}
        >>> print(effort_table({"line3": [{"parts": parts}]}))
        | run | labels | belief steps per startgame label | labelling | training | a processor for each part | speed-up |
        |---|---|---|---|---|---|---|
        | line3 | 20 | 40 | 4 s | 2 s | 6 s | 1.0 |
    """
    lines = [
        "| run | labels | belief steps per startgame label | labelling | training | a processor for each part | speed-up |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, iterations in check_mapping("runs", runs, Sequence).items():
        check_iterations(f"runs[{name!r}]", iterations)
        e = effort(iterations)
        speed_up = (e.label_seconds + e.train_seconds) / e.parallel_seconds
        steps = "" if e.steps_per_label is None else f"{e.steps_per_label:.0f}"
        lines.append(
            f"| {name} | {e.labels} | {steps} | {e.label_seconds:.0f} s | {e.train_seconds:.0f} s | "
            f"{e.parallel_seconds:.0f} s | {speed_up:.1f} |"
        )
    return "\n".join(lines)
