"""The checks of :mod:`torchrl_pomdp.checks` that are about tensors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Categorical, TensorSpec

from torchrl_pomdp.checks import shown

__all__ = [
    "check_device",
    "check_distributions",
    "check_dtype",
    "check_entries",
    "check_keys",
    "check_representable",
    "check_tensor",
    "device_of",
    "place",
]

# How far the sum of probabilities may be from one: rounding in long products of float32 numbers.
SUM_TOLERANCE = 1e-4


def check_entries(name: str, value: Any, keys: Iterable[NestedKey]) -> TensorDictBase:
    """A TensorDict that has some entries; their shapes are not looked at, which costs nothing at every step of a simulation.

    Raises:
        TypeError: if it is no TensorDict.
        ValueError: if an entry is missing.

    Examples:
        >>> check_entries("y", {}, ["belief"])
        Traceback (most recent call last):
        TypeError: y must be a TensorDict, got {}
    """
    if not isinstance(value, TensorDictBase):
        raise TypeError(f"{name} must be a TensorDict, got {shown(value)}")
    for key in keys:
        if not isinstance(value.get(key, None), Tensor):
            raise ValueError(f"{name} lacks the entry {key!r}")
    return value


def check_device(name: str, value: Any) -> torch.device:
    """A device that is there, from its name or itself.

    Raises:
        TypeError: if it is neither.
        ValueError: if there is no such device here.

    Examples:
        >>> check_device("device", "cpu")
        device(type='cpu')
    """
    if not isinstance(value, (str, torch.device)):
        raise TypeError(f"{name} must be a device such as cpu or cuda:0, got {shown(value)}")
    try:
        device = torch.device(value)
        # A tensor without numbers, as on the device meta, has no first one.
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ValueError(f"{name} must be a device of this machine such as cpu or cuda:0, got {shown(str(value))}") from error
    return device


def check_dtype(name: str, value: Any) -> torch.dtype:
    """The type of beliefs and costs: float32 or float64.

    Raises:
        TypeError: if it is no type of tensors.
        ValueError: if it is another one.

    Examples:
        >>> import torch
        >>> check_dtype("dtype", torch.float64)
        torch.float64
    """
    if not isinstance(value, torch.dtype):
        raise TypeError(f"{name} must be torch.float32 or torch.float64, got {shown(value)}")
    if value not in (torch.float32, torch.float64):
        raise ValueError(f"{name} must be torch.float32 or torch.float64, got {value}")
    return value


def check_tensor(
    name: str,
    value: Any,
    shape: Sequence[int | None] | None = None,
    dtype: torch.dtype | None = None,
    *,
    finite: bool = True,
    sparse: bool = False,
) -> Tensor:
    """A tensor of a shape.

    Args:
        name: name of the argument.
        value: what was given: a tensor, or nested sequences of numbers.
        shape: its sizes, None for any; None altogether for any shape.
        dtype: its type; None for any real one.

    Keyword Args:
        finite: whether all numbers must be finite.
        sparse: whether it may be a sparse tensor.

    Raises:
        TypeError: if it is no such thing.
        ValueError: if the shape is another or a number is not finite.

    Examples:
        >>> check_tensor("costs", (0, 1, 5), (3,)).tolist()
        [0, 1, 5]
    """
    if not isinstance(value, torch.Tensor):
        try:
            # In Python's own precision; a float32 copy of 0.1 is another number.
            read = torch.as_tensor(value)
            exact = isinstance(value, Sequence) and read.is_floating_point()
            value = torch.as_tensor(value, dtype=torch.float64) if exact else read
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise TypeError(f"{name} must be a tensor of numbers, got {shown(value)}") from error
    if value.layout != torch.strided and not sparse:
        raise TypeError(f"{name} must be a dense tensor, got one of layout {value.layout}")
    if (
        (dtype is not None and value.dtype != dtype)
        or value.is_complex()
        or value.is_quantized
        or (dtype is None and value.dtype == torch.bool)
    ):
        raise TypeError(f"{name} must be a tensor of {dtype or 'real numbers'}, got {value.dtype}")
    if shape is not None and (
        len(shape) != value.ndim or any(s not in (None, n) for s, n in zip(shape, value.shape, strict=True))
    ):
        expected = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} must have shape ({expected}), got {tuple(value.shape)}")
    if finite and not bool(torch.isfinite(value).all()):
        raise ValueError(f"{name} must hold finite numbers, got {value[~torch.isfinite(value)][0].item()} among them")
    return value


def check_keys(name: str, value: Any) -> Tensor:
    """Keys of random streams: an int64 tensor of any shape.

    Raises:
        TypeError: if it is anything else.

    Examples:
        >>> import torch
        >>> check_keys("keys", torch.arange(2)).tolist()
        [0, 1]
    """
    if not isinstance(value, torch.Tensor) or value.dtype != torch.int64:
        given = value.dtype if isinstance(value, torch.Tensor) else shown(value)
        raise TypeError(f"{name} must be an int64 tensor, got {given}")
    return value


def check_representable(name: str, value: float, dtype: torch.dtype) -> float:
    """A number of Python's that stays finite in the type of beliefs and costs.

    Raises:
        ValueError: if it is not finite there.

    Examples:
        >>> check_representable("cost", 1e39, torch.float32)
        Traceback (most recent call last):
        ValueError: cost must be finite in torch.float32, got 1e+39
    """
    if not abs(value) <= torch.finfo(dtype).max:
        raise ValueError(f"{name} must be finite in {dtype}, got {value}")
    return value


def check_distributions(name: str, value: Tensor) -> Tensor:
    """Probabilities ``[*, n]`` whose last dimension sums to one, with rounding allowed for.

    Raises:
        ValueError: if a number is negative, above one or not finite, or a sum is not one.

    Examples:
        >>> import torch
        >>> check_distributions("belief", torch.tensor([0.5, 0.6]))
        Traceback (most recent call last):
        ValueError: belief must hold probabilities that sum to 1, got a sum of 1.1
    """
    if not value.numel():
        return value
    rounding = 8 * torch.finfo(value.dtype).eps
    if not (value.amin() >= 0.0 and value.amax() <= 1.0 + rounding):
        wrong = value[~((value >= 0.0) & (value <= 1.0 + rounding))][0].item()
        raise ValueError(f"{name} must hold probabilities in [0, 1], got {wrong:.6g} among them")
    # Along the memory: beliefs often have their first dimension innermost.
    sums = value.movedim(0, -1).sum(-2) if value.ndim > 1 and value.stride(0) == 1 else value.sum(-1)
    wrong_sum = (sums - 1.0).abs() > SUM_TOLERANCE
    if bool(wrong_sum.any()):
        raise ValueError(
            f"{name} must hold probabilities that sum to 1, got a sum of {float(sums[wrong_sum].flatten()[0]):.6g}"
        )
    return value


def within(leaf: TensorSpec, value: Tensor) -> bool:
    """Whether ``value`` ``[*B, ...]`` lies in the bounds of a spec; floating numbers may pass an upper one by rounding."""
    if isinstance(leaf, Bounded) and leaf.dtype.is_floating_point:
        low, high = leaf.space.low, leaf.space.high
        slack = 8 * torch.finfo(leaf.dtype).eps
        high = high + slack * high.abs().clamp_min(1)
        return bool(value.amin() >= low.max() and value.amax() <= high.min()) or bool(((value >= low) & (value <= high)).all())
    return bool(leaf.expand(value.shape).is_in(value))


def bounds_text(leaf: TensorSpec) -> str:
    """The bounds of a spec in a line.

    Examples:
        >>> bounds_text(Categorical(20)), bounds_text(Bounded(0.0, 1.0, shape=(3,)))
        ('0 to 19', '0 to 1')
    """
    if isinstance(leaf, Categorical):
        return f"0 to {leaf.n - 1}"
    if isinstance(leaf, Bounded):
        return f"{leaf.space.low.min():g} to {leaf.space.high.max():g}"
    return " ".join(str(leaf).split())


def device_of(y: TensorDictBase) -> torch.device:
    """Where the entries of ``y`` are. A TensorDict need not say so itself; TorchRL's collectors make such.

    Examples:
        >>> from tensordict import TensorDict
        >>> y = TensorDict({"belief": torch.zeros(2, device="meta")}, [2])
        >>> y.device, device_of(y)
        (None, device(type='meta'))
    """
    if y.device is not None:
        return y.device
    return next((leaf.device for leaf in y.values(include_nested=True, leaves_only=True)), torch.device("cpu"))


def place(index: tuple[int, ...]) -> str:
    """Where in a batch something is wrong, for a message; nothing for a single state.

    Examples:
        >>> place((3, 1)), place(())
        (' at batch index (3, 1)', '')
    """
    return f" at batch index {index}" if index else ""
