"""Collectors of labelled feature states (paper, Section IV)."""

from torchrl_pomdp.collectors.rollout_improvement import RolloutImprovement
from torchrl_pomdp.collectors.states import Mixture, PartSampler, StateSampler, VisitedStates, training_states

__all__ = ["Mixture", "PartSampler", "RolloutImprovement", "StateSampler", "VisitedStates", "training_states"]
