"""A training run in a folder: everything it makes is kept as soon as it is there, and the same run goes on from there."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache, cached_property, partial
from os import PathLike
from pathlib import Path
from typing import Any, Literal, cast

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.record import CSVLogger

from torchrl_pomdp import __version__
from torchrl_pomdp.checks import check_callable, check_choice, check_flag, check_instance, check_integer, check_path
from torchrl_pomdp.collectors import OnLabels
from torchrl_pomdp.config import EVALUATION_SEED, MAX_STATES, PolicyIterationConfig
from torchrl_pomdp.evaluation import Comparison, compare, discounted_costs
from torchrl_pomdp.files import DamagedFileError, check_claimed, read_json, write_json
from torchrl_pomdp.identity import digest
from torchrl_pomdp.kept import keep, kept
from torchrl_pomdp.modules import PartitionedPolicy, PartitionedValue, Policy
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.provenance import note_provenance
from torchrl_pomdp.report.names import ALGORITHM_NAMES, is_own
from torchrl_pomdp.report.run_folder import read_iterations
from torchrl_pomdp.trainers.architecture import is_multiagent
from torchrl_pomdp.trainers.asynchronous import AsynchronousIteration
from torchrl_pomdp.trainers.checkpoint import (
    Checkpoint,
    check_run_folder,
    checkpoint_bytes,
    open_run_folder,
    problem_digest,
    save_checkpoint,
)
from torchrl_pomdp.trainers.plan import Improve
from torchrl_pomdp.trainers.policy_iteration import Iteration
from torchrl_pomdp.trainers.recipes import api, multiagent_rollouts, papi_nt, papi_t, r_nt, r_t
from torchrl_pomdp.workers import LOCAL, Workers

__all__ = ["ALGORITHMS", "TrainingRun"]

ALGORITHMS = dict(zip(ALGORITHM_NAMES, (papi_nt, papi_t, api), strict=True))
"""The algorithms that learn, by name."""

Report = Callable[[str, Comparison], None]


@dataclass(frozen=True)
class TrainingRun:
    """What decides the results of a training run.

    Raises:
        TypeError: if something is of the wrong kind; the message names it.
        ValueError: if a name is unknown or a number out of range; the message names it.

    Examples:
        >>> import tempfile
        >>> config = PolicyIterationConfig(1, samples_per_part=40, least_steps=1, validation_states=50)
        >>> from torchrl_pomdp.problems import make_problem
        >>> run = TrainingRun(make_problem("line3"), config=config, states=20, online_states=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     list(run.carry_out(Path(folder) / "run"))
        ['greedy', 'urgency', 'R-NT of greedy', 'pAPI-NT 1']
    """

    problem: Problem
    """The problem; the algorithm API takes it with a single part."""

    algorithm: Literal["pAPI-NT", "pAPI-T", "API"] = "pAPI-NT"
    """Policy iteration: pAPI-NT (partitioned), pAPI-T (partitioned, truncated simulations), API (one part)."""

    base: str = cast(str, None)
    """Name of the base policy that is improved first; None: the first of the problem's."""

    config: PolicyIterationConfig = field(default_factory=PolicyIterationConfig)
    """The numbers of the policy iteration."""

    states: int = 1000
    """Start states of each evaluation."""

    rollout_states: int = 1000
    """Start states of the evaluation of online rollout of the base policy: the first of the ``states``, and no more; 0 for
    none."""

    online_states: int = 1000
    """Start states of the evaluation of online rollout on top of the trained policy, which takes longest: the first of the
    ``states``, and no more; 0 for none. Where the base policy is the best one, only if ``rollout_states`` are fewer."""

    online_trajectories: int = 10
    """Simulated trajectories of each control in online rollout."""

    staleness: int | None = None
    """How many versions a part may be ahead of the last one: asynchronous policy iteration, see
    :class:`~torchrl_pomdp.trainers.AsynchronousIteration`. None: all parts together, and a seed gives the same result again."""

    def __post_init__(self) -> None:
        check_instance("problem", self.problem, Problem)
        check_choice("algorithm", self.algorithm, ALGORITHMS)
        if self.algorithm == "API":
            object.__setattr__(self, "problem", self.problem.unpartitioned())
        base = self.problem.baseline if self.base is None else check_choice("base", self.base, self.problem.base_policies)
        object.__setattr__(self, "base", base)
        check_instance("config", self.config, PolicyIterationConfig)
        for name in self.problem.base_policies:
            if is_own(name):
                raise ValueError(f"base_policies must have names that no policy of a run has, such as 'API 1', got {name!r}")
        check_integer("states", self.states, 2, MAX_STATES)
        check_integer("rollout_states", self.rollout_states, 0, MAX_STATES)
        check_integer("online_states", self.online_states, 0, MAX_STATES)
        check_integer("online_trajectories", self.online_trajectories, 1, 10**6)
        if self.staleness is not None:
            check_integer("staleness", self.staleness, 0, 10**6)

    def to_dict(self) -> dict[str, Any]:
        """All numbers and names, for JSON; the problem by its name and its spec."""
        numbers = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {**numbers, "problem": self.problem.name, "spec": self.problem.spec, "config": asdict(self.config)}

    def costs(self, folder: str | PathLike[str], policies: Iterable[str]) -> dict[str, Tensor]:
        """Costs by evaluated policy, from the start states of the evaluation, of a run that was carried out in ``folder``.

        Raises:
            DamagedFileError: if they are not what this run has written there.
        """
        path, identity = check_path("folder", folder), _identity(self)
        found = {}
        for name in policies:
            file = _costs_file(path, name)
            content = kept(file, _owner(identity, name))
            if content is None:
                raise DamagedFileError(f"{file} does not hold the costs of this run: carry it out again")
            found[name] = content["costs"]
        return found

    def check(self, folder: str | PathLike[str]) -> None:
        """Raise ``TypeError`` or ``ValueError`` where :meth:`carry_out` would at once; nothing is written."""
        check_run_folder(folder, _identity(self))
        _check_kept(self)

    def carry_out(
        self,
        folder: str | PathLike[str],
        *,
        progress: bool = False,
        report: Report = lambda name, comparison: None,
        on_labels: OnLabels | None = None,
        workers: Workers = LOCAL,
    ) -> dict[str, Comparison]:
        """Train and evaluate, or go on where an interrupted run with the same numbers stopped.

        The best policy is kept in ``best.pt``; it is the base policy as long as no iteration was accepted.

        Args:
            folder: folder of the run; new, empty, or that of the same run.

        Keyword Args:
            progress: whether to show progress bars.
            report: called with the name of a policy and its comparison with the baseline as soon as it is known.
            on_labels: see :class:`PolicyIteration`.
            workers: who does the work; they change no result.

        Returns:
            comparisons with the baseline, the problem's first base policy, by policy, in the order of the evaluations; online
            rollout on fewer states.

        Raises:
            TypeError: if something is of the wrong kind.
            ValueError: if the folder holds something else, or what is trained could not be kept: the problem has a spec, but
                not the base policies that this describes, or networks of the base policy are not of the sizes and the encoder
                that ``config`` has.
            OSError: if the folder cannot be written, or was deleted while the run went on.
        """
        folder = check_path("folder", folder)
        check_flag("progress", progress)
        check_callable("report", report)
        if on_labels is not None:
            check_callable("on_labels", on_labels)
        check_instance("workers", workers, Workers).check_device(self.problem.model.device)
        _check_kept(self)
        identity = _identity(self)
        path = open_run_folder(folder, identity)
        execution = _Execution(self, self.problem, path, identity, progress, report, on_labels, workers)
        try:
            return execution.carry_out()
        except OSError as error:
            execution.check_folder(error)
            raise


@dataclass
class _Execution:
    run: TrainingRun
    problem: Problem
    folder: Path
    identity: dict[str, Any]
    progress: bool
    report: Report
    on_labels: OnLabels | None
    workers: Workers
    results: dict[str, Comparison] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # What computes is noted once; not at all where everything was there already.
        self._note = cache(partial(note_provenance, self.folder))

    def carry_out(self) -> dict[str, Comparison]:
        run, bases = self.run, self.problem.base_policies
        for name, policy in bases.items():
            self._compare(name, policy, run.states)
        base = bases[run.base]
        for name, online in self._online(base).items():
            self._compare(f"{name} of {run.base}", online, run.rollout_states)
        best, policy = self._train(base)
        # On top of the base policy it is evaluated already.
        if best != run.base or min(run.online_states, run.states) > run.rollout_states:
            # The first one: what the networks have been taught.
            name, online = next(iter(self._online(policy).items()))
            self._compare(f"{best} + {name}", online, run.online_states)
        self._write_metrics({})
        return self.results

    def _online(self, policy: TensorDictModuleBase) -> dict[str, Policy]:
        """Online rollouts of a policy by name; first the one that makes the labels."""
        run, problem = self.run, self.problem
        several = is_multiagent(problem, run.config)
        found: dict[str, Policy] = {}
        if several:
            found |= multiagent_rollouts(problem, policy, run.config, run.online_trajectories)
        if problem.model.enumerable:
            stages = run.config.stages
            cut = {} if stages is None else {"max_steps": stages, "terminal_cost": problem.pessimistic_cost}
            found["R-NT"] = r_nt(problem, policy, trajectories=run.online_trajectories, **cut)
        return found

    def _train(self, base: TensorDictModuleBase) -> tuple[str, TensorDictModuleBase]:
        """Carry out the iterations, keep and evaluate their policies; name and policy of the best one."""
        run = self.run
        best = run.base
        together = ALGORITHMS[run.algorithm](
            self.problem,
            run.config,
            base,
            folder=self.folder,
            logger=CSVLogger("log", log_dir=str(self.folder)),
            progress=self.progress,
            on_labels=self.on_labels,
            workers=self.workers,
        )
        training = together if run.staleness is None else AsynchronousIteration(together, run.staleness)
        kept_best = untrained = _base_checkpoint(run)
        if not (self.folder / "best.pt").is_file():
            self._keep("best.pt", untrained)
        # What is known already, when a run is carried out again, does not become less meanwhile.
        summaries, known = [], self._known()
        if not (self.folder / f"iteration-{run.config.iterations}.pt").is_file():
            self._note()
        for iteration in training:
            name = f"{run.algorithm} {iteration.number}"
            checkpoint = Checkpoint(
                self.problem, run.config, run.algorithm, iteration.number, iteration.policy, iteration.value
            )
            self._keep(f"iteration-{iteration.number}.pt", checkpoint)
            if iteration.accepted:
                best, kept_best = name, checkpoint
                if iteration.number > known:
                    self._keep("best.pt", checkpoint)
            if iteration.number == 1 and together.plan[-1].truncation is not None:
                self._compare_truncated(base, iteration.value)
            self._compare(name, iteration.policy, run.states)
            summaries.append({**_summary(iteration), "staleness": run.staleness})
            if iteration.number >= known:
                write_json(self.folder / "iterations.json", summaries)
        self._keep("best.pt", kept_best)
        return best, training.best

    def _known(self) -> int:
        """The number of iterations that the folder tells of."""
        try:
            return len(read_iterations(self.folder / "iterations.json"))
        except DamagedFileError:
            return 0

    def _compare_truncated(self, base: TensorDictModuleBase, value: PartitionedValue) -> None:
        """Evaluate what the networks of the startgame have learnt from, played online, where simulations are cut."""
        run = self.run
        truncated = r_t(self.problem, base, value, trajectories=run.online_trajectories, max_steps=run.config.stages)
        self._compare(f"R-T of {run.base}", truncated, run.rollout_states)

    def _keep(self, name: str, checkpoint: Checkpoint) -> None:
        self.check_folder()
        save_checkpoint(self.folder / name, checkpoint)

    def check_folder(self, cause: BaseException | None = None) -> None:
        """Raise if the folder is no longer the one that the run has opened."""
        check_claimed(self.folder / "config.json", cause)

    @cached_property
    def _baseline(self) -> Tensor:
        name = self.problem.baseline
        return self._costs(name, self.problem.base_policies[name], self.run.states)

    def _compare(self, name: str, policy: Policy, states: int) -> None:
        """Add a policy's comparison with the baseline, and bring the folder's metrics up to date; nothing without states."""
        if states == 0:
            return
        costs = self._costs(name, policy, min(states, self.run.states))
        self.results[name] = compare(costs, self._baseline[: costs.numel()])
        self._write_metrics(self._stored)
        self.report(name, self.results[name])

    @cached_property
    def _stored(self) -> dict[str, Any]:
        """The metrics that the folder has when the run is carried out again."""
        path = self.folder / "metrics.json"
        try:
            return read_json(path) if path.is_file() else {}
        except DamagedFileError:
            return {}

    def _write_metrics(self, stored: dict[str, Any]) -> None:
        """Bring the folder's metrics up to date, those that it has included."""
        self.check_folder()
        own = {key: asdict(value) for key, value in self.results.items()}
        write_json(self.folder / "metrics.json", stored | own)

    def _costs(self, name: str, policy: Policy, states: int) -> Tensor:
        """Costs from the first evaluation states, computed once for each policy of a name."""
        path, owner = _costs_file(self.folder, name), _owner(self.identity, name)
        # A name does not say which networks it stands for: in an asynchronous run that depends on time.
        own, content = digest(policy), kept(path, owner)
        if content is not None and content["policy"] == own:
            return content["costs"]
        self._note()
        costs = discounted_costs(
            self.problem.model,
            policy,
            self.problem.start,
            num_states=states,
            seed=EVALUATION_SEED,
            terminal_cost=self.problem.evaluation_cost,
            progress=self.progress,
            name=f"evaluate {name}",
            workers=self.workers,
        ).cpu()
        self.check_folder()
        keep(path, owner, {"policy": own, "costs": costs})
        return costs


def _base_checkpoint(run: TrainingRun) -> Checkpoint:
    """The base policy, the best one as long as no iteration was accepted."""
    problem = run.problem
    value = PartitionedValue([problem.pessimistic_cost] * problem.partition.num_parts)
    return Checkpoint(problem, run.config, run.algorithm, 0, problem.base_policies[run.base], value)


def _check_kept(run: TrainingRun) -> None:
    """Raise unless the base policy and the networks of the first iteration can be kept, which would come out after hours."""
    base = _base_checkpoint(run)
    checkpoint_bytes(base)
    training = ALGORITHMS[run.algorithm](run.problem, run.config, base.policy)
    local = list(training._base)
    for index, step in enumerate(training.plan):
        for part in step.parts if isinstance(step, Improve) else ():
            local[part] = training._initial(index, part, local, [], 1)
    networks = copy.deepcopy(PartitionedPolicy(local)).eval()
    # Weights change, as in training: those of the base policy would be kept by its name.
    with torch.no_grad():
        for weight in networks.parameters():
            weight.add_(1.0)
    try:
        checkpoint_bytes(replace(base, iteration=1, policy=networks))
    except ValueError as error:
        raise ValueError(
            f"config must have the sizes and the encoder of the networks of the base policy {run.base!r}, which are trained "
            f"further, it has others: {error}"
        ) from error


def _identity(run: TrainingRun) -> dict[str, Any]:
    """All that decides the results of a run, as JSON."""
    bases = {name: digest(policy) for name, policy in run.problem.base_policies.items()}
    own = {"version": __version__, "problem_digest": problem_digest(run.problem), "base_policies": bases}
    return {**run.to_dict(), **own}


def _costs_file(folder: Path, policy: str) -> Path:
    return folder / "costs" / f"{policy}.pt"


def _owner(identity: dict[str, Any], policy: str) -> str:
    """Whose costs a file holds: those of a policy in a run."""
    return digest([identity, policy])


def _summary(iteration: Iteration) -> dict[str, Any]:
    """An iteration's numbers, for JSON."""
    return {
        "number": iteration.number,
        "accepted": iteration.accepted,
        "reason": iteration.reason,
        "comparison": asdict(iteration.comparison),
        "parts": {name: record.to_dict() for name, record in iteration.records.items()},
    }
