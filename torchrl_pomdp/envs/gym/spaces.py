"""Gymnasium's spaces of a belief model's states, controls and observations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, TensorSpec, Unbounded

from torchrl_pomdp.checks import shown
from torchrl_pomdp.envs.controls import JointControls

__all__ = ["LegalDiscrete", "LegalMultiDiscrete", "controls_of", "count_space", "entries_space", "entry_array", "legal_space"]


def entries_space(spec: Composite) -> spaces.Dict:
    """The space of one state's entries: float32 boxes for floating numbers, discrete ones for integers.

    Args:
        spec: the entries of one state, as ``model.state_spec()`` gives them.

    Raises:
        TypeError: if an entry has another kind of spec.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> entries_space(make_problem("line3").model.state_spec())
        Dict('belief': Box(0.0, 1.0, (3, 5), float32), 'location': MultiDiscrete([3]))
    """
    return spaces.Dict({key: _entry_space(key, leaf) for key, leaf in spec.items()})


def _entry_space(key: str, leaf: TensorSpec) -> spaces.Space:
    if type(leaf) is Binary:
        return spaces.MultiBinary(tuple(leaf.shape))
    if type(leaf) is Categorical:
        return spaces.MultiDiscrete(np.full(tuple(leaf.shape), leaf.n)) if leaf.shape else spaces.Discrete(int(leaf.n))
    if isinstance(leaf, Bounded) and leaf.dtype.is_floating_point:
        low, high = (bound.to("cpu", torch.float32).numpy() for bound in (leaf.space.low, leaf.space.high))
        return spaces.Box(low, high, tuple(leaf.shape), np.float32)
    if isinstance(leaf, Unbounded) and leaf.dtype.is_floating_point:
        return spaces.Box(-np.inf, np.inf, tuple(leaf.shape), np.float32)
    raise TypeError(
        f"entry {key!r} of state_spec must be Binary, Categorical, or Bounded or Unbounded floating numbers to be an "
        f"observation in Gymnasium, got {type(leaf).__name__} of {leaf.dtype}"
    )


def count_space(base: int, count: int) -> spaces.Discrete | spaces.MultiDiscrete:
    """The space of so many numbers below a base; one number is ``Discrete``.

    Examples:
        >>> count_space(6, 1), count_space(6, 2)
        (Discrete(6), MultiDiscrete([6 6]))
    """
    return spaces.Discrete(base) if count == 1 else spaces.MultiDiscrete(np.full(count, base))


def entry_array(space: spaces.Space, leaf: Tensor) -> Any:
    """A new array of the space's type, a NumPy number where it is discrete; the tensor has any batch in front.

    Rounding, of sums of probabilities or to float32, may pass the bounds of a box: such numbers are put on them.

    Examples:
        >>> entry_array(spaces.Box(0.0, 1.0, (2,)), torch.tensor([0.5, 1.0 + 1e-15], dtype=torch.float64))
        array([0.5, 1. ], dtype=float32)
    """
    array = leaf.detach().cpu().numpy().astype(space.dtype, order="C")
    if isinstance(space, spaces.Box):
        array = np.asarray(np.clip(array, space.low, space.high))
    return array[()] if isinstance(space, spaces.Discrete) and not array.ndim else array


# ---- controls ----------------------------------------------------------------------------------------------------------


class _Legal:
    """What spaces of controls share: a random control is legal in the environment's present state.

    Gymnasium draws random actions from the space and looks at no state, so the environment shows its masks to the space.
    ``sample(mask=info["action_mask"])`` draws from a mask that is given, and takes it in the shape that it has.

    Gymnasium's checker, in the middle of an episode, seeds the space, draws, resets the environment with the same seed, and
    plays what it drew. So the first draw after ``seed(s)`` there is legal in the start state of ``reset(seed=s)``, and in the
    present state where that leaves a choice.
    """

    _now: np.ndarray | None = None
    _start_of: Callable[[int], np.ndarray] | None = None
    _at_start = False
    _first: np.ndarray | None = None

    def show(self, mask: np.ndarray, start_of: Callable[[int], np.ndarray] | None = None) -> None:
        """Take over the legal controls of the present state.

        Args:
            mask: int8 ``[*S, n]``.
            start_of: the mask of the start state of a seed; given where the present state is the start of an episode.
        """
        self._now, self._first = mask, None
        self._at_start = start_of is not None
        self._start_of = start_of or self._start_of

    def seed(self, seed: Any = None) -> Any:
        """Seed the space's random numbers."""
        result = super().seed(seed)  # type: ignore[misc]
        foreseen = self._start_of is not None and not self._at_start and isinstance(seed, int)
        self._first = self._start_of(seed) if foreseen else None  # type: ignore[misc]
        return result

    def sample(self, mask: Any = None, probability: Any = None) -> Any:
        """A random control: legal in the present state, or by a mask, or by probabilities."""
        if mask is None and probability is None:
            mask = self._now
            if mask is not None and self._first is not None:
                mask = np.where((mask & self._first).any(-1, keepdims=True), mask & self._first, self._first)
        self._first = None
        return super().sample(_nested(mask), _nested(probability))  # type: ignore[misc]

    def __getstate__(self) -> dict[str, Any]:
        """Copies and files do not take the environment along; it shows itself to a copy at the next start."""
        return {**self.__dict__, "_start_of": None}


class LegalDiscrete(_Legal, spaces.Discrete):
    """Controls that are numbers, see :class:`_Legal`.

    Examples:
        >>> space = LegalDiscrete(3, seed=0)
        >>> space.show(np.array([0, 1, 0], np.int8))
        >>> int(space.sample()), int(space.sample(mask=np.array([0, 0, 1], np.int8)))
        (1, 2)
    """


class LegalMultiDiscrete(_Legal, spaces.MultiDiscrete):
    """Controls of several robots, of several environments, or both, see :class:`_Legal`.

    Examples:
        >>> space = LegalMultiDiscrete([3, 3], seed=0)
        >>> space.sample(mask=np.array([[0, 1, 0], [0, 0, 1]], np.int8))
        array([1, 2])
    """


def _nested(mask: Any) -> Any:
    """Masks ``[*S, n]`` as Gymnasium takes them: tuples of arrays ``[n]``."""
    return tuple(_nested(row) for row in mask) if isinstance(mask, np.ndarray) and mask.ndim > 1 else mask


def legal_space(model: JointControls, num_envs: int | None = None) -> LegalDiscrete | LegalMultiDiscrete:
    """The space of a model's controls: ``Discrete``; of robots whose joint controls are not numbered ``MultiDiscrete``.

    Args:
        model: whose controls.
        num_envs: how many environments; None is a single one, without a dimension for it.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> legal_space(make_problem("linear20").model), legal_space(make_problem("linear20").model, 4)
        (Discrete(3), MultiDiscrete([3 3 3 3]))
    """
    shape = (*(() if num_envs is None else (num_envs,)), *model.control_shape)
    return LegalMultiDiscrete(np.full(shape, model.control_range)) if shape else LegalDiscrete(model.control_range)


def controls_of(action: Any, shape: tuple[int, ...], device: torch.device) -> Tensor:
    """Controls, int64 of a shape, from what an agent gives.

    Raises:
        ValueError: if it is anything else than integers of this shape.

    Examples:
        >>> controls_of(2, (), torch.device("cpu"))
        tensor(2)
        >>> controls_of(2.0, (), torch.device("cpu"))
        Traceback (most recent call last):
        ValueError: action must be integers of shape (), got 2.0
    """
    message = f"action must be integers of shape {shape}, got {shown(action)}"
    try:
        array = np.asarray(action)
    except (ValueError, TypeError, RuntimeError) as error:
        raise ValueError(message) from error
    if array.dtype.kind not in "iu" or array.shape != shape:
        raise ValueError(message)
    return torch.as_tensor(array.astype(np.int64), device=device)
