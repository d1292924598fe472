r"""The partitioned policy: N local policies that act as one (paper, Section V)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torchrl_pomdp.envs.belief import take_rows

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
        # A policy that is local to several parts is called once for all of them.
        self._distinct = list(dict.fromkeys(policies))
        self.register_buffer("_policy_of_part", torch.tensor([self._distinct.index(p) for p in policies]), persistent=False)
        read = {str(key): None for policy in policies for key in policy.in_keys}
        self.in_keys = [*read, "partition"]
        written = [set(policy.out_keys) for policy in policies]
        self.out_keys = [key for key in policies[0].out_keys if all(key in keys for keys in written)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the entries that all local policies write, ``"action"`` among them."""
        part = tensordict.get("partition").reshape(-1)
        if part.numel() and not 0 <= int(part.min()) <= int(part.max()) < len(self.policies):
            raise ValueError(f"partition must hold parts 0..{len(self.policies) - 1}, got {part.unique().tolist()}")
        flat = tensordict.select(*self.in_keys).reshape(-1)
        if len(self._distinct) == 1:
            result = self._distinct[0](flat).select(*self.out_keys)
        else:
            chosen = self._policy_of_part[part]
            present = chosen.unique().tolist()
            rows = [(chosen == number).nonzero().squeeze(-1) for number in present]
            outputs = [
                self._distinct[number](take_rows(flat, index)).select(*self.out_keys)
                for number, index in zip(present, rows, strict=True)
            ]
            result = torch.cat(outputs, 0)[torch.cat(rows).argsort()]
        return tensordict.update(result.reshape(tensordict.batch_size))
