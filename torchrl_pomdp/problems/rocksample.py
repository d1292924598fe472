"""RockSample as a problem: the instances of papers, the base policy, and what networks see."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_pomdp.checks import check_instance, check_integer, check_number, check_seed
from torchrl_pomdp.envs.rows import take_rows
from torchrl_pomdp.modules.encoders import Encoder
from torchrl_pomdp.noise import fold, seed_keys, uniform
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.problems.rocksample_model import (
    EAST,
    FIRST_CHECK,
    HALVING_DISTANCE,
    NORTH,
    SAMPLE,
    SOUTH,
    WEST,
    RockSample,
    offsets,
)
from torchrl_pomdp.tensor_checks import check_device, check_entries, check_keys, device_of

__all__ = ["NearestRock", "RockEncoder", "RockSample", "random_rocks", "rocksample"]

# The rocks (x east, y north) of the instances that papers report, by (n, k).
LAYOUTS = {
    (7, 8): ((2, 0), (0, 1), (3, 1), (6, 3), (2, 4), (3, 4), (5, 5), (1, 6)),
    (11, 11): ((0, 3), (0, 7), (1, 8), (2, 4), (3, 3), (3, 8), (4, 3), (5, 8), (6, 1), (9, 3), (9, 9)),
}
# Random states: the shares of rocks that are known to be bad and of those that nothing is known of.
KNOWN_BAD, UNKNOWN = 0.4, 0.4


def rocksample(n: int, k: int, *, seed: int = 0, name: str = "rocksample", device: torch.device | str = "cpu") -> Problem:
    """RockSample(n, k), from the usual start: the rover in the western column, in the middle, and nothing known.

    (7, 8) and (11, 11) have the rocks of the papers; otherwise they lie in distinct random cells. What trains it well:
    ``torchrl-pomdp train rocksample11x11 --algorithm API --iterations 1 --samples-per-part 60000 --trajectories 10
    --max-steps 60 --epochs 15 --visits-per-label 0.3``.

    Args:
        n: cells on a side.
        k: rocks.

    Keyword Args:
        seed: seed of the random cells.
        name: what it is called.
        device: where the model computes.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if a number is not positive, or there are more rocks than cells.

    Examples:
        >>> problem = rocksample(15, 15, seed=3)
        >>> problem.model.describe()
        'RockSample(15, 15): 7372801 states, 20 controls, 3 observations, discount 0.95'
        >>> problem.start(torch.arange(1))["location"].item() == 7 * 15
        True
    """
    n, seed = check_integer("n", n, 1, 1000), check_seed("seed", seed)
    k = check_integer("k", k, 1, n * n)
    model = RockSample(n, LAYOUTS.get((n, k)) or random_rocks(n, k, seed), device=check_device("device", device))
    return Problem(
        model,
        Unexplored(model),
        name=name,
        training=(RandomRocks(model),),
        base_policies={"nearest": NearestRock(model)},
        encoder=RockEncoder,
    )


def random_rocks(size: int, count: int, seed: int) -> list[tuple[int, int]]:
    """Distinct random cells, a function of the three numbers alone.

    Examples:
        >>> random_rocks(15, 15, seed=0) == random_rocks(15, 15, seed=0) != random_rocks(15, 15, seed=1)
        True
    """
    order = seed_keys(seed, torch.arange(size * size)).argsort()[:count].tolist()
    return [(cell % size, cell // size) for cell in order]


class Unexplored:
    """The usual start: the rover in the middle of the western column; every rock may be good as well as bad."""

    def __init__(self, model: RockSample) -> None:
        self.model = model

    def __call__(self, keys: Tensor) -> TensorDictBase:
        """Feature states ``[*B]`` for int64 keys ``[*B]``."""
        shape, model = check_keys("keys", keys).shape, self.model
        belief = torch.full((model.num_rocks, *shape), 0.5, dtype=model.dtype, device=keys.device).movedim(0, -1)
        location = torch.full((*shape, 1), model.size * (model.size // 2), device=keys.device)
        return TensorDict({"belief": belief, "location": location}, batch_size=shape)


class RandomRocks:
    """Random states: a rover anywhere; rocks are known to be bad, or nothing is known of them, or they have any probability."""

    def __init__(self, model: RockSample) -> None:
        self.model = model

    def __call__(self, keys: Tensor) -> TensorDictBase:
        """Feature states ``[*B]`` for int64 keys ``[*B]``."""
        model, streams = self.model, fold(check_keys("keys", keys), 0)
        rocks = torch.arange(model.num_rocks, device=keys.device).view(-1, *[1] * keys.ndim)
        kind, good = uniform(streams, 2 * rocks + 1), uniform(streams, 2 * rocks + 2).to(model.dtype)
        belief = torch.where(kind < KNOWN_BAD + UNKNOWN, 0.5, good).masked_fill(kind < KNOWN_BAD, 0.0).movedim(0, -1)
        location = (uniform(streams, 0).double() * model.exit).to(torch.int64).unsqueeze(-1)
        return TensorDict({"belief": belief, "location": location}, batch_size=keys.shape)


class NearestRock(TensorDictModuleBase):
    r"""Go to the nearest rock that is worth the way and sample it; check it first, from nearby, while that is not sure.

    A rock is worth the way if it is good with at least the probability ``worth``, and sampled without a check with ``sure``.
    One that is not sure is checked from at most ``look`` cells away, each check a stage. The way leads along the longer side of
    what is left of it. Ties go to the rock with the lower index. Where no rock is worth the way the rover leaves to the east.

    Args:
        model: the model.
        worth: probability in [0, 1].
        sure: probability in [0, 1].
        look: number of moves, not negative.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if an argument is out of range.

    Examples:
        >>> problem = rocksample(7, 8)
        >>> u = NearestRock(problem.model)(problem.start(torch.arange(1)))["action"]
        >>> problem.model.control_names[u]
        'check rock 1'
    """

    in_keys = ["belief", "location"]
    out_keys = ["action"]
    moves: Tensor
    controls: Tensor

    def __init__(self, model: RockSample, worth: float = 0.5, sure: float = 0.8, look: float = 6.0) -> None:
        super().__init__()
        self.model = check_instance("model", model, RockSample)
        self.worth, self.sure = check_number("worth", worth, "[0, 1]"), check_number("sure", sure, "[0, 1]")
        self.look = check_number("look", look, "[0, inf)")
        across, up = offsets(model.size, model.rocks)
        moves = across.abs() + up.abs()
        step = torch.where(across.abs() >= up.abs(), torch.where(across > 0, EAST, WEST), torch.where(up > 0, NORTH, SOUTH))
        step[moves == 0] = SAMPLE
        self.register_buffer("moves", moves.to(model.dtype), persistent=False)
        self.register_buffer("controls", step.to(model.device), persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"``, int64 ``[*B]``."""
        check_entries("tensordict", tensordict, self.in_keys)
        belief = tensordict.get("belief").reshape(-1, self.model.num_rocks).T
        location = tensordict.get("location").reshape(-1)
        left = location == self.model.exit
        cell = location.masked_fill(left, 0)
        moves, rock = self.moves.index_select(1, cell).masked_fill(belief < self.worth, torch.inf).min(0)
        unsure = belief.gather(0, rock.unsqueeze(0)).squeeze(0) < self.sure
        step = self.controls.flatten()[rock * self.model.exit + cell]
        action = torch.where(unsure & (moves <= self.look), FIRST_CHECK + rock, step)
        return tensordict.set("action", action.masked_fill(left | moves.isinf(), EAST).view(tensordict.batch_size))


class RockEncoder(Encoder):
    r"""Every rock as the rover sees it, the rover's column and row, and what the base policy would do, both one-hot.

    A rock has nine features. Two are about what is known: p, the probability that it is good, and 4p(1-p), what a check can
    still tell. The next two are these times :math:`\alpha^d` for the d moves to it. The others depend on the place alone:
    :math:`\alpha^d`; :math:`2^{-e/20}` for the Euclidean distance e; the offset in cells to the east and to the north, over n;
    and whether the rover is there. All are zero for a rover that has left.

    The control of :class:`NearestRock` lets a network learn where to do something else, instead of all that it does. Without
    it a network that is wrong about a single state may check a rock that it knows for ever.

    Args:
        model: the model.

    Examples:
        >>> problem = rocksample(7, 8)
        >>> RockEncoder(problem.model)(problem.start(torch.arange(4))).shape
        torch.Size([4, 99])
    """

    keys = ("belief", "location")
    places: Tensor

    def __init__(self, model: RockSample) -> None:
        super().__init__()
        self.base_policy = NearestRock(model)
        self.num_rocks, self.num_controls, self.exit, self.dtype = model.num_rocks, model.num_controls, model.exit, model.dtype
        self.num_features = 9 * self.num_rocks + 2 * model.size + self.num_controls
        across, up = (offset.double() for offset in offsets(model.size, model.rocks))
        moves = across.abs() + up.abs()
        told = 2.0 ** (-(across.square() + up.square()).sqrt() / HALVING_DISTANCE)
        size, cells = torch.arange(model.size).unsqueeze(-1), torch.arange(model.exit)
        rocks = torch.cat([model.discount**moves, told, across / model.size, up / model.size, (moves == 0).double()])
        table = torch.cat([rocks, size == cells % model.size, size == cells // model.size])
        # [5k + 2n, n² + 1]: all that depends on the cell alone.
        self.register_buffer("places", nn.functional.pad(table, (0, 1)).to(model.device, model.dtype), persistent=False)

    def encode_rows(self, y: TensorDictBase, rows: Tensor | None) -> Tensor:
        """See :class:`Encoder`."""
        y = y.select(*self.keys) if rows is None else take_rows(y.select(*self.keys), rows)
        location = y.get("location").squeeze(-1)
        good = y.get("belief").T * (location < self.exit)
        known, places = torch.cat([good, 4.0 * good * (1.0 - good)]), self.places.index_select(1, location)
        near = known * places[: self.num_rocks].repeat(2, 1)
        control = self.base_policy(y).get("action") == torch.arange(self.num_controls, device=device_of(y)).unsqueeze(-1)
        return torch.cat([known, near, places, control.to(self.dtype)]).T.contiguous()
