r"""Encoders of the feature state and the policy network :math:`\hat\mu(y,r)` (paper, Sections IV and VI-C)."""

from __future__ import annotations

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


class FlatEncoder(Encoder):
    """The paper's encoding, for any model: real entries flattened, integer entries one-hot.

    The dimensions of a real entry are flattened last first, so that beliefs kept as planes need no transposition.

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
        self.num_dims = {key: len(leaf.shape) for key, leaf in spec.items()}
        self.num_features = sum(leaf.shape.numel() * (self.classes[key] or 1) for key, leaf in spec.items())
        self.dtype = next(leaf.dtype for leaf in spec.values() if leaf.dtype.is_floating_point)

    def forward(self, y: TensorDictBase) -> Tensor:
        """Features ``[*B, F]`` of feature states ``[*B]``."""
        size = y.batch_size.numel()
        blocks = []
        for key in self.keys:
            leaf = y.get(key)
            leaf = leaf.reshape(size, *leaf.shape[leaf.ndim - self.num_dims[key] :])
            leaf = leaf.permute(*range(leaf.ndim - 1, -1, -1))
            classes = self.classes[key]
            if classes is not None:
                leaf = leaf.unsqueeze(0) == torch.arange(classes, device=leaf.device).view(-1, *([1] * leaf.ndim))
            blocks.append(leaf.reshape(-1, size).to(self.dtype))
        return torch.cat(blocks).T.reshape(*y.batch_size, self.num_features)


class RelativeEncoder(Encoder):
    """The repair problem as each robot sees it: what is known of the location at every offset from the robot.

    What to do with damage two steps to the left hardly depends on where on the pipeline the robot stands; with a window
    centred at the robot the network need not learn it anew for each location. Channels of an offset are the
    probabilities of the damaged levels and whether damage is possible at all; offsets outside the graph are zero. The
    robots' locations follow, one-hot.

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
    window: Tensor

    def __init__(self, model: RepairModel) -> None:
        super().__init__()
        self.num_levels, self.num_locations, self.num_robots = model.num_levels, model.num_locations, model.num_robots
        self.register_buffer("window", _window(model.graph).to(model.device), persistent=False)
        places = self.window.shape[0] * self.num_levels + self.num_locations
        self.num_features = self.num_robots * places

    def forward(self, y: TensorDictBase) -> Tensor:
        """Features ``[*B, F]`` of feature states ``[*B]``."""
        location = y.get("location").reshape(-1, self.num_robots).T
        planes = y.get("belief").reshape(-1, self.num_locations, self.num_levels).permute(2, 1, 0)
        size = planes.shape[-1]
        # [K, L + 1, N]: damaged levels and possible damage; the last location stands for all outside the graph.
        channels = planes.new_zeros(self.num_levels, self.num_locations + 1, size)
        channels[:-1, :-1] = planes[1:]
        channels[-1, :-1] = 1.0 - planes[0].floor()
        rows = torch.arange(size, device=planes.device)
        places = torch.arange(self.num_locations, device=planes.device).unsqueeze(-1)
        blocks = []
        for robot in location:
            index = (self.window.index_select(1, robot) * size + rows).flatten()
            blocks.append(channels.flatten(1).index_select(1, index).view(-1, size))
            blocks.append((places == robot).to(planes.dtype))
        return torch.cat(blocks).T.reshape(*y.batch_size, self.num_features)


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
        logits = _rowwise(self.network, self.encoder(tensordict))
        logits = logits.masked_fill(~tensordict.get("action_mask"), -torch.inf)
        return tensordict.update({"logits": logits, "action": logits.argmax(-1)})


def _relu_network(sizes: Sequence[int], generator: torch.Generator) -> nn.Sequential:
    """Linear layers of the given sizes with ReLU between them, PyTorch's default initialisation from ``generator``."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in pairwise(sizes):
        layer = nn.utils.skip_init(nn.Linear, fan_in, fan_out, device=generator.device)
        for parameter in layer.parameters():
            nn.init.uniform_(parameter, -(fan_in**-0.5), fan_in**-0.5, generator=generator)
        layers += [layer, nn.ReLU()]
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
