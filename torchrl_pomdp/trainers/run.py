"""A training run in a folder: everything it makes is kept as soon as it is there, and the same run goes on from there."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.record import CSVLogger

from torchrl_pomdp.collectors import OnLabels
from torchrl_pomdp.envs import Problem, make_problem
from torchrl_pomdp.evaluation import Comparison, compare, discounted_costs
from torchrl_pomdp.files import load_tensors, save_tensors, write_json
from torchrl_pomdp.modules import GreedyRepair, NeverRepairCost, Policy, UrgencyRepair
from torchrl_pomdp.trainers.checkpoint import Checkpoint, open_run_folder, save_checkpoint
from torchrl_pomdp.trainers.config import PolicyIterationConfig
from torchrl_pomdp.trainers.policy_iteration import Iteration
from torchrl_pomdp.trainers.recipes import api, papi_nt, papi_t, r_nt, r_t

__all__ = ["ALGORITHMS", "BASE_POLICIES", "EVALUATION_SEED", "TrainingRun"]

ALGORITHMS = {"pAPI-NT": papi_nt, "pAPI-T": papi_t, "API": api}
"""The algorithms that learn, by name."""

BASE_POLICIES: dict[str, Callable[..., TensorDictModuleBase]] = {"greedy": GreedyRepair, "urgency": UrgencyRepair}
"""The base policies by name; made from the model."""

# Start states of evaluations are drawn under this seed, whatever the training's.
EVALUATION_SEED = 20200

Report = Callable[[str, Comparison], None]


@dataclass(frozen=True)
class TrainingRun:
    """What decides the results of a training run.

    Examples:
        >>> import tempfile
        >>> config = PolicyIterationConfig(1, samples_per_part=40, least_steps=1, validation_states=50)
        >>> run = TrainingRun("line3", config=config, states=20, online_states=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     list(run.carry_out(Path(folder) / "run"))
        ['greedy', 'urgency', 'R-NT of greedy', 'pAPI-NT 1']
    """

    problem: str
    """Name of the problem, such as linear20."""

    algorithm: Literal["pAPI-NT", "pAPI-T", "API"] = "pAPI-NT"
    """Policy iteration: pAPI-NT (partitioned), pAPI-T (partitioned, truncated simulations), API (one part)."""

    base: Literal["greedy", "urgency"] = "greedy"
    """Base policy that is improved first."""

    config: PolicyIterationConfig = field(default_factory=PolicyIterationConfig)
    """The numbers of the policy iteration."""

    states: int = 1000
    """Start states of each evaluation."""

    online_states: int = 1000
    """Start states of the evaluation of online rollout on top of the trained policy, which takes longest: the first of the
    ``states``, and no more; 0 for none."""

    online_trajectories: int = 10
    """Simulated trajectories of each control in online rollout."""

    def make_problem(self, device: torch.device | str = "cpu") -> Problem:
        """The problem, partitioned as the algorithm needs it."""
        return make_problem(self.problem, partitioned=self.algorithm != "API", device=device)

    def costs(self, folder: Path, policies: Iterable[str]) -> dict[str, Tensor]:
        """Costs by evaluated policy, from the start states of the evaluation, of a run that was carried out in ``folder``."""
        return {name: load_tensors(_costs_file(folder, name)) for name in policies}

    def carry_out(
        self,
        folder: Path,
        *,
        device: torch.device | str = "cpu",
        progress: bool = False,
        report: Report = lambda name, comparison: None,
        on_labels: OnLabels | None = None,
    ) -> dict[str, Comparison]:
        """Train and evaluate, or go on where an interrupted run with the same numbers stopped.

        Args:
            folder: folder of the run; new, empty, or that of the same run.

        Keyword Args:
            device: where to compute.
            progress: whether to show progress bars.
            report: called with the name of a policy and its comparison with greedy as soon as it is known.
            on_labels: see :class:`PolicyIteration`.

        Returns:
            comparisons with greedy by policy, in the order of the evaluations; online rollout on fewer states.

        Raises:
            ValueError: if the folder holds something else, or a number is out of range.
        """
        problem = self.make_problem(device)
        open_run_folder(folder, asdict(self))
        return _Execution(self, problem, folder, progress, report, on_labels).carry_out()


@dataclass
class _Execution:
    run: TrainingRun
    problem: Problem
    folder: Path
    progress: bool
    report: Report
    on_labels: OnLabels | None
    results: dict[str, Comparison] = field(default_factory=dict)

    def carry_out(self) -> dict[str, Comparison]:
        run, model, config = self.run, self.problem.model, self.run.config
        bases = {name: make(model) for name, make in BASE_POLICIES.items()}
        for name, policy in bases.items():
            self._compare(name, policy, run.states)
        base = bases[run.base]
        online: dict[str, Any] = {"trajectories": run.online_trajectories}
        self._compare(f"R-NT of {run.base}", r_nt(self.problem, base, **online), run.states)
        logger = CSVLogger("log", log_dir=str(self.folder))
        training = ALGORITHMS[run.algorithm](
            self.problem,
            config,
            base,
            folder=self.folder,
            logger=logger,
            progress=self.progress,
            on_labels=self.on_labels,
        )
        best: str = run.base
        summaries = []
        for iteration in training:
            name = f"{run.algorithm} {iteration.number}"
            checkpoint = Checkpoint(self.problem, config, run.algorithm, iteration.number, iteration.policy, iteration.value)
            save_checkpoint(self.folder / f"iteration-{iteration.number}.pt", checkpoint)
            if iteration.accepted:
                save_checkpoint(self.folder / "best.pt", checkpoint)
                best = name
            if iteration.number == 1 and training.plan[-1].truncation is not None:
                # What the networks of the startgame have learnt from, played online.
                truncated = r_t(self.problem, base, iteration.value, **online)
                self._compare(f"R-T of {run.base}", truncated, run.states)
            self._compare(name, iteration.policy, run.states)
            summaries.append(_summary(iteration))
            write_json(self.folder / "iterations.json", summaries)
        if run.online_states:
            self._compare(f"{best} + R-NT", r_nt(self.problem, training.best, **online), run.online_states)
        return self.results

    @cached_property
    def _baseline(self) -> Tensor:
        return self._costs("greedy", GreedyRepair(self.problem.model), self.run.states)

    def _compare(self, name: str, policy: Policy, states: int) -> None:
        """Add a policy's comparison with greedy, and bring the folder's metrics up to date."""
        costs = self._costs(name, policy, min(states, self.run.states))
        self.results[name] = compare(costs, self._baseline[: costs.numel()])
        write_json(self.folder / "metrics.json", {key: asdict(value) for key, value in self.results.items()})
        self.report(name, self.results[name])

    def _costs(self, name: str, policy: Policy, states: int) -> Tensor:
        """Costs from the first evaluation states, computed once."""
        path = _costs_file(self.folder, name)
        if path.is_file():
            return load_tensors(path)
        costs = discounted_costs(
            self.problem.model,
            policy,
            self.problem.start,
            num_states=states,
            seed=EVALUATION_SEED,
            terminal_cost=NeverRepairCost(self.problem.model),
            progress=self.progress,
            name=f"evaluate {name}",
        ).cpu()
        save_tensors(path, costs)
        return costs


def _costs_file(folder: Path, policy: str) -> Path:
    return folder / "costs" / f"{policy}.pt"


def _summary(iteration: Iteration) -> dict[str, Any]:
    """An iteration's numbers, for JSON."""
    return {
        "number": iteration.number,
        "accepted": iteration.accepted,
        "reason": iteration.reason,
        "comparison": asdict(iteration.comparison),
        "parts": {name: record.to_dict() for name, record in iteration.records.items()},
    }
