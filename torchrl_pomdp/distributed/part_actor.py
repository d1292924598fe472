"""The process that trains the network of a part."""

from __future__ import annotations

from typing import Any

import ray
import torch
from torchrl.record.loggers import Logger

from torchrl_pomdp.workers import PartTraining

__all__ = ["PartActor"]


class PartActor:
    """Owns network, optimiser and buffer of a part while it trains.

    All that a training needs is in the call: an actor that dies begins it again, with the same result.
    """

    def train(self, job: PartTraining, blocks: list[tuple[int, Any]]) -> tuple[Any, list[tuple[str, float, int]]]:
        """Carry out a training on labelled states.

        Args:
            job: the training.
            blocks: for each block the part whose states were labelled, and a reference, fetched one after the other.

        Returns:
            what the job returns, and the rows of the log: name, value, step.
        """
        torch.set_num_threads(1)
        data, log = job.open(), _Rows()
        for source, reference in blocks:
            data.add(source, ray.get(reference))
        return job.train(data, log, False), log.rows


class _Rows(Logger):
    """A logger that keeps scalars."""

    def __init__(self) -> None:
        super().__init__("rows", "")
        self.rows: list[tuple[str, float, int]] = []

    def _create_experiment(self) -> None:
        return None

    def log_scalar(self, name: str, value: float, step: int | None = None, **kwargs: Any) -> None:
        self.rows.append((name, value, step or 0))

    def log_video(self, name: str, video: Any, step: int | None = None, **kwargs: Any) -> None:
        raise NotImplementedError

    def log_hparams(self, cfg: Any) -> None:
        raise NotImplementedError

    def log_histogram(self, name: str, data: Any, **kwargs: Any) -> None:
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"{len(self.rows)} rows"
