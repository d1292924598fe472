"""What training took: labels, belief steps and time."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, NamedTuple, cast

from torchrl_pomdp.checks import check_mapping, check_sequence, shown

__all__ = ["Effort", "check_iterations", "effort", "effort_table"]

# Iteration or version, step of the plan, and part.
_NAME = re.compile(r"iteration-(\d+)/(\d+)-[a-z]+-part-(\d+)")
_NUMBERS = ("samples", "simulated_steps", "label_seconds", "train_seconds")


@dataclass(frozen=True)
class Effort:
    """What a training run took.

    Attributes:
        labels: labelled states.
        steps_per_label: belief steps behind a label of the last step of an iteration, that of the startgame; None where
            iterations have one step alone.
        label_seconds: time of labelling.
        train_seconds: time of optimisation.
        parallel_seconds: both together, had every part a processor of its own: the longest part of every step counts. Parts
            at their own pace wait for those alone that are more versions behind than they may be.
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
    records = [(_place(name), record) for iteration in iterations for name, record in iteration["parts"].items()]
    first, last = (choose(place.step for place, _ in records) for choose in (min, max))
    startgame = [record for place, record in records if place.step == last]
    label, train = (sum(record[key] for _, record in records) for key in ("label_seconds", "train_seconds"))
    return Effort(
        labels=sum(record["samples"] for _, record in records),
        steps_per_label=None
        if first == last
        else sum(record["simulated_steps"] for record in startgame) / sum(record["samples"] for record in startgame),
        label_seconds=label,
        train_seconds=train,
        parallel_seconds=_parallel_seconds(records, iterations[0].get("staleness")),
    )


class _Place(NamedTuple):
    """What a record is of."""

    number: int
    step: int
    part: int


def _place(name: str) -> _Place:
    found = cast(re.Match[str], _NAME.fullmatch(name))
    return _Place(*map(int, found.groups()))


def _parallel_seconds(records: Sequence[tuple[_Place, Mapping[str, Any]]], staleness: int | None) -> float:
    """The time that the parts take side by side."""
    seconds: Counter[tuple[tuple[int, int], int]] = Counter()
    for place, record in records:
        # Parts wait for each other after every step or, at their own pace, take the steps of a version one after the other.
        turn = (place.number, place.step if staleness is None else 0)
        seconds[turn, place.part] += record["label_seconds"] + record["train_seconds"]
    parts = {part for _, part in seconds}
    done: list[dict[int, float]] = []
    for turn in sorted({turn for turn, _ in seconds}):
        behind = len(done) - 1 - (staleness or 0)
        begin = max(done[behind].values()) if behind >= 0 else 0.0
        own = done[-1] if done else dict.fromkeys(parts, 0.0)
        done.append({part: max(begin, own[part]) + seconds[turn, part] for part in parts})
    return max(done[-1].values())


def check_iterations(name: str, iterations: Any) -> None:
    """Raise unless these are iterations as a run's ``iterations.json`` has them."""
    for iteration in check_sequence(name, iterations, Mapping, least=1):
        parts, staleness = iteration.get("parts"), iteration.get("staleness")
        records = parts if isinstance(parts, Mapping) else {}
        sound = all(
            isinstance(key, str) and _NAME.fullmatch(key) and isinstance(r, Mapping)
            and all(isinstance(r.get(n), Real) for n in _NUMBERS)
            for key, r in records.items()
        )  # fmt: skip
        if not records or not sound or not (staleness is None or (type(staleness) is int and staleness >= 0)):
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
