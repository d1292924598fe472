"""Timing, and the table that a benchmark fills."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch

from torchrl_pomdp.provenance import provenance


@dataclass
class Table:
    """Measured values, each with its unit and, where there is one, the target."""

    rows: list[dict] = field(default_factory=list)

    def add(self, name: str, value: float, unit: str = "ratio", target: str = "") -> None:
        self.rows.append({"name": name, "value": value, "unit": unit, "target": target})
        print(f"{name:78s} {value:12.4g} {unit:12s} {target}", flush=True)


def seconds(*functions: Callable[[], object], repeats: int = 3) -> list[float]:
    """Median time of a call of each function, after one call of each that is not counted.

    They are called in turn, so that what else the machine does meets them all alike.
    """
    times: list[list[float]] = [[] for _ in functions]
    for function in functions:
        function()
    for _ in range(repeats):
        for function, mine in zip(functions, times, strict=True):
            start = time.perf_counter()
            function()
            mine.append(time.perf_counter() - start)
    return [statistics.median(mine) for mine in times]


@contextmanager
def threads(count: int):
    """Let PyTorch use ``count`` threads inside."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def write(path: Path, results: dict[str, Table]) -> None:
    """Merge results into the JSON file ``path``, replaced as a whole."""
    content = json.loads(path.read_text()) if path.exists() else {}
    for name, table in results.items():
        content[name] = {"machine": provenance("numba"), "rows": asdict(table)["rows"]}
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(content, indent=1) + "\n")
    temporary.replace(path)
