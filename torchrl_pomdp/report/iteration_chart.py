"""Cost against iteration as SVG text, for pages that need nothing else."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape

from torchrl_pomdp.evaluation import Estimate
from torchrl_pomdp.report.tables import half_width, interval_text

__all__ = ["iteration_chart"]

_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 480, 280, 82, 12, 14, 62

# Numbers of more digits before the point are written with an exponent.
_WRITTEN = 9


def iteration_chart(costs: Sequence[tuple[str, Estimate]], rejected: Mapping[str, str]) -> str:
    """An SVG of discounted costs with their 95 % intervals, from left to right; of those that were not accepted hollow.

    Args:
        costs: names and costs of policies, the base policy first.
        rejected: names of those that were not accepted, and why.

    Examples:
        >>> chart = iteration_chart([("greedy", Estimate(10.0, 0.5, 9)), ("API 1", Estimate(8.0, 0.5, 9))], {})
        >>> chart[:13], chart.count("<circle")
        ('<svg viewBox=', 2)
    """
    # A single start state has no interval.
    half = [0.0 if math.isnan(half_width(cost)) else half_width(cost) for _, cost in costs]
    low = min(cost.mean - each for (_, cost), each in zip(costs, half, strict=True))
    high = max(cost.mean + each for (_, cost), each in zip(costs, half, strict=True))
    ticks = _ticks(low, high)
    digits = _digits(ticks)
    low, high = min(low, ticks[0]), max(high, ticks[-1])

    def y(value: float) -> float:
        return _TOP + (_HEIGHT - _TOP - _BOTTOM) * (high - value) / (high - low)

    step = (_WIDTH - _LEFT - _RIGHT) / len(costs)
    marks = [
        f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y(tick):.1f}" y2="{y(tick):.1f}"/>'
        f'<text x="{_LEFT - 8}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:.{digits}g}</text>'
        for tick in ticks
    ]
    points = [(_LEFT + step * (number + 0.5), y(cost.mean)) for number, (_, cost) in enumerate(costs)]
    marks.append(f'<polyline class="line" points="{" ".join(f"{x:.1f},{height:.1f}" for x, height in points)}"/>')
    # Of iterations the numbers, which leave room for many.
    labels = [costs[0][0], *(name.rpartition(" ")[2] for name, _ in costs[1:])]
    for (name, cost), each, (x, height), label in zip(costs, half, points, labels, strict=True):
        top, bottom = y(cost.mean + each), y(cost.mean - each)
        hollow = ' class="hollow"' if name in rejected else ""
        about = f"{name}: {interval_text(cost)}" + (f", not accepted: {rejected[name]}" if name in rejected else "")
        whiskers = f"M{x:.1f} {top:.1f}V{bottom:.1f}M{x - 7:.1f} {top:.1f}h14M{x - 7:.1f} {bottom:.1f}h14"
        marks.append(
            f"<g><title>{escape(about)}</title>"
            f'<path class="whisker" d="{whiskers}"/><circle{hollow} cx="{x:.1f}" cy="{height:.1f}" r="6"/></g>'
            f'<text x="{x:.1f}" y="{_HEIGHT - _BOTTOM + 24}" text-anchor="middle">{escape(label)}</text>'
        )
    about = "Discounted cost of the base policy and of each iteration"
    across, down = (_LEFT + _WIDTH - _RIGHT) / 2, (_TOP + _HEIGHT - _BOTTOM) / 2
    marks += [
        f'<text x="{across}" y="{_HEIGHT - 10}" text-anchor="middle">base policy, then number of the iteration</text>',
        f'<text transform="translate(14 {down}) rotate(-90)" text-anchor="middle">discounted cost</text>',
    ]
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" class="chart" role="img" aria-label="{about}">{"".join(marks)}</svg>'


def _ticks(low: float, high: float) -> list[float]:
    """Four to nine round numbers around an interval."""
    # Costs that differ by rounding alone are one.
    span = high - low if high - low > 1e-9 * max(abs(low), abs(high)) else abs(high) or 1.0
    step = 10.0 ** math.floor(math.log10(span / 4))
    step *= next(factor for factor in (1, 2, 5, 10) if span / (step * factor) <= 6)
    first, last = math.floor(low / step), max(math.ceil(high / step), math.floor(low / step) + 1)
    return [number * step for number in range(first, last + 1)]


def _digits(ticks: Sequence[float]) -> int:
    """Digits that tell ticks apart, and write them out where that is not too long."""
    largest = math.floor(math.log10(max(abs(ticks[0]), abs(ticks[-1]))))
    apart = largest - math.floor(math.log10(ticks[1] - ticks[0])) + 1
    return max(6, apart, largest + 1 if largest < _WRITTEN else 0)
