r"""Training a value network on simulated costs is a regression problem (paper, Section IV)."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey

from torchrl_pomdp.modules import ClosedFormCost
from torchrl_pomdp.objectives.labels import LabelLoss

__all__ = ["ValueLoss"]


class ValueLoss(LabelLoss):
    r"""Mean squared error of a cost approximation :math:`\hat J(y,r)` against simulated costs, relative to a scale.

    Costs-to-go span many orders of magnitude; divided by a known positive cost of the state, such as that of never
    repairing, the errors of cheap and of expensive states count alike.

    Args:
        value: module that writes ``"state_value"``; a :class:`~torchrl_pomdp.modules.ValueNetwork` or a partitioned one.
        scale: positive cost of a state that its error is divided by.

    Returns (by ``forward``):
        TensorDict with scalars ``loss_value`` and ``relative_error`` (mean absolute error over mean target).

    Examples:
        >>> import torch
        >>> from torchrl_pomdp.envs import make_problem
        >>> from torchrl_pomdp.modules import FlatEncoder, GreedyRepair, NeverRepairCost, PolicyCost, ValueNetwork
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
        self.scale = scale
        self.convert_to_functional(value, "value")

    @property
    def network(self) -> TensorDictModuleBase:
        """The module that is trained."""
        return self.value

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss and metrics of labelled states ``[*B]``; see the class."""
        batch = tensordict.reshape(-1)
        with self.value_params.to_module(self.value, preserve_module_state=False):
            value = self.value(batch.select(*self.value.in_keys)).get("state_value")
        target = batch.get(self.tensor_keys.cost_to_go)
        error = value - target
        relative = error / self.scale.costs(batch)
        return TensorDict(
            {
                "loss_value": relative.square().mean(),
                "relative_error": error.detach().abs().mean() / target.mean(),
            }
        )
