"""Collectors whose frames are labelled feature states: state number i of a run with what a labelling module writes."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from tqdm import tqdm

from torchrl_pomdp.collectors.states import StateSampler
from torchrl_pomdp.envs.belief import BeliefEnv
from torchrl_pomdp.files import load_tensors, save_tensors
from torchrl_pomdp.modules.rollout import Policy

__all__ = ["LabelCollector", "OnLabels"]

OnLabels = Callable[[int, bool], None]
"""Called with a number of labelled states, and whether an interrupted run had labelled them."""

# States that are drawn, labelled and kept at once; the data do not depend on it. Many, because a rollout is slow at its end,
# when few trajectories are left.
_BLOCK = 16384


class LabelCollector(Collector):
    r"""Base of the collectors that label numbered states with the simulated costs of a policy.

    Every batch is a flat TensorDict ``[frames_per_batch]`` with the feature state (core entries, ``action_mask``,
    ``partition``), what the label module writes, ``("collector", "mask")`` and the state's number in
    ``("collector", "traj_ids")``. It has no ``"next"``: a label is no transition. It runs alone and, as
    ``collector_class``, under ``MultiSyncCollector``.

    State number i of the run is ``states(i)`` whichever worker labels it, and a label is a function of the state and the
    seed alone: any number of workers yields the same data.

    Args:
        create_env_fn: a :class:`BeliefEnv` or a function that makes one; it gives the model.
        policy: the policy that is simulated; a copy is kept, which ``update_policy_weights_`` changes.

    Keyword Args:
        states: the numbered training states.
        label: makes the module that labels feature states from model and policy.
        frames_per_batch: labelled states in each batch.
        total_frames: labelled states in all; -1 for no end.
        num_workers: number of collectors that share the work; this one is number ``worker_idx``.
        cache: folder for labelled blocks; those that an interrupted run has left there are read instead of being labelled
            again. It must belong to this run alone. None keeps nothing.
        progress: whether to show a progress bar with the labelling rate.
        name: what the progress bar calls the work.
        on_labels: called after every block with its number of states and whether they were read from the cache.
        kwargs: further arguments of ``torchrl.collectors.Collector``.

    Attributes:
        simulated_steps: belief steps of the simulations behind the labels so far, cached ones too.
        seconds: time that they and drawing the states took.

    Raises:
        TypeError: if the environment is not a :class:`BeliefEnv`.
        ValueError: if ``num_workers`` is not positive.
    """

    def __init__(
        self,
        create_env_fn: BeliefEnv | Callable[[], BeliefEnv],
        policy: Policy | None = None,
        *,
        states: StateSampler,
        label: Callable[..., TensorDictModuleBase],
        frames_per_batch: int,
        total_frames: int = -1,
        num_workers: int = 1,
        cache: Path | None = None,
        progress: bool = False,
        name: str = "label",
        on_labels: OnLabels | None = None,
        **kwargs: Any,
    ) -> None:
        if num_workers < 1:
            raise ValueError(f"num_workers must be at least 1, got {num_workers}")
        # The data is no environment rollout: buffers of that layout and transforms for it do not apply.
        kwargs["use_buffers"] = False
        kwargs["auto_register_policy_transforms"] = False
        # Any callable on feature states is a policy; TorchRL would map its arguments to entries.
        kwargs["trust_policy"] = True
        super().__init__(
            create_env_fn,
            copy.deepcopy(policy),
            frames_per_batch=frames_per_batch,
            total_frames=total_frames,
            **kwargs,
        )
        if not isinstance(self.env, BeliefEnv):
            raise TypeError(f"create_env_fn must give a BeliefEnv, got {type(self.env).__name__}")
        self.states, self.num_workers, self.cache, self.progress, self.name = states, num_workers, cache, progress, name
        self.on_labels = on_labels
        self.labeller = label(self.env.model, self.policy)
        self._batches, self.simulated_steps, self.seconds = 0, 0, 0.0

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """The next batch of labelled states, ``[frames_per_batch]``."""
        size = self.requested_frames_per_batch
        # Batches are shared out in blocks, so that the workers' stacked batches are in order.
        first = (self._batches * self.num_workers + (self.worker_idx or 0)) * size
        self._batches += 1
        index = torch.arange(first, first + size, device=self.env.device)
        with tqdm(total=size, unit="state", desc=self.name, disable=not self.progress, leave=False) as bar:
            blocks = [self._block(numbers, bar) for numbers in index.split(_BLOCK)]
        batch: Any = torch.cat(blocks, 0)
        batch.set(("collector", "traj_ids"), index)
        return batch.set(("collector", "mask"), torch.ones_like(index, dtype=torch.bool))

    def _block(self, numbers: Tensor, bar: tqdm) -> TensorDictBase:
        """Labelled states with the given numbers ``[N]``, from the cache where they are there."""
        path = self.cache / f"{int(numbers[0]):012d}-{numbers.numel()}.pt" if self.cache is not None else None
        if path is not None and path.is_file():
            content = load_tensors(path, self.env.device)
            self.simulated_steps += content["simulated_steps"]
            self.seconds += content["seconds"]
            self._advance(bar, numbers.numel(), cached=True)
            return TensorDict(content["states"], numbers.shape, device=self.env.device)
        before, begin = self.labeller.simulated_steps, time.perf_counter()
        block = self.labeller(self.env.model.with_features(self.states(numbers)))
        steps, seconds = self.labeller.simulated_steps - before, time.perf_counter() - begin
        self.simulated_steps += steps
        self.seconds += seconds
        self._advance(bar, numbers.numel(), cached=False)
        if path is not None:
            save_tensors(path, {"states": block.to_dict(), "simulated_steps": steps, "seconds": seconds})
        return block

    def _advance(self, bar: tqdm, states: int, *, cached: bool) -> None:
        bar.update(states)
        if self.on_labels is not None:
            self.on_labels(states, cached)

    def state_dict(self) -> dict[str, Any]:
        """State of the base policy and the number of batches made."""
        return {**super().state_dict(), "batches": self._batches}

    def load_state_dict(self, state_dict: dict[str, Any], **kwargs: Any) -> None:
        """Continue after the batch at which ``state_dict`` was taken."""
        state = dict(state_dict)
        self._batches = state.pop("batches")
        super().load_state_dict(state, **kwargs)
