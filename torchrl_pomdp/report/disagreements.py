"""Where two policies disagree, in the states that one of them visits."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase

from torchrl_pomdp.modules.policies import Policy, controls_of
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.trajectories import play

__all__ = ["Disagreements", "disagreements"]


@dataclass(frozen=True)
class Disagreements:
    """Where two policies disagree.

    Attributes:
        parts: by name of the part, the number of decisions and of those that differ; of parts that are visited.
        pairs: for controls of a single agent, what the one policy does, what the other does instead, and how often; the most
            frequent first.
    """

    parts: dict[str, tuple[int, int]]
    pairs: list[tuple[str, str, int]]


def disagreements(
    problem: Problem, base: Policy, trained: Policy, y: TensorDictBase, keys: torch.Tensor, *, max_steps: int
) -> Disagreements:
    """Compare the decisions of ``base`` and ``trained`` in the states that ``trained`` visits from ``y`` ``[N]``.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem, keys = make_problem("tiger"), torch.arange(20)
        >>> bases = problem.base_policies
        >>> found = disagreements(problem, bases["listen"], bases["myopic"], problem.start(keys), keys, max_steps=5)
        >>> found.parts
        {'all': (100, 19)}
    """
    model = problem.model
    visited = play(model, trained, y, keys, max_steps=max_steps)
    states = visited.exclude("next", "action", "q_factors", "hidden", "cost").reshape(-1)
    live = ~model.is_terminal(states)
    states, u = states[live], visited["action"].flatten(0, 1)[live]
    with torch.no_grad():
        instead = controls_of("base", base, states.copy())
    mine, theirs = (each.reshape(len(states), -1) for each in (u, instead))
    differ = (mine != theirs).any(-1)
    parts = {}
    for part, name in enumerate(problem.partition.names):
        here = states["partition"] == part
        if bool(here.any()):
            parts[name] = (int(here.sum()), int((here & differ).sum()))
    pairs: Counter[tuple[str, str]] = Counter()
    both, counts = torch.stack([instead[differ], u[differ]], 1).unique(dim=0, return_counts=True)
    for (was, now), count in zip(both, counts.tolist(), strict=True):
        for one, other in zip(model.shown_control(was), model.shown_control(now), strict=True):
            if one != other:
                pairs[one, other] += count
    return Disagreements(parts, [(*pair, count) for pair, count in pairs.most_common()])
