"""Policies, encoders and terminal costs of repair problems (paper, Section VI)."""

from collections.abc import Sequence
from typing import Any, cast

from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.repair.model import RepairModel
from torchrl_pomdp.modules.repair.base_policies import GreedyRepair, UrgencyRepair
from torchrl_pomdp.modules.repair.changed import OldPolicy
from torchrl_pomdp.modules.repair.encoders import RelativeEncoder, RobotEncoder
from torchrl_pomdp.modules.repair.terminal_costs import NeverRepairCost, SteadyStateCost
from torchrl_pomdp.modules.scalar import Limited, SearchEngine, offer_engines

__all__ = [
    "GreedyRepair",
    "NeverRepairCost",
    "OldPolicy",
    "RelativeEncoder",
    "RobotEncoder",
    "SteadyStateCost",
    "UrgencyRepair",
]


def _local_engine(policies: Sequence[Any], model: BeliefModel, limits: Limited) -> SearchEngine | None:
    from torchrl_pomdp.modules.repair.scalar.networks import network_engine

    return network_engine(policies, cast(RepairModel, model), limits)


offer_engines(RepairModel, _local_engine)
