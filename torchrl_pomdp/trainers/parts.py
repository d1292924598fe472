r"""Teaching the network of one part, under TorchRL's ``Trainer`` (paper, Sections IV and V)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.objectives import LossModule
from torchrl.record.loggers import Logger
from torchrl.trainers import DefaultOptimizationStepper, Trainer

from torchrl_pomdp.checks import check_flag, check_instance, check_seed, check_text
from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.modules.threads import kept_threads
from torchrl_pomdp.progress import progress_bar

__all__ = ["PartRecord", "train_part"]

_LOG_INTERVAL = 50


@dataclass(frozen=True)
class PartRecord:
    """What the training of a part took and how it ended.

    Attributes:
        samples: labelled states; each is used with all its mirror images that lie in the part.
        simulated_steps: belief steps of the simulations that labelled them.
        label_seconds: time of labelling, together with drawing the states.
        train_seconds: time of optimisation.
        losses: means of the loss module's outputs over the last tenth of the optimisation steps.
    """

    samples: int
    simulated_steps: int
    label_seconds: float
    train_seconds: float
    losses: dict[str, float]

    def to_dict(self) -> dict[str, Any]:
        """All numbers, for JSON."""
        return asdict(self)


def train_part(
    batch: TensorDictBase,
    loss: LossModule,
    config: PolicyIterationConfig,
    *,
    seed: int,
    name: str,
    logger: Logger | None = None,
    progress: bool = False,
) -> tuple[float, dict[str, float]]:
    """Train a loss module's network on labelled states, in place.

    Args:
        batch: labelled states ``[N]``, from a :class:`~torchrl_pomdp.collectors.LabelCollector`.
        loss: loss module of the network that is trained.
        config: step size, batch size, epochs and least number of steps.

    Keyword Args:
        seed: seed of the batches.
        name: what logs and progress bars call the part.
        logger: TorchRL logger of the losses.
        progress: whether to show a progress bar.

    Returns:
        seconds, and the means of the loss module's outputs over the last tenth of the optimisation steps.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if there are no states, or a loss is not finite.
    """
    _check(batch, loss, config, logger)
    seed, name, progress = check_seed("seed", seed), check_text("name", name), check_flag("progress", progress)
    size = batch.batch_size.numel()
    steps = max(config.least_steps, config.epochs * size // config.batch_size)
    optimizer = torch.optim.RMSprop(loss.parameters(), config.learning_rate)
    stepper = _Stepper(optimizer, steps, name, logger, progress)
    trainer = Trainer(
        collector=_Labelled(batch),
        total_frames=size,
        frame_skip=1,
        optim_steps_per_batch=steps,
        loss_module=loss,
        optimizer=optimizer,
        optimization_stepper=stepper,
        progress_bar=False,
    )
    device = batch.device or torch.device("cpu")
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(size, device=device),
        sampler=SamplerWithoutReplacement(),
        batch_size=min(config.batch_size, size),
        generator=torch.Generator(device).manual_seed(seed),
    )
    trainer.register_op("batch_process", partial(_store, buffer))
    trainer.register_op("process_optim_batch", lambda batch: buffer.sample())
    begin = time.perf_counter()
    # Products of a few rows are slower with several threads than with one, and sums of gradients would depend on their number.
    with kept_threads(1):
        trainer.train()
    return time.perf_counter() - begin, stepper.final()


def _check(batch: TensorDictBase, loss: LossModule, config: PolicyIterationConfig, logger: Logger | None) -> None:
    check_instance("batch", batch, TensorDictBase)
    check_instance("loss", loss, LossModule)
    check_instance("config", config, PolicyIterationConfig)
    if logger is not None:
        check_instance("logger", logger, Logger)
    if batch.ndim != 1 or batch.batch_size[0] == 0:
        raise ValueError(f"batch must hold labelled states [N], at least one, got batch {tuple(batch.batch_size)}")


class _Labelled:
    """Labelled states as a ``Trainer`` takes them: a collector of a single batch."""

    init_random_frames = 0

    def __init__(self, batch: TensorDictBase) -> None:
        self.batch = batch

    def __iter__(self) -> Iterator[TensorDictBase]:
        yield self.batch

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        return seed

    def shutdown(self) -> None:
        pass


class _Stepper(DefaultOptimizationStepper):
    """TorchRL's optimisation step with a falling step size, a log of the losses and a progress bar."""

    def __init__(self, optimizer: torch.optim.Optimizer, steps: int, name: str, logger: Logger | None, progress: bool) -> None:
        super().__init__()
        self.schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total_iters=steps)
        self.name, self.logger, self.steps, self.progress = name, logger, steps, progress
        self.count = 0
        self._sums: dict[str, float] = {}

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        if self.count == 0:
            self.bar = progress_bar(self.steps, "step", f"train {self.name}", self.progress)
        # The trainer averages them over all steps; with their graphs it would keep every step's memory.
        losses = super().step(trainer, sub_batch).detach()
        self.schedule.step()
        self.count += 1
        if self.logger is not None and self.count % _LOG_INTERVAL == 0:
            for key in trainer.loss_module.out_keys:
                self.logger.log_scalar(f"{self.name}/{key}", losses[key].item(), step=self.count)
        if self.count > self.steps - self._tail:
            for key in trainer.loss_module.out_keys:
                self._sums[key] = self._sums.get(key, 0.0) + losses[key].item()
        self.bar.update()
        if self.count == self.steps:
            self.bar.close()
        return losses

    @property
    def _tail(self) -> int:
        return max(1, self.steps // 10)

    def final(self) -> dict[str, float]:
        """Mean losses of the last tenth of the steps."""
        return {key: total / self._tail for key, total in self._sums.items()}


def _store(buffer: TensorDictReplayBuffer, batch: TensorDictBase) -> TensorDictBase:
    buffer.extend(batch.exclude("collector"))
    return batch
