r"""Partitioned architectures: N local policies, or values, that act as one (paper, Section V)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_pomdp.envs.belief import take_rows
from torchrl_pomdp.modules.networks import LocalNetwork, evaluate_networks, invert

__all__ = ["PartitionedPolicy", "PartitionedValue"]


class _Partitioned(TensorDictModuleBase):
    """Routes the rows of a batch to the modules of their parts.

    A module that is local to several parts is called once for all of them. Networks of one kind, which share an encoder, are
    evaluated together: the batch is sorted by network and encoded once.
    """

    def __init__(self, members: Sequence[TensorDictModuleBase]) -> None:
        super().__init__()
        distinct = dict.fromkeys(members)
        kinds = {member.kind for member in distinct if isinstance(member, LocalNetwork)}
        self._networks = [m for m in distinct if isinstance(m, LocalNetwork)] if len(kinds) == 1 else []
        # Networks come last, so that their rows are neighbours once the batch is sorted.
        self._others = [member for member in distinct if member not in self._networks]
        numbers = {member: number for number, member in enumerate([*self._others, *self._networks])}
        self.register_buffer("_member_of_part", torch.tensor([numbers[m] for m in members]), persistent=False)
        read = {str(key): None for member in members for key in member.in_keys}
        self.in_keys = [*read, "partition"]
        written = [set(member.out_keys) for member in members]
        self.out_keys = [key for key in members[0].out_keys if all(key in keys for keys in written)]

    # Which rows go where depends on the data, which a compiler cannot follow.
    @torch.compiler.disable
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the entries that all local modules write, for feature states ``[*B]``."""
        part, parts = tensordict.get("partition").reshape(-1), self._member_of_part.numel()
        if part.numel() and not 0 <= int(part.min()) <= int(part.max()) < parts:
            raise ValueError(f"partition must hold parts 0..{parts - 1}, got {part.unique().tolist()}")
        flat = tensordict.select(*self.in_keys).reshape(-1)
        if not self._networks and len(self._others) == 1:
            result = self._others[0](flat).select(*self.out_keys)
        else:
            result = self._route(flat, self._member_of_part[part])
        return tensordict.update(result.reshape(tensordict.batch_size))

    def _route(self, y: TensorDictBase, chosen: Tensor) -> TensorDictBase:
        """Entries of the members number ``chosen`` ``[N]`` at the rows of ``y`` ``[N]``."""
        order = chosen.argsort(stable=True)
        counts = chosen.bincount(minlength=len(self._others) + len(self._networks)).tolist()
        outputs = [
            member(take_rows(y, index)).select(*self.out_keys)
            for member, index in zip(self._others, order.split(counts), strict=False)
            if index.numel()
        ]
        own = counts[len(self._others) :]
        networks = [(network, count) for network, count in zip(self._networks, own, strict=True) if count]
        if networks:
            rest = order.numel() - sum(count for _, count in networks)
            entries, rows = evaluate_networks([n for n, _ in networks], y, order[rest:], [count for _, count in networks])
            order = torch.cat([order[:rest], rows])
            outputs.append(entries.select(*self.out_keys))
        joined: Any = torch.cat(outputs, 0)
        return joined[invert(order)]


class PartitionedPolicy(_Partitioned):
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
        if not policies:
            raise ValueError("policies is empty: a partitioned policy needs one policy for each part")
        super().__init__(policies)
        self.policies = nn.ModuleList(policies)


class PartitionedValue(_Partitioned):
    r"""Global cost approximation :math:`\hat J` whose value at a state of :math:`Y_\nu` is the local one's (Section V).

    It is a terminal cost for rollouts, and writes ``"state_value"`` ``[*B]``. Any module that writes it can be local: value
    networks, the closed-form terminal costs, or a mixture, such as networks in the endgame parts alone.

    Args:
        values: one local value for each part, in the order of the parts.

    Raises:
        ValueError: if there is no value; when called, if a part has no value.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> from torchrl_pomdp.modules import NeverRepairCost
        >>> problem = make_problem("linear20")
        >>> value = PartitionedValue([NeverRepairCost(problem.model)] * 6)
        >>> value(problem.model.with_features(problem.start(torch.arange(4))))["state_value"].shape
        torch.Size([4])
    """

    def __init__(self, values: Sequence[TensorDictModuleBase]) -> None:
        if not values:
            raise ValueError("values is empty: a partitioned value needs one value for each part")
        super().__init__(values)
        self.values = nn.ModuleList(values)
