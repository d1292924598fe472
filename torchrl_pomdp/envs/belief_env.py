"""The TorchRL environment over a belief model."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_pomdp.checks import check_callable, check_instance, check_integer, check_seed
from torchrl_pomdp.envs.belief_model import BeliefModel, StateGenerator
from torchrl_pomdp.envs.legal import legal_controls

__all__ = ["BeliefEnv"]


class BeliefEnv(EnvBase):
    r"""TorchRL environment over a belief model; ``reward`` is minus the expected stage cost :math:`\hat g`.

    The batch is free by default (``batch_size=()``, any TensorDict batch is accepted) or fixed. Legal controls are in
    ``"action_mask"`` and in the action spec, so that random controls are legal, see :class:`~.legal.LegalControls`. An illegal
    control raises. States enter through ``reset(y, set_state=True)``, which computes the mask and ``"terminated"``; ``step``
    reads them, so a transform that changes a core entry, such as ``ObservationNorm(in_keys=["belief"])``, must write to
    ``out_keys`` of its own: ``step`` raises where it finds no feature state.

    ============== ============ ======================================================================
    key            shape        meaning
    ============== ============ ======================================================================
    core entries   ``[*B, …]``  ``model.state_spec()``, e.g. ``belief``
    action_mask    ``[*B, U]``  bool, legal controls; of very many agents ``[*B, R, A]``, see :mod:`.controls`
    partition      ``[*B]``     int64, if the model has a partition
    action         ``[*B]``     int64; of very many agents ``[*B, R]``, TorchRL's MultiCategorical
    reward         ``[*B, 1]``  minus the expected cost
    terminated     ``[*B, 1]``  no cost follows
    ============== ============ ======================================================================

    Args:
        model: the belief model.
        generator: distribution of start states, maps int64 keys ``[*B]`` to feature states ``[*B]``.

    Keyword Args:
        batch_size: fixed batch, or ``()`` for a free one.
        seed: seed of the environment's own random numbers; None draws one from the operating system, so that environments
            made by the same call differ.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if a size is not positive or the seed is negative; by ``step`` if a control is illegal or a state is none
            of the model's, by ``reset`` if a given or generated state is none, or states are given with flags ``"_reset"``.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> env = BeliefEnv(problem.model, problem.start, batch_size=(4,), seed=0)
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([4, 3, 1])
    """

    _supports_set_state = True

    def __init__(
        self,
        model: BeliefModel,
        generator: StateGenerator,
        *,
        batch_size: torch.Size | tuple[int, ...] = (),
        seed: int | None = None,
    ) -> None:
        check_instance("model", model, BeliefModel)
        check_callable("generator", generator)
        check_instance("batch_size", batch_size, (tuple, list))
        shape = torch.Size([check_integer(f"batch_size[{i}]", size, 1) for i, size in enumerate(batch_size)])
        # A state that a caller sets may be terminal already.
        super().__init__(device=model.device, batch_size=shape, allow_done_after_reset=True)
        self.model = model
        self.generator = generator
        self.rng = torch.Generator(device=self.device)
        self._make_specs()
        self.set_seed(seed)

    @property
    def batch_locked(self) -> bool:
        """Whether the batch size is fixed."""
        return len(self.batch_size) > 0

    def _make_specs(self) -> None:
        shape, device = self.batch_size, self.device
        self.observation_spec = self.model.feature_spec(shape)
        self.state_spec = self.observation_spec.clone()
        self._controls = legal_controls(self.model, shape, self.rng)
        self.action_spec = self._controls
        reward = Unbounded(shape=(*shape, 1), dtype=self.model.dtype, device=device)
        self.reward_spec = Composite(reward=reward, shape=shape)
        flags = {
            key: Binary(1, shape=(*shape, 1), dtype=torch.bool, device=device) for key in ("done", "terminated", "truncated")
        }
        self.full_done_spec = Composite(flags, shape=shape, device=device)

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            self.rng.seed()
        else:
            self.rng.manual_seed(check_seed("seed", seed))

    def to(self, *args: Any, **kwargs: Any) -> BeliefEnv:
        """Refused unless nothing changes: build the model on the device and in the type, and the environment over it."""
        self.model.to(*args, **kwargs)
        return self

    def _reset(self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, **_: Any) -> TensorDictBase:
        shape = self.batch_size if tensordict is None else tensordict.batch_size
        flags = None if tensordict is None else tensordict.get("_reset", None)
        if set_state and flags is not None:
            # TorchRL 0.14 sets the state of any TensorDict that holds one, and so finished rows would stay where they are.
            raise ValueError(
                "tensordict has states and the flags '_reset': reset(tensordict, set_state=False) draws flagged rows anew, "
                "reset(tensordict.exclude('_reset'), set_state=True) sets the states"
            )
        if set_state and tensordict is not None:
            y = self.model.with_features(tensordict)
        else:
            keys = torch.randint(-(2**62), 2**62, tuple(shape), generator=self.rng, device=self.device)
            y = self.model.derive(self.model.drawn(self.generator, keys))
        self._controls.show(y.get("action_mask"), flags)
        return self._with_done(y)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        u = tensordict.get("action")
        self.model.check_state(tensordict)
        self.model.check_controls(tensordict, u)
        shape = (*tensordict.batch_size, self.model.noise_dim)
        noise = torch.rand(shape, generator=self.rng, dtype=self.model.dtype, device=self.device)
        cost, nxt = self.model.advance(tensordict, u, noise)
        if not bool(torch.isfinite(cost).all()):
            raise ValueError(f"expected_cost of the model must be finite, got {cost[~torch.isfinite(cost)][0].item()}")
        terminal = tensordict.get("terminated", None)
        terminal = self.model.is_terminal(tensordict) if terminal is None else terminal.squeeze(-1)
        self._controls.show(nxt.get("action_mask"))
        return self._with_done(nxt).set("reward", -cost.masked_fill(terminal, 0.0).unsqueeze(-1))

    def _with_done(self, y: TensorDictBase) -> TensorDictBase:
        terminated = self.model.is_terminal(y).unsqueeze(-1)
        y.set("terminated", terminated)
        y.set("done", terminated.clone())
        y.set("truncated", torch.zeros_like(terminated))
        return y
