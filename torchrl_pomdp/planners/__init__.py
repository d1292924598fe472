"""Planners that search a whole tree or the whole belief space (paper, Sections I and VI-C)."""

from torchrl_pomdp.planners.belief_mdp import BeliefMDP, belief_mdp
from torchrl_pomdp.planners.despot import DESPOT
from torchrl_pomdp.planners.exact import AlphaVectorPolicy, Interval, Solution, solve
from torchrl_pomdp.planners.pomcp import POMCP

__all__ = ["DESPOT", "POMCP", "AlphaVectorPolicy", "BeliefMDP", "Interval", "Solution", "belief_mdp", "solve"]
