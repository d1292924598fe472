"""The sequential repair of pipelines (paper, Section VI)."""

from torchrl_pomdp.envs.repair.chains import damage_chain
from torchrl_pomdp.envs.repair.generators import CalibratedStart, RandomState, UniformStart
from torchrl_pomdp.envs.repair.graphs import Graph, grid, line
from torchrl_pomdp.envs.repair.model import REPAIR, RepairModel
from torchrl_pomdp.envs.repair.partition import RepairPartition
from torchrl_pomdp.envs.repair.rendering import network_figure, save_animation, trajectory_figure
from torchrl_pomdp.envs.repair.symmetry import Symmetry, symmetries
from torchrl_pomdp.envs.repair.tabular import joint_belief, tabular_model

__all__ = [
    "REPAIR",
    "CalibratedStart",
    "Graph",
    "RandomState",
    "RepairModel",
    "RepairPartition",
    "Symmetry",
    "UniformStart",
    "damage_chain",
    "grid",
    "joint_belief",
    "line",
    "network_figure",
    "save_animation",
    "symmetries",
    "tabular_model",
    "trajectory_figure",
]
