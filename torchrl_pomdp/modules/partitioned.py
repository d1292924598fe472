r"""The partitioned policy: N local policies that act as one (paper, Section V)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_pomdp.envs.belief import take_rows
from torchrl_pomdp.modules.networks import PolicyNetwork, invert, network_outputs

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
        # A policy that is local to several parts is called once for all of them. Networks that read the same features
        # come last, so that their rows are neighbours once the batch is sorted by policy.
        distinct = dict.fromkeys(policies)
        encoders = {policy.encoder: None for policy in distinct if isinstance(policy, PolicyNetwork)}
        self._encoder = next(iter(encoders)) if len(encoders) == 1 else None
        self._networks = [p for p in distinct if isinstance(p, PolicyNetwork) and self._encoder is not None]
        self._others = [p for p in distinct if p not in self._networks]
        numbers = {policy: number for number, policy in enumerate([*self._others, *self._networks])}
        self.register_buffer("_policy_of_part", torch.tensor([numbers[p] for p in policies]), persistent=False)
        read = {str(key): None for policy in policies for key in policy.in_keys}
        self.in_keys = [*read, "partition"]
        written = [set(policy.out_keys) for policy in policies]
        self.out_keys = [key for key in policies[0].out_keys if all(key in keys for keys in written)]

    # Which rows go where depends on the data, which a compiler cannot follow.
    @torch.compiler.disable
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the entries that all local policies write, ``"action"`` among them."""
        part = tensordict.get("partition").reshape(-1)
        if part.numel() and not 0 <= int(part.min()) <= int(part.max()) < len(self.policies):
            raise ValueError(f"partition must hold parts 0..{len(self.policies) - 1}, got {part.unique().tolist()}")
        flat = tensordict.select(*self.in_keys).reshape(-1)
        if not self._networks and len(self._others) == 1:
            result = self._others[0](flat).select(*self.out_keys)
        else:
            result = self._route(flat, self._policy_of_part[part])
        return tensordict.update(result.reshape(tensordict.batch_size))

    def _route(self, y: TensorDictBase, chosen: Tensor) -> TensorDictBase:
        """Outputs of the policies number ``chosen`` ``[N]`` at the rows of ``y`` ``[N]``."""
        order = chosen.argsort(stable=True)
        counts = chosen.bincount(minlength=len(self._others) + len(self._networks)).tolist()
        outputs = [
            policy(take_rows(y, index)).select(*self.out_keys)
            for policy, index in zip(self._others, order.split(counts), strict=False)
            if index.numel()
        ]
        networks = [
            (network, count) for network, count in zip(self._networks, counts[len(self._others) :], strict=True) if count
        ]
        if networks:
            rest = order.numel() - sum(count for _, count in networks)
            decisions, rows = self._decide(y, order[rest:], *zip(*networks, strict=True))
            order = torch.cat([order[:rest], rows])
            outputs.append(decisions)
        joined: Any = torch.cat(outputs, 0)
        return joined[invert(order)]

    def _decide(
        self, y: TensorDictBase, rows: Tensor, networks: Sequence[PolicyNetwork], counts: Sequence[int]
    ) -> tuple[TensorDictBase, Tensor]:
        """Outputs of the networks at ``rows``, of which each has the next ``counts``, and the rows in the outputs' order."""
        logits, rows = network_outputs(networks, y, rows, counts)
        logits = logits.masked_fill(~y.get("action_mask").index_select(0, rows), -torch.inf)
        return TensorDict({"logits": logits, "action": logits.argmax(-1)}, rows.shape).select(*self.out_keys), rows
