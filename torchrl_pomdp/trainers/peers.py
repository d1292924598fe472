r"""Every method on one problem, from the same start states and under the same noise (paper, Section VI-D).

============== ==================================================================================================
name           what it is
============== ==================================================================================================
greedy, …      the problem's base policies
R-NT, R-T      online rollout of the last base policy, without truncation, and with it where there are value networks
pAPI-NT k, …   the trained policy, and online rollout on top of it
POMCP, DESPOT  tree searches: ``orig`` with every control that can be carried out and random play, as out of the box,
               where that is more than the legal ones;
               ``mod`` with legal controls and random play; ``fair`` with legal controls and a good base policy
PPO            masked proximal policy optimisation, from the command line with as many belief steps as the labels of policy
               iteration took; visits and validations of policy iteration come on top of them
============== ==================================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from os import PathLike
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_pomdp import __version__
from torchrl_pomdp.checks import (
    check_callable,
    check_choice,
    check_flag,
    check_instance,
    check_integer,
    check_number,
    check_path,
    check_seed,
    check_sequence,
)
from torchrl_pomdp.config import EVALUATION_SEED, MAX_STATES
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.identity import digest
from torchrl_pomdp.kept import keep, kept
from torchrl_pomdp.modules import Policy, RolloutPolicy, ValueNetwork
from torchrl_pomdp.modules.lookahead import simulated_steps
from torchrl_pomdp.modules.partitioned import local_policies
from torchrl_pomdp.modules.threads import kept_threads
from torchrl_pomdp.noise import fold, seed_keys
from torchrl_pomdp.planners import DESPOT, POMCP
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.provenance import note_provenance
from torchrl_pomdp.report.peers import Outcome
from torchrl_pomdp.trainers.checkpoint import Checkpoint, open_run_folder, problem_digest
from torchrl_pomdp.trainers.ppo import BATCH, ppo, training_owner
from torchrl_pomdp.trainers.recipes import r_t

__all__ = ["compare_peers"]

# Start states whose costs are kept at once: an interrupted comparison loses no more.
_BLOCK = 10
# Decisions whose time is taken.
_TIMED = 15
# Most trajectories of an online decision; its time ends it.
_TRAJECTORIES = 4096
# Most belief steps of PPO, which make a month.
_MOST_STEPS = 10**10
# Most scenarios of DESPOT, as its authors have them.
_SCENARIOS = 500


@dataclass(frozen=True)
class _Peer:
    """A method's policy, and whether it may do all that can be carried out."""

    policy: Policy
    unrestricted: bool = False


def compare_peers(
    problem: Problem,
    folder: str | PathLike[str],
    *,
    checkpoint: Checkpoint | None = None,
    ppo_steps: int | None = None,
    methods: Sequence[str] | None = None,
    states: int = 100,
    seconds: float = 0.1,
    seed: int = EVALUATION_SEED,
    report: Callable[[str, Outcome], None] = lambda name, outcome: None,
    progress: bool = False,
) -> dict[str, Outcome]:
    """Compare all methods, or go on with an interrupted comparison.

    Args:
        problem: the problem.
        folder: where results are kept; new, empty, or that of the same comparison.

    Keyword Args:
        checkpoint: a trained policy of the problem, with its parts or with a single one; None: without one.
        ppo_steps: belief steps that PPO is trained for; None: without PPO.
        methods: names of the methods to compare with the baseline; None: all.
        states: start states.
        seconds: time of each decision of the methods that plan online. Rollout makes its first trajectories in any case, which
            takes some tenths of a second for models without a compiled loop.
        seed: seed of start states and noise, and of PPO.
        report: called with the name of a method and its outcome as soon as it is known.
        progress: whether to show progress bars.

    Returns:
        outcomes by method, the baseline first.

    Raises:
        ImportError: if numba, which the extra ``fast`` installs, is missing.
        TypeError: if an argument is of the wrong kind.
        ValueError: if a number is out of range, a method is not there, the folder holds something else, the checkpoint is of
            another problem, a base policy is named like another method, or model or last base policy have no scalar twin.

    Examples:
        >>> import tempfile
        >>> from torchrl_pomdp.problems import make_problem
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     outcomes = compare_peers(make_problem("line3"), folder, states=2, seconds=0.001)
        >>> list(outcomes)[:4]
        ['greedy', 'urgency', 'R-NT of urgency', 'POMCP orig']
    """
    check_instance("problem", problem, Problem)
    check_integer("states", states, 2, MAX_STATES)
    check_number("seconds", seconds, "(0, inf)")
    check_integer("seed", seed)
    check_callable("report", report)
    check_flag("progress", progress)
    if checkpoint is not None:
        check_instance("checkpoint", checkpoint, Checkpoint)
        # What API has trained does not know of parts.
        if problem_digest(checkpoint.problem) not in map(problem_digest, (problem, problem.unpartitioned())):
            raise ValueError(f"checkpoint must be of the problem {problem.name}, got one of {checkpoint.problem.name}")
    if ppo_steps is not None:
        check_integer("ppo_steps", ppo_steps, BATCH, _MOST_STEPS)
        check_seed("seed", seed)
    # Whatever cannot be made is refused before anything is written.
    peers: dict[str, _Peer | None] = {**_peers(problem, checkpoint, seconds)}
    if ppo_steps is not None:
        # Last, since its training takes longest.
        peers["PPO"] = None
    names = [problem.baseline, *(peers if methods is None else _chosen(methods, peers))]
    found = {"problem": problem_digest(problem), "seconds": seconds, "seed": seed}
    path = open_run_folder(check_path("folder", folder), found)
    execution = _Execution(problem, path, states, seed, progress)
    outcomes: dict[str, Outcome] = {}
    for name in dict.fromkeys(names):
        peer = peers[name] or _Peer(execution.ppo(ppo_steps or 0))
        outcomes[name] = execution.outcome(name, peer)
        report(name, outcomes[name])
    return outcomes


def _chosen(methods: Sequence[str], peers: Iterable[str]) -> list[str]:
    """The methods asked for, in the order of all."""
    for name in check_sequence("methods", methods, str, least=1):
        check_choice("methods", name, peers)
    return [name for name in peers if name in methods]


def _peers(problem: Problem, checkpoint: Checkpoint | None, seconds: float) -> dict[str, _Peer]:
    """The methods by name, but for PPO."""
    model, bases = problem.model, problem.base_policies
    base_name, base = list(bases.items())[-1]
    online: dict[str, Any] = {"trajectories": _TRAJECTORIES, "allocation": "adaptive", "seconds": seconds}
    peers: dict[str, _Peer] = {}
    peers[f"R-NT of {base_name}"] = _Peer(RolloutPolicy(model, base, **online))
    if checkpoint is not None:
        # Without value networks there is nothing to cut simulations by.
        earlier = [part for stage in checkpoint.problem.partition.stages[:-1] for part in stage]
        if earlier and all(isinstance(checkpoint.value.values[part], ValueNetwork) for part in earlier):
            peers[f"R-T of {base_name}"] = _Peer(r_t(problem, base, checkpoint.value, **online))
        policy = checkpoint.policy
        if checkpoint.problem.partition.num_parts < problem.partition.num_parts:
            (policy,) = local_policies("checkpoint.policy", policy, 1)
        peers[checkpoint.name] = _Peer(policy)
        peers[f"{checkpoint.name} + R-NT"] = _Peer(RolloutPolicy(model, policy, **online))
    everything = model.unrestricted()
    for search in (POMCP, DESPOT):
        name = search.__name__
        options: dict[str, Any] = {"scenarios": _scenarios(seconds)} if search is DESPOT else {}
        as_they_come: dict[str, Any] = {**options, "bound": "trivial"} if search is DESPOT else {}
        if everything is not model:
            peers[f"{name} orig"] = _Peer(search(everything, None, seconds=seconds, **as_they_come), unrestricted=True)
        peers[f"{name} mod"] = _Peer(search(model, None, seconds=seconds, **as_they_come))
        peers[f"{name} fair"] = _Peer(search(model, base, seconds=seconds, **options))
    for name, policy in bases.items():
        # A checkpoint may hold a base policy, by its name.
        if name == "PPO" or (name in peers and digest(peers[name].policy) != digest(policy)):
            raise ValueError(f"base_policies must have names that no other method has, got {name!r}")
    return {name: _Peer(policy) for name, policy in bases.items()} | peers


def _scenarios(seconds: float) -> int:
    """Scenarios that DESPOT has time for: the root alone takes a simulation of each for every control."""
    return min(_SCENARIOS, max(10, round(10_000 * seconds)))


class _Counted:
    """A policy whose decisions are counted, those in terminal states left out."""

    def __init__(self, policy: Policy, model: BeliefModel) -> None:
        self.policy, self.model, self.decisions = policy, model, 0
        self.in_keys = getattr(policy, "in_keys", ())

    def __call__(self, y: TensorDictBase) -> TensorDictBase:
        self.decisions += int((~self.model.is_terminal(y)).sum())
        return self.policy(y)


@dataclass
class _Execution:
    problem: Problem
    folder: Path
    states: int
    seed: int
    progress: bool
    _baseline: torch.Tensor | None = None

    def __post_init__(self) -> None:
        # What computes is noted once; not at all where everything was there already.
        self._note = cache(partial(note_provenance, self.folder))

    def ppo(self, steps: int) -> Policy:
        """PPO, trained as far as its file does not have it already."""
        path, batches = self.folder / f"ppo-{steps}.pt", steps // BATCH
        content = kept(path, training_owner(self.problem, batches, self.seed))
        if content is None:
            # Like all else in the folder, it is made again where it is damaged or another version's.
            path.unlink(missing_ok=True)
        if content is None or content["done"] < batches:
            self._note()
        return ppo(self.problem, steps=steps, seed=self.seed, path=path, progress=self.progress)

    def outcome(self, name: str, peer: _Peer) -> Outcome:
        """A method's costs, from the folder as far as they are there."""
        owner = digest([__version__, problem_digest(self.problem), name, peer.policy, self.seed])
        blocks = list(self._blocks(name, peer, owner))
        costs = torch.cat([block["costs"] for block in blocks])
        if self._baseline is None:
            self._baseline = costs
        decisions, steps = (sum(block[key] for block in blocks) for key in ("decisions", "steps"))
        taken = self._time(name, peer.policy, owner)
        return Outcome(compare(costs, self._baseline), taken, steps / max(decisions, 1), tuple(costs.tolist()))

    def _blocks(self, name: str, peer: _Peer, owner: str) -> Iterator[dict[str, Any]]:
        model = self.problem.model.unrestricted() if peer.unrestricted else self.problem.model
        for first in range(0, self.states, _BLOCK):
            count = min(_BLOCK, self.states - first)
            path = self.folder / name / f"{first:07d}-{count}.pt"
            block = kept(path, f"{owner} {first}")
            if block is None:
                self._note()
                block = self._evaluate(f"{name}, from state {first}", model, peer.policy, first, count)
                keep(path, f"{owner} {first}", block)
            yield block

    def _evaluate(self, name: str, model: BeliefModel, policy: Policy, first: int, count: int) -> dict[str, Any]:
        simulates = simulated_steps(policy) is not None
        counted = _Counted(policy, model) if simulates else policy
        before = simulated_steps(policy) or 0
        costs = discounted_costs(
            model,
            counted,
            self.problem.start,
            num_states=count,
            first=first,
            seed=self.seed,
            terminal_cost=self.problem.evaluation_cost,
            progress=self.progress,
            name=name,
        )
        steps = (simulated_steps(policy) or 0) - before
        return {"costs": costs.cpu(), "decisions": counted.decisions if isinstance(counted, _Counted) else 0, "steps": steps}

    def _time(self, name: str, policy: Policy, owner: str) -> float:
        """Median time of a decision in the first start states, taken once."""
        path = self.folder / name / "time.pt"
        content = kept(path, owner)
        if content is None:
            self._note()
            model = self.problem.model
            keys = seed_keys(self.seed, torch.arange(_TIMED + 1, device=model.device))
            y = model.derive(model.drawn(self.problem.start, fold(keys, 0)))
            with kept_threads(1), torch.no_grad():
                # The first decision compiles.
                times = [_seconds(policy, y[number : number + 1]) for number in range(_TIMED + 1)][1:]
            content = {"seconds": median(times)}
            keep(path, owner, content)
        return float(content["seconds"])


def _seconds(policy: Policy, y: TensorDictBase) -> float:
    begin = perf_counter()
    policy(y.clone())
    return perf_counter() - begin
