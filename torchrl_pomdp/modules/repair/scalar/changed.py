"""Compiled simulations of an old policy in a changed model, by the twin ``elsewhere``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from torchrl_pomdp.envs.repair.model import RepairModel
from torchrl_pomdp.modules.repair.scalar.engine import RepairEngine, repair_engine
from torchrl_pomdp.modules.repair.scalar.tables import make_tables
from torchrl_pomdp.modules.repair.scalar.twins import elsewhere
from torchrl_pomdp.modules.scalar import Limited, scalar_engine

__all__ = ["changed_engine"]

# What tables hold of a graph, which is the old one to an old policy; and of parts, in which old and new model must agree.
_GRAPH = ("destinations", "order", "distances", "first_controls", "first_moves", "unrestricted")
_PARTS = ("columns", "prices", "damage_threshold", "low", "high")


def changed_engine(policy: Any, old: RepairModel, new: RepairModel, limits: Limited) -> RepairEngine | None:
    """The engine of a policy of model ``old`` in ``new``, of as many robots; None where the policy has no twin.

    Args:
        policy: the old policy.
        old: the model that it was made for.
        new: the model that is simulated.
        limits: see :func:`~torchrl_pomdp.modules.scalar.scalar_engine`.
    """
    before = scalar_engine(policy, old, limits._replace(truncation=None, terminal_cost=None))
    # Its costs of levels are read from the new model's tables, as are the parts.
    if not isinstance(before, RepairEngine) or not torch.equal(old.costs, new.costs):
        return None
    known, now = before.tables, make_tables(new, limits.max_steps + 2)
    if not all(np.array_equal(getattr(known, name), getattr(now, name)) for name in _PARTS):
        return None
    seen = now._replace(**{name: getattr(known, name) for name in _GRAPH})
    return repair_engine(elsewhere, (seen, before.policy), new, new, limits, numbers=before.numbers, refresh=before.refresh)
