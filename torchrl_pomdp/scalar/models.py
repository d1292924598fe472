"""Scalar models: belief models as small compiled functions, for searches that grow a tree one history at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from inspect import signature
from typing import Any, cast

from numba import types
from numba.extending import NativeValue, models, overload, register_model, typeof_impl, unbox

from torchrl_pomdp.scalar.compiling import OPTIONS, code_digest, inner

__all__ = [
    "ModelType",
    "ScalarModel",
    "costs",
    "keep",
    "mask",
    "move",
    "over",
    "preferred",
    "recall",
    "relaxed",
    "remaining",
    "see",
    "seen_after",
    "settle",
    "start",
]

_MODELS: dict[str, dict[str, Callable[..., Any]]] = {}


class ModelType(types.Type):
    """The type of a model in compiled code, named by the digest of its functions; see :class:`~.twins.TwinType`."""

    def __init__(self, key: str) -> None:
        super().__init__(name=f"ScalarModel({key})")


class ScalarModel:
    """A belief model in compiled code: one function for each operation of this module, by its name.

    Each function takes the model's data in place of the model; the ``state`` is a tuple of arrays of the model's own making,
    that of one history at a time.
    """

    def __init__(self, **functions: Callable[..., Any]) -> None:
        missing = set(_OPERATIONS) ^ set(functions)
        if missing:
            raise ValueError(f"functions must be one for each of {sorted(_OPERATIONS)}, got a difference in {sorted(missing)}")
        found = {name: inner(function) for name, function in functions.items()}
        digests = "-".join(code_digest(function) for _, function in sorted(found.items()))
        self.__setstate__((f"{functions['start'].__module__}-{digests}", found))

    def __getstate__(self) -> tuple[str, dict[str, Callable[..., Any]]]:
        return self._key, _MODELS[self.type.name]

    def __setstate__(self, state: tuple[str, dict[str, Callable[..., Any]]]) -> None:
        # Compiled code finds the functions by the type, in another process too.
        self._key, functions = state
        self.type = ModelType(self._key)
        _MODELS[self.type.name] = functions


def start(model, state):
    """The state becomes that of the root."""
    raise NotImplementedError


def keep(model, state, row):
    """Put the state into ``row``, float64 ``[W]``."""
    raise NotImplementedError


def recall(model, state, row):
    """The state becomes that in ``row``."""
    raise NotImplementedError


def mask(model, state, legal):
    """Put into ``legal``, bool ``[U]``, which controls are legal."""
    raise NotImplementedError


def costs(model, state, out):
    """Put into ``out``, float64 ``[U]``, the expected stage cost of each control."""
    raise NotImplementedError


def over(model, state):
    """Whether no cost follows: the state is terminal, or so late that simulations end."""
    raise NotImplementedError


def move(model, state, u):
    """Take control ``u``: what follows is seen by :func:`see`, and taken in by :func:`settle`."""
    raise NotImplementedError


def see(model, state, noise):
    """Number of the observation in a scenario after :func:`move`; the state stays."""
    raise NotImplementedError


def seen_after(model, state, seen):
    """The variables that a scenario has seen after :func:`move`, as bits, when it had seen ``seen``."""
    raise NotImplementedError


def settle(model, state, z):
    """The state becomes that of the next stage, after :func:`move` and observation ``z``."""
    raise NotImplementedError


def remaining(model, policy, state, noise):
    """Cost of a policy from the state on in one scenario, its steps, and whether all its controls were legal."""
    raise NotImplementedError


def relaxed(model, state, noise):
    """No policy costs less than this from the state on in the scenario."""
    raise NotImplementedError


def preferred(model, policy, state):
    """The control that a policy chooses in the state."""
    raise NotImplementedError


_EVERY = start, keep, recall, mask, costs, over, move, see, seen_after, settle, remaining, relaxed, preferred
_OPERATIONS: dict[str, Callable[..., Any]] = {each.__name__: each for each in _EVERY}


def _function(model: Any, name: str) -> Callable[..., Any] | None:
    """The operation of a model of this type; None if it is no model."""
    twin = next(iter(model), None) if isinstance(model, Iterable) else None
    return _MODELS[twin.name][name] if isinstance(twin, ModelType) else None


# Compiled functions have no lists of arguments: one way for each number of them.
def _with_state(name: str) -> Callable[..., Any]:
    def operation(model, state):
        function = _function(model, name)
        return function and (lambda model, state: function(model[1], state))

    return operation


def _with_another(name: str) -> Callable[..., Any]:
    def operation(model, state, more):
        function = _function(model, name)
        return function and (lambda model, state, more: function(model[1], state, more))

    return operation


def _with_two(name: str) -> Callable[..., Any]:
    def operation(model, first, second, third):
        function = _function(model, name)
        return function and (lambda model, first, second, third: function(model[1], first, second, third))

    return operation


_WAYS = {2: _with_state, 3: _with_another, 4: _with_two}


for _name, _stub in _OPERATIONS.items():
    overload(_stub, jit_options=cast(Any, OPTIONS))(_WAYS[len(signature(_stub).parameters)](_name))


@typeof_impl.register(ScalarModel)
def _typeof(twin: ScalarModel, context: Any) -> ModelType:
    return twin.type


register_model(ModelType)(models.OpaqueModel)


@unbox(ModelType)
def _unbox(typ: ModelType, twin: Any, context: Any) -> NativeValue:
    return NativeValue(context.context.get_dummy_value())
