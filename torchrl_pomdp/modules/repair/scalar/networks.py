"""Compiled simulations of policies with networks; see :func:`~torchrl_pomdp.modules.repair.scalar.twins.networks`."""

from __future__ import annotations

from collections.abc import Sequence
from threading import Lock
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from torchrl_pomdp.envs.repair.model import RepairModel
from torchrl_pomdp.envs.repair.partition import RepairPartition
from torchrl_pomdp.modules.encoders import FlatEncoder
from torchrl_pomdp.modules.networks import LocalNetwork, PolicyNetwork
from torchrl_pomdp.modules.repair.encoders import RelativeEncoder
from torchrl_pomdp.modules.repair.scalar.engine import RepairEngine, repair_engine
from torchrl_pomdp.modules.repair.scalar.twins import greedy, networks, random
from torchrl_pomdp.modules.rowwise import RowLinear
from torchrl_pomdp.modules.scalar import Limited, SearchEngine, scalar_engine
from torchrl_pomdp.scalar.compiling import Loops
from torchrl_pomdp.scalar.noise import hash_words

__all__ = ["network_engine"]


def network_engine(policies: Sequence[Any], model: RepairModel, limits: Limited) -> SearchEngine | None:
    """The engine of local policies, one for each part, of which some are networks; None where there is no twin for them.

    Args:
        policies: ReLU networks of equal sizes and in single precision, which see the state by one :class:`RelativeEncoder` or
            :class:`~torchrl_pomdp.modules.FlatEncoder`; and at most one other policy, which has a twin. None: any legal
            control.
        model: the model that is simulated.
        limits: see :func:`~torchrl_pomdp.modules.scalar.scalar_engine`.
    """
    if not policies:
        return repair_engine(random, (), model, model, limits)
    parts = 1 if model.partition is None else model.partition.num_parts
    own = list(dict.fromkeys(policy for policy in policies if type(policy) is PolicyNetwork))
    others = list(dict.fromkeys(policy for policy in policies if policy not in own))
    # Another network is asked for its engine by coming here again.
    if len(policies) not in (1, parts) or any(isinstance(policy, LocalNetwork) for policy in others):
        return None
    base = scalar_engine(others[0], model, limits) if len(others) == 1 else None
    if not own:
        return base
    features = _features(own[0].encoder, model)
    unknown = len(others) > 1 or (others and not isinstance(base, RepairEngine))
    unknown = unknown or (len(policies) > 1 and type(model.partition) is not RepairPartition)
    if unknown or features is None or not _alike(own) or own[0].network[-1].out_features != model.num_controls:
        return None
    which = np.array([own.index(policy) if policy in own else -1 for policy in policies])
    layers = [[layer for layer in network.network if isinstance(layer, nn.Linear)] for network in own]
    columns, places, robot_features, whole = features
    widest = max(len(columns) * model.num_levels + 1, *(layer.out_features for layer in layers[0]))
    source = _Weights(layers)
    policy, numbers = (base.policy, base.numbers) if isinstance(base, RepairEngine) else ((greedy, (0.0,)), 1)
    data = which, columns, places, robot_features, whole, source.weights, source.biases, policy
    numbers = max(numbers, 3 * model.num_robots * widest)
    return repair_engine(networks, data, model, model, limits, numbers=numbers, refresh=source.refresh)


def _features(encoder: Any, model: RepairModel) -> tuple[NDArray[np.int64], NDArray[np.int64], int, bool] | None:
    """What is which feature of an encoder.

    Which one is each number of the belief, ``[L, L * K]`` by a robot's location, and the location itself, ``[L]``; how many a
    robot has; and whether they are the probabilities, or tell of level 0 whether damage is possible.
    """
    size, levels = model.num_locations, model.num_levels
    if type(encoder) is RelativeEncoder:
        known = encoder.columns.shape == (size, size * levels) and encoder.num_robots == model.num_robots
        return (encoder.columns.numpy(), encoder.places.numpy(), encoder.robot_features, False) if known else None
    if type(encoder) is FlatEncoder and encoder.num_features == size * (levels + model.num_robots):
        columns = np.broadcast_to(np.arange(size * levels), (size, size * levels)).copy()
        # Beliefs are seen once, and then a location by each robot.
        return columns, np.arange(size * levels, size * (levels + 1)), size, True
    return None


def _alike(own: Sequence[PolicyNetwork]) -> bool:
    """Whether all networks have one encoder, the same sizes in single precision, and ReLUs between linear layers alone."""
    layers = [tuple(map(type, network.network)) for network in own]
    plain = all(kinds == (*(RowLinear, nn.ReLU) * (len(kinds) // 2), RowLinear) for kinds in layers)
    shapes = [[tuple(p.shape) for p in network.network.parameters()] for network in own]
    single = all(p.dtype == torch.float32 for network in own for p in network.network.parameters())
    return plain and single and all(n.encoder is own[0].encoder for n in own) and all(each == shapes[0] for each in shapes)


class _Weights:
    """Weights of networks as the twin reads them, brought up to date when they have changed."""

    def __init__(self, layers: Sequence[Sequence[nn.Linear]]) -> None:
        self.layers = [list(each) for each in zip(*layers, strict=True)]
        # Weights [network, in, out] and biases [network, out] of every layer, filled before the first simulation.
        sizes = [(len(each), each[0].in_features, each[0].out_features) for each in self.layers]
        self.weights = tuple(np.empty(size, np.float32) for size in sizes)
        self.biases = tuple(np.empty((count, size), np.float32) for count, _, size in sizes)
        # Where the layers keep them, and a hash of what was copied from there.
        self._where: list[int] = []
        self._memory: tuple[NDArray[np.uint32], ...] = ()
        self._copied: int | None = None
        self._loops, self._lock = Loops(), Lock()

    def refresh(self) -> None:
        """Copy the weights again if they have changed.

        Versions of tensors do not tell: what is written through ``.data``, as TorchRL does, raises none.
        """
        # Several threads may share a rollout.
        with self._lock:
            self._refresh()

    def _refresh(self) -> None:
        now = [p for each in self.layers for layer in each for p in (layer.weight, layer.bias)]
        where = [p.data_ptr() for p in now]
        whole = all(p.is_contiguous() for p in now)
        if where != self._where or not whole:
            self._where = where if whole else []
            self._memory = tuple(np.ascontiguousarray(p.detach().numpy()).reshape(-1).view(np.uint32) for p in now)
        content = self._loops(hash_words, self._memory)
        if content == self._copied:
            return
        self._copied = None
        for each, weight, bias in zip(self.layers, self.weights, self.biases, strict=True):
            for number, layer in enumerate(each):
                weight[number] = layer.weight.detach().T.numpy()
                bias[number] = layer.bias.detach().numpy()
            for values in (weight, bias):
                if not np.isfinite(values).all():
                    wrong = values[~np.isfinite(values)][0]
                    raise ValueError(f"logits of a network must be finite, got {wrong}: a weight is no number")
        self._copied = content
