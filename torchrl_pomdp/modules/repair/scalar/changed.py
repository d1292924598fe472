"""Compiled simulations of an old policy in a changed model, by the twin ``elsewhere``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from torchrl_pomdp.envs.repair.model import RepairModel
from torchrl_pomdp.modules.repair.scalar.engine import RepairEngine, repair_engine
from torchrl_pomdp.modules.repair.scalar.twins import elsewhere
from torchrl_pomdp.modules.scalar import Limited, scalar_engine

__all__ = ["changed_engine"]


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
    known = before.tables
    graph = known.destinations, known.order, known.distances, known.first_controls, known.first_moves, known.unrestricted
    after = repair_engine(elsewhere, (*graph, before.policy), new, new, limits, numbers=before.numbers, refresh=before.refresh)
    if after is None:
        return None
    own = after.tables
    parted = ("columns", "prices", "damage_threshold", "low", "high")
    return after if all(np.array_equal(getattr(known, name), getattr(own, name)) for name in parted) else None
