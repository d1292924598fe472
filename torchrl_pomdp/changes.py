"""What online rollout gains where the model has changed under an old policy (arXiv:2011.04222): measured, paired."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import torch

from torchrl_pomdp.checks import check_callable, check_flag, check_integer
from torchrl_pomdp.config import EVALUATION_SEED, MAX_STATES
from torchrl_pomdp.envs.repair import CalibratedStart, RepairModel, damage_chain
from torchrl_pomdp.evaluation import Comparison, compare, discounted_costs
from torchrl_pomdp.modules.repair import OldPolicy
from torchrl_pomdp.problems import make_problem, repair_problem
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.problems.repair import DEGRADATION
from torchrl_pomdp.trainers import r_nt

__all__ = ["Change", "measure_changes", "model_changes"]


@dataclass(frozen=True, eq=False)
class Change:
    """A model that has changed, and the old policy in it.

    Attributes:
        problem: the changed problem.
        policy: the old policy, left as it is.
    """

    problem: Problem
    policy: OldPolicy


def model_changes() -> dict[str, Change]:
    """The changes that are measured, by what has happened; the old policy is urgency.

    Examples:
        >>> list(model_changes())
        ['damage three times as fast', 'two blocked edges', 'one of two robots lost', 'one of ten robots lost']
    """
    linear, wide, two, ten = (make_problem(name) for name in ("linear20", "grid6x6", "two_robots20", "network32x10"))
    blocked = cast(RepairModel, wide.model).graph.without_edge(14, 15).without_edge(20, 21)
    fast = damage_chain([3 * rate for rate in DEGRADATION])
    return {
        "damage three times as fast": _change(linear, chain=fast),
        "two blocked edges": _change(wide, graph=blocked),
        "one of two robots lost": _change(two, lost=1, place=10),
        "one of ten robots lost": _change(ten, lost=4, place=12),
    }


def _change(problem: Problem, *, lost: int | None = None, place: int = 0, **changed: Any) -> Change:
    """The problem with some of the model's arguments changed, and its urgency policy in it."""
    old = cast(RepairModel, problem.model)
    arguments = {"graph": old.graph, "chain": old.chain, "costs": old.costs, "discount": old.discount, **changed}
    robots = old.num_robots - (lost is not None)
    fraction = cast(CalibratedStart, problem.start).num_damaged / old.num_locations
    new = repair_problem(
        **arguments, num_robots=robots, start=lambda model: CalibratedStart(model, fraction), name=f"changed {problem.name}"
    )
    new = replace(new, pessimistic_cost=type(problem.pessimistic_cost)(new.model))
    policy = OldPolicy(problem.base_policies["urgency"], old, cast(RepairModel, new.model), lost, place)
    return Change(new, policy)


def measure_changes(
    states: int = 1000,
    *,
    trajectories: int = 10,
    report: Callable[[str, str, Comparison], None] = lambda change, policy, comparison: None,
    progress: bool = False,
) -> dict[str, dict[str, Comparison]]:
    """Costs of the old policy, of online rollout of it in the changed model, and of a policy made for that.

    Args:
        states: start states.

    Keyword Args:
        trajectories: simulated trajectories of each control.
        report: called with change, policy and its comparison with the old policy as soon as it is known.
        progress: whether to show progress bars.

    Returns:
        for every change the comparisons with the old policy, by policy.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if a number is out of range.
    """
    check_integer("states", states, 2, MAX_STATES)
    check_integer("trajectories", trajectories, 1, 10**6)
    check_callable("report", report)
    check_flag("progress", progress)
    found: dict[str, dict[str, Comparison]] = {}
    for name, change in model_changes().items():
        problem, old = change.problem, change.policy
        # Many robots: simulations are cut, as their labels are.
        cut = {} if problem.model.enumerable else {"max_steps": 10, "terminal_cost": problem.pessimistic_cost}
        online = r_nt(problem, old, trajectories=trajectories, **cut)
        policies = {"old policy": old, "rollout of it": online, "made anew": problem.base_policies["urgency"]}
        costs: dict[str, torch.Tensor] = {}
        found[name] = {}
        for policy, each in policies.items():
            costs[policy] = discounted_costs(
                problem.model,
                each,
                problem.start,
                num_states=states,
                seed=EVALUATION_SEED,
                terminal_cost=problem.pessimistic_cost,
                progress=progress,
                name=f"{name}: {policy}",
            )
            found[name][policy] = compare(costs[policy], costs["old policy"])
            report(name, policy, found[name][policy])
    return found
