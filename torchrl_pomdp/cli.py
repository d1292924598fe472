"""The command ``torchrl-pomdp``: train, evaluate, compare and show policies, reproduce the paper's experiments, list the
problems.

Nothing that takes long to import is imported before the arguments are read.
"""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from torchrl_pomdp.config import EVALUATION_SEED, PolicyIterationConfig


@dataclass(frozen=True)
class Numbers(PolicyIterationConfig):
    """The numbers of the policy iteration."""

    def __post_init__(self) -> None:
        """Checked once all arguments are read, with them."""


@dataclass(frozen=True)
class Train:
    """Train policies by approximate policy iteration; the same command goes on with an interrupted run."""

    problem: tyro.conf.Positional[str]
    """The problem: a name such as linear20, see the command problems; a file .toml or .POMDP; or module:function, your code."""

    algorithm: Literal["pAPI-NT", "pAPI-T", "API"] = "pAPI-NT"
    """pAPI-NT: partitioned; pAPI-T: partitioned, with simulations truncated at the endgame; API: a single part."""

    base: str | None = None
    """Base policy that is improved first; by default the problem's first, such as greedy."""

    config: tyro.conf.OmitArgPrefixes[Numbers] = field(default_factory=Numbers)

    out: Path | None = None
    """Folder of the run: new, empty, or that of the same run; by default runs/PROBLEM-ALGORITHM-BASE-seedSEED."""

    states: int = 1000
    """Start states of each evaluation."""

    rollout_states: int = 1000
    """Start states on which online rollout of the base policy is evaluated, slow where it is not compiled; 0 for not at all."""

    online_states: int = 0
    """Start states on which online rollout of the trained policy is evaluated, which takes long; 0 for not at all."""

    device: str = "cpu"
    """Device to compute on, such as cpu or cuda:0."""

    backend: Literal["local", "ray"] = "local"
    """Who does the work: this process; or the workers of a Ray cluster, with the same results. Needs the extra ray."""

    address: str | None = None
    """Address of a running Ray cluster, such as 10.0.0.1:6379; by default one is started on this machine."""

    workers: int | None = None
    """Ray workers that label and evaluate at the same time; by default as many as the cluster has CPUs."""

    staleness: int | None = None
    """Each part trains at its own pace, at most so many versions ahead; a seed does not give the same result again."""


@dataclass(frozen=True)
class Evaluate:
    """Compare a policy with the problem's base policies from the same start states."""

    policy: tyro.conf.Positional[str]
    """Path of a checkpoint, or with --problem the name of a base policy, such as greedy."""

    online: bool = False
    """Whether the policy is improved online, by one-step lookahead with rollout."""

    problem: str | None = None
    """Problem, as for the command train; a checkpoint knows its own unless it is of one's own code."""

    states: int = 1000
    """Start states."""

    trajectories: int = 10
    """Simulated trajectories from each leaf, for online rollout."""

    seed: int = EVALUATION_SEED
    """Seed of start states and noise."""

    device: str = "cpu"
    """Device to compute on, such as cpu or cuda:0."""


@dataclass(frozen=True)
class Compare:
    """Compare all methods on a problem: base policies, rollout, a trained policy, POMCP, DESPOT and PPO; the same command goes
    on with an interrupted comparison. Results of another one are not written over: name another folder by --out.
    """

    problem: tyro.conf.Positional[str]
    """The problem, as for the command train."""

    checkpoint: Path | None = None
    """A trained policy; with it come online rollout on top of it, and PPO with as many belief steps as its labels took."""

    methods: tuple[str, ...] | None = None
    """Names of the methods to compare with the baseline, as the table has them; all if left out."""

    states: int = 100
    """Start states."""

    seconds: float = 0.1
    """Time of each decision of the methods that plan online."""

    seed: int = EVALUATION_SEED
    """Seed of start states and noise."""

    runs: Path = Path("runs")
    """Folder of the comparison's own folder."""

    out: Path = Path("results")
    """Folder of the results; table, figures and numbers go to the folder compare in it."""


@dataclass(frozen=True)
class Reproduce:
    """Carry out one of the paper's experiments; the same command goes on with an interrupted one."""

    experiment: tyro.conf.Positional[Literal["table1", "architectures", "ablation", "optimum", "multirobot", "extensions"]]
    """Which one:
    - table1: the grids and two robots;
    - architectures: API, pAPI-NT and pAPI-T;
    - ablation: rollout and iteration apart;
    - optimum: the line of 3, whose optimal cost is known;
    - multirobot: 4, 8 and 10 robots on a network;
    - extensions: obstacles, repairs that may fail, locations of many kinds."""

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
    """Folder of the results; tables, figures and numbers go to the experiment's folder in it."""

    device: str = "cpu"
    """Device to compute on, such as cpu or cuda:0."""


@dataclass(frozen=True)
class Changes:
    """Measure what online rollout gains where the model has changed under an old policy, without training."""

    states: int = 1000
    """Start states."""

    trajectories: int = 10
    """Simulated trajectories of each control."""

    out: Path = Path("results")
    """Folder of the results; the table goes to the folder changes in it."""


@dataclass(frozen=True)
class Report:
    """Write one page about a training run, report.html in its folder: costs, parts, where policies disagree, and a player of
    trajectories.
    """

    run: tyro.conf.Positional[Path]
    """Folder of the run, which may be unfinished."""

    problem: str | None = None
    """Problem, as for the command train; a run knows its own unless it is of one's own code."""

    animation: Path | None = None
    """Also write trajectories of both policies, side by side, to this file .gif, or .mp4 by ffmpeg; of repair problems."""

    stages: int = 100
    """The most stages of the animation."""


@dataclass(frozen=True)
class Problems:
    """List the known problems with their numbers of states, controls and observations."""


@contextmanager
def _interrupted_by_sigterm() -> Iterator[None]:
    """Let SIGTERM, a batch system's way to end a program, do what Ctrl-C does: temporary files go, workers are released."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        # Python knows no handler that something else has installed.
        signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)


def main(args: list[str] | None = None) -> int:
    """Run the command with ``args`` (default: the process's); returns the exit status: 2 for input that was refused, 1 for
    work that has failed elsewhere, 130 for Ctrl-C and SIGTERM, 141 if nobody reads the output any more.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        # What a terminal cannot show is no reason to lose a table.
        sys.stdout.reconfigure(errors="replace")
    choices = (
        Annotated[Train, tyro.conf.subcommand("train")]
        | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
        | Annotated[Compare, tyro.conf.subcommand("compare")]
        | Annotated[Changes, tyro.conf.subcommand("changes")]
        | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
        | Annotated[Report, tyro.conf.subcommand("report")]
        | Annotated[Problems, tyro.conf.subcommand("problems")]
    )
    about = (
        "Policies for very large POMDPs by lookahead, rollout and partitioned policy iteration. "
        "`torchrl-pomdp COMMAND --help` lists the options of a command; "
        "`--tyro-print-completion bash` (or zsh, tcsh) prints the completion for a shell."
    )
    command: Train | Evaluate | Compare | Changes | Reproduce | Report | Problems = tyro.cli(
        choices, prog="torchrl-pomdp", description=about, args=args
    )
    try:
        from torchrl import logger

        from torchrl_pomdp import commands
        from torchrl_pomdp.workers import WorkerError
    except KeyboardInterrupt:
        return 130
    logger.setLevel("WARNING")
    actions: dict[type, Callable[[Any], None]] = {
        Train: commands.train,
        Evaluate: commands.evaluate,
        Compare: commands.compare,
        Changes: commands.changes,
        Reproduce: commands.reproduce,
        Report: commands.report,
        Problems: lambda command: commands.problems(),
    }
    try:
        with _interrupted_by_sigterm():
            actions[type(command)](command)
            sys.stdout.flush()
    except BrokenPipeError:
        # As by `| head`. What is left to write goes nowhere, so that the interpreter need not complain about it at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (ValueError, TypeError, OSError, ImportError) as error:
        print(f"torchrl-pomdp: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except WorkerError as error:
        print(f"torchrl-pomdp: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        goes_on = isinstance(command, (Train, Compare, Reproduce))
        print(f"\ntorchrl-pomdp: interrupted{'; the same command goes on' if goes_on else ''}", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
