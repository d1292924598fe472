"""Losses (paper, Section IV)."""

from torchrl_pomdp.objectives.classification import ClassificationLoss

__all__ = ["ClassificationLoss"]
