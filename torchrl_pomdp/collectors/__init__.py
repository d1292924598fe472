"""Collectors of labelled feature states (paper, Section IV)."""

from torchrl_pomdp.collectors.labels import LabelCollector, OnLabels
from torchrl_pomdp.collectors.memory import StateMemory
from torchrl_pomdp.collectors.policy_evaluation import PolicyEvaluation
from torchrl_pomdp.collectors.rollout_improvement import RolloutImprovement
from torchrl_pomdp.collectors.states import PartSampler, StateSampler, training_states

__all__ = [
    "LabelCollector",
    "OnLabels",
    "PartSampler",
    "PolicyEvaluation",
    "RolloutImprovement",
    "StateMemory",
    "StateSampler",
    "training_states",
]
