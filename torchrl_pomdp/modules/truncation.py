r"""When a simulated trajectory is cut: the state-dependent number of steps m of truncated rollout (paper, Section III).

The paper truncates by "a variable and state-dependent value of m". A rule says of every trajectory, from its feature state,
its age and what it remembers of its start, whether it ends here with a terminal cost. Rules are joined by ``|``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance, check_integer, shown
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.tensor_checks import device_of

__all__ = ["AfterSteps", "OnEntering", "OnLeaving", "Truncation"]


class Truncation(ABC):
    r"""A rule that cuts simulated trajectories; the steps made until then are the m of :math:`T_\mu^m\hat J`.

    ``first | second`` stops when either does.

    Attributes:
        in_keys: entries of feature states that :meth:`stop` reads; they are computed at every step.
        width: w, how many numbers the rule remembers of a trajectory's start.
    """

    in_keys: tuple[str, ...] = ()
    width: int = 0

    @property
    def rules(self) -> tuple[Truncation, ...]:
        """The rules that this one joins, or this one."""
        return (self,)

    def start(self, y: TensorDictBase) -> Tensor:
        """What the rule remembers of trajectories that start at ``y`` ``[N]``, with all features: int64 ``[N, w]``."""
        return torch.zeros(*y.batch_size, self.width, dtype=torch.int64, device=device_of(y))

    @abstractmethod
    def stop(self, y: TensorDictBase, age: Tensor, memory: Tensor) -> Tensor:
        """Which trajectories are cut here, bool ``[N]``.

        Args:
            y: feature states ``[N]`` with at least ``in_keys``.
            age: steps made, int64 ``[N]``.
            memory: what :meth:`start` gave, int64 ``[N, w]``.
        """

    def check_model(self, model: BeliefModel) -> None:
        """Raise unless the rule can be applied to the feature states of ``model``.

        Raises:
            ValueError: if the model lacks a feature or a part that the rule names.
        """
        check_instance("model", model, BeliefModel)
        features = list(map(str, model.feature_spec().keys()))
        missing = [key for key in self.in_keys if key not in features]
        if missing:
            raise ValueError(f"truncation by {type(self).__name__} reads {missing}, but the model's features are {features}")

    def __or__(self, other: Truncation) -> Truncation:
        """The rule that stops when either does."""
        return _Either(self, other) if isinstance(other, Truncation) else NotImplemented


class AfterSteps(Truncation):
    r"""Stop after m steps.

    Args:
        m: the number of steps, at least 0; or a function of the feature states ``[N]`` in which trajectories start, with
            all features, that gives it for each, int64 ``[N]``: the paper's state-dependent m.

    Raises:
        TypeError: if m is neither.
        ValueError: if m is negative; at the start of a trajectory, if the function gives anything but such numbers.

    Examples:
        >>> AfterSteps(3).stop(None, torch.tensor([0, 2, 3]), torch.zeros(3, 0)).tolist()
        [False, False, True]
        >>> by_part = AfterSteps(lambda y: torch.where(y["partition"] < 3, 40, 10))
    """

    def __init__(self, m: int | Callable[[TensorDictBase], Tensor]) -> None:
        self._m = m if callable(m) else check_integer("m", m, 0, 1 << 62)
        self.width = int(callable(m))

    @property
    def m(self) -> int | Callable[[TensorDictBase], Tensor]:
        """The number of steps; fixed, as compiled simulations have read it."""
        return self._m

    def start(self, y: TensorDictBase) -> Tensor:
        """The state-dependent m ``[N, 1]``; nothing ``[N, 0]`` where m is a number."""
        if not callable(self.m):
            return super().start(y)
        steps = check_instance("m(y)", self.m(y), Tensor)
        if steps.shape != y.batch_size or steps.dtype != torch.int64:
            raise ValueError(f"m must give int64 {tuple(y.batch_size)}, got {steps.dtype} {tuple(steps.shape)}")
        if bool((steps < 0).any()):
            raise ValueError(f"m must give at least 0 for every state, got {int(steps.min())}")
        return steps.unsqueeze(-1)

    def stop(self, y: TensorDictBase, age: Tensor, memory: Tensor) -> Tensor:
        """Where m steps have been made."""
        return age >= (memory[:, 0] if callable(self.m) else self.m)


class OnEntering(Truncation):
    r"""Stop as soon as the state is in one of the given parts of the partition, also at once when it starts there.

    With the endgame parts, startgame trajectories end where a terminal cost of the endgame takes over (paper, Section VI-B).

    Args:
        parts: numbers of the parts, at least one.

    Raises:
        TypeError: if ``parts`` holds anything but integers.
        ValueError: if ``parts`` is empty or has a negative number; when given to a rollout, if the model has no such part.

    Examples:
        >>> from tensordict import TensorDict
        >>> y = TensorDict({"partition": torch.tensor([0, 3, 5])}, [3])
        >>> OnEntering((3, 4, 5)).stop(y, torch.zeros(3), torch.zeros(3, 0)).tolist()
        [False, True, True]
    """

    in_keys = ("partition",)

    def __init__(self, parts: Iterable[int]) -> None:
        if isinstance(parts, str) or not isinstance(parts, Iterable):
            raise TypeError(f"parts must be numbers of parts, got {shown(parts)}")
        self._parts = tuple(sorted({check_integer("parts", part) for part in parts}))
        if not self.parts or self.parts[0] < 0:
            raise ValueError(f"parts must hold at least one part and none below 0, got {self.parts}")

    @property
    def parts(self) -> tuple[int, ...]:
        """Numbers of the parts, in order; fixed, as compiled simulations have read them."""
        return self._parts

    def stop(self, y: TensorDictBase, age: Tensor, memory: Tensor) -> Tensor:
        """Where the state is in one of the parts."""
        part = y.get("partition")
        inside = part == self.parts[0]
        for other in self.parts[1:]:
            inside = inside | (part == other)
        return inside

    def check_model(self, model: BeliefModel) -> None:
        """Raise unless the model's partition has the parts."""
        super().check_model(model)
        if model.partition is not None and self.parts[-1] >= model.partition.num_parts:
            raise ValueError(f"parts must be in 0..{model.partition.num_parts - 1}, got {self.parts}")


class OnLeaving(Truncation):
    r"""Stop when the state is in another part of the partition than where the trajectory started.

    Examples:
        >>> from tensordict import TensorDict
        >>> y = TensorDict({"partition": torch.tensor([0, 3])}, [2])
        >>> OnLeaving().stop(y, torch.ones(2), torch.tensor([[0], [0]])).tolist()
        [False, True]
    """

    in_keys = ("partition",)
    width = 1

    def start(self, y: TensorDictBase) -> Tensor:
        """The part of the start, ``[N, 1]``."""
        return y.get("partition").unsqueeze(-1)

    def stop(self, y: TensorDictBase, age: Tensor, memory: Tensor) -> Tensor:
        """Where the part has changed."""
        return y.get("partition") != memory[:, 0]


class _Either(Truncation):
    """Stop when one of two rules does; the first one's memory comes first."""

    def __init__(self, first: Truncation, second: Truncation) -> None:
        self.first, self.second = first, second
        self.in_keys = tuple(dict.fromkeys((*first.in_keys, *second.in_keys)))
        self.width = first.width + second.width

    @property
    def rules(self) -> tuple[Truncation, ...]:
        return self.first.rules + self.second.rules

    def start(self, y: TensorDictBase) -> Tensor:
        return torch.cat([self.first.start(y), self.second.start(y)], -1)

    def stop(self, y: TensorDictBase, age: Tensor, memory: Tensor) -> Tensor:
        mine, others = memory[:, : self.first.width], memory[:, self.first.width :]
        return self.first.stop(y, age, mine) | self.second.stop(y, age, others)

    def check_model(self, model: BeliefModel) -> None:
        self.first.check_model(model)
        self.second.check_model(model)
