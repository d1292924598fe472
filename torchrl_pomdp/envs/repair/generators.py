"""Distributions of feature states of repair problems (paper, Section VI-C)."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_flag, check_instance, check_integer, check_number, shown
from torchrl_pomdp.envs.repair.chains import chain_powers
from torchrl_pomdp.envs.repair.model import RepairModel
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.noise import fold, uniform
from torchrl_pomdp.tensor_checks import check_keys

__all__ = ["CalibratedStart", "RandomState", "UniformStart"]

# What a key's independent streams of uniforms are for; generators that draw from others use more.
_ORDER, _LEVELS, _ROBOTS, _OBSERVE, _FRACTION, _AGE = range(6)
_MOST_AGE = 10_000


class UniformStart:
    """Every level equally likely at every location, robots at given locations: the prior of the small exact problems.

    Args:
        model: the repair model.
        robots: location of each robot.
        observe_start: whether the robots observe their locations before the first control.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``robots`` does not give one location for each robot.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> make_problem("line3").start(torch.arange(4))["belief"].shape
        torch.Size([4, 3, 5])
    """

    def __init__(self, model: RepairModel, robots: tuple[int, ...] = (0,), *, observe_start: bool = True) -> None:
        check_instance("model", model, RepairModel)
        check_instance("robots", robots, (tuple, list))
        if len(robots) != model.num_robots:
            raise ValueError(f"robots must be {model.num_robots} locations, one for each robot, got {tuple(robots)}")
        robots = tuple(check_integer(f"robots[{i}]", place, 0, model.num_locations - 1) for i, place in enumerate(robots))
        check_flag("observe_start", observe_start)
        self.model, self.robots, self.observe_start = model, robots, observe_start

    def __call__(self, keys: Tensor) -> TensorDictBase:
        """Feature states ``[*B]`` (core entries) for int64 keys ``[*B]``."""
        model, keys = self.model, check_keys("keys", keys)
        shape = (*keys.shape, model.num_locations, model.num_levels)
        belief = torch.full(shape, 1.0 / model.num_levels, dtype=model.dtype, device=keys.device)
        location = torch.tensor(self.robots, device=keys.device).expand(*keys.shape, -1).clone()
        return _place(model, keys, belief, location, self.observe_start)


class CalibratedStart:
    """The calibrated start states: a fraction of the locations, at least one of them, possibly damaged, robots anywhere.

    The belief of a possibly damaged location is Dirichlet(1, …, 1) over the levels, the others are surely at level 0.

    Args:
        model: the repair model.
        damaged_fraction: fraction of the locations that are possibly damaged, in (0, 1]; their number is rounded.
        observe_start: whether the robots observe their locations before the first control.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``damaged_fraction`` is not in (0, 1].

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> y = CalibratedStart(problem.model, observe_start=False)(torch.arange(100))
        >>> (y["belief"][..., 0] < 1).sum(-1).unique().tolist()
        [14]
    """

    def __init__(self, model: RepairModel, damaged_fraction: float = 0.7, *, observe_start: bool = True) -> None:
        check_instance("model", model, RepairModel)
        check_number("damaged_fraction", damaged_fraction, "(0, 1]")
        self.model, self.observe_start = model, check_flag("observe_start", observe_start)
        self.num_damaged = max(1, round(damaged_fraction * model.num_locations))

    def __call__(self, keys: Tensor) -> TensorDictBase:
        """Feature states ``[*B]`` (core entries) for int64 keys ``[*B]``."""
        belief = _random_beliefs(self.model, check_keys("keys", keys), torch.full_like(keys, self.num_damaged))
        return _place(self.model, keys, belief, _anywhere(self.model, keys), self.observe_start)


class RandomState:
    """Random feature states of a phase, for training (paper, Section VI-C, "random generation of feature states").

    The number of possibly damaged locations, at least one, is uniform between two fractions, each belief is
    Dirichlet(1, …, 1) and has then degraded for a random number of stages; the robots are anywhere and have observed their
    locations.

    Args:
        model: the repair model.
        fractions: lowest and highest fraction of possibly damaged locations, 0 <= low <= high <= 1.
        max_age: largest number of stages the beliefs have degraded, at most 10000.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if the fractions are not ordered in [0, 1] or ``max_age`` is out of bounds.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> model = make_problem("linear20").model
        >>> y = RandomState(model, fractions=(0.0, 0.45))(torch.arange(100))
        >>> int(model.partition(y).min())
        3
    """

    def __init__(self, model: RepairModel, fractions: tuple[float, float] = (0.0, 1.0), max_age: int = 40) -> None:
        check_instance("model", model, RepairModel)
        check_instance("fractions", fractions, (tuple, list))
        if len(fractions) != 2:
            raise ValueError(f"fractions must be the lowest and the highest fraction, got {shown(fractions)}")
        low, high = (check_number(f"fractions[{i}]", share, "[0, 1]") for i, share in enumerate(fractions))
        if low > high:
            raise ValueError(f"fractions must satisfy 0 <= low <= high <= 1, got {fractions}")
        self.model, self.max_age = model, check_integer("max_age", max_age, 0, _MOST_AGE)
        self.range = max(1, round(low * model.num_locations)), max(1, round(high * model.num_locations))
        # [ages, L or 1, K, K].
        powers = chain_powers(model.chain, max_age)
        self._powers = powers if model.chain.ndim == 3 else powers.unsqueeze(1)

    def __call__(self, keys: Tensor) -> TensorDictBase:
        """Feature states ``[*B]`` (core entries) for int64 keys ``[*B]``."""
        (low, high), keys = self.range, check_keys("keys", keys)
        count = low + (_uniforms(keys, _FRACTION, 1).squeeze(-1) * (high - low + 1)).to(torch.int64)
        age = (_uniforms(keys, _AGE, 1).squeeze(-1) * (self.max_age + 1)).to(torch.int64)
        fresh, powers = _random_beliefs(self.model, keys, count), self._powers[age]
        # Level by level, as a library's product of matrices would round by the number of states.
        belief = fresh[..., :1] * powers[..., 0, :]
        for level in range(1, self.model.num_levels):
            belief += fresh[..., level, None] * powers[..., level, :]
        return _place(self.model, keys, belief, _anywhere(self.model, keys), observe=True)


def _uniforms(keys: Tensor, purpose: int, count: int) -> Tensor:
    """``count`` uniforms ``[*B, count]`` of each key's stream for one purpose."""
    return uniform(fold(keys, purpose).unsqueeze(-1), torch.arange(count, device=keys.device))


def _anywhere(model: RepairModel, keys: Tensor) -> Tensor:
    """Uniform locations of the robots, ``[*B, R]``."""
    return (_uniforms(keys, _ROBOTS, model.num_robots) * model.num_locations).to(torch.int64)


def _random_beliefs(model: RepairModel, keys: Tensor, num_damaged: Tensor) -> Tensor:
    """Beliefs ``[*B, L, K]``: ``num_damaged`` ``[*B]`` random locations are Dirichlet(1, …, 1), the others at level 0."""
    size, levels = model.num_locations, model.num_levels
    place = _uniforms(keys, _ORDER, size).argsort(-1).argsort(-1)
    damaged = (place < num_damaged.unsqueeze(-1)).unsqueeze(-1)
    # Normalised exponentials are Dirichlet(1, …, 1); log1p(-u) is finite for u in [0, 1).
    weight = -torch.log1p(-_uniforms(keys, _LEVELS, size * levels).double()).view(*keys.shape, size, levels)
    weight = weight.clamp_min(2.0**-30)
    intact = torch.eye(levels, dtype=weight.dtype, device=keys.device)[0]
    total = sum_first(weight.movedim(-1, 0).clone()).unsqueeze(-1)
    return torch.where(damaged, weight / total, intact).to(model.dtype)


def _place(model: RepairModel, keys: Tensor, belief: Tensor, location: Tensor, observe: bool) -> TensorDictBase:
    """Feature states of beliefs and locations, the robots having observed if ``observe``."""
    y = TensorDict({"belief": belief, "location": location}, batch_size=keys.shape, device=model.device)
    return model.observe(y, _uniforms(keys, _OBSERVE, model.num_robots)) if observe else y
