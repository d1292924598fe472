"""What a policy and a terminal cost are, and what is checked of what they give."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_callable, shown
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.tensor_checks import place

__all__ = ["Policy", "TerminalCost", "check_finite", "check_policy", "controls_of", "read_by", "terminal_costs"]

Policy = Callable[[TensorDictBase], TensorDictBase]
"""A policy writes ``"action"``, int64 ``[*B]``, into a TensorDict of feature states; any TensorDictModule with that key."""

TerminalCost = Callable[[TensorDictBase], Tensor | TensorDictBase]
r"""Terminal cost approximation :math:`\hat J`: feature states ``[*B]`` to costs ``[*B]``, or a TensorDictModule that writes
them as ``"state_value"`` ``[*B]`` (costs, lower is better). ``in_keys``, where it has them, name the features that it reads."""


def terminal_costs(terminal_cost: TerminalCost, y: TensorDictBase) -> Tensor:
    r""":math:`\hat J(y)` ``[*B]`` of either form of terminal cost.

    Args:
        terminal_cost: :math:`\hat J`.
        y: feature states ``[*B]`` with the entries that it reads; a TensorDictModule may write into it.

    Raises:
        TypeError: if it gives no costs.
        ValueError: if they have not the shape of the batch, or are not finite.
    """
    result = terminal_cost(y)
    cost = result.get("state_value", None) if isinstance(result, TensorDictBase) else result
    if cost is None and isinstance(result, TensorDictBase):
        raise ValueError("terminal_cost must return costs or write 'state_value', got a TensorDict without it")
    if not isinstance(cost, Tensor) or not cost.is_floating_point():
        raise TypeError(f"terminal_cost must return floating costs or write 'state_value', got {shown(cost)}")
    if cost.shape != y.batch_size:
        raise ValueError(f"terminal_cost must give costs of shape {tuple(y.batch_size)}, got {tuple(cost.shape)}")
    check_finite("terminal_cost must give finite costs", cost)
    return cost


def check_policy(name: str, policy: Any, model: BeliefModel) -> Any:
    """A policy or terminal cost, called ``name`` in messages, that can be called and is none for another model.

    Raises:
        TypeError: if it cannot be called.
        ValueError: if it has local modules for other parts than the model's, which may have none.
    """
    check_callable(name, policy)
    num_parts, partition = getattr(policy, "num_parts", None), model.partition
    if num_parts is not None and partition is None:
        raise ValueError(f"{name} must have no local modules, as the model has no partition, got {num_parts}")
    if partition is not None and num_parts not in (None, partition.num_parts):
        raise ValueError(
            f"{name} must have a local module for each of the model's {partition.num_parts} parts, got {num_parts}"
        )
    return policy


def controls_of(name: str, policy: Policy, y: TensorDictBase) -> Tensor:
    """The controls ``[*B]`` that a policy, called ``name`` in messages, writes at ``y`` ``[*B]``; it may write into ``y``.

    Raises:
        TypeError: if it returns no TensorDict with controls.
    """
    result = policy(y)
    u = result.get("action", None) if isinstance(result, TensorDictBase) else None
    if not isinstance(u, Tensor):
        raise TypeError(f"{name} must write 'action' into a TensorDict and return it, got {shown(result)}")
    return u


def check_finite(rule: str, costs: Tensor) -> None:
    """Raise the rule, and where it is broken, unless all costs are finite."""
    if not bool(torch.isfinite(costs).all()):
        where = tuple((~torch.isfinite(costs)).nonzero()[0].tolist())
        raise ValueError(f"{rule}, got {costs[where].item()}{place(where)}")


def read_by(reader: Policy | TerminalCost) -> tuple[str, ...] | None:
    """Features that a module says it reads; None, all of them, for a plain callable."""
    return tuple(getattr(reader, "in_keys", ())) or None
