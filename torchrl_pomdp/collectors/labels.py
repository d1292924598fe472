"""Collectors whose frames are labelled feature states: state number i of a run with what a labelling module writes."""

from __future__ import annotations

import copy
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.collectors import Collector

from torchrl_pomdp import __version__
from torchrl_pomdp.checks import check_callable, check_flag, check_instance, check_integer, check_path, check_text
from torchrl_pomdp.collectors.states import StateSampler
from torchrl_pomdp.envs.belief_env import BeliefEnv
from torchrl_pomdp.identity import digest
from torchrl_pomdp.kept import keep, kept
from torchrl_pomdp.modules.lookahead import simulated_steps
from torchrl_pomdp.modules.policies import Policy, controls_of
from torchrl_pomdp.modules.threads import rows_at_once
from torchrl_pomdp.progress import progress_bar
from torchrl_pomdp.workers import LOCAL, Workers

__all__ = ["LabelCollector", "OnLabels"]

Summary = Callable[[TensorDictBase], Any]
OnLabels = Callable[[int, bool], None]
"""Called with a number of labelled states, and whether an interrupted run had labelled them."""


class Block(NamedTuple):
    """Labelled states that some workers have.

    Attributes:
        handle: for the workers to find them by.
        summary: what was to be told about them.
    """

    handle: Any
    summary: Any


# States that are drawn, labelled and kept at once on a CPU; the data do not depend on it. Many, because a rollout is slow at
# its end, when few trajectories are left.
_BLOCK = 16384
# Most states of a batch, which is kept in memory.
_LARGEST = 10**9


# Arguments of ``update_policy_weights_`` that say where to take the weights from.
_SOURCES = {"policy", "policy_weights", "weights", "weights_dict"}


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
        total_frames: labelled states in all, rounded up to whole batches; -1 for no end.
        num_workers: number of collectors that share the work; this one is number ``worker_idx``.
        cache: folder for labelled blocks; those that an interrupted run has left there are read instead of being labelled
            again, unless they are damaged or another run's. None keeps nothing.
        progress: whether to show a progress bar with the labelling rate.
        name: what the progress bar calls the work.
        on_labels: called after every block with its number of states and whether they were read from the cache.
        kwargs: further arguments of ``torchrl.collectors.Collector``.

    Attributes:
        simulated_steps: belief steps of the simulations behind the labels so far, cached ones too.
        seconds: time that they and drawing the states took.

    Raises:
        TypeError: if an argument is of the wrong kind, or the environment is not a :class:`BeliefEnv`.
        ValueError: if a number is not positive.
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
        # A worker of several is given a factory instead.
        if kwargs.get("policy_factory") is None:
            check_callable("policy", policy)
        self.states, self.num_workers = check_callable("states", states), check_integer("num_workers", num_workers, 1)
        check_callable("label", label)
        frames_per_batch = check_integer("frames_per_batch", frames_per_batch, 1, _LARGEST)
        if check_integer("total_frames", total_frames, -1) == 0:
            raise ValueError("total_frames must be a positive integer, or -1 for no end, got 0")
        self.cache = None if cache is None else check_path("cache", cache)
        self.progress, self.name = check_flag("progress", progress), check_text("name", name)
        self.on_labels = None if on_labels is None else check_callable("on_labels", on_labels)
        # The data is no environment rollout: buffers of that layout and transforms for it do not apply.
        kwargs["use_buffers"] = False
        kwargs["auto_register_policy_transforms"] = False
        # Any callable on feature states is a policy; TorchRL would map its arguments to entries.
        kwargs["trust_policy"] = True
        env = _environment(create_env_fn)
        if policy is not None:
            first = env.model.derive(
                env.model.drawn(self.states, torch.zeros(1, dtype=torch.int64, device=env.device), "states")
            )
            env.model.check_controls(first, controls_of("policy", policy, first.copy()))
        super().__init__(
            env,
            copy.deepcopy(policy),
            frames_per_batch=frames_per_batch,
            total_frames=total_frames,
            **kwargs,
        )
        # The collector below knows the copy alone.
        self._given = weakref.ref(policy) if isinstance(policy, nn.Module) else None
        self.labeller = check_instance("label(model, policy)", label(self.env.model, self.policy), TensorDictModuleBase)
        self._batches, self.simulated_steps, self.seconds = 0, 0, 0.0

    def update_policy_weights_(self, policy_or_weights: Any = None, **kwargs: Any) -> None:
        """Give the policy that is simulated other weights.

        Args:
            policy_or_weights: the weights, or a module that has them; by default the policy that the collector was made with.
            kwargs: see ``torchrl.collectors.Collector``.

        Raises:
            RuntimeError: by TorchRL, if there are no weights to take.
        """
        given = any(kwargs.get(source) is not None for source in _SOURCES)
        if policy_or_weights is None and not given and self._given is not None:
            policy_or_weights = self._given()
        if isinstance(policy_or_weights, nn.Module):
            policy_or_weights = TensorDict.from_module(policy_or_weights)
        super().update_policy_weights_(policy_or_weights, **kwargs)

    def rollout(self) -> TensorDictBase:
        """The next batch of labelled states, ``[frames_per_batch]``."""
        numbers = self._next_numbers()
        batch: Any = torch.cat([block.handle for block in self._blocks(numbers, LOCAL, None)], 0)
        batch.set(("collector", "traj_ids"), numbers)
        return batch.set(("collector", "mask"), torch.ones_like(numbers, dtype=torch.bool))

    def blocks(self, workers: Workers, summary: Summary) -> Iterator[Block]:
        """The next batch block by block, labelled by ``workers``, who begin at once; nothing keeps all of it in memory.

        Args:
            workers: who labels.
            summary: what to tell about the states of a block.
        """
        return self._blocks(self._next_numbers(), workers, summary)

    def _next_numbers(self) -> Tensor:
        """Numbers of the next batch's states."""
        size = self.requested_frames_per_batch
        # Batches are shared out in blocks, so that the workers' stacked batches are in order.
        first = (self._batches * self.num_workers + (self.worker_idx or 0)) * size
        self._batches += 1
        return torch.arange(first, first + size, device=self.env.device)

    def _blocks(self, numbers: Tensor, workers: Workers, summary: Summary | None) -> Iterator[Block]:
        """Blocks of labelled states with the given numbers, in order; some are given out at once."""
        pieces = numbers.split(max(1, rows_at_once(_BLOCK, numbers.device) // workers.pieces))
        paths = [None if self.cache is None else self.cache / f"{int(n[0]):012d}-{len(n)}.pt" for n in pieces]
        there = [path is not None and path.is_file() for path in paths]
        label = partial(workers.tasks, label_states, (self.env.model, self.labeller, self.states, summary), name=self._title)
        made = label([own for own, found in zip(pieces, there, strict=True) if not found])

        def labelled() -> Iterator[tuple[Any, dict[str, Any], bool]]:
            """Handle and report of each block, and whether it comes from the cache, where this labelling has made it."""
            owner = "" if self.cache is None else digest([__version__, self.labeller, self.states])
            for own, path, found in zip(pieces, paths, there, strict=True):
                content = kept(path, f"{owner} {path.name}", self.env.device) if path is not None and found else None
                if content is not None:
                    states = TensorDict(content.pop("states"), own.shape, device=self.env.device)
                    yield workers.put(states), {**content, "summary": summary and summary(states)}, True
                    continue
                # A damaged block is made again by itself.
                handle, report = next(label([own]) if found else made)
                if path is not None:
                    took = {key: report[key] for key in ("simulated_steps", "seconds")}
                    keep(path, f"{owner} {path.name}", {"states": workers.fetch(handle).to_dict(), **took})
                yield handle, report, False

        return self._counted(pieces, labelled())

    def _counted(self, pieces: Sequence[Tensor], labelled: Iterator[tuple[Any, dict[str, Any], bool]]) -> Iterator[Block]:
        """The blocks, and what they took is added up and shown."""
        with progress_bar(sum(map(len, pieces)), "state", self.name, self.progress) as bar:
            for own, (handle, report, cached) in zip(pieces, labelled, strict=True):
                self.simulated_steps += report["simulated_steps"]
                self.seconds += report["seconds"]
                bar.update(len(own))
                if self.on_labels is not None:
                    self.on_labels(len(own), cached)
                yield Block(handle, report["summary"])

    def _title(self, numbers: Tensor) -> str:
        """What the labelling of a block is called."""
        return f"{self.name}, states {int(numbers[0])} … {int(numbers[-1])}"

    def state_dict(self) -> dict[str, Any]:
        """State of the base policy and the number of batches made."""
        return {**super().state_dict(), "batches": self._batches}

    def load_state_dict(self, state_dict: dict[str, Any], **kwargs: Any) -> None:
        """Continue after the batch at which ``state_dict`` was taken."""
        state = dict(state_dict)
        self._batches = state.pop("batches")
        super().load_state_dict(state, **kwargs)


def label_states(shared: tuple[Any, ...], numbers: Tensor) -> tuple[TensorDictBase, dict[str, Any]]:
    """Labelled states with the given numbers ``[N]``; and what they took, and their summary if there is one.

    Args:
        shared: model, labelling module, numbered states, and what to tell about them.
        numbers: numbers of the states, ``[N]``.
    """
    model, labeller, states, summary = shared
    before, begin = simulated_steps(labeller) or 0, time.perf_counter()
    with torch.no_grad():
        block = labeller(model.derive(model.drawn(states, numbers, "states")))
    seconds, steps = time.perf_counter() - begin, (simulated_steps(labeller) or 0) - before
    report = {"simulated_steps": steps, "seconds": seconds, "summary": summary and summary(block)}
    return block, report


def _environment(create_env_fn: Any) -> BeliefEnv:
    """The environment of a collector."""
    makes = callable(create_env_fn) and not isinstance(create_env_fn, (nn.Module, type))
    env = create_env_fn() if makes else create_env_fn
    if not isinstance(env, BeliefEnv):
        raise TypeError(f"create_env_fn must be or must give a BeliefEnv, got {type(env).__name__}")
    return env
