"""Scalar twins: policies as small compiled functions, for simulations that compute one trajectory at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, cast

from numba import types
from numba.extending import NativeValue, models, overload, register_model, typeof_impl, unbox

from torchrl_pomdp.scalar.compiling import OPTIONS, inner

__all__ = ["ScalarTwin", "TwinType", "choose", "scalar_twin"]

_TWINS: dict[str, Callable[..., Any]] = {}


class TwinType(types.Type):
    """The type of a twin in compiled code: other twins are other types, so that each is compiled into the loop.

    Compiled loops are kept on disk by the types of their arguments; the digest of the twin's code makes a changed twin
    another one.
    """

    def __init__(self, key: str) -> None:
        super().__init__(name=f"ScalarTwin({key})")


class ScalarTwin:
    """A compiled policy, see :func:`scalar_twin`.

    Attributes:
        function: the compiled function, to be called by other twins.
        type: its type in compiled code.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        compiled = inner(function)
        # Its name has the digest of its code.
        self.__setstate__((f"{compiled.__module__}.{compiled.__qualname__}", compiled))

    def __getstate__(self) -> tuple[str, Callable[..., Any]]:
        return self._key, self.function

    def __setstate__(self, state: tuple[str, Callable[..., Any]]) -> None:
        # Compiled code finds it by its type, in another process too.
        self._key, self.function = state
        self.type = TwinType(self._key)
        _TWINS[self.type.name] = self.function


def scalar_twin(function: Callable[..., None]) -> ScalarTwin:
    """Make a scalar twin of a policy from ``function(data, view, controls)``.

    The function writes the control of every robot into ``controls`` (int64 ``[R]``). ``data`` is what the policy offers with
    the twin, a tuple of arrays and numbers; ``view`` is what the simulation shows, for repair models a
    :class:`~torchrl_pomdp.modules.repair.scalar.View`, for tabular ones a
    :class:`~torchrl_pomdp.modules.tabular.TabularView`. It is compiled by numba, and may call functions that are.

    Examples:
        >>> @scalar_twin
        ... def wait(data, view, controls):
        ...     controls[:] = 0
    """
    return ScalarTwin(function)


def choose(policy, view, controls):
    """For compiled loops: write the controls of a policy, a pair of twin and data."""
    raise NotImplementedError("choose is for compiled functions")


@overload(choose, jit_options=cast(Any, OPTIONS))
def _choose(policy, view, controls):
    twin = next(iter(policy), None) if isinstance(policy, Iterable) else None
    if not isinstance(twin, TwinType):
        return None
    function = _TWINS[twin.name]

    def compiled(policy, view, controls):
        function(policy[1], view, controls)

    return compiled


@typeof_impl.register(ScalarTwin)
def _typeof(twin: ScalarTwin, context: Any) -> TwinType:
    return twin.type


register_model(TwinType)(models.OpaqueModel)


@unbox(TwinType)
def _unbox(typ: TwinType, twin: Any, context: Any) -> NativeValue:
    return NativeValue(context.context.get_dummy_value())
