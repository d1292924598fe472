r"""The collector of (feature state, cost of the current policy) pairs, :math:`(y^s,\beta^s)` of the paper's Section IV."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torchrl_pomdp.collectors.labels import LabelCollector
from torchrl_pomdp.modules.terminal_costs import PolicyCost

__all__ = ["PolicyEvaluation"]


class PolicyEvaluation(LabelCollector):
    r"""Collector whose frames are feature states labelled with the simulated cost of a policy from there.

    The label entry is ``cost_to_go`` ``[.]``, the target of a value network. The policy is the *global* one: a trajectory
    that leaves the part of its first state goes on under the policies of the other parts (paper, Section V).

    Args:
        args: environment and policy, see :class:`LabelCollector`.

    Keyword Args:
        label: makes the module that writes ``cost_to_go`` from model and policy; default :class:`PolicyCost`, one trajectory
            without truncation.
        kwargs: see :class:`LabelCollector`; ``states`` and ``frames_per_batch`` are required.

    Examples:
        >>> from torchrl_pomdp.collectors import PartSampler
        >>> from torchrl_pomdp.envs import BeliefEnv
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> problem = make_problem("linear20")
        >>> collector = PolicyEvaluation(
        ...     BeliefEnv(problem.model, problem.start),
        ...     GreedyRepair(problem.model),
        ...     states=PartSampler({part: problem.training[part] for part in (3, 4, 5)}, seed=0),
        ...     frames_per_batch=12,
        ...     total_frames=12,
        ... )
        >>> [bool((batch["cost_to_go"] > 0).all()) for batch in collector]
        [True]
    """

    def __init__(self, *args: Any, label: Callable[..., PolicyCost] = PolicyCost, **kwargs: Any) -> None:
        super().__init__(*args, label=label, **kwargs)
