"""Base policies of the repair problem (paper, Section VI-C)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance, check_number
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.repair.chains import location_costs, prices
from torchrl_pomdp.envs.repair.model import REPAIR, RepairModel
from torchrl_pomdp.modules.scalar import Limited, ScalarEngine
from torchrl_pomdp.tensor_checks import check_entries

__all__ = ["GreedyRepair", "UrgencyRepair"]


class GreedyRepair(TensorDictModuleBase):
    r"""The paper's greedy policy: repair where you stand if it may be damaged, else step to the nearest such location.

    A location may be damaged if :math:`1-b(0)>` ``damage_threshold``. Ties go to the location, then to the control, with
    the lower index. Several robots choose each for itself. Where nothing may be damaged a robot takes its first move.

    Args:
        model: the repair model.
        damage_threshold: probability in [0, 1); zero means any possibility of damage.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``damage_threshold`` is not in [0, 1).

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> y = problem.start(torch.arange(5))
        >>> GreedyRepair(problem.model)(y)["action"].shape
        torch.Size([5])
    """

    in_keys = ["belief", "location"]
    out_keys = ["action"]
    ranks: Tensor
    first_moves: Tensor

    def __init__(self, model: RepairModel, damage_threshold: float = 0.0) -> None:
        super().__init__()
        self.model = check_instance("model", model, RepairModel)
        self._damage_threshold = check_number("damage_threshold", damage_threshold, "[0, 1)")
        size = model.num_locations
        # [L, L], target by origin: orders targets by distance, then index, and is below `size * size` for all.
        ranks = model.graph.distances.T * size + torch.arange(size).unsqueeze(-1)
        self.register_buffer("ranks", ranks.to(model.device, model.dtype), persistent=False)
        self.register_buffer("first_moves", first_moves(model), persistent=False)

    @property
    def damage_threshold(self) -> float:
        """Probability of damage up to which a location counts as intact; fixed, as compiled simulations have read it."""
        return self._damage_threshold

    def scalar_engine(self, model: BeliefModel, limits: Limited) -> ScalarEngine | None:
        """Compiled simulations, see :class:`~torchrl_pomdp.modules.scalar.ScalarEngine`."""
        from torchrl_pomdp.modules.repair.scalar import engine, twins

        return engine.repair_engine(twins.greedy, (self.damage_threshold,), self.model, model, limits)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"``, int64 ``[*B]``."""
        check_entries("tensordict", tensordict, self.in_keys)
        size = self.model.num_locations
        belief = tensordict.get("belief").reshape(-1, size, self.model.num_levels)
        location = tensordict.get("location").reshape(-1, self.model.num_robots)
        # 1 where a location is intact, else 0: floor is exact at 1 and much faster than a comparison.
        intact = (belief[..., 0].T + self.damage_threshold).floor()
        controls = [self._robot_control(intact, location[:, robot]) for robot in range(self.model.num_robots)]
        action = self.model.join_controls(torch.stack(controls, -1))
        return tensordict.set("action", action.view((*tensordict.batch_size, *self.model.control_shape)))

    def _robot_control(self, intact: Tensor, location: Tensor) -> Tensor:
        """Control ``[N]`` of a robot at ``location`` ``[N]``, given the intact flags ``[L, N]``."""
        size = self.model.num_locations
        rank = _columns(self.ranks, location).add_(intact, alpha=float(size * size)).amin(0)
        nowhere = rank >= size * size
        # The remainder by `size`, exact in floating point and much faster than an integer division.
        target = (rank - (rank / size).floor() * size).to(torch.int64)
        control = self.model.first_controls.flatten()[location * size + target]
        return torch.where(nowhere, self.first_moves[location], control)


class UrgencyRepair(TensorDictModuleBase):
    r"""Go where damage costs most for the way there, and repair: the location that maximises :math:`(b\cdot c-c_0)/(d+1)^3`.

    :math:`b\cdot c-c_0` is what a location is expected to cost per stage more than if it were intact, d the number of moves
    to it, computed in double precision and rounded to the model's, so that in single precision ties are ties. They go to the
    location, then to the control, with the lower index. Robots choose one after the other, each among the locations that no
    earlier robot has chosen. A robot for which no costly location is left takes its first move.

    Args:
        model: the repair model.
        exponent: how much the distance counts, not negative.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``exponent`` is negative.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> UrgencyRepair(problem.model)(problem.start(torch.arange(5)))["action"].shape
        torch.Size([5])
    """

    in_keys = ["belief", "location"]
    out_keys = ["action"]
    remoteness: Tensor
    indices: Tensor
    first_moves: Tensor

    def __init__(self, model: RepairModel, exponent: float = 3.0) -> None:
        super().__init__()
        self.model = check_instance("model", model, RepairModel)
        self._exponent = check_number("exponent", exponent, "[0, inf)")
        # What a level costs more than an intact location.
        costs = model.costs.double()
        self._prices = prices(costs - costs[..., :1])
        # [L, L], target by origin.
        remoteness = (model.graph.distances.T.double() + 1.0) ** self.exponent
        self.register_buffer("remoteness", remoteness.to(model.device), persistent=False)
        indices = torch.arange(model.num_locations, dtype=model.dtype, device=model.device).unsqueeze(-1)
        self.register_buffer("indices", indices, persistent=False)
        self.register_buffer("first_moves", first_moves(model), persistent=False)

    @property
    def exponent(self) -> float:
        """How much the distance counts; fixed, as tables have been made with it."""
        return self._exponent

    def scalar_engine(self, model: BeliefModel, limits: Limited) -> ScalarEngine | None:
        """Compiled simulations, see :class:`~torchrl_pomdp.modules.scalar.ScalarEngine`."""
        from torchrl_pomdp.modules.repair.scalar import engine, twins

        costs = self.model.costs.double()
        data = self.remoteness.numpy().T.copy(), float((costs - costs[..., :1]).max())
        return engine.repair_engine(twins.urgency, data, self.model, model, limits, numbers=self.model.num_robots)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"``, int64 ``[*B]``."""
        check_entries("tensordict", tensordict, self.in_keys)
        model = self.model
        belief = tensordict.get("belief").reshape(-1, model.num_locations, model.num_levels)
        location = tensordict.get("location").reshape(-1, model.num_robots)
        costs = location_costs(belief.permute(1, 2, 0).double(), self._prices)
        controls = []
        for robot in range(model.num_robots):
            place = location[:, robot]
            urgency = (costs / _columns(self.remoteness, place)).to(model.dtype)
            highest = urgency.amax(0)
            # The first location that attains the highest: all others rank behind it. Much faster than argmax.
            rank = (highest - urgency).sign_().mul_(model.num_locations).add_(self.indices).amin(0)
            target = rank.to(torch.int64)
            control = model.first_controls.flatten()[place * model.num_locations + target]
            controls.append(torch.where(highest > 0, control, self.first_moves[place]))
            if robot + 1 < model.num_robots:
                costs = costs.scatter(0, target.unsqueeze(0), 0.0)
        action = model.join_controls(torch.stack(controls, -1))
        return tensordict.set("action", action.view((*tensordict.batch_size, *model.control_shape)))


def _columns(table: Tensor, location: Tensor) -> Tensor:
    """Columns ``location`` ``[N]`` of ``table`` ``[L, L]``: ``[L, N]``."""
    # Compiled, `gather` costs a fourth of `index_select`, which also admits indices from the end.
    return table.gather(1, location.expand(table.shape[0], -1))


def first_moves(model: RepairModel) -> Tensor:
    """The lowest move of a robot at every location ``[L]``, or repair where it cannot move."""
    legal = model.destinations >= 0
    legal[:, REPAIR] = ~legal[:, 1:].any(-1)
    return legal.to(torch.int64).argmax(-1)
