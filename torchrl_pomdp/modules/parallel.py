r"""Parallel rollout: one-step lookahead with several base policies (paper, Section III)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_pomdp.checks import check_instance, shown
from torchrl_pomdp.modules.lookahead import RolloutPolicy
from torchrl_pomdp.modules.qfactors import cheapest

__all__ = ["ParallelRollout"]


class ParallelRollout(TensorDictModuleBase):
    r"""Rollout of the best of several base policies: the Q-factor of a control is the smallest over the bases.

    .. math:: \tilde Q(y,u)=\min_i\tilde Q_i(y,u)

    With exact Q-factors the policy is at least as good as every base policy. With simulated ones the minimum is biased to
    the low side, the more the fewer trajectories there are.

    Args:
        policies: rollout policies of the same model, one for each base policy.

    Raises:
        TypeError: if there is anything but rollout policies.
        ValueError: if there is no policy, or they are not of one model.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair, UrgencyRepair
        >>> problem = make_problem("linear20")
        >>> bases = GreedyRepair(problem.model), UrgencyRepair(problem.model)
        >>> policy = ParallelRollout([RolloutPolicy(problem.model, base) for base in bases])
        >>> policy(problem.start(torch.arange(4)))["action"].shape
        torch.Size([4])
    """

    out_keys = ["action", "q_factors"]

    def __init__(self, policies: Sequence[RolloutPolicy]) -> None:
        super().__init__()
        if not isinstance(policies, Sequence):
            raise TypeError(f"policies must be a sequence of rollout policies, got {shown(policies)}")
        if not policies:
            raise ValueError("policies is empty: parallel rollout needs at least one rollout policy")
        for number, policy in enumerate(policies):
            check_instance(f"policies[{number}]", policy, RolloutPolicy)
        if any(policy.model is not policies[0].model for policy in policies):
            raise ValueError("policies must be rollout policies of one model, got several models")
        self.policies = nn.ModuleList(policies)
        self.in_keys = policies[0].in_keys

    @property
    def simulated_steps(self) -> int:
        """Belief steps simulated so far."""
        return sum(policy.simulated_steps for policy in set(self._rollouts()))

    def _rollouts(self) -> list[RolloutPolicy]:
        return [cast(RolloutPolicy, policy) for policy in self.policies]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"q_factors"`` ``[*B, U]`` (costs, ``+inf`` where illegal) and ``"action"`` ``[*B]`` (ties to the lower)."""
        q = self.q_factors(tensordict)
        return tensordict.update({"action": cheapest(q), "q_factors": q})

    def q_factors(self, y: TensorDictBase) -> Tensor:
        r""":math:`\min_i\tilde Q_i(y,u)` ``[*B, U]``, ``+inf`` where the control is illegal."""
        return torch.stack([policy.q_factors(y) for policy in self._rollouts()]).amin(0)
