"""What the losses on labelled states have in common."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from typing import Any, TypeVar, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torchrl_pomdp.checks import shown
from torchrl_pomdp.tensor_checks import check_entries

__all__ = ["LabelLoss", "check_batch", "check_loss", "label_of", "with_weights", "without_modes"]

LossClass = TypeVar("LossClass", bound="LabelLoss")


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


def without_modes(loss: type[LossClass]) -> type[LossClass]:
    """A class of losses whose ``forward`` leaves TorchRL's exploration type and recurrent mode alone.

    TorchRL sets both around every loss. They belong to the whole process: where parts are trained in threads, one puts back
    what another had set, and actors would draw nothing from then on. Losses on labels draw nothing and need neither.
    """
    cast(Any, loss).forward = cast(Any, loss.forward).__wrapped__
    return loss


@contextmanager
def with_weights(module: nn.Module, weights: TensorDictBase) -> Iterator[None]:
    """Lend a module other weights.

    What ends the process, such as Ctrl-C, goes on as what it is: TensorDict's own way would make another error of it.
    """
    ending: BaseException | None = None
    with weights.to_module(module, preserve_module_state=False):
        try:
            yield
        except Exception:
            raise
        except BaseException as error:
            ending = error
    if ending is not None:
        raise ending


def check_batch(tensordict: TensorDictBase, keys: Iterable[NestedKey]) -> TensorDictBase:
    """Labelled states ``[*B]`` with entries ``keys`` as a flat batch that is not empty."""
    batch = check_entries("tensordict", tensordict, keys).reshape(-1)
    if batch.batch_size[0] == 0:
        raise ValueError("tensordict must hold at least one labelled state, got none")
    return batch


def label_of(batch: TensorDictBase, key: NestedKey, ndim: int, floating: bool) -> Tensor:
    """The labels ``key`` of a flat batch.

    Raises:
        ValueError: if they are missing or of another shape or kind.
    """
    label, kind = batch.get(key), "floating" if floating else "int64"
    fits = label.is_floating_point() if floating else label.dtype == torch.int64
    if label.ndim != ndim or not fits:
        raise ValueError(f"{key!r} must hold {kind} labels of {ndim} dimensions, got {label.dtype} and {shown(label)}")
    return label


def check_loss(name: str, loss: Tensor) -> Tensor:
    """The loss, if it is a number.

    Raises:
        ValueError: if it is not finite.
    """
    if not bool(torch.isfinite(loss)):
        raise ValueError(
            f"{name} must be finite, got {float(loss.detach())}: a label, or an output of the network, is no number"
        )
    return loss
