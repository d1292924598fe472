"""Gymnasium's environment over a simulation: one episode at a time."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.seeding import np_random
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance, check_mapping, check_seed, shown
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.gym.drawing import FRAMES_PER_SECOND, Window, check_render_mode, figure_pixels, render_modes
from torchrl_pomdp.envs.gym.simulation import Simulation, stage_keys
from torchrl_pomdp.envs.gym.spaces import controls_of, legal_space

__all__ = ["PomdpEnv"]

# Of the keys of episodes, which are drawn.
KEYS = -(2**62), 2**62
# Characters of the controls in a title; those of very many robots are left out.
_LONGEST = 60


class PomdpEnv(gymnasium.Env):
    r"""Gymnasium environment over a :class:`Simulation`; what ``gymnasium.make("torchrl_pomdp/PipelineRepair-v0")`` makes.

    The reward is minus the stage cost: the expected one :math:`\hat g(y,u)` where the agent sees the belief, the realised one
    where it sees observations. Rewards are not discounted: an agent that minimises what the library does discounts them by
    :attr:`model` ``.discount``. An episode ends (``terminated``) where no cost follows; ``truncated`` is the ``TimeLimit``'s,
    which ``gymnasium.make`` puts around.

    Legal controls are in ``info["action_mask"]``, int8 ``[U]``, or ``[R, A]`` of robots whose joint controls are too many to be
    numbered, and are given by :meth:`action_masks`. An illegal control raises a ``ValueError``; ``action_space.sample()`` draws
    legal ones.

    Equal seeds of ``reset(seed=)`` and equal controls give equal episodes. Rendering shows the state, with the last controls
    and the cost so far in the title.

    Args:
        simulation: what is played.
        render_mode: ``"rgb_array"``, ``"human"`` for a window, or None.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if the problem cannot be rendered so; by ``reset`` if a seed is negative or there are options; by ``step``
            if a control is illegal.

    Examples:
        >>> import gymnasium
        >>> env = gymnasium.make("torchrl_pomdp/PipelineRepair-v0", problem="line3")
        >>> observation, info = env.reset(seed=0)
        >>> sorted(observation), info["action_mask"].tolist()
        (['belief', 'location'], [1, 0, 1])
        >>> observation, reward, terminated, truncated, info = env.step(0)
        >>> round(reward, 2), terminated
        (-44.54, False)
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": FRAMES_PER_SECOND}

    def __init__(self, simulation: Simulation, render_mode: str | None = None) -> None:
        self.simulation: Simulation = check_instance("simulation", simulation, Simulation)
        self.metadata = {**self.metadata, "render_modes": render_modes(simulation)}
        self.render_mode = check_render_mode(render_mode, simulation, self.metadata["render_modes"])
        self.observation_space = simulation.observation_space
        self.action_space = self._controls = legal_space(self.model)
        self._state: TensorDictBase | None = None
        self._window = Window()

    @property
    def model(self) -> BeliefModel:
        """The belief model."""
        return self.simulation.model

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; a seed determines it and all that follow until the next one. There are no options."""
        check_options(options)
        super().reset(seed=None if seed is None else check_seed("seed", seed))
        self._key = self._drawn(self.np_random)
        self._stage, self._cost, self._last = 0, 0.0, ""
        self._become(self.simulation.start(self._key), start=True)
        return self.simulation.observed(self._now()), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Play a control: observation, reward, whether no cost follows, False, and info."""
        state = self._now()
        u = controls_of(action, self.model.control_shape, self.model.device)
        cost, state = self.simulation.step(state, u, stage_keys(self._key, torch.tensor(self._stage, device=self._key.device)))
        self._stage, self._cost = self._stage + 1, self._cost + float(cost)
        self._last = ", ".join(self.model.shown_control(u)) if self.render_mode else ""
        self._become(state)
        # Of a cost of 0 too, whose negative is another number.
        reward = 0.0 - float(cost)
        return self.simulation.observed(state), reward, bool(self.simulation.over(state)), False, self._info()

    def action_masks(self) -> np.ndarray:
        """Legal controls, bool ``[U]`` or ``[R, A]``, by the convention of sb3-contrib."""
        self._now()
        return self._mask.astype(bool)

    def render(self) -> Any:
        """The state as pixels, uint8 ``[height, width, 3]``; None where it is shown in a window."""
        state = self._now()
        if self.render_mode is None:
            gymnasium.logger.warn('render() draws nothing: give render_mode="rgb_array" or "human" to gymnasium.make')
            return None
        after = f", after {self._last}" if 0 < len(self._last) <= _LONGEST else ""
        pixels = figure_pixels(self.simulation.figure(state, f"stage {self._stage}{after}\ncost so far {self._cost:.5g}"))
        if self.render_mode == "rgb_array":
            return pixels
        self._window.show(pixels)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        self._window.close()

    def _now(self) -> TensorDictBase:
        if self._state is None:
            raise ResetNeeded("there is no episode yet: call reset() first")
        return self._state

    def _become(self, state: TensorDictBase, *, start: bool = False) -> None:
        self._state = state
        self._mask = mask_array(self.simulation.legal(state))
        self._controls.show(self._mask, self._start_mask if start else None)
        if self.render_mode == "human":
            self.render()

    def _drawn(self, rng: np.random.Generator) -> Tensor:
        """The key of the next episode."""
        return torch.tensor(int(rng.integers(*KEYS)), device=self.model.device)

    def _start_mask(self, seed: int) -> np.ndarray:
        """Legal controls in the start state of a seed."""
        return mask_array(self.simulation.legal(self.simulation.start(self._drawn(np_random(seed)[0]))))

    def _info(self) -> dict[str, Any]:
        return {"action_mask": self._mask.copy()}


def mask_array(legal: Tensor) -> np.ndarray:
    """Legal controls as an int8 array of its own."""
    return legal.cpu().numpy().astype(np.int8)


def check_options(options: Any, *known: str) -> dict[str, Any]:
    """Options of ``reset``, as a dictionary of its own.

    Raises:
        TypeError: if it is no mapping.
        ValueError: if there are others than the known ones.
    """
    given = {} if options is None else dict(check_mapping("options", options, object))
    unknown = sorted(set(given) - set(known))
    if unknown:
        raise ValueError(f"options must be among {list(known)}, got {shown(unknown)}")
    return given
