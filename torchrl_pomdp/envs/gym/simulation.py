"""Episodes of a belief model as an outside agent plays them: what Gymnasium's environments have inside."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import torch
from gymnasium import spaces
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_callable, check_instance
from torchrl_pomdp.envs.belief_model import BeliefModel, StateGenerator
from torchrl_pomdp.envs.digits import digits
from torchrl_pomdp.envs.gym.spaces import count_space, entries_space, entry_array
from torchrl_pomdp.envs.scene import Scene
from torchrl_pomdp.envs.world import World
from torchrl_pomdp.noise import fold, uniform

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["BeliefSimulation", "Simulation", "WorldSimulation"]

# What an episode's key is for beside its start, see torchrl_pomdp.envs.world.
_STAGES = 12


class Simulation(ABC):
    """Pure functions of the states ``[*B]`` of running episodes, and what an agent is shown of them.

    A state is a TensorDict, and all random numbers come from keys: an episode is the same alone and in any batch, up to the
    rounding of sums.

    Attributes:
        model: the belief model.
        observation_space: what the agent sees of one state.
        has_figure: whether :meth:`figure` draws.

    Args:
        model: the belief model.
        generator: distribution of start states, maps int64 keys ``[*B]`` to feature states ``[*B]``.

    Raises:
        TypeError: if an argument is of the wrong kind.
    """

    observation_space: spaces.Space
    has_figure: bool

    def __init__(self, model: BeliefModel, generator: StateGenerator) -> None:
        self.model: BeliefModel = check_instance("model", model, BeliefModel)
        self.generator: StateGenerator = check_callable("generator", generator)

    @abstractmethod
    def start(self, keys: Tensor) -> TensorDictBase:
        """States ``[*B]`` at the start of the episodes of int64 keys ``[*B]``."""

    @abstractmethod
    def step(self, state: TensorDictBase, u: Tensor, keys: Tensor) -> tuple[Tensor, TensorDictBase]:
        """Stage cost ``[*B]`` and next state, for controls int64 ``[*B, *S]`` and keys ``[*B]``, others at each stage.

        Raises:
            ValueError: if a control is illegal; the message lists the legal ones.
        """

    @abstractmethod
    def legal(self, state: TensorDictBase) -> Tensor:
        """Legal controls, bool ``[*B, *S, n]``, see :mod:`~torchrl_pomdp.envs.controls`."""

    @abstractmethod
    def over(self, state: TensorDictBase) -> Tensor:
        """Bool ``[*B]``: no cost follows."""

    @abstractmethod
    def observed(self, state: TensorDictBase) -> Any:
        """What the agent sees, arrays ``[*B, …]`` of :attr:`observation_space`; nobody else holds them."""

    @abstractmethod
    def figure(self, state: TensorDictBase, title: str) -> Figure:
        """A picture of a state of batch ``()``."""


class BeliefSimulation(Simulation):
    r"""The agent sees the belief: the core entries of the feature state :math:`y`. Costs are :math:`\hat g(y,u)`.

    Examples:
        >>> from torchrl_pomdp.problems import tiger
        >>> problem = tiger()
        >>> simulation, keys = BeliefSimulation(problem.model, problem.start), torch.arange(2)
        >>> cost, state = simulation.step(simulation.start(keys), torch.tensor([0, 0]), keys)
        >>> cost.tolist(), simulation.observed(state)["belief"].round(2)
        ([1.0, 1.0], array([[0.15, 0.85], [0.15, 0.85]], dtype=float32))
    """

    observation_space: spaces.Dict

    def __init__(self, model: BeliefModel, generator: StateGenerator) -> None:
        super().__init__(model, generator)
        self.observation_space = entries_space(model.state_spec())
        self.has_figure = type(model.scene()).figure is not Scene.figure

    def start(self, keys: Tensor) -> TensorDictBase:
        """Feature states of the generator, with their masks."""
        return self.model.derive(self.model.drawn(self.generator, keys), ("action_mask",))

    def step(self, state: TensorDictBase, u: Tensor, keys: Tensor) -> tuple[Tensor, TensorDictBase]:
        """One sampled step of the belief; see :meth:`Simulation.step`."""
        self.model.check_controls(state, u)
        noise = uniform(keys.unsqueeze(-1), torch.arange(self.model.noise_dim, device=keys.device)).to(self.model.dtype)
        cost, nxt = self.model.advance(state, u, noise)
        cost = cost.masked_fill(self.over(state), 0.0)
        if not bool(torch.isfinite(cost).all()):
            raise ValueError(f"expected_cost of the model must be finite, got {cost[~torch.isfinite(cost)][0].item()}")
        return cost, nxt

    def legal(self, state: TensorDictBase) -> Tensor:
        """The masks that the states carry."""
        return state.get("action_mask")

    def over(self, state: TensorDictBase) -> Tensor:
        """Terminal feature states."""
        return self.model.is_terminal(state)

    def observed(self, state: TensorDictBase) -> dict[str, Any]:
        """The core entries."""
        return {key: entry_array(space, state.get(key)) for key, space in self.observation_space.items()}

    def figure(self, state: TensorDictBase, title: str) -> Figure:
        """The belief, as the model draws it."""
        return self.model.scene().figure(state, title)


class WorldSimulation(Simulation):
    """The agent sees observations alone: what was seen after the last control, and at a start that nothing was seen yet.

    The observation is one number, or one for each robot; the number above all others stands for nothing seen yet. Costs are
    the realised ones, which the agent gets as rewards. Controls are legal that can be carried out.

    Raises:
        TypeError: if an argument is of the wrong kind, or the model has no hidden states.

    Examples:
        >>> from torchrl_pomdp.problems import tiger
        >>> problem = tiger()
        >>> simulation, keys = WorldSimulation(problem.model, problem.start), torch.arange(3)
        >>> start = simulation.start(keys)
        >>> simulation.observed(start), simulation.observed(simulation.step(start, torch.zeros_like(keys), keys)[1])
        (array([2, 2, 2]), array([1, 0, 1]))
    """

    def __init__(self, model: BeliefModel, generator: StateGenerator) -> None:
        super().__init__(model, generator)
        self.world = model.world()
        self._hidden = list(self.world.hidden_spec().keys())
        self._base, self._count = model.observation_digits
        self.observation_space = count_space(self._base + 1, self._count)
        self.has_figure = type(self.world).figure is not World.figure

    def start(self, keys: Tensor) -> TensorDictBase:
        """Hidden states drawn from the beliefs of the generator's states; nothing is seen yet."""
        hidden = self.world.sample(self.model.drawn(self.generator, keys).select(*self.model.state_keys), keys)
        return self._joined(hidden, torch.full((*keys.shape, self._count), self._base, device=keys.device))

    def step(self, state: TensorDictBase, u: Tensor, keys: Tensor) -> tuple[Tensor, TensorDictBase]:
        """One stage of the world; see :meth:`Simulation.step`."""
        cost, hidden, z = self.world.step(state.select(*self._hidden), u, keys)
        return cost.masked_fill(self.over(state), 0.0), self._joined(hidden, digits(z, self._base, self._count))

    def _joined(self, hidden: TensorDictBase, seen: Tensor) -> TensorDictBase:
        """A state: the hidden one, and the numbers ``[*B, count]`` that were seen."""
        entries = {**{key: hidden.get(key) for key in self._hidden}, "seen": seen}
        return TensorDict(entries, batch_size=hidden.batch_size, device=self.model.device)

    def legal(self, state: TensorDictBase) -> Tensor:
        """Controls that can be carried out."""
        return self.world.action_mask(state)

    def over(self, state: TensorDictBase) -> Tensor:
        """Terminal hidden states, whether or not that can be known."""
        return self.world.is_terminal(state)

    def observed(self, state: TensorDictBase) -> Any:
        """What was seen last."""
        seen = state.get("seen")
        return entry_array(self.observation_space, seen.squeeze(-1) if self._count == 1 else seen)

    def figure(self, state: TensorDictBase, title: str) -> Figure:
        """The hidden state, as the world draws it."""
        return self.world.figure(state.select(*self._hidden), title)


def stage_keys(keys: Tensor, stage: Tensor) -> Tensor:
    """Keys ``[*B]`` of the steps at stages int64 ``[*B]`` of the episodes of keys ``[*B]``, other ones than of their starts."""
    return fold(fold(keys, _STAGES), stage)
