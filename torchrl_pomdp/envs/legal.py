"""Legal controls in TorchRL's action spec: what draws random actions draws legal ones.

TorchRL draws random actions from the action spec, in :meth:`EnvBase.rand_action` and in :class:`RandomPolicy`, and looks at no
state. Which controls are legal depends on the state, so :class:`LegalControls` holds the mask of the current states. All copies
of the spec share it, because collectors and transforms draw from copies.

A batched environment (``SerialEnv``, ``ParallelEnv``) has the spec of an environment that is gone, and its own environments may
live in other processes; there is no hook through which they could tell it a mask. Importing this module therefore extends four
functions of TorchRL: the two that draw show the ``"action_mask"`` of the TensorDict at hand to the spec before they draw, and
``set_seed`` of the two batched environments seeds the spec. Nothing changes for any other spec.

Specs are sent to other processes with their random generator. PyTorch sends a generator's state by a file that the other
process cannot open; here it is told to send plain bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import wraps
from multiprocessing.reduction import ForkingPickler
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Categorical, Composite, MultiCategorical, TensorSpec
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv
from torchrl.modules import RandomPolicy

from torchrl_pomdp.envs.controls import JointControls
from torchrl_pomdp.envs.rows import inverse_cdf
from torchrl_pomdp.noise import fold

__all__ = ["LegalAgentControls", "LegalControls", "LegalSpec", "legal_controls"]


class _Current:
    """What the copies of a spec share: the mask of the current states, and where random numbers come from."""

    def __init__(self, generator: torch.Generator | None) -> None:
        self.generator = generator
        self.mask: Tensor | None = None

    def source(self, device: torch.device) -> torch.Generator:
        """Where random numbers come from; if nobody gave a generator, from a new one, seeded by the operating system."""
        if self.generator is None:
            self.generator = torch.Generator(device)
            self.generator.seed()
        return self.generator


class LegalSpec(TensorSpec):
    """What specs of legal controls have in common: random ones are legal in the current states, whose mask all copies share."""

    _current: _Current

    @property
    def _count(self) -> int:
        """What every control is below."""
        raise NotImplementedError

    def update_mask(self, mask: Tensor | None) -> None:
        """Set the legal controls of the current states: bool ``[*B, *S, n]``; None keeps what is known."""
        # TorchRL's own mask stays unset: it would have to fit the spec's shape, and would refuse stored actions.
        self.mask = None
        if mask is not None:
            self.show(mask)

    def show(self, mask: Tensor, changed: Tensor | None = None) -> None:
        """Tell all copies the legal controls ``[*B, *S, n]`` of the current states, of what has ``changed`` ``[*B, 1]``."""
        known = self._current.mask
        if changed is not None and known is not None and known.shape == mask.shape:
            mask = torch.where(changed.view(*changed.shape[:-1], *[1] * (mask.ndim - changed.ndim + 1)), mask, known)
        self._current.mask = mask

    def reseed(self, seed: int | None) -> None:
        """Seed the random numbers of all copies; None: by the operating system."""
        generator = self._current.source(self.device)
        if seed is None:
            generator.seed()
        else:
            # Another stream than that of an environment with the same seed.
            generator.manual_seed(int(fold(torch.tensor(seed), 1)) & (2**63 - 1))

    def rand(self, shape: torch.Size | tuple[int, ...] | None = None) -> Tensor:
        """Random legal controls of the current states; any control if their batch is not that of what is drawn."""
        size = torch.Size([*(shape or ()), *self.shape])
        generator, mask = self._current.source(self.device), self._current.mask
        if mask is None or mask.shape[:-1] not in ((), size):
            return torch.randint(self._count, size, generator=generator, device=generator.device).to(self.device, self.dtype)
        noise = torch.rand(size, generator=generator, dtype=torch.float32, device=generator.device)
        weights = mask.to(generator.device, noise.dtype).expand(*size, self._count)
        return inverse_cdf(weights, noise).to(self.device, self.dtype)

    # Copies share what is current.

    def _sharing(self, copy: Any) -> Any:
        copy._current = self._current
        return copy

    def clone(self) -> Any:
        """A copy; see :class:`~torchrl.data.Categorical`, also for what follows."""
        return self._sharing(super().clone())

    def to(self, dest: Any) -> Any:
        """A copy on a device or of a type."""
        return self._sharing(super().to(dest))

    def expand(self, *shape: Any) -> Any:
        """A copy of a larger batch."""
        return self._sharing(super().expand(*shape))

    def squeeze(self, dim: int | None = None) -> Any:
        """A copy without a dimension of size one."""
        return self._sharing(super().squeeze(dim))

    def unsqueeze(self, dim: int) -> Any:
        """A copy with one more dimension of size one."""
        return self._sharing(super().unsqueeze(dim))

    def unbind(self, dim: int = 0) -> tuple[Any, ...]:
        """A copy for each index of a dimension."""
        return tuple(self._sharing(copy) for copy in super().unbind(dim))

    def __getitem__(self, idx: Any) -> Any:
        return self._sharing(super().__getitem__(idx))

    def _reshape(self, shape: Any) -> Any:
        return self._sharing(super()._reshape(shape))

    def _unflatten(self, dim: int, sizes: Any) -> Any:
        return self._sharing(super()._unflatten(dim, sizes))


class LegalControls(LegalSpec, Categorical):
    """Action spec that draws legal controls of the current states.

    Any control of the model is *in* the spec, as stored actions belong to other states than the current ones.

    Args:
        n: U, the number of controls.
        shape: shape of the actions.
        device: where actions are.
        dtype: type of actions.
        mask: legal controls of the current states, see :meth:`update_mask`.

    Keyword Args:
        generator: source of the random numbers; None makes one that is seeded by the operating system.

    Examples:
        >>> spec = LegalControls(3)
        >>> copy = spec.expand(2)
        >>> spec.update_mask(torch.tensor([[False, True, False], [False, False, True]]))
        >>> copy.rand()
        tensor([1, 2])
    """

    def __init__(
        self,
        n: int,
        shape: torch.Size | None = None,
        device: torch.device | str | None = None,
        dtype: torch.dtype = torch.int64,
        mask: Tensor | None = None,
        *,
        generator: torch.Generator | None = None,
    ) -> None:
        self._current = _Current(generator)
        super().__init__(n, shape, device, dtype, mask)

    @property
    def _count(self) -> int:
        return self.n


class LegalAgentControls(LegalSpec, MultiCategorical):
    """Action spec of many agents: draws a legal control for each of them, see :class:`LegalControls`.

    Args:
        nvec: the numbers of controls of the agents, all equal.
        shape: shape of the actions, ``[*B, R]``.
        device: where actions are.
        dtype: type of actions.
        mask: legal controls of the current states, bool ``[*B, R, A]``, see :meth:`update_mask`.
        remove_singleton: as TorchRL has it.

    Keyword Args:
        generator: source of the random numbers; None makes one that is seeded by the operating system.

    Examples:
        >>> spec = LegalAgentControls([3, 3])
        >>> spec.update_mask(torch.tensor([[False, True, False], [False, False, True]]))
        >>> spec.rand()
        tensor([1, 2])
    """

    def __init__(
        self,
        nvec: Any,
        shape: torch.Size | None = None,
        device: torch.device | str | None = None,
        dtype: torch.dtype = torch.int64,
        mask: Tensor | None = None,
        remove_singleton: bool = False,
        *,
        generator: torch.Generator | None = None,
    ) -> None:
        self._current = _Current(generator)
        super().__init__(nvec, shape, device, dtype, mask, remove_singleton)

    @property
    def _count(self) -> int:
        return int(self.nvec.flatten()[0])


def legal_controls(model: JointControls, batch: torch.Size, generator: torch.Generator) -> LegalControls | LegalAgentControls:
    """The action spec of a model: numbers of joint controls, or one control for each of many agents.

    Args:
        model: the belief model.
        batch: shape of the environment's batch.
        generator: source of the random numbers.
    """
    shape = torch.Size([*batch, *model.control_shape])
    if model.enumerable:
        return LegalControls(model.num_controls, shape=shape, device=generator.device, generator=generator)
    each = [model.num_agent_controls] * model.num_agents
    return LegalAgentControls(each, shape=shape, device=generator.device, generator=generator)


def _legal(spec: TensorSpec | None) -> Iterator[LegalSpec]:
    """The specs of legal controls in an action spec."""
    for leaf in spec.values(True, True) if isinstance(spec, Composite) else (spec,):
        if isinstance(leaf, LegalSpec):
            yield leaf


def _looking(draw: Callable[..., Any], spec: Callable[[Any], TensorSpec | None]) -> Callable[..., Any]:
    """The method ``draw(self, tensordict)``, which first shows the mask of the TensorDict to the specs that it draws from."""

    @wraps(draw)
    def look_and_draw(self: Any, *args: Any, **kwargs: Any) -> Any:
        tensordict = next(iter((*args, *kwargs.values())), None)
        mask = None if tensordict is None else tensordict.get("action_mask", None)
        if mask is not None:
            for leaf in _legal(spec(self)):
                leaf.show(mask)
        return draw(self, *args, **kwargs)

    return look_and_draw


def _seeding(set_seed: Callable[..., Any]) -> Callable[..., Any]:
    """The method ``set_seed(self, seed, static_seed)`` of a batched environment, which also seeds its action spec."""

    @wraps(set_seed)
    def seed_all(self: Any, seed: int | None = None, static_seed: bool = False) -> Any:
        for leaf in _legal(self.full_action_spec):
            leaf.reseed(seed)
        return set_seed(self, seed, static_seed)

    return seed_all


def _extend(owner: type, name: str, extend: Callable[[Callable[..., Any]], Callable[..., Any]]) -> None:
    """Replace a method once, whoever imports this module how often."""
    method = getattr(owner, name)
    if getattr(method, "_knows_legal_controls", False):
        return
    extended = extend(method)
    extended._knows_legal_controls = True  # type: ignore[attr-defined]
    setattr(owner, name, extended)


def _generator_of(device: str, state: bytes) -> torch.Generator:
    generator = torch.Generator(device)
    generator.set_state(torch.frombuffer(bytearray(state), dtype=torch.uint8))
    return generator


def _sent(generator: torch.Generator) -> tuple[Any, ...]:
    return _generator_of, (str(generator.device), generator.get_state().numpy().tobytes())


ForkingPickler.register(torch.Generator, _sent)
_extend(EnvBase, "rand_action", lambda draw: _looking(draw, lambda env: env.input_spec["full_action_spec"]))
_extend(RandomPolicy, "__call__", lambda draw: _looking(draw, lambda policy: policy.action_spec))
_extend(SerialEnv, "set_seed", _seeding)
_extend(ParallelEnv, "set_seed", _seeding)
