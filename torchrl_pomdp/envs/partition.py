"""Partitions of the feature space (paper, Section V; for repair problems Section VI-B).

The index of the part that holds a feature state is itself a feature: ``y["partition"]``. Policies and values are
routed by it, and training proceeds in stages of parts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_pomdp.envs.graphs import Graph
from torchrl_pomdp.envs.sums import sum_first

__all__ = ["Partition", "RepairPartition", "SinglePart"]


class Partition(nn.Module, ABC):
    r"""Disjoint sets :math:`Y_1,\dots,Y_N` that cover the feature space.

    Attributes:
        names: one name for each part; their number is N.
        stages: groups of parts in the order in which they are trained. States of a stage lead only to parts of the
            same or earlier stages.
    """

    names: tuple[str, ...]
    stages: tuple[tuple[int, ...], ...]

    @property
    def num_parts(self) -> int:
        """N, the number of parts."""
        return len(self.names)

    @abstractmethod
    def forward(self, y: TensorDictBase) -> Tensor:
        """Part index of every feature state, int64 ``[*B]``."""


class SinglePart(Partition):
    """The trivial partition, N = 1: partitioned algorithms become the plain ones.

    Examples:
        >>> from tensordict import TensorDict
        >>> SinglePart()(TensorDict({"belief": torch.ones(2, 3)}, [2])).tolist()
        [0, 0]
    """

    names = ("all",)
    stages = ((0,),)

    def forward(self, y: TensorDictBase) -> Tensor:
        """Zeros, int64 ``[*B]``."""
        return torch.zeros(y.batch_size, dtype=torch.int64, device=y.device)


class RepairPartition(Partition):
    r"""The six parts of the pipeline problem (paper, Section VI-B).

    *Phase*: a state is an endgame state if fewer than half of the locations are believed damaged, that is
    :math:`1-b(0)>` ``damage_threshold``. With the threshold at zero and level 0 absorbing the count never grows, so
    endgame states lead only to endgame states and the endgame parts are trained first.

    *Density*: with LD and RD the expected costs left and right of the robot, LD/(LD+RD) above 0.7, in between, or below
    0.3; LD+RD = 0 counts as balanced. "Left" is by column, for several robots relative to their mean column.

    Args:
        graph: where the robots are; its columns define left and right.
        costs: cost of each damage level, ``[K]``.
        damage_threshold: probability of damage above which a location is believed damaged.
        device: where the tables are.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
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
        if not 0.0 <= damage_threshold < 1.0:
            raise ValueError(f"damage_threshold must be in [0, 1), got {damage_threshold}")
        self.damage_threshold = damage_threshold
        self._prices = tuple(costs.tolist())
        self.register_buffer("columns", graph.columns.to(device), persistent=False)

    def forward(self, y: TensorDictBase) -> Tensor:
        """Part index int64 ``[*B]``: three times the phase (0 startgame, 1 endgame) plus the density class."""
        belief, location = y.get("belief"), y.get("location")
        # A view [L, K, *B]: the model keeps the batch innermost.
        planes = belief.movedim((-2, -1), (0, 1))
        # floor is exact and, like all arithmetic, much faster than comparisons of this size.
        num_intact = sum_first((planes[:, 0] + self.damage_threshold).floor())
        endgame = 2 * num_intact > belief.shape[-2]
        return 3 * endgame.to(torch.int64) + self._density(planes, location)

    def _density(self, planes: Tensor, location: Tensor) -> Tensor:
        """0 where the damage is mostly left, 1 where balanced, 2 where mostly right: int64 ``[*B]``."""
        cost = location_costs(planes, self._prices)
        column = self.columns.view(-1, *([1] * (cost.ndim - 1)))
        centre = self.columns[location].mean(-1)
        # 1 left of the robots, 0 at and right of them: their mean column is a multiple of 1 / R.
        side = (centre - column) * location.shape[-1]
        left, right = sum_first(cost * side.clamp(0, 1)), sum_first(cost * side.neg_().clamp_(0, 1))
        low, high = self.density_bounds
        total = left + right
        # Cross-multiplied, so that no damage on either side (total = 0) is balanced.
        return 1 - (left > high * total).to(torch.int64) + (left < low * total).to(torch.int64)


def location_costs(planes: Tensor, costs: Sequence[float]) -> Tensor:
    """Expected cost of every location, ``[L, *B]``, for beliefs as planes ``[L, K, *B]`` and a cost for each level."""
    paid = [level for level, cost in enumerate(costs) if cost != 0]
    if not paid:
        return torch.zeros_like(planes[:, 0])
    total = planes[:, paid[0]] * costs[paid[0]]
    for level in paid[1:]:
        total.add_(planes[:, level], alpha=costs[level])
    return total
