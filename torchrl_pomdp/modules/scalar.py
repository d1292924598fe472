r"""What a compiled simulation is to the rollout: trajectories and Q-factors, one at a time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from time import perf_counter
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.modules.truncation import Truncation

__all__ = [
    "MOST_NUMBERS",
    "Allocation",
    "Cut",
    "Limited",
    "Roots",
    "ScalarEngine",
    "SearchEngine",
    "local_engine",
    "offer_engines",
    "scalar_engine",
]


MOST_NUMBERS = 1 << 22
"""The most numbers in tables of compiled simulations: every entry may be read at every step."""


class Cut(NamedTuple):
    """Trajectories that were cut, and whose terminal cost is still to be added.

    Attributes:
        rows: their numbers, int64 ``[M]``.
        ages: the steps that they made, int64 ``[M]``.
        y: their feature states, core entries ``[M]``.
    """

    rows: Tensor
    ages: Tensor
    y: TensorDictBase


class Allocation(NamedTuple):
    """How the trajectories of a decision are spent.

    Attributes:
        order: numbers of the trajectories in the order in which they are made, ``[n]``.
        rounds: how many of them every round makes.
        observations: whether a leaf is an observation.
        clearly: standard errors by which a control is beaten and gets no more; infinite: none ever is.
        seconds: time for the decision; None: as long as it takes.
    """

    order: NDArray[np.int64]
    rounds: NDArray[np.int64]
    observations: bool
    clearly: float
    seconds: float | None

    def stretches(self) -> Iterator[NDArray[np.int64]]:
        """The rounds, as many at a time as the time allows; the first one always."""
        if self.seconds is None:
            yield self.rounds
            return
        begin, done, spent = perf_counter(), 0, 0
        while done < len(self.rounds):
            elapsed = perf_counter() - begin
            # A trajectory of what is left costs no more than one so far, as beaten controls get none.
            fitting = self.rounds[done] if spent == 0 else int(min(spent, spent * (self.seconds / elapsed - 1.0)))
            last = done + int(np.searchsorted(np.cumsum(self.rounds[done:]), fitting, "right"))
            if last == done:
                return
            yield self.rounds[done:last]
            spent += int(self.rounds[done:last].sum())
            done = last


class Roots(NamedTuple):
    """States from which a search grows trees, see :mod:`torchrl_pomdp.scalar.models`.

    Attributes:
        model: scalar model and its data.
        policy: scalar twin and its data.
        keys: the states' streams of random numbers, uint64 ``[N]``.
        state: makes the memory of the model for a state, by its number, with the state as root.
        width: numbers that a state is kept in.
        least: no policy costs less from any state.
    """

    model: tuple[Any, ...]
    policy: tuple[Any, ...]
    keys: NDArray[np.uint64]
    state: Callable[[int], Any]
    width: int
    least: float


class Limited(NamedTuple):
    """When the trajectories of a rollout end, see :class:`~torchrl_pomdp.modules.TruncatedRollout`."""

    max_steps: int
    truncation: Truncation | None
    terminal_cost: Any


class SearchEngine(ABC):
    """A policy and its model in compiled searches."""

    @abstractmethod
    def roots(self, y: TensorDictBase, seed: int) -> Roots:
        """States ``[*B]``, checked, as roots of searches.

        Args:
            y: feature states.
            seed: seed of their random numbers.
        """


class ScalarEngine(SearchEngine):
    """Simulates the trajectories of a policy with a scalar twin; means the same as the tensors' way.

    Attributes:
        closed: whether Q-factors can be computed in one go: all that a cut adds is known to the compiled loop.
    """

    closed: bool

    @abstractmethod
    def simulate(self, y: TensorDictBase, scenarios: Scenarios, count: int) -> tuple[Tensor, int, Cut | None]:
        """Cost of one trajectory from each of the states ``y`` ``[N]``.

        Args:
            y: feature states, checked.
            scenarios: their noise.
            count: number of trajectories of an estimate.

        Returns:
            costs ``[N]``, steps, and the trajectories that still lack a terminal cost.
        """

    @abstractmethod
    def q_factors(
        self,
        y: TensorDictBase,
        keys: Tensor | None,
        seed: int,
        allocation: Allocation,
        controls: NDArray[np.int64] | None = None,
    ) -> tuple[NDArray[np.float64], int]:
        """Q-factors ``[N, C]`` of states of batch ``[*B]``, infinite where a control is illegal, and the number of steps.

        Args:
            y: feature states.
            keys: keys of their scenarios, ``[N]``; None: as ``RolloutPolicy.keys`` gives them.
            seed: seed of these.
            allocation: how trajectories are spent.
            controls: the candidates, each the controls of R parts, such as robots, ``[N, C, R]``, C at least 1; None: all joint
                controls in their order.

        Raises:
            TypeError: by ``BeliefModel.check_state``.
            ValueError: likewise, or if the policy's twin chooses an illegal control.
        """


# What a class defines that does something.
_METHODS = (FunctionType, property, staticmethod, classmethod)

LocalEngines = Callable[[Sequence[Any], BeliefModel, Limited], SearchEngine | None]
_OFFERED: dict[type[BeliefModel], LocalEngines] = {}


def offer_engines(kind: type[BeliefModel], make: LocalEngines) -> None:
    """Let ``make`` be asked for compiled simulations of local policies, networks among them, for models of a kind.

    Args:
        kind: the class of the models.
        make: gives an engine, or None, for local policies, one for each part, a model and limits.
    """
    _OFFERED[kind] = make


def local_engine(policies: Sequence[Any], model: BeliefModel, limits: Limited) -> SearchEngine | None:
    """Compiled simulations of local policies, one for each part; None where there are none for the model, or for them.

    Args:
        policies: the policies; a single one for all parts; none: any legal control, all equally likely.
        model: the belief model.
        limits: when trajectories end.
    """
    if model.device.type != "cpu" or find_spec("numba") is None:
        return None
    make = _OFFERED.get(type(model))
    return None if make is None else make(policies, model, limits)


def scalar_engine(policy: Any, model: BeliefModel, limits: Limited) -> SearchEngine | None:
    """Compiled simulations of a policy, or searches alone; None on an accelerator, without numba, or where none are offered.

    A policy offers them by a method ``scalar_engine(model, limits)``; a class below that overrides another method does not.

    Args:
        policy: the policy.
        model: the belief model.
        limits: when trajectories end.
    """
    if not _has_twin(policy) or model.device.type != "cpu" or find_spec("numba") is None:
        return None
    engine: SearchEngine | None = policy.scalar_engine(model, limits)
    return engine


def makeup(policy: Any) -> tuple[tuple[nn.Module, ...], tuple[bool, ...]]:
    """What compiled simulations of a policy are made of: once it differs, they are to be made anew.

    Args:
        policy: the policy.

    Returns:
        its modules, none for what is no module; and, if any has hooks or a ``forward`` of its own, of which twins know
        nothing, which ones.
    """
    members: list[nn.Module] = []
    if isinstance(policy, nn.Module):
        _add_members(policy, members)
    altered = tuple([bool(m._forward_hooks or m._forward_pre_hooks or "forward" in vars(m)) for m in members])
    return tuple(members), altered if any(altered) else ()


def _add_members(module: nn.Module, members: list[nn.Module]) -> None:
    # A decision waits for this, and ``modules()`` takes three times as long.
    members.append(module)
    for child in module._modules.values():
        if child is not None:
            _add_members(child, members)


def _has_twin(policy: Any) -> bool:
    """Whether a policy offers compiled simulations of what it does, and not of what a class does that it overrides."""
    kinds = type(policy).__mro__
    offering = next((kind for kind in kinds if "scalar_engine" in vars(kind)), None)
    if offering is None:
        return False
    above = kinds[: kinds.index(offering)]
    return not any(_overrides(kind, offering) for kind in above) and not makeup(policy)[1]


def _overrides(kind: type, offering: type) -> bool:
    """Whether a class defines anew what the class does that offers a twin; how it is made and shown does not matter."""
    methods = [name for name, entry in vars(kind).items() if isinstance(entry, _METHODS)]
    ours = [name for name in methods if name == "__call__" or not name.startswith("__")]
    return any(getattr(offering, name, None) is not getattr(nn.Module, name, None) for name in ours)
