"""What an object is, as a short text: the same for equal content in any process, another one as soon as a number differs.

A run folder belongs to one run, a checkpoint to one problem. Names do not tell problems, policies and rules apart; a hash of
all that they hold does.
"""

from __future__ import annotations

import functools
import hashlib
import types
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

__all__ = ["digest", "identity"]

# What a module holds of its own; hooks, the mode and caches say nothing of what it computes.
_MODULE_CONTENT = ("_parameters", "_buffers", "_modules")
_PLAIN = (int, float, str, bytes, bool, type(None), tuple, frozenset, torch.dtype)


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
    defaults, closures and the plain global values that they read; other objects with their class and what they are pickled by.

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
        if isinstance(value, _PLAIN) and not isinstance(value, (tuple, frozenset)):
            return _hash("plain", type(value).__name__, repr(value))
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
            return _hash("tensordict", str(tuple(value.batch_size)), self._items(leaves))
        if isinstance(value, Mapping):
            return _hash("mapping", self._items(value))
        if isinstance(value, (list, tuple)):
            return _hash(type(value).__name__, *map(self.digest, value))
        if isinstance(value, (set, frozenset)):
            return _hash("set", *sorted(map(self.digest, value)))
        if isinstance(value, torch.device):
            return _hash("device")
        if isinstance(value, torch.Generator):
            return _hash("generator", _tensor(value.get_state()))
        if isinstance(value, type):
            return _hash("class", _name(value))
        if callable(value) and not isinstance(value, nn.Module):
            found = self._function(value)
            if found is not None:
                return found
        return _hash("object", _name(type(value)), self._state(value))

    def _function(self, value: Any) -> bytes | None:
        """Digest of a function, method or partial; None for other objects that can be called."""
        if isinstance(value, functools.partial):
            return _hash("partial", *map(self.digest, (value.func, value.args, value.keywords)))
        if isinstance(value, types.MethodType):
            return _hash("method", *map(self.digest, (value.__func__, value.__self__)))
        if isinstance(value, types.BuiltinFunctionType):
            return _hash("builtin", _name(value))
        if not isinstance(value, types.FunctionType):
            return None
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        read = {n: value.__globals__.get(n) for n in value.__code__.co_names if isinstance(value.__globals__.get(n), _PLAIN)}
        parts = (value.__defaults__, value.__kwdefaults__, cells, read)
        return _hash("function", _name(value), self._code(value.__code__), *map(self.digest, parts))

    def _code(self, code: types.CodeType) -> bytes:
        constants = [self._code(c) if isinstance(c, types.CodeType) else self.digest(c) for c in code.co_consts]
        return _hash("code", code.co_code, repr((code.co_names, code.co_varnames)), *constants)

    def _state(self, value: Any) -> bytes:
        state = value.__getstate__()
        if isinstance(value, nn.Module) and isinstance(state, dict):
            own = set(nn.Module().__dict__).difference(_MODULE_CONTENT)
            state = {key: entry for key, entry in state.items() if key not in own}
        return self.digest(state)

    def _items(self, entries: Mapping[Any, Any]) -> bytes:
        return _hash("items", *sorted(self.digest(key) + self.digest(entry) for key, entry in entries.items()))


def _tensor(value: Tensor) -> bytes:
    flat = value.detach().cpu().contiguous().reshape(-1)
    content = flat.view(torch.uint8).numpy().data if flat.numel() else b""
    return _hash("tensor", str(value.dtype), str(tuple(value.shape)), content)


def _name(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _hash(*parts: str | bytes | memoryview) -> bytes:
    result = hashlib.blake2b(digest_size=16)
    for part in _encoded(parts):
        # With its length, so that no two lists of parts are one text.
        result.update(len(part).to_bytes(8, "little"))
        result.update(part)
    return result.digest()


def _encoded(parts: Iterable[str | bytes | memoryview]) -> Iterable[bytes | memoryview]:
    return (part.encode() if isinstance(part, str) else part for part in parts)
