"""Compiled simulations of policies with networks; see :func:`~torchrl_pomdp.modules.repair.scalar.twins.networks`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.repair.model import RepairModel
from torchrl_pomdp.envs.repair.partition import RepairPartition
from torchrl_pomdp.modules.networks import PolicyNetwork
from torchrl_pomdp.modules.repair.scalar.engine import RepairEngine, repair_engine
from torchrl_pomdp.modules.repair.scalar.twins import greedy, networks
from torchrl_pomdp.modules.scalar import Limited, scalar_engine

if TYPE_CHECKING:
    from torchrl_pomdp.modules.repair.encoders import RelativeEncoder

__all__ = ["network_engine"]


def network_engine(
    encoder: RelativeEncoder, policies: Sequence[Any], model: BeliefModel, limits: Limited
) -> RepairEngine | None:
    """The engine of local policies, one for each part, of which some are networks; None where there is no twin for them.

    Args:
        encoder: of all networks.
        policies: networks of equal sizes in single precision, and at most one other policy, which has a twin.
        model: the model that is simulated.
        limits: see :func:`~torchrl_pomdp.modules.scalar.scalar_engine`.
    """
    own = list(dict.fromkeys(policy for policy in policies if type(policy) is PolicyNetwork))
    others = list(dict.fromkeys(policy for policy in policies if policy not in own))
    if len(others) > 1 or not isinstance(model, RepairModel) or not _alike(own, encoder):
        return None
    if (
        encoder.columns.shape != (model.num_locations, model.num_locations * model.num_levels)
        or encoder.num_robots != model.num_robots
    ):
        return None
    if len(policies) > 1 and (type(model.partition) is not RepairPartition or model.partition.num_parts != len(policies)):
        return None
    base: Any = (greedy, (0.0,))
    numbers = 1
    if others:
        engine = scalar_engine(others[0], model, limits)
        if not isinstance(engine, RepairEngine):
            return None
        base, numbers = engine.policy, engine.numbers
    which = np.array([own.index(policy) if policy in own else -1 for policy in policies])
    layers = [[layer for layer in network.network if isinstance(layer, nn.Linear)] for network in own]
    widest = max(encoder.num_robots * (encoder.columns.shape[1] + 1), *(layer.out_features for layer in layers[0]))
    source = _Weights(layers)
    data = which, encoder.columns.numpy(), encoder.places.numpy(), encoder.robot_features, *source.arrays(), base
    return repair_engine(networks, data, model, model, limits, numbers=max(numbers, 3 * widest), refresh=source.refresh)


def _alike(own: Sequence[PolicyNetwork], encoder: RelativeEncoder) -> bool:
    """Whether all networks have this encoder, and the same sizes in single precision."""
    shapes = [[tuple(p.shape) for p in network.network.parameters()] for network in own]
    single = all(p.dtype == torch.float32 for network in own for p in network.network.parameters())
    return single and all(network.encoder is encoder for network in own) and all(each == shapes[0] for each in shapes)


class _Weights:
    """Weights of networks as the twin reads them, brought up to date when they have changed."""

    def __init__(self, layers: Sequence[Sequence[nn.Linear]]) -> None:
        self.layers = [list(each) for each in zip(*layers, strict=True)]
        self.weights = tuple(self._stacked([layer.weight.T for layer in each]) for each in self.layers)
        self.biases = tuple(self._stacked([layer.bias for layer in each]) for each in self.layers)
        self._versions = self._now()

    def arrays(self) -> tuple[Any, Any]:
        """Weights ``[network, in, out]`` and biases ``[network, out]`` of every layer."""
        return self.weights, self.biases

    def refresh(self) -> None:
        """Copy the weights again if they have changed."""
        if (versions := self._now()) == self._versions:
            return
        self._versions = versions
        for each, weight, bias in zip(self.layers, self.weights, self.biases, strict=True):
            for number, layer in enumerate(each):
                weight[number] = layer.weight.detach().T.numpy()
                bias[number] = layer.bias.detach().numpy()

    def _now(self) -> list[tuple[int, int]]:
        return [(p.data_ptr(), p._version) for each in self.layers for layer in each for p in (layer.weight, layer.bias)]

    @staticmethod
    def _stacked(tensors: Sequence[Tensor]) -> Any:
        return torch.stack([tensor.detach() for tensor in tensors]).contiguous().numpy()
