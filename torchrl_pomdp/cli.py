"""The command ``torchrl-pomdp``: train policies and evaluate them."""

from __future__ import annotations

import json
import platform
import sys
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor
from torchrl import logger as torchrl_logger
from torchrl.record import CSVLogger

from torchrl_pomdp.envs import BeliefEnv, Problem, make_problem
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import GreedyRepair, Policy, RolloutPolicy
from torchrl_pomdp.noise import seed_keys
from torchrl_pomdp.report import Result, cost_figure, table, trajectory_figure, write_metrics
from torchrl_pomdp.trainers import PolicyIteration, PolicyIterationConfig
from torchrl_pomdp.trainers.checkpoint import (
    Checkpoint,
    create_run_folder,
    load_checkpoint,
    save_checkpoint,
    write_atomically,
)

# Start states of evaluations are drawn under this seed, whatever the training's.
_EVALUATION_SEED = 20200


@dataclass(frozen=True)
class Train:
    """Train policies by partitioned policy iteration without truncation (pAPI-NT), from the greedy policy."""

    problem: tyro.conf.Positional[str]
    """Name of the problem, such as linear20."""

    config: tyro.conf.OmitArgPrefixes[PolicyIterationConfig] = field(default_factory=PolicyIterationConfig)

    out: Path | None = None
    """Folder of the run, new or empty; by default runs/PROBLEM-seedSEED."""

    states: int = 1000
    """Start states of each evaluation."""

    device: str = "cpu"
    """Device to compute on, such as cpu or cuda:0."""


@dataclass(frozen=True)
class Evaluate:
    """Compare a policy with the greedy policy from the same start states."""

    policy: tyro.conf.Positional[str]
    """Path of a checkpoint, or greedy, or rollout (one-step lookahead with rollout of the greedy policy)."""

    problem: str = "linear20"
    """Problem for greedy and rollout; a checkpoint knows its own."""

    states: int = 1000
    """Start states."""

    trajectories: int = 10
    """Simulated trajectories from each leaf, for rollout."""

    seed: int = _EVALUATION_SEED
    """Seed of start states and noise."""

    device: str = "cpu"
    """Device to compute on, such as cpu or cuda:0."""


def main(args: list[str] | None = None) -> int:
    """Run the command with ``args`` (default: the process's); returns the exit status, 2 for input that was refused."""
    torchrl_logger.setLevel("WARNING")
    commands = Annotated[Train, tyro.conf.subcommand("train")] | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    command: Train | Evaluate = tyro.cli(commands, prog="torchrl-pomdp", args=args)
    try:
        _train(command) if isinstance(command, Train) else _evaluate(command)
    except ValueError as error:
        print(f"torchrl-pomdp: {error}", file=sys.stderr)
        return 2
    return 0


def _train(command: Train) -> None:
    problem = make_problem(command.problem, device=command.device)
    config = command.config
    out = create_run_folder(command.out or Path("runs") / f"{problem.name}-seed{config.seed}")
    print(f"{problem.name}: {problem.model.describe()}\nrun folder: {out}")
    _write_json(out / "config.json", {"problem": problem.name, "base_policy": "greedy", **asdict(config), **_versions()})
    greedy = GreedyRepair(problem.model)
    baseline = _costs(problem, greedy, command.states, "greedy")
    results = [Result("greedy", compare(baseline, baseline))]
    rollout = RolloutPolicy(problem.model, greedy)
    _add(results, "R-NT", _costs(problem, rollout, command.states, "R-NT"), baseline, problem, out)
    logger = CSVLogger("log", log_dir=str(out))
    best: tuple[float, Any] = (results[0].comparison.cost.mean, greedy)
    for number, policy in enumerate(PolicyIteration(problem, config, greedy, logger=logger, progress=True), start=1):
        save_checkpoint(out / f"iteration-{number}.pt", Checkpoint(problem, config, number, policy))
        name = f"pAPI-NT {number}"
        _add(results, name, _costs(problem, policy, command.states, name), baseline, problem, out)
        best = min(best, (results[-1].comparison.cost.mean, policy), key=lambda entry: entry[0])
    _save_trajectory(problem, best[1], out / "trajectory.png")
    print(f"\n{table(results)}\n\npictures: {out / 'costs.png'}, {out / 'trajectory.png'}")


def _evaluate(command: Evaluate) -> None:
    problem, policy, name = _named_policy(command)
    baseline = _costs(problem, GreedyRepair(problem.model), command.states, "greedy", command.seed)
    results = [Result("greedy", compare(baseline, baseline))]
    if name != "greedy":
        costs = _costs(problem, policy, command.states, name, command.seed)
        results.append(Result(name, compare(costs, baseline)))
    print(f"{problem.name}: {problem.model.describe()}; {command.states} start states, seed {command.seed}\n")
    print(table(results))


def _named_policy(command: Evaluate) -> tuple[Problem, Policy, str]:
    """The problem, the policy and its name that ``evaluate`` was asked for."""
    if command.policy in ("greedy", "rollout"):
        problem = make_problem(command.problem, device=command.device)
        greedy = GreedyRepair(problem.model)
        if command.policy == "greedy":
            return problem, greedy, "greedy"
        return problem, RolloutPolicy(problem.model, greedy, trajectories=command.trajectories), "R-NT"
    checkpoint = load_checkpoint(Path(command.policy), device=command.device)
    return checkpoint.problem, checkpoint.policy, f"pAPI-NT {checkpoint.iteration}"


def _costs(problem: Problem, policy: Policy, states: int, name: str, seed: int = _EVALUATION_SEED) -> Tensor:
    return discounted_costs(
        problem.model, policy, problem.start, num_states=states, seed=seed, progress=True, name=f"evaluate {name}"
    )


def _add(results: list[Result], name: str, costs: Tensor, baseline: Tensor, problem: Problem, out: Path) -> None:
    """Append a result, tell it, and bring the run folder's metrics and picture up to date."""
    result = Result(name, compare(costs, baseline))
    results.append(result)
    low, high = result.comparison.ratio.interval
    print(f"{name}: {result.comparison.ratio.mean:.3f} of greedy ({low:.3f} … {high:.3f})", flush=True)
    write_atomically(out / "metrics.csv", lambda path: write_metrics(path, results))
    title = f"{problem.name}, {costs.numel()} start states; below each policy its ratio to greedy"
    write_atomically(out / "costs.png", lambda path: cost_figure(results, title).savefig(path))


def _save_trajectory(problem: Problem, policy: Policy, path: Path) -> None:
    """Draw the trajectory of ``policy`` from the first start state of the evaluations."""
    env = BeliefEnv(problem.model, problem.start, seed=_EVALUATION_SEED)
    y = env.reset(problem.start(seed_keys(_EVALUATION_SEED, torch.tensor(0))), set_state=True)
    with torch.no_grad():
        trajectory = env.rollout(200, policy, tensordict=y, auto_reset=False)
    figure = trajectory_figure(problem.model, trajectory, f"{problem.name}: one trajectory of the best policy")
    write_atomically(path, figure.savefig)


def _write_json(path: Path, content: dict) -> None:
    write_atomically(path, lambda temporary: temporary.write_text(json.dumps(content, indent=2) + "\n"))


def _versions() -> dict:
    packages = ("torchrl-pomdp", "torch", "torchrl", "tensordict")
    return {"python": platform.python_version(), "versions": {name: version(name) for name in packages}}


if __name__ == "__main__":
    sys.exit(main())
