"""The numbers of a policy iteration, checked when they are given."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args, get_origin, get_type_hints

__all__ = ["PolicyIterationConfig"]

_POSITIVE = (
    "iterations", "samples_per_part", "trajectories", "max_steps", "memory_capacity", "value_samples",
    "batch_size", "epochs", "least_steps", "validation_states",
)  # fmt: skip


@dataclass(frozen=True)
class PolicyIterationConfig:
    """How approximate policy iteration collects labels and trains (paper, Sections IV to VI).

    Raises:
        ValueError: if a number is out of range; the message names it.

    Examples:
        >>> PolicyIterationConfig(samples_per_part=500).iterations
        3
        >>> PolicyIterationConfig(iterations=0)
        Traceback (most recent call last):
        ValueError: iterations must be at least 1, got 0
    """

    iterations: int = 3
    """Policy iterations: each labels states with the rollout of the last policy and trains new networks."""

    samples_per_part: int = 200_000
    """Labelled states for each part of the partition and iteration."""

    trajectories: int = 2
    """Simulated trajectories from each leaf of the lookahead tree; the paper has 10."""

    leaves: Literal["control", "observation"] = "control"
    """What a leaf is: a control, its first observations stratified, or a pair of control and first observation."""

    allocation: Literal["uniform", "adaptive"] = "uniform"
    """Whether every control gets all trajectories, or the clearly beaten ones no more of them."""

    max_steps: int = 400
    """Stages after which a simulated trajectory is cut."""

    visited_share: float = 0.7
    """Share of the training states taken from the memory of visited states, in [0, 1]; the rest are random."""

    visits_per_label: float = 0.7
    """Trajectories of the base policy, and of each iteration's, for each labelled state of an iteration; the memory retains a
    tenth of their states. With few of them the same states are labelled again and again."""

    exploration: float = 0.15
    """Probability of a random control at each stage of those trajectories, in [0, 1]."""

    memory_capacity: int = 500_000
    """Largest number of states of a part in the memory."""

    symmetries: bool = True
    """Whether mirror images of labelled states are labelled states too."""

    encoder: Literal["relative", "flat"] = "relative"
    """Network input: beliefs at offsets from the robot, or the flattened beliefs and one-hot location of the paper."""

    hidden: tuple[int, ...] = (256, 64)
    """Sizes of the policy networks' hidden layers."""

    value_hidden: tuple[int, ...] = (256, 128, 64)
    """Sizes of the value networks' hidden layers."""

    value_samples: int = 200_000
    """States labelled with a simulated cost for each value network."""

    loss: Literal["soft", "cross_entropy", "cost_weighted", "l2"] = "soft"
    """Classification loss, see ClassificationLoss; l2 is the paper's."""

    learning_rate: float = 1e-3
    """First step size of RMSprop; it falls linearly to zero."""

    batch_size: int = 256
    """States of each part in an optimisation step."""

    epochs: int = 6
    """Passes over the labelled states."""

    least_steps: int = 1500
    """Optimisation steps of each network at least, however few the labelled states are."""

    validation_states: int = 10_000
    """Start states on which an iteration's policy is compared with the best one so far."""

    seed: int = 0
    """Seed of everything that is random: states, labels, initial weights, batches."""

    def __post_init__(self) -> None:
        for name in _POSITIVE:
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("visited_share", "exploration"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")
        for name in ("visits_per_label", "learning_rate"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name, hint in get_type_hints(type(self)).items():
            if get_origin(hint) is Literal and getattr(self, name) not in get_args(hint):
                raise ValueError(f"{name} must be one of {', '.join(get_args(hint))}, got {getattr(self, name)!r}")
        for name in ("hidden", "value_hidden"):
            sizes = getattr(self, name)
            if not sizes or min(sizes) < 1:
                raise ValueError(f"{name} must hold positive layer sizes, got {sizes}")
