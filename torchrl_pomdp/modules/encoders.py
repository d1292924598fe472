r"""Encoders: what the networks see of the feature state (paper, Sections IV and VI-C)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Categorical

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.rows import flat_rows
from torchrl_pomdp.modules.rowwise import rowwise
from torchrl_pomdp.tensor_checks import check_entries

__all__ = ["Encoder", "FlatEncoder", "transformed"]


class Encoder(nn.Module):
    """Maps feature states ``[*B]`` to vectors ``[*B, num_features]`` of type ``dtype``, reading the entries ``keys``."""

    keys: tuple[str, ...]
    num_features: int
    dtype: torch.dtype

    def forward(self, y: TensorDictBase) -> Tensor:
        """Features ``[*B, F]`` of feature states ``[*B]``."""
        check_entries("y", y, self.keys)
        return self.encode_rows(flat_rows(y), None).reshape(*y.batch_size, self.num_features)

    @abstractmethod
    def encode_rows(self, y: TensorDictBase, rows: Tensor | None) -> Tensor:
        """Features ``[M, F]`` of the rows ``rows`` (int64 ``[M]``, in that order; None: all) of a flat batch ``[N]``."""

    def first_layers(
        self, y: TensorDictBase, rows: Tensor, layers: Sequence[nn.Linear], counts: Sequence[int]
    ) -> list[tuple[Tensor, Tensor | None]]:
        """Outputs of several networks' first layers, each at rows of its own.

        Args:
            y: feature states ``[N]``.
            rows: int64 ``[M]``, numbers of rows of ``y``.
            layers: the layers, each from ``num_features`` numbers.
            counts: the first layer reads the first ``counts[0]`` of ``rows``, the second the next ``counts[1]``, ...

        Returns:
            each layer's output ``[P, H]`` and where in it the layer's rows are, int64 ``[count]``; None: they are all of it.
        """
        blocks = zip(layers, self.encode_rows(y, rows).split(list(counts)), strict=True)
        return [(rowwise(layer, features), None) for layer, features in blocks]


def transformed() -> bool:
    """Whether a function transform such as ``vmap`` runs, under which the numbers of a tensor cannot decide what is done."""
    return torch._C._functorch.peek_interpreter_stack() is not None


class FlatEncoder(Encoder):
    """The paper's encoding, for any model: real entries flattened, integer entries one-hot.

    Args:
        model: the belief model.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> encoder = FlatEncoder(problem.model)
        >>> encoder.num_features, encoder(problem.start(torch.arange(6))).shape
        (120, torch.Size([6, 120]))
    """

    def __init__(self, model: BeliefModel) -> None:
        super().__init__()
        spec = check_instance("model", model, BeliefModel).state_spec()
        self.keys = model.state_keys
        self.classes = {key: leaf.n if isinstance(leaf, Categorical) else None for key, leaf in spec.items()}
        self.num_features = sum(leaf.shape.numel() * (self.classes[key] or 1) for key, leaf in spec.items())
        self.dtype = model.dtype

    def encode_rows(self, y: TensorDictBase, rows: Tensor | None) -> Tensor:
        """See :class:`Encoder`."""
        blocks = []
        for key in self.keys:
            # [., N] and its transpose: entries kept as planes are turned by one fast transposition.
            leaf = y.get(key)
            leaf = leaf.unsqueeze(0) if leaf.ndim == 1 else leaf.movedim(0, -1).flatten(0, -2)
            classes = self.classes[key]
            if classes is not None:
                leaf = (leaf.unsqueeze(1) == torch.arange(classes, device=leaf.device).unsqueeze(-1)).flatten(0, 1)
            blocks.append(leaf.to(self.dtype))
        features = torch.cat(blocks).T.contiguous()
        return features if rows is None else features.index_select(0, rows)
