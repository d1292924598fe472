"""What an object is, as a short text: the same for equal content in any process, another one as soon as a number differs.

A run folder belongs to one run, a checkpoint to one problem. Names do not tell problems, policies and rules apart; a hash of
all that they hold does.
"""

from __future__ import annotations

import copyreg
import dis
import functools
import hashlib
import sys
import types
from collections import ChainMap
from collections.abc import Iterable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase, is_leaf_nontensor, is_non_tensor
from torch import Tensor, nn

__all__ = ["digest", "identity"]

# What a module holds of its own; hooks, the mode and caches say nothing of what it computes.
_MODULE_CONTENT = ("_parameters", "_buffers", "_modules")
_PLAIN = (int, float, complex, str, bytes, bool, type(None), torch.dtype)
# What a class has of its making, not of what it does; and what enumerations find out as they are used.
_SAYS_NOTHING = {
    *("__module__", "__doc__", "__dict__", "__weakref__", "__firstlineno__", "__static_attributes__", "__slotnames__"),
    *("__annotations__", "__annotate_func__", "__annotations_cache__", "_abc_impl"),
    *("_value2member_map_", "_hashable_values_", "_unhashable_values_", "_unhashable_values_map_"),
}
_DESCRIPTORS = (types.MemberDescriptorType, types.GetSetDescriptorType, types.WrapperDescriptorType, types.MethodDescriptorType)
# Names say enough of these packages, of any version; compiled code on disk belongs to one version of the first ones.
_FOUNDATIONS = sys.stdlib_module_names.union(sys.builtin_module_names, ("numpy", "numba"))
_LIBRARIES = _FOUNDATIONS.union(("torchrl_pomdp", "torch", "torchrl", "tensordict", "gymnasium", "tqdm", "tyro"))
_INSTALLED = {"site-packages", "dist-packages"}


def identity(value: Any) -> str:
    """Class and content of an object, for records of runs.

    Examples:
        >>> identity(nn.ReLU()).split()[0]
        'ReLU'
    """
    return f"{type(value).__name__} {digest(value)}"


def digest(value: Any, libraries: bool = False) -> str:
    """Hash of all that an object holds, 32 hexadecimal digits; the device does not matter.

    Tensors count with type, shape and numbers; modules with parameters, buffers and attributes; functions, compiled or not,
    with their code, defaults, closures, attributes and the globals and imports that they read, those of other modules too;
    classes with all that they define; other objects with their class and what they are pickled by. Objects that lead back to
    themselves have equal digests if no way through them tells them apart. Cached properties do not count.

    Args:
        value: the object.
        libraries: whether what libraries define counts with its content too. If not, functions and classes count by name where
            this library, what it builds on and the standard library define them, and by name and version where other
            installed packages do.

    Raises:
        TypeError: if an object holds what cannot be told, such as an open file.

    Examples:
        >>> digest({"a": torch.arange(3)}) == digest({"a": torch.arange(3)}), digest(1.0) == digest(2.0)
        (True, False)
    """
    return _Graph(libraries).digest(value).hex()


class _Content(NamedTuple):
    """What an object says itself, what it holds in an order, and what it holds in none: groups of values."""

    label: bytes
    ordered: list[Any]
    groups: list[tuple[Any, ...]]


def _content(*label: str | bytes | memoryview, holds: Iterable[Any] = (), groups: Iterable[tuple[Any, ...]] = ()) -> _Content:
    return _Content(_hashed(*label), [*holds], [*groups])


# The digest of what is plain; the number of what is not.
_Key = bytes | int


class _Graph:
    """Objects and what they hold. Their digests are computed group by group of such as lead to each other."""

    def __init__(self, libraries: bool) -> None:
        self._libraries = libraries
        # What says enough of what a package defines; None: only its content does.
        self._said: dict[str, str | None] = {}
        # The objects themselves are kept: the number of one that is gone may be another's.
        self._values: dict[int, Any] = {}
        self._contents: dict[int, _Content] = {}
        self._digests: dict[int, bytes] = {}

    def digest(self, value: Any) -> bytes:
        """Tarjan's algorithm, without recursion: chains of objects may be long."""
        root = self._key(value)
        if isinstance(root, bytes):
            return root
        number: dict[int, int] = {}
        lowest: dict[int, int] = {}
        waiting: list[int] = []
        path: list[tuple[int, Iterator[int]]] = []

        def enter(key: int) -> None:
            number[key] = lowest[key] = len(number)
            waiting.append(key)
            path.append((key, self._held(key)))

        enter(root)
        while path:
            key, held = path[-1]
            for other in held:
                if other not in number:
                    enter(other)
                    break
                if other not in self._digests:
                    lowest[key] = min(lowest[key], number[other])
            else:
                path.pop()
                if path:
                    lowest[path[-1][0]] = min(lowest[path[-1][0]], lowest[key])
                if lowest[key] == number[key]:
                    members = [waiting.pop()]
                    while members[-1] != key:
                        members.append(waiting.pop())
                    self._close(members)
        return self._digests[root]

    def _key(self, value: Any) -> _Key:
        if type(value) in _PLAIN:
            return _hashed("plain", type(value).__name__, repr(value))
        self._values[id(value)] = value
        return id(value)

    def _held(self, key: int) -> Iterator[int]:
        """The objects that an object holds, which is looked at."""
        value = self._values[key]
        try:
            found = self._look(value)
        except Exception as error:
            name = _name(type(value))
            raise TypeError(f"what a {name} holds cannot be told, so no file can say that it belongs to it: {error}") from error
        ordered = [self._key(each) for each in found.ordered]
        groups = [tuple(map(self._key, group)) for group in found.groups]
        self._contents[key] = _Content(found.label, ordered, groups)
        return (each for group in (ordered, *groups) for each in group if isinstance(each, int))

    def _close(self, members: list[int]) -> None:
        """The digests of objects that lead to each other, when those of all else that they lead to are known."""
        if len(members) == 1 and members[0] not in self._contents[members[0]].ordered:
            alone = self._contents[members[0]]
            if not any(members[0] in group for group in alone.groups):
                self._digests[members[0]] = self._told(alone, self._digests)
                return
        # Rounds tell apart what differs within as many steps, until another one tells no more apart.
        colours = dict.fromkeys(members, b"")
        while True:
            known = ChainMap(colours, self._digests)
            finer = {key: self._told(self._contents[key], known) for key in members}
            if len(set(finer.values())) == len(set(colours.values())):
                break
            colours = finer
        whole = sorted({colours[key] + finer[key] for key in members})
        self._digests |= {key: _hashed("leads to itself", finer[key], *whole) for key in members}

    def _told(self, content: _Content, digests: Mapping[int, bytes]) -> bytes:
        def told(keys: Iterable[_Key]) -> list[bytes]:
            return [key if isinstance(key, bytes) else digests[key] for key in keys]

        groups = sorted(b"".join(told(group)) for group in content.groups)
        return _hashed(content.label, *told(content.ordered), "in no order", *groups)

    # ---- kinds of objects ------------------------------------------------------------------------------------------------

    def _look(self, value: Any) -> _Content:
        if isinstance(value, Tensor):
            return _tensor(value)
        if is_non_tensor(value):
            return _content("no tensor", holds=[value.tolist()])
        if isinstance(value, TensorDictBase):
            keys = value.keys(include_nested=True, leaves_only=True, is_leaf=is_leaf_nontensor)
            leaves = {str(key): value.get(key) for key in keys}
            return _content("tensordict", str(tuple(value.batch_size)), groups=leaves.items())
        if type(value) in (dict, types.MappingProxyType):
            # The order of layers, or of the parts that are sampled from, decides what they give.
            return _content("mapping", holds=[each for item in value.items() for each in item])
        if type(value) in (list, tuple):
            return _content(type(value).__name__, holds=value)
        if type(value) in (set, frozenset):
            return _content("set", groups=((each,) for each in value))
        if isinstance(value, torch.device):
            return _content("device")
        if isinstance(value, torch.Generator):
            return _content("generator", holds=[value.get_state()])
        if isinstance(value, types.ModuleType):
            return _content("module", value.__name__)
        if isinstance(value, types.CodeType):
            return _code(value)
        if isinstance(value, types.CellType):
            return _content("cell", holds=[value.cell_contents] if value != types.CellType() else [])
        if isinstance(value, (staticmethod, classmethod, functools._lru_cache_wrapper)):
            return _content(type(value).__name__, holds=[value.__wrapped__])
        if isinstance(value, property):
            return _content("property", holds=[value.fget, value.fset])
        if isinstance(value, functools.cached_property):
            return _content("property", holds=[value.func])
        if isinstance(value, _DESCRIPTORS):
            return _content("descriptor", value.__name__)
        if isinstance(value, type):
            return self._class(value)
        if isinstance(value, types.FunctionType):
            return self._function(value)
        if isinstance(value, types.MethodType):
            return _content("method", holds=[value.__func__, value.__self__])
        if isinstance(value, types.BuiltinFunctionType):
            own = None if isinstance(value.__self__, types.ModuleType) else value.__self__
            return _content("builtin", _name(value), holds=[own])
        if isinstance(value, (functools.partial, functools.partialmethod)):
            return _content("partial", holds=[value.func, value.args, value.keywords, vars(value)])
        if isinstance(getattr(value, "py_func", None), types.FunctionType):
            return _content("compiled", holds=[value.py_func, getattr(value, "targetoptions", None)])
        return _content("object", holds=[type(value), *_state(value)])

    def _class(self, value: type) -> _Content:
        """A class by name, and by what it defines unless names say enough."""
        said = self._said_of(value.__module__ or "builtins")
        if said is not None:
            return _content("class", _name(value), said)
        own = {name: entry for name, entry in vars(value).items() if name not in _SAYS_NOTHING}
        return _content("class", _name(value), holds=[type(value), *value.__bases__], groups=own.items())

    def _function(self, value: types.FunctionType) -> _Content:
        """A function by name, defaults and closure, and by code, attributes and what it reads unless names say enough."""
        module = value.__globals__.get("__name__")
        # Neither changes where a function is wrapped or renamed.
        name = f"{module}.{value.__code__.co_qualname}"
        bound = [value.__defaults__, value.__kwdefaults__, value.__closure__]
        if module == functools.__name__ and hasattr(value, "registry"):
            return _content("function", name, holds=[dict(value.registry)])
        said = None if module is None else self._said_of(module)
        if said is not None:
            return _content("function", name, said, holds=bound)
        return _content("function", name, holds=[value.__code__, value.__dict__, self._read(value), *bound])

    def _read(self, function: types.FunctionType) -> dict[str, Any]:
        """What a function reads: globals, what it imports, and what it may use of these modules."""
        every = [*_codes(function.__code__)]
        # In an order of its own: that of a set is another one in each process.
        names = sorted({name for code in every for name in code.co_names})
        read = {name: function.__globals__[name] for name in names if name in function.__globals__}
        for code in every:
            read |= {f"import {way}": module for way, module in self._imports(code, function.__globals__)}
        modules = [entry for entry in read.items() if isinstance(entry[1], types.ModuleType)]
        for way, module in modules:
            if self._said_of(module.__name__) is None:
                found = {f"{way}.{name}": getattr(module, name) for name in names if hasattr(module, name)}
                inner = (entry for entry in found.items() if isinstance(entry[1], types.ModuleType))
                # A module may lead back to itself.
                modules += [entry for entry in inner if all(entry[1] is not each for _, each in modules)]
                read |= found
        return read

    def _imports(self, code: types.CodeType, space: dict[str, Any]) -> Iterator[tuple[str, types.ModuleType]]:
        """Modules that code imports, but for those of which names say enough and those that are not there."""
        done = [*dis.get_instructions(code)]
        for level, names, each in zip(done, done[1:], done[2:], strict=False):
            if each.opname == "IMPORT_NAME" and (level.argval or self._said_of(each.argval) is None):
                try:
                    yield each.argval, __import__(each.argval, space, None, names.argval or (), level.argval)
                except ImportError:
                    continue

    def _said_of(self, module: str) -> str | None:
        """What says enough, beside its name, of what a module defines; None: its content counts."""
        package = module.partition(".")[0]
        if package not in self._said:
            known = package in (_FOUNDATIONS if self._libraries else _LIBRARIES)
            self._said[package] = "" if known else None if self._libraries else _version(package)
        return self._said[package]


def _version(package: str) -> str | None:
    """Version of an installed package; None for what is not installed, such as a script."""
    module = sys.modules.get(package)
    try:
        spec = None if module else find_spec(package)
    except (ImportError, ValueError):
        return None
    origin = getattr(module, "__file__", None) or (spec and spec.origin)
    return str(getattr(module, "__version__", "")) if origin and _INSTALLED.intersection(Path(origin).parts) else None


def _state(value: Any) -> list[Any]:
    """What an object would be pickled by, without cached properties."""
    kind = type(value)
    own_way = (kind.__reduce_ex__, kind.__reduce__) != (object.__reduce_ex__, object.__reduce__)
    special = copyreg.dispatch_table.get(kind)
    state = None if own_way or special else _lasting(kind, value.__getstate__())
    if isinstance(value, nn.Module) and isinstance(state, dict):
        hooks = set(nn.Module().__dict__).difference(_MODULE_CONTENT)
        kept = {key: each for key, each in state.items() if key not in hooks}
        return [kept, *(list(state[key].values()) for key in sorted(hooks) if key.endswith("hooks") and state[key])]
    if state is not None and not isinstance(value, (list, tuple, dict, set, frozenset)):
        return [state]
    reduced = value.__reduce_ex__(4) if special is None else special(value)
    if isinstance(reduced, str):
        return ["named", reduced]
    make, given, state, *items = (*reduced, None)[:5]
    return [make, given, _lasting(kind, state), *(list(entries) for entries in items if entries is not None)]


def _lasting(kind: type, state: Any) -> Any:
    """State sorted by name, without cached properties, which may not have been read yet."""
    if not isinstance(state, dict):
        return state
    cached = {name for name in state if isinstance(getattr(kind, str(name), None), functools.cached_property)}
    return {name: state[name] for name in sorted(state, key=str) if name not in cached} or None


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """A function's code and that of the functions in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _codes(constant)


def _code(code: types.CodeType) -> _Content:
    arguments = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
    names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
    return _content("code", code.co_code, code.co_exceptiontable, repr((arguments, names)), holds=code.co_consts)


def _tensor(value: Tensor) -> _Content:
    flat = value.detach().cpu().to_dense().contiguous().reshape(-1)
    content = flat.view(torch.uint8).numpy().data if flat.numel() else b""
    return _content("tensor", str(value.dtype), str(value.layout), str(tuple(value.shape)), content)


def _name(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _hashed(*parts: str | bytes | memoryview) -> bytes:
    """Hash of a list of parts, 16 bytes."""
    result = hashlib.blake2b(digest_size=16)
    for part in parts:
        encoded = part.encode() if isinstance(part, str) else part
        # With its length, so that no two lists of parts are one text.
        result.update(len(encoded).to_bytes(8, "little"))
        result.update(encoded)
    return result.digest()
