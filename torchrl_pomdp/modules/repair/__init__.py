"""Policies, encoders and terminal costs of repair problems (paper, Section VI)."""

from torchrl_pomdp.modules.repair.base_policies import GreedyRepair, UrgencyRepair
from torchrl_pomdp.modules.repair.encoders import RelativeEncoder
from torchrl_pomdp.modules.repair.terminal_costs import NeverRepairCost, SteadyStateCost

__all__ = ["GreedyRepair", "NeverRepairCost", "RelativeEncoder", "SteadyStateCost", "UrgencyRepair"]
