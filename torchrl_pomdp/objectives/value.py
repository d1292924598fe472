r"""Training a value network on simulated costs is a regression problem (paper, Section IV)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.modules import ClosedFormCost
from torchrl_pomdp.modules.policies import check_finite
from torchrl_pomdp.objectives.labels import LabelLoss, check_batch, check_loss, label_of, with_weights, without_modes

__all__ = ["ValueLoss"]


@without_modes
class ValueLoss(LabelLoss):
    r"""Mean squared error of a cost approximation :math:`\hat J(y,r)` against simulated costs, relative to a scale.

    Costs-to-go span many orders of magnitude; divided by a known positive cost of the state, such as that of never
    repairing, the errors of cheap and of expensive states count alike. States of scale zero, such as terminal ones, where there
    is nothing to learn, are left out.

    Args:
        value: module that writes ``"state_value"``; a :class:`~torchrl_pomdp.modules.ValueNetwork` or a partitioned one.
        scale: cost of a state, not negative, that its error is divided by.

    Returns (by ``forward``):
        TensorDict with scalars ``loss_value`` and ``relative_error`` (mean absolute error over mean target, 0 where all is 0).

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: by ``forward``, if a label is missing or no number, a scale is negative, or the loss is not finite.

    Examples:
        >>> import torch
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules import FlatEncoder, PolicyCost, ValueNetwork
        >>> from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost
        >>> problem = make_problem("linear20")
        >>> model, scale = problem.model, NeverRepairCost(problem.model)
        >>> batch = PolicyCost(model, GreedyRepair(model))(problem.start(torch.arange(8)))
        >>> network = ValueNetwork(FlatEncoder(model), scale, generator=torch.Generator().manual_seed(0))
        >>> bool(ValueLoss(network, scale)(batch)["loss_value"] > 0)
        True
    """

    @dataclass
    class _AcceptedKeys:
        cost_to_go: NestedKey = "cost_to_go"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_value", "relative_error"]
    value: TensorDictModuleBase
    value_params: TensorDictParams
    target_value_params: TensorDictParams

    def __init__(self, value: TensorDictModuleBase, scale: ClosedFormCost) -> None:
        super().__init__()
        check_instance("value", value, TensorDictModuleBase)
        self.scale = check_instance("scale", scale, ClosedFormCost)
        self.convert_to_functional(value, "value")

    @property
    def network(self) -> TensorDictModuleBase:
        """The module that is trained."""
        return self.value

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss and metrics of labelled states ``[*B]``; see the class."""
        batch = check_batch(tensordict, self.in_keys)
        target = label_of(batch, self.tensor_keys.cost_to_go, 1, floating=True)
        check_finite("cost_to_go must be finite", target)
        with with_weights(self.value, self.value_params):
            value = self.value(batch.select(*self.value.in_keys)).get("state_value")
        scale = self.scale.costs(batch)
        if not bool((scale >= 0).all()):
            raise ValueError(f"scale must give costs that are not negative, got {float(scale.min())} among them")
        known = scale > 0
        error = (value - target).masked_fill(~known, 0.0)
        relative = error / scale.masked_fill(~known, 1.0)
        count, total = known.sum().clamp_min(1), target.masked_fill(~known, 0.0).abs().sum()
        return TensorDict(
            {
                "loss_value": check_loss("loss_value", relative.square().sum() / count),
                "relative_error": error.detach().abs().sum() / torch.where(total > 0, total, 1.0),
            }
        )
