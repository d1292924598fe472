"""Where training states come from (paper, Section VI-C): random states of each part, and states that policies visit."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_callable, check_instance, check_integer, check_number, shown
from torchrl_pomdp.collectors.memory import StateMemory
from torchrl_pomdp.envs.belief_model import StateGenerator
from torchrl_pomdp.envs.generators import Mixture, draw_each
from torchrl_pomdp.noise import seed_keys
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.tensor_checks import check_keys

__all__ = ["PartSampler", "StateSampler", "training_states"]

StateSampler = Callable[[Tensor], TensorDictBase]
"""Numbered training states: maps int64 numbers ``[N]`` to feature states ``[N]``, the same number to the same state."""


class PartSampler:
    """Numbered training states that fill several parts evenly: state i belongs to the part ``parts[i % len(parts)]``.

    Args:
        generators: generator of each part's states.
        seed: seed of the states.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if there is no generator.

    Examples:
        >>> import torch
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> sampler = PartSampler({part: problem.training[part] for part in (3, 4, 5)}, seed=0)
        >>> problem.model.partition(sampler(torch.arange(6))).tolist()
        [3, 4, 5, 3, 4, 5]
    """

    def __init__(self, generators: Mapping[int, StateGenerator], seed: int) -> None:
        if not isinstance(generators, Mapping):
            raise TypeError(f"generators must map parts to generators, got {shown(generators)}")
        if not generators:
            raise ValueError("generators is empty: give a generator for at least one part")
        for part, generator in generators.items():
            check_callable(f"generators[{check_integer('generators', part, 0)}]", generator)
        self.generators, self.seed = dict(generators), check_integer("seed", seed)

    def __call__(self, index: Tensor) -> TensorDictBase:
        """Feature states ``[N]`` with the numbers ``index``, int64 ``[N]``."""
        if check_keys("index", index).ndim != 1:
            raise ValueError(f"index must have shape [N], got {tuple(index.shape)}")
        keys = seed_keys(self.seed, index)
        which = index % len(self.generators)
        return draw_each(list(self.generators.values()), which, keys)


def training_states(problem: Problem, memory: StateMemory | None, part: int, *, visited_share: float = 0.5) -> StateGenerator:
    """Random states of a part, mixed with states of the part that policies have visited.

    Args:
        problem: the problem; its training generators give the random states.
        memory: the visited states; None for random states alone.
        part: the part.

    Keyword Args:
        visited_share: share of visited states, in [0, 1]; where the memory holds none of the part, all are random.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``visited_share`` is out of range or there is no such part.

    Examples:
        >>> import torch
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> problem = make_problem("linear20")
        >>> memory = StateMemory(problem.model)
        >>> memory.visit(GreedyRepair(problem.model), problem.start, torch.arange(50), exploration=0.15)
        >>> y = training_states(problem, memory, part=4)(torch.arange(8))
        >>> problem.model.partition(y).unique().tolist()
        [4]
    """
    check_instance("problem", problem, Problem)
    if memory is not None:
        check_instance("memory", memory, StateMemory)
    visited_share = check_number("visited_share", visited_share, "[0, 1]")
    random = problem.training[check_integer("part", part, 0, len(problem.training) - 1)]
    if memory is None or visited_share == 0.0 or memory.count(part) == 0:
        return random
    return Mixture([random, memory.generator(part)], [1.0 - visited_share, visited_share])
