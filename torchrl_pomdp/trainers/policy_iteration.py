r"""Approximate policy iteration with partitioned policies and values (paper, Sections IV to VI).

One iteration follows a *plan*: a sequence of steps, each of which trains networks for some parts. :class:`Improve` teaches
policy networks the rollout control of the current policy, :class:`Evaluate` teaches value networks its cost. What a step has
trained is the base policy, or the terminal cost, of the steps after it: with a plan that takes the partition's stages in their
order, the startgame is rolled out with the endgame networks of the same iteration. The paper's algorithms are plans, see
:mod:`torchrl_pomdp.trainers.recipes`.
"""

from __future__ import annotations

import copy
import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.record.loggers import Logger

from torchrl_pomdp import __version__
from torchrl_pomdp.checks import check_callable, check_flag, check_instance, check_path
from torchrl_pomdp.collectors import OnLabels, PartSampler, PolicyEvaluation, RolloutImprovement, StateMemory, training_states
from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.envs.belief_env import BeliefEnv
from torchrl_pomdp.evaluation import Comparison, compare, discounted_costs
from torchrl_pomdp.files import check_claimed, claim
from torchrl_pomdp.identity import digest, identity
from torchrl_pomdp.kept import keep, kept
from torchrl_pomdp.logs import clear_log
from torchrl_pomdp.modules import (
    AgentNetwork,
    Encoder,
    MultiagentRollout,
    PartitionedPolicy,
    PartitionedValue,
    Policy,
    PolicyCost,
    PolicyNetwork,
    RolloutPolicy,
    as_policy,
)
from torchrl_pomdp.modules.networks import LocalNetwork
from torchrl_pomdp.modules.partitioned import local_policies
from torchrl_pomdp.noise import seed_keys
from torchrl_pomdp.objectives import ClassificationLoss, ValueLoss
from torchrl_pomdp.problems.problem import Problem, Symmetry
from torchrl_pomdp.trainers.architecture import (
    is_multiagent,
    make_agent_encoder,
    make_encoder,
    make_networks,
    make_values,
    weightless,
)
from torchrl_pomdp.trainers.parts import PartImages, PartJob, PartRecord, records_text, text_records
from torchrl_pomdp.trainers.plan import Evaluate, Improve, Step, checked_plan
from torchrl_pomdp.workers import LOCAL, Training, Workers

__all__ = ["Iteration", "PolicyIteration", "judge"]

# The record of whose folder it is.
_RECORD = "policy-iteration.json"
# What seeds are for; an iteration's validation is the same for all iterations.
_PURPOSES = ("weights", "states", "labels", "batches", "visits", "validation")


@dataclass(frozen=True)
class Iteration:
    """What an iteration has made.

    Attributes:
        number: from 1.
        policy: the trained policy.
        value: terminal cost: the trained value networks, and the pessimistic cost where there are none.
        accepted: whether it is the best policy so far.
        reason: why, in words with numbers.
        comparison: costs against the best policy before, on the validation states.
        records: what the training of each part took, by step and part.
    """

    number: int
    policy: PartitionedPolicy
    value: PartitionedValue
    accepted: bool
    reason: str
    comparison: Comparison
    records: dict[str, PartRecord] = field(repr=False)


class PolicyIteration:
    r"""Policy iteration from a base policy: its iterations, and the best policy so far. To iterate again is to start anew.

    An iteration starts from the best policy so far. Its policy is accepted if, on fixed validation states and under the same
    noise, the mean of its costs' paired differences is negative with 95 % confidence. A rejected one is dropped, and the next
    iteration tries again with other training states, those where the rejected one went among them. The value networks are
    those of the best policy, too. Where ``max_steps`` cut a trajectory its state's pessimistic cost is added, or, in a step
    with a truncation rule, what the part's value network says once there is one; evaluations leave it out where that is a
    constant.

    With a ``folder`` the networks of every step and every block of labels are kept there as soon as they are there. The same
    iteration with the same folder goes on where an earlier one was interrupted, and gives the same result.

    Args:
        problem: model, start states and training states.
        config: the numbers.
        base_policy: the policy :math:`\mu_0` that is improved first; any callable that writes ``"action"``.
        plan: the steps of an iteration.

    Keyword Args:
        folder: where the run is kept, a folder of this run alone; None keeps nothing.
        logger: TorchRL logger of losses; None logs nothing.
        progress: whether to show progress bars with rates.
        on_labels: called as states are labelled, with their number and whether an interrupted run had labelled them.
        workers: who labels, evaluates and trains; by default this process.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if the plan is empty or names a part that is none, or a partitioned base policy has not one policy for each
            part; when iterated, if the folder holds a run that differs in the content of its problem, its configuration, plan
            or base policy, or in the library's version.
        FileNotFoundError: when iterated, if the folder is deleted meanwhile.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> from torchrl_pomdp.trainers import papi_nt
        >>> problem = make_problem("line3")
        >>> config = PolicyIterationConfig(iterations=1, samples_per_part=40, least_steps=1, validation_states=50)
        >>> run = papi_nt(problem, config, GreedyRepair(problem.model))
        >>> [iteration.accepted for iteration in run], run.best is run.base_policy
        ([True], False)
    """

    def __init__(
        self,
        problem: Problem,
        config: PolicyIterationConfig,
        base_policy: Policy,
        plan: Sequence[Step],
        *,
        folder: Path | None = None,
        logger: Logger | None = None,
        progress: bool = False,
        on_labels: OnLabels | None = None,
        workers: Workers = LOCAL,
    ) -> None:
        self.partition = check_instance("problem", problem, Problem).partition
        self.problem, self.config = problem, check_instance("config", config, PolicyIterationConfig)
        self.base_policy = as_policy(base_policy, problem.model, "base_policy")
        self._base = local_policies("base_policy", self.base_policy, self.partition.num_parts)
        self.plan = checked_plan(plan, problem)
        self.folder = None if folder is None else check_path("folder", folder)
        self.logger = None if logger is None else check_instance("logger", logger, Logger)
        self.progress = check_flag("progress", progress)
        self.on_labels = None if on_labels is None else check_callable("on_labels", on_labels)
        self.workers = check_instance("workers", workers, Workers)
        workers.check_device(problem.model.device)
        self._scale = problem.pessimistic_cost
        self._multiagent = is_multiagent(problem, config)
        self._images = PartImages(self.partition, self._symmetries())
        self._encoder = self._shared_encoder()
        # Value networks share the policy networks' encoder where these see the state as they do.
        self._value_encoder = make_encoder(problem, config) if self._multiagent else self._encoder
        self._start()

    def _symmetries(self) -> list[Symmetry]:
        """Those whose images are labelled states, too."""
        itself, *others = self.problem.symmetries
        if not self.config.symmetries:
            return [itself]
        # Agents that decide in turn cannot change places.
        in_turn = self._multiagent and self.problem.model.num_agents > 1
        return [itself, *(each for each in others if not in_turn or getattr(each, "keeps_order", False))]

    def _shared_encoder(self) -> Encoder:
        """What the policy networks share, the base policy's own too."""
        kind = AgentNetwork if self._multiagent else PolicyNetwork
        of_base = next((policy.encoder for policy in self._base if isinstance(policy, kind)), None)
        if of_base is not None:
            return weightless(of_base)
        return (make_agent_encoder if self._multiagent else make_encoder)(self.problem, self.config)

    def _start(self) -> None:
        self.best: TensorDictModuleBase = self.base_policy
        self.memory = StateMemory(self.problem.model, self.config.memory_capacity, seed=self._seed(0, "visits"))
        # Policies whose states are remembered once a step needs them; a step that is restored needs none.
        self._unvisited: list[tuple[TensorDictModuleBase, int]] = []
        self._values: list[TensorDictModuleBase] = [self._scale] * self.partition.num_parts

    def __iter__(self) -> Iterator[Iteration]:
        """Carry out the iterations, in order."""
        self._start()
        if self.folder is not None:
            record = self._identity()
            claim(self.folder / _RECORD, record)
            self._owner = digest(record)
        policy = self.best
        best_costs = self._validate(policy, "base policy")
        for number in range(1, self.config.iterations + 1):
            self._unvisited.append((policy, number - 1))
            local, values, records = self._iterate(number)
            policy = PartitionedPolicy(local).eval()
            costs = self._validate(policy, f"iteration {number}")
            comparison = compare(costs, best_costs)
            accepted, reason = judge(comparison)
            if accepted:
                self.best, self._values, best_costs = policy, values, costs
            yield Iteration(number, policy, PartitionedValue(values).eval(), accepted, reason, comparison, records)

    def _identity(self) -> dict[str, Any]:
        """What decides the results, as JSON: names for people, digests of the content for certainty."""
        problem = self.problem
        return {
            "version": __version__,
            "problem": problem.name,
            "model": identity(problem.model),
            "start": identity(problem.start),
            "training": [identity(generator) for generator in problem.training],
            "pessimistic_cost": identity(problem.pessimistic_cost),
            "symmetries": [identity(symmetry) for symmetry in problem.symmetries],
            "encoders": [identity(problem.encoder), identity(problem.agent_encoder)],
            "base_policy": identity(self.base_policy),
            "plan": [[type(s).__name__, s.parts, None if s.truncation is None else identity(s.truncation)] for s in self.plan],
            "config": asdict(self.config),
        }

    def _iterate(self, number: int) -> tuple[list[Any], list[Any], dict[str, PartRecord]]:
        """The local policies and values after one iteration from the best policy."""
        local = local_policies("best", self.best, self.partition.num_parts)
        values: list[Any] = list(self._values)
        records: dict[str, PartRecord] = {}
        for index, step in enumerate(self.plan):
            networks = {part: self._initial(index, part, local, values, number) for part in step.parts}
            trained = self._restore(networks, self._name(number, index))
            records |= trained or self._train_step(index, networks, local, values, number)
            for part, network in networks.items():
                (local if isinstance(step, Improve) else values)[part] = network.eval()
        return local, values, records

    def _name(self, number: int, index: int) -> str:
        """Name of a step of the plan in an iteration."""
        return f"iteration-{number}/{index + 1}-{type(self.plan[index]).__name__.lower()}"

    def _initial(self, index: int, part: int, local: list[Any], values: list[Any], number: int) -> LocalNetwork:
        """The network to train: the one that the part has, or a new one."""
        step = self.plan[index]
        old = (local if isinstance(step, Improve) else values)[part]
        if isinstance(old, LocalNetwork) and isinstance(old, AgentNetwork) == (self._multiagent and isinstance(step, Improve)):
            # What has no weights is shared; a shared encoder lets networks be evaluated together.
            return copy.deepcopy(old, {id(old.encoder): old.encoder, id(self._scale): self._scale})
        seed = self._seed(number, "weights", part, index)
        if isinstance(step, Improve):
            return cast(LocalNetwork, make_networks(self.problem, self.config, seed, self._encoder).policies[part])
        return cast(LocalNetwork, make_values(self.problem, self.config, seed, self._value_encoder, self._scale).values[part])

    def _restore(self, networks: dict[int, LocalNetwork], name: str) -> dict[str, PartRecord] | None:
        """Load the networks of a step where an interrupted run has trained them; None where it has not."""
        path = self._path(name)
        if path is None:
            return None
        content = kept(path, f"{self._owner} {name}", self.problem.model.device)
        if content is None:
            return None
        # A kill may have come before they were removed.
        shutil.rmtree(path.with_suffix(".labels"), ignore_errors=True)
        for part, network in networks.items():
            network.load_state_dict(content["networks"][str(part)])
        records = text_records(content["records"])
        if self.on_labels is not None:
            self.on_labels(sum(record.samples for record in records.values()), True)
        return records

    def _train_step(
        self, index: int, networks: dict[int, LocalNetwork], local: list[Any], values: list[Any], number: int
    ) -> dict[str, PartRecord]:
        """Label states of the step's parts, train their networks, and keep them."""
        step, name = self.plan[index], self._name(number, index)
        while self._unvisited:
            self._visit(*self._unvisited.pop(0))
        path = self._path(name)
        cache = path.with_suffix(".labels") if path is not None else None
        make = partial(self._collector, index, PartitionedPolicy(local), PartitionedValue(values), number, cache)
        trainings = {part: self._training(index, part, network, number) for part, network in networks.items()}
        collectors = {part: make(part) for part in step.parts}
        labelled = {part: collector.blocks(self.workers, self._images.counts) for part, collector in collectors.items()}
        for part, blocks in labelled.items():
            for block in blocks:
                for other, training in trainings.items():
                    if block.summary[other]:
                        training.add(part, block.handle)
        records = {}
        for part, trained in self.workers.trained(trainings).items():
            networks[part].load_state_dict(trained.weights)
            records[f"{name}-part-{part}"] = PartRecord.of(collectors[part], trained)
        if path is not None and cache is not None:
            states = {str(part): network.state_dict() for part, network in networks.items()}
            content = {"networks": states, "records": records_text(records)}
            check_claimed(path.parents[1] / _RECORD)
            keep(path, f"{self._owner} {name}", content)
            shutil.rmtree(cache, ignore_errors=True)
        return records

    def _training(self, index: int, part: int, network: LocalNetwork, number: int) -> Training:
        """The training of a part's network in a step."""
        name = f"{self._name(number, index)}-part-{part}"
        clear_log(self.logger, name)
        improves = isinstance(self.plan[index], Improve)
        loss = partial(ClassificationLoss, loss=self.config.loss) if improves else partial(ValueLoss, scale=self._scale)
        seed = self._seed(number, "batches", part, index)
        job = PartJob(part, name, seed, network, loss, self._images, self.config)
        return self.workers.training(job, self.logger, self.progress)

    def _path(self, name: str) -> Path | None:
        """File of a step's networks; None where nothing is kept."""
        return None if self.folder is None else self.folder / f"{name}.pt"

    def _collector(
        self,
        index: int,
        policy: PartitionedPolicy,
        value: PartitionedValue,
        number: int,
        cache: Path | None,
        part: int,
    ) -> RolloutImprovement | PolicyEvaluation:
        """Collector of the labelled states of a part, all in one batch."""
        config, problem, step = self.config, self.problem, self.plan[index]
        simulation: dict[str, Any] = {
            "max_steps": config.stages,
            "truncation": step.truncation,
            "terminal_cost": value,
            "seed": self._seed(number, "labels", part, index),
        }
        states = training_states(problem, self.memory, part, visited_share=config.visited_share)
        samples = config.samples_per_part if isinstance(step, Improve) else config.value_samples
        options: dict[str, Any] = {
            "states": PartSampler({part: states}, self._seed(number, "states", part, index)),
            "frames_per_batch": samples,
            "total_frames": samples,
            "cache": cache / str(part) if cache is not None else None,
            "progress": self.progress,
            "name": f"label {self._name(number, index)}, part {part}",
            "on_labels": self.on_labels,
        }
        env = BeliefEnv(problem.model, problem.start)
        if isinstance(step, Evaluate):
            return PolicyEvaluation(env, policy, label=partial(PolicyCost, **simulation), **options)
        simulation |= {"trajectories": config.trajectories, "leaves": config.leaves, "allocation": config.allocation}
        rollout = MultiagentRollout if self._multiagent else RolloutPolicy
        return RolloutImprovement(env, policy, label=partial(rollout, **simulation), **options)

    def _visit(self, policy: TensorDictModuleBase, number: int, part: int | None = None) -> None:
        """Remember states that an iteration's policy visits, also a rejected one's: there the next one can do better.

        A part at its own pace makes its share of the visits.
        """
        config = self.config
        count = math.ceil(config.visits_per_label * config.samples_per_part * self.partition.num_parts)
        keys = seed_keys(self._seed(number, "visits"), torch.arange(count, device=self.problem.model.device))
        if part is not None:
            keys = keys[part :: self.partition.num_parts]
        options: dict[str, Any] = {"exploration": config.exploration, "max_steps": config.max_steps, "workers": self.workers}
        self.memory.visit(policy, self.problem.start, keys, **options)

    def _validate(self, policy: TensorDictModuleBase, name: str) -> torch.Tensor:
        problem, config = self.problem, self.config
        return discounted_costs(
            problem.model,
            policy,
            problem.start,
            num_states=config.validation_states,
            seed=self._seed(0, "validation"),
            max_steps=config.max_steps,
            terminal_cost=self._scale,
            progress=self.progress,
            name=f"validate {name}",
            workers=self.workers,
        )

    def _seed(self, iteration: int, purpose: str, part: int = 0, index: int = 0) -> int:
        """A seed for one purpose of one part in one iteration, another one each time that the plan comes to the part."""
        turn, parts = sum(part in step.parts for step in self.plan[:index]), self.partition.num_parts
        slot = (self.config.seed * 1000 + iteration) * max(100, parts * len(self.plan)) + turn * parts + part
        return (slot * len(_PURPOSES) + _PURPOSES.index(purpose)) % 2**63


def judge(comparison: Comparison) -> tuple[bool, str]:
    """Whether a policy is accepted against the best one so far, and why; costs may be negative."""
    low, high = comparison.difference.interval
    accepted = high < 0.0
    verdict = "lower" if accepted else "higher" if low > 0.0 else "not lower with confidence"
    ratio = "" if comparison.ratio is None else f", {comparison.ratio.mean:.4f} times it"
    return accepted, (
        f"cost {verdict}: {comparison.difference.mean:+.4g} ({low:+.4g} … {high:+.4g}) against the best policy so far{ratio}, "
        f"on {comparison.cost.count} validation states"
    )
