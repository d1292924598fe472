"""Tasks and trainings on a Ray cluster: the same plans, and the same results, as in one process."""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self

import ray
import torch
from ray.exceptions import RayError, RayTaskError
from torchrl.record.loggers import Logger

from torchrl_pomdp.checks import check_integer, check_text
from torchrl_pomdp.distributed.part_actor import PartActor
from torchrl_pomdp.logs import close_log
from torchrl_pomdp.workers import PartTraining, Task, Training, WorkerError, Workers

__all__ = ["RayWorkers"]

# Tasks that are given out for each worker: one that it does, and one that waits, so that no worker does.
_AHEAD = 2
# How often a task or a training whose process dies is done again: with the same seeds, so that nothing changes.
_RETRIES = 5
_LOOPBACK = "127.0.0.1"
# Seconds within which a cluster must answer.
_ANSWER = 10.0


class RayWorkers(Workers):
    """Workers of a Ray cluster: stateless tasks, and an actor for each part that trains its network.

    Results are those of one process, to the last bit, whatever the number of workers, if all machines are alike. A task or
    training whose process dies is done again with the same seeds. Use it as a context, which releases Ray at its end.

    Args:
        address: a running cluster, as ``ray.init`` takes it; None starts one on this machine, reachable from it alone and
            without a dashboard, which is stopped in the end. Where Ray runs in this process already, it is used.
        num_workers: CPUs of the cluster that is started here, each for one task at a time; None: all of the machine's.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``num_workers`` is not positive, or given for a cluster that is running; or if Ray runs in this process
            at another address.
        ConnectionError: if there is no cluster at the address.

    Examples:
        Ray takes some seconds to start::

            with RayWorkers(num_workers=2) as workers:
                for iteration in papi_nt(problem, config, base_policy, workers=workers):
                    print(iteration.reason)
    """

    pieces = 8

    def __init__(self, address: str | None = None, num_workers: int | None = None) -> None:
        if address is not None:
            check_text("address", address)
        wanted = None if num_workers is None else check_integer("num_workers", num_workers, 1, 10**5)
        self._own, self._closed = not ray.is_initialized(), False
        if wanted is not None and not (self._own and address is None):
            raise ValueError(f"num_workers is for a cluster that is started here, got {wanted} for one that is running")
        if not self._own and address is not None:
            _check_address(address)
        self._actors: dict[int, Any] = {}
        # Reports of tasks that were given out and not collected yet.
        self._given: set[Any] = set()
        self._do: Any = ray.remote(num_returns=2, num_cpus=1, max_retries=_RETRIES)(_do)
        # Otherwise a task that needs too much memory is begun again without end.
        os.environ.setdefault("RAY_task_oom_retries", str(_RETRIES))
        try:
            with _kept_sigterm():
                if self._own and address is None:
                    ray.init("local", num_cpus=wanted, include_dashboard=False, log_to_driver=False, _node_ip_address=_LOOPBACK)
                elif self._own and address is not None:
                    _connect(address)
            self.num_workers = max(1, int(ray.cluster_resources().get("CPU", 1)))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Give up what is not done, stop the actors, and the cluster if it was started here."""
        if self._closed:
            return
        # Every call of Ray's would start it again once it is stopped.
        self._closed = True
        try:
            if ray.is_initialized():
                for report in list(self._given):
                    ray.cancel(report)
                for actor in list(self._actors.values()):
                    ray.kill(actor)
        finally:
            if self._own:
                ray.shutdown()

    def _check_open(self) -> None:
        if self._closed:
            raise WorkerError("the workers were released: make new ones")

    def check_device(self, device: torch.device) -> None:
        """See :meth:`Workers.check_device`: they compute on CPUs."""
        if device.type != "cpu":
            raise ValueError(f"workers of a Ray cluster compute on CPUs, got a model on {device}")

    def tasks(self, function: Task, shared: Any, items: Sequence[Any], name: Callable[[Any], str]) -> Iterator[tuple[Any, Any]]:
        """See :meth:`Workers.tasks`."""
        self._check_open()
        # The first ones are given out now: where several kinds of tasks are asked for, they are done side by side.
        everyone, left, waiting = [ray.put(shared)] if items else [], deque(items), deque[tuple[Any, Any, Any]]()

        def give_out() -> None:
            while left and len(waiting) < _AHEAD * self.num_workers:
                item = left.popleft()
                handle, report = self._do.remote(function, everyone, item)
                self._given.add(report)
                waiting.append((handle, report, item))

        def results() -> Iterator[tuple[Any, Any]]:
            while waiting:
                handle, report, item = waiting.popleft()
                found = self._get(report, name(item))
                self._given.discard(report)
                give_out()
                yield handle, found

        give_out()
        return results()

    def fetch(self, handle: Any) -> Any:
        """See :meth:`Workers.fetch`."""
        return self._get(handle, "a result")

    def put(self, value: Any) -> Any:
        """See :meth:`Workers.put`."""
        self._check_open()
        return ray.put(value)

    def training(self, job: PartTraining, logger: Logger | None, progress: bool) -> Training:
        """See :meth:`Workers.training`; progress is shown by the number of trained parts."""
        self._check_open()
        if job.part not in self._actors:
            # They reserve no CPU, which labelling would then lack: where all parts train together, nothing is labelled.
            options: dict[str, Any] = {"num_cpus": 0, "scheduling_strategy": "SPREAD"}
            made: Any = ray.remote(max_restarts=_RETRIES, max_task_retries=_RETRIES, **options)(PartActor)
            self._actors[job.part] = made.remote()
        return RayTraining(self._actors[job.part], job, logger, self._get)

    def _get(self, reference: Any, name: str) -> Any:
        """What a reference gives; says what has failed."""
        self._check_open()
        try:
            return ray.get(reference)
        except RayTaskError as error:
            cause = error.cause
            raise WorkerError(f"{name}: {type(cause).__name__}: {cause}") from error
        except RayError as error:
            raise WorkerError(f"{name}: {type(error).__name__}: {error}") from error


def _check_address(address: str) -> None:
    """Raise if an address is another one than that of the Ray that runs in this process."""
    running = ray.get_runtime_context().gcs_address
    host, _, port = address.rpartition(":")
    here = host in (running.rpartition(":")[0], "localhost", _LOOPBACK)
    if port.isdigit() and "/" not in host and not (here and port == running.rpartition(":")[2]):
        raise ValueError(f"address must be that of the Ray that runs in this process, {running}, or None, got {address!r}")


def _connect(address: str) -> None:
    """Connect to a running cluster; Ray itself would try for ten minutes."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit() and "/" not in host:
        try:
            socket.create_connection((host, int(port)), _ANSWER).close()
        except (OSError, OverflowError) as error:
            raise ConnectionError(f"nothing answers at {address}: {error}; ray start --head starts a cluster") from error
    try:
        ray.init(address, log_to_driver=False)
    except ConnectionError as error:
        token = "where the cluster has a token, set RAY_AUTH_MODE=token here too, and have the same ~/.ray/auth_token"
        raise ConnectionError(f"{error}; {token}") from error


@contextmanager
def _kept_sigterm() -> Iterator[None]:
    """Leave a handler of SIGTERM in place that Ray would replace by one that exits."""
    handler = signal.getsignal(signal.SIGTERM)
    yield
    if callable(handler) and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


class RayTraining(Training):
    """The training of a part by its actor, which fetches the blocks itself.

    Args:
        actor: the part's actor.
        job: see :class:`PartTraining`.
        logger: logger of the losses, which are written once it has trained.
        get: what a reference gives; by reference and name.
    """

    def __init__(self, actor: Any, job: PartTraining, logger: Logger | None, get: Callable[[Any, str], Any]) -> None:
        self.actor, self.job, self.logger, self._get = actor, job, logger, get
        self._blocks: list[tuple[int, Any]] = []
        self.reference: Any = None

    def add(self, source: int, handle: Any) -> None:
        """See :meth:`Training.add`."""
        self._blocks.append((source, handle))

    def start(self) -> None:
        """See :meth:`Training.start`."""
        self.reference = self.actor.train.remote(self.job, self._blocks)

    def result(self) -> Any:
        """See :meth:`Training.result`."""
        trained, rows = self._get(self.reference, f"train {self.job.name}")
        if self.logger is not None:
            for name, value, step in rows:
                self.logger.log_scalar(name, value, step=step)
            close_log(self.logger, self.job.name)
        return trained


# What this worker process has read of the shared values, the latest ones: tables and compiled loops are made once for each.
_shared: dict[str, Any] = {}
_KEPT = 8


def _do(function: Task, everyone: list[Any], item: Any) -> tuple[Any, Any]:
    """A task in a worker process."""
    torch.set_num_threads(1)
    (reference,) = everyone
    key = reference.hex()
    value = _shared.pop(key) if key in _shared else ray.get(reference)
    _shared[key] = value
    if len(_shared) > _KEPT:
        del _shared[next(iter(_shared))]
    return function(value, item)
