"""Losses (paper, Section IV)."""

from torchrl_pomdp.objectives.classification import ClassificationLoss
from torchrl_pomdp.objectives.value import ValueLoss

__all__ = ["ClassificationLoss", "ValueLoss"]
