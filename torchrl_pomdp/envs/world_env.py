"""The TorchRL environment over hidden states: what a real system shows to whoever controls it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_pomdp.checks import check_callable, check_instance, check_integer, check_seed
from torchrl_pomdp.envs.belief_model import BeliefModel, StateGenerator
from torchrl_pomdp.envs.legal import legal_controls

__all__ = ["WorldEnv"]


class WorldEnv(EnvBase):
    r"""TorchRL environment with a hidden state inside; out come observations, and minus the realised stage costs as rewards.

    :class:`BeliefEnv` plays in feature states; this one is the other door to the same problem: a system as it is. Behind the
    transform :class:`TrackBelief` it gives the same law of feature states, and rewards of the same mean, and every policy of
    the library plays in it. Without it, it is for agents that learn from observations.

    The hidden state stays in the environment, out of every TensorDict, so the batch is fixed, and ``step`` goes on from where
    the environment is, whatever is in the TensorDict. It takes every control that can be carried out, and raises at others;
    random controls are such, in ``SerialEnv`` and ``ParallelEnv`` only with a :class:`TrackBelief` around it. A start state is
    drawn from the generator, and the hidden state from its belief: the start state is what is known beforehand, with the first
    look in it where the generator gives one.

    ============ ============ =====================================================================================
    key          shape        meaning
    ============ ============ =====================================================================================
    observation  ``[*B]``     int64, number of what was seen after the control; Z, one more than any, at a start
    prior        ``[*B, …]``  core entries, ``("prior", "belief")`` and the like, of the start state of this episode
    action       ``[*B]``     int64
    reward       ``[*B, 1]``  minus the realised stage cost
    terminated   ``[*B, 1]``  the hidden state is terminal, whether or not that can be known from the observations
    ============ ============ =====================================================================================

    Args:
        model: a belief model with a :class:`World`.
        generator: distribution of start states, maps int64 keys ``[*B]`` to feature states ``[*B]``.

    Keyword Args:
        batch_size: how many systems are simulated; ``()`` is a single one.
        seed: seed of the environment's own random numbers; None draws one from the operating system, so that environments
            made by the same call differ.

    Attributes:
        world: the model's world.

    Raises:
        TypeError: if an argument is of the wrong kind, or the model has no hidden states.
        ValueError: if a size or the seed is negative; by ``step`` if a control cannot be carried out, by ``reset`` if a
            generated state is no feature state of the model.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> env = WorldEnv(problem.model, problem.start, batch_size=(4,), seed=0)
        >>> env.reset()["observation"].tolist()
        [5, 5, 5, 5]
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([4, 3])
    """

    def __init__(
        self,
        model: BeliefModel,
        generator: StateGenerator,
        *,
        batch_size: torch.Size | tuple[int, ...] = (),
        seed: int | None = None,
    ) -> None:
        world = check_instance("model", model, BeliefModel).world()
        check_callable("generator", generator)
        check_instance("batch_size", batch_size, (tuple, list))
        shape = torch.Size([check_integer(f"batch_size[{i}]", size, 1) for i, size in enumerate(batch_size)])
        # A start state may be terminal already.
        super().__init__(device=model.device, batch_size=shape, allow_done_after_reset=True)
        self.model, self.world, self.generator = model, world, generator
        self.rng = torch.Generator(device=self.device)
        self._inside: TensorDictBase | None = None
        self._make_specs()
        self.set_seed(seed)

    def _make_specs(self) -> None:
        model, shape, device = self.model, self.batch_size, self.device
        observation = Categorical(model.num_observations + 1, shape=shape, dtype=torch.int64, device=device)
        self.observation_spec = Composite(observation=observation, prior=model.state_spec(shape), shape=shape, device=device)
        self._controls = legal_controls(model, shape, self.rng)
        self.action_spec = self._controls
        self.reward_spec = Composite(reward=Unbounded(shape=(*shape, 1), dtype=model.dtype, device=device), shape=shape)
        flags = {
            key: Binary(1, shape=(*shape, 1), dtype=torch.bool, device=device) for key in ("done", "terminated", "truncated")
        }
        self.full_done_spec = Composite(flags, shape=shape, device=device)

    @property
    def hidden(self) -> TensorDictBase:
        """A copy of the hidden state ``[*B]``, for tests and pictures; no policy sees it."""
        return self._now().get("hidden").clone()

    def to(self, *args: Any, **kwargs: Any) -> WorldEnv:
        """Refused unless nothing changes: build the model on the device and in the type, and the environment over it."""
        self.model.to(*args, **kwargs)
        return self

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            self.rng.seed()
        else:
            self.rng.manual_seed(check_seed("seed", seed))

    def _keys(self) -> Tensor:
        return torch.randint(-(2**62), 2**62, tuple(self.batch_size), generator=self.rng, device=self.device)

    def _now(self) -> TensorDictBase:
        if self._inside is None:
            raise ValueError("the hidden state of WorldEnv is not known yet: call reset() first")
        return self._inside

    def _become(self, inside: TensorDictBase, changed: Tensor | None) -> None:
        """Take over hidden state, prior and observation; where a mask is given, only of the rows that have ``changed``."""
        if changed is not None and self._inside is not None:
            inside = inside.where(changed.reshape(self.batch_size), self._inside)
        self._inside = inside
        rows = None if changed is None else changed.reshape(*self.batch_size, 1)
        self._controls.show(self.world.action_mask(inside.get("hidden")), rows)

    def _shown(self) -> TensorDictBase:
        """What comes out, but for the reward."""
        inside = self._now()
        terminated = self.world.is_terminal(inside.get("hidden")).unsqueeze(-1)
        flags = {"terminated": terminated, "done": terminated.clone(), "truncated": torch.zeros_like(terminated)}
        return inside.select("observation", "prior").clone().update(flags)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        prior = self.model.drawn(self.generator, self._keys()).select(*self.model.state_keys)
        entries = {
            "hidden": self.world.sample(prior, self._keys()),
            "prior": prior,
            "observation": torch.full(self.batch_size, self.model.num_observations, device=self.device),
        }
        inside = TensorDict(entries, batch_size=self.batch_size, device=self.device)
        self._become(inside, None if tensordict is None else tensordict.get("_reset", None))
        return self._shown()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        before = self._now()
        cost, hidden, z = self.world.step(before.get("hidden"), tensordict.get("action", None), self._keys())
        # Rows that TorchRL does not step, because they are finished, stay as they are.
        moved = tensordict.get("_step", None)
        self._become(before.copy().update({"hidden": hidden, "observation": z}), moved)
        reward = -cost if moved is None else -cost.masked_fill(~moved.reshape(self.batch_size), 0.0)
        return self._shown().set("reward", reward.unsqueeze(-1))
