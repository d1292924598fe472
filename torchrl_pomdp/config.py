"""The numbers of a policy iteration, checked when they are given; PyTorch is not needed to read them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin, get_type_hints

from torchrl_pomdp.checks import check_choice, check_flag, check_integer, check_number, check_seed, check_sizes

__all__ = ["EVALUATION_SEED", "MAX_STATES", "PolicyIterationConfig"]

# Start states of evaluations are drawn under this seed, whatever the training's.
EVALUATION_SEED = 20200

# Most start states of an evaluation: their costs are kept together.
MAX_STATES = 10**8
# Counts, from 1 or what _LEAST says, with their largest values: above any use, below what no machine could hold or finish.
_COUNTS = {
    "iterations": 1000, "samples_per_part": 10**9, "trajectories": 10**6, "max_steps": 10**6, "label_steps": 10**6,
    "memory_capacity": 10**9, "value_samples": 10**9, "batch_size": 10**7, "epochs": 10**6, "least_steps": 10**9,
    "validation_states": MAX_STATES,
}  # fmt: skip
# The standard error of a single cost is not known.
_LEAST = {"validation_states": 2}
_INTERVALS = {"visited_share": "[0, 1]", "exploration": "[0, 1]", "visits_per_label": "(0, 1000]", "learning_rate": "(0, 1]"}
_WIDEST, _DEEPEST = 1 << 14, 16


@dataclass(frozen=True)
class PolicyIterationConfig:
    """How approximate policy iteration collects labels and trains (paper, Sections IV to VI).

    Raises:
        TypeError: if something is of the wrong kind; the message names it.
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

    max_steps: int | None = None
    """Stages after which a simulated trajectory is cut; None: as many as the discount asks for, 400 for 0.99."""

    label_steps: int | None = None
    """Stages after which a label's trajectory is cut, with a terminal cost; None: max_steps. Makes many robots affordable."""

    visited_share: float = 0.7
    """Share of the training states taken from the memory of visited states, in [0, 1]; the rest are random."""

    visits_per_label: float = 0.7
    """Trajectories of each policy for each labelled state; the memory retains a tenth of their states. Few: states repeat."""

    exploration: float = 0.15
    """Probability of a random control at each stage of those trajectories, in [0, 1]."""

    memory_capacity: int = 500_000
    """Largest number of states of a part in the memory."""

    symmetries: bool = True
    """Whether mirror images of labelled states are labelled states too; of robots in turn, those that keep their order."""

    encoder: Literal["own", "flat"] = "own"
    """Network input: the problem's own, for repair beliefs at offsets from the robot; or the paper's flattened beliefs."""

    multiagent: bool = False
    """Whether robots share one network and decide one after the other; always where joint controls are too many to list."""

    hidden: tuple[int, ...] = (256, 64)
    """Sizes of the policy networks' hidden layers."""

    value_hidden: tuple[int, ...] = (256, 128, 64)
    """Sizes of the value networks' hidden layers."""

    value_samples: int = 200_000
    """States labelled with a simulated cost for each value network."""

    loss: Literal["soft", "cross_entropy", "cost_weighted", "l2", "advantage"] = "soft"
    """Classification loss, see ClassificationLoss; l2 is the paper's, advantage is for very many controls and noisy labels."""

    learning_rate: float = 1e-3
    """First step size of RMSprop; it falls linearly to zero."""

    batch_size: int = 256
    """States of each part in an optimisation step."""

    epochs: int = 6
    """Passes over the labelled states; each leaves out what is less than a batch."""

    least_steps: int = 1500
    """Optimisation steps of each network at least, however few the labelled states are."""

    validation_states: int = 10_000
    """Start states on which an iteration's policy is compared with the best one so far."""

    seed: int = 0
    """Seed of everything that is random: states, labels, initial weights, batches."""

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self)).items():
            object.__setattr__(self, name, _checked(name, getattr(self, name), hint))

    @property
    def stages(self) -> int | None:
        """Stages after which a label's trajectory is cut; None: as many as the discount asks for."""
        return self.label_steps or self.max_steps


def _checked(name: str, value: Any, hint: Any) -> Any:
    """A field's value as it is kept."""
    if name in ("max_steps", "label_steps") and value is None:
        return None
    if name in _COUNTS:
        return check_integer(name, value, _LEAST.get(name, 1), _COUNTS[name])
    if name in _INTERVALS:
        return check_number(name, value, _INTERVALS[name])
    if get_origin(hint) is Literal:
        return check_choice(name, value, get_args(hint))
    if name == "seed":
        return check_seed(name, value)
    if name in ("symmetries", "multiagent"):
        return check_flag(name, value)
    sizes = check_sizes(name, value, _WIDEST)
    if len(sizes) > _DEEPEST:
        raise ValueError(f"{name} must hold at most {_DEEPEST} sizes, got {len(sizes)}")
    return sizes
