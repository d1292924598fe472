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

# What tables hold of a graph and of parts, which are the old ones to an old policy.
_GRAPH = ("destinations", "order", "distances", "first_controls", "first_moves", "unrestricted")
_PARTS = ("columns", "damage_threshold", "low", "high")


def changed_engine(
    policy: Any, old: RepairModel, new: RepairModel, limits: Limited, lost: int | None, place: int
) -> RepairEngine | None:
    """The engine of a policy of model ``old`` in ``new``; None where the policy has no twin.

    Args:
        policy: the old policy.
        old: the model that it was made for.
        new: the model that is simulated.
        lost: number of the robot that is lost; None: there are as many as before.
        place: where it broke down.
        limits: see :func:`~torchrl_pomdp.modules.scalar.scalar_engine`.
    """
    before = scalar_engine(policy, old, limits._replace(truncation=None, terminal_cost=None))
    # Costs of levels, those that parts are told by among them, are read from the new model's tables, where its chain is.
    if not isinstance(before, RepairEngine) or not torch.equal(old.costs, new.costs):
        return None
    known, now = before.tables, make_tables(new, limits.max_steps + 2)
    if not np.array_equal(known.prices, now.prices):
        return None
    seen = now._replace(**{name: getattr(known, name) for name in (*_GRAPH, *_PARTS)})
    # Locations and controls take two of these numbers each, and begin where one of theirs may.
    own = before.numbers + before.numbers % 2
    data = seen, before.policy, -1 if lost is None else lost, place, own
    numbers = own + 4 * old.num_robots
    return repair_engine(elsewhere, data, new, new, limits, numbers=numbers, refresh=before.refresh)
