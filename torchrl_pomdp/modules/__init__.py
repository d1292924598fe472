"""Policies, rollout, lookahead and partitioned networks (paper, Sections III to VI)."""

from torchrl_pomdp.modules.agents import AgentEncoder, AgentNetwork, FlatAgentEncoder
from torchrl_pomdp.modules.base_policies import Myopic, as_policy
from torchrl_pomdp.modules.encoders import Encoder, FlatEncoder
from torchrl_pomdp.modules.lookahead import RolloutPolicy
from torchrl_pomdp.modules.multiagent import MultiagentRollout
from torchrl_pomdp.modules.multistep import MultistepLookahead
from torchrl_pomdp.modules.networks import PolicyNetwork, ValueNetwork
from torchrl_pomdp.modules.parallel import ParallelRollout
from torchrl_pomdp.modules.partitioned import PartitionedPolicy, PartitionedValue
from torchrl_pomdp.modules.policies import Policy, TerminalCost
from torchrl_pomdp.modules.rollout import TruncatedRollout
from torchrl_pomdp.modules.terminal_costs import ClosedFormCost, ConstantCost, PolicyCost, ZeroCost
from torchrl_pomdp.modules.truncation import AfterSteps, OnEntering, OnLeaving, Truncation

__all__ = [
    "AfterSteps",
    "AgentEncoder",
    "AgentNetwork",
    "ClosedFormCost",
    "ConstantCost",
    "Encoder",
    "FlatAgentEncoder",
    "FlatEncoder",
    "MultiagentRollout",
    "MultistepLookahead",
    "Myopic",
    "OnEntering",
    "OnLeaving",
    "ParallelRollout",
    "PartitionedPolicy",
    "PartitionedValue",
    "Policy",
    "PolicyCost",
    "PolicyNetwork",
    "RolloutPolicy",
    "TerminalCost",
    "TruncatedRollout",
    "Truncation",
    "ValueNetwork",
    "ZeroCost",
    "as_policy",
]
