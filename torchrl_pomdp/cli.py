"""The command ``torchrl-pomdp``: train policies, evaluate them, reproduce the paper's experiments."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from tensordict.nn import TensorDictModuleBase
from torchrl import logger as torchrl_logger

from torchrl_pomdp.envs import BeliefEnv, Problem, make_problem
from torchrl_pomdp.evaluation import Comparison, compare, discounted_costs
from torchrl_pomdp.files import write_atomically, write_json
from torchrl_pomdp.modules import NeverRepairCost, Policy
from torchrl_pomdp.noise import fold, seed_keys
from torchrl_pomdp.provenance import provenance
from torchrl_pomdp.report import Result, cost_figure, table, trajectory_figure
from torchrl_pomdp.reproduce import EXPERIMENTS, reproduce
from torchrl_pomdp.trainers import r_nt
from torchrl_pomdp.trainers.checkpoint import load_checkpoint
from torchrl_pomdp.trainers.config import PolicyIterationConfig
from torchrl_pomdp.trainers.run import BASE_POLICIES, EVALUATION_SEED, TrainingRun


@dataclass(frozen=True)
class Train:
    """Train policies by approximate policy iteration; the same command goes on with an interrupted run."""

    problem: tyro.conf.Positional[str]
    """Name of the problem, such as linear20."""

    algorithm: Literal["pAPI-NT", "pAPI-T", "API"] = "pAPI-NT"
    """pAPI-NT: partitioned; pAPI-T: partitioned, with simulations truncated at the endgame; API: a single part."""

    base: Literal["greedy", "urgency"] = "greedy"
    """Base policy that is improved first."""

    config: tyro.conf.OmitArgPrefixes[PolicyIterationConfig] = field(default_factory=PolicyIterationConfig)

    out: Path | None = None
    """Folder of the run: new, empty, or that of the same run; by default runs/PROBLEM-ALGORITHM-BASE-seedSEED."""

    states: int = 1000
    """Start states of each evaluation."""

    online_states: int = 0
    """Start states on which online rollout of the trained policy is evaluated, which takes long; 0 for not at all."""

    device: str = "cpu"
    """Device to compute on, such as cpu or cuda:0."""


@dataclass(frozen=True)
class Evaluate:
    """Compare a policy with the greedy policy from the same start states."""

    policy: tyro.conf.Positional[str]
    """Path of a checkpoint, or greedy, or urgency."""

    online: bool = False
    """Whether the policy is improved online, by one-step lookahead with rollout."""

    problem: str = "linear20"
    """Problem for greedy and urgency; a checkpoint knows its own."""

    states: int = 1000
    """Start states."""

    trajectories: int = 10
    """Simulated trajectories from each leaf, for online rollout."""

    seed: int = EVALUATION_SEED
    """Seed of start states and noise."""

    device: str = "cpu"
    """Device to compute on, such as cpu or cuda:0."""


@dataclass(frozen=True)
class Reproduce:
    """Carry out one of the paper's experiments; the same command goes on with an interrupted one."""

    experiment: tyro.conf.Positional[Literal["table1", "architectures", "ablation", "optimum"]]
    """table1: the grids and two robots; architectures: API, pAPI-NT and pAPI-T; ablation: rollout and iteration apart; optimum:
    the line of 3, whose optimal cost is known."""

    scale: float = 0.05
    """Fraction of the paper's samples; 1 is the paper's."""

    settings: Literal["paper", "tuned"] = "tuned"
    """The paper's own settings, or this library's."""

    base: Literal["greedy", "urgency"] = "greedy"
    """Base policy that is improved first; the paper's is greedy."""

    problems: tuple[str, ...] = ()
    """Only these of the experiment's problems; none: all."""

    seed: int = 0
    """Seed of the training."""

    runs: Path = Path("runs")
    """Folder of the runs."""

    out: Path = Path("results")
    """Folder of tables, figures and numbers."""

    device: str = "cpu"
    """Device to compute on, such as cpu or cuda:0."""


def main(args: list[str] | None = None) -> int:
    """Run the command with ``args`` (default: the process's); returns the exit status, 2 for input that was refused."""
    torchrl_logger.setLevel("WARNING")
    commands = (
        Annotated[Train, tyro.conf.subcommand("train")]
        | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
        | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
    )
    command: Train | Evaluate | Reproduce = tyro.cli(commands, prog="torchrl-pomdp", args=args)
    try:
        if isinstance(command, Train):
            _train(command)
        elif isinstance(command, Evaluate):
            _evaluate(command)
        else:
            _reproduce(command)
    except ValueError as error:
        print(f"torchrl-pomdp: {error}", file=sys.stderr)
        return 2
    return 0


def _train(command: Train) -> None:
    run = TrainingRun(command.problem, command.algorithm, command.base, command.config, command.states, command.online_states)
    problem = run.make_problem(command.device)
    default = f"{command.problem}-{command.algorithm}-{command.base}-seed{command.config.seed}"
    out = command.out or Path("runs") / default
    print(f"{problem.name}: {problem.model.describe()}\nrun folder: {out}")
    comparisons = run.carry_out(out, device=command.device, progress=True, report=_tell)
    write_json(out / "provenance.json", provenance())
    results = [Result(name, comparison) for name, comparison in comparisons.items()]
    title = f"{problem.name}, {command.states} start states; below each policy its ratio to greedy"
    write_atomically(out / "costs.png", lambda path: cost_figure(results, title).savefig(path))
    best = load_checkpoint(out / "best.pt", device=command.device).policy if (out / "best.pt").is_file() else None
    _save_trajectory(problem, best or BASE_POLICIES[command.base](problem.model), out / "trajectory.png")
    print(f"\n{table(results)}\n\npictures: {out / 'costs.png'}, {out / 'trajectory.png'}")


def _tell(name: str, comparison: Comparison) -> None:
    low, high = comparison.ratio.interval
    print(f"{name}: {comparison.ratio.mean:.3f} of greedy ({low:.3f} … {high:.3f})", flush=True)


def _evaluate(command: Evaluate) -> None:
    problem, policy, name = _named_policy(command)
    policies: dict[str, Policy] = {base: make(problem.model) for base, make in BASE_POLICIES.items()}
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
            terminal_cost=NeverRepairCost(problem.model),
            progress=True,
            name=f"evaluate {name}",
        )
        for name, policy in policies.items()
    }
    print(f"{problem.name}: {problem.model.describe()}; {command.states} start states, seed {command.seed}\n")
    print(table([Result(name, compare(cost, costs["greedy"])) for name, cost in costs.items()]))


def _named_policy(command: Evaluate) -> tuple[Problem, TensorDictModuleBase, str]:
    """The problem, the policy and its name that ``evaluate`` was asked for."""
    if command.policy in BASE_POLICIES:
        problem = make_problem(command.problem, device=command.device)
        return problem, BASE_POLICIES[command.policy](problem.model), command.policy
    checkpoint = load_checkpoint(Path(command.policy), device=command.device)
    return checkpoint.problem, checkpoint.policy, f"{checkpoint.algorithm} {checkpoint.iteration}"


def _reproduce(command: Reproduce) -> None:
    experiment = EXPERIMENTS[command.experiment]
    text = reproduce(
        experiment,
        scale=command.scale,
        settings=command.settings,
        base=command.base,
        problems=command.problems,
        seed=command.seed,
        runs=command.runs,
        out=command.out,
        device=command.device,
        report=lambda run, name, comparison: _tell(f"{run}, {name}", comparison),
        progress=True,
    )
    print(f"\n{text}")


def _save_trajectory(problem: Problem, policy: Policy, path: Path) -> None:
    """Draw the trajectory of ``policy`` from the first start state of the evaluations."""
    env = BeliefEnv(problem.model, problem.start, seed=EVALUATION_SEED)
    y = env.reset(problem.start(fold(seed_keys(EVALUATION_SEED, torch.tensor(0)), 0)), set_state=True)
    with torch.no_grad():
        trajectory = env.rollout(200, policy, tensordict=y, auto_reset=False)
    figure = trajectory_figure(problem.model, trajectory, f"{problem.name}: one trajectory of the best policy")
    write_atomically(path, figure.savefig)


if __name__ == "__main__":
    sys.exit(main())
