"""Several robots as one: joint controls, and what each of them reports (paper, Section VI-A)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from numbers import Integral
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import shown
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.names import number_of
from torchrl_pomdp.envs.repair.graphs import Graph

__all__ = ["Robots"]


class Robots(BeliefModel):
    """The robots of a :class:`~torchrl_pomdp.envs.repair.RepairModel`: their controls, and observations that may be missing.

    Robots are agents, see :mod:`~torchrl_pomdp.envs.controls` for joint controls. An observation is the damage
    level that a robot sees where it stands: one for each robot, or None from a robot that does not report; a single robot's
    may stand alone.

    Attributes:
        graph: where the robots move.
        num_robots: R.
        num_robot_controls: A, the number of controls of one robot.
        num_levels: K.
    """

    graph: Graph
    num_robots: int
    num_robot_controls: int
    num_levels: int

    @property
    def num_agent_controls(self) -> int:
        """A: robots are the model's agents, see :mod:`~torchrl_pomdp.envs.controls`."""
        return self.num_robot_controls

    @property
    def observation_digits(self) -> tuple[int, int]:
        """K and R: each robot sees a level."""
        return self.num_levels, self.num_robots

    # ---- what real robots do and report --------------------------------------------------------------------------------

    def shown_control(self, u: Tensor) -> tuple[str, ...]:
        """Names of the robots' controls, such as ``("repair", "left")``."""
        return tuple(self.graph.control_names[c] for c in self.split_controls(u).tolist())

    def given_control(self, control: Any) -> Tensor:
        """The joint control that is given by its number, or by a number or name for each robot; of one robot without a list.

        Raises:
            TypeError: if it is of another kind.
            ValueError: if there is no such control, or not one for each robot.
        """
        number = isinstance(control, Integral) or (isinstance(control, Tensor) and control.shape == ())
        if number and self.enumerable:
            return torch.tensor(number_of("control", control, None, self.num_controls), device=self.device)
        each = self._each("control", control)
        names, count = self.graph.control_names, self.num_robot_controls
        numbers = [number_of(f"control of robot {robot}", given, names, count) for robot, given in enumerate(each)]
        return self.join_controls(torch.tensor(numbers, device=self.device))

    def condition(self, y: TensorDictBase, observation: Any) -> TensorDictBase:
        """The state ``y``, of batch ``()``, after the robots have looked where they stand, without a control.

        Raises:
            TypeError: if an observation is no level.
            ValueError: if it is unknown, or impossible in ``y``.
        """
        levels = self._levels_of(observation)
        location = y.get("location").reshape(-1, 1)
        return self._successor(y, self._report(self._planes(y).clone(), location, levels), location)

    def follow(self, y: TensorDictBase, u: Tensor, observation: Any) -> TensorDictBase:
        """The next state for a single state, of batch ``()``, given the levels that some of the robots report.

        Where no robot reports from, the belief is the prediction: intact for sure after a repair that always works.

        Raises:
            TypeError: if an observation is no level.
            ValueError: if it is unknown, or impossible after this control.
        """
        levels = self._levels_of(observation)
        location, repaired = self._move(y, u)
        planes = self._degrade_planes(self._planes(y))
        for place in {place for place, done in zip(location[:, 0].tolist(), repaired[:, 0].tolist(), strict=True) if done}:
            planes[place] = self._repaired(planes[place])
        return self._successor(y, self._report(planes, location, levels), location)

    def _each(self, what: str, given: Any) -> Sequence[Any]:
        """What is given for each robot; for one robot it may stand alone."""
        several = isinstance(given, Sequence) and not isinstance(given, (str, bytes))
        if not several and self.num_robots == 1:
            return [given]
        if not several:
            raise TypeError(f"{what} must be a sequence, one for each of the {self.num_robots} robots, got {shown(given)}")
        if len(given) != self.num_robots:
            raise ValueError(f"{what} must hold one for each of the {self.num_robots} robots, got {shown(given)}")
        return given

    def _levels_of(self, observation: Any) -> list[int | None]:
        """One level or None for each robot; None alone: no robot reports."""
        each = [None] * self.num_robots if observation is None else self._each("observation", observation)
        names = self.observation_names
        return [
            None if level is None else number_of(f"observation of robot {robot}", level, names, self.num_levels)
            for robot, level in enumerate(each)
        ]

    def _report(self, planes: Tensor, location: Tensor, levels: Sequence[int | None]) -> Tensor:
        """The planes ``[L, K, 1]`` of a state once the robots have seen levels, written into."""
        for robot, (place, seen) in enumerate(zip(location[:, 0].tolist(), levels, strict=True)):
            if seen is None:
                continue
            possible = (planes[place, :, 0] > 0).nonzero().flatten().tolist()
            if seen not in possible:
                where = self.graph.location_names[place]
                raise ValueError(
                    f"observation of robot {robot} must be possible: level {seen} at location {where} is not, "
                    f"what is known allows levels {possible}"
                )
            # Robots that stand together see the same level: the next one is held to this.
            planes[place, :, 0] = (torch.arange(self.num_levels, device=planes.device) == seen).to(planes.dtype)
        return planes

    # ---- what the model computes ---------------------------------------------------------------------------------------

    @abstractmethod
    def _planes(self, y: TensorDictBase) -> Tensor:
        """Belief of ``y`` as planes ``[L, K, N]``."""

    @abstractmethod
    def _move(self, y: TensorDictBase, u: Tensor) -> tuple[Tensor, Tensor]:
        """For each robot ``[R, N]`` its new location and whether it repairs there."""

    @abstractmethod
    def _degrade_planes(self, planes: Tensor) -> Tensor:
        """Planes one step of the chain later, as a new tensor."""

    @abstractmethod
    def _repaired(self, column: Tensor) -> Tensor:
        """Marginal ``[K, N]`` after an attempt to repair, of one that is ``column`` where it fails."""

    @abstractmethod
    def _successor(self, y: TensorDictBase, planes: Tensor, location: Tensor) -> TensorDictBase:
        """The feature state of planes ``[L, K, N]`` and locations ``[R, N]``."""
