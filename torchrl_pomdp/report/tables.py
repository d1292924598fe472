"""Tables of costs, paired differences and ratios, each with its 95 % interval."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from torchrl_pomdp.checks import check_instance, check_integer, check_mapping, check_sequence, check_text
from torchrl_pomdp.evaluation import Comparison, Estimate, compare
from torchrl_pomdp.report.names import is_iteration, is_on_top, is_online
from torchrl_pomdp.tensor_checks import check_tensor

__all__ = ["Result", "half_width", "interval_text", "paired_ratios", "paired_table", "ratio_texts", "table"]

_MOST_DECIMALS = 20


@dataclass(frozen=True)
class Result:
    """A policy's name and its comparison with the baseline.

    Raises:
        TypeError: if ``name`` is no text or ``comparison`` no comparison.
        ValueError: if ``name`` is empty or not printable.
    """

    name: str
    comparison: Comparison

    def __post_init__(self) -> None:
        check_text("name", self.name)
        check_instance("comparison", self.comparison, Comparison)


def table(results: Sequence[Result]) -> str:
    """Markdown table of costs, paired differences and ratios, each with its 95 % interval.

    Costs of fewer start states than those of others, which must not be compared with these, say how many they are.

    Raises:
        TypeError: if something is of the wrong kind.

    Examples:
        >>> import torch
        >>> from torchrl_pomdp.evaluation import compare
        >>> cost = torch.tensor([10.0, 20.0])
        >>> print(table([Result("greedy", compare(cost, cost))]))
        | policy | discounted cost | difference | ratio | 95 % interval of the ratio |
        |---|---|---|---|---|
        | greedy | 15.0 ± 9.8 | +0.0 ± 0.0 | 1.000 | 1.000 … 1.000 |
    """
    lines = [
        "| policy | discounted cost | difference | ratio | 95 % interval of the ratio |",
        "|---|---|---|---|---|",
    ]
    most = max((result.comparison.cost.count for result in check_sequence("results", results, Result)), default=0)
    for result in results:
        c = result.comparison
        few = f" ({c.cost.count} start states)" if c.cost.count < most else ""
        digits = _decimals(c.difference, _decimals(c.cost))
        lines.append(
            f"| {result.name}{few} | {interval_text(c.cost)} | {c.difference.mean:+.{digits}f} ± "
            f"{half_width(c.difference):.{digits}f} | "
            f"{' | '.join(ratio_texts(c.ratio))} |"
        )
    return "\n".join(lines)


def ratio_texts(ratio: Estimate | None, digits: int = 3) -> tuple[str, str]:
    """A ratio and its 95 % interval; dashes where a ratio means nothing.

    Raises:
        TypeError: if something is of the wrong kind.

    Examples:
        >>> ratio_texts(Estimate(mean=0.9, standard_error=0.0, count=2)), ratio_texts(None)
        (('0.900', '0.900 … 0.900'), ('–', '–'))
    """
    check_integer("digits", digits, 0, 100)
    if ratio is None:
        return "–", "–"
    check_instance("ratio", ratio, Estimate)
    low, high = ratio.interval
    return f"{ratio.mean:.{digits}f}", f"{low:.{digits}f} … {high:.{digits}f}"


def interval_text(value: Estimate) -> str:
    """Mean and half width of the 95 % interval.

    Raises:
        TypeError: if something is of the wrong kind.

    Examples:
        >>> interval_text(Estimate(mean=15.0, standard_error=5.0, count=2))
        '15.0 ± 9.8'
        >>> interval_text(Estimate(mean=-21.47, standard_error=0.06, count=1000))
        '-21.47 ± 0.12'
        >>> interval_text(Estimate(mean=0.00431, standard_error=0.0001, count=100))
        '0.00431 ± 0.00020'
    """
    digits = _decimals(check_instance("value", value, Estimate))
    return f"{value.mean:.{digits}f} ± {half_width(value):.{digits}f}"


def _decimals(value: Estimate, least: int | None = None) -> int:
    """Decimals that tell a mean from what it may also be: two digits of its half width, or three of a mean without one."""
    half = half_width(value)
    size = half or abs(value.mean) / 10
    least = (2 if half < 1 else 1) if least is None else least
    return max(least, min(_MOST_DECIMALS, 1 - math.floor(math.log10(size)))) if 0 < size < math.inf else least


def paired_ratios(costs: Mapping[str, Tensor]) -> dict[str, dict[str, Estimate | None]]:
    """Ratios of what was trained, and of online rollout on top of it, to online rollout of the base policy and to each other.

    Of several online rollouts of the base policy the later ones have ratios as well.

    Args:
        costs: costs from the same start states under the same noise, by policy, each named as a training run names it.

    Returns:
        the ratios by policy and by the policy that it is divided by; None where a ratio means nothing.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if costs are no finite numbers of start states.

    Examples:
        >>> import torch
        >>> cost = torch.tensor([10.0, 20.0])
        >>> found = paired_ratios({"R-NT of greedy": cost, "API 1": 0.5 * cost, "API 1 + R-NT": 0.4 * cost})
        >>> {name: {other: round(ratio.mean, 2) for other, ratio in row.items()} for name, row in found.items()}
        {'API 1': {'R-NT of greedy': 0.5}, 'API 1 + R-NT': {'R-NT of greedy': 0.4, 'API 1': 0.8}}
    """
    check_mapping("costs", costs, Tensor)
    for name, values in costs.items():
        check_tensor(f"costs[{name!r}]", values, (None,))
    trained = [name for name in costs if is_iteration(name)]
    rollout = [name for name in costs if is_online(name)]
    rows = [name for name in costs if name in trained or name in rollout[1:] or is_on_top(name)]
    ratios: dict[str, dict[str, Estimate | None]] = {}
    for name in rows:
        ratios[name] = {}
        for other in (*rollout, *trained):
            if name != other:
                count = min(costs[name].numel(), costs[other].numel())
                ratios[name][other] = compare(costs[name][:count], costs[other][:count]).ratio
    return ratios


def paired_table(problem: str, ratios: Mapping[str, Mapping[str, Estimate | None]]) -> str:
    """Markdown table of :func:`paired_ratios` to online rollout and to each algorithm's last iteration.

    Raises:
        TypeError: if something is of the wrong kind.

    Examples:
        >>> ratio = Estimate(mean=0.5, standard_error=0.0, count=2)
        >>> print(paired_table("line3", {"API 1": {"R-NT of greedy": ratio, "API 2": ratio}, "API 2": {"API 1": ratio}}))
        | line3: ratio to | R-NT of greedy | API 2 |
        |---|---|---|
        | API 1 | 0.5000 (0.5000 … 0.5000) | 0.5000 (0.5000 … 0.5000) |
        | API 2 |  |  |
    """
    check_text("problem", problem)
    for name, row in check_mapping("ratios", ratios, Mapping).items():
        check_mapping(f"ratios[{name!r}]", row, (Estimate, type(None)))
    columns = {other: None for row in ratios.values() for other in row}
    rollout = [name for name in columns if not is_iteration(name)]
    # Rows are in the order of the iterations.
    last = {name.rpartition(" ")[0]: name for name in ratios if name in columns and name not in rollout}
    shown = [*rollout, *last.values()]
    lines = [f"| {problem}: ratio to | {' | '.join(shown)} |", f"|---|{'---|' * len(shown)}"]
    for name, row in ratios.items():
        cells = [_ratio_text(row[other]) if other in row else "" for other in shown]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _ratio_text(ratio: Estimate | None) -> str:
    mean, interval = ratio_texts(ratio, 4)
    return mean if ratio is None else f"{mean} ({interval})"


def half_width(value: Estimate) -> float:
    """Half the width of the 95 % interval."""
    return (value.interval[1] - value.interval[0]) / 2
