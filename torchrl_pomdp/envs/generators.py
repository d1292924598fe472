"""Distributions of feature states, as pure functions of 64-bit keys.

A generator maps int64 keys ``[*B]`` to feature states ``[*B]``; the same key gives the same state in any batch. They make
the starts of environments and evaluations and the training states of each part (paper, Section VI-C).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_callable, check_instance, check_integer, shown
from torchrl_pomdp.envs.belief_model import BeliefModel, StateGenerator, generated
from torchrl_pomdp.envs.rows import inverse_cdf, put_rows, random_control, take_rows
from torchrl_pomdp.noise import fold, uniform
from torchrl_pomdp.tensor_checks import check_distributions, check_keys, check_tensor

__all__ = ["FixedBelief", "InPart", "Mixture", "RandomPlay", "draw_each"]

# What a key's independent streams of uniforms are for, beside those of the generators that are drawn from.
_RETRY, _CHOICE, _LENGTH, _PLAY, _INNER = range(6, 11)
# Probability that random play keeps a control for another stage.
_KEPT = 0.75
# Candidates that a rejection round makes at once.
_BATCH = 4096


class InPart:
    """A generator restricted to one part of the model's partition, by rejection.

    Args:
        model: a model with a partition.
        proposal: generator of candidate states.
        part: the part that states must lie in.
        max_tries: candidates for one state before giving up.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``part`` is not a part of the model's partition; when called, if a state has no acceptable
            candidate among ``max_tries``.

    Examples:
        >>> from torchrl_pomdp.envs.repair import RandomState
        >>> from torchrl_pomdp.problems import make_problem
        >>> model = make_problem("linear20").model
        >>> y = InPart(model, RandomState(model), part=2)(torch.arange(50))
        >>> model.partition(y).unique().tolist()
        [2]
    """

    def __init__(self, model: BeliefModel, proposal: StateGenerator, part: int, max_tries: int = 500) -> None:
        check_instance("model", model, BeliefModel)
        self.proposal = check_callable("proposal", proposal)
        parts = 0 if model.partition is None else model.partition.num_parts
        if model.partition is None or not 0 <= check_integer("part", part) < parts:
            raise ValueError(f"part must be one of the model's {parts} parts, got {part}")
        self.model, self.part, self.max_tries = model, part, check_integer("max_tries", max_tries, 1, 1_000_000)
        self.partition = model.partition

    def __call__(self, keys: Tensor) -> TensorDictBase:
        """Feature states ``[*B]`` of the part for int64 keys ``[*B]``; terminal states are rejected too."""
        flat = check_keys("keys", keys).reshape(-1)
        result = self.model.drawn(self.proposal, flat, "proposal")
        missing = (~self._accepted(result)).nonzero().squeeze(-1)
        if missing.numel():
            # The proposal may keep what it gives.
            result = result.clone()
        tried = 1
        while missing.numel() and tried < self.max_tries:
            # Several candidates at once where few states are missing; the first acceptable one counts in any case.
            width = min(max(1, _BATCH // missing.numel()), self.max_tries - tried)
            attempts = torch.arange(tried, tried + width, device=keys.device)
            tried += width
            candidates = self.model.drawn(self.proposal, fold(fold(flat[missing], _RETRY).unsqueeze(-1), attempts).flatten())
            accepted = self._accepted(candidates).view(-1, width)
            found, first = accepted.any(-1), accepted.to(torch.int64).argmax(-1)
            chosen = torch.arange(missing.numel(), device=keys.device) * width + first
            result[missing[found]] = candidates[chosen[found]]
            missing = missing[~found]
        if missing.numel() == 0:
            return result.view(keys.shape)
        raise ValueError(
            f"no state of part {self.part} ({self.partition.names[self.part]}) among {self.max_tries} candidates "
            f"of {type(self.proposal).__name__}: choose a proposal that reaches it, for a Problem its training states"
        )

    def _accepted(self, y: TensorDictBase) -> Tensor:
        return (self.partition(y) == self.part) & ~self.model.is_terminal(y)


class Mixture:
    """Generator that draws each state from one of several generators.

    Args:
        generators: the generators that are mixed, mixtures among them, too.
        weights: their probabilities, nonnegative with positive sum.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if there is no generator, or not one nonnegative weight for each of them.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> Mixture([problem.start, problem.training[4]], [0.5, 0.5])(torch.arange(8)).batch_size
        torch.Size([8])
    """

    def __init__(self, generators: Sequence[StateGenerator], weights: Sequence[float]) -> None:
        check_instance("generators", generators, (list, tuple))
        if not generators:
            raise ValueError("generators is empty: a mixture needs at least one")
        for i, generator in enumerate(generators):
            check_callable(f"generators[{i}]", generator)
        shares = check_tensor("weights", weights, (len(generators),)).to(torch.float32)
        if not bool((shares >= 0).all()) or not 0 < float(shares.sum()) < torch.inf:
            raise ValueError(f"weights must be {len(generators)} nonnegative numbers with positive sum, got {shown(weights)}")
        self.generators, self.weights = list(generators), shares

    def __call__(self, keys: Tensor) -> TensorDictBase:
        """Feature states ``[*B]`` for int64 keys ``[*B]``."""
        flat = check_keys("keys", keys).reshape(-1)
        probs = self.weights.to(keys.device).expand(flat.numel(), -1)
        which = inverse_cdf(probs, uniform(fold(flat, _CHOICE), 0))
        # By other keys: what is drawn may be a mixture again, and its choice is another one.
        return draw_each(self.generators, which, fold(flat, _INNER)).view(keys.shape)


class RandomPlay:
    """Feature states that random play reaches from the start: what there is to train on where nothing better is known.

    Each state is that after a random number of stages. A control is kept for some stages, four on average, so that play goes
    further than by independent ones. Play ends in terminal states.

    Args:
        model: the belief model.
        start: generator of start states.
        max_stages: largest number of stages.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``max_stages`` is out of bounds; when called, if the start is no state of the model.

    Examples:
        >>> from torchrl_pomdp.problems import tiger
        >>> problem = tiger()
        >>> y = RandomPlay(problem.model, problem.start)(torch.arange(100))
        >>> len(y["belief"][:, 0].unique()) > 5
        True
    """

    def __init__(self, model: BeliefModel, start: StateGenerator, max_stages: int = 50) -> None:
        self.model, self.start = check_instance("model", model, BeliefModel), check_callable("start", start)
        self.max_stages = check_integer("max_stages", max_stages, 0, 10_000)

    def __call__(self, keys: Tensor) -> TensorDictBase:
        """Feature states ``[*B]`` (core entries) for int64 keys ``[*B]``."""
        model, flat = self.model, check_keys("keys", keys).reshape(-1)
        y = model.drawn(self.start, fold(flat, _INNER), "start").select(*model.state_keys)
        length = (uniform(fold(flat, _LENGTH), 0) * (self.max_stages + 1)).to(torch.int64)
        u = torch.full((*flat.shape, *model.control_shape), -1, device=flat.device)
        numbers = torch.arange(model.noise_dim + 1 + math.prod(model.control_shape), device=flat.device)
        for stage in range(self.max_stages):
            live = ((length > stage) & ~model.is_terminal(y)).nonzero().squeeze(-1)
            if not live.numel():
                break
            now = take_rows(y, live)
            noise = uniform(fold(fold(flat[live], _PLAY), stage).unsqueeze(-1), numbers)
            seen, keep, draw = noise.split([model.noise_dim, 1, len(numbers) - model.noise_dim - 1], -1)
            u[live] = self._controls(model.action_mask(now), u[live], keep.squeeze(-1), draw)
            y = put_rows(y, live, model.advance(now, u[live], seen)[1])
        return y.view(keys.shape)

    def _controls(self, mask: Tensor, last: Tensor, keep: Tensor, draw: Tensor) -> Tensor:
        """The last controls ``[N, *S]`` where they are legal and kept, else others of the ``mask`` ``[N, *S, n]``."""
        legal = mask.gather(-1, last.clamp_min(0).unsqueeze(-1)).squeeze(-1)
        kept = (last >= 0) & legal & (keep < _KEPT).view(-1, *[1] * (last.ndim - 1))
        return torch.where(kept, last, random_control(mask, draw.view(last.shape)))


class FixedBelief:
    """A single start belief of a tabular model.

    Args:
        belief: probabilities of the states, ``[n]``.

    Raises:
        TypeError: if ``belief`` is no floating tensor.
        ValueError: if it is no distribution.

    Examples:
        >>> FixedBelief(torch.tensor([0.5, 0.5]))(torch.arange(3))["belief"].shape
        torch.Size([3, 2])
    """

    def __init__(self, belief: Tensor) -> None:
        check_instance("belief", belief, Tensor)
        if not belief.is_floating_point():
            raise TypeError(f"belief must be a floating tensor, got {belief.dtype}")
        if belief.ndim != 1 or not belief.numel():
            raise ValueError(f"belief must have shape (n), at least one state, got {tuple(belief.shape)}")
        self.belief = check_distributions("belief", check_tensor("belief", belief)).clone()

    def __call__(self, keys: Tensor) -> TensorDictBase:
        """Feature states ``[*B]`` for int64 keys ``[*B]``."""
        keys = check_keys("keys", keys)
        return TensorDict({"belief": self.belief.expand(*keys.shape, -1).clone()}, batch_size=keys.shape)


def draw_each(generators: Sequence[StateGenerator], which: Tensor, keys: Tensor) -> TensorDictBase:
    """States ``[N]`` for keys ``[N]``, the i-th from the generator number ``which[i]``."""
    used = [i for i in range(len(generators)) if bool((which == i).any())] or [0]
    drawn = [generated(generators[i], keys[which == i]) for i in used]
    return torch.cat(drawn, 0)[which.argsort(stable=True).argsort()]
