"""What the losses on labelled states have in common."""

from __future__ import annotations

from dataclasses import fields

from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.objectives import LossModule

__all__ = ["LabelLoss"]


class LabelLoss(LossModule):
    """Base of losses that compare a network's entries with labels; subclasses name the label entries in ``_AcceptedKeys``."""

    @property
    def network(self) -> TensorDictModuleBase:
        """The module that is trained."""
        raise NotImplementedError

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries that ``forward`` reads: the network's and the labels."""
        return [*self.network.in_keys, *(getattr(self.tensor_keys, field.name) for field in fields(self.tensor_keys))]

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        # LossModule assigns it; it follows from the network.
        pass

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        pass
