r"""The collector of (feature state, rollout control) pairs, :math:`(y^s,u^s)` of the paper's Section IV."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from tqdm import tqdm

from torchrl_pomdp.collectors.states import StateSampler
from torchrl_pomdp.envs.belief import BeliefEnv
from torchrl_pomdp.modules.lookahead import RolloutPolicy
from torchrl_pomdp.modules.rollout import Policy

__all__ = ["RolloutImprovement"]

# States drawn at once and labelled between two updates of the progress bar; the data do not depend on either.
_DRAWN, _LABELLED = 32768, 1024


class RolloutImprovement(Collector):
    r"""Collector whose frames are feature states labelled with the rollout control of a base policy.

    Every batch is a flat TensorDict ``[frames_per_batch]`` with the feature state (core entries, ``action_mask``,
    ``partition``), ``action`` (the rollout control), ``q_factors`` ``[., U]`` (costs), ``("collector", "mask")`` and the
    state's number in ``("collector", "traj_ids")``. It has no ``"next"``: a label is no transition. It runs alone and, as
    ``collector_class``, under ``MultiSyncCollector``.

    State number i of the run is ``states(i)`` whichever worker labels it, and a label is a function of the state and the
    seed alone: any number of workers yields the same data.

    Args:
        create_env_fn: a :class:`BeliefEnv` or a function that makes one; it gives the model.
        policy: base policy; a copy is kept, which ``update_policy_weights_`` changes.

    Keyword Args:
        states: the numbered training states.
        frames_per_batch: labelled states in each batch.
        total_frames: labelled states in all; -1 for no end.
        label: makes the labelling policy from model and base policy; default :class:`RolloutPolicy` as it comes.
        num_workers: number of collectors that share the work; this one is number ``worker_idx``.
        progress: whether to show a progress bar with the labelling rate.
        kwargs: further arguments of ``torchrl.collectors.Collector``.

    Raises:
        TypeError: if the environment is not a :class:`BeliefEnv`.
        ValueError: if ``num_workers`` is not positive.

    Examples:
        >>> from torchrl_pomdp.collectors import PartSampler
        >>> from torchrl_pomdp.envs import make_problem
        >>> from torchrl_pomdp.modules import GreedyRepair
        >>> problem = make_problem("linear20")
        >>> collector = RolloutImprovement(
        ...     BeliefEnv(problem.model, problem.start),
        ...     GreedyRepair(problem.model),
        ...     states=PartSampler(dict(enumerate(problem.training)), seed=0),
        ...     frames_per_batch=12,
        ...     total_frames=24,
        ... )
        >>> [batch["q_factors"].shape for batch in collector]
        [torch.Size([12, 3]), torch.Size([12, 3])]
    """

    def __init__(
        self,
        create_env_fn: BeliefEnv | Callable[[], BeliefEnv],
        policy: Policy | None = None,
        *,
        states: StateSampler,
        frames_per_batch: int,
        total_frames: int = -1,
        label: Callable[..., RolloutPolicy] = RolloutPolicy,
        num_workers: int = 1,
        progress: bool = False,
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
        self.states, self.num_workers, self.progress = states, num_workers, progress
        self.labeller = label(self.env.model, self.policy)
        self._batches = 0

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """The next batch of labelled states, ``[frames_per_batch]``."""
        size = self.requested_frames_per_batch
        # Batches are shared out in blocks, so that the workers' stacked batches are in order.
        first = (self._batches * self.num_workers + (self.worker_idx or 0)) * size
        self._batches += 1
        index = torch.arange(first, first + size, device=self.env.device)
        blocks = []
        with tqdm(total=size, unit="state", desc="label", disable=not self.progress, leave=False) as bar:
            for numbers in index.split(_DRAWN):
                for y in self.env.model.with_features(self.states(numbers)).split(_LABELLED):
                    blocks.append(self.labeller(y))
                    bar.update(y.batch_size.numel())
        batch: Any = torch.cat(blocks, 0)
        batch.set(("collector", "traj_ids"), index)
        return batch.set(("collector", "mask"), torch.ones_like(index, dtype=torch.bool))

    def state_dict(self) -> dict[str, Any]:
        """State of the base policy and the number of batches made."""
        return {**super().state_dict(), "batches": self._batches}

    def load_state_dict(self, state_dict: dict[str, Any], **kwargs: Any) -> None:
        """Continue after the batch at which ``state_dict`` was taken."""
        state = dict(state_dict)
        self._batches = state.pop("batches")
        super().load_state_dict(state, **kwargs)
