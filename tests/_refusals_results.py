"""Cases of the test of refusals: evaluation, reports, files and checks; see the cases of planning."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from _hostile import (
    Hostile,
    choices,
    devices,
    dtypes,
    flags,
    integers,
    keys,
    mappings,
    no_states,
    not_callable,
    numbers,
    objects,
    paths,
    probabilities,
    seeds,
    sequences,
    sizes,
    states,
    tensors,
    terminal_costs,
    texts,
    values,
    wrong_actions,
    wrong_entries,
)
from _valid import (
    CHAIN,
    COSTS,
    ITERATIONS,
    KEYS,
    a_check,
    a_policy,
    a_start,
    at_once,
    belief_model,
    callback,
    case,
    comparison,
    env,
    greedy,
    model,
    problem,
    quick_reproduce,
    repair_model,
    some_workers,
    state,
    written,
)

from torchrl_pomdp import checks, evaluation, files, noise, report, reproduce, tensor_checks, trajectories
from torchrl_pomdp.envs import repair
from torchrl_pomdp.modules import ZeroCost
from torchrl_pomdp.report import page

__all__ = ["FILES", "REPORTS"]

# fmt: off

RESULTS = [report.Result("greedy", comparison())]
TITLES = values(None, 3, b"x", [], object())
RUNS = [*mappings(), *values({"run": None}, {"run": 3}, {"run": [3]}, {"run": [{}]})]
PLAYED = env().rollout(2, greedy())[0]
NO_TENSORS = values(object(), {"x": object()}, len, int)


def run_folder(folder: Path) -> Path:
    """A run that has just begun."""
    content = {"problem": "line3", "algorithm": "API", "base": "greedy", "config": {"seed": 0}}
    files.write_json(folder / "run" / "config.json", content)
    return folder / "run"


REPORTS = {
    "evaluation.discounted_costs": lambda _: case(
        evaluation.discounted_costs,
        model=belief_model(),
        policy=at_once(a_policy()),
        start=at_once(a_start()),
        num_states=(2, integers(1)),
        first=(0, integers(0)),
        seed=(0, integers()),
        max_steps=(3, integers(1)),
        terminal_cost=at_once((ZeroCost(), terminal_costs())),
        progress=(False, flags()),
        name=("evaluate", texts()),
        workers=some_workers(),
    ),
    "evaluation.estimate": lambda _: case(evaluation.estimate, values=(torch.ones(2), tensors(torch.ones(2), free=True))),
    "evaluation.compare": lambda _: case(
        evaluation.compare,
        costs=(torch.ones(2), tensors(torch.ones(2))),
        baseline=(torch.ones(2), tensors(torch.ones(2))),
    ),
    "noise.seed_keys": lambda _: case(
        noise.seed_keys,
        seed=(0, integers()),
        index=(KEYS, keys()),
    ),
    "report.Result": lambda _: case(report.Result, name=("greedy", texts()), comparison=(comparison(), objects())),
    "report.table": lambda _: case(
        report.table, results=(RESULTS, sequences(RESULTS, None, 3, "x", comparison(), empty=False))
    ),
    "report.cost_figure": lambda _: case(
        report.cost_figure, results=(RESULTS, sequences(RESULTS, None, 3, "x", comparison())), title=("title", TITLES)
    ),
    "report.iteration_figure": lambda _: case(
        report.iteration_figure,
        lines=({"run": [comparison()]}, [*mappings(), *values({"run": None}, {"run": [3]})]),
    ),
    "report.time_figure": lambda _: case(report.time_figure, runs=({"run": ITERATIONS}, RUNS)),
    "report.effort_table": lambda _: case(report.effort_table, runs=({"run": ITERATIONS}, RUNS)),
    "report.effort": lambda _: case(
        report.effort,
        iterations=(ITERATIONS, sequences(ITERATIONS, None, 3, {}, {"parts": {}}, {"parts": 3}, {"parts": {"a": {}}})),
    ),
    "envs.repair.trajectory_figure": lambda _: case(
        repair.trajectory_figure,
        model=repair_model(),
        trajectory=(greedy()(state()), [
            *no_states(greedy()(state()), "belief", "location"), *(Hostile("no action", state(), names=("action",)),)
        ]),
        title=("title", TITLES),
    ),
    "envs.repair.network_figure": lambda _: case(
        repair.network_figure,
        model=repair_model(),
        y=(state()[0], [
            *no_states(state()[0], "belief", "location"),
            *(wrong._replace(value=wrong.value[0]) for wrong in wrong_entries(state())),
            *values(state()),
        ]),
        control=("repair", values("", "no such", b"x", -1, 99, 1.5, True, [], [0, 0], [None], {}, object(), torch.ones(2))),
        title=("title", TITLES),
    ),
    "envs.repair.save_animation": lambda folder: case(
        repair.save_animation,
        path=(folder / "a.gif", [*paths(), *values("a", "a.png", "a.mp3")]),
        model=repair_model(),
        trajectories=({"greedy": PLAYED}, [
            *mappings(),
            *values({}, {3: PLAYED}, {"": PLAYED}, {"greedy": {}}, {"greedy": PLAYED[0]}, {"greedy": PLAYED[:0]}),
            *(Hostile(wrong.label, {"greedy": wrong.value}) for wrong in no_states(PLAYED, "belief", "location", "action")),
            *(Hostile(wrong.label, {"greedy": wrong.value}) for wrong in [*wrong_entries(PLAYED), *wrong_actions(PLAYED)]),
            *values(*({"greedy": PLAYED.copy().set("q_factors", wrong)} for wrong in (torch.zeros(2, 9), torch.zeros(3)[:2]))),
            *values({"greedy": PLAYED.copy().set("hidden", PLAYED.select("location"))}),
        ]),
        frames_per_second=(2.0, numbers("[0.1, 50]")),
    ),
    "trajectories.has_world": lambda _: case(trajectories.has_world, model=belief_model()),
    "trajectories.play": lambda _: case(
        trajectories.play,
        model=belief_model(),
        policy=a_policy(),
        y=(state(), states(state())),
        keys=(KEYS, [*keys(), Hostile("one key for two states", KEYS[:1])]),
        max_steps=(2, integers(1)),
    ),
    "report.page.write_report": lambda folder: case(
        page.write_report,
        folder=(run_folder(folder), [*paths(), *values("no such folder")]),
        problem=at_once((problem(), objects())),
    ),
    "report.interval_text": lambda _: case(report.interval_text, value=(comparison().cost, objects(comparison()))),
    "report.ratio_texts": lambda _: case(
        report.ratio_texts, ratio=(comparison().ratio, objects(comparison())), digits=(3, integers(0))
    ),
    "report.draw": lambda folder: case(
        report.draw, figures=({folder / "a.png": lambda: report.cost_figure(RESULTS)}, mappings())
    ),
    "report.is_iteration": lambda _: case(report.is_iteration, policy=("API 1", values(None, 3, b"x", [], object()))),
    "report.paired_ratios": lambda _: case(
        report.paired_ratios,
        costs=(
            {"API 1": torch.ones(2), "API 2": torch.ones(2)},
            [*mappings(), *values({"API 1": 3, "API 2": 3}, {3: torch.ones(2)})],
        ),
    ),
    "report.paired_table": lambda _: case(
        report.paired_table,
        problem=("line3", texts()),
        ratios=(
            {"API 1": {"API 2": comparison().ratio}},
            [*mappings(), *values({"API 1": 3}, {"API 1": {"API 2": 3}})],
        ),
    ),
    "reproduce.Experiment": lambda _: case(
        reproduce.Experiment,
        name=("tiny", texts()),
        problems=(("line3",), sequences(("line3",), "no such", 3, None)),
        algorithms=(("API",), sequences(("API",), "no such", 3, None)),
        states=(8, integers(1)),
    ),
    "reproduce.settings_config": lambda _: case(
        reproduce.settings_config,
        settings=("paper", choices()),
        problem=("line3", choices()),
        scale=(1.0, numbers("(0, inf)")),
        seed=(0, seeds()),
    ),
    "reproduce.plan": lambda _: case(reproduce.plan, **an_experiment(), device=("cpu", devices())),
    "reproduce.reproduce": lambda folder: case(
        quick_reproduce,
        **an_experiment(),
        runs=(folder / "runs", paths()),
        out=(folder / "results", paths()),
        device=("cpu", devices()),
        report=callback(),
        tell=callback(),
        progress=(False, flags()),
    ),
}


def an_experiment():
    return {
        "experiment": (reproduce.EXPERIMENTS["optimum"], objects(reproduce.Experiment)),
        "settings": ("paper", choices()),
        "base": ("greedy", choices()),
        "scale": (1.0, numbers("(0, inf)")),
        "seed": (0, seeds()),
        "problems": ((), sequences(("line3",), "no such", 3, None, empty=False)),
    }


FILES = {
    "files.write_bytes": lambda folder: case(
        files.write_bytes, path=(folder / "a", paths()), content=(b"x", values(None, 3, "x", [], object()))
    ),
    "files.write_json": lambda folder: case(
        files.write_json,
        path=(folder / "a", paths()),
        content=({}, values(object(), {"a": object()}, {1j: 0}, {"a": 1j}, {"a": b"x"})),
    ),
    "files.check_folder": lambda folder: case(
        lambda path: files.check_folder("path", path), path=(folder, [*paths(), Hostile("a file", written(folder / "a.json"))])
    ),
    "files.read_text": lambda folder: case(
        files.read_text, path=(written(folder / "a.json"), paths()), encoding=("utf-8", choices())
    ),
    "files.read_json": lambda folder: case(files.read_json, path=(written(folder / "a.json"), paths())),
    "files.claim": lambda folder: case(
        files.claim,
        path=(folder / "a.json", paths()),
        identity=({"seed": 0}, [*mappings(), *values({"seed": object()}, {1j: 0})]),
    ),
    "files.save_tensors": lambda folder: case(
        files.save_tensors, path=(folder / "a.pt", paths()), content=({"x": KEYS}, NO_TENSORS)
    ),
    "files.tensor_bytes": lambda _: case(files.tensor_bytes, content=({"x": KEYS}, NO_TENSORS)),
    "files.load_tensors": lambda folder: case(
        files.load_tensors, path=(written(folder / "a.pt"), paths()), device=("cpu", devices())
    ),
    "files.parse_tensors": lambda folder: case(
        files.parse_tensors,
        content=(files.tensor_bytes({"x": KEYS}), values(None, 3, "x", [], object())),
        path=(folder / "a.pt", paths()),
        device=("cpu", devices()),
    ),
    "checks.check_integer": lambda _: a_check(checks.check_integer, 3, integers(1, 9), least=1, most=9),
    "checks.check_seed": lambda _: a_check(checks.check_seed, 3, seeds()),
    "checks.check_number": lambda _: a_check(checks.check_number, 0.5, numbers("(0, 1)"), interval="(0, 1)"),
    "checks.check_flag": lambda _: a_check(checks.check_flag, True, flags()),
    "checks.check_choice": lambda _: a_check(checks.check_choice, "soft", choices(), allowed=("soft", "l2")),
    "checks.check_text": lambda _: a_check(checks.check_text, "x", texts()),
    "checks.check_label": lambda _: a_check(checks.check_label, "x", [*texts(), *values("../x", "x" * 200, "\u6f22" * 34)]),
    "checks.check_path": lambda _: a_check(checks.check_path, "x", paths()),
    "checks.check_instance": lambda _: a_check(checks.check_instance, model(), objects(), kind=type(model())),
    "checks.check_callable": lambda _: a_check(checks.check_callable, len, not_callable()),
    "checks.check_sizes": lambda _: a_check(checks.check_sizes, (4,), sizes()),
    "tensor_checks.check_device": lambda _: a_check(tensor_checks.check_device, "cpu", devices()),
    "tensor_checks.check_dtype": lambda _: a_check(tensor_checks.check_dtype, torch.float32, dtypes()),
    "tensor_checks.check_tensor": lambda _: a_check(tensor_checks.check_tensor, COSTS, tensors(COSTS), shape=(2,)),
    "tensor_checks.check_keys": lambda _: a_check(tensor_checks.check_keys, KEYS, keys()),
    # Of a real tensor, which is checked before.
    "tensor_checks.check_distributions": lambda _: a_check(
        tensor_checks.check_distributions, CHAIN,
        [value for value in probabilities(CHAIN) if value.label in ("all zero", "all one", "halved", "negative", "with NaN")],
    ),
    # Of a real number, which is checked before.
    "tensor_checks.check_representable": lambda _: a_check(
        tensor_checks.check_representable, 7.0, values(1e39, -1e39, math.inf, math.nan), dtype=torch.float32
    ),
    "tensor_checks.check_entries": lambda _: a_check(
        tensor_checks.check_entries, state(), [
            *values(None, 3, "x", [], {}, object()),
            *(Hostile(f"no {key}", state().exclude(key), names=(key,)) for key in ("belief", "location")),
        ],
        keys=("belief", "location"),
    ),
    "checks.check_sequence": lambda _: a_check(checks.check_sequence, (3,), sequences((3,), "3", None, 1.5), kind=int, least=1),
    "checks.check_mapping": lambda _: a_check(
        checks.check_mapping, {"a": 3}, [*mappings(), *values({3: 3}, {"a": "3"}, {"a": None})], kind=int
    ),
}
