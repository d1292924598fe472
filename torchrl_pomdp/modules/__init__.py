"""Policies, rollout, lookahead and partitioned networks (paper, Sections III to VI)."""

from torchrl_pomdp.modules.base_policies import GreedyRepair, UrgencyRepair
from torchrl_pomdp.modules.encoders import Encoder, FlatEncoder, RelativeEncoder
from torchrl_pomdp.modules.lookahead import RolloutPolicy
from torchrl_pomdp.modules.multistep import MultistepLookahead
from torchrl_pomdp.modules.networks import PolicyNetwork, ValueNetwork
from torchrl_pomdp.modules.parallel import ParallelRollout
from torchrl_pomdp.modules.partitioned import PartitionedPolicy, PartitionedValue
from torchrl_pomdp.modules.rollout import Policy, TerminalCost, TruncatedRollout
from torchrl_pomdp.modules.terminal_costs import ClosedFormCost, NeverRepairCost, PolicyCost, SteadyStateCost, ZeroCost
from torchrl_pomdp.modules.truncation import AfterSteps, OnEntering, OnLeaving, Truncation

__all__ = [
    "AfterSteps",
    "ClosedFormCost",
    "Encoder",
    "FlatEncoder",
    "GreedyRepair",
    "MultistepLookahead",
    "NeverRepairCost",
    "OnEntering",
    "OnLeaving",
    "ParallelRollout",
    "PartitionedPolicy",
    "PartitionedValue",
    "Policy",
    "PolicyCost",
    "PolicyNetwork",
    "RelativeEncoder",
    "RolloutPolicy",
    "SteadyStateCost",
    "TerminalCost",
    "TruncatedRollout",
    "Truncation",
    "UrgencyRepair",
    "ValueNetwork",
    "ZeroCost",
]
