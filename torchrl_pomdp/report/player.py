"""Trajectories of two policies under the same noise, as JSON that a page steps through."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_pomdp.config import EVALUATION_SEED
from torchrl_pomdp.envs.scene import MOST_CONTROLS, control_bars
from torchrl_pomdp.modules.policies import Policy
from torchrl_pomdp.noise import fold, seed_keys
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.trajectories import play

__all__ = ["lookahead", "player_data", "side_by_side", "starts"]

# Bytes of the JSON text, so that a page stays below three million.
_MOST_BYTES = 2_000_000
# Simulated trajectories of each control, for Q-factors.
_TRAJECTORIES = 10


def lookahead(problem: Problem, base: Policy) -> Any:
    """What estimates Q-factors of the base policy; None where controls are too many for bars."""
    # Not at the top: the trainers know the reports of peers.
    from torchrl_pomdp.trainers.recipes import r_nt

    if not problem.model.enumerable or problem.model.num_controls > MOST_CONTROLS:
        return None
    return r_nt(problem, base, trajectories=_TRAJECTORIES)


def starts(problem: Problem, count: int) -> tuple[TensorDictBase, torch.Tensor]:
    """The first start states ``[count]`` of the evaluations, and keys of the noise."""
    keys = seed_keys(EVALUATION_SEED, torch.arange(count, device=problem.model.device))
    return problem.model.drawn(problem.start, fold(keys, 0), "start"), fold(keys, 1)


def side_by_side(
    problem: Problem, policies: Mapping[str, Policy], count: int, max_steps: int
) -> list[dict[str, TensorDictBase]]:
    """Trajectories ``[T]`` of policies from the same states under the same noise, with Q-factors of the first policy.

    Args:
        problem: the problem.
        policies: the policies by name, the base policy first.
        count: number of start states.
        max_steps: the most stages.
    """
    y, keys = starts(problem, count)
    factors = lookahead(problem, next(iter(policies.values())))
    found: list[dict[str, TensorDictBase]] = []
    for i in range(count):
        found.append({})
        for name, policy in policies.items():
            found[-1][name] = trajectory = play(problem.model, policy, y[i], keys[i], max_steps=max_steps)
            if factors is not None:
                trajectory.set("q_factors", factors.q_factors(trajectory.select(*problem.model.state_keys)))
    return found


def player_data(problem: Problem, trajectories: Sequence[Mapping[str, TensorDictBase]]) -> dict[str, Any]:
    """What the player shows, as JSON: the layout of the scene and, for each start state and policy, the frames of all stages.

    Args:
        problem: the problem.
        trajectories: for each start state, trajectories ``[T]`` by policy, see :func:`side_by_side`.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("tiger")
        >>> data = player_data(problem, side_by_side(problem, {"listen": problem.base_policies["listen"]}, 1, 2))
        >>> data["policies"], [frame["does"] for frame in data["starts"][0][0]]
        (['listen'], ['listen', 'listen', 'the end'])
    """
    scene = problem.model.scene()
    starts = [[_frames(problem, trajectory) for trajectory in each.values()] for each in trajectories]
    data: dict[str, Any] = {"policies": list(trajectories[0]), "scene": scene.layout(), "starts": starts, "cut": None}
    size = len(json.dumps(data))
    if size > _MOST_BYTES:
        longest = max(len(frames) for start in starts for frames in start)
        data["cut"] = stages = max(2, longest * _MOST_BYTES // size)
        data["starts"] = [[frames[:stages] for frames in start] for start in starts]
    return data


def _frames(problem: Problem, trajectory: TensorDictBase) -> list[dict[str, Any]]:
    """A frame for every stage, and one for the end."""
    model = problem.model
    core = [*model.state_keys, *(["hidden"] if "hidden" in trajectory else [])]
    states: Any = torch.cat([trajectory.select(*core), trajectory["next"].select(*core)[-1:]])
    u = trajectory["action"]
    frames = model.scene().frames(states.set("action", torch.cat([u, u[-1:]])))
    frames[-1] |= {"does": "the end"}
    frames[-1].pop("to", None)
    discounts = model.discount ** torch.arange(len(trajectory), dtype=torch.float64, device=u.device)
    so_far = [0.0, *(trajectory["cost"].double() * discounts).cumsum(0).tolist()]
    bars = control_bars(model, trajectory) or []
    for stage, frame in enumerate(frames):
        frame |= {"cost": round(so_far[stage], 4), "q": bars[stage] if stage < len(bars) else []}
    return frames
