"""Problems as environments of Gymnasium: ``gymnasium.make("torchrl_pomdp/PipelineRepair-v0", problem="linear20")``."""

from torchrl_pomdp.envs.gym.simulation import BeliefSimulation, Simulation, WorldSimulation
from torchrl_pomdp.envs.gym.single import PomdpEnv
from torchrl_pomdp.envs.gym.vector import PomdpVectorEnv

__all__ = ["BeliefSimulation", "PomdpEnv", "PomdpVectorEnv", "Simulation", "WorldSimulation"]
