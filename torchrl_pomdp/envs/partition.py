"""Partitions of the feature space (paper, Section V).

The index of the part that holds a feature state is itself a feature: ``y["partition"]``. Policies and values are
routed by it, and training proceeds in stages of parts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_pomdp.checks import check_callable, check_instance, check_integer, check_sequence, check_text, shown
from torchrl_pomdp.tensor_checks import check_entries, device_of

__all__ = ["FunctionPartition", "Partition", "SinglePart"]


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

    def check(self) -> None:
        """Raise unless parts have names and every part belongs to one stage; models do it when they get a partition.

        Raises:
            TypeError: if ``names`` or ``stages`` is missing or of the wrong kind.
            ValueError: if there is no part, a name is empty, or a part is in no stage or in several.
        """
        kind = type(self).__name__
        names = check_instance(f"names of partition {kind}", getattr(self, "names", None), (tuple, list))
        stages = check_instance(f"stages of partition {kind}", getattr(self, "stages", None), (tuple, list))
        if not names:
            raise ValueError(f"names of partition {kind} must hold at least one name, got none")
        for part, name in enumerate(names):
            check_text(f"names[{part}] of partition {kind}", name)
        groups = [check_instance(f"stages[{i}] of partition {kind}", stage, (tuple, list)) for i, stage in enumerate(stages)]
        if len(set(names)) < len(names):
            raise ValueError(f"names of partition {kind} must differ, got {shown(tuple(names))}")
        staged = [check_integer(f"a part in stages of partition {kind}", part) for stage in groups for part in stage]
        if sorted(staged) != list(range(len(names))):
            raise ValueError(f"stages of partition {kind} must hold every part 0..{len(names) - 1} once, got {shown(stages)}")

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
        check_entries("y", y, ())
        return torch.zeros(y.batch_size, dtype=torch.int64, device=device_of(y))


class FunctionPartition(Partition):
    r"""A partition that a function of feature states gives.

    Args:
        names: one name for each part.
        function: gives the number of the part of each feature state, int64 ``[*B]`` for states ``[*B]``.
        stages: groups of parts in the order in which they are trained, those first that the others lead to; None: all parts
            in one stage. :func:`~torchrl_pomdp.problems.check_partition` counts what breaks the order.

    Raises:
        TypeError: if an argument is of the wrong kind; when called, if the function gives no int64 tensor.
        ValueError: if there is no part or a part is not in exactly one stage; when called, if the function gives numbers of
            another shape, or of no part.

    Examples:
        >>> from tensordict import TensorDict
        >>> sure = FunctionPartition(("unsure", "sure"), lambda y: (y["belief"].amax(-1) > 0.9).long(), stages=((1,), (0,)))
        >>> sure(TensorDict({"belief": torch.tensor([[0.5, 0.5], [0.0, 1.0]])}, [2])).tolist()
        [0, 1]
    """

    def __init__(
        self,
        names: Sequence[str],
        function: Callable[[TensorDictBase], Tensor],
        stages: Sequence[Sequence[int]] | None = None,
    ) -> None:
        super().__init__()
        self.names = tuple(check_sequence("names", names, str, 1))
        self.function = check_callable("function", function)
        groups = [range(len(self.names))] if stages is None else check_sequence("stages", stages, Sequence, 1)
        self.stages = tuple(tuple(stage) for stage in groups)
        self.check()

    def forward(self, y: TensorDictBase) -> Tensor:
        """Part index of every feature state, int64 ``[*B]``."""
        part = self.function(check_entries("y", y, ()))
        if not isinstance(part, Tensor) or part.dtype != torch.int64:
            given = part.dtype if isinstance(part, Tensor) else shown(part)
            raise TypeError(f"function must give the numbers of parts as an int64 tensor, got {given}")
        if part.shape != y.batch_size:
            raise ValueError(f"function must give one part for each state, {tuple(y.batch_size)}, got {tuple(part.shape)}")
        low, high = part.aminmax() if part.numel() else (0, 0)
        if low < 0 or high >= len(self.names):
            wrong = int(low if low < 0 else high)
            raise ValueError(f"function must give parts in 0..{len(self.names) - 1}, got {wrong} among them")
        return part
