"""What an object is, as a short text: the same for equal content in any process, another one as soon as a number differs.

A run folder belongs to one run, a checkpoint to one problem. Names do not tell problems, policies and rules apart; a hash of
all that they hold does.
"""

from __future__ import annotations

import functools
import hashlib
import sys
import types
from collections.abc import Iterable, Iterator, Mapping, Set
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

__all__ = ["LIBRARIES", "digest", "identity"]

# What a module holds of its own; hooks, the mode and caches say nothing of what it computes.
_MODULE_CONTENT = ("_parameters", "_buffers", "_modules")
_PLAIN = (int, float, complex, str, bytes, bool, type(None), torch.dtype)
# What a class has of its making, not of what it does.
_SAYS_NOTHING = {
    *("__module__", "__doc__", "__dict__", "__weakref__", "__firstlineno__", "__static_attributes__"),
    *("__slotnames__", "_abc_impl"),
}
_DESCRIPTORS = (types.MemberDescriptorType, types.GetSetDescriptorType, types.WrapperDescriptorType, types.MethodDescriptorType)
LIBRARIES = frozenset(
    {"torch", "torchrl", "tensordict", "numpy", "numba", "tqdm", *sys.builtin_module_names, *sys.stdlib_module_names}
)
"""What this library builds on: there names say enough."""
_BY_NAME = LIBRARIES | {"torchrl_pomdp"}


def identity(value: Any) -> str:
    """Class and content of an object, for records of runs.

    Examples:
        >>> identity(nn.ReLU()).split()[0]
        'ReLU'
    """
    return f"{type(value).__name__} {digest(value)}"


def digest(value: Any, by_name: Set[str] = _BY_NAME) -> str:
    """Hash of all that an object holds, 32 hexadecimal digits; the device does not matter.

    Tensors count with type, shape and numbers; modules with parameters, buffers and attributes; functions, compiled or not,
    with their code, defaults, closures and the globals that they read, those of other modules too; classes with all that they
    define; other objects with their class and what they are pickled by.

    Args:
        value: the object.
        by_name: packages whose functions and classes count by name. By default this library, what it builds on and the
            standard library: their versions are written down beside digests.

    Raises:
        TypeError: if an object holds what cannot be told, such as an open file.

    Examples:
        >>> digest({"a": torch.arange(3)}) == digest({"a": torch.arange(3)}), digest(1.0) == digest(2.0)
        (True, False)
    """
    return _Walk(by_name).digest(value).hex()


class _Walk:
    """Digests of the objects that are met, each computed once."""

    def __init__(self, by_name: Set[str]) -> None:
        self._by_name = by_name
        # The objects themselves are kept: the number of one that is gone may be another's.
        self._known: dict[int, tuple[Any, bytes]] = {}

    def digest(self, value: Any) -> bytes:
        if type(value) in _PLAIN:
            return _hashed("plain", type(value).__name__, repr(value))
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
            return _hashed("tensordict", str(tuple(value.batch_size)), self._items(leaves))
        if type(value) in (dict, types.MappingProxyType):
            return _hashed("mapping", self._items(value))
        if type(value) in (list, tuple):
            return _hashed(type(value).__name__, *map(self.digest, value))
        if type(value) in (set, frozenset):
            return _hashed("set", *sorted(map(self.digest, value)))
        if isinstance(value, torch.device):
            return _hashed("device")
        if isinstance(value, torch.Generator):
            return _hashed("generator", _tensor(value.get_state()))
        if isinstance(value, types.ModuleType):
            return _hashed("module", value.__name__)
        if isinstance(value, types.CodeType):
            return self._code(value)
        if isinstance(value, (staticmethod, classmethod, functools._lru_cache_wrapper)):
            return _hashed(type(value).__name__, self.digest(value.__wrapped__))
        if isinstance(value, property):
            return _hashed("property", *map(self.digest, (value.fget, value.fset)))
        if isinstance(value, functools.cached_property):
            return _hashed("property", self.digest(value.func))
        if isinstance(value, _DESCRIPTORS):
            return _hashed("descriptor", value.__name__)
        if isinstance(value, type):
            return self._class(value)
        if isinstance(value, types.FunctionType):
            return self._function(value)
        if isinstance(value, types.MethodType):
            return _hashed("method", *map(self.digest, (value.__func__, value.__self__)))
        if isinstance(value, types.BuiltinFunctionType):
            own = None if isinstance(value.__self__, types.ModuleType) else value.__self__
            return _hashed("builtin", _name(value), self.digest(own))
        if isinstance(value, (functools.partial, functools.partialmethod)):
            return _hashed("partial", *map(self.digest, (value.func, value.args, value.keywords)))
        compiled = getattr(value, "py_func", None)
        if isinstance(compiled, types.FunctionType):
            return _hashed("compiled", self.digest(compiled))
        return _hashed("object", self._class(type(value)), self._state(value))

    def _class(self, value: type) -> bytes:
        """A class by name, and by what it defines unless names say enough."""
        if self._is_known(value.__module__):
            return _hashed("class", _name(value))
        own = {name: entry for name, entry in vars(value).items() if name not in _SAYS_NOTHING}
        return _hashed("class", _name(value), *(self.digest(base) for base in value.__bases__), self._items(own))

    def _function(self, value: types.FunctionType) -> bytes:
        """A function by name, defaults and closure, and by code and the globals that it reads unless names say enough."""
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        bound = (value.__defaults__, value.__kwdefaults__, cells)
        # None that is written in Python is of builtins: so are those called that no module made.
        if value.__module__ not in (None, "builtins") and self._is_known(value.__module__):
            return _hashed("function", _name(value), *map(self.digest, bound))
        # In an order of its own: that of a set is another one in each process.
        names = sorted({name for code in _codes(value.__code__) for name in code.co_names})
        read = {name: value.__globals__[name] for name in names if name in value.__globals__}
        modules = [entry for entry in read.items() if isinstance(entry[1], types.ModuleType)]
        for way, module in modules:
            if not self._is_known(module.__name__):
                found = {f"{way}.{name}": getattr(module, name) for name in names if hasattr(module, name)}
                inner = (entry for entry in found.items() if isinstance(entry[1], types.ModuleType))
                # A module may lead back to itself.
                modules += [entry for entry in inner if all(entry[1] is not each for _, each in modules)]
                read |= found
        return _hashed("function", _name(value), self._code(value.__code__), *map(self.digest, (*bound, read)))

    def _code(self, code: types.CodeType) -> bytes:
        constants = [self._code(c) if isinstance(c, types.CodeType) else self.digest(c) for c in code.co_consts]
        return _hashed("code", code.co_code, repr((code.co_names, code.co_varnames)), *constants)

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
            return _hashed("named", reduced)
        make, given, state, *items = (*reduced, None)[:5]
        return self.digest([make, given, state, *(list(entries) for entries in items if entries is not None)])

    def _is_known(self, module: str | None) -> bool:
        return (module or "builtins").partition(".")[0] in self._by_name

    def _items(self, entries: Mapping[Any, Any]) -> bytes:
        return _hashed("items", *sorted(self.digest(key) + self.digest(entry) for key, entry in entries.items()))


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """A function's code and that of the functions in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _codes(constant)


def _tensor(value: Tensor) -> bytes:
    flat = value.detach().cpu().contiguous().reshape(-1)
    content = flat.view(torch.uint8).numpy().data if flat.numel() else b""
    return _hashed("tensor", str(value.dtype), str(tuple(value.shape)), content)


def _name(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _hashed(*parts: str | bytes | memoryview) -> bytes:
    """Hash of a list of parts, 16 bytes."""
    result = hashlib.blake2b(digest_size=16)
    for part in _encoded(parts):
        # With its length, so that no two lists of parts are one text.
        result.update(len(part).to_bytes(8, "little"))
        result.update(part)
    return result.digest()


def _encoded(parts: Iterable[str | bytes | memoryview]) -> Iterable[bytes | memoryview]:
    return (part.encode() if isinstance(part, str) else part for part in parts)
