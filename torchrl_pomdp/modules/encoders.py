r"""Encoders: what the networks see of the feature state (paper, Sections IV and VI-C)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Categorical

from torchrl_pomdp.envs.belief import BeliefModel
from torchrl_pomdp.envs.graphs import Graph
from torchrl_pomdp.envs.repair import RepairModel

__all__ = ["Encoder", "FlatEncoder", "RelativeEncoder", "rowwise"]

# BLAS multiplies a handful of rows by another kernel, which rounds differently: with at least this many rows the
# output of a row does not depend on the batch it is in.
_MIN_ROWS = 16


class Encoder(nn.Module):
    """Maps feature states ``[*B]`` to vectors ``[*B, num_features]``, reading the entries ``keys``."""

    keys: tuple[str, ...]
    num_features: int

    def forward(self, y: TensorDictBase) -> Tensor:
        """Features ``[*B, F]`` of feature states ``[*B]``."""
        return self.encode_rows(y.reshape(-1), None).reshape(*y.batch_size, self.num_features)

    @abstractmethod
    def encode_rows(self, y: TensorDictBase, rows: Tensor | None) -> Tensor:
        """Features ``[M, F]`` of the rows ``rows`` (int64 ``[M]``, in that order; None: all) of a flat batch ``[N]``."""

    def first_layers(
        self, y: TensorDictBase, rows: Tensor, layers: Sequence[nn.Linear], counts: Sequence[int]
    ) -> tuple[list[Tensor], Tensor]:
        """Outputs of several networks' first layers, each at rows of its own.

        Args:
            y: feature states ``[N]``.
            rows: int64 ``[M]``, numbers of rows of ``y``.
            layers: the layers, each from ``num_features`` numbers.
            counts: the first layer reads the first ``counts[0]`` of ``rows``, the second the next ``counts[1]``, ...

        Returns:
            each layer's output, and the rows ``[M]`` that they belong to: ``rows``, reordered within each layer's.
        """
        blocks = zip(layers, self.encode_rows(y, rows).split(list(counts)), strict=True)
        return [rowwise(layer, features) for layer, features in blocks], rows


class FlatEncoder(Encoder):
    """The paper's encoding, for any model: real entries flattened, integer entries one-hot.

    Args:
        model: the belief model.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> problem = make_problem("linear20")
        >>> encoder = FlatEncoder(problem.model)
        >>> encoder.num_features, encoder(problem.start(torch.arange(6))).shape
        (120, torch.Size([6, 120]))
    """

    def __init__(self, model: BeliefModel) -> None:
        super().__init__()
        spec = model.state_spec()
        self.keys = model.state_keys
        self.classes = {key: leaf.n if isinstance(leaf, Categorical) else None for key, leaf in spec.items()}
        self.num_features = sum(leaf.shape.numel() * (self.classes[key] or 1) for key, leaf in spec.items())
        self.dtype = model.dtype

    def encode_rows(self, y: TensorDictBase, rows: Tensor | None) -> Tensor:
        """See :class:`Encoder`."""
        blocks = []
        for key in self.keys:
            # [., N] and its transpose: entries kept as planes are turned by one fast transposition.
            leaf = y.get(key).movedim(0, -1).flatten(0, -2)
            classes = self.classes[key]
            if classes is not None:
                leaf = (leaf.unsqueeze(1) == torch.arange(classes, device=leaf.device).unsqueeze(-1)).flatten(0, 1)
            blocks.append(leaf.to(self.dtype))
        features = torch.cat(blocks).T.contiguous()
        return features if rows is None else features.index_select(0, rows)


class RelativeEncoder(Encoder):
    """The repair problem as each robot sees it: what is known of the location at every offset from the robot.

    What to do with damage two steps to the left hardly depends on where on the pipeline the robot stands; with a window
    centred at the robot the network need not learn it anew for each location. An offset has K features: whether damage is
    possible at all and the probabilities of the damaged levels; offsets outside the graph are zero. The robot's location
    follows, one-hot.

    Args:
        model: the repair model; offsets are differences of its graph's columns and rows.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
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
        self.num_levels, self.num_locations, self.num_robots = model.num_levels, model.num_locations, model.num_robots
        size, levels = self.num_locations, self.num_levels
        window = _window(model.graph)
        # [L, L * K] for a robot at a location: which feature each number of the belief is; and the location's own.
        columns = window.unsqueeze(-1) * levels + torch.arange(levels)
        places = (int(window.max()) + 1) * levels + torch.arange(size)
        self.register_buffer("columns", columns.flatten(1).to(model.device), persistent=False)
        self.register_buffer("places", places.to(model.device), persistent=False)
        # On a line the features are neighbours, which saves a copy; the first one then.
        ranges = (columns.flatten(1).diff() == 1).all(-1).tolist()
        self._neighbouring = [int(row[0]) if range else None for row, range in zip(columns.flatten(1), ranges, strict=True)]
        self.robot_features = int(places[-1]) + 1
        self.num_features = self.num_robots * self.robot_features

    def encode_rows(self, y: TensorDictBase, rows: Tensor | None) -> Tensor:
        """See :class:`Encoder`."""
        numbers, location = self._numbers(y.get("belief"), rows), y.get("location")
        location = location if rows is None else location[rows]
        features = numbers.new_zeros(len(numbers), self.num_robots, self.robot_features)
        features.scatter_(-1, self.columns[location], numbers.unsqueeze(1).expand(-1, self.num_robots, -1))
        features.scatter_(-1, self.places[location].unsqueeze(-1), 1.0)
        return features.flatten(1)

    def first_layers(
        self, y: TensorDictBase, rows: Tensor, layers: Sequence[nn.Linear], counts: Sequence[int]
    ) -> tuple[list[Tensor], Tensor]:
        """See :class:`Encoder`. Without gradients, on a CPU, the rows are grouped by location.

        Robots at one location see the same offsets, the others' features are zero: a group is multiplied by the few rows of
        the weights that matter to it, and no window is ever made.
        """
        if torch.is_grad_enabled() or rows.device.type != "cpu":
            return super().first_layers(y, rows, layers, counts)
        numbers, location = self._numbers(y.get("belief"), None), y.get("location")
        outputs, ordered = [], []
        for layer, own in zip(layers, rows.split(list(counts)), strict=True):
            order = location[own, 0].argsort(stable=True)
            own = own[order]
            output = self._first_layer(numbers, own, location[own, 0], layer, 0)
            for robot in range(1, self.num_robots):
                order = location[own, robot].argsort(stable=True)
                others = self._first_layer(numbers, own[order], location[own[order], robot], layer, robot)
                output.index_add_(0, order, others)
            outputs.append(output)
            ordered.append(own)
        return outputs, torch.cat(ordered)

    def _first_layer(self, numbers: Tensor, rows: Tensor, location: Tensor, layer: nn.Linear, robot: int) -> Tensor:
        """A robot's share of ``layer`` at ``rows`` ``[M]`` of ``numbers`` ``[N, L * K]``, sorted by ``location`` ``[M]``."""
        # Small groups are multiplied together with rows of the next ones, whose own products then replace the result.
        x = numbers.index_select(0, nn.functional.pad(rows, (0, _MIN_ROWS)))
        weight = layer.weight.T[robot * self.robot_features :][: self.robot_features].contiguous()
        bias = weight[self.places] if robot else weight[self.places] + layer.bias
        output = x.new_empty(len(x), layer.out_features)
        start = 0
        for place, count in enumerate(location.bincount(minlength=self.num_locations).tolist()):
            if count:
                block = slice(start, start + max(count, _MIN_ROWS))
                torch.addmm(bias[place], x[block], self._seen_from(place, weight), out=output[block])
                start += count
        return output[:start]

    def _seen_from(self, place: int, weight: Tensor) -> Tensor:
        """Those rows of the weights ``[F, H]`` that the belief meets from a location: ``[L * K, H]``."""
        first = self._neighbouring[place]
        size = self.num_locations * self.num_levels
        return weight.index_select(0, self.columns[place]) if first is None else weight.narrow(0, first, size)

    def _numbers(self, belief: Tensor, rows: Tensor | None) -> Tensor:
        """What the windows show of the rows of ``belief`` ``[N, L, K]``: ``[M, L * K]``."""
        # A transposition of two dimensions is much faster than a general permutation.
        planes = belief.permute(1, 2, 0).flatten(0, 1)
        numbers = planes.T.contiguous() if rows is None else planes.T.index_select(0, rows)
        numbers = numbers.clone() if numbers.data_ptr() == belief.data_ptr() else numbers
        numbers[:, :: self.num_levels] = 1.0 - numbers[:, :: self.num_levels].floor()
        return numbers


def rowwise(network: nn.Module, features: Tensor) -> Tensor:
    """``network`` on ``[*B, F]``, such that a row's output does not depend on the size of the batch."""
    flat = features.reshape(-1, features.shape[-1])
    missing = max(0, _MIN_ROWS - flat.shape[0])
    output = network(nn.functional.pad(flat, (0, 0, 0, missing)) if missing else flat)
    return output[: flat.shape[0]].reshape(*features.shape[:-1], output.shape[-1])


def _window(graph: Graph) -> Tensor:
    """Number of the offset from every location to every location, ``[L, L]``: row by row, as a window centred at the first."""
    column, row = graph.columns.round().to(torch.int64), graph.rows.round().to(torch.int64)
    across, down = column - column.unsqueeze(-1), row - row.unsqueeze(-1)
    width = int(across.max() - across.min()) + 1
    return (down - down.min()) * width + across - across.min()
