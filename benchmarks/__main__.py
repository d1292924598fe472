"""``python -m benchmarks [NAME…]``: run benchmarks, print tables, write ``benchmarks/results.json`` and the pictures."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from benchmarks import decisions, engine, online, robots, rocksample, scaling, searches, tabular, where
from benchmarks.harness import Table, write

FOLDER = Path(__file__).parent
BENCHMARKS = {
    function.__name__: function
    for function in (
        engine.trajectories, engine.looks, engine.batch, engine.network, engine.router, engine.locations, engine.memory,
        engine.env_step, tabular.updates, decisions.decision, decisions.labels, decisions.adaptive, decisions.expectation,
        online.online, searches.searches, robots.robots, scaling.scaling, scaling.disk,
        where.profile, rocksample.rocksample_updates, rocksample.rocksample_rewards,
    )
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"default: all of {', '.join(BENCHMARKS)}")
    names = parser.parse_args().names or list(BENCHMARKS)
    unknown = [name for name in names if name not in BENCHMARKS]
    if unknown:
        parser.error(f"unknown benchmark {unknown[0]!r}; known: {', '.join(BENCHMARKS)}")
    for name in names:
        print(f"\n{name}: {BENCHMARKS[name].__doc__}")
        table = Table()
        BENCHMARKS[name](table)
        write(FOLDER / "results.json", {name: table})
    _draw(json.loads((FOLDER / "results.json").read_text()))


def _draw(results: dict) -> None:
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    def points(name: str, unit: str) -> tuple[list[int], list[float]]:
        rows = [row for row in results[name]["rows"] if row["unit"] == unit]
        return [int(next(word for word in row["name"].split() if word.isdigit())) for row in rows], [r["value"] for r in rows]

    for name, unit, labels in (
        ("batch", "M steps/s", ("rows at once", "million belief steps per second")),
        ("locations", "ns", ("locations L", "ns per belief step")),
    ):
        if name in results:
            figure = Figure(figsize=(5, 3.4), layout="constrained", dpi=120)
            axes = figure.add_subplot()
            x, values = points(name, unit)
            axes.loglog(x, values, "o-", color="#3572a5")
            axes.set(xlabel=labels[0], ylabel=labels[1], title="greedy rollout, one core")
            if name == "locations":
                axes.loglog(x, [values[0] * size / x[0] for size in x], "--", color="#9aa5b1", label="linear")
                axes.legend()
            axes.set_xticks(x, [f"{size:,}" for size in x], rotation=30)
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.yaxis.set_major_formatter("{x:,g}")
            axes.minorticks_off()
            axes.grid(alpha=0.3)
            figure.savefig(FOLDER / f"{name}.png")


if __name__ == "__main__":
    main()
