"""What the networks see of a repair problem (paper, Sections IV and VI-C)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.envs.repair.chains import location_costs, prices
from torchrl_pomdp.envs.repair.graphs import Graph
from torchrl_pomdp.envs.repair.model import REPAIR, RepairModel
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.modules.agents import AgentEncoder
from torchrl_pomdp.modules.encoders import Encoder, transformed
from torchrl_pomdp.modules.rowwise import affine, align, align_terms, product

__all__ = ["RelativeEncoder", "RobotEncoder"]


# Offsets that differ by less than this fraction of the graph's size are the same: coordinates are rounded.
_SAME = 1e-5
# Powers of the nearness by which a robot weighs what is far away.
_POWERS = 3
# Most features of a window: a first layer of a hundred million weights.
_MOST_FEATURES = 1 << 19


class RelativeEncoder(Encoder):
    """The repair problem as each robot sees it: what is known of the location at every offset from the robot.

    What to do with damage two steps to the left hardly depends on where on the pipeline the robot stands; with a window
    centred at the robot the network need not learn it anew for each location. An offset has K features: whether damage is
    possible at all and the probabilities of the damaged levels; offsets outside the graph are zero. The robot's location
    follows, one-hot.

    Args:
        model: the repair model; offsets are differences of its graph's columns and rows.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> encoder = RelativeEncoder(problem.model)
        >>> encoder.num_features == 39 * 5 + 20, encoder(problem.start(torch.arange(6))).shape
        (True, torch.Size([6, 215]))
    """

    keys = ("belief", "location")
    columns: Tensor
    places: Tensor

    def __init__(self, model: RepairModel) -> None:
        super().__init__()
        check_instance("model", model, RepairModel)
        self.num_levels, self.num_locations, self.num_robots = model.num_levels, model.num_locations, model.num_robots
        self.dtype = model.dtype
        size, levels = self.num_locations, self.num_levels
        offsets = _offsets(model.graph)
        if int(offsets.max()) * levels > _MOST_FEATURES:
            raise ValueError(
                f"model has {int(offsets.max()) + 1} different offsets between locations, too many: use FlatEncoder"
            )
        # [L, L * K] for a robot at a location: which feature each number of the belief is; and the location's own.
        columns = (offsets.unsqueeze(-1) * levels + torch.arange(levels)).flatten(1)
        places = (int(offsets.max()) + 1) * levels + torch.arange(size)
        self.register_buffer("columns", columns.to(model.device), persistent=False)
        self.register_buffer("places", places.to(model.device), persistent=False)
        # On a line the features are neighbours, which saves a copy; the first one then.
        ranges = (columns.diff() == 1).all(-1).tolist()
        self.neighbouring = [int(row[0]) if range else None for row, range in zip(columns, ranges, strict=True)]
        self.robot_features = int(places[-1]) + 1
        self.num_features = self.num_robots * self.robot_features

    def encode_rows(self, y: TensorDictBase, rows: Tensor | None) -> Tensor:
        """See :class:`Encoder`."""
        numbers, location = self.numbers(y.get("belief")), y.get("location")
        return self.windows(numbers, location) if rows is None else self.windows(numbers[rows], location[rows])

    def windows(self, numbers: Tensor, location: Tensor) -> Tensor:
        """Features ``[M, F]`` of what is known of the locations, see :meth:`numbers`, by robots at ``location`` ``[M, R]``."""
        features = numbers.new_zeros(len(numbers), self.num_robots, self.robot_features)
        known = numbers[:, : self.columns.shape[1]].unsqueeze(1).expand(-1, self.num_robots, -1)
        features = features.scatter(-1, self.columns[location], known)
        return features.scatter(-1, self.places[location].unsqueeze(-1), 1.0).flatten(1)

    def numbers(self, belief: Tensor) -> Tensor:
        """What a window shows of every location of ``belief`` ``[N, L, K]``: ``[N, L * K]``, and zeros that align the rows."""
        # A transposition of two dimensions is much faster than a general permutation.
        planes = belief.permute(1, 2, 0).flatten(0, 1)
        numbers = belief.new_zeros(len(belief), align_terms(len(planes)))
        numbers[:, : len(planes)] = planes.T
        numbers[:, : len(planes) : self.num_levels] = 1.0 - planes.T[:, :: self.num_levels].floor()
        return numbers

    def seen_from(self, place: int, weight: Tensor, count: int) -> Tensor:
        """Those rows of the weights ``[F + count, H]`` that :meth:`numbers`, ``count`` of them, meet from a location."""
        first = self.neighbouring[place]
        if first is not None:
            return weight.narrow(0, first, count)
        return weight.index_select(0, nn.functional.pad(self.columns[place], (0, count - self.columns.shape[1])))

    def first_layers(
        self, y: TensorDictBase, rows: Tensor, layers: Sequence[nn.Linear], counts: Sequence[int]
    ) -> list[tuple[Tensor, Tensor | None]]:
        """See :class:`Encoder`. On a CPU the rows are grouped by location.

        Robots at one location see the same offsets, the others' features are zero: a group is multiplied by the few rows of
        the weights that matter to it, and no window is ever made.
        """
        belief, location = y.get("belief"), y.get("location")
        if rows.device.type != "cpu" or belief.requires_grad or transformed():
            return super().first_layers(y, rows, layers, counts)
        numbers = self.numbers(belief)
        return [
            _WindowLayer.apply(layer.weight, layer.bias, self, numbers, location, own)
            for layer, own in zip(layers, rows.split(list(counts)), strict=True)
        ]


class _WindowLayer(torch.autograd.Function):
    """A linear layer on the windows of :class:`RelativeEncoder` at chosen rows, computed without them; the gradient with them.

    Both with and without gradients the outputs are these, to the last bit.
    """

    @staticmethod
    def forward(
        ctx: Any, weight: Tensor, bias: Tensor, encoder: RelativeEncoder, numbers: Tensor, location: Tensor, rows: Tensor
    ) -> tuple[Tensor, Tensor]:
        location = location[rows]
        output, places = _robot_output(encoder, numbers, rows, location[:, 0], weight, bias, 0)
        for robot in range(1, encoder.num_robots):
            other, found = _robot_output(encoder, numbers, rows, location[:, robot], weight, None, robot)
            output.index_add_(0, places, other.index_select(0, found))
        ctx.encoder = encoder
        ctx.save_for_backward(numbers, location, rows, places)
        ctx.mark_non_differentiable(places)
        return output, places

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, output: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        numbers, location, rows, places = ctx.saved_tensors
        features = ctx.encoder.windows(numbers[rows], location)
        output = output.index_select(0, places)
        return output.T @ features, output.sum(0), None, None, None, None


def _robot_output(
    encoder: RelativeEncoder,
    numbers: Tensor,
    rows: Tensor,
    location: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    robot: int,
) -> tuple[Tensor, Tensor]:
    """A robot's share of a layer at ``rows`` ``[M]``, where it stands at ``location`` ``[M]``.

    Rows of one location are neighbours, each location's filled up to a multiple of 16.

    Returns:
        outputs ``[P, H]``, and the places ``[M]`` of the rows among them.
    """
    groups = location.bincount(minlength=encoder.num_locations)
    sizes = [align(count) if count else 0 for count in groups.tolist()]
    starts = torch.tensor(sizes).cumsum(0) - torch.tensor(sizes)
    order = location.argsort(stable=True)
    within = torch.arange(len(rows)) - (groups.cumsum(0) - groups)[location[order]]
    places = torch.empty_like(rows).index_copy_(0, order, starts[location[order]] + within)
    source = rows.new_zeros(sum(sizes)).index_copy_(0, places, rows)
    x = numbers.index_select(0, source)
    wide = align(weight.shape[0])
    own = weight.new_zeros(encoder.robot_features + numbers.shape[1], wide)
    own[: encoder.robot_features, : weight.shape[0]] = weight.T[robot * encoder.robot_features :][: encoder.robot_features]
    offset = own[encoder.places]
    if bias is not None:
        offset[:, : len(bias)] += bias
    output = x.new_empty(len(x), wide)
    for place, (start, size) in enumerate(zip(starts.tolist(), sizes, strict=True)):
        if size:
            block = slice(start, start + size)
            affine(x[block], encoder.seen_from(place, own, x.shape[1]), offset[place], out=output[block])
    # No view: what follows may overwrite it.
    return output if wide == weight.shape[0] else output[:, : weight.shape[0]].contiguous(), places


def _offsets(graph: Graph) -> Tensor:
    """Number of the offset from every location to every location, ``[L, L]``, numbered row by row."""
    across, down = (c.double().unsqueeze(0) - c.double().unsqueeze(1) for c in (graph.columns, graph.rows))
    for rounding in (_SAME, 0.0):
        offsets = (_ranks(down, rounding) * across.numel() + _ranks(across, rounding)).unique(return_inverse=True)[1]
        # Locations that are closer than the rounding must not be taken for one.
        if bool((offsets.sort(-1).values.diff() > 0).all()):
            return offsets
    raise ValueError(
        "model must have a graph whose columns and rows tell its locations apart from everywhere, got one that rounds"
    )


def _ranks(values: Tensor, rounding: float) -> Tensor:
    """Numbers from the smallest on, those that differ by rounding alone being the same."""
    ordered, inverse = values.unique(return_inverse=True)
    larger = ordered.diff() > rounding * float(ordered.abs().max())
    return nn.functional.pad(larger.cumsum(0), (1, 0))[inverse]


class RobotEncoder(AgentEncoder):
    r"""What a robot among many sees: what is known of all locations, where the damage lies from where it stands, who else does
    what.

    Features of the state are, for every location, whether damage is possible, the probabilities of the damaged levels, and how
    many robots are there. A robot's own features say for each of its controls how much damage lies that way, near or far:
    with :math:`c_l` the extra cost of location l, d the way to it and the sum over the locations that a shortest path through
    the control leads to,

    .. math:: \log\Bigl(1+\sum_l c_l\,(d+1)^{-p}\Bigr),\qquad \log\Bigl(1+\sum_l c_l\,(d+1)^{-p}/n_l\Bigr),

    p = 1, 2, 3, where :math:`n_l=\sum_r(d_r+1)^{-3}` counts the robots near l. Marks are the robot's number and location, and
    of earlier robots the locations that they go to or repair.

    Args:
        model: the repair model.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> encoder = RobotEncoder(make_problem("network32x10").model)
        >>> encoder.num_features, encoder.num_own, encoder.num_marks
        (192, 30, 106)
    """

    keys = ("belief", "location")
    model: RepairModel
    ways: Tensor
    nearness: Tensor

    def __init__(self, model: RepairModel) -> None:
        super().__init__()
        self.model = check_instance("model", model, RepairModel)
        self.dtype = model.dtype
        size, count = model.num_locations, model.num_robot_controls
        self.num_features, self.num_marks = size * (model.num_levels + 1), model.num_robots + 3 * size
        self.num_own = 2 * _POWERS * count
        self._prices = prices(model.costs - model.costs[..., :1])
        near = (model.graph.distances.to(model.device, model.dtype) + 1.0).reciprocal()
        powers = torch.stack([near**power for power in range(1, _POWERS + 1)], -1)
        first = torch.nn.functional.one_hot(model.first_controls, count).to(model.dtype)
        # [L, L * A * P]: what a location's cost is to a robot at every location, by its controls and the powers.
        ways = (first.unsqueeze(-1) * powers.unsqueeze(-2)).flatten(2)
        self.register_buffer("ways", ways.transpose(0, 1).flatten(1).contiguous(), persistent=False)
        self.register_buffer("nearness", powers[..., -1].contiguous(), persistent=False)

    def encode_rows(self, y: TensorDictBase, rows: Tensor | None) -> Tensor:
        """See :class:`~torchrl_pomdp.modules.Encoder`."""
        belief, location = y.get("belief"), y.get("location")
        # A transposition of two dimensions is much faster than a general permutation; what is written into is a copy.
        planes = belief.permute(1, 2, 0).flatten(0, 1)
        known = planes.T.clone(memory_format=torch.contiguous_format)
        known[:, :: self.model.num_levels] = 1.0 - known[:, :: self.model.num_levels].floor()
        robots = known.new_zeros(len(known), self.model.num_locations)
        robots.scatter_add_(1, location, torch.ones_like(location, dtype=self.dtype))
        features = torch.cat([known, robots], -1)
        return features if rows is None else features.index_select(0, rows)

    def own_features(self, y: TensorDictBase) -> Tensor:
        """How much damage lies each way; see the class."""
        belief, location = y.get("belief"), y.get("location")
        costs = location_costs(belief.permute(1, 2, 0), self._prices).T.clamp_min(0.0)
        robots = self.nearness.index_select(0, location.T.flatten()).view(*location.T.shape, len(self.nearness))
        shared = costs / sum_first(robots.clone())
        place = location.unsqueeze(-1).expand(-1, -1, self.num_own // 2)
        shape = len(location), self.model.num_locations, self.num_own // 2
        seen = [product(each.contiguous(), self.ways).view(shape) for each in (costs, shared)]
        return torch.cat([each.gather(1, place) for each in seen], -1).clamp_min(0.0).log1p()

    def own_marks(self, y: TensorDictBase) -> Tensor:
        """The robot's number, and its location."""
        location = y.get("location")
        number = torch.arange(self.model.num_robots, device=location.device).expand_as(location)
        return torch.stack([number, self.model.num_robots + location], -1)

    def choice_marks(self, y: TensorDictBase, agents: slice, controls: Tensor) -> Tensor:
        """The location that the robot goes to, or repairs."""
        model = self.model
        target = model.destinations[y.get("location")[:, agents], controls]
        place = model.num_robots + model.num_locations * (1 + (controls == REPAIR).long()) + target
        return place.unsqueeze(-1)
