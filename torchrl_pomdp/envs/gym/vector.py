"""Gymnasium's vector environment over a simulation: one batch of episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance, check_integer, check_seed, shown
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.gym.drawing import FRAMES_PER_SECOND, check_render_mode, figure_pixels
from torchrl_pomdp.envs.gym.simulation import Simulation, stage_keys
from torchrl_pomdp.envs.gym.single import KEYS, check_options, mask_array
from torchrl_pomdp.envs.gym.spaces import controls_of, legal_space
from torchrl_pomdp.envs.rows import put_rows

__all__ = ["PomdpVectorEnv"]

_MOST_ENVS = 1_000_000


class PomdpVectorEnv(VectorEnv):
    """Gymnasium vector environment whose N episodes are one batch of the model; what ``gymnasium.make_vec`` makes.

    Episode i is that of a single :class:`PomdpEnv` with the same seed, up to the rounding of sums; an integer seed s gives them
    the seeds s, s + 1, and so on. ``info["action_mask"]`` is int8 ``[N, U]`` or ``[N, R, A]``.

    Autoreset is Gymnasium's ``NEXT_STEP``: the step that ends an episode gives its last observation. The following step takes
    no notice of that row's control, and gives the first observation of the next episode, with reward 0. ``reset`` takes the
    option ``reset_mask``, bool ``[N]``, which starts only these episodes anew.

    Args:
        simulation: what is played.
        num_envs: N, at most a million.
        max_episode_steps: stages after which an episode is truncated; None: never.
        render_mode: ``"rgb_array"`` or None.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if a number is out of bounds, or the problem cannot be rendered so; by ``reset`` if a seed is negative or
            there are not N of them; by ``step`` if a control is illegal.

    Examples:
        >>> import gymnasium
        >>> envs = gymnasium.make_vec("torchrl_pomdp/PipelineRepair-v0", num_envs=4, problem="line3")
        >>> observation, info = envs.reset(seed=0)
        >>> observation["belief"].shape, info["action_mask"].shape
        ((4, 3, 5), (4, 3))
        >>> observation, reward, terminated, truncated, info = envs.step(envs.action_space.sample(mask=info["action_mask"]))
        >>> reward.shape
        (4,)
    """

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "render_fps": FRAMES_PER_SECOND,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        simulation: Simulation,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.simulation: Simulation = check_instance("simulation", simulation, Simulation)
        self.num_envs = check_integer("num_envs", num_envs, 1, _MOST_ENVS)
        limited = max_episode_steps is not None
        self.max_episode_steps = check_integer("max_episode_steps", max_episode_steps, 1, 2**62) if limited else None
        self.metadata = {**self.metadata, "render_modes": ["rgb_array"] if simulation.has_figure else []}
        self.render_mode = check_render_mode(render_mode, simulation, self.metadata["render_modes"])
        self.single_observation_space = simulation.observation_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.single_action_space = legal_space(self.model)
        self.action_space = self._controls = legal_space(self.model, self.num_envs)
        self._rngs: list[np.random.Generator | None] = [None] * self.num_envs
        self._state: TensorDictBase | None = None

    @property
    def model(self) -> BeliefModel:
        """The belief model."""
        return self.simulation.model

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start all episodes, or those of ``options["reset_mask"]``; see the class for seeds."""
        given, seeds = check_options(options, "reset_mask"), self._seeds(seed)
        rows = np.arange(self.num_envs)
        if "reset_mask" in given:
            self._now()
            rows = self._rows(given["reset_mask"])
        for row in rows:
            if seeds[row] is not None or self._rngs[row] is None:
                self._rngs[row] = np_random(seeds[row])[0]
        if len(rows) == self.num_envs:
            device = self.model.device
            self._keys = torch.zeros(self.num_envs, dtype=torch.int64, device=device)
            self._stage = torch.zeros_like(self._keys)
            self._cost = torch.zeros(self.num_envs, dtype=torch.float64, device=device)
            self._ended = torch.zeros(self.num_envs, dtype=torch.bool, device=device)
        self._start(torch.as_tensor(rows, device=self.model.device))
        return self.simulation.observed(self._now()), self._info()

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Play controls ``[N]`` or ``[N, R]``: observations, rewards float64 ``[N]``, terminated, truncated, and infos."""
        state, ended = self._now(), self._ended.clone()
        u = controls_of(actions, (self.num_envs, *self.model.control_shape), self.model.device)
        legal = self.simulation.legal(state)
        # Rows whose episode has ended start anew below; until then they take any legal control.
        u = torch.where(ended.view(-1, *[1] * (u.ndim - 1)), legal.to(torch.int64).argmax(-1), u)
        cost, self._state = self.simulation.step(state, u, stage_keys(self._keys, self._stage))
        self._stage += 1
        self._cost += cost
        if bool(ended.any()):
            self._start(ended.nonzero().squeeze(-1))
        terminated = self.simulation.over(self._state) & ~ended
        truncated = torch.zeros_like(ended)
        if self.max_episode_steps is not None:
            truncated = (self._stage >= self.max_episode_steps) & ~ended
        self._ended = terminated | truncated
        reward = 0.0 - cost.double().masked_fill(ended, 0.0)
        observation = self.simulation.observed(self._state)
        return observation, _array(reward), _array(terminated), _array(truncated), self._info()

    def action_masks(self) -> np.ndarray:
        """Legal controls, bool ``[N, U]`` or ``[N, R, A]``."""
        return mask_array(self.simulation.legal(self._now())).astype(bool)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """One picture for each episode, uint8 ``[height, width, 3]``."""
        state = self._now()
        if self.render_mode is None:
            return None
        titles = [
            f"stage {stage}\ncost so far {cost:.5g}"
            for stage, cost in zip(self._stage.tolist(), self._cost.tolist(), strict=True)
        ]
        return tuple(figure_pixels(self.simulation.figure(state[row], title)) for row, title in enumerate(titles))

    def _now(self) -> TensorDictBase:
        if self._state is None:
            raise ResetNeeded("there are no episodes yet: call reset() first")
        return self._state

    def _start(self, rows: Tensor) -> None:
        """Start the episodes of rows int64 ``[M]`` anew."""
        rngs = [self._rngs[row] for row in rows.tolist()]
        drawn = [int(rng.integers(*KEYS)) for rng in rngs if rng is not None]
        keys = torch.tensor(drawn, device=self.model.device)
        started = self.simulation.start(keys)
        self._state = started if len(rows) == self.num_envs else put_rows(self._now(), rows, started)
        self._keys[rows] = keys
        self._stage[rows], self._cost[rows], self._ended[rows] = 0, 0.0, False

    def _info(self) -> dict[str, Any]:
        mask = mask_array(self.simulation.legal(self._now()))
        self._controls.show(mask)
        return {"action_mask": mask.copy(), "_action_mask": np.ones(self.num_envs, dtype=bool)}

    def _seeds(self, seed: Any) -> list[int | None]:
        """One seed, or None, for each episode."""
        if seed is None:
            return [None] * self.num_envs
        if not isinstance(seed, Sequence) or isinstance(seed, (str, bytes)):
            first = check_seed("seed", seed)
            return [first + row for row in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"seed must be one number, or {self.num_envs} of them, got {shown(seed)}")
        return [None if each is None else check_seed(f"seed[{row}]", each) for row, each in enumerate(seed)]

    def _rows(self, mask: Any) -> np.ndarray:
        """The rows of an option ``reset_mask``."""
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"reset_mask of options must be a bool array of shape ({self.num_envs},) with a True in it, got {shown(mask)}"
            )
        return mask.nonzero()[0]


def _array(rows: Tensor) -> np.ndarray:
    return rows.cpu().numpy().copy()
