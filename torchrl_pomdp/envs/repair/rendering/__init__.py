"""Pictures of repair problems; matplotlib, the extra ``plot``, is imported when one is drawn."""

from torchrl_pomdp.envs.repair.rendering.animation import save_animation
from torchrl_pomdp.envs.repair.rendering.figures import network_figure, trajectory_figure

__all__ = ["network_figure", "save_animation", "trajectory_figure"]
