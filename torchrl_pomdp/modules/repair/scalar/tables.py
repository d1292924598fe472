"""The repair problem as tables, for compiled simulations."""

from __future__ import annotations

import numpy as np

from torchrl_pomdp.envs.repair.model import REPAIR, RepairModel
from torchrl_pomdp.envs.repair.partition import RepairPartition
from torchrl_pomdp.modules.repair.base_policies import first_moves
from torchrl_pomdp.modules.repair.scalar.view import Tables

__all__ = ["make_tables"]


def make_tables(model: RepairModel, stages: int) -> Tables:
    """What the kernel reads of a model, for so many stages."""
    chain, costs = model.chain.double().numpy(), model.costs.double().numpy()
    size, levels = model.num_locations, model.num_levels
    powers = np.empty((stages, levels, levels))
    powers[0] = np.eye(levels)
    for n in range(1, stages):
        powers[n] = powers[n - 1] @ chain
    discounts = np.power(model.discount, np.arange(stages), dtype=np.float64)
    stage_costs, interval_costs = powers @ costs, np.zeros((stages, levels))
    # What overflows is refused where it is a result.
    with np.errstate(over="ignore"):
        interval_costs[1:] = np.cumsum(discounts[:-1, None] * stage_costs[:-1], 0)
    distances = model.graph.distances.numpy()
    absorbing = model.level_zero_absorbing
    steady = absorbing and bool((chain[1:, 0] == 0).all())
    own = model.partition if isinstance(model.partition, RepairPartition) else None
    return Tables(
        powers=powers,
        cumulative=np.cumsum(powers, -1),
        stage_costs=stage_costs,
        interval_costs=interval_costs,
        discounts=discounts,
        destinations=model.destinations.numpy(),
        order=np.argsort(distances * size + np.arange(size), 1),
        distances=distances.astype(np.int64),
        first_controls=model.graph.first_controls.numpy(),
        first_moves=first_moves(model).numpy(),
        unrestricted=bool(model.legal_when_intact()[:, REPAIR].all()),
        columns=np.zeros(size) if own is None else own.columns.double().numpy(),
        prices=np.array(costs if own is None else own.prices, np.float64),
        absorbing=absorbing,
        steady=steady,
        free=steady and costs[0] == 0.0,
        upward=bool((np.tril(chain, -1) == 0).all() and costs[0] >= 0.0 and (np.diff(costs) >= 0.0).all()),
        least_cost=float(costs.min()),
        terminal_probability=model.terminal_probability,
        damage_threshold=0.0 if own is None else own.damage_threshold,
        low=0.0 if own is None else own.density_bounds[0],
        high=0.0 if own is None else own.density_bounds[1],
    )
