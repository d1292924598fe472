"""Tables and pictures of results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.envs.repair import REPAIR, RepairModel
from torchrl_pomdp.evaluation import Comparison, Estimate, compare

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Effort",
    "Result",
    "cost_figure",
    "effort",
    "effort_table",
    "interval_text",
    "is_iteration",
    "iteration_figure",
    "paired_ratios",
    "paired_table",
    "table",
    "time_figure",
    "trajectory_figure",
]


@dataclass(frozen=True)
class Result:
    """A policy's name and its comparison with the baseline."""

    name: str
    comparison: Comparison


def table(results: Sequence[Result]) -> str:
    """Markdown table of costs, paired differences and ratios, each with its 95 % interval.

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
    for result in results:
        c = result.comparison
        low, high = c.ratio.interval
        lines.append(
            f"| {result.name} | {interval_text(c.cost)} | {c.difference.mean:+.1f} ± "
            f"{_half(c.difference):.1f} | {c.ratio.mean:.3f} | {low:.3f} … {high:.3f} |"
        )
    return "\n".join(lines)


def interval_text(value: Estimate) -> str:
    """Mean and half width of the 95 % interval.

    Examples:
        >>> interval_text(Estimate(mean=15.0, standard_error=5.0, count=2))
        '15.0 ± 9.8'
    """
    return f"{value.mean:.1f} ± {_half(value):.1f}"


def cost_figure(results: Sequence[Result], title: str = "") -> Figure:
    """Bars of discounted cost with 95 % intervals.

    Raises:
        ImportError: if matplotlib, the extra ``plot``, is not installed.
    """
    figure = _new_figure(1.4 * len(results) + 1.6, 3.6)
    axes = figure.add_subplot()
    means = [result.comparison.cost.mean for result in results]
    names = [f"{result.name}\n{result.comparison.ratio.mean:.3f}" for result in results]
    errors = [_half(result.comparison.cost) for result in results]
    axes.bar(names, means, yerr=errors, capsize=5, color=["#9aa5b1"] + ["#3572a5"] * (len(results) - 1))
    axes.set_ylabel("discounted cost")
    axes.set_title(title)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def iteration_figure(lines: Mapping[str, Sequence[Comparison]]) -> Figure:
    """Ratio to greedy against iteration, one line for each run; iteration 0 is the base policy.

    Args:
        lines: comparisons of base policy, first iteration, second iteration, ... by run.

    Raises:
        ImportError: if matplotlib, the extra ``plot``, is not installed.
    """
    figure = _new_figure(6.0, 3.8)
    axes = figure.add_subplot()
    for number, (name, comparisons) in enumerate(lines.items()):
        ratios = [comparison.ratio for comparison in comparisons]
        # A little apart, so that intervals do not hide each other.
        x = [i + 0.04 * number for i in range(len(ratios))]
        axes.errorbar(x, [r.mean for r in ratios], yerr=[_half(r) for r in ratios], capsize=4, marker="o", label=name)
    axes.set(xlabel="iteration", ylabel="cost, ratio to greedy")
    axes.locator_params(axis="x", integer=True)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    return figure


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

    Examples:
        >>> record = {"samples": 10, "simulated_steps": 400, "label_seconds": 2.0, "train_seconds": 1.0}
        >>> parts = {"iteration-1/1-improve-part-1": record, "iteration-1/2-improve-part-0": record}
        >>> effort([{"parts": parts}])
        Effort(labels=20, steps_per_label=40.0, label_seconds=4.0, train_seconds=2.0, parallel_seconds=6.0)
    """
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


def is_iteration(policy: str) -> bool:
    """Whether a policy's name is that of what an iteration has trained.

    Examples:
        >>> is_iteration("pAPI-NT 2"), is_iteration("pAPI-NT 2 + R-NT"), is_iteration("greedy")
        (True, False, False)
    """
    return policy.rpartition(" ")[2].isdigit()


def paired_ratios(costs: dict[str, Tensor]) -> dict[str, dict[str, Estimate]]:
    """Ratios of what was trained, and of online rollout on top of it, to online rollout of the base policy and to each other.

    Args:
        costs: costs from the same start states under the same noise, by policy.

    Returns:
        the ratios by policy and by the policy that it is divided by.

    Examples:
        >>> cost = torch.tensor([10.0, 20.0])
        >>> found = paired_ratios({"R-NT of greedy": cost, "API 1": 0.5 * cost, "API 1 + R-NT": 0.4 * cost})
        >>> {name: {other: round(ratio.mean, 2) for other, ratio in row.items()} for name, row in found.items()}
        {'API 1': {'R-NT of greedy': 0.5}, 'API 1 + R-NT': {'R-NT of greedy': 0.4, 'API 1': 0.8}}
    """
    trained = [name for name in costs if is_iteration(name)]
    rollout = [name for name in costs if name.startswith(("R-NT of", "R-T of"))]
    rows = [name for name in costs if name in trained or name.endswith("+ R-NT") or name.startswith("R-T of")]
    ratios: dict[str, dict[str, Estimate]] = {}
    for name in rows:
        ratios[name] = {}
        for other in (*rollout, *trained):
            if name != other:
                count = min(costs[name].numel(), costs[other].numel())
                ratios[name][other] = compare(costs[name][:count], costs[other][:count]).ratio
    return ratios


def paired_table(problem: str, ratios: dict[str, dict[str, Estimate]]) -> str:
    """Markdown table of :func:`paired_ratios` to online rollout and to each algorithm's last iteration.

    Examples:
        >>> ratio = Estimate(mean=0.5, standard_error=0.0, count=2)
        >>> print(paired_table("line3", {"API 1": {"R-NT of greedy": ratio, "API 2": ratio}, "API 2": {"API 1": ratio}}))
        | line3: ratio to | R-NT of greedy | API 2 |
        |---|---|---|
        | API 1 | 0.5000 (0.5000 … 0.5000) | 0.5000 (0.5000 … 0.5000) |
        | API 2 |  |  |
    """
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


def _ratio_text(ratio: Estimate) -> str:
    low, high = ratio.interval
    return f"{ratio.mean:.4f} ({low:.4f} … {high:.4f})"


def effort_table(runs: dict[str, list[dict[str, Any]]]) -> str:
    """Markdown table of what training took, for the iterations of runs by name.

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
    for name, iterations in runs.items():
        e = effort(iterations)
        speed_up = (e.label_seconds + e.train_seconds) / e.parallel_seconds
        steps = "" if e.steps_per_label is None else f"{e.steps_per_label:.0f}"
        lines.append(
            f"| {name} | {e.labels} | {steps} | {e.label_seconds:.0f} s | {e.train_seconds:.0f} s | "
            f"{e.parallel_seconds:.0f} s | {speed_up:.1f} |"
        )
    return "\n".join(lines)


def time_figure(runs: dict[str, list[dict[str, Any]]]) -> Figure:
    """Time of labelling and training by part, stacked; beside it what it would be with one processor for each part.

    Args:
        runs: iterations of every run, as a run's ``iterations.json`` has them.

    Raises:
        ImportError: if matplotlib, the extra ``plot``, is not installed.
    """
    figure = _new_figure(2.2 * len(runs) + 3.0, 4.0)
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


def trajectory_figure(model: RepairModel, trajectory: TensorDictBase, title: str = "") -> Figure:
    """One trajectory: locations by time, colour the expected damage, robots' paths over it, repairs marked.

    Args:
        model: the repair model.
        trajectory: ``[T]`` with ``belief``, ``location`` and ``action``, as ``BeliefEnv.rollout`` gives it.
        title: title of the figure.

    Raises:
        ImportError: if matplotlib, the extra ``plot``, is not installed.
    """
    steps = trajectory.batch_size[0]
    damage = trajectory["belief"] @ torch.arange(model.num_levels, dtype=model.dtype, device=model.device)
    figure = _new_figure(max(5.0, 0.14 * steps + 2.5), max(2.5, 0.16 * model.num_locations + 1.2))
    axes = figure.add_subplot()
    image = axes.imshow(
        damage.T.cpu().numpy(), aspect="auto", cmap="YlOrRd", vmin=0, vmax=model.num_levels - 1, interpolation="nearest"
    )
    figure.colorbar(image, ax=axes, label="expected damage level")
    controls = model.split_controls(trajectory["action"])
    for robot in range(model.num_robots):
        path = trajectory["location"][:, robot].cpu().numpy()
        axes.plot(range(steps), path, color="#1f4e79", linewidth=1.2, label=f"robot {robot + 1}")
        repairs = (controls[:, robot] == REPAIR).nonzero().squeeze(-1).cpu().numpy()
        axes.scatter(repairs, path[repairs], marker="P", s=44, color="#1f4e79", edgecolor="white", linewidth=0.6)
    axes.scatter([], [], marker="P", color="#1f4e79", label="repair")
    axes.legend(loc="upper right", fontsize="small")
    axes.set(xlabel="stage", ylabel="location", title=title)
    axes.locator_params(integer=True)
    return figure


def _half(value: Estimate) -> float:
    return (value.interval[1] - value.interval[0]) / 2


def _new_figure(width: float, height: float) -> Figure:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("pictures need matplotlib: pip install 'torchrl-pomdp[plot]'") from error
    return Figure(figsize=(width, height), layout="constrained", dpi=120)
