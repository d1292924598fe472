r"""RockSample(n, k) (Smith and Simmons 2004): which rocks are worth the way, and which are worth a look first.

A rover on n x n cells, k of which hold a rock, good with probability 1/2 each and independently, knows where it is and where
rocks are. Sampling a good rock pays 10, a bad one costs 10; a rock is bad once it is sampled. Checking a rock at Euclidean
distance d is right with probability :math:`(1+2^{-d/20})/2`. Leaving the map to the east pays 10 and ends it all. Moves and
checks are free but for the discount, 0.95. Rocks stay independent given the history: the belief is a probability for each.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite

from torchrl_pomdp.checks import check_integer, check_sequence, shown
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.envs.world import World
from torchrl_pomdp.tensor_checks import check_device, check_dtype

__all__ = ["EAST", "FIRST_CHECK", "HALVING_DISTANCE", "NORTH", "SAMPLE", "SOUTH", "WEST", "RockSample", "offsets"]

DISCOUNT, REWARD, HALVING_DISTANCE = 0.95, 10.0, 20.0
# The controls before the checks; a check of rock i is FIRST_CHECK + i.
NORTH, SOUTH, EAST, WEST, SAMPLE, FIRST_CHECK = range(6)
NONE, GOOD, BAD = range(3)
# Most numbers of a table by cell and control.
_MOST = 1 << 24


class RockSample(BeliefModel):
    r"""Belief model of RockSample with n x n cells and k rocks.

    Core entries: ``"belief"`` float ``[*B, k]``, the probability that each rock is good, and ``"location"`` int64 ``[*B, 1]``,
    the rover's cell x + n y, or n² when it has left, which is terminal. The controls are north, south, east, west, sample, and
    check rock 0 to k-1. Leaving the map but to the east and sampling where no rock is are illegal. Where the rover has left,
    the control east alone is legal, and does nothing. Costs are minus the rewards.

    Args:
        size: n, the side of the map.
        rocks: their cells (x east, y north), distinct.
        discount: :math:`\alpha`.

    Keyword Args:
        partition: partition whose index becomes a feature.
        dtype: float32 or float64.
        device: where the model computes.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if there is no rock, a rock lies outside the map or two share a cell, or there are too many cells and
            rocks for a table.

    Examples:
        >>> from tensordict import TensorDict
        >>> model = RockSample(7, [(2, 0), (0, 1), (3, 3)])
        >>> model.describe()
        'RockSample(7, 3): 393 states, 8 controls, 3 observations, discount 0.95'
        >>> y = TensorDict({"belief": torch.full((1, 3), 0.5), "location": torch.tensor([[21]])}, [1])
        >>> check, good = torch.tensor([FIRST_CHECK + 2]), torch.tensor([model.observation_names.index("good")])
        >>> [round(p, 3) for p in model.estimator(y, check, good)["belief"][0].tolist()]
        [0.5, 0.5, 0.951]
    """

    state_keys = ("belief", "location")
    num_observations = 3
    max_cost = REWARD
    observation_names = ("none", "good", "bad")
    destinations: Tensor
    concerns: Tensor
    accuracy: Tensor
    legal: Tensor
    exit_cost: Tensor

    def __init__(
        self,
        size: int,
        rocks: Sequence[Sequence[int]],
        discount: float = DISCOUNT,
        *,
        partition: Partition | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(discount, partition)
        self.size = check_integer("size", size, 1, 1000)
        self.rocks = _checked_rocks(rocks, self.size)
        dtype, device = check_dtype("dtype", dtype), check_device("device", device)
        self.num_rocks, self.exit = len(self.rocks), self.size**2
        self.num_controls = FIRST_CHECK + self.num_rocks
        if (self.exit + 1) * self.num_controls > _MOST:
            allowed = f"(size^2 + 1) (rocks + {FIRST_CHECK}) at most {_MOST}"
            raise ValueError(f"size and rocks must have {allowed}, got a size of {size} and {self.num_rocks} rocks")
        names = [f"check rock {rock}" for rock in range(self.num_rocks)]
        self.control_names = ("north", "south", "east", "west", "sample", *names)
        for name, table in self._tables(dtype).items():
            self.register_buffer(name, table.to(device), persistent=False)

    def _tables(self, dtype: torch.dtype) -> dict[str, Tensor]:
        """All that depends on cell and control alone, cell by cell; a rover that has left is in the last cell."""
        cells, n = torch.arange(self.exit), self.size
        x, y = cells % n, cells // n
        across, up = offsets(n, self.rocks)
        here = (across == 0) & (up == 0)
        shape = self.exit + 1, self.num_controls
        legal, left = torch.ones(shape, dtype=torch.bool), torch.tensor(self.exit)
        legal[:-1, :FIRST_CHECK] = torch.stack([y < n - 1, y > 0, y >= 0, x > 0, here.any(0)], -1)
        legal[-1] = torch.arange(self.num_controls) == EAST
        stays = torch.arange(self.exit + 1).unsqueeze(-1).repeat(1, self.num_controls)
        goes = torch.stack([cells + n, cells - n, torch.where(x < n - 1, cells + 1, left), cells - 1], -1)
        destinations = stays.clone()
        destinations[:-1, :SAMPLE] = torch.where(legal[:-1, :SAMPLE], goes, stays[:-1, :SAMPLE])
        accuracy = torch.ones(shape, dtype=torch.float64)
        distance = (across.double().square() + up.double().square()).sqrt()
        accuracy[:-1, FIRST_CHECK:] = (1.0 + 2.0 ** (-distance.T / HALVING_DISTANCE)) / 2.0
        concerns = torch.zeros(shape, dtype=torch.int64)
        concerns[:-1, SAMPLE] = here.int().argmax(0)
        concerns[:, FIRST_CHECK:] = torch.arange(self.num_rocks)
        exit_cost = torch.zeros(shape)
        exit_cost[:-1, EAST] = -REWARD * (x == n - 1)
        tables = {
            "destinations": destinations,
            "accuracy": accuracy.to(dtype),
            "concerns": concerns,
            "exit_cost": exit_cost.to(dtype),
        }
        return {name: table.flatten() for name, table in tables.items()} | {"legal": legal}

    @property
    def device(self) -> torch.device:
        """Device of the model's tensors."""
        return self.accuracy.device

    @property
    def dtype(self) -> torch.dtype:
        """Type of beliefs and costs."""
        return self.accuracy.dtype

    def state_spec(self, batch_size: torch.Size | tuple[int, ...] = ()) -> Composite:
        """``belief`` ``[*B, k]`` in [0, 1] and ``location`` ``[*B, 1]``."""
        shape = torch.Size(batch_size)
        return Composite(
            belief=Bounded(0.0, 1.0, shape=(*shape, self.num_rocks), dtype=self.dtype, device=self.device),
            location=Categorical(self.exit + 1, shape=(*shape, 1), dtype=torch.int64, device=self.device),
            shape=shape,
            device=self.device,
        )

    def describe(self) -> str:
        """Size, and the numbers of states, controls and observations."""
        states = self.exit * 2**self.num_rocks + 1
        return (
            f"RockSample({self.size}, {self.num_rocks}): {states if states < 1e9 else f'{states:.1e}'} states, "
            f"{self.num_controls} controls, {self.num_observations} observations, discount {self.discount:g}"
        )

    def is_terminal(self, y: TensorDictBase) -> Tensor:
        """Bool ``[*B]``: the rover has left."""
        return y.get("location").squeeze(-1) == self.exit

    def action_mask(self, y: TensorDictBase) -> Tensor:
        """Legal controls, bool ``[*B, U]``; they depend on the cell alone."""
        location = y.get("location")
        return self.legal.index_select(0, location.flatten()).view(*location.shape[:-1], self.num_controls)

    def expected_cost(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """10 (1 - 2p) for sampling a rock that is good with probability p, -10 for leaving, else 0: ``[*B]``."""
        pair, _, good = self._concerned(y, u)
        return self._cost(u, pair, good)

    def observation_probs(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """Probabilities of none, good and bad, ``[*B, 3]``: none unless a rock is checked.

        Raises as :meth:`check_control_shape` does.
        """
        self.check_control_shape(y, u)
        pair, _, good = self._concerned(y, u)
        (_, seen_good), (_, seen_bad) = _joint(good, self.accuracy[pair])
        blind = u < FIRST_CHECK
        return torch.stack([blind.to(self.dtype), seen_good.masked_fill(blind, 0.0), seen_bad.masked_fill(blind, 0.0)], -1)

    def estimator(self, y: TensorDictBase, u: Tensor, z: Tensor) -> TensorDictBase:
        """F(y, u, z): Bayes' rule for the rock that is checked; a sampled rock is bad.

        Raises:
            ValueError: if a control is illegal or an observation impossible.
        """
        self.check_controls(y, u)
        self.check_observations(y, z)
        self.refuse_impossible(z, self.observation_probs(y, u).gather(-1, z.unsqueeze(-1)).squeeze(-1) > 0)
        pair, rock, good = self._concerned(y, u)
        return self._moved(y, u, pair, rock, good, _posterior(_joint(good, self.accuracy[pair]), z == GOOD))

    def advance(self, y: TensorDictBase, u: Tensor, noise: Tensor) -> tuple[Tensor, TensorDictBase]:
        """One sampled step; a check sees good where the noise is below its probability. See :meth:`BeliefModel.advance`."""
        pair, rock, good = self._concerned(y, u)
        joint = _joint(good, self.accuracy[pair])
        posterior = _posterior(joint, noise[..., 0] < joint[0][1])
        return self._cost(u, pair, good), self._moved(y, u, pair, rock, good, posterior)

    def observed(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """1 + the rock that is checked, 0 for controls that see nothing, int64 ``[*B, 1]``."""
        return (u - FIRST_CHECK + 1).clamp_min(0).unsqueeze(-1)

    def world(self) -> World:
        """Which rocks are good."""
        # Not at the top: the world knows the model.
        from torchrl_pomdp.problems.rocksample_world import RockWorld

        return RockWorld(self)

    def _concerned(self, y: TensorDictBase, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The pair of cell and control, the rock that it concerns (the first for none), and P(that rock is good), ``[*B]``."""
        pair = y.get("location").squeeze(-1) * self.num_controls + u
        rock = self.concerns[pair]
        return pair, rock, y.get("belief").movedim(-1, 0).gather(0, rock.unsqueeze(0)).squeeze(0)

    def _cost(self, u: Tensor, pair: Tensor, good: Tensor) -> Tensor:
        return torch.where(u == SAMPLE, REWARD - 2.0 * REWARD * good, self.exit_cost[pair])

    def _moved(self, y: TensorDictBase, u: Tensor, pair: Tensor, rock: Tensor, good: Tensor, checked: Tensor) -> TensorDictBase:
        """The successor, if a check leaves the rock good with the probability ``checked``; beliefs are planes ``[k, *B]``."""
        new = torch.where(u >= FIRST_CHECK, checked, good.masked_fill(u == SAMPLE, 0.0))
        belief = y.get("belief").movedim(-1, 0).scatter(0, rock.unsqueeze(0), new.unsqueeze(0)).movedim(0, -1)
        return self.successor(y, belief=belief, location=self.destinations[pair].unsqueeze(-1))


_Joint = tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]


def _joint(good: Tensor, accuracy: Tensor) -> _Joint:
    """P(rock is good, seen so) and P(seen so) for seen good and for seen bad."""
    bad, error = 1.0 - good, 1.0 - accuracy
    hit, missed = good * accuracy, good * error
    return (hit, hit + bad * error), (missed, missed + bad * accuracy)


def _posterior(joint: _Joint, seen_good: Tensor) -> Tensor:
    """P(good) after a check."""
    (hit, by_hit), (missed, by_missed) = joint
    return torch.where(seen_good, hit, missed) / torch.where(seen_good, by_hit, by_missed)


def offsets(size: int, rocks: Sequence[Sequence[int]]) -> tuple[Tensor, Tensor]:
    """How far east and how far north of each of the n² cells each rock is, int64 ``[k, n²]``."""
    cells, at = torch.arange(size * size), torch.tensor(rocks).unsqueeze(-1)
    return at[:, 0] - cells % size, at[:, 1] - cells // size


def _checked_rocks(rocks: Sequence[Sequence[int]], size: int) -> tuple[tuple[int, int], ...]:
    check_sequence("rocks", rocks, Sequence, 1)
    cells = []
    for i, cell in enumerate(rocks):
        if len(check_sequence(f"rocks[{i}]", cell, int)) != 2:
            raise ValueError(f"rocks[{i}] must be a cell (x, y), got {shown(cell)}")
        x, y = (check_integer(f"rocks[{i}][{axis}]", number, 0, size - 1) for axis, number in enumerate(cell))
        cells.append((x, y))
    if len(set(cells)) < len(cells):
        raise ValueError(f"rocks must lie in distinct cells, got {shown(rocks)}")
    return tuple(cells)
