r"""Partitioned architectures: N local policies, or values, that act as one (paper, Section V)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_pomdp.checks import check_instance, shown
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.rows import flat_rows, take_rows
from torchrl_pomdp.modules.networks import LocalNetwork, evaluate_networks
from torchrl_pomdp.modules.scalar import Limited, SearchEngine, local_engine
from torchrl_pomdp.tensor_checks import check_entries

__all__ = ["PartitionedPolicy", "PartitionedValue"]


class _Partitioned(TensorDictModuleBase):
    """Routes the rows of a batch to the modules of their parts.

    A module that is local to several parts is called once for all of them. Networks of one kind, which share an encoder, are
    evaluated together: the batch is sorted by network and encoded once.
    """

    def __init__(self, name: str, members: Any) -> None:
        if not isinstance(members, Sequence) and not isinstance(members, nn.ModuleList):
            raise TypeError(f"{name} must be a sequence of modules, one for each part, got {shown(members)}")
        if not len(members):
            raise ValueError(f"{name} is empty: a partitioned module needs one local module for each part")
        for part, member in enumerate(members):
            check_instance(f"{name}[{part}]", member, TensorDictModuleBase)
        super().__init__()
        self._name = name
        setattr(self, name, nn.ModuleList(members))

    @property
    def num_parts(self) -> int:
        """N, for how many parts there are local modules."""
        return len(getattr(self, self._name))

    # Local modules may be replaced, by others that read or write other entries.

    @property
    def in_keys(self) -> list[str]:
        """What the local modules read, and the part."""
        return [*{str(key): None for member in getattr(self, self._name) for key in member.in_keys}, "partition"]

    @property
    def out_keys(self) -> list[str]:
        """What all local modules write."""
        first, *others = (list(member.out_keys) for member in getattr(self, self._name))
        return [key for key in first if all(key in keys for keys in others)]

    # Which rows go where depends on the data, which a compiler cannot follow.
    @torch.compiler.disable
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the entries that all local modules write, for feature states ``[*B]``."""
        members = list(getattr(self, self._name))
        check_instance("tensordict", tensordict, TensorDictBase)
        if tensordict.get("partition", None) is None:
            raise ValueError("tensordict lacks the entry 'partition': add it by model.with_features(y)")
        part = check_entries("tensordict", tensordict, self.in_keys).get("partition").reshape(-1)
        known = part.dtype == torch.int64 and (part.numel() == 0 or 0 <= int(part.min()) <= int(part.max()) < len(members))
        if not known:
            raise ValueError(f"partition must hold parts 0..{len(members) - 1}, got {part.unique().tolist()}")
        # What agents are told, where their networks are taught.
        told = [] if tensordict.get("told", None) is None else ["told"]
        flat = flat_rows(tensordict.select(*self.in_keys, *told))
        result = self._route(flat, part, members)
        return tensordict.update(result.reshape(tensordict.batch_size))

    def _route(self, y: TensorDictBase, part: Tensor, members: list[Any]) -> TensorDictBase:
        """Entries at the rows of ``y`` ``[N]``, each by the member of its part ``[N]``."""
        distinct = list(dict.fromkeys(members))
        networks = [member for member in distinct if isinstance(member, LocalNetwork) and member.kind is not None]
        networks = networks if len({network.kind for network in networks}) == 1 else []
        if (len(distinct) == 1 and not networks) or len(part) == 0:
            return distinct[0](y).select(*self.out_keys)
        # Networks come last, so that their rows are neighbours once the batch is sorted.
        others = [member for member in distinct if member not in networks]
        numbers = {member: number for number, member in enumerate([*others, *networks])}
        chosen = torch.tensor([numbers[member] for member in members], device=part.device)[part]
        order = chosen.argsort(stable=True)
        counts = chosen.bincount(minlength=len(distinct)).tolist()
        outputs = [
            member(take_rows(y, index)).select(*self.out_keys)
            for member, index in zip(others, order.split(counts), strict=False)
            if index.numel()
        ]
        present = [(network, count) for network, count in zip(networks, counts[len(others) :], strict=True) if count]
        if present:
            own = order[order.numel() - sum(count for _, count in present) :]
            entries = evaluate_networks([network for network, _ in present], y, own, [count for _, count in present])
            outputs.append(entries.select(*self.out_keys))
        joined: Any = torch.cat(outputs, 0)
        return joined[torch.empty_like(order).index_copy_(0, order, torch.arange(order.numel(), device=order.device))]


class PartitionedPolicy(_Partitioned):
    r"""Global policy whose control at a state of :math:`Y_\nu` is the local policy :math:`\nu`'s.

    The part is read from ``"partition"``, never computed again. Any policy can be local: networks, base policies, or a
    mixture, such as networks in the endgame parts and the greedy policy elsewhere.

    Args:
        policies: one local policy for each part, in the order of the parts.

    Raises:
        ValueError: if there is no policy; when called, if a part has no policy.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> problem = make_problem("linear20")
        >>> policy = PartitionedPolicy([GreedyRepair(problem.model)] * 6)
        >>> policy(problem.model.with_features(problem.start(torch.arange(4))))["action"].shape
        torch.Size([4])
    """

    policies: nn.ModuleList

    def __init__(self, policies: Sequence[TensorDictModuleBase]) -> None:
        super().__init__("policies", policies)

    def scalar_engine(self, model: BeliefModel, limits: Limited) -> SearchEngine | None:
        """Compiled simulations, see :func:`~torchrl_pomdp.modules.scalar.scalar_engine`."""
        return local_engine(list(self.policies), model, limits)


def local_policies(name: str, policy: TensorDictModuleBase, num_parts: int) -> list[TensorDictModuleBase]:
    """The policy of each part: of a partitioned policy the local ones, of any other itself.

    Raises:
        ValueError: if a partitioned policy, which ``name`` names, has other parts.
    """
    if not isinstance(policy, PartitionedPolicy):
        return [policy] * num_parts
    if len(policy.policies) != num_parts:
        raise ValueError(f"{name} must have {num_parts} local policies, one for each part, got {len(policy.policies)}")
    return list(policy.policies)


class PartitionedValue(_Partitioned):
    r"""Global cost approximation :math:`\hat J` whose value at a state of :math:`Y_\nu` is the local one's (Section V).

    It is a terminal cost for rollouts, and writes ``"state_value"`` ``[*B]``. Any module that writes it can be local: value
    networks, the closed-form terminal costs, or a mixture, such as networks in the endgame parts alone.

    Args:
        values: one local value for each part, in the order of the parts.

    Raises:
        ValueError: if there is no value; when called, if a part has no value.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import NeverRepairCost
        >>> problem = make_problem("linear20")
        >>> value = PartitionedValue([NeverRepairCost(problem.model)] * 6)
        >>> value(problem.model.with_features(problem.start(torch.arange(4))))["state_value"].shape
        torch.Size([4])
    """

    values: nn.ModuleList

    def __init__(self, values: Sequence[TensorDictModuleBase]) -> None:
        super().__init__("values", values)
