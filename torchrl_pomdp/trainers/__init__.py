"""Approximate policy iteration (paper, Sections IV to VI)."""

from torchrl_pomdp.trainers.config import PolicyIterationConfig
from torchrl_pomdp.trainers.policy_iteration import PolicyIteration, make_networks

__all__ = ["PolicyIteration", "PolicyIterationConfig", "make_networks"]
