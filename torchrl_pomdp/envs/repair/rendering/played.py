"""Trajectories of repair problems, checked before they are drawn."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_text
from torchrl_pomdp.envs.entries import check_state_entries
from torchrl_pomdp.envs.repair.model import RepairModel
from torchrl_pomdp.envs.scene import control_bars
from torchrl_pomdp.tensor_checks import check_distributions, check_tensor

__all__ = ["Played", "check_moves", "expected_damage", "played"]


class Played(NamedTuple):
    """A trajectory of T controls, on the CPU; of its states the last one may be missing.

    Attributes:
        name: what it is called.
        captions: stage and cost so far, one for each state.
        damage: expected damage levels ``[T + 1, L]``.
        location: int64 ``[T + 1, R]``.
        controls: the robots' controls, int64 ``[T, R]``.
        truth: true damage levels ``[T + 1, L]``, where they are known.
        bars: by stage, names of the best controls, what their Q-factors are above the least one, and whether they are chosen;
            where Q-factors are known and controls are few.
    """

    name: str
    captions: list[str]
    damage: Tensor
    location: Tensor
    controls: Tensor
    truth: Tensor | None
    bars: list[list[tuple[str, float, bool]]] | None


def played(model: RepairModel, name: str, trajectory: TensorDictBase) -> Played:
    """A trajectory, checked, with the discounted cost before each stage."""
    check_text("key of trajectories", name)
    what = f"trajectories[{name!r}]"
    states, controls = of_one_trajectory(model, what, trajectory)
    truth, action = _truth(model, what, trajectory), trajectory["action"]
    if "next" in trajectory:
        states = torch.cat([states, _states(model, f"next of {what}", trajectory["next"])[-1:]])
        last = None if truth is None else _truth(model, f"next of {what}", trajectory["next"])
        truth = None if truth is None or last is None else torch.cat([truth, last[-1:]])
    check_moves(f"action of {what}", model, states["location"][: len(controls)], controls)
    # As the environment has it: no cost follows a terminal state.
    costs = model.expected_cost(states).masked_fill(model.is_terminal(states), 0.0).double()
    costs *= model.discount ** torch.arange(len(costs), device=model.device)
    before = (costs.cumsum(0) - costs).tolist()
    captions = [f"stage {stage}, cost so far {cost:.5g}" for stage, cost in enumerate(before)]
    damage, location = expected_damage(model, states["belief"]).cpu(), states["location"].cpu()
    return Played(name, captions, damage, location, controls.cpu(), truth, _bars(model, what, trajectory, action))


def of_one_trajectory(model: RepairModel, what: str, trajectory: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
    """Core entries ``[T]`` and robots' controls ``[T, R]`` of a single trajectory; raises where they are none of the model."""
    if len(trajectory.batch_size) != 1 or not trajectory.batch_size[0]:
        raise ValueError(f"{what} must be one trajectory of at least one stage, got batch {tuple(trajectory.batch_size)}")
    states, shape = _states(model, what, trajectory), (*trajectory.batch_size, *model.control_shape)
    action = check_tensor(f"action of {what}", trajectory.get("action", None), shape, torch.int64)
    wrong = action[(action < 0) | (action >= model.control_range)]
    if len(wrong):
        raise ValueError(f"action of {what} must be in 0..{model.control_range - 1}, got {int(wrong[0])}")
    return states, model.split_controls(action.to(model.device))


def _states(model: RepairModel, what: str, given: TensorDictBase) -> TensorDictBase:
    """The core entries of feature states, on the model's device; raises where they are none of the model."""
    check_state_entries(what, given, model.state_spec(), "a feature state")
    check_distributions(f"entry 'belief' of {what}", given["belief"])
    return given.select(*model.state_keys).to(model.device)


def _truth(model: RepairModel, what: str, given: TensorDictBase) -> Tensor | None:
    """The true levels ``[T, L]``; None where the trajectory has no hidden states."""
    hidden = given.get("hidden", None)
    if hidden is None:
        return None
    check_state_entries(f"hidden of {what}", hidden, model.world().hidden_spec(), "a hidden state")
    return hidden["level"].cpu()


def _bars(
    model: RepairModel, what: str, trajectory: TensorDictBase, action: Tensor
) -> list[list[tuple[str, float, bool]]] | None:
    """The best controls of every stage; None where the trajectory has no Q-factors of joint controls, or too many."""
    q_factors = trajectory.get("q_factors", None)
    if q_factors is not None and q_factors.ndim == 3:
        check_tensor(f"q_factors of {what}", q_factors, (len(action), model.num_agents, model.num_agent_controls), finite=False)
    elif q_factors is not None:
        check_tensor(f"q_factors of {what}", q_factors, (len(action), model.num_controls), finite=False)
    stages = control_bars(model, trajectory)
    if stages is None:
        return None
    least = [min((q for _, q, _ in stage), default=0.0) for stage in stages]
    return [[(name, q - low, chosen) for name, q, chosen in stage] for stage, low in zip(stages, least, strict=True)]


def check_moves(name: str, model: RepairModel, location: Tensor, controls: Tensor) -> None:
    """Raise unless robots' controls ``[*B, R]`` stay on the graph."""
    outside = (model.destinations[location, controls] < 0).nonzero()
    if len(outside):
        where = tuple(outside[0].tolist())
        control = model.graph.control_names[controls[where]]
        place = model.graph.location_names[location[where]]
        raise ValueError(
            f"{name} must move robots along edges, got {control!r} for robot {where[-1] + 1} at {place}, which has none there"
        )


def expected_damage(model: RepairModel, belief: Tensor) -> Tensor:
    """Expected damage levels ``[*B, L]`` of beliefs ``[*B, L, K]``."""
    return belief @ torch.arange(model.num_levels, dtype=model.dtype, device=model.device)
