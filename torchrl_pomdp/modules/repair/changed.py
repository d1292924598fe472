"""An old policy in a model that has changed: another chain, a blocked edge, a robot lost (arXiv:2011.04222).

Online rollout needs no training: it takes the changed model, and the old policy as its base policy.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_pomdp.checks import check_callable, check_instance, check_integer
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.repair.model import RepairModel
from torchrl_pomdp.envs.rows import flat_rows
from torchrl_pomdp.modules.policies import Policy, controls_of
from torchrl_pomdp.modules.scalar import Limited, ScalarEngine
from torchrl_pomdp.tensor_checks import check_entries

__all__ = ["OldPolicy"]


class OldPolicy(TensorDictModuleBase):
    """A policy that was made for another model of the same locations, left as it is, in the changed one.

    The policy sees what it always saw. Where its control is no longer legal for a robot, such as a move over a blocked edge,
    the robot takes its first legal control. A robot that is lost counts, for the policy, as standing where it broke down.

    Args:
        policy: the policy.
        old: the model that it was made for.
        new: the changed model: its graph has the same locations and slots, its chains as many levels.
        lost: number of the robot, among the old ones, that is lost; None: there are as many as before.
        place: location where it broke down; only with ``lost``.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if the models do not fit each other, or there is no such robot or location.

    Examples:
        >>> from torchrl_pomdp.envs.repair import grid
        >>> from torchrl_pomdp.modules import RolloutPolicy
        >>> from torchrl_pomdp.modules.repair import UrgencyRepair
        >>> from torchrl_pomdp.problems import repair_problem
        >>> from torchrl_pomdp.envs.repair import damage_chain
        >>> chain, costs = damage_chain((0.0, 0.1)), (0.0, 1.0, 10.0)
        >>> old = repair_problem(grid(3, 3), chain, costs, 0.95)
        >>> new = repair_problem(grid(3, 3).without_edge(0, 1), chain, costs, 0.95)
        >>> policy = OldPolicy(UrgencyRepair(old.model), old.model, new.model)
        >>> y = RolloutPolicy(new.model, policy)(new.start(torch.arange(4)))
        >>> bool(y["q_factors"].isfinite().any(-1).all())
        True
    """

    in_keys = ["belief", "location"]
    out_keys = ["action"]

    def __init__(self, policy: Policy, old: RepairModel, new: RepairModel, lost: int | None = None, place: int = 0) -> None:
        super().__init__()
        self.policy = check_callable("policy", policy)
        self.old, self.new = check_instance("old", old, RepairModel), check_instance("new", new, RepairModel)
        self.lost = None if lost is None else check_integer("lost", lost, 0, old.num_robots - 1)
        self.place = check_integer("place", place, 0, old.num_locations - 1)
        if place and lost is None:
            raise ValueError(f"place is that of a lost robot, got {place} without one")
        for name, one, other in _shapes(old, new, 0 if lost is None else 1):
            if one != other:
                raise ValueError(f"new must have as many {name} as old, got {other} for {one}")

    def scalar_engine(self, model: BeliefModel, limits: Limited) -> ScalarEngine | None:
        """Compiled simulations, see :class:`~torchrl_pomdp.modules.scalar.ScalarEngine`."""
        from torchrl_pomdp.modules.repair.scalar.changed import changed_engine

        fits = model is self.new
        return changed_engine(self.policy, self.old, self.new, limits, self.lost, self.place) if fits else None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"`` for feature states of the changed model."""
        y = flat_rows(check_entries("tensordict", tensordict, self.in_keys).select(*self.in_keys))
        location = y.get("location")
        if self.lost is not None:
            broken = torch.full_like(location[:, :1], self.place)
            location = torch.cat([location[:, : self.lost], broken, location[:, self.lost :]], -1)
        seen = TensorDict({"belief": y.get("belief"), "location": location}, batch_size=y.batch_size)
        controls = self.old.split_controls(controls_of("policy", self.policy, self.old.derive(seen)))
        if self.lost is not None:
            controls = torch.cat([controls[:, : self.lost], controls[:, self.lost + 1 :]], -1)
        mask = self.new.agent_mask(y)
        legal = mask.gather(-1, controls.unsqueeze(-1)).squeeze(-1)
        action = self.new.join_controls(torch.where(legal, controls, mask.to(torch.int8).argmax(-1)))
        return tensordict.set("action", action.view((*tensordict.batch_size, *self.new.control_shape)))


def _shapes(old: RepairModel, new: RepairModel, lost: int) -> list[tuple[str, Any, Any]]:
    """What two models must have in common."""
    return [
        ("locations", old.num_locations, new.num_locations),
        ("levels", old.num_levels, new.num_levels),
        ("controls of a robot", old.num_robot_controls, new.num_robot_controls),
        ("robots that are left", old.num_robots - lost, new.num_robots),
    ]
