"""Policies, rollout, lookahead and partitioned networks (paper, Sections III to VI)."""

from torchrl_pomdp.modules.base_policies import GreedyRepair, UrgencyRepair
from torchrl_pomdp.modules.encoders import Encoder, FlatEncoder, RelativeEncoder
from torchrl_pomdp.modules.lookahead import RolloutPolicy
from torchrl_pomdp.modules.networks import PolicyNetwork, ValueNetwork
from torchrl_pomdp.modules.partitioned import PartitionedPolicy, PartitionedValue
from torchrl_pomdp.modules.rollout import Policy, TerminalCost, TruncatedRollout

__all__ = [
    "Encoder",
    "FlatEncoder",
    "GreedyRepair",
    "PartitionedPolicy",
    "PartitionedValue",
    "Policy",
    "PolicyNetwork",
    "RelativeEncoder",
    "RolloutPolicy",
    "TerminalCost",
    "TruncatedRollout",
    "UrgencyRepair",
    "ValueNetwork",
]
