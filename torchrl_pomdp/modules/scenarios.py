r"""Common random numbers: simulated trajectories as scenarios of what there is to be observed.

Controls are compared by simulations under the same noise (paper, Section III). Were the noise tied to steps alone, two robots
that walk the same way one step apart would draw different damage for every location, and the comparison would be hardly better
than with independent noise. Here the *first* observation of a hidden variable, such as the damage of a location, is tied to the
trajectory and the variable: in one scenario a location is found in much the same state whenever, and by whatever way, a robot
gets there. Later observations of the same variable are tied to the step. All uniforms of a trajectory are independent.

The trajectories of one estimate are stratified: their n uniforms for the first observation of a variable lie one in each of n
equal slices of [0, 1), in a random order that is independent from variable to variable (a Latin hypercube).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_pomdp.noise import fold, permuted, uniform

__all__ = ["Scenarios"]

# Variables are remembered as bits of an int64; those that share a bit with another one count as observed with it.
BITS = 63
# Steps count from here, above the names of all variables.
STEPS = 1 << 32
LARGEST = 1.0 - 2.0**-24


class Scenarios(NamedTuple):
    """The noise of N trajectories, and which variables they have observed.

    Attributes:
        keys: stream of each trajectory, int64 ``[N]``.
        groups: key that the trajectories of one estimate share, int64 ``[N]``.
        members: number of each trajectory in its estimate, int64 ``[N]``, below the number of trajectories.
        seen: bits of the variables that have been observed, int64 ``[N]``.
    """

    keys: Tensor
    groups: Tensor
    members: Tensor
    seen: Tensor

    @classmethod
    def single(cls, keys: Tensor) -> Scenarios:
        """Trajectories that are each an estimate of its own; nothing has been observed.

        Args:
            keys: int64 ``[N]``.

        Examples:
            >>> scenarios = Scenarios.single(torch.arange(3))
            >>> noise, _ = scenarios.draw(torch.zeros(3, dtype=torch.int64), torch.tensor([[7], [7], [2]]), 1)
            >>> later, _ = scenarios.draw(torch.full((3,), 9), torch.tensor([[7], [7], [2]]), 1)
            >>> torch.equal(noise, later), noise.shape
            (True, torch.Size([3, 1]))
        """
        zeros = torch.zeros_like(keys)
        return cls(keys, keys, zeros, zeros)

    def rows(self, index: Tensor) -> Scenarios:
        """The trajectories with numbers ``index``."""
        return Scenarios(*(entry[index] for entry in self))

    def replace_rows(self, index: Tensor, other: Scenarios) -> Scenarios:
        """With the trajectories ``other`` in the places ``index``."""
        return Scenarios(*(mine.index_copy(0, index, theirs) for mine, theirs in zip(self, other, strict=True)))

    def observe(self, names: Tensor) -> Scenarios:
        """With the variables ``names`` ``[N, R]`` observed."""
        seen = self.seen
        for name in names.unbind(-1):
            seen = seen | _bit(name)
        return self._replace(seen=seen)

    def draw(self, age: Tensor, names: Tensor, count: int) -> tuple[Tensor, Scenarios]:
        """Uniforms ``[N, R]`` for the observation of the variables ``names`` ``[N, R]``, and the scenarios after it.

        Args:
            age: steps that the trajectories have made, int64 ``[N]``.
            names: the variables, not negative, below 2**32.
            count: number of trajectories of an estimate.
        """
        robots = names.shape[-1]
        columns, seen = [], self.seen
        for robot, name in enumerate(names.unbind(-1)):
            bit = _bit(name)
            first, seen = (self.seen & bit) == 0, seen | bit
            noise = uniform(self.keys, torch.where(first, name, STEPS + age * robots + robot))
            columns.append(self._stratified(noise, first, name, count) if count > 1 else noise)
        return torch.stack(columns, -1), self._replace(seen=seen)

    def _stratified(self, noise: Tensor, first: Tensor, name: Tensor, count: int) -> Tensor:
        """``noise`` ``[N]``, within the trajectory's slice where it is the ``first`` observation of its variable."""
        if torch.compiler.is_compiling():
            # Which rows these are depends on the data, which a compiler cannot follow.
            return torch.where(first, _within_slice(noise, self.groups, self.members, name, count), noise)
        rows = first.nonzero().squeeze(-1)
        inside = _within_slice(noise[rows], self.groups[rows], self.members[rows], name[rows], count)
        return noise.index_copy(0, rows, inside)


def _within_slice(noise: Tensor, groups: Tensor, members: Tensor, name: Tensor, count: int) -> Tensor:
    return ((permuted(fold(groups, name), members, count) + noise) / count).clamp_max(LARGEST)


def _bit(name: Tensor) -> Tensor:
    return torch.ones_like(name) << (name % BITS)
