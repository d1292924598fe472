"""Where training states come from (paper, Section VI-C): random states of each part, and states that policies visit."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.envs.belief import BeliefModel, StateGenerator, inverse_cdf, take_rows
from torchrl_pomdp.envs.generators import InPart
from torchrl_pomdp.envs.presets import Problem
from torchrl_pomdp.modules.rollout import Policy, step_noise
from torchrl_pomdp.noise import fold, seed_keys, uniform

__all__ = ["Mixture", "PartSampler", "StateSampler", "VisitedStates", "training_states"]

StateSampler = Callable[[Tensor], TensorDictBase]
"""Numbered training states: maps int64 numbers ``[N]`` to feature states ``[N]``, the same number to the same state."""

# What a key's independent streams are for.
_START, _STEPS, _EXPLORE, _CONTROL, _PICK, _CHOICE = range(16, 22)


class PartSampler:
    """Numbered training states that fill several parts evenly: state i belongs to the part ``parts[i % len(parts)]``.

    Args:
        generators: generator of each part's states.
        seed: seed of the states.

    Raises:
        ValueError: if there is no generator.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> problem = make_problem("linear20")
        >>> sampler = PartSampler({part: problem.training[part] for part in (3, 4, 5)}, seed=0)
        >>> problem.model.partition(sampler(torch.arange(6))).tolist()
        [3, 4, 5, 3, 4, 5]
    """

    def __init__(self, generators: Mapping[int, StateGenerator], seed: int) -> None:
        if not generators:
            raise ValueError("generators is empty: give a generator for at least one part")
        self.generators, self.seed = dict(generators), seed

    def __call__(self, index: Tensor) -> TensorDictBase:
        """Feature states ``[N]`` with the numbers ``index``, int64 ``[N]``."""
        keys = seed_keys(self.seed, index)
        which = index % len(self.generators)
        return _draw_each(list(self.generators.values()), which, keys)


class Mixture:
    """Generator that draws each state from one of several generators.

    Args:
        generators: the generators that are mixed.
        weights: their probabilities, nonnegative with positive sum.

    Raises:
        ValueError: if there is not one nonnegative weight for each generator.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> problem = make_problem("linear20")
        >>> Mixture([problem.start, problem.training[4]], [0.5, 0.5])(torch.arange(8)).batch_size
        torch.Size([8])
    """

    def __init__(self, generators: Sequence[StateGenerator], weights: Sequence[float]) -> None:
        if len(generators) != len(weights) or not generators or min(weights) < 0 or sum(weights) <= 0:
            raise ValueError(f"weights must be {len(generators)} nonnegative numbers with positive sum, got {list(weights)}")
        self.generators, self.weights = list(generators), torch.tensor(weights, dtype=torch.float32)

    def __call__(self, keys: Tensor) -> TensorDictBase:
        """Feature states ``[*B]`` for int64 keys ``[*B]``."""
        flat = keys.reshape(-1)
        probs = self.weights.to(keys.device).expand(flat.numel(), -1)
        which = inverse_cdf(probs, uniform(fold(flat, _CHOICE), 0))
        return _draw_each(self.generators, which, flat).view(keys.shape)


class VisitedStates:
    """Generator of states that a policy visits: from a random start, one state of the trajectory, all equally likely.

    Random legal controls are mixed in, so that the states around the policy's own are seen too. With ``part`` the state
    is picked among those of that part; a trajectory that has none gives its start state, so restrict the result with
    :class:`~torchrl_pomdp.envs.InPart`.

    Args:
        model: the belief model.
        start: generator of start states.
        policy: the policy that is followed.

    Keyword Args:
        part: part of the model's partition to pick from, or None for any.
        exploration: probability of a random legal control at each step, in [0, 1].
        max_steps: length at which trajectories are cut.

    Raises:
        ValueError: if ``exploration`` is not in [0, 1] or ``max_steps`` is not positive.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> from torchrl_pomdp.modules import GreedyRepair
        >>> problem = make_problem("linear20")
        >>> visited = VisitedStates(problem.model, problem.start, GreedyRepair(problem.model))
        >>> visited(torch.arange(8)).batch_size
        torch.Size([8])
    """

    def __init__(
        self,
        model: BeliefModel,
        start: StateGenerator,
        policy: Policy,
        *,
        part: int | None = None,
        exploration: float = 0.15,
        max_steps: int = 100,
    ) -> None:
        if not 0.0 <= exploration <= 1.0:
            raise ValueError(f"exploration must be in [0, 1], got {exploration}")
        if max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {max_steps}")
        self.model, self.start, self.policy = model, start, policy
        self.part, self.exploration, self.max_steps = part, exploration, max_steps

    @torch.no_grad()
    def __call__(self, keys: Tensor) -> TensorDictBase:
        """Feature states ``[*B]`` (core entries) for int64 keys ``[*B]``."""
        model, flat = self.model, keys.reshape(-1)
        y = model.with_features(self.start(fold(flat, _START)))
        live = torch.arange(flat.numel(), device=flat.device)
        picked = y.select(*model.state_keys).clone()
        seen = torch.zeros_like(flat)
        for step in range(self.max_steps):
            rest = (~model.is_terminal(y)).nonzero().squeeze(-1)
            if rest.numel() == 0:
                break
            if rest.numel() < live.numel():
                y, live = take_rows(y, rest), live[rest]
            self._pick(picked, seen, y, live, flat, step)
            u = self._control(y, flat[live], step)
            _, y = model.advance(y, u, step_noise(fold(flat[live], _STEPS), step, model.noise_dim))
        return picked.view(keys.shape)

    def _pick(self, picked: TensorDictBase, seen: Tensor, y: TensorDictBase, live: Tensor, keys: Tensor, step: int) -> None:
        """Reservoir sampling: the n-th eligible state of a trajectory replaces the picked one with probability 1/n."""
        eligible = torch.ones_like(live, dtype=torch.bool) if self.part is None else y.get("partition") == self.part
        seen[live[eligible]] += 1
        replace = eligible & (uniform(fold(keys[live], _PICK), step) * seen[live] < 1.0)
        picked[live[replace]] = y.select(*self.model.state_keys)[replace]

    def _control(self, y: TensorDictBase, keys: Tensor, step: int) -> Tensor:
        """The policy's control, or a random legal one with probability ``exploration``."""
        mask = y.get("action_mask").to(torch.float32)
        u = self.policy(y.copy()).get("action")
        random = inverse_cdf(mask, uniform(fold(keys, _CONTROL), step))
        return torch.where(uniform(fold(keys, _EXPLORE), step) < self.exploration, random, u)


def training_states(
    problem: Problem, policy: Policy, part: int, *, visited_share: float = 0.5, exploration: float = 0.15
) -> StateGenerator:
    """Random states of a part, mixed with states of the part that a policy visits from the problem's start states.

    Args:
        problem: the problem; its training generators give the random states.
        policy: the policy that is followed.
        part: the part.

    Keyword Args:
        visited_share: share of visited states, in [0, 1]. A trajectory that never enters the part is replaced by another;
            where a hundred do not, a random state takes the place.
        exploration: probability of a random legal control at each step of the visits, in [0, 1].

    Raises:
        ValueError: if a probability is out of range or there is no such part.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> from torchrl_pomdp.modules import GreedyRepair
        >>> problem = make_problem("linear20")
        >>> y = training_states(problem, GreedyRepair(problem.model), part=4)(torch.arange(8))
        >>> problem.model.partition(y).unique().tolist()
        [4]
    """
    random = problem.training[part]
    visited = VisitedStates(problem.model, problem.start, policy, part=part, exploration=exploration)
    in_part = InPart(problem.model, visited, part, max_tries=100, fallback=random)
    return Mixture([random, in_part], [1.0 - visited_share, visited_share])


def _draw_each(generators: Sequence[StateGenerator], which: Tensor, keys: Tensor) -> TensorDictBase:
    """States ``[N]`` for keys ``[N]``, the i-th from the generator number ``which[i]``."""
    drawn = [generator(keys[which == i]) for i, generator in enumerate(generators) if bool((which == i).any())]
    return torch.cat(drawn, 0)[which.argsort(stable=True).argsort()]
