"""Belief models and the environments over them (paper, Section II)."""

from torchrl_pomdp.envs.belief_env import BeliefEnv
from torchrl_pomdp.envs.belief_model import BeliefModel, StateGenerator
from torchrl_pomdp.envs.generators import FixedBelief, InPart, Mixture, RandomPlay
from torchrl_pomdp.envs.partition import FunctionPartition, Partition, SinglePart
from torchrl_pomdp.envs.pomdp_file import parse_pomdp, read_pomdp, write_pomdp
from torchrl_pomdp.envs.tabular import TabularModel
from torchrl_pomdp.envs.track_belief import TrackBelief
from torchrl_pomdp.envs.world import World
from torchrl_pomdp.envs.world_env import WorldEnv

__all__ = [
    "BeliefEnv",
    "BeliefModel",
    "FixedBelief",
    "FunctionPartition",
    "InPart",
    "Mixture",
    "Partition",
    "RandomPlay",
    "SinglePart",
    "StateGenerator",
    "TabularModel",
    "TrackBelief",
    "World",
    "WorldEnv",
    "parse_pomdp",
    "read_pomdp",
    "write_pomdp",
]
