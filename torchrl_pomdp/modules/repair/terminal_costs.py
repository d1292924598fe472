r"""Terminal costs :math:`\hat J` of repair problems in closed form (paper, Section III)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance, shown
from torchrl_pomdp.envs.repair.chains import location_costs, prices
from torchrl_pomdp.envs.repair.model import RepairModel
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.modules.policies import check_finite
from torchrl_pomdp.modules.terminal_costs import ClosedFormCost

__all__ = ["NeverRepairCost", "SteadyStateCost"]


class SteadyStateCost(ClosedFormCost):
    r""":math:`\hat J(y)=\hat g(y)/(1-\alpha)`: the present stage cost for ever, as if damage neither grew nor was repaired.

    Args:
        model: the repair model; its stage cost does not depend on the control.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("line3")
        >>> y = SteadyStateCost(problem.model)(problem.start(torch.arange(2)))
        >>> torch.allclose(y["state_value"] * 0.01, problem.model.expected_cost(y))
        True
    """

    in_keys = ["belief"]

    def __init__(self, model: RepairModel) -> None:
        super().__init__()
        self.model = check_instance("model", model, RepairModel)

    def costs(self, y: TensorDictBase) -> Tensor:
        """Costs ``[*B]``."""
        _belief(y)
        return self.model.expected_cost(y) / (1.0 - self.model.discount)


class NeverRepairCost(ClosedFormCost):
    r"""Exact cost of never repairing, the sum over locations of :math:`b\,(I-\alpha P)^{-1}c`, with P the damage chain.

    Args:
        model: the repair model.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("line3")
        >>> y = problem.start(torch.arange(2))
        >>> bool((NeverRepairCost(problem.model).costs(y) >= SteadyStateCost(problem.model).costs(y)).all())
        True
    """

    in_keys = ["belief"]

    def __init__(self, model: RepairModel) -> None:
        super().__init__()
        chain = check_instance("model", model, RepairModel).chain.double()
        system = torch.eye(model.num_levels, dtype=chain.dtype, device=chain.device) - model.discount * chain
        # Discounted cost of one location that starts at each level.
        level_costs = torch.linalg.solve(system, model.costs.double().unsqueeze(-1)).squeeze(-1).to(model.dtype)
        check_finite(f"costs of the model for ever must be finite in {model.dtype}", level_costs)
        self.num_levels, self.level_costs = model.num_levels, prices(level_costs)

    def costs(self, y: TensorDictBase) -> Tensor:
        """Costs ``[*B]``."""
        # Planes [L, K, *B] are summed in the same order whatever the batch.
        belief = _belief(y)
        if belief.shape[y.ndim + 1 :] != (self.num_levels,):
            raise ValueError(f"entry 'belief' of y must end in {self.num_levels} levels, got {tuple(belief.shape)}")
        return sum_first(location_costs(belief.movedim((-2, -1), (0, 1)), self.level_costs))


def _belief(y: TensorDictBase) -> Tensor:
    belief = check_instance("y", y, TensorDictBase).get("belief", None)
    if not isinstance(belief, Tensor) or not belief.is_floating_point():
        raise ValueError(f"y must hold the beliefs as entry 'belief', got {shown(belief)}")
    return belief
