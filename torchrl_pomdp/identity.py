"""What an object is, as a short text: the same for equal content in any process, another one as soon as a number differs.

A run folder belongs to one run, a checkpoint to one problem. Names do not tell problems, policies and rules apart; a hash of
all that they hold does.
"""

from __future__ import annotations

import functools
import hashlib
import sys
import types
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

__all__ = ["digest", "identity"]

# What a module holds of its own; hooks, the mode and caches say nothing of what it computes.
_MODULE_CONTENT = ("_parameters", "_buffers", "_modules")
_PLAIN = (int, float, complex, str, bytes, bool, type(None), torch.dtype)
# What a class has of its making, not of what it does.
_SAYS_NOTHING = {
    *("__module__", "__doc__", "__dict__", "__weakref__", "__firstlineno__", "__static_attributes__"),
    *("__slotnames__", "_abc_impl"),
}
_DESCRIPTORS = (types.MemberDescriptorType, types.GetSetDescriptorType, types.WrapperDescriptorType, types.MethodDescriptorType)
# Of these packages names say enough: versions are written down beside them.
_BUILT_ON = {"torchrl_pomdp", "torch", "torchrl", "tensordict", "numpy", "tqdm"}
_KNOWN = _BUILT_ON.union(sys.builtin_module_names, sys.stdlib_module_names)


def identity(value: Any) -> str:
    """Class and content of an object, for records of runs.

    Examples:
        >>> identity(nn.ReLU()).split()[0]
        'ReLU'
    """
    return f"{type(value).__name__} {digest(value)}"


def digest(value: Any) -> str:
    """Hash of all that an object holds, 32 hexadecimal digits; the device does not matter.

    Tensors count with type, shape and numbers; modules with parameters, buffers and attributes; functions with their code,
    defaults, closures and the globals that they read, those of other modules too; classes with all that they define; other
    objects with their class and what they are pickled by. What the standard library and the libraries that this one builds
    on define counts by name.

    Raises:
        TypeError: if an object holds what cannot be told, such as an open file.

    Examples:
        >>> digest({"a": torch.arange(3)}) == digest({"a": torch.arange(3)}), digest(1.0) == digest(2.0)
        (True, False)
    """
    return _Walk().digest(value).hex()


class _Walk:
    """Digests of the objects that are met, each computed once."""

    def __init__(self) -> None:
        # The objects themselves are kept: the number of one that is gone may be another's.
        self._known: dict[int, tuple[Any, bytes]] = {}

    def digest(self, value: Any) -> bytes:
        if type(value) in _PLAIN:
            return hashed("plain", type(value).__name__, repr(value))
        known = self._known.get(id(value))
        if known is None:
            # What leads back to itself is told by the way there.
            self._known[id(value)] = value, b"itself"
            known = value, self._content(value)
            self._known[id(value)] = known
        return known[1]

    def _content(self, value: Any) -> bytes:
        if isinstance(value, Tensor):
            return _tensor(value)
        if isinstance(value, TensorDictBase):
            leaves = {str(key): value.get(key) for key in value.keys(include_nested=True, leaves_only=True)}
            return hashed("tensordict", str(tuple(value.batch_size)), self._items(leaves))
        if type(value) in (dict, types.MappingProxyType):
            return hashed("mapping", self._items(value))
        if type(value) in (list, tuple):
            return hashed(type(value).__name__, *map(self.digest, value))
        if type(value) in (set, frozenset):
            return hashed("set", *sorted(map(self.digest, value)))
        if isinstance(value, torch.device):
            return hashed("device")
        if isinstance(value, torch.Generator):
            return hashed("generator", _tensor(value.get_state()))
        if isinstance(value, types.ModuleType):
            return hashed("module", value.__name__)
        if isinstance(value, types.CodeType):
            return self._code(value)
        if isinstance(value, (staticmethod, classmethod, functools._lru_cache_wrapper)):
            return hashed(type(value).__name__, self.digest(value.__wrapped__))
        if isinstance(value, property):
            return hashed("property", *map(self.digest, (value.fget, value.fset)))
        if isinstance(value, functools.cached_property):
            return hashed("property", self.digest(value.func))
        if isinstance(value, _DESCRIPTORS):
            return hashed("descriptor", value.__name__)
        if isinstance(value, type):
            return self._class(value)
        if isinstance(value, types.FunctionType):
            return self._function(value)
        if isinstance(value, types.MethodType):
            return hashed("method", *map(self.digest, (value.__func__, value.__self__)))
        if isinstance(value, types.BuiltinFunctionType):
            own = None if isinstance(value.__self__, types.ModuleType) else value.__self__
            return hashed("builtin", _name(value), self.digest(own))
        if isinstance(value, (functools.partial, functools.partialmethod)):
            return hashed("partial", *map(self.digest, (value.func, value.args, value.keywords)))
        return hashed("object", self._class(type(value)), self._state(value))

    def _class(self, value: type) -> bytes:
        """A class by name, and by what it defines unless it is of a known package."""
        if _is_known(value):
            return hashed("class", _name(value))
        own = {name: entry for name, entry in vars(value).items() if name not in _SAYS_NOTHING}
        return hashed("class", _name(value), *(self.digest(base) for base in value.__bases__), self._items(own))

    def _function(self, value: types.FunctionType) -> bytes:
        """A function by name, code, defaults, closure and the globals that it reads; of a known package by name and closure."""
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        bound = (value.__defaults__, value.__kwdefaults__, cells)
        if _is_known(value):
            return hashed("function", _name(value), *map(self.digest, bound))
        names = {name for code in codes(value.__code__) for name in code.co_names}
        read = {name: value.__globals__[name] for name in names if name in value.__globals__}
        for name, module in [*read.items()]:
            if isinstance(module, types.ModuleType) and module.__name__.partition(".")[0] not in _KNOWN:
                read |= {f"{name}.{entry}": getattr(module, entry) for entry in names if hasattr(module, entry)}
        return hashed("function", _name(value), self._code(value.__code__), *map(self.digest, (*bound, read)))

    def _code(self, code: types.CodeType) -> bytes:
        constants = [self._code(c) if isinstance(c, types.CodeType) else self.digest(c) for c in code.co_consts]
        return hashed("code", code.co_code, repr((code.co_names, code.co_varnames)), *constants)

    def _state(self, value: Any) -> bytes:
        """What an object would be pickled by."""
        kind = type(value)
        own_way = (kind.__reduce_ex__, kind.__reduce__) != (object.__reduce_ex__, object.__reduce__)
        state = None if own_way else value.__getstate__()
        if isinstance(value, nn.Module) and isinstance(state, dict):
            hooks = set(nn.Module().__dict__).difference(_MODULE_CONTENT)
            kept = {key: entry for key, entry in state.items() if key not in hooks}
            return self.digest(
                [kept, *(list(state[key].values()) for key in sorted(hooks) if key.endswith("hooks") and state[key])]
            )
        if state is not None and not isinstance(value, (list, tuple, dict, set, frozenset)):
            return self.digest(state)
        try:
            reduced = value.__reduce_ex__(4)
        except TypeError as error:
            raise TypeError(
                f"what a {_name(kind)} holds cannot be told, so no file can say that it belongs to it: {error}"
            ) from error
        if isinstance(reduced, str):
            return hashed("named", reduced)
        make, given, state, *items = (*reduced, None)[:5]
        return self.digest([make, given, state, *(list(entries) for entries in items if entries is not None)])

    def _items(self, entries: Mapping[Any, Any]) -> bytes:
        return hashed("items", *sorted(self.digest(key) + self.digest(entry) for key, entry in entries.items()))


def codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """A function's code and that of the functions in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from codes(constant)


def _is_known(value: Any) -> bool:
    return (value.__module__ or "builtins").partition(".")[0] in _KNOWN


def _tensor(value: Tensor) -> bytes:
    flat = value.detach().cpu().contiguous().reshape(-1)
    content = flat.view(torch.uint8).numpy().data if flat.numel() else b""
    return hashed("tensor", str(value.dtype), str(tuple(value.shape)), content)


def _name(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def hashed(*parts: str | bytes | memoryview) -> bytes:
    """Hash of a list of parts, 16 bytes."""
    result = hashlib.blake2b(digest_size=16)
    for part in _encoded(parts):
        # With its length, so that no two lists of parts are one text.
        result.update(len(part).to_bytes(8, "little"))
        result.update(part)
    return result.digest()


def _encoded(parts: Iterable[str | bytes | memoryview]) -> Iterable[bytes | memoryview]:
    return (part.encode() if isinstance(part, str) else part for part in parts)
