"""The repair problem as tables, for compiled simulations."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrl_pomdp.envs.repair.chains import chain_powers
from torchrl_pomdp.envs.repair.model import REPAIR, RepairModel
from torchrl_pomdp.envs.repair.partition import RepairPartition
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.modules.repair.base_policies import first_moves
from torchrl_pomdp.modules.repair.scalar.view import Tables

__all__ = ["by_location", "kinds", "make_tables"]


def by_location(values: Tensor | Sequence[float], model: RepairModel) -> NDArray[np.float64]:
    """Numbers for the levels, ``[K]`` or ``[L, K]``, as ``[L, K]``."""
    own = torch.as_tensor(values, dtype=torch.float64).numpy()
    return np.array(np.broadcast_to(own, (model.num_locations, model.num_levels)), order="C")


def kinds(model: RepairModel) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The first location of each kind, ``[J]``, and the kind of each location, ``[L]``.

    Kinds differ in their chains, or in their costs, be it those of the partition.
    """
    size = model.num_locations
    own = [by_location(model.costs, model), _prices(model)]
    if model.chain.ndim == 3:
        own.append(model.chain.double().numpy().reshape(size, -1))
    _, first, kind = np.unique(np.concatenate(own, 1), axis=0, return_index=True, return_inverse=True)
    return first, kind.reshape(size)


def _prices(model: RepairModel) -> NDArray[np.float64]:
    """Cost of every level as the partition has them, ``[L, K]``."""
    own = model.partition
    return by_location(own.prices if isinstance(own, RepairPartition) else model.costs, model)


def make_tables(model: RepairModel, stages: int) -> Tables:
    """What the kernel reads of a model, for so many stages."""
    size, levels = model.num_locations, model.num_levels
    first, kind = kinds(model)
    chain = np.broadcast_to(model.chain.double().numpy(), (size, levels, levels))[first]
    costs, prices = by_location(model.costs, model)[first], _prices(model)
    discounts = np.power(model.discount, np.arange(stages), dtype=np.float64)
    powers = chain_powers(torch.from_numpy(chain), stages - 1).movedim(0, 1)
    stage_costs, extra_costs = _expected(powers, costs), _expected(powers, costs - costs[:, :1])
    damage = np.zeros_like(stage_costs)
    for k in range(levels):
        # Summed as the loop sums what it does not read here.
        damage += powers[..., k].numpy() * prices[first, None, None, k]
    distances = model.graph.distances.numpy()
    steady = bool((chain[:, 0, 0] == 1).all() and (chain[:, 1:, 0] == 0).all())
    own = model.partition if isinstance(model.partition, RepairPartition) else None
    return Tables(
        kind=kind,
        powers=np.ascontiguousarray(powers.numpy()),
        cumulative=np.cumsum(powers.numpy(), -1),
        stage_costs=stage_costs,
        extra_costs=extra_costs,
        interval_costs=_interval_costs(stage_costs, discounts),
        discounts=discounts,
        destinations=model.destinations.numpy(),
        order=np.argsort(distances * size + np.arange(size), 1),
        distances=distances.astype(np.int64),
        first_controls=model.graph.first_controls.numpy(),
        first_moves=first_moves(model).numpy(),
        unrestricted=bool(model.legal_when_intact()[:, REPAIR].all()),
        columns=np.zeros(size) if own is None else own.columns.double().numpy(),
        prices=prices,
        damage=damage,
        works=model.repair_probability,
        ends=model.ends,
        steady=steady,
        free=steady and bool((costs[:, 0] == 0.0).all()),
        upward=bool((np.tril(chain, -1) == 0).all() and (costs[:, 0] >= 0.0).all() and (np.diff(costs) >= 0.0).all()),
        least_cost=float(costs.min()),
        terminal_probability=model.terminal_probability,
        forgiven=_forgiven(model, costs) if model.ends else 0.0,
        damage_threshold=0.0 if own is None else own.damage_threshold,
        low=0.0 if own is None else own.density_bounds[0],
        high=0.0 if own is None else own.density_bounds[1],
    )


def _forgiven(model: RepairModel, costs: NDArray[np.float64]) -> float:
    r"""The most that damage can cost, more than none, where its probability anywhere is at most :math:`\epsilon`.

    Probabilities of damage :math:`p_i` with :math:`1-\prod(1-p_i)\le\epsilon` have a sum of at most
    :math:`-\ln(1-\epsilon)`.
    """
    return -math.log1p(-model.terminal_probability) * float(costs.max()) / (1.0 - model.discount)


def _expected(powers: Tensor, costs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Expected costs ``[J, n, K]`` n stages after each level, by powers ``[J, n, K, K]`` and costs ``[J, K]`` of the kinds."""
    weighted = powers * torch.from_numpy(costs)[:, None, None]
    return np.ascontiguousarray(sum_first(weighted.movedim(-1, 0)).numpy())


def _interval_costs(stage_costs: NDArray[np.float64], discounts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Discounted costs ``[J, n, K]`` of the n stages after each level, by those of a stage and discounts ``[n]``."""
    interval_costs = np.zeros_like(stage_costs)
    # What overflows is refused where it is a result.
    with np.errstate(over="ignore"):
        interval_costs[:, 1:] = np.cumsum(discounts[:-1, None] * stage_costs[:, :-1], 1)
    return interval_costs
