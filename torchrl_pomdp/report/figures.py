"""Pictures of results; matplotlib, the extra ``plot``, is imported when one is drawn."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_pomdp.checks import check_callable, check_instance, check_mapping, check_sequence
from torchrl_pomdp.evaluation import Comparison, Estimate
from torchrl_pomdp.files import write_bytes
from torchrl_pomdp.pictures import COLOURS, new_figure
from torchrl_pomdp.report.effort import check_iterations, effort
from torchrl_pomdp.report.tables import Result, half_width, ratio_texts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["cost_figure", "draw", "iteration_figure", "time_figure"]


def draw(figures: Mapping[Path, Callable[[], Figure]]) -> str:
    """Draw figures and write them to files.

    Args:
        figures: what makes the figure of each file.

    Returns:
        a line that says where they are, or why there are none: results are not lost for want of a picture.

    Raises:
        TypeError: if something is of the wrong kind.
    """
    for path, make in check_instance("figures", figures, Mapping).items():
        check_instance("key of figures", path, Path)
        check_callable(f"figures[{str(path)!r}]", make)
    try:
        for path, make in figures.items():
            content = io.BytesIO()
            make().savefig(content, format="png")
            write_bytes(path, content.getvalue())
    except Exception as error:  # whatever the drawing, its fonts or the disk may raise
        return f"no pictures: {' '.join(str(error).split()) or type(error).__name__}"
    return f"pictures: {', '.join(map(str, figures))}"


def cost_figure(results: Sequence[Result], title: str = "") -> Figure:
    """Bars of discounted cost with 95 % intervals; below each its ratio to the baseline, or its difference where there is none.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if there is nothing to draw.
        ImportError: if matplotlib, the extra ``plot``, is not installed.
    """
    check_sequence("results", results, Result, least=1)
    check_instance("title", title, str)
    figure = new_figure(1.4 * len(results) + 1.6, 3.6)
    axes = figure.add_subplot()
    means = [result.comparison.cost.mean for result in results]
    most = max(result.comparison.cost.count for result in results)
    names = [f"{result.name}\n{_beside(result.comparison)}{_fewer(result.comparison, most)}" for result in results]
    errors = [half_width(result.comparison.cost) for result in results]
    bars = axes.bar(names, means, yerr=errors, capsize=5, color=["#9aa5b1"] + ["#3572a5"] * (len(results) - 1))
    for bar, result in zip(bars, results, strict=True):
        if _fewer(result.comparison, most):
            # Its height is not to be compared with the others'.
            bar.set(hatch="//", edgecolor="white")
    axes.set_ylabel("discounted cost")
    # The baseline's own ratio is missing where all are.
    beside = "difference from" if results[0].comparison.ratio is None else "ratio to"
    axes.set_xlabel(f"below each name: {beside} {results[0].name}")
    axes.set_title(title)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _beside(comparison: Comparison) -> str:
    """A policy against the baseline, in a word."""
    return f"{comparison.difference.mean:+.3g}" if comparison.ratio is None else ratio_texts(comparison.ratio)[0]


def _fewer(comparison: Comparison, most: int) -> str:
    """How many start states a policy was evaluated from, where these are fewer than others'."""
    return f"\nfrom {comparison.cost.count} states" if comparison.cost.count < most else ""


def iteration_figure(lines: Mapping[str, Sequence[Comparison]]) -> Figure:
    """Ratio to greedy against iteration, one line for each run; iteration 0 is the base policy.

    Args:
        lines: comparisons of base policy, first iteration, second iteration, ... by run.

    Raises:
        TypeError: if something is of the wrong kind.
        ImportError: if matplotlib, the extra ``plot``, is not installed.
    """
    for name, comparisons in check_mapping("lines", lines, Sequence).items():
        check_sequence(f"lines[{name!r}]", comparisons, Comparison)
    figure = new_figure(6.0, 3.8)
    axes = figure.add_subplot()
    axes.set_prop_cycle(color=COLOURS)
    for number, (name, comparisons) in enumerate(lines.items()):
        # Where a ratio means nothing there is a gap.
        ratios = [comparison.ratio or Estimate(math.nan, math.nan, 0) for comparison in comparisons]
        # A little apart, so that intervals do not hide each other.
        x = [i + 0.04 * number for i in range(len(ratios))]
        axes.errorbar(x, [r.mean for r in ratios], yerr=[half_width(r) for r in ratios], capsize=4, marker="o", label=name)
    axes.set(xlabel="iteration", ylabel="cost, ratio to greedy")
    axes.locator_params(axis="x", integer=True)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    return figure


def time_figure(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """Time of labelling and training by part, stacked; beside it what it would be with one processor for each part.

    Args:
        runs: iterations of every run, as a run's ``iterations.json`` has them.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if they are not what ``iterations.json`` has.
        ImportError: if matplotlib, the extra ``plot``, is not installed.
    """
    for name, iterations in check_mapping("runs", runs, Sequence).items():
        check_iterations(f"runs[{name!r}]", iterations)
    figure = new_figure(2.2 * len(runs) + 3.0, 4.0)
    axes = figure.add_subplot()
    ticks, labels = [], []
    for number, (name, iterations) in enumerate(runs.items()):
        bottom = 0.0
        for iteration in iterations:
            for record in iteration["parts"].values():
                for kind, colour in (("label_seconds", "#3572a5"), ("train_seconds", "#e8a33d")):
                    axes.bar(number, record[kind], 0.36, bottom=bottom, color=colour, edgecolor="white", linewidth=0.4)
                    bottom += record[kind]
        axes.bar(number + 0.4, effort(iterations).parallel_seconds, 0.36, color="#9aa5b1")
        ticks.append(number + 0.2)
        labels.append(name)
    for colour, label in (("#3572a5", "labelling"), ("#e8a33d", "training"), ("#9aa5b1", "one processor for each part")):
        axes.bar(0, 0, color=colour, label=label)
    axes.set_xticks(ticks, labels, fontsize="small")
    axes.set_ylabel("seconds")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=3, fontsize="small")
    return figure
