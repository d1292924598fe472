"""Methods beside each other: what they cost, and what their decisions take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from torchrl_pomdp.checks import check_instance, check_mapping, check_number, check_sequence, check_text
from torchrl_pomdp.evaluation import Comparison
from torchrl_pomdp.pictures import COLOURS, new_figure
from torchrl_pomdp.report.tables import half_width, interval_text, ratio_texts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Outcome", "peer_figure", "peer_table"]


@dataclass(frozen=True)
class Outcome:
    """What a method costs, and what its decisions take.

    Attributes:
        comparison: its costs beside the baseline's.
        seconds: median time of a decision, of a single state on a single core.
        steps: belief steps that a decision simulates, on average.
        costs: its cost from each start state; those of two comparisons with the same seed are paired.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if ``seconds`` is not positive or ``steps`` negative.
    """

    comparison: Comparison
    seconds: float
    steps: float
    costs: tuple[float, ...]

    def __post_init__(self) -> None:
        check_instance("comparison", self.comparison, Comparison)
        check_number("seconds", self.seconds, "(0, inf)")
        check_number("steps", self.steps, "[0, inf)")
        for cost in check_sequence("costs", self.costs, float, least=1):
            check_number("costs", cost)

    def to_dict(self) -> dict[str, Any]:
        """All numbers, for JSON."""
        return asdict(self)


def peer_table(outcomes: Mapping[str, Outcome]) -> str:
    """Markdown table of methods by name.

    Raises:
        TypeError: if something is of the wrong kind.

    Examples:
        >>> import torch
        >>> from torchrl_pomdp.evaluation import compare
        >>> cost = torch.tensor([10.0, 20.0])
        >>> print(peer_table({"greedy": Outcome(compare(cost, cost), 0.0004, 0.0, (10.0, 20.0))}))
        | method | discounted cost | ratio | 95 % interval of the ratio | ms a decision | simulated steps a decision |
        |---|---|---|---|---|---|
        | greedy | 15.0 ± 9.8 | 1.000 | 1.000 … 1.000 | 0.4 | 0 |
    """
    lines = [
        "| method | discounted cost | ratio | 95 % interval of the ratio | ms a decision | simulated steps a decision |",
        "|---|---|---|---|---|---|",
    ]
    for name, outcome in check_mapping("outcomes", outcomes, Outcome).items():
        check_text("name in outcomes", name)
        ratio = " | ".join(ratio_texts(outcome.comparison.ratio))
        cost = interval_text(outcome.comparison.cost)
        lines.append(f"| {name} | {cost} | {ratio} | {1000 * outcome.seconds:.3g} | {outcome.steps:,.0f} |")
    return "\n".join(lines)


def peer_figure(outcomes: Mapping[str, Outcome], title: str = "") -> Figure:
    """Cost against the time of a decision, on a logarithmic axis: down and to the left is better.

    Costs are ratios to the baseline's where these mean something.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if there is nothing to draw.
        ImportError: if matplotlib, the extra ``plot``, is not installed.
    """
    found = check_mapping("outcomes", outcomes, Outcome)
    if not found:
        raise ValueError("outcomes is empty: there is nothing to draw")
    check_instance("title", title, str)
    ratios = all(outcome.comparison.ratio is not None for outcome in found.values())
    figure = new_figure(8.0, 4.8)
    axes = figure.add_subplot()
    for number, (name, outcome) in enumerate(found.items()):
        value = outcome.comparison.ratio if ratios else outcome.comparison.cost
        if value is not None:
            axes.errorbar(
                1000 * outcome.seconds,
                value.mean,
                yerr=half_width(value),
                marker="osD^v<>PX*"[number % 10],
                color=(colour := COLOURS[number % len(COLOURS)]),
                mfc=colour if number < 10 else "white",
                capsize=4,
                linestyle="none",
                label=name,
            )
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    if ratios and max(outcome.comparison.cost.mean for outcome in found.values()) > 0:
        # Ratios lie within a decade: plain numbers, also between its ends.
        axes.set_yscale("log", subs=[1.2, 1.5, 2, 3, 4, 5, 6, 7, 8, 9])
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
    axes.set(
        xlabel="time of a decision, ms", ylabel="cost, ratio to the baseline" if ratios else "discounted cost", title=title
    )
    axes.grid(alpha=0.3, which="both")
    figure.legend(loc="outside right upper", fontsize="small")
    return figure
