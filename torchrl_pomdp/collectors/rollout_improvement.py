r"""The collector of (feature state, rollout control) pairs, :math:`(y^s,u^s)` of the paper's Section IV."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torchrl_pomdp.collectors.labels import LabelCollector
from torchrl_pomdp.modules.lookahead import RolloutPolicy
from torchrl_pomdp.modules.qfactors import SimulatedQFactors

__all__ = ["RolloutImprovement"]


class RolloutImprovement(LabelCollector):
    r"""Collector whose frames are feature states labelled with the rollout control of a base policy.

    The label entries are ``action`` (the rollout control) and ``q_factors`` ``[., U]`` (costs), or ``[., R, A]`` of
    :class:`~torchrl_pomdp.modules.MultiagentRollout`.

    Args:
        args: environment and base policy, see :class:`LabelCollector`.

    Keyword Args:
        label: makes the labelling policy from model and base policy; default :class:`RolloutPolicy` as it comes.
        kwargs: see :class:`LabelCollector`; ``states`` and ``frames_per_batch`` are required.

    Examples:
        >>> import torch
        >>> from torchrl_pomdp.collectors import PartSampler
        >>> from torchrl_pomdp.envs import BeliefEnv
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
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

    def __init__(self, *args: Any, label: Callable[..., SimulatedQFactors] = RolloutPolicy, **kwargs: Any) -> None:
        super().__init__(*args, label=label, **kwargs)
