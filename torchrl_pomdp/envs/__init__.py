"""Belief models and the environments over them (paper, Sections II and VI)."""

from torchrl_pomdp.envs.belief import BeliefModel, StateGenerator
from torchrl_pomdp.envs.belief_env import BeliefEnv
from torchrl_pomdp.envs.chains import damage_chain
from torchrl_pomdp.envs.generators import CalibratedStart, FixedBelief, InPart, Mixture, RandomState, UniformStart
from torchrl_pomdp.envs.graphs import Graph, grid, line
from torchrl_pomdp.envs.partition import Partition, RepairPartition, SinglePart
from torchrl_pomdp.envs.presets import PRESETS, Problem, make_problem
from torchrl_pomdp.envs.repair import REPAIR, RepairModel
from torchrl_pomdp.envs.symmetry import Symmetry, symmetries
from torchrl_pomdp.envs.tabular import TabularModel, tiger

__all__ = [
    "PRESETS",
    "REPAIR",
    "BeliefEnv",
    "BeliefModel",
    "CalibratedStart",
    "FixedBelief",
    "Graph",
    "InPart",
    "Mixture",
    "Partition",
    "Problem",
    "RandomState",
    "RepairModel",
    "RepairPartition",
    "SinglePart",
    "StateGenerator",
    "Symmetry",
    "TabularModel",
    "UniformStart",
    "damage_chain",
    "grid",
    "line",
    "make_problem",
    "symmetries",
    "tiger",
]
