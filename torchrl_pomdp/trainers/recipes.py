r"""The paper's five algorithms, composed from the library's modules (Section VI-D).

====== ========== ============ =======================================================================
name   learning   partition    what it is
====== ========== ============ =======================================================================
R-NT   none       any          online one-step lookahead, simulations to the end
R-T    none       N parts      the same, startgame simulations cut at the endgame, with a terminal cost
API    networks   one part     policy iteration, one policy network
pAPI-NT networks  N parts      policy iteration, N policy networks
pAPI-T networks   N parts      the same, startgame simulations cut at the endgame, with its value networks
====== ========== ============ =======================================================================

Online play on top of a trained policy, a Newton step of the method for solving Bellman's equation, is :func:`r_nt` of it,
or :func:`r_t` with its values.
"""

from __future__ import annotations

from typing import Any

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.modules import (
    MultiagentRollout,
    OnEntering,
    PartitionedPolicy,
    Policy,
    RolloutPolicy,
    TerminalCost,
    Truncation,
)
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.report.names import SCHEME_NAMES
from torchrl_pomdp.trainers.plan import Evaluate, Improve
from torchrl_pomdp.trainers.policy_iteration import PolicyIteration

__all__ = ["api", "multiagent_rollouts", "papi_nt", "papi_t", "r_nt", "r_t"]


def r_nt(problem: Problem, base_policy: Policy, **options: Any) -> RolloutPolicy | MultiagentRollout:
    """Rollout without truncation: online, nothing is learnt. One agent after the other where joint controls are too many.

    Args:
        problem: the problem.
        base_policy: the base policy.
        options: see :class:`~torchrl_pomdp.modules.RolloutPolicy`.

    Examples:
        >>> import torch
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> problem = make_problem("line3")
        >>> r_nt(problem, GreedyRepair(problem.model))(problem.start(torch.arange(2)))["action"].shape
        torch.Size([2])
    """
    model = check_instance("problem", problem, Problem).model
    return (RolloutPolicy if model.enumerable else MultiagentRollout)(model, base_policy, **options)


def multiagent_rollouts(
    problem: Problem, base_policy: Policy, config: PolicyIterationConfig, trajectories: int
) -> dict[str, MultiagentRollout]:
    """Multiagent rollout in its schemes, by name, cut as the labels of policy iteration are: online, nothing is learnt.

    The best order takes R(R+1)/2·A Q-factors: it is left out where there are too many joint controls.

    Args:
        problem: the problem.
        base_policy: the base policy.
        config: says after how many stages simulations are cut.
        trajectories: simulated trajectories of each control.

    Examples:
        >>> from torchrl_pomdp.config import PolicyIterationConfig
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> problem = make_problem("two_robots20")
        >>> list(multiagent_rollouts(problem, GreedyRepair(problem.model), PolicyIterationConfig(label_steps=10), 2))
        ['one-at-a-time', 'order-optimised', 'autonomous']
    """
    check_instance("problem", problem, Problem)
    steps = check_instance("config", config, PolicyIterationConfig).stages
    options: dict[str, Any] = {"trajectories": trajectories, "max_steps": steps, "terminal_cost": problem.pessimistic_cost}
    return {
        name: MultiagentRollout(problem.model, base_policy, scheme=scheme, **options)
        for scheme, name in SCHEME_NAMES.items()
        if problem.model.enumerable or scheme != "order_optimised"
    }


def r_t(problem: Problem, base_policy: Policy, terminal_cost: TerminalCost, **options: Any) -> PartitionedPolicy:
    r"""Rollout with truncation: online, nothing is learnt. It simulates as :func:`papi_t` does for its labels.

    Where a simulation enters a part of an earlier stage, it ends with :math:`\alpha^m\hat J`; those that start in the first
    stage are not cut, since with nothing but :math:`\hat J` after a single step its errors can make a robot walk back and forth
    for ever. ``max_steps`` is the horizon unless it is given.

    Args:
        problem: the problem; its partition has at least two stages.
        base_policy: the base policy.
        terminal_cost: :math:`\hat J`; but for trajectories that do not end, read in the parts of all stages but the last.
        options: see :class:`~torchrl_pomdp.modules.RolloutPolicy`.

    Raises:
        ValueError: if the partition has one stage alone.

    Examples:
        >>> import torch
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair, SteadyStateCost
        >>> problem = make_problem("linear20")
        >>> policy = r_t(problem, GreedyRepair(problem.model), SteadyStateCost(problem.model), trajectories=2)
        >>> policy(problem.model.with_features(problem.start(torch.arange(2))))["action"].shape
        torch.Size([2])
    """
    local: dict[int, RolloutPolicy] = {}
    for stage, truncation in _cut_stages(problem, "R-T"):
        policy = RolloutPolicy(problem.model, base_policy, truncation=truncation, terminal_cost=terminal_cost, **options)
        local |= dict.fromkeys(stage, policy)
    return PartitionedPolicy([local[part] for part in sorted(local)])


def papi_nt(problem: Problem, config: PolicyIterationConfig, base_policy: Policy, **options: Any) -> PolicyIteration:
    """Partitioned policy iteration without truncation; the partition's stages one after the other.

    Args:
        problem: the problem.
        config: the numbers.
        base_policy: the policy that is improved first.
        options: see :class:`PolicyIteration`.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import UrgencyRepair
        >>> problem = make_problem("linear20")
        >>> [step.parts for step in papi_nt(problem, PolicyIterationConfig(), UrgencyRepair(problem.model)).plan]
        [(3, 4, 5), (0, 1, 2)]
    """
    plan = [Improve(stage) for stage in _stages(problem)]
    return PolicyIteration(problem, config, base_policy, plan, **options)


def papi_t(problem: Problem, config: PolicyIterationConfig, base_policy: Policy, **options: Any) -> PolicyIteration:
    r"""Partitioned policy iteration with truncation: simulations from a later stage end where they enter an earlier one.

    There :math:`\alpha^m\hat J` of that part's value network is added. Every stage but the last has value networks.

    Args:
        problem: the problem; its partition has at least two stages.
        config: the numbers.
        base_policy: the policy that is improved first.
        options: see :class:`PolicyIteration`.

    Raises:
        ValueError: if the partition has one stage alone.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import UrgencyRepair
        >>> problem = make_problem("linear20")
        >>> plan = papi_t(problem, PolicyIterationConfig(), UrgencyRepair(problem.model)).plan
        >>> [(type(step).__name__, step.parts) for step in plan]
        [('Improve', (3, 4, 5)), ('Evaluate', (3, 4, 5)), ('Improve', (0, 1, 2))]
    """
    plan: list[Improve | Evaluate] = []
    cuts = _cut_stages(problem, "pAPI-T")
    for stage, truncation in cuts:
        plan.append(Improve(stage, truncation))
        if stage is not cuts[-1][0]:
            plan.append(Evaluate(stage, truncation))
    return PolicyIteration(problem, config, base_policy, plan, **options)


def _stages(problem: Problem) -> tuple[tuple[int, ...], ...]:
    return check_instance("problem", problem, Problem).partition.stages


def _cut_stages(problem: Problem, algorithm: str) -> list[tuple[tuple[int, ...], Truncation | None]]:
    """The partition's stages, each with the rule that cuts its simulations where they enter an earlier one."""
    stages = _stages(problem)
    if len(stages) < 2:
        raise ValueError(f"{algorithm} needs a partition of at least two stages, problem {problem.name!r} has {len(stages)}")
    earlier = [sum(stages[:number], ()) for number in range(len(stages))]
    return [(stage, OnEntering(parts) if parts else None) for stage, parts in zip(stages, earlier, strict=True)]


def api(problem: Problem, config: PolicyIterationConfig, base_policy: Policy, **options: Any) -> PolicyIteration:
    """Policy iteration with one network for the whole feature space; the problem must have a single part.

    Args:
        problem: the problem, such as :meth:`Problem.unpartitioned` of another.
        config: the numbers; ``samples_per_part`` is then the number of all samples.
        base_policy: the policy that is improved first.
        options: see :class:`PolicyIteration`.

    Raises:
        ValueError: if the problem has several parts.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import UrgencyRepair
        >>> problem = make_problem("linear20", partitioned=False)
        >>> [step.parts for step in api(problem, PolicyIterationConfig(), UrgencyRepair(problem.model)).plan]
        [(0,)]
    """
    parts = check_instance("problem", problem, Problem).partition.num_parts
    if parts != 1:
        raise ValueError(f"API is for a problem with a single part, {problem.name!r} has {parts}: take problem.unpartitioned()")
    return PolicyIteration(problem, config, base_policy, [Improve((0,))], **options)
