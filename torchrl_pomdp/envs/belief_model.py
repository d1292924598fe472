"""The belief model, the paper's Section II as code.

A :class:`BeliefModel` is a set of pure, batched functions of the feature state ``y``. Planners call the model; users and
TorchRL call :class:`~torchrl_pomdp.envs.BeliefEnv`, a thin skin over it.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite

from torchrl_pomdp.checks import check_callable, check_instance, check_number, check_sequence, shown
from torchrl_pomdp.envs.controls import JointControls, check_index
from torchrl_pomdp.envs.entries import RESERVED, check_state_entries
from torchrl_pomdp.envs.names import name_of, number_of
from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.envs.rows import inverse_cdf
from torchrl_pomdp.envs.scene import Scene
from torchrl_pomdp.noise import fingerprint
from torchrl_pomdp.tensor_checks import check_keys, place

if TYPE_CHECKING:
    from torchrl_pomdp.envs.world import World

__all__ = ["INSIGNIFICANT", "BeliefModel", "StateGenerator", "generated"]

# Discount of a stage from which on all costs may be left out: that of the 400th, where it is the paper's 0.99.
INSIGNIFICANT = 0.018
# What is better, where it takes no more than so many stages.
_NEGLIGIBLE, _STAGES = 0.001, 400

StateGenerator = Callable[[Tensor], TensorDictBase]
"""Distribution of feature states: maps int64 keys ``[*B]`` to feature states ``[*B]``, the same key to the same state."""


class BeliefModel(JointControls, ABC):
    r"""A POMDP seen through its feature state :math:`y` (paper, Section II), as batched pure tensor functions.

    Feature states are TensorDicts of any batch shape ``[*B]``. Their *core* entries (:attr:`state_keys`) determine the
    belief :math:`b_y`; the *derived* entries ``"action_mask"`` (bool ``[*B, U]``) and, when the model has a partition,
    ``"partition"`` (int64 ``[*B]``) are functions of the core. A successor of ``y`` carries the derived entries that
    ``y`` carries, so nothing is computed that nobody reads.

    Subclasses define :meth:`state_spec`, :meth:`action_mask`, :meth:`expected_cost`, :meth:`observation_probs` and
    :meth:`estimator`; they may override :meth:`advance` to be faster, and :meth:`world` to be simulated.

    Attributes:
        state_keys: names of the core entries.
        num_controls: U, the size of the control set.
        num_observations: Z, the size of the observation set.
        noise_dim: uniforms consumed by one sampled step.
        discount: :math:`\alpha` in (0, 1).
        partition: the partition whose part index is a feature, or None.
        max_cost: a bound of :math:`|\hat g|` where one is known, or None.
        control_names: names of the controls, or None.
        observation_names: names of the observations, or None.

    A model stays on the device and in the type it was built with; ``to``, ``double`` and the like are refused.

    Args:
        discount: :math:`\alpha` in (0, 1).
        partition: the partition whose part index is a feature, or None.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``discount`` is not in (0, 1).
    """

    state_keys: tuple[str, ...]
    num_observations: int
    noise_dim: int = 1
    max_cost: float | None = None
    control_names: tuple[str, ...] | None = None
    observation_names: tuple[str, ...] | None = None

    def __init__(self, discount: float, partition: Partition | None = None) -> None:
        super().__init__()
        self.discount = check_number("discount", discount, "(0, 1)")
        keys = getattr(self, "state_keys", ())
        taken = sorted(RESERVED.intersection(keys if isinstance(keys, tuple) else ()))
        if taken:
            raise ValueError(f"state_keys must not hold names of what stands beside a state, got {', '.join(taken)}")
        if partition is not None:
            self.check_partition(partition)
        self.partition = partition

    def check_partition(self, partition: Partition) -> None:
        """Raise unless a partition is one, and one for this model (subclasses may ask for more).

        Raises:
            TypeError: if it is none, or its names or stages are of the wrong kind.
            ValueError: by :meth:`Partition.check`.
        """
        check_instance("partition", partition, Partition).check()

    def with_partition(self, partition: Partition) -> BeliefModel:
        """The same model, tables shared, with another partition.

        Raises:
            TypeError: by :meth:`check_partition`.
            ValueError: by :meth:`check_partition`.

        Examples:
            >>> from torchrl_pomdp.envs import SinglePart
            >>> from torchrl_pomdp.problems import make_problem
            >>> make_problem("linear20").model.with_partition(SinglePart()).partition.names
            ('all',)
        """
        self.check_partition(partition)
        other = copy.copy(self)
        other._modules = dict(self._modules)
        other.partition = partition
        return other

    def unrestricted(self) -> BeliefModel:
        """The same model where controls that are pointless, but can be carried out, are legal too; most have none.

        Examples:
            >>> from torchrl_pomdp.problems import make_problem
            >>> problem = make_problem("tiger")
            >>> problem.model.unrestricted() is problem.model
            True
        """
        return self

    @property
    def horizon(self) -> int:
        r"""Stages that a simulation needs: up to where the rest weighs a thousandth, :math:`\alpha^m\le 0.001`.

        Where that takes more than the paper's 400 stages, 400 will do, or as many as it takes to :math:`\alpha^m\le 0.018`.

        Examples:
            >>> from torchrl_pomdp.problems import make_problem
            >>> make_problem("linear20").model.horizon, make_problem("tiger").model.horizon
            (400, 135)
        """
        enough, least = (math.ceil(math.log(rest) / math.log(self.discount)) for rest in (_NEGLIGIBLE, INSIGNIFICANT))
        return max(min(enough, _STAGES), least)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> BeliefModel:
        """Refuse what would move or convert tensors: tables that are no buffers would stay behind."""
        for dtype in (self.dtype, torch.int64):
            probe = torch.ones(1, dtype=dtype, device=self.device)
            result = fn(probe)
            if result is not probe:
                what = f"on {result.device}" if result.device != probe.device else f"with dtype {result.dtype}"
                raise ValueError(
                    f"a model stays on its device {self.device} and in its type {self.dtype}; build the model {what}"
                )
        return super()._apply(fn, recurse)

    @property
    def observation_digits(self) -> tuple[int, int]:
        """Base and count of the numbers that make an observation, such as what each robot sees; here one number below Z."""
        return self.num_observations, 1

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
        """U(y): bool ``[*B, U]``, True where a control is legal; at least one is. See :mod:`.controls` for many agents."""

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
        it in the same state, see :mod:`torchrl_pomdp.modules.scenarios`. By default each uniform has a hidden variable of its
        own. Uniforms of one name are equal where it is observed for the first time; later ones are not. Names are below
        :math:`2^{32}`.
        """
        return torch.arange(self.noise_dim, device=self.device).expand(*y.batch_size, self.noise_dim)

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

        Raises:
            TypeError: if ``keys`` are no names; by :meth:`check_state`.
            ValueError: by :meth:`check_state`.
        """
        if keys is not None:
            check_sequence("keys", keys, str)
        self.check_state(y)
        return self.derive(y, keys)

    def derive(self, y: TensorDictBase, keys: tuple[str, ...] | None = None) -> TensorDictBase:
        """:meth:`with_features` of states that the model has made or has checked."""
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
        count = self.control_range
        mask = (*shape, *self.control_shape, count)
        spec["action_mask"] = Binary(count, shape=mask, dtype=torch.bool, device=self.device)
        if self.partition is not None:
            spec["partition"] = Categorical(self.partition.num_parts, shape=shape, dtype=torch.int64, device=self.device)
        return spec

    def check_state(self, y: TensorDictBase) -> None:
        """Raise unless ``y`` is a feature state of this model.

        Upper bounds may be passed by the rounding of a few operations, lower ones may not: sums only grow.

        Raises:
            TypeError: if ``y`` is not a TensorDict or an entry has the wrong dtype.
            ValueError: if an entry is missing, has the wrong shape, or lies outside its bounds.
        """
        check_state_entries("y", y, self.state_spec(), "a feature state")

    def check_observations(self, y: TensorDictBase, z: Tensor) -> None:
        """Raise unless ``z`` ``[*B]`` are observations of this model, whether possible in ``y`` ``[*B]`` or not.

        Raises:
            TypeError: if ``z`` is no tensor.
            ValueError: if its type or shape is another, or a number is out of range.
        """
        check_index("observation", z, y.batch_size)
        if z.numel():
            low, high = z.aminmax()
            if low < 0 or high >= self.num_observations:
                raise ValueError(
                    f"observation must be in 0..{self.num_observations - 1}, got {int(low if low < 0 else high)} among them"
                )

    def refuse_impossible(self, z: Tensor, possible: Tensor) -> None:
        """For estimators: raise if an observation is not possible.

        Args:
            z: observations, int64 ``[*B]``.
            possible: whether each has a positive probability, bool ``[*B]``.

        Raises:
            ValueError: at the first one that is not.
        """
        if not possible.all():
            where = tuple((~possible).nonzero()[0].tolist())
            raise ValueError(f"observation {int(z[where])}{place(where)} is impossible after this control")

    def drawn(self, generator: StateGenerator, keys: Tensor, name: str = "generator") -> TensorDictBase:
        """The feature states ``[*B]`` that a generator, called ``name`` in messages, gives for int64 keys ``[*B]``, checked.

        Core entries come to the model's device and, where they are floating, to its type.

        Raises:
            TypeError: if the generator gives no TensorDict, or an entry of the wrong kind.
            ValueError: if it gives another batch than the keys', or what is no feature state of this model.

        Examples:
            >>> from torchrl_pomdp.envs import FixedBelief
            >>> from torchrl_pomdp.problems import tiger
            >>> tiger().model.drawn(FixedBelief(torch.tensor([0.5, 0.5])), torch.arange(3))["belief"].shape
            torch.Size([3, 2])
        """
        y = generated(generator, keys, name)
        result = TensorDict(dict(y.items()), batch_size=y.batch_size, device=self.device)
        for key in self.state_keys:
            leaf = result.get(key, None)
            if isinstance(leaf, Tensor) and leaf.is_floating_point():
                result.set(key, leaf.to(self.dtype))
        self.check_state(result)
        return result

    def world(self) -> World:
        """The hidden states that the beliefs are about, for :class:`~torchrl_pomdp.envs.WorldEnv`; not every model has them.

        Raises:
            TypeError: if this model has none.

        Examples:
            >>> from torchrl_pomdp.problems import make_problem
            >>> [key for key in make_problem("linear20").model.world().hidden_spec().keys()]
            ['level', 'location']
        """
        raise TypeError(f"model has no hidden states: {type(self).__name__} must override world(), giving a World")

    def scene(self) -> Scene:
        """How feature states are drawn: bars of the core entries, unless a model has a better picture."""
        return Scene(self)

    # ---- what a real robot does and reports, see torchrl_pomdp.controller ---------------------------------------------

    def shown_control(self, u: Tensor) -> tuple[str, ...]:
        """Names of control ``u`` ``[*S]``, one for each robot; its number where the model has no names."""
        return (name_of(int(u), self.control_names),)

    def given_control(self, control: Any) -> Tensor:
        """The control ``[*S]`` that is given by number or name; raises as :func:`~torchrl_pomdp.envs.names.number_of` does."""
        return torch.tensor(number_of("control", control, self.control_names, self.num_controls), device=self.device)

    def condition(self, y: TensorDictBase, observation: Any) -> TensorDictBase:
        """The state ``y``, of batch ``()``, after a look before the first control. Most models have none and refuse."""
        raise ValueError(f"observation must wait for a control: {type(self).__name__} sees nothing before the first one")

    def follow(self, y: TensorDictBase, u: Tensor, observation: Any) -> TensorDictBase:
        """F(y, u, z) of a single state, of batch ``()``, for a reported observation: a number or a name.

        Raises:
            TypeError: if the observation is neither.
            ValueError: if it is unknown, or impossible after this control.
        """
        z = number_of("observation", observation, self.observation_names, self.num_observations)
        possible = (self.observation_probs(y, u) > 0).nonzero().flatten().tolist()
        if z not in possible:
            names = ", ".join(name_of(each, self.observation_names) for each in possible)
            raise ValueError(f"observation must be possible after this control, one of {names}; got {observation!r}")
        return self.estimator(y, u, torch.tensor(z, device=self.device))

    def describe(self) -> str:
        """One line: what the model is, with the numbers of states, where it is known, of controls and of observations."""
        states = f"{self.num_states} states, " if hasattr(self, "num_states") else ""
        return (
            f"{type(self).__name__}: {states}{self.num_controls} controls, {self.num_observations} observations, "
            f"discount {self.discount:g}"
        )


def generated(generator: StateGenerator, keys: Tensor, name: str = "generator") -> TensorDictBase:
    """What a generator gives for int64 keys ``[*B]``: raises unless it is a TensorDict ``[*B]``."""
    check_callable(name, generator)
    y = generator(check_keys("keys", keys))
    if not isinstance(y, TensorDictBase):
        raise TypeError(f"{name} must give a TensorDict of feature states, got {shown(y)}")
    if y.batch_size != keys.shape:
        raise ValueError(f"{name} must give one state for each key, {tuple(keys.shape)}, got batch {tuple(y.batch_size)}")
    return y
