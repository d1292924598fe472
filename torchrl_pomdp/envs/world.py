"""The hidden states that beliefs are about: what a simulator of the real system needs (paper, Section II)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from torchrl_pomdp.envs.entries import check_state_entries
from torchrl_pomdp.noise import fold, uniform
from torchrl_pomdp.tensor_checks import check_keys

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchrl_pomdp.envs.belief_model import BeliefModel

__all__ = ["World"]

# What a key's independent streams of uniforms are for, beside those of the generators of feature states: the key that made a
# start state may also draw the hidden state behind it.
_STEP, _SAMPLE = 11, 13


class World(ABC):
    r"""The system behind a belief model: hidden states :math:`i`, what they cost, what follows them and what is seen of it.

    A model that has one gives it by :meth:`BeliefModel.world`. The law is that of the model: the hidden state drawn from
    ``y`` has the law :math:`b_y`; under a control its cost has the mean :math:`\hat g(y,u)`, the observation the law
    :math:`\hat p(z\mid b_y,u)`, and the next hidden state, given the observation, the belief of :math:`F(y,u,z)`.

    Subclasses define :meth:`hidden_spec`, :meth:`action_mask`, :meth:`is_terminal`, :meth:`draw` and :meth:`advance`, pure
    tensor functions of any batch ``[*B]`` that take their random numbers as an argument. Callers use :meth:`sample` and
    :meth:`step`, which check what they are given and make the random numbers from keys: no generator has a state.

    Attributes:
        model: the belief model.
        draw_dim: uniforms that drawing a hidden state consumes.
        noise_dim: uniforms that one step consumes.

    Args:
        model: the belief model.

    Examples:
        >>> from torchrl_pomdp.problems import tiger
        >>> problem, keys = tiger(), torch.arange(4)
        >>> world = problem.model.world()
        >>> hidden = world.sample(problem.start(keys), keys)
        >>> hidden["state"].tolist()
        [1, 0, 0, 1]
        >>> cost, hidden, z = world.step(hidden, torch.zeros_like(keys), fold(keys, 1))
        >>> cost.tolist(), z.tolist()
        ([1.0, 1.0, 1.0, 1.0], [1, 0, 1, 0])
    """

    draw_dim: int
    noise_dim: int

    def __init__(self, model: BeliefModel) -> None:
        self.model = model

    # ---- what a subclass defines -------------------------------------------------------------------------------------

    @abstractmethod
    def hidden_spec(self, batch_size: torch.Size | tuple[int, ...] = ()) -> Composite:
        """Specs of the entries of hidden states: leaf shape is ``batch_size`` followed by the entry's own shape."""

    @abstractmethod
    def action_mask(self, hidden: TensorDictBase) -> Tensor:
        """Controls that can be carried out in hidden states, bool ``[*B, U]``.

        They are all those that are legal in some feature state which holds the hidden state possible; what is illegal because
        of what is known can be carried out.
        """

    @abstractmethod
    def is_terminal(self, hidden: TensorDictBase) -> Tensor:
        """Bool ``[*B]``: no cost follows from here whatever is done, whether or not anybody knows."""

    @abstractmethod
    def draw(self, y: TensorDictBase, noise: Tensor) -> TensorDictBase:
        """Hidden states ``[*B]`` by the beliefs of feature states ``[*B]`` and uniforms in [0, 1), ``[*B, draw_dim]``."""

    @abstractmethod
    def advance(self, hidden: TensorDictBase, u: Tensor, noise: Tensor) -> tuple[Tensor, TensorDictBase, Tensor]:
        """Cost, next hidden state and observation by uniforms in [0, 1), ``[*B, noise_dim]``; see :meth:`step`."""

    def figure(self, hidden: TensorDictBase, title: str = "") -> Figure:
        """A picture of a hidden state, of batch ``()``; most worlds have none and raise a ``TypeError``."""
        raise TypeError(f"world has no picture: {type(self).__name__} must override figure()")

    # ---- what callers use --------------------------------------------------------------------------------------------

    def sample(self, y: TensorDictBase, keys: Tensor) -> TensorDictBase:
        r"""Hidden states drawn from the belief :math:`b_y`.

        Args:
            y: feature states ``[*B]``.
            keys: int64 ``[*B]``; the same key draws the same hidden state from the same feature state, in any batch.

        Returns:
            hidden states ``[*B]``, entries by :meth:`hidden_spec`.

        Raises:
            TypeError: if an argument is of the wrong kind.
            ValueError: if ``y`` are no feature states of the model, or there is not one key for each.
        """
        self.model.check_state(y)
        return self.draw(y, _uniforms(keys, y, _SAMPLE, self.draw_dim))

    def step(self, hidden: TensorDictBase, u: Tensor, keys: Tensor) -> tuple[Tensor, TensorDictBase, Tensor]:
        """One stage of the system.

        Args:
            hidden: hidden states ``[*B]``.
            u: controls that can be carried out, int64 ``[*B]``.
            keys: int64 ``[*B]``, another one at each stage, such as ``fold(keys, stage)``.

        Returns:
            realised stage cost ``[*B]``, next hidden state ``[*B]``, and number of the observation, int64 ``[*B]``.

        Raises:
            TypeError: if an argument is of the wrong kind.
            ValueError: if ``hidden`` are no hidden states of this world, a control cannot be carried out, there is not one key
                for each state, or a cost is not finite.
        """
        self.check_hidden(hidden)
        mask = TensorDict({"action_mask": self.action_mask(hidden)}, batch_size=hidden.batch_size)
        self.model.check_controls(mask, u)
        cost, nxt, z = self.advance(hidden, u, _uniforms(keys, hidden, _STEP, self.noise_dim))
        if not bool(torch.isfinite(cost).all()):
            raise ValueError(f"cost of the world must be finite, got {cost[~torch.isfinite(cost)][0].item()}")
        return cost, nxt, z

    def check_hidden(self, hidden: TensorDictBase) -> None:
        """Raise unless ``hidden`` are hidden states ``[*B]`` of this world.

        Raises:
            TypeError: if it is no TensorDict or an entry has the wrong dtype.
            ValueError: if an entry is missing, has the wrong shape, or lies outside its bounds.
        """
        check_state_entries("hidden", hidden, self.hidden_spec(), "a hidden state")


def _uniforms(keys: Tensor, states: TensorDictBase, purpose: int, count: int) -> Tensor:
    """Uniforms ``[*B, count]`` of the keys of states ``[*B]``."""
    if check_keys("keys", keys).shape != states.batch_size:
        expected = tuple(states.batch_size)
        raise ValueError(f"keys must be one for each state, of shape {expected}, got {tuple(keys.shape)}")
    return uniform(fold(keys, purpose).unsqueeze(-1), torch.arange(count, device=keys.device))
