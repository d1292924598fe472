r"""Teaching the network of one part, under TorchRL's ``Trainer`` (paper, Sections IV and V)."""

from __future__ import annotations

import ctypes
import errno
import json
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.objectives import LossModule
from torchrl.record.loggers import Logger
from torchrl.trainers import DefaultOptimizationStepper, Trainer

from torchrl_pomdp.checks import check_flag, check_instance, check_seed, check_text
from torchrl_pomdp.collectors.labels import LabelCollector
from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.logs import close_log
from torchrl_pomdp.modules.networks import LocalNetwork
from torchrl_pomdp.modules.threads import kept_threads
from torchrl_pomdp.problems.problem import Symmetry
from torchrl_pomdp.progress import progress_bar
from torchrl_pomdp.stopping import check_stopped

__all__ = ["MEMORY", "PartData", "PartImages", "PartJob", "PartRecord", "Trained", "train_part"]

MEMORY = 2 << 30
"""Bytes of a part's labelled states beyond which they are mapped to disk, in a temporary folder."""

# Bytes that are written to disk before memory is given back.
_GIVEN_BACK = 1 << 28
# Room on disk beside what is mapped: files are longer than their numbers.
_BESIDE = 1 << 20

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

    @classmethod
    def of(cls, collector: LabelCollector, trained: Trained) -> PartRecord:
        """The record of a part whose states a collector has labelled, in one batch."""
        made = collector.requested_frames_per_batch, collector.simulated_steps, collector.seconds
        return cls(*made, trained.seconds, trained.losses)


def records_text(records: Mapping[str, PartRecord]) -> str:
    """Records by name, as the text that a file keeps."""
    return json.dumps({name: record.to_dict() for name, record in records.items()})


def text_records(text: str) -> dict[str, PartRecord]:
    """The records of such a text."""
    return {name: PartRecord(**record) for name, record in json.loads(text).items()}


@dataclass(frozen=True)
class Trained:
    """What the training of a part gives.

    Attributes:
        weights: state of the trained network.
        seconds: time of optimisation.
        losses: see :class:`PartRecord`.
    """

    weights: dict[str, Any]
    seconds: float
    losses: dict[str, float]


class PartImages:
    """Mirror images of labelled states, by the part in which they lie.

    Args:
        partition: the partition.
        symmetries: the images, each a function of labelled states; the identity among them.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> images = PartImages(problem.partition, problem.symmetries)
        >>> y = problem.training[3](torch.arange(4)).set("action", torch.zeros(4, dtype=torch.int64))
        >>> images.counts(y), [len(rows) for rows in images.of_part(5, y)]
        ([0, 0, 0, 4, 0, 4], [0, 4])
    """

    def __init__(self, partition: Partition, symmetries: Sequence[Symmetry]) -> None:
        self.partition, self.symmetries = partition, symmetries

    def _images(self, block: TensorDictBase) -> Iterator[Any]:
        for symmetry in self.symmetries:
            image = symmetry(block)
            # A symmetry need not know of parts.
            yield image.set("partition", self.partition(image))

    def counts(self, block: TensorDictBase) -> list[int]:
        """How many images of labelled states ``[N]`` lie in each part."""
        parts = torch.cat([image.get("partition") for image in self._images(block)])
        return torch.bincount(parts, minlength=self.partition.num_parts).tolist()

    def of_part(self, part: int, block: TensorDictBase) -> list[Any]:
        """The images of labelled states ``[N]`` that lie in a part, for each symmetry."""
        return [image[image.get("partition") == part] for image in self._images(block)]


class PartData:
    """Labelled states of a part that come block by block; past a stated size, :data:`MEMORY`, they are mapped to disk.

    Args:
        part: the part.
        images: what becomes of the blocks.

    Attributes:
        bytes: how much there is.
    """

    def __init__(self, part: int, images: PartImages) -> None:
        self.part, self.images = part, images
        # By the part whose states were labelled and by symmetry, so that the order does not depend on the blocks.
        self._rows: dict[tuple[int, int], list[Any]] = {}
        self.bytes = 0
        # Since memory was last given back.
        self._written = 0
        self._folder: TemporaryDirectory[str] | None = None

    def add(self, source: int, block: TensorDictBase) -> None:
        """Add the images of a block of labelled states of part ``source`` that lie in the part."""
        for number, rows in enumerate(self.images.of_part(self.part, block)):
            self.bytes += rows.bytes()
            if self.large and len(rows):
                self._written += rows.bytes()
                check_room(self.folder, rows.bytes())
                rows = rows.cpu().memmap(self.folder / f"{source}-{number}-{len(self._rows.get((source, number), []))}")
            self._rows.setdefault((source, number), []).append(rows)
        if self._written > _GIVEN_BACK:
            give_back()
            self._written = 0

    def __iter__(self) -> Iterator[Any]:
        """The blocks, in the order of the parts and symmetries."""
        return (rows for key in sorted(self._rows) for rows in self._rows[key])

    def __len__(self) -> int:
        return sum(len(rows) for rows in self)

    @property
    def large(self) -> bool:
        """Whether there is more than memory is for."""
        return self.bytes > MEMORY

    @property
    def folder(self) -> Path:
        """Temporary folder for what does not stay in memory."""
        if self._folder is None:
            self._folder = TemporaryDirectory(prefix="torchrl-pomdp-")
        return Path(self._folder.name)

    def close(self) -> None:
        """Forget all."""
        self._rows.clear()
        if self._folder is not None:
            self._folder.cleanup()


def check_room(folder: Path, size: int) -> None:
    """Raise unless so many bytes fit into a folder: a file that is mapped and finds no room kills the process.

    What others write there at the same time, such as other parts, is not known.

    Args:
        folder: the folder.
        size: number of bytes.

    Raises:
        OSError: if they do not fit.
    """
    free = shutil.disk_usage(folder).free
    if size + _BESIDE > free:
        what = f"labelled states need {size:,} bytes more on disk, {free:,} are free; TMPDIR names another place"
        raise OSError(errno.ENOSPC, what, str(folder))


def give_back() -> None:
    """Give memory that is free back to the system, which glibc hardly does where blocks come and go."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


@dataclass(frozen=True)
class PartJob:
    """The training of a part's network, all of it: it can be carried out anywhere.

    Attributes:
        part: the part.
        name: what logs, errors and progress bars call it.
        seed: seed of the batches.
        network: the network before training.
        loss: makes the loss module of a network.
        images: see :class:`PartData`.
        config: see :func:`train_part`.
    """

    part: int
    name: str
    seed: int
    network: LocalNetwork
    loss: Callable[[LocalNetwork], LossModule]
    images: PartImages
    config: PolicyIterationConfig

    def open(self) -> PartData:
        """Empty data."""
        return PartData(self.part, self.images)

    def train(self, data: PartData, logger: Logger | None, progress: bool) -> Trained:
        """Train the network on the data, and close them."""
        options: dict[str, Any] = {"seed": self.seed, "name": self.name, "logger": logger, "progress": progress}
        try:
            seconds, losses = train_part(data, self.loss(self.network), self.config, **options)
        finally:
            data.close()
            close_log(logger, self.name)
        return Trained(self.network.state_dict(), seconds, losses)


def train_part(
    batch: TensorDictBase | PartData,
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
        batch: labelled states ``[N]``, from a :class:`~torchrl_pomdp.collectors.LabelCollector`; or data block by block.
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
    size = len(batch)
    steps = max(config.least_steps, config.epochs * size // config.batch_size)
    optimizer = torch.optim.RMSprop(loss.parameters(), config.learning_rate)
    stepper = _Stepper(optimizer, steps, name, logger, progress)
    buffer = _filled(batch, min(config.batch_size, size), seed)
    trainer = Trainer(
        collector=_Labelled(buffer[:1]),
        total_frames=1,
        frame_skip=1,
        optim_steps_per_batch=steps,
        loss_module=loss,
        optimizer=optimizer,
        optimization_stepper=stepper,
        progress_bar=False,
    )
    device = next(loss.parameters()).device
    trainer.register_op("process_optim_batch", lambda batch: buffer.sample().to(device))
    begin = time.perf_counter()
    # Products of a few rows are slower with several threads than with one, and sums of gradients would depend on their number.
    with kept_threads(1), torch.enable_grad():
        trainer.train()
    return time.perf_counter() - begin, stepper.final()


def _filled(batch: TensorDictBase | PartData, size: int, seed: int) -> TensorDictReplayBuffer:
    """A replay buffer of the states that gives batches of a size; on disk where the states are."""
    blocks: list[Any] = [batch] if isinstance(batch, TensorDictBase) else list(batch)
    if isinstance(batch, PartData) and batch.large:
        device = torch.device("cpu")
        check_room(batch.folder, batch.bytes)
        storage = LazyMemmapStorage(len(batch), scratch_dir=str(batch.folder / "buffer"), device=device)
    else:
        device = blocks[0].device or torch.device("cpu")
        storage = LazyTensorStorage(len(batch), device=device)
    buffer = TensorDictReplayBuffer(
        storage=storage,
        # A last batch of a few states would count as a full step; the states it leaves out differ from pass to pass.
        sampler=SamplerWithoutReplacement(drop_last=True),
        batch_size=size,
        generator=torch.Generator(device).manual_seed(seed),
    )
    for block in blocks:
        if len(block):
            buffer.extend(block.exclude("collector").to(device))
    return buffer


def _check(batch: Any, loss: LossModule, config: PolicyIterationConfig, logger: Logger | None) -> None:
    if not isinstance(batch, PartData):
        check_instance("batch", batch, TensorDictBase)
    check_instance("loss", loss, LossModule)
    check_instance("config", config, PolicyIterationConfig)
    if logger is not None:
        check_instance("logger", logger, Logger)
    if isinstance(batch, TensorDictBase) and batch.ndim != 1:
        raise ValueError(f"batch must hold labelled states [N], at least one, got batch {tuple(batch.batch_size)}")
    if len(batch) == 0:
        raise ValueError("batch must hold labelled states [N], at least one, got none")


class _Labelled:
    """What a ``Trainer`` takes as a collector: a single batch, as the states are in the buffer already."""

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
        check_stopped()
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
