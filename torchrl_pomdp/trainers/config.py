"""The numbers of a policy iteration, checked when they are given."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["PolicyIterationConfig"]


@dataclass(frozen=True)
class PolicyIterationConfig:
    """How approximate policy iteration collects labels and trains (paper, Sections IV to VI).

    Raises:
        ValueError: if a number is out of range; the message names it.

    Examples:
        >>> PolicyIterationConfig(samples_per_part=500).iterations
        2
        >>> PolicyIterationConfig(iterations=0)
        Traceback (most recent call last):
        ValueError: iterations must be at least 1, got 0
    """

    iterations: int = 2
    """Policy iterations: each labels states with the rollout of the last policy and trains new networks."""

    samples_per_part: int = 200_000
    """Labelled states for each part of the partition and iteration."""

    trajectories: int = 10
    """Simulated trajectories from each leaf of the lookahead tree."""

    leaves: Literal["control", "observation"] = "control"
    """What a leaf is: a control, its first observations stratified, or a pair of control and first observation."""

    allocation: Literal["uniform", "adaptive"] = "uniform"
    """Whether every control gets all trajectories, or the clearly beaten ones no more of them."""

    max_steps: int = 400
    """Stages after which a simulated trajectory is cut."""

    visited_share: float = 0.5
    """Share of the training states taken from trajectories of the last policy, in [0, 1]; the rest are random."""

    exploration: float = 0.15
    """Probability of a random control at each stage of those trajectories, in [0, 1]."""

    encoder: Literal["relative", "flat"] = "relative"
    """Network input: beliefs at offsets from the robot, or the flattened beliefs and one-hot location of the paper."""

    hidden: tuple[int, ...] = (256, 64)
    """Sizes of the policy networks' hidden layers."""

    loss: Literal["soft", "cross_entropy", "cost_weighted", "l2"] = "soft"
    """Classification loss, see ClassificationLoss; l2 is the paper's."""

    learning_rate: float = 1e-3
    """First step size of RMSprop; it falls linearly to zero."""

    batch_size: int = 256
    """States of each part in an optimisation step."""

    epochs: int = 12
    """Passes over the labelled states."""

    seed: int = 0
    """Seed of everything that is random: states, labels, initial weights, batches."""

    def __post_init__(self) -> None:
        for name in ("iterations", "samples_per_part", "trajectories", "max_steps", "batch_size", "epochs"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("visited_share", "exploration"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")
        if not self.learning_rate > 0.0:
            raise ValueError(f"learning_rate must be positive, got {self.learning_rate}")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden must hold positive layer sizes, got {self.hidden}")
