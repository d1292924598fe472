"""Both cores busy: independent chunks of a batch in threads of their own.

PyTorch splits one operation over threads only where it is large; a rollout is thousands of small ones. Operations release the
interpreter, so that threads with a chunk each run side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Event
from typing import TypeVar

import torch

from torchrl_pomdp.stopping import check_stopped, watched, watching

__all__ = ["blocks", "kept_threads", "map_threads", "rows_at_once"]

# An accelerator does so many times more rows at once: fewer, and it waits for the next operation.
_ON_ACCELERATOR = 16

# Trajectories that are made at once, in chunks of the rollout: enough to keep its chunk full nearly all the time.
_CHUNKS_PER_BLOCK = 8

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def rows_at_once(on_cpu: int, device: torch.device) -> int:
    """Rows that a device works on at once, where a CPU works best on ``on_cpu`` of them.

    Examples:
        >>> rows_at_once(1000, torch.device("cpu")), rows_at_once(1000, torch.device("cuda"))
        (1000, 16000)
    """
    return on_cpu if device.type == "cpu" else _ON_ACCELERATOR * on_cpu


def blocks(states: int, trajectories: int, chunk_rows: int, device: torch.device) -> tuple[int, int]:
    """States to simulate at once, and the number of threads that do so side by side.

    Args:
        states: number of states, at least 1.
        trajectories: trajectories of each.
        chunk_rows: trajectories in a chunk of the rollout.
        device: where it computes; only a CPU has several threads.

    Examples:
        >>> blocks(10_000, 8, 1024, torch.device("meta"))
        (1024, 1)
    """
    threads = torch.get_num_threads() if device.type == "cpu" else 1
    return min(max(1, _CHUNKS_PER_BLOCK * chunk_rows // trajectories), -(-states // threads)), threads


def map_threads(function: Callable[[_Item], _Result], items: Sequence[_Item], threads: int) -> list[_Result]:
    """Results of ``function`` for every item, in order, computed by up to ``threads`` threads without gradients.

    Args:
        function: must not depend on the order of the calls.
        items: the arguments.
        threads: number of threads; with one, or a single item, the function runs in the caller's.

    Examples:
        >>> map_threads(lambda x: x * x, [1, 2, 3], threads=2)
        [1, 4, 9]
    """
    if threads == 1 or len(items) == 1:
        return [_unless_stopped(function, item) for item in items]
    stop, above = Event(), watched()

    def run(item: _Item) -> _Result:
        # Gradient mode is a thread's own, like the number of threads that one operation may use.
        with torch.no_grad(), watching(*above, stop):
            return _unless_stopped(function, item)

    with kept_threads(), ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        try:
            return list(pool.map(run, items))
        except BaseException:
            # The pool waits for those that have begun.
            stop.set()
            raise


def _unless_stopped(function: Callable[[_Item], _Result], item: _Item) -> _Result:
    check_stopped()
    return function(item)


@contextmanager
def kept_threads(threads: int | None = None) -> Iterator[None]:
    """Leave the number of threads of one operation as it was afterwards; meanwhile it is ``threads``, if that is given.

    Examples:
        >>> with kept_threads(1):
        ...     torch.get_num_threads()
        1
    """
    before = torch.get_num_threads()
    try:
        if threads is not None:
            torch.set_num_threads(threads)
        yield
    finally:
        torch.set_num_threads(before)
