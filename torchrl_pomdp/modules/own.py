"""Modules with locks, counts or compiled loops, which no copy takes along, nor a file."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

from torch import nn

__all__ = ["MakesItsOwn"]


class MakesItsOwn(nn.Module):
    """A module of which every copy makes some attributes for itself, also one that is read from a file.

    A class names them in ``_OWN``, makes them in :meth:`_prepare`, and calls that when it is constructed.

    Examples:
        >>> import copy
        >>> class Counter(MakesItsOwn):
        ...     _OWN = frozenset({"count"})
        ...
        ...     def _prepare(self):
        ...         self.count = 0
        >>> counter = Counter()
        >>> counter.count = 3
        >>> copy.deepcopy(counter).count
        0
    """

    _OWN: ClassVar[frozenset[str]] = frozenset()

    @abstractmethod
    def _prepare(self) -> None:
        """Make what a copy does not take along."""

    def __getstate__(self) -> dict[str, Any]:
        """All but what a copy makes for itself."""
        return {key: value for key, value in self.__dict__.items() if key not in self._OWN}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """The inverse of :meth:`__getstate__`."""
        super().__setstate__(state)
        self._prepare()
