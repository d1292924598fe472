"""Approximate policy iteration with a partitioned architecture and no truncation, pAPI-NT (paper, Sections IV to VI).

One iteration improves the base policy part by part, in the partition's stages: a stage labels states of its parts with the
rollout control, its networks learn the labels, and from then on they are the base policy in those parts, so that the
startgame is rolled out with the endgame networks of the same iteration. A stage is one run of TorchRL's ``Trainer``.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from functools import partial

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import LazyTensorStorage, ReplayBufferEnsemble, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.record.loggers import Logger
from torchrl.trainers import DefaultOptimizationStepper, Trainer
from tqdm import tqdm

from torchrl_pomdp.collectors import PartSampler, RolloutImprovement, training_states
from torchrl_pomdp.envs.belief import BeliefEnv
from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.envs.presets import Problem
from torchrl_pomdp.modules import FlatEncoder, PartitionedPolicy, PolicyNetwork, RelativeEncoder, RolloutPolicy
from torchrl_pomdp.objectives import ClassificationLoss
from torchrl_pomdp.trainers.config import PolicyIterationConfig

__all__ = ["PolicyIteration", "make_networks"]

_ENCODERS = {"flat": FlatEncoder, "relative": RelativeEncoder}
_LOG_INTERVAL = 50


def make_networks(problem: Problem, config: PolicyIterationConfig, seed: int) -> PartitionedPolicy:
    """An untrained partitioned policy: one policy network for each part of the problem's partition.

    Args:
        problem: the problem.
        config: sizes and encoding.
        seed: seed of the initial weights.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> len(make_networks(make_problem("linear20"), PolicyIterationConfig(), seed=0).policies)
        6
    """
    model = problem.model
    generator = torch.Generator(device=model.device).manual_seed(seed)
    encoder = _ENCODERS[config.encoder](model)
    num_parts = _partition(problem).num_parts
    return PartitionedPolicy(
        [PolicyNetwork(encoder, model.num_controls, config.hidden, generator=generator) for _ in range(num_parts)]
    )


class PolicyIteration:
    r"""Policy iteration from a base policy: an iterator over the policies :math:`\hat\mu_1,\hat\mu_2,\dots`.

    Args:
        problem: model, start states and training states.
        config: the numbers.
        base_policy: the policy :math:`\mu_0` that is improved first.

    Keyword Args:
        logger: TorchRL logger of losses; None logs nothing.
        progress: whether to show progress bars with rates.

    Raises:
        ValueError: if the problem's model has no partition.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> from torchrl_pomdp.modules import GreedyRepair
        >>> problem = make_problem("line3")
        >>> config = PolicyIterationConfig(iterations=1, samples_per_part=40, trajectories=2, epochs=1, batch_size=20)
        >>> policies = list(PolicyIteration(problem, config, GreedyRepair(problem.model)))
        >>> y = problem.model.with_features(problem.start(torch.arange(5)))
        >>> policies[0](y)["action"].shape
        torch.Size([5])
    """

    def __init__(
        self,
        problem: Problem,
        config: PolicyIterationConfig,
        base_policy: TensorDictModuleBase,
        *,
        logger: Logger | None = None,
        progress: bool = False,
    ) -> None:
        self.problem, self.config, self.logger, self.progress = problem, config, logger, progress
        self.partition = _partition(problem)
        self.base_policy = base_policy

    def __iter__(self) -> Iterator[PartitionedPolicy]:
        """Yield the policy of every iteration, in order."""
        policy: TensorDictModuleBase = self.base_policy
        for iteration in range(self.config.iterations):
            policy = self.improve(policy, iteration)
            yield policy

    def improve(self, base: TensorDictModuleBase, iteration: int) -> PartitionedPolicy:
        """One policy iteration: the trained approximation of the rollout policy of ``base``.

        Args:
            base: the current policy.
            iteration: number of the iteration; random numbers depend on it and on the seed.
        """
        local = list(base.policies) if isinstance(base, PartitionedPolicy) else [base] * self.partition.num_parts
        networks = self._initial_networks(base, iteration)
        for stage in self.partition.stages:
            self._train_stage(networks, PartitionedPolicy(local), stage, iteration)
            for part in stage:
                local[part] = networks.policies[part]
        return networks.eval()

    def _initial_networks(self, base: TensorDictModuleBase, iteration: int) -> PartitionedPolicy:
        """Networks to train: those of ``base`` again, or new ones where it has none."""
        if isinstance(base, PartitionedPolicy) and all(isinstance(p, PolicyNetwork) for p in base.policies):
            return copy.deepcopy(base)
        return make_networks(self.problem, self.config, self._seed(iteration, "weights"))

    def _seed(self, iteration: int, purpose: str, stage: int = 0) -> int:
        """A seed for one purpose of one stage of one iteration."""
        purposes = ("weights", "states", "labels", "batches")
        return ((self.config.seed * 1000 + iteration) * 100 + stage) * len(purposes) + purposes.index(purpose)

    def _train_stage(
        self, networks: PartitionedPolicy, base: PartitionedPolicy, stage: tuple[int, ...], iteration: int
    ) -> None:
        """Label states of the parts ``stage`` with the rollout of ``base`` and train their networks in place."""
        config, number = self.config, self.partition.stages.index(stage)
        frames = config.samples_per_part * len(stage)
        loss = ClassificationLoss(networks, config.loss)
        steps = max(1, config.epochs * config.samples_per_part // config.batch_size)
        optimizer = torch.optim.RMSprop(loss.parameters(), config.learning_rate)
        name = f"iteration-{iteration + 1}-stage-{number + 1}"
        trainer = Trainer(
            collector=self._collector(base, stage, iteration, frames),
            total_frames=frames,
            frame_skip=1,
            optim_steps_per_batch=steps,
            loss_module=loss,
            optimizer=optimizer,
            optimization_stepper=_Stepper(optimizer, steps, name, self.logger, self.progress),
            progress_bar=False,
        )
        buffers = self._buffers(stage, self._seed(iteration, "batches", number))
        trainer.register_op("batch_process", partial(_store, buffers))
        trainer.register_op("process_optim_batch", partial(_sample, buffers))
        try:
            trainer.train()
        finally:
            trainer.collector.shutdown()

    def _collector(self, base: PartitionedPolicy, stage: tuple[int, ...], iteration: int, frames: int) -> RolloutImprovement:
        config, problem = self.config, self.problem
        number = self.partition.stages.index(stage)
        label = partial(
            RolloutPolicy,
            trajectories=config.trajectories,
            leaves=config.leaves,
            allocation=config.allocation,
            max_steps=config.max_steps,
            seed=self._seed(iteration, "labels", number),
        )
        share = {"visited_share": config.visited_share, "exploration": config.exploration}
        generators = {part: training_states(problem, base, part, **share) for part in stage}
        return RolloutImprovement(
            BeliefEnv(problem.model, problem.start),
            base,
            states=PartSampler(generators, self._seed(iteration, "states", number)),
            frames_per_batch=frames,
            total_frames=frames,
            label=label,
            progress=self.progress,
        )

    def _buffers(self, stage: tuple[int, ...], seed: int) -> ReplayBufferEnsemble:
        """One buffer for each part, written by ``"partition"``; batches come from the parts of the stage alone."""
        config = self.config
        parts = range(self.partition.num_parts)
        members = [
            TensorDictReplayBuffer(
                storage=LazyTensorStorage(config.samples_per_part),
                sampler=SamplerWithoutReplacement(),
                generator=torch.Generator().manual_seed(seed),
            )
            for _ in parts
        ]
        return ReplayBufferEnsemble(
            *members,
            routing_key="partition",
            p=[float(part in stage) for part in parts],
            num_buffer_sampled=len(stage),
            batch_size=config.batch_size * len(stage),
            generator=torch.Generator().manual_seed(seed),
        )


class _Stepper(DefaultOptimizationStepper):
    """TorchRL's optimisation step with a falling step size, a log of the losses and a progress bar."""

    def __init__(self, optimizer: torch.optim.Optimizer, steps: int, name: str, logger: Logger | None, progress: bool) -> None:
        super().__init__()
        self.schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total_iters=steps)
        self.name, self.logger = name, logger
        self.bar = tqdm(total=steps, unit="step", desc=f"train {name}", disable=not progress, leave=False)
        self.count = 0

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        losses = super().step(trainer, sub_batch)
        self.schedule.step()
        self.count += 1
        if self.logger is not None and self.count % _LOG_INTERVAL == 0:
            for key in ("loss_policy", "accuracy", "regret"):
                self.logger.log_scalar(f"{self.name}/{key}", losses[key].item(), step=self.count)
        self.bar.update()
        if self.count == self.bar.total:
            self.bar.close()
        return losses


def _store(buffers: ReplayBufferEnsemble, batch: TensorDictBase) -> TensorDictBase:
    buffers.extend(batch.exclude("collector"))
    return batch


def _sample(buffers: ReplayBufferEnsemble, batch: TensorDictBase) -> TensorDictBase:
    return buffers.sample().reshape(-1)


def _partition(problem: Problem) -> Partition:
    if problem.model.partition is None:
        raise ValueError(f"the model of problem {problem.name!r} has no partition; give it one, SinglePart() for none")
    return problem.model.partition
