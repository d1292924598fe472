r"""The partitioned policy: N local policies that act as one (paper, Section V)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

__all__ = ["PartitionedPolicy"]


class PartitionedPolicy(TensorDictModuleBase):
    r"""Global policy whose control at a state of :math:`Y_\nu` is the local policy :math:`\nu`'s.

    The part is read from ``"partition"``, never computed again. Any policy can be local: networks, base policies, or a
    mixture, such as networks in the endgame parts and the greedy policy elsewhere.

    Args:
        policies: one local policy for each part, in the order of the parts.

    Raises:
        ValueError: if there is no policy; when called, if a part has no policy.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> from torchrl_pomdp.modules import GreedyRepair
        >>> problem = make_problem("linear20")
        >>> policy = PartitionedPolicy([GreedyRepair(problem.model)] * 6)
        >>> policy(problem.model.with_features(problem.start(torch.arange(4))))["action"].shape
        torch.Size([4])
    """

    def __init__(self, policies: Sequence[TensorDictModuleBase]) -> None:
        super().__init__()
        if not policies:
            raise ValueError("policies is empty: a partitioned policy needs one policy for each part")
        self.policies = nn.ModuleList(policies)
        read = {str(key): None for policy in policies for key in policy.in_keys}
        self.in_keys = [*read, "partition"]
        written = [set(policy.out_keys) for policy in policies]
        self.out_keys = [key for key in policies[0].out_keys if all(key in keys for keys in written)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the entries that all local policies write, ``"action"`` among them."""
        part = tensordict.get("partition").reshape(-1)
        flat = tensordict.select(*self.in_keys).reshape(-1)
        present = part.unique().tolist()
        if present and not 0 <= present[0] <= present[-1] < len(self.policies):
            raise ValueError(f"partition must hold parts 0..{len(self.policies) - 1}, got {present}")
        order = part.argsort(stable=True)
        outputs = [
            self.policies[nu](flat[rows]).select(*self.out_keys)
            for nu in present
            for rows in [(part == nu).nonzero().squeeze(-1)]
        ]
        if not outputs:
            raise ValueError("the batch is empty: there is no state to choose a control for")
        merged = torch.cat(outputs, 0)[order.argsort()]
        return tensordict.update(merged.reshape(tensordict.batch_size))
