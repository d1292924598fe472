"""The belief model, the paper's Section II as code, and its TorchRL environment.

A :class:`BeliefModel` is a set of pure, batched functions of the feature state ``y``. Planners call the model; users and
TorchRL call :class:`BeliefEnv`, a thin skin over it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.noise import fingerprint

__all__ = ["BeliefEnv", "BeliefModel", "StateGenerator", "inverse_cdf", "put_rows", "take_rows"]

StateGenerator = Callable[[Tensor], TensorDictBase]
"""Distribution of feature states: maps int64 keys ``[*B]`` to feature states ``[*B]``, the same key to the same state."""


def inverse_cdf(probs: Tensor, noise: Tensor, dim: int = -1) -> Tensor:
    """Index drawn from ``probs`` by inverting its distribution function at ``noise``.

    Args:
        probs: nonnegative weights with positive sum along ``dim``.
        noise: uniforms in [0, 1) of ``probs``' shape without ``dim``.
        dim: the dimension that is drawn from.

    Returns:
        int64 index of ``noise``'s shape; an index of probability zero is never returned.

    Examples:
        >>> inverse_cdf(torch.tensor([0.0, 0.25, 0.75, 0.0]).expand(3, 4), torch.tensor([0.0, 0.25, 0.999])).tolist()
        [1, 2, 2]
    """
    cumulative = probs.cumsum(dim)
    # Scaling by the rounded total keeps the threshold below it, so trailing zeros are not reached.
    threshold = (noise * cumulative.select(dim, -1)).unsqueeze(dim)
    return (cumulative.narrow(dim, 0, probs.shape[dim] - 1) <= threshold).sum(dim)


def take_rows(y: TensorDictBase, index: Tensor) -> TensorDictBase:
    """Rows ``index`` (int64 ``[M]``) of the flat batch ``y`` ``[N]``, each entry in the memory layout that it has.

    Indexing ``y[index]`` would turn entries whose batch dimension is innermost, such as beliefs kept as planes, into
    row-major ones, and every later step would pay for turning them back.

    Examples:
        >>> y = TensorDict({"belief": torch.rand(3, 5).T}, [5])
        >>> take_rows(y, torch.tensor([4, 0]))["belief"].stride()
        (1, 2)
    """

    def take(leaf: Tensor) -> Tensor:
        if _batch_innermost(leaf):
            planes = leaf.movedim(0, -1)
            return planes.flatten(0, -2).index_select(1, index).view(*planes.shape[:-1], -1).movedim(-1, 0)
        return leaf.index_select(0, index)

    return TensorDict({key: take(leaf) for key, leaf in y.items()}, batch_size=index.shape, device=y.device)


def put_rows(y: TensorDictBase, index: Tensor, rows: TensorDictBase) -> TensorDictBase:
    """The flat batch ``y`` ``[N]`` with ``rows`` ``[M]`` in the places ``index`` (int64 ``[M]``); ``y`` is left alone.

    Examples:
        >>> y = TensorDict({"belief": torch.zeros(3, 5).T}, [5])
        >>> put_rows(y, torch.tensor([4]), TensorDict({"belief": torch.ones(1, 3)}, [1]))["belief"].sum(-1).tolist()
        [0.0, 0.0, 0.0, 0.0, 3.0]
    """

    def put(leaf: Tensor, new: Tensor) -> Tensor:
        if _batch_innermost(leaf):
            planes = leaf.movedim(0, -1)
            result = planes.flatten(0, -2).index_copy(1, index, new.movedim(0, -1).flatten(0, -2))
            return result.view(planes.shape).movedim(-1, 0)
        return leaf.index_copy(0, index, new)

    changed = {key: put(leaf, rows.get(key)) for key, leaf in y.items()}
    return TensorDict(changed, batch_size=y.batch_size, device=y.device)


def _batch_innermost(leaf: Tensor) -> bool:
    return leaf.ndim > 1 and leaf.stride(0) == 1


class BeliefModel(nn.Module, ABC):
    r"""A POMDP seen through its feature state :math:`y` (paper, Section II), as batched pure tensor functions.

    Feature states are TensorDicts of any batch shape ``[*B]``. Their *core* entries (:attr:`state_keys`) determine the
    belief :math:`b_y`; the *derived* entries ``"action_mask"`` (bool ``[*B, U]``) and, when the model has a partition,
    ``"partition"`` (int64 ``[*B]``) are functions of the core. A successor of ``y`` carries the derived entries that
    ``y`` carries, so nothing is computed that nobody reads.

    Subclasses define :meth:`state_spec`, :meth:`action_mask`, :meth:`expected_cost`, :meth:`observation_probs` and
    :meth:`estimator`; they may override :meth:`advance` to be faster.

    Attributes:
        state_keys: names of the core entries.
        num_controls: U, the size of the control set.
        num_observations: Z, the size of the observation set.
        noise_dim: uniforms consumed by one sampled step.
        discount: :math:`\alpha` in (0, 1).
        partition: the partition whose part index is a feature, or None.

    Raises:
        ValueError: if ``discount`` is not in (0, 1).
    """

    state_keys: tuple[str, ...]
    num_controls: int
    num_observations: int
    noise_dim: int = 1

    def __init__(self, discount: float, partition: Partition | None = None) -> None:
        super().__init__()
        if not 0.0 < discount < 1.0:
            raise ValueError(f"discount must be in (0, 1), got {discount}")
        self.discount = float(discount)
        self.partition = partition

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Device of the model's tensors."""

    @property
    @abstractmethod
    def dtype(self) -> torch.dtype:
        """Type of beliefs and costs, float32 or float64."""

    @abstractmethod
    def state_spec(self, batch_size: torch.Size | tuple[int, ...] = ()) -> Composite:
        """Specs of the core entries: leaf shape is ``batch_size`` followed by the entry's own shape."""

    @abstractmethod
    def action_mask(self, y: TensorDictBase) -> Tensor:
        """U(y): bool ``[*B, U]``, True where a control is legal; at least one is."""

    @abstractmethod
    def expected_cost(self, y: TensorDictBase, u: Tensor) -> Tensor:
        r"""Stage cost :math:`\hat g(y,u)`, exact under the belief: ``[*B]`` for controls int64 ``[*B]``."""

    @abstractmethod
    def observation_probs(self, y: TensorDictBase, u: Tensor) -> Tensor:
        r""":math:`\hat p(z\mid b_y,u)`: ``[*B, Z]``, rows sum to one."""

    @abstractmethod
    def estimator(self, y: TensorDictBase, u: Tensor, z: Tensor) -> TensorDictBase:
        """F(y, u, z), exact Bayes: next feature state ``[*B]`` for an observation of positive probability."""

    def advance(self, y: TensorDictBase, u: Tensor, noise: Tensor) -> tuple[Tensor, TensorDictBase]:
        r"""One sampled step: stage cost :math:`\hat g(y,u)` ``[*B]`` and next feature state ``[*B]``.

        Args:
            y: feature states ``[*B]``.
            u: controls, int64 ``[*B]``.
            noise: uniforms in [0, 1), ``[*B, noise_dim]``.
        """
        z = inverse_cdf(self.observation_probs(y, u), noise[..., 0])
        return self.expected_cost(y, u), self.estimator(y, u, z)

    def observed(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """Names of the hidden variables that control ``u`` ``[*B]`` lets be observed, int64 ``[*B, noise_dim]``, not negative.

        Simulations compare controls under common random numbers: in one scenario, whoever observes a variable first finds
        it in the same state, see :mod:`torchrl_pomdp.modules.scenarios`. One name for all: a single hidden variable.
        """
        return torch.zeros(*y.batch_size, self.noise_dim, dtype=torch.int64, device=self.device)

    def is_terminal(self, y: TensorDictBase) -> Tensor:
        """Bool ``[*B]``: no cost follows from here whatever is done. A discounted model need not have such states."""
        return torch.zeros(y.batch_size, dtype=torch.bool, device=self.device)

    def fingerprint(self, y: TensorDictBase) -> Tensor:
        """Hash of the core entries, int64 ``[*B]``: identifies a feature state to noise and to memories."""
        return fingerprint(y.select(*self.state_keys))

    def with_features(self, y: TensorDictBase, keys: tuple[str, ...] | None = None) -> TensorDictBase:
        """A feature state with the core of ``y`` and its derived entries.

        Args:
            y: TensorDict ``[*B]`` with at least the core entries.
            keys: names of entries that will be read; derived entries not among them are left out. None: all.

        Returns:
            a new TensorDict ``[*B]``; the entries of ``y`` are shared, not copied.
        """
        result = TensorDict({key: y.get(key) for key in self.state_keys}, batch_size=y.batch_size, device=self.device)
        if keys is None or "action_mask" in keys:
            result.set("action_mask", self.action_mask(result))
        if self.partition is not None and (keys is None or "partition" in keys):
            result.set("partition", self.partition(result))
        return result

    def successor(self, y: TensorDictBase, **core: Tensor) -> TensorDictBase:
        """The feature state with entries ``core`` and the derived entries that ``y`` has (helper for subclasses)."""
        nxt = TensorDict(core, batch_size=y.batch_size, device=self.device)
        keys = y.keys()
        if "action_mask" in keys:
            nxt.set("action_mask", self.action_mask(nxt))
        if "partition" in keys and self.partition is not None:
            nxt.set("partition", self.partition(nxt))
        return nxt

    def feature_spec(self, batch_size: torch.Size | tuple[int, ...] = ()) -> Composite:
        """Specs of core and derived entries."""
        spec = self.state_spec(batch_size)
        shape = torch.Size(batch_size)
        spec["action_mask"] = Binary(self.num_controls, shape=(*shape, self.num_controls), dtype=torch.bool, device=self.device)
        if self.partition is not None:
            spec["partition"] = Categorical(self.partition.num_parts, shape=shape, dtype=torch.int64, device=self.device)
        return spec

    def check_state(self, y: TensorDictBase) -> None:
        """Raise unless ``y`` is a feature state of this model.

        Raises:
            TypeError: if ``y`` is not a TensorDict or an entry has the wrong dtype.
            ValueError: if an entry is missing, has the wrong shape, or lies outside its bounds.
        """
        if not isinstance(y, TensorDictBase):
            raise TypeError(f"y must be a TensorDict, got {type(y).__name__}")
        for key, leaf in self.state_spec().items():
            value = y.get(key, None)
            if value is None:
                raise ValueError(f"y lacks the entry {key!r}; a feature state needs {list(self.state_keys)}")
            shape = (*y.batch_size, *leaf.shape)
            if value.shape != shape:
                raise ValueError(
                    f"entry {key!r} of y has shape {tuple(value.shape)}, expected {shape}: "
                    f"the batch {tuple(y.batch_size)} followed by the entry's own shape"
                )
            if value.dtype != leaf.dtype:
                raise TypeError(f"entry {key!r} of y has dtype {value.dtype}, expected {leaf.dtype}")
            if value.numel() and not leaf.expand(shape).is_in(value):
                raise ValueError(f"entry {key!r} of y holds values outside its bounds: expected {leaf}")

    def describe(self) -> str:
        """One line: what the model is, with the numbers of controls and observations."""
        return (
            f"{type(self).__name__}: {self.num_controls} controls, {self.num_observations} observations, "
            f"discount {self.discount:g}"
        )


class BeliefEnv(EnvBase):
    r"""TorchRL environment over a belief model; ``reward`` is minus the expected stage cost :math:`\hat g`.

    The batch is free by default (``batch_size=()``, any TensorDict batch is accepted) or fixed. Legal controls are in
    ``"action_mask"``; :meth:`rand_action` obeys it. An illegal control raises. States enter through
    ``reset(y, set_state=True)``, which computes the mask and ``"terminated"``; ``step`` reads them.

    ============== ============ ==========================================
    key            shape        meaning
    ============== ============ ==========================================
    core entries   ``[*B, …]``  ``model.state_spec()``, e.g. ``belief``
    action_mask    ``[*B, U]``  bool, legal controls
    partition      ``[*B]``     int64, if the model has a partition
    action         ``[*B]``     int64
    reward         ``[*B, 1]``  minus the expected cost
    terminated     ``[*B, 1]``  no cost follows
    ============== ============ ==========================================

    Args:
        model: the belief model.
        generator: distribution of start states, maps int64 keys ``[*B]`` to feature states ``[*B]``.

    Keyword Args:
        batch_size: fixed batch, or ``()`` for a free one.
        seed: seed of the environment's own random numbers.

    Raises:
        ValueError: by ``step`` if a control is illegal, by ``reset`` if a given state does not fit the model.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
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
        seed: int = 0,
    ) -> None:
        # A state that a caller sets may be terminal already.
        super().__init__(device=model.device, batch_size=torch.Size(batch_size), allow_done_after_reset=True)
        self.model = model
        self.generator = generator
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
        self.action_spec = Categorical(self.model.num_controls, shape=shape, dtype=torch.int64, device=device)
        self.reward_spec = Composite(reward=Unbounded(shape=(*shape, 1), device=device), shape=shape)
        flags = {
            key: Binary(1, shape=(*shape, 1), dtype=torch.bool, device=device) for key in ("done", "terminated", "truncated")
        }
        self.full_done_spec = Composite(flags, shape=shape, device=device)

    def _set_seed(self, seed: int | None) -> None:
        self.rng = torch.Generator(device=self.device)
        if seed is not None:
            self.rng.manual_seed(seed)

    def to(self, *args: Any, **kwargs: Any) -> BeliefEnv:
        """Refused: build the model on the device and the environment over it."""
        device = torch._C._nn._parse_to(*args, **kwargs)[0]
        if device is None or device == self.device:
            return self
        raise ValueError(f"the environment lives on its model's device {self.device}; build the model on {device}")

    def _reset(self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, **_: Any) -> TensorDictBase:
        shape = self.batch_size if tensordict is None else tensordict.batch_size
        if set_state and tensordict is not None:
            self.model.check_state(tensordict)
            y = self.model.with_features(tensordict)
        else:
            keys = torch.randint(-(2**62), 2**62, tuple(shape), generator=self.rng, device=self.device)
            y = self.model.with_features(self.generator(keys))
        return self._with_done(y)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        u = tensordict.get("action")
        self._check_legal(tensordict, u)
        noise = torch.rand((*tensordict.batch_size, self.model.noise_dim), generator=self.rng, device=self.device)
        cost, nxt = self.model.advance(tensordict, u, noise)
        terminal = tensordict.get("terminated", None)
        terminal = self.model.is_terminal(tensordict) if terminal is None else terminal.squeeze(-1)
        return self._with_done(nxt).set("reward", -cost.masked_fill(terminal, 0.0).unsqueeze(-1))

    def _check_legal(self, y: TensorDictBase, u: Tensor) -> None:
        if u.shape != y.batch_size or u.dtype != torch.int64:
            raise ValueError(f"action must be int64 of shape {tuple(y.batch_size)}, got {u.dtype} of shape {tuple(u.shape)}")
        mask = y.get("action_mask")
        low, high = u.aminmax() if u.numel() else (0, 0)
        if low >= 0 and high < self.model.num_controls and mask.gather(-1, u.unsqueeze(-1)).all():
            return
        known = (u >= 0) & (u < self.model.num_controls)
        index = u.clamp(0, self.model.num_controls - 1).unsqueeze(-1)
        where = (~(known & mask.gather(-1, index).squeeze(-1))).nonzero()[0].tolist()
        raise ValueError(
            f"action {int(u[tuple(where)])} at batch index {tuple(where)} is illegal; "
            f"legal there: {mask[tuple(where)].nonzero().flatten().tolist()}"
        )

    def _with_done(self, y: TensorDictBase) -> TensorDictBase:
        terminated = self.model.is_terminal(y).unsqueeze(-1)
        y.set("terminated", terminated)
        y.set("done", terminated.clone())
        y.set("truncated", torch.zeros_like(terminated))
        return y

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Write a uniformly random legal ``"action"``, drawn from the environment's own generator.

        Args:
            tensordict: feature states ``[*B]``; None draws for a fresh reset.
        """
        if tensordict is None:
            tensordict = self.reset()
        mask = tensordict.get("action_mask")
        noise = torch.rand(tuple(mask.shape[:-1]), generator=self.rng, device=self.device)
        return tensordict.set("action", inverse_cdf(mask.to(noise.dtype), noise))
