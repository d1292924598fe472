"""What ``gymnasium.make`` and ``gymnasium.make_vec`` make for the ids of :mod:`torchrl_pomdp.gym_ids`.

All take ``problem``: the name of a preset, the path of a file ``.toml`` or ``.POMDP``, ``module:function`` of the user's own
code, or a :class:`~torchrl_pomdp.problems.Problem`, of pipelines or not.
"""

from __future__ import annotations

import os
from typing import Any

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.envs.gym import BeliefSimulation, PomdpEnv, PomdpVectorEnv, WorldSimulation
from torchrl_pomdp.problems.find import find_problem
from torchrl_pomdp.problems.problem import Problem

__all__ = ["PipelineRepair", "PipelineRepairObservations", "PipelineRepairObservationsVector", "PipelineRepairVector"]


class PipelineRepair(PomdpEnv):
    """The agent sees the belief; see :class:`~torchrl_pomdp.envs.gym.PomdpEnv`.

    Args:
        problem: see the module.
        render_mode: ``"rgb_array"``, ``"human"`` or None.
    """

    def __init__(self, problem: str | os.PathLike[str] | Problem = "linear20", render_mode: str | None = None) -> None:
        found = _problem(problem)
        super().__init__(BeliefSimulation(found.model, found.start), render_mode)


class PipelineRepairObservations(PomdpEnv):
    """The agent sees what the robots see; see :class:`~torchrl_pomdp.envs.gym.WorldSimulation`.

    Args:
        problem: see the module; its model has hidden states.
        render_mode: ``"rgb_array"``, ``"human"`` or None.
    """

    def __init__(self, problem: str | os.PathLike[str] | Problem = "linear20", render_mode: str | None = None) -> None:
        found = _problem(problem)
        super().__init__(WorldSimulation(found.model, found.start), render_mode)


class PipelineRepairVector(PomdpVectorEnv):
    """Many :class:`PipelineRepair` as one batch.

    Args:
        problem: see the module.
        options: ``num_envs``, ``max_episode_steps`` and ``render_mode``, see :class:`~torchrl_pomdp.envs.gym.PomdpVectorEnv`.
    """

    def __init__(self, problem: str | os.PathLike[str] | Problem = "linear20", **options: Any) -> None:
        found = _problem(problem)
        super().__init__(BeliefSimulation(found.model, found.start), **options)


class PipelineRepairObservationsVector(PomdpVectorEnv):
    """Many :class:`PipelineRepairObservations` as one batch.

    Args:
        problem: see the module; its model has hidden states.
        options: ``num_envs``, ``max_episode_steps`` and ``render_mode``, see :class:`~torchrl_pomdp.envs.gym.PomdpVectorEnv`.
    """

    def __init__(self, problem: str | os.PathLike[str] | Problem = "linear20", **options: Any) -> None:
        found = _problem(problem)
        super().__init__(WorldSimulation(found.model, found.start), **options)


def _problem(given: Any) -> Problem:
    check_instance("problem", given, (str, os.PathLike, Problem))
    return given if isinstance(given, Problem) else find_problem(os.fspath(given))
