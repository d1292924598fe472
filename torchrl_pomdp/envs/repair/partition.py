"""The parts of the repair problem (paper, Section VI-B)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance, check_number
from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.envs.repair.chains import location_costs, prices
from torchrl_pomdp.envs.repair.graphs import Graph
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.tensor_checks import check_device, check_entries, check_tensor

__all__ = ["RepairPartition"]

# How many different columns a plan can have from its left to its right edge.
_COLUMN_UNITS = 2.0**18


class RepairPartition(Partition):
    r"""The six parts of the pipeline problem (paper, Section VI-B).

    *Phase*: a state is an endgame state if fewer than half of the locations are believed damaged, that is
    :math:`1-b(0)>` ``damage_threshold``. With the threshold at zero and level 0 absorbing the count never grows, so
    endgame states lead only to endgame states and the endgame parts are trained first.

    *Density*: with LD and RD the expected costs left and right of the robot, LD/(LD+RD) above 0.7, in between, or below
    0.3; LD+RD = 0 counts as balanced. "Left" is by column, for several robots relative to their mean column.

    Args:
        graph: where the robots are; its columns define left and right.
        costs: cost of each damage level, ``[K]``; or ``[L, K]``, different by location.
        damage_threshold: probability of damage above which a location is believed damaged.
        device: where the tables are.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``costs`` are not finite and nonnegative or ``damage_threshold`` is not in [0, 1).

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> problem.model.partition.names[0], problem.model.partition.stages
        ('startgame left', ((3, 4, 5), (0, 1, 2)))
    """

    names = (
        "startgame left",
        "startgame balanced",
        "startgame right",
        "endgame left",
        "endgame balanced",
        "endgame right",
    )
    stages = ((3, 4, 5), (0, 1, 2))
    density_bounds = (0.3, 0.7)
    columns: Tensor

    def __init__(
        self, graph: Graph, costs: Tensor, *, damage_threshold: float = 0.0, device: torch.device | str = "cpu"
    ) -> None:
        super().__init__()
        check_instance("graph", graph, Graph)
        self.damage_threshold = check_number("damage_threshold", damage_threshold, "[0, 1)")
        costs = check_tensor("costs", costs, finite=False).detach().clone()
        shapes = costs.ndim == 1 or (costs.ndim == 2 and len(costs) == graph.num_locations)
        if not shapes or costs.shape[-1] < 2:
            raise ValueError(
                f"costs must be for at least 2 levels, of all locations or of each of {graph.num_locations}, "
                f"got shape {tuple(costs.shape)}"
            )
        if not bool((torch.isfinite(costs.float()) & (costs >= 0)).all()):
            raise ValueError(f"costs must be finite and nonnegative for at least 2 levels, got {costs.tolist()}")
        self.num_levels = costs.shape[-1]
        self.prices = prices(costs.float().to(check_device("device", device)) if costs.ndim == 2 else costs)
        # In units below which two columns count as equal: coordinates are rounded.
        columns = graph.columns.double() - graph.columns.double().min()
        columns = columns / (float(columns.max()) or 1.0) * _COLUMN_UNITS
        self.register_buffer("columns", columns.float().to(check_device("device", device)), persistent=False)

    def check_fits(self, num_locations: int, num_levels: int, device: torch.device) -> None:
        """Raise unless this is a partition for so many locations and levels, on the same device."""
        own = len(self.columns), self.num_levels
        if own != (num_locations, num_levels):
            raise ValueError(
                f"partition must be for {num_locations} locations and {num_levels} levels as the model is, "
                f"got one for {own[0]} locations and {own[1]} levels"
            )
        if self.columns.device != device:
            raise ValueError(f"partition must be on the model's device {device}, got one on {self.columns.device}")

    def forward(self, y: TensorDictBase) -> Tensor:
        """Part index int64 ``[*B]``: three times the phase (0 startgame, 1 endgame) plus the density class."""
        check_entries("y", y, ("belief", "location"))
        belief, location = y.get("belief"), y.get("location")
        # A view [L, K, *B]: the model keeps the batch innermost.
        planes = belief.movedim((-2, -1), (0, 1))
        # floor is exact and, like all arithmetic, much faster than comparisons of this size.
        num_intact = sum_first((planes[:, 0] + self.damage_threshold).floor())
        endgame = 2 * num_intact > belief.shape[-2]
        return 3 * endgame.to(torch.int64) + self._density(planes, location)

    def _density(self, planes: Tensor, location: Tensor) -> Tensor:
        """0 where the damage is mostly left, 1 where balanced, 2 where mostly right: int64 ``[*B]``."""
        cost = location_costs(planes, self.prices)
        column = self.columns.view(-1, *([1] * (cost.ndim - 1)))
        # R times the robots' mean column.
        centre = sum_first(self.columns[location].movedim(-1, 0).clone())
        # At least 1 left of the robots, 0 at them, at most -1 right of them.
        side = (centre - column * location.shape[-1]).trunc_()
        left, right = sum_first(cost * side.clamp(0, 1)), sum_first(cost * side.neg_().clamp_(0, 1))
        low, high = self.density_bounds
        total = left + right
        # Cross-multiplied, so that no damage on either side (total = 0) is balanced.
        return 1 - (left > high * total).to(torch.int64) + (left < low * total).to(torch.int64)
