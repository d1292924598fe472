"""The paper's experiments (Section VI-D) as training runs, with tables and figures beside the published numbers."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor
from tqdm import tqdm

from torchrl_pomdp.checks import (
    check_callable,
    check_choice,
    check_flag,
    check_instance,
    check_integer,
    check_number,
    check_sequence,
    check_text,
)
from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.evaluation import Comparison, Estimate
from torchrl_pomdp.files import check_folder, write_bytes, write_json
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.problems.repair import REPAIR_PRESETS
from torchrl_pomdp.progress import progress_bar
from torchrl_pomdp.provenance import known_provenance
from torchrl_pomdp.report import (
    Result,
    cost_figure,
    draw,
    effort_table,
    interval_text,
    is_iteration,
    iteration_figure,
    paired_ratios,
    paired_table,
    ratio_texts,
    time_figure,
)
from torchrl_pomdp.tensor_checks import check_device
from torchrl_pomdp.trainers.run import ALGORITHMS, TrainingRun

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["EXPERIMENTS", "OPTIMA", "PUBLISHED", "Experiment", "plan", "reproduce", "settings_config"]

PUBLISHED = {
    ("grid5x4", "greedy"): 5476.79,
    ("grid5x4", "pAPI-NT 1"): 5255.64,
    ("grid5x4", "pAPI-NT 2"): 4952.26,
    ("grid6x6", "greedy"): 18799.5,
    ("grid6x6", "pAPI-NT 1"): 18037.1,
    ("grid6x6", "pAPI-NT 2"): 17341.9,
    ("two_robots20", "greedy"): 4142.84,
    ("two_robots20", "pAPI-NT 1"): 3321.95,
    ("two_robots20", "pAPI-NT 2"): 3133.08,
    **{
        (f"network32x{robots}", policy): float(cost)
        for robots, costs in {
            4: {"greedy": 3277, "one-at-a-time of greedy": 1926, "order-optimised of greedy": 1893, "R-NT of greedy": 1880},
            8: {"greedy": 5347, "one-at-a-time of greedy": 992, "API 1": 2329, "API 2": 1266, "API 3": 1162, "API 4": 1206},
            10: {"greedy": 4667, "one-at-a-time of greedy": 799, "API 1": 1878, "API 2": 1311, "API 3": 1240, "API 4": 1293},
        }.items()
        for policy, cost in costs.items()
    },
}
"""Costs of the paper's Table I by problem and policy; for the network of 32 those of arXiv:2011.04222, whose start states are
other ones."""

OPTIMA = {"line3": 168.97}
"""Optimal costs of problems that are small enough to be solved, to two decimals (by a point-based solver)."""

# Labelled states of each part in the paper.
_SAMPLES = {"linear20": 200_000, "line3": 200_000, "linear20_slow_repair": 200_000, "linear20_uneven": 200_000}
# Stages of a label's trajectories where there are many robots; 10 in their paper. Discounted by 0.95 fewer will do; where
# repaired locations stay intact, as many as it takes to get to the damage.
_MANY_ROBOTS = {"network32x4": 25, "network32x8": 5, "network32x10": 5}
_MORE_SAMPLES = 500_000
# Trajectories of a label and online where a repair takes a random time: with fewer, rollout is worse than its base policy.
_LABEL_TRAJECTORIES, _ONLINE_TRAJECTORIES = {"linear20_slow_repair": 20}, {"linear20_slow_repair": 40}


@dataclass(frozen=True)
class Experiment:
    """Problems and algorithms that are set beside each other.

    Attributes:
        name: what the command calls it.
        problems: names of the problems.
        algorithms: names of the algorithms that learn.
        states: start states of each evaluation.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if a problem or an algorithm is unknown, or ``states`` is not positive.
    """

    name: str
    problems: tuple[str, ...]
    algorithms: tuple[Literal["pAPI-NT", "pAPI-T", "API"], ...]
    states: int = 1000

    def __post_init__(self) -> None:
        check_text("name", self.name)
        for problem in check_sequence("problems", self.problems, str, least=1):
            check_choice("problems", problem, sorted(REPAIR_PRESETS))
        for algorithm in check_sequence("algorithms", self.algorithms, str, least=1):
            check_choice("algorithms", algorithm, ALGORITHMS)
        check_integer("states", self.states, 1, 10**9)


EXPERIMENTS = {
    experiment.name: experiment
    for experiment in (
        Experiment("table1", ("grid5x4", "grid6x6", "two_robots20"), ("pAPI-NT",)),
        Experiment("architectures", ("linear20",), ("API", "pAPI-NT", "pAPI-T")),
        Experiment("ablation", ("linear20",), ("pAPI-NT", "pAPI-T")),
        # Differences from the optimum are small, and so is the problem.
        Experiment("optimum", ("line3",), ("pAPI-NT",), states=100_000),
        Experiment("multirobot", ("network32x4", "network32x8", "network32x10"), ("API",)),
        Experiment("extensions", ("grid6x6_obstacles", "linear20_slow_repair", "linear20_uneven"), ("pAPI-NT",)),
    )
}
"""The experiments by name."""


def settings_config(settings: Literal["paper", "tuned"], problem: str, scale: float, seed: int) -> PolicyIterationConfig:
    """The numbers of a policy iteration at a fraction of the paper's samples.

    Args:
        settings: ``"paper"``: two iterations, 10 trajectories, flattened beliefs, squared error, no exploration, no mirror
            images. The paper leaves open the share of states from the memory, a half here, and the number of epochs.
            ``"tuned"``: the configuration's defaults, what has worked best here.
        problem: name of the problem.
        scale: fraction of the paper's samples, in (0, 100].
        seed: seed of the training.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if ``settings`` or ``problem`` is unknown, or ``scale`` or ``seed`` out of range.

    Examples:
        >>> settings_config("paper", "linear20", 0.5, seed=0).samples_per_part
        100000
    """
    check_choice("settings", settings, ("paper", "tuned"))
    check_choice("problem", problem, sorted(REPAIR_PRESETS))
    check_number("scale", scale, "(0, 100]")
    samples = max(1, round(scale * _SAMPLES.get(problem, _MORE_SAMPLES)))
    common = PolicyIterationConfig(samples_per_part=samples, value_samples=samples, seed=seed)
    if problem in _MANY_ROBOTS:
        # Every labelled state teaches a decision of each robot.
        common = replace(
            common,
            iterations=4,
            multiagent=True,
            label_steps=_MANY_ROBOTS[problem] if settings == "tuned" else 10,
            trajectories=3,
            visits_per_label=0.2,
            batch_size=64,
            hidden=(128, 32),
            validation_states=1000,
        )
    if settings == "tuned":
        return replace(common, trajectories=_LABEL_TRAJECTORIES.get(problem, common.trajectories))
    return replace(
        common,
        iterations=common.iterations if problem in _MANY_ROBOTS else 2,
        trajectories=10,
        encoder="flat",
        loss="l2",
        visited_share=0.5,
        exploration=0.0,
        symmetries=False,
    )


def plan(
    experiment: Experiment,
    settings: Literal["paper", "tuned"],
    base: Literal["greedy", "urgency"],
    scale: float,
    seed: int,
    problems: Sequence[str] = (),
    device: torch.device | str = "cpu",
) -> dict[str, TrainingRun]:
    """The training runs of an experiment by name.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if a number is out of range, a name is unknown, or a problem is not one of the experiment's.

    Examples:
        >>> list(plan(EXPERIMENTS["ablation"], "paper", "greedy", 0.1, seed=0))
        ['linear20-pAPI-NT-paper-greedy-scale0.1-seed0', 'linear20-pAPI-T-paper-greedy-scale0.1-seed0']
    """
    check_instance("experiment", experiment, Experiment)
    check_choice("base", base, ("greedy", "urgency"))
    unknown = [problem for problem in check_sequence("problems", problems, str) if problem not in experiment.problems]
    if unknown:
        raise ValueError(f"problems must be among {experiment.problems} for {experiment.name}, got {unknown[0]!r}")
    runs = {}
    for problem in problems or experiment.problems:
        for algorithm in experiment.algorithms:
            config = settings_config(settings, problem, scale, seed)
            if algorithm == "API":
                config = replace(config, samples_per_part=6 * config.samples_per_part)
            name = f"{problem}-{algorithm}-{settings}-{base}-scale{scale:g}-seed{seed}"
            runs[name] = TrainingRun(
                make_problem(problem, device=device),
                algorithm,
                base,
                config,
                states=experiment.states,
                rollout_states=experiment.states,
                online_states=experiment.states,
                online_trajectories=_ONLINE_TRAJECTORIES.get(problem, 5 if settings == "tuned" else 10),
            )
    return runs


def reproduce(
    experiment: Experiment,
    *,
    scale: float,
    settings: Literal["paper", "tuned"] = "tuned",
    base: Literal["greedy", "urgency"] = "greedy",
    problems: Sequence[str] = (),
    seed: int = 0,
    runs: str | PathLike[str] = Path("runs"),
    out: str | PathLike[str] = Path("results"),
    device: torch.device | str = "cpu",
    report: Callable[[str, str, Comparison], None] = lambda run, policy, comparison: None,
    tell: Callable[[str], None] = lambda text: None,
    progress: bool = False,
) -> str:
    """Carry out an experiment, or go on with an interrupted one, and write numbers, a table and figures.

    Args:
        experiment: one of :data:`EXPERIMENTS`.

    Keyword Args:
        scale: fraction of the paper's samples; 1 is the paper's.
        settings: see :func:`settings_config`.
        base: base policy that is improved first; the paper's is greedy.
        problems: only these problems; none: all of the experiment's.
        seed: seed of the training.
        runs: folder of the run folders.
        out: folder of the results: ``EXPERIMENT/NAME.json``, ``NAME.md`` and ``NAME-*.png`` in it.
        device: where to compute.
        report: called with run, policy and its comparison with greedy as soon as it is known.
        tell: called with the table before pictures are drawn, then with a line that says where they are or why there are
            none.
        progress: whether to show progress on a terminal; the outer bar counts labelled states and estimates the time left.

    Returns:
        the table, Markdown.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if a number is out of range, a problem is not one of the experiment's, a folder cannot be written or holds
            something else, or there is no such device; before anything is computed.
    """
    check_flag("progress", progress)
    check_callable("report", report)
    check_callable("tell", tell)
    device = check_device("device", device)
    runs, out = check_folder("runs", runs), check_folder("out", out)
    planned = plan(experiment, settings, base, scale, seed, problems, device)
    for name, run in planned.items():
        run.check(runs / name)
    out = out / experiment.name
    results: dict[str, dict[str, Comparison]] = {}
    iterations: dict[str, list[dict[str, Any]]] = {}
    costs: dict[str, dict[str, Tensor]] = {}
    total = sum(run.config.iterations * _iteration_labels(run) for run in planned.values())
    # An average rate over the whole run, since labelling and training take turns.
    with progress_bar(total, "label", experiment.name, progress, smoothing=0, leave=True) as bar:
        for name, run in planned.items():
            results[name] = run.carry_out(
                runs / name,
                progress=progress,
                report=partial(report, name),
                on_labels=partial(_advance, bar),
            )
            iterations[name] = json.loads((runs / name / "iterations.json").read_text())
            costs.setdefault(run.problem.name, {}).update(run.costs(runs / name, results[name]))
    title = f"{experiment.name}-{settings}-{base}-scale{scale:g}-seed{seed}"
    if problems:
        title = f"{title}-{'-'.join(problems)}"
    about = {"experiment": experiment.name, "settings": settings, "base": base, "scale": scale, "seed": seed}
    paired = {problem: paired_ratios(found) for problem, found in costs.items()}
    provenances = {name: known_provenance(runs / name) for name in planned}
    text = _write(out, title, about, planned, results, iterations, provenances, paired)
    tell(text)
    tell(draw(_figures(out, title, planned, results, iterations)))
    return text


def _write(
    out: Path,
    title: str,
    about: dict[str, Any],
    planned: dict[str, TrainingRun],
    results: dict[str, dict[str, Comparison]],
    iterations: dict[str, list[dict[str, Any]]],
    provenances: dict[str, list[dict[str, Any]]],
    paired: dict[str, dict[str, dict[str, Estimate | None]]],
) -> str:
    """Write numbers and tables; returns the tables."""
    content = {
        **about,
        "provenance": provenances,
        "runs": {name: run.to_dict() for name, run in planned.items()},
        "results": {name: {p: asdict(c) for p, c in found.items()} for name, found in results.items()},
        "paired": {
            problem: {p: {r: e and asdict(e) for r, e in row.items()} for p, row in rows.items()}
            for problem, rows in paired.items()
        },
        "iterations": iterations,
    }
    write_json(out / f"{title}.json", content)
    text = comparison_table({name: (run.problem.name, results[name]) for name, run in planned.items()})
    text += "".join(f"\n\n{paired_table(problem, rows)}" for problem, rows in paired.items())
    text += f"\n\n{effort_table({f'{run.problem.name}, {run.algorithm}': iterations[name] for name, run in planned.items()})}"
    write_bytes(out / f"{title}.md", (text + "\n").encode())
    return text


def comparison_table(results: dict[str, tuple[str, dict[str, Comparison]]]) -> str:
    """Markdown table of all policies of all runs (problem and comparisons by run) beside the published numbers.

    Examples:
        >>> from torchrl_pomdp.evaluation import compare
        >>> cost = torch.tensor([10.0, 20.0])
        >>> print(comparison_table({"a": ("grid5x4", {"greedy": compare(cost, cost)})}))
        | problem | policy | states | cost | ratio to greedy | 95 % interval | paper: cost | paper: ratio |
        |---|---|---|---|---|---|---|---|
        | grid5x4 | greedy | 2 | 15.0 ± 9.8 | 1.000 | 1.000 … 1.000 | 5476.79 | 1.000 |
    """
    known = any(problem in OPTIMA for problem, _ in results.values())
    lines = [
        "| problem | policy | states | cost | ratio to greedy | 95 % interval | paper: cost | paper: ratio |",
        "|---|---|---|---|---|---|---|---|",
    ]
    if known:
        lines = [lines[0] + " over the optimum |", lines[1] + "---|"]
    for problem, found in results.values():
        for policy, comparison in found.items():
            published, greedy = PUBLISHED.get((problem, policy)), PUBLISHED.get((problem, "greedy"))
            beside = f"{published} | {published / greedy:.3f}" if published and greedy else " | "
            lines.append(
                f"| {problem} | {policy} | {comparison.cost.count} | {interval_text(comparison.cost)} | "
                f"{' | '.join(ratio_texts(comparison.ratio))} | {beside} |"
            )
            if known:
                lines[-1] += f" {_over_optimum(problem, comparison)} |"
    return "\n".join(lines)


def _over_optimum(problem: str, comparison: Comparison) -> str:
    """How much more than the optimum a policy costs, with its 95 % interval; empty where no optimum is known."""
    if problem not in OPTIMA:
        return ""
    low, high = (100 * (cost / OPTIMA[problem] - 1) for cost in comparison.cost.interval)
    return f"{(low + high) / 2:.2f} % ± {(high - low) / 2:.2f}"


def _iteration_labels(run: TrainingRun) -> int:
    parts = 1 if run.algorithm == "API" else 6
    values = 3 * run.config.value_samples if run.algorithm == "pAPI-T" else 0
    return parts * run.config.samples_per_part + values


def _advance(bar: tqdm, labels: int, restored: bool) -> None:
    """Count labelled states; those of an interrupted run took no time now and say nothing about the rate."""
    if restored and not bar.disable:
        bar.initial += labels
    bar.update(labels)


def _figures(
    out: Path,
    title: str,
    planned: dict[str, TrainingRun],
    results: dict[str, dict[str, Comparison]],
    iterations: dict[str, list[dict[str, Any]]],
) -> dict[Path, Callable[[], Figure]]:
    """Bars for each run, cost against iteration, and training time by part; drawn when they are called."""
    figures: dict[Path, Callable[[], Figure]] = {}
    lines = {}
    for name, run in planned.items():
        found, label = results[name], f"{run.problem.name}, {run.algorithm}"
        bars = [Result(policy, comparison) for policy, comparison in found.items()]
        path = out / f"{title}-{run.problem.name}-{run.algorithm}.png"
        figures[path] = partial(cost_figure, bars, f"{name}; below each policy its ratio to greedy")
        lines[label] = [found[run.base]] + [found[policy] for policy in found if is_iteration(policy)]
    times = {f"{run.problem.name}, {run.algorithm}": iterations[name] for name, run in planned.items()}
    figures[out / f"{title}-iterations.png"] = partial(iteration_figure, lines)
    figures[out / f"{title}-time.png"] = partial(time_figure, times)
    return figures
