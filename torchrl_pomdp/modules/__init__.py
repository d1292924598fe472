"""Policies, rollout, lookahead and partitioned networks (paper, Sections III to VI)."""

from torchrl_pomdp.modules.base_policies import GreedyRepair
from torchrl_pomdp.modules.lookahead import RolloutPolicy
from torchrl_pomdp.modules.networks import Encoder, FlatEncoder, PolicyNetwork, RelativeEncoder
from torchrl_pomdp.modules.partitioned import PartitionedPolicy
from torchrl_pomdp.modules.rollout import Policy, TerminalCost, TruncatedRollout
from torchrl_pomdp.modules.terminal_costs import NeverRepairCost, PolicyCost, SteadyStateCost, ZeroCost
from torchrl_pomdp.modules.truncation import AfterSteps, OnEntering, OnLeaving, Truncation

__all__ = [
    "AfterSteps",
    "Encoder",
    "FlatEncoder",
    "GreedyRepair",
    "NeverRepairCost",
    "OnEntering",
    "OnLeaving",
    "PartitionedPolicy",
    "Policy",
    "PolicyCost",
    "PolicyNetwork",
    "RelativeEncoder",
    "RolloutPolicy",
    "SteadyStateCost",
    "TerminalCost",
    "TruncatedRollout",
    "Truncation",
    "ZeroCost",
]
