r"""Encoders of the feature state and the policy network :math:`\hat\mu(y,r)` (paper, Sections IV and VI-C)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from itertools import pairwise

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Categorical

from torchrl_pomdp.envs.belief import BeliefModel
from torchrl_pomdp.envs.graphs import Graph
from torchrl_pomdp.envs.repair import RepairModel

__all__ = ["Encoder", "FlatEncoder", "PolicyNetwork", "RelativeEncoder"]

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
    follows, one-hot and filled with zeros to a multiple of K.

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
    shared: Tensor
    slots: Tensor
    stride: Tensor

    def __init__(self, model: RepairModel) -> None:
        super().__init__()
        self.num_levels, self.num_locations, self.num_robots = model.num_levels, model.num_locations, model.num_robots
        # Slots are K numbers. First come those that all rows share: the outside and every place, one-hot; then a row's
        # locations, one row after the other.
        place_slots = -(-self.num_locations // self.num_levels)
        shared = torch.zeros(1 + self.num_locations, place_slots * self.num_levels)
        shared[1:, : self.num_locations] = torch.eye(self.num_locations)
        shared = shared.view(-1, self.num_levels)[place_slots - 1 :]
        window = _window(model.graph).T
        own = window < self.num_locations
        places = 1 + torch.arange(self.num_locations * place_slots).view(-1, place_slots)
        slots = torch.cat([(window + len(shared)).masked_fill(~own, 0), places], -1)
        tables = {
            "shared": shared.to(model.dtype),
            # [L, S]: the slots that a robot at a location reads in row 0, and by how much they move from row to row.
            "slots": slots.to(torch.int32),
            "stride": torch.cat([own * self.num_locations, torch.zeros_like(places)], -1).to(torch.int32),
        }
        for name, value in tables.items():
            self.register_buffer(name, value.to(model.device), persistent=False)
        self.num_features = self.num_robots * slots.shape[-1] * self.num_levels

    def encode_rows(self, y: TensorDictBase, rows: Tensor | None) -> Tensor:
        """See :class:`Encoder`."""
        table, location = self._table(y.get("belief")), y.get("location").T
        rows = torch.arange(location.shape[-1], device=location.device) if rows is None else rows
        blocks = []
        for robot in location:
            place = robot[rows]
            slots = self.slots.index_select(0, place)
            slots.addcmul_(self.stride.index_select(0, place), rows.unsqueeze(-1).to(torch.int32))
            blocks.append(table.index_select(0, slots.flatten()).view(rows.numel(), -1))
        return blocks[0] if len(blocks) == 1 else torch.cat(blocks, -1)

    def _table(self, belief: Tensor) -> Tensor:
        """The shared slots, then those of every row of ``belief`` ``[N, L, K]``."""
        size, first = belief.shape[0], len(self.shared)
        table = belief.new_empty(first + size * self.num_locations, self.num_levels)
        table[:first] = self.shared
        # A transposition of two dimensions is much faster than a general permutation.
        planes = belief.permute(1, 2, 0).flatten(0, 1)
        own = table[first:].view(size, -1).copy_(planes.T).view(belief.shape)
        own[..., 0] = 1.0 - belief[..., 0].floor()
        return table


class PolicyNetwork(TensorDictModuleBase):
    r"""Masked policy network :math:`\hat\mu(y,r)`: a ReLU network over the encoded feature state, 256-64 in the paper.

    Args:
        encoder: encoder of feature states.
        num_controls: U.
        hidden: sizes of the hidden layers.
        generator: generator of the initial weights; the global one is left alone.

    Examples:
        >>> from torchrl_pomdp.envs import make_problem
        >>> problem = make_problem("linear20")
        >>> network = PolicyNetwork(FlatEncoder(problem.model), 3, generator=torch.Generator().manual_seed(0))
        >>> y = network(problem.model.with_features(problem.start(torch.arange(6))))
        >>> y["logits"].shape, bool(y["action_mask"].gather(1, y["action"][:, None]).all())
        (torch.Size([6, 3]), True)
    """

    out_keys = ["logits", "action"]

    def __init__(
        self, encoder: Encoder, num_controls: int, hidden: Sequence[int] = (256, 64), *, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.in_keys = [*encoder.keys, "action_mask"]
        self.network = _relu_network([encoder.num_features, *hidden, num_controls], generator)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"logits"`` ``[*B, U]`` (``-inf`` where illegal) and the most probable ``"action"`` ``[*B]``."""
        logits = self.logits(self.encoder(tensordict), tensordict.get("action_mask"))
        return tensordict.update({"logits": logits, "action": logits.argmax(-1)})

    def logits(self, features: Tensor, action_mask: Tensor) -> Tensor:
        """Logits ``[*B, U]`` from features ``[*B, F]``, ``-inf`` where ``action_mask`` ``[*B, U]`` is False."""
        return _rowwise(self.network, features).masked_fill(~action_mask, -torch.inf)


def _relu_network(sizes: Sequence[int], generator: torch.Generator) -> nn.Sequential:
    """Linear layers of the given sizes with ReLU between them, PyTorch's default initialisation from ``generator``."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in pairwise(sizes):
        layer = nn.utils.skip_init(nn.Linear, fan_in, fan_out, device=generator.device)
        for parameter in layer.parameters():
            nn.init.uniform_(parameter, -(fan_in**-0.5), fan_in**-0.5, generator=generator)
        layers += [layer, nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


def _rowwise(network: nn.Module, features: Tensor) -> Tensor:
    """``network`` on ``[*B, F]``, such that a row's output does not depend on the size of the batch."""
    flat = features.reshape(-1, features.shape[-1])
    missing = max(0, _MIN_ROWS - flat.shape[0])
    output = network(nn.functional.pad(flat, (0, 0, 0, missing)) if missing else flat)
    return output[: flat.shape[0]].reshape(*features.shape[:-1], -1)


def _window(graph: Graph) -> Tensor:
    """Location at every offset from every location, ``[W, L]``; L where the offset leaves the graph."""
    places = [(round(c), round(r)) for c, r in zip(graph.columns.tolist(), graph.rows.tolist(), strict=True)]
    at = {place: index for index, place in enumerate(places)}
    spans = [max(values) - min(values) for values in zip(*places, strict=True)]
    offsets = [(dc, dr) for dr in range(-spans[1], spans[1] + 1) for dc in range(-spans[0], spans[0] + 1)]
    outside = graph.num_locations
    return torch.tensor([[at.get((c + dc, r + dr), outside) for c, r in places] for dc, dr in offsets])
