"""Comparing policies: discounted costs from the same start states under the same noise (paper, Section VI-C)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from tqdm import tqdm

from torchrl_pomdp.checks import check_callable, check_flag, check_instance, check_integer, check_text
from torchrl_pomdp.config import MAX_STATES
from torchrl_pomdp.envs.belief_model import BeliefModel, StateGenerator
from torchrl_pomdp.modules.policies import Policy, TerminalCost, check_policy
from torchrl_pomdp.modules.rollout import TruncatedRollout
from torchrl_pomdp.modules.scalar import Limited, SearchEngine, scalar_engine
from torchrl_pomdp.noise import fold, seed_keys
from torchrl_pomdp.progress import progress_bar
from torchrl_pomdp.tensor_checks import check_tensor
from torchrl_pomdp.workers import LOCAL, Workers

__all__ = ["Comparison", "Estimate", "compare", "discounted_costs", "estimate"]

# Start states that other processes get at once; a single process gets them all.
_BLOCK = 512
# Half width of a 95 % interval in standard errors.
_Z95 = 1.96


@dataclass(frozen=True)
class Estimate:
    """A mean with its standard error; printed, with its 95 % interval.

    Attributes:
        mean: sample mean.
        standard_error: of the mean.
        count: sample size.

    Examples:
        >>> print(Estimate(mean=0.94415, standard_error=0.0112, count=50))
        0.9442 (0.9222 … 0.9661)
    """

    mean: float
    standard_error: float
    count: int

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval (normal approximation)."""
        half = _Z95 * self.standard_error
        return self.mean - half, self.mean + half

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.mean:.4g} ({low:.4g} … {high:.4g})"


@dataclass(frozen=True)
class Comparison:
    """A policy against a baseline, paired by start state and noise.

    Attributes:
        cost: discounted cost of the policy.
        difference: policy minus baseline.
        ratio: mean cost over the baseline's mean cost, its standard error by the delta method. None where it means nothing:
            the mean cost is negative, or the baseline's is not positive, or, with costs of both signs, not clearly so.
    """

    cost: Estimate
    difference: Estimate
    ratio: Estimate | None


def discounted_costs(
    model: BeliefModel,
    policy: Policy,
    start: StateGenerator,
    *,
    num_states: int = 1000,
    first: int = 0,
    seed: int = 0,
    max_steps: int | None = None,
    terminal_cost: TerminalCost | None = None,
    progress: bool = False,
    name: str = "evaluate",
    workers: Workers = LOCAL,
) -> Tensor:
    """Discounted cost of one trajectory of ``policy`` from each of ``num_states`` start states.

    Start state i and the noise of its trajectory depend on (seed, i) alone: costs of different policies are paired.

    Args:
        model: the belief model.
        policy: the policy.
        start: generator of start states.

    Keyword Args:
        num_states: number of start states.
        first: number i of the first one.
        seed: seed of the start states and of the noise.
        max_steps: stages after which a trajectory is cut; None: as the discount asks for, see :attr:`BeliefModel.horizon`.
        terminal_cost: what a cut adds, see :class:`TruncatedRollout`.
        progress: whether to show a progress bar, which counts decisions.
        name: label of the progress bar.
        workers: who computes; the bar counts start states where that is not this process.

    Returns:
        costs ``[num_states]``.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``num_states`` is not positive, or by :class:`TruncatedRollout`.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> problem = make_problem("linear20")
        >>> costs = discounted_costs(problem.model, GreedyRepair(problem.model), problem.start, num_states=50)
        >>> estimate(costs).count
        50
    """
    check_instance("model", model, BeliefModel)
    check_policy("policy", policy, model)
    check_callable("start", start)
    num_states = check_integer("num_states", num_states, 1, MAX_STATES)
    seed = check_integer("seed", seed)
    first = check_integer("first", first, 0, MAX_STATES)
    check_instance("workers", workers, Workers).check_device(model.device)
    name, progress = check_text("name", name), check_flag("progress", progress)
    numbers, options = range(first, first + num_states), (start, seed, max_steps, terminal_cost)
    if workers is not LOCAL:
        return _costs_elsewhere(workers, (model, policy, *options), numbers, name, progress)
    with progress_bar(None, "step", name, progress) as bar:
        costs, unseen = costs_of_states((model, _Watched(policy, bar), *options), numbers)
        bar.update(unseen)
    return costs


def _costs_elsewhere(workers: Workers, shared: tuple[Any, ...], numbers: range, name: str, progress: bool) -> Tensor:
    """Costs from the start states with the given numbers, block by block; the bar counts start states."""
    size = max(1, _BLOCK // workers.pieces)
    blocks = [numbers[i : i + size] for i in range(0, len(numbers), size)]
    tasks = workers.tasks(costs_of_states, shared, blocks, lambda own: f"{name}, start states {own[0]} … {own[-1]}")
    costs: list[Tensor] = []
    with progress_bar(len(numbers), "state", name, progress) as bar:
        for own, (handle, _) in zip(blocks, tasks, strict=True):
            costs.append(workers.fetch(handle))
            bar.update(len(own))
    return torch.cat(costs)


def costs_of_states(shared: tuple[Any, ...], numbers: range) -> tuple[Tensor, int]:
    """Costs of the trajectories from the start states with the given numbers, and the steps of compiled simulations.

    Args:
        shared: model, policy, start states, seed, number of stages, and terminal cost.
        numbers: numbers of the start states.
    """
    model, policy, start, seed, max_steps, terminal_cost = shared
    keys = seed_keys(seed, torch.arange(numbers.start, numbers.stop, device=model.device))
    cost = TruncatedRollout(model, policy, max_steps=max_steps, terminal_cost=terminal_cost)
    costs = cost(model.drawn(start, fold(keys, 0), "start"), fold(keys, 1))
    return costs, 0 if cost.scalar is None else cost.simulated_steps


class _Watched:
    """A policy whose decisions a progress bar counts."""

    def __init__(self, policy: Policy, bar: tqdm) -> None:
        self.policy, self.bar = policy, bar
        self.in_keys = getattr(policy, "in_keys", ())

    def scalar_engine(self, model: BeliefModel, limits: Limited) -> SearchEngine | None:
        return scalar_engine(self.policy, model, limits)

    def __call__(self, y: TensorDictBase) -> TensorDictBase:
        self.bar.update(y.batch_size.numel())
        return self.policy(y)


def estimate(values: Tensor) -> Estimate:
    """Mean and standard error of independent values ``[N]``; the error is NaN for a single value.

    Raises:
        TypeError: if they are no tensor of real numbers.
        ValueError: if there are none, or one is not finite.

    Examples:
        >>> estimate(torch.tensor([1.0, 3.0]))
        Estimate(mean=2.0, standard_error=1.0, count=2)
    """
    values = _sample("values", values)
    error = values.std() / values.numel() ** 0.5 if values.numel() > 1 else torch.tensor(torch.nan)
    return Estimate(float(values.mean()), float(error), values.numel())


def compare(costs: Tensor, baseline: Tensor) -> Comparison:
    """Compare paired costs ``[N]`` with a baseline's ``[N]``.

    The difference always means something. A ratio does so where both means are costs, not rewards; see :class:`Comparison`.

    Raises:
        TypeError: if they are no tensors of real numbers.
        ValueError: if there are none, one is not finite, or the shapes differ.

    Examples:
        >>> compare(torch.tensor([9.0, 18.0]), torch.tensor([10.0, 20.0])).ratio
        Estimate(mean=0.9, standard_error=0.0, count=2)
        >>> rewards = compare(torch.tensor([-9.0, -8.0]), torch.tensor([-3.0, -2.0]))
        >>> rewards.difference.mean, rewards.ratio
        (-6.0, None)
    """
    costs, baseline = _sample("costs", costs), _sample("baseline", baseline)
    if costs.shape != baseline.shape:
        raise ValueError(f"costs and baseline must be paired, got shapes {tuple(costs.shape)} and {tuple(baseline.shape)}")
    return Comparison(
        cost=estimate(costs),
        difference=estimate(costs - baseline),
        ratio=_ratio(costs, baseline) if _is_positive(baseline) and costs.mean() >= 0.0 else None,
    )


def _sample(name: str, values: Tensor) -> Tensor:
    values = check_tensor(name, check_instance(name, values, Tensor), (None,)).double()
    if values.numel() == 0:
        raise ValueError(f"{name} must hold at least one value, got none")
    return values


def _is_positive(baseline: Tensor) -> bool:
    """Whether the mean can be divided by: it is positive, and clearly so where single costs are negative."""
    mean = estimate(baseline)
    return mean.mean > 0.0 and (bool((baseline >= 0.0).all()) or mean.interval[0] > 0.0)


def _ratio(costs: Tensor, baseline: Tensor) -> Estimate:
    mean = baseline.mean()
    ratio = float(costs.mean() / mean)
    residual = estimate((costs - ratio * baseline) / mean)
    return Estimate(ratio, residual.standard_error, costs.numel())
