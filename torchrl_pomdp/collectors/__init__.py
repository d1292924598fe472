"""Collectors of labelled feature states (paper, Section IV)."""

from torchrl_pomdp.collectors.labels import LabelCollector
from torchrl_pomdp.collectors.policy_evaluation import PolicyEvaluation
from torchrl_pomdp.collectors.rollout_improvement import RolloutImprovement
from torchrl_pomdp.collectors.states import Mixture, PartSampler, StateSampler, VisitedStates, training_states

__all__ = [
    "LabelCollector",
    "Mixture",
    "PartSampler",
    "PolicyEvaluation",
    "RolloutImprovement",
    "StateSampler",
    "VisitedStates",
    "training_states",
]
