"""What the subcommands of ``torchrl-pomdp`` do; every argument is checked before anything is computed or written."""

from __future__ import annotations

import shlex
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch

from torchrl_pomdp.changes import measure_changes
from torchrl_pomdp.checks import check_integer, check_seed
from torchrl_pomdp.config import EVALUATION_SEED, MAX_STATES, PolicyIterationConfig
from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.envs.repair import RepairModel, save_animation, trajectory_figure
from torchrl_pomdp.envs.repair.rendering.animation import check_film
from torchrl_pomdp.evaluation import Comparison, discounted_costs
from torchrl_pomdp.evaluation import compare as compare_costs
from torchrl_pomdp.files import check_folder, read_json, write_bytes, write_json
from torchrl_pomdp.identity import digest
from torchrl_pomdp.modules import Policy
from torchrl_pomdp.modules.rollout import MAX_STEPS
from torchrl_pomdp.noise import fold, seed_keys
from torchrl_pomdp.problems import PRESETS, Problem, make_problem
from torchrl_pomdp.problems.find import find_problem
from torchrl_pomdp.provenance import known_provenance
from torchrl_pomdp.report import Result, cost_figure, draw, interval_text, peer_figure, peer_table, ratio_texts, table
from torchrl_pomdp.report.page import write_report
from torchrl_pomdp.report.player import side_by_side
from torchrl_pomdp.report.run_folder import read_iterations, read_run_folder
from torchrl_pomdp.reproduce import EXPERIMENTS
from torchrl_pomdp.reproduce import reproduce as reproduce_experiment
from torchrl_pomdp.tensor_checks import check_device
from torchrl_pomdp.trainers import Checkpoint, compare_peers, load_checkpoint, r_nt
from torchrl_pomdp.trainers.ppo import BATCH
from torchrl_pomdp.trainers.run import TrainingRun
from torchrl_pomdp.workers import LOCAL, Workers

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchrl_pomdp.cli import Changes, Compare, Evaluate, Report, Reproduce, Train

__all__ = ["changes", "compare", "evaluate", "problems", "report", "reproduce", "train"]


def train(command: Train) -> None:
    """Carry out a training run; print its table, then draw its pictures."""
    config = PolicyIterationConfig(**asdict(command.config))
    given = find_problem(command.problem, check_device("device", command.device))
    numbers: dict[str, Any] = {
        name: getattr(command, name) for name in ("states", "rollout_states", "online_states", "staleness")
    }
    run = TrainingRun(given, command.algorithm, cast(str, command.base), config, **numbers)
    problem = run.problem
    default = Path("runs") / f"{problem.name}-{command.algorithm}-{run.base}-seed{config.seed}"
    out = check_folder("out", command.out or default)
    print(f"{problem.name}: {problem.model.describe()}\nrun folder: {out}", flush=True)
    with _workers(command) as workers:
        comparisons = run.carry_out(out, progress=True, report=partial(_tell, problem.baseline), workers=workers)
    results = [Result(name, comparison) for name, comparison in comparisons.items()]
    print(f"\n{table(results)}\n", flush=True)
    best = load_checkpoint(out / "best.pt", problem=problem)
    title = f"{problem.name}, {command.states} start states"
    figures = {
        out / "costs.png": partial(cost_figure, results, title),
    }
    if isinstance(problem.model, RepairModel):
        figures[out / "trajectory.png"] = partial(_trajectory_figure, problem, problem.model, best.policy)
    print(draw(figures))
    print(_write_report(out, problem))
    # A file cannot describe a problem of one's own.
    named = shlex.quote(str(out / "best.pt"))
    if problem.spec is None:
        named += f" --problem {shlex.quote(command.problem)}"
    if best.iteration == 0:
        print(
            f"no iteration was accepted: best.pt is the base policy, {best.name}. What usually helps: more --samples-per-part, "
            "more --validation-states, more --trajectories"
        )
    else:
        print(
            f"best policy: {best.name}, {out / 'best.pt'}. Compare it, or improve it online: torchrl-pomdp evaluate "
            f"{named} --online. On a robot: torchrl_pomdp.controller.Controller.from_checkpoint"
        )


def _write_report(out: Path, problem: Problem) -> str:
    """Write the page about a run; a line that says where it is, or why there is none: results are not lost for want of it."""
    try:
        return f"report: {write_report(out, problem=problem)}"
    except Exception as error:  # whatever a world or a name of the user's own code may raise when it is shown
        return f"no report: {' '.join(str(error).split()) or type(error).__name__}"


def _workers(command: Train) -> AbstractContextManager[Workers]:
    """Who does the work of a training."""
    if command.backend == "local":
        for name in ("address", "workers"):
            if getattr(command, name) is not None:
                raise ValueError(f"{name} is for --backend ray, got {getattr(command, name)} for the backend local")
        return nullcontext(LOCAL)
    if find_spec("ray") is None:
        raise ValueError("backend ray needs Ray: pip install '.[ray]' in the library's folder")
    from torchrl_pomdp.distributed import RayWorkers

    return RayWorkers(command.address, command.workers)


def _tell(baseline: str, name: str, comparison: Comparison) -> None:
    ratio, interval = ratio_texts(comparison.ratio)
    of_baseline = f"{ratio} of {baseline} ({interval})" if comparison.ratio else f"cost {interval_text(comparison.cost)}"
    print(f"{name}: {of_baseline}", flush=True)


def _trajectory_figure(problem: Problem, model: RepairModel, policy: Policy) -> Figure:
    """The trajectory of ``policy`` from the first start state of the evaluations."""
    env = BeliefEnv(problem.model, problem.start, seed=EVALUATION_SEED)
    first = torch.tensor(0, device=problem.model.device)
    y = env.reset(problem.start(fold(seed_keys(EVALUATION_SEED, first), 0)), set_state=True)
    with torch.no_grad():
        trajectory = env.rollout(200, policy, tensordict=y, auto_reset=False)
    return trajectory_figure(model, trajectory, f"{problem.name}: one trajectory of the best policy")


def evaluate(command: Evaluate) -> None:
    """Compare a policy with the base policies; print the table."""
    check_integer("states", command.states, 2, MAX_STATES)
    check_integer("trajectories", command.trajectories, 1, 10**6)
    check_seed("seed", command.seed)
    problem, policy, name = _named_policy(command, check_device("device", command.device))
    policies: dict[str, Policy] = dict(problem.base_policies)
    if command.online:
        name, policy = f"{name} + R-NT", r_nt(problem, policy, trajectories=command.trajectories)
    policies.setdefault(name, policy)
    costs = {
        name: discounted_costs(
            problem.model,
            policy,
            problem.start,
            num_states=command.states,
            seed=command.seed,
            terminal_cost=problem.evaluation_cost,
            progress=True,
            name=f"evaluate {name}",
        )
        for name, policy in policies.items()
    }
    print(f"{problem.name}: {problem.model.describe()}; {command.states} start states, seed {command.seed}\n")
    print(table([Result(name, compare_costs(cost, costs[problem.baseline])) for name, cost in costs.items()]))


def _named_policy(command: Evaluate, device: torch.device) -> tuple[Problem, Policy, str]:
    """The problem, the policy and its name that ``evaluate`` was asked for."""
    given = None if command.problem is None else find_problem(command.problem, device)
    if given is not None and command.policy in given.base_policies:
        return given, given.base_policies[command.policy], command.policy
    if not Path(command.policy).is_file():
        names = "with --problem the name of a base policy" if given is None else f"one of {', '.join(given.base_policies)}"
        raise ValueError(f"policy must be the path of a checkpoint, or {names}, got {command.policy!r}")
    checkpoint = load_checkpoint(command.policy, problem=given, device=device)
    return checkpoint.problem, checkpoint.policy, checkpoint.name


def compare(command: Compare) -> None:
    """Compare all methods; print the table, write it with its numbers, then draw its pictures."""
    problem = find_problem(command.problem, torch.device("cpu"))
    given = None if command.checkpoint is None else load_checkpoint(command.checkpoint, problem=problem)
    name = f"compare-{problem.name}-{command.seconds:g}s"
    runs, out = check_folder("runs", command.runs), check_folder("out", command.out) / "compare"
    ppo = command.methods is None or "PPO" in command.methods
    about = {**asdict(command), **{key: str(getattr(command, key)) for key in ("checkpoint", "runs", "out")}}
    about |= {"methods": command.methods and list(command.methods), "policy": given and digest(given.policy)}
    _check_same(out / f"{name}.json", about)
    folder = runs / f"{name}-seed{command.seed}"
    outcomes = compare_peers(
        problem,
        folder,
        checkpoint=given,
        ppo_steps=None if given is None or not ppo else _ppo_steps(cast(Path, command.checkpoint).parent, given),
        methods=command.methods,
        states=command.states,
        seconds=command.seconds,
        seed=command.seed,
        report=lambda method, outcome: _tell(problem.baseline, method, outcome.comparison),
        progress=True,
    )
    text = f"{problem.name}, {command.states} start states, {command.seconds:g} s a decision\n\n{peer_table(outcomes)}"
    found = {method: each.to_dict() for method, each in outcomes.items()}
    write_json(out / f"{name}.json", {"command": about, "provenance": known_provenance(folder), "outcomes": found})
    write_bytes(out / f"{name}.md", f"{text}\n".encode())
    print(f"\n{text}\n", flush=True)
    results = [Result(method, outcome.comparison) for method, outcome in outcomes.items()]
    title = f"{problem.name}, {command.states} start states"
    pictures = {out / f"{name}-time.png": partial(peer_figure, outcomes, title)}
    print(draw(pictures | {out / f"{name}.png": partial(cost_figure, results, title)}))


def _check_same(path: Path, command: dict[str, Any]) -> None:
    """Raise if a file holds the results of another comparison: they are not written over."""
    if not path.is_file():
        return
    found = read_json(path).get("command")
    given = {key: value for key, value in command.items() if key not in ("runs", "out")}
    differing = [key for key in given if not isinstance(found, dict) or found.get(key) != given[key]]
    if differing:
        what = ", ".join(differing)
        raise ValueError(f"out must be another folder: {path} holds another comparison, which differs in {what}")


def changes(command: Changes) -> None:
    """Measure all changes of models; print the table and write it."""
    path = check_folder("out", command.out) / "changes" / "model-changes.md"
    numbers = f"{command.states} start states, {command.trajectories} trajectories of each control"
    if path.is_file() and f", {numbers}, " not in path.read_text().partition("\n")[0]:
        raise ValueError(f"out must be another folder: {path} holds another measurement, not of {numbers}")
    found = measure_changes(
        command.states,
        trajectories=command.trajectories,
        report=lambda change, policy, comparison: _tell("the old policy", f"{change}, {policy}", comparison),
        progress=True,
    )
    tables = [
        f"{change}, {numbers}, ratios to the old policy\n\n"
        + table([Result(policy, comparison) for policy, comparison in policies.items()])
        for change, policies in found.items()
    ]
    text = "\n\n".join(tables)
    write_bytes(path, f"{text}\n".encode())
    print(f"\n{text}\n", flush=True)


def _ppo_steps(folder: Path, trained: Checkpoint) -> int | None:
    """Belief steps of PPO beside a trained policy of a run, said aloud; None where the folder does not tell of them."""
    steps = _simulated_steps(folder, trained.iteration)
    of = f"labels of {trained.algorithm} took up to iteration {trained.iteration}"
    if steps is None:
        why = f"{folder / 'iterations.json'} does not tell of them" if trained.iteration else "a base policy has none"
        print(f"without PPO, which takes as many belief steps as the {of}: {why}", flush=True)
    else:
        print(f"PPO takes as many belief steps as the {of}, and {BATCH:,} at least: {steps:,}", flush=True)
    return steps


def _simulated_steps(folder: Path, last: int) -> int | None:
    """Belief steps that the labels of a run's iterations up to the ``last`` one took, but no fewer than PPO takes; None where
    the folder does not tell of all of them.
    """
    iterations = [each for each in read_iterations(folder / "iterations.json") if each["number"] <= last]
    steps = sum(part["simulated_steps"] for iteration in iterations for part in iteration["parts"].values())
    return max(steps, BATCH) if 0 < last == len(iterations) else None


def reproduce(command: Reproduce) -> None:
    """Carry out an experiment; print its tables, then draw its pictures."""
    reproduce_experiment(
        EXPERIMENTS[command.experiment],
        scale=command.scale,
        settings=command.settings,
        base=command.base,
        problems=command.problems,
        seed=command.seed,
        runs=command.runs,
        out=command.out,
        device=command.device,
        report=lambda run, name, comparison: _tell("greedy", f"{run}, {name}", comparison),
        tell=lambda text: print(f"\n{text}", flush=True),
        progress=True,
    )


def report(command: Report) -> None:
    """Write the page about a run and, if asked for, an animation of its policies; say where they are."""
    stages = check_integer("stages", command.stages, 1, MAX_STEPS)
    given = None if command.problem is None else find_problem(command.problem, torch.device("cpu"))
    if command.animation is None:
        print(f"report: {write_report(command.run, problem=given)}")
        return
    check_film("animation", command.animation)
    run = read_run_folder(command.run, given)
    if run.policy is None:
        raise ValueError(f"animation needs a policy of the run. {run.missing}")
    problem = run.policy.problem
    if not isinstance(problem.model, RepairModel):
        raise ValueError(f"animation is of repair problems, got {problem.name}")
    print(f"report: {write_report(command.run, problem=given)}")
    (trajectories,) = side_by_side(problem, run.policies, 1, stages)
    save_animation(command.animation, problem.model, trajectories)
    print(f"animation: {command.animation}")


def problems() -> None:
    """Print a line for each known problem."""
    width = max(map(len, PRESETS))
    for name in PRESETS:
        problem = make_problem(name)
        parts = problem.partition.num_parts
        bases = ", ".join(problem.base_policies)
        print(f"{name:{width}}  {problem.model.describe()}; {parts} part{'s' * (parts > 1)}; base policies {bases}")
