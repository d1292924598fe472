"""Who does the work of policy iteration: stateless tasks and the training of parts, in this process or elsewhere.

Labels, visited states and costs of evaluations are functions of numbers and seeds alone. So it does not matter who computes
them, in which pieces and in which order: the results are the same to the last bit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, Protocol

import torch
from torchrl.record.loggers import Logger

__all__ = ["LOCAL", "LocalWorkers", "PartTraining", "Task", "Training", "WorkerError", "Workers"]

Task = Callable[[Any, Any], tuple[Any, Any]]
"""A stateless task: from what all of its kind share, and from what is its own, a result and a small report of it."""


class WorkerError(RuntimeError):
    """Work has failed elsewhere; the message says which, and why."""


class PartTraining(Protocol):
    """The training of one part, as workers carry it out: :class:`~torchrl_pomdp.trainers.parts.PartJob`."""

    part: int
    name: str

    def open(self) -> Any:
        """The empty data of the part, which take blocks by ``add(source, block)``."""

    def train(self, data: Any, logger: Logger | None, progress: bool) -> Any:
        """Train on the data; close them."""


class Training(ABC):
    """A training to which blocks of data are given before it starts."""

    @abstractmethod
    def add(self, source: int, handle: Any) -> None:
        """Give it a block of labelled states.

        Args:
            source: the part whose states were labelled.
            handle: the block, see :meth:`Workers.tasks`.
        """

    @abstractmethod
    def start(self) -> None:
        """Begin to train, where that does not hold up others."""

    @abstractmethod
    def result(self) -> Any:
        """What the job's ``train`` returns; waits for it."""


class Workers(ABC):
    """Carries out tasks and trainings.

    Attributes:
        pieces: into how many times smaller blocks work is cut than for a single process.
        num_workers: trainings at once.
    """

    pieces: int
    num_workers: int

    @abstractmethod
    def check_device(self, device: torch.device) -> None:
        """Raise ``ValueError`` unless the workers can compute with models on a device."""

    @abstractmethod
    def tasks(self, function: Task, shared: Any, items: Sequence[Any], name: Callable[[Any], str]) -> Iterator[tuple[Any, Any]]:
        """Carry out ``function(shared, item)`` for every item; some are begun at once.

        Args:
            function: the task, a function of a module.
            shared: what all of these tasks read.
            items: the tasks' own arguments.
            name: what an item is called in errors.

        Returns:
            for each item, in order, a handle of the result, and the report.
        """

    @abstractmethod
    def fetch(self, handle: Any) -> Any:
        """The result behind a handle."""

    @abstractmethod
    def put(self, value: Any) -> Any:
        """A handle of a value."""

    @abstractmethod
    def training(self, job: PartTraining, logger: Logger | None, progress: bool) -> Training:
        """The training of a part.

        Args:
            job: what is trained, and how.
            logger: logger of its losses.
            progress: whether to show progress bars.
        """

    def trained(self, trainings: Mapping[int, Training]) -> dict[int, Any]:
        """Carry out trainings; what they return, by the same keys."""
        waiting, found = iter(trainings.values()), {}
        for training in islice(waiting, self.num_workers):
            training.start()
        for key, training in trainings.items():
            found[key] = training.result()
            for following in islice(waiting, 1):
                following.start()
        return found


class LocalWorkers(Workers):
    """This process; a handle is the value itself.

    Examples:
        >>> workers = LocalWorkers()
        >>> [workers.fetch(handle) for handle, _ in workers.tasks(lambda a, b: (a + b, None), 1, [1, 2], str)]
        [2, 3]
    """

    pieces = num_workers = 1

    def check_device(self, device: torch.device) -> None:
        """See :meth:`Workers.check_device`: any."""

    def tasks(self, function: Task, shared: Any, items: Sequence[Any], name: Callable[[Any], str]) -> Iterator[tuple[Any, Any]]:
        """See :meth:`Workers.tasks`."""
        return (function(shared, item) for item in items)

    def fetch(self, handle: Any) -> Any:
        """See :meth:`Workers.fetch`."""
        return handle

    def put(self, value: Any) -> Any:
        """See :meth:`Workers.put`."""
        return value

    def training(self, job: PartTraining, logger: Logger | None, progress: bool) -> Training:
        """See :meth:`Workers.training`."""
        return _LocalTraining(job, logger, progress)


LOCAL = LocalWorkers()
"""This process."""


class _LocalTraining(Training):
    def __init__(self, job: PartTraining, logger: Logger | None, progress: bool) -> None:
        self.job, self.logger, self.progress = job, logger, progress
        self.data = job.open()

    def add(self, source: int, handle: Any) -> None:
        self.data.add(source, handle)

    def start(self) -> None:
        pass

    def result(self) -> Any:
        return self.job.train(self.data, self.logger, self.progress)
