"""Hostile values by kind of argument: what no argument of the kind may be."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

NAN, INF, HUGE = float("nan"), float("inf"), 10**12


class Hostile(NamedTuple):
    """A value that an argument must not have.

    Attributes:
        label: what it is, for messages.
        value: the value.
        refused: where: "at once", by the call itself; "in use", at the latest when what the call made is used, for callables
            whose results are wrong; "or harmless": it may also be accepted if what the call made can be used.
        names: what the refusal may name instead of the argument: the entries of a feature state.
    """

    label: str
    value: Any
    refused: Literal["at once", "in use", "or harmless"] = "at once"
    names: tuple[str, ...] = ()


def values(*given: Any) -> list[Hostile]:
    return [Hostile(_label(value), value) for value in given]


def _label(value: Any) -> str:
    """A short text; what has no short one is told by its class."""
    plain = isinstance(value, (str, bytes, int, float, complex, list, tuple, dict, type, torch.dtype)) or value is None
    text = repr(value)
    return text if plain and len(text) <= 80 else f"a {type(value).__name__}"


# ---- numbers and texts ----------------------------------------------------------------------------------------------


def integers(least: int | None = None, most: int | None = None) -> list[Hostile]:
    wrong = values(True, 1.5, NAN, INF, "1", b"1", None, [], [1], {}, 1j, torch.ones(2, dtype=torch.int64), object())
    wrong += [] if least is None else values(least - 1, -HUGE, -(10**30))
    if most is not None:
        return wrong + values(most + 1, 10**30)
    return wrong + [hostile._replace(refused="or harmless") for hostile in values(HUGE, 10**30)]


def seeds() -> list[Hostile]:
    """Seeds of PyTorch's generators; where noise is a hash of the seed, any integer will do."""
    return integers(0, 2**63 - 1)


def numbers(interval: str) -> list[Hostile]:
    low, high = (float(bound) for bound in interval[1:-1].split(","))
    below = [-1e300, low - 1e-6, *([low] if interval[0] == "(" else [])] if low > -INF else []
    above = [1e300, high + 1e-6, *([high] if interval[-1] == ")" else [])] if high < INF else []
    # As an exponent or a step size a huge number may overflow.
    huge = [] if high < INF else [Hostile("1e300", 1e300, "or harmless")]
    kinds = values(True, "0.5", b"1", None, [], [0.5], {}, 1j, torch.ones(2), object())
    return kinds + values(NAN, INF, -INF, *below, *above) + [*huge, Hostile("10**400", 10**400)]


def flags() -> list[Hostile]:
    return values(0, 1, 1.0, NAN, None, "", "yes", [], [True], torch.ones(2))


def choices() -> list[Hostile]:
    return values("", "no such", "\x1b[31m", b"", None, 3, True, NAN, [], ["soft"], object())


def sizes() -> list[Hostile]:
    wrong = [(0,), (-1,), (1.5,), (True,), (NAN,), ("4",), (None,), ([4],), (4, 0), (HUGE,), (10**30,)]
    return values((), None, 3, "44", b"44", NAN, {}, object(), *wrong)


def texts() -> list[Hostile]:
    return values("", "\x1b[31m", "a\nb", b"x", None, 3, True, NAN, [], ["x"], object())


def paths() -> list[Hostile]:
    return values("", " ", "a\0b", b"x", 3, True, NAN, None, [], ["x"], object())


def devices() -> list[Hostile]:
    return values("", "nonsense", "cuda:99", b"cpu", 3, True, NAN, None, [], object())


def dtypes() -> list[Hostile]:
    others = (torch.float16, torch.bfloat16, torch.int64, torch.bool, torch.complex64)
    return values(*others, float, "float32", None, 3, [], object())


# ---- objects and sequences ------------------------------------------------------------------------------------------


def objects(*others: Any) -> list[Hostile]:
    """No instance of the class that is meant, whichever it is; ``others``: further things that are none."""
    return values(None, 3, True, NAN, "line3", b"x", [], {}, object(), torch.ones(2), int, *others)


def not_callable() -> list[Hostile]:
    return values(None, 3, True, NAN, "greedy", b"x", [], {}, object(), torch.ones(2))


def sequences(valid: Sequence[Any], *members: Any, free: bool = True, empty: bool = True) -> list[Hostile]:
    """No sequences, and sequences like ``valid`` with one of ``members`` at the end.

    Args:
        free: whether the length may be another; else one more and one less are refused.
        empty: whether the empty sequence is refused.
    """
    whole = tuple(valid)
    wrong = {f"[..., {_label(member)}]": (*whole[:-1], member) for member in members}
    wrong |= {} if free else {"one too few": whole[:-1], "one too many": (*whole, *whole[-1:])}
    wrong |= {"()": ()} if empty else {}
    return values(None, 3, True, NAN, "x", object()) + [Hostile(label, value) for label, value in wrong.items()]


def mappings() -> list[Hostile]:
    return values(None, 3, True, NAN, "x", [], object())


# ---- tensors --------------------------------------------------------------------------------------------------------


def _with_first(valid: Tensor, number: float) -> Tensor:
    result = valid.clone()
    result[(0,) * valid.ndim] = number
    return result


def tensors(valid: Tensor, *numbers: float, free: bool = False) -> list[Hostile]:
    """Tensors unlike ``valid``, and some with one of ``numbers`` in it; ``free``: the last size may be any, but not 0."""
    wrong = {
        "one dimension more": valid.unsqueeze(0),
        "empty": valid[..., :0],
        "complex": valid.to(torch.complex64),
        "with NaN": _with_first(valid, NAN),
        "with inf": _with_first(valid, INF),
        **{f"with {number}": _with_first(valid, number) for number in numbers},
    }
    if not free:
        wrong["too long"] = torch.cat([valid, valid[..., :1]], -1)
    ragged = [Hostile("ragged lists", [[1.0], [1.0, 2.0]])]
    return values(None, "x", 3, {}, object()) + ragged + [Hostile(label, value) for label, value in wrong.items()]


def probabilities(valid: Tensor, *, free: bool = False) -> list[Hostile]:
    sums = {"all zero": torch.zeros_like(valid), "all one": torch.ones_like(valid), "halved": valid / 2}
    negative = torch.zeros_like(valid)
    negative[..., 0], negative[..., 1] = -1.0, 2.0
    wrong = {**sums, "negative": negative}
    return tensors(valid, 1.5, free=free) + [Hostile(label, value) for label, value in wrong.items()]


def keys() -> list[Hostile]:
    wrong = {"float keys": torch.ones(2), "int32 keys": torch.ones(2, dtype=torch.int32), "bool keys": torch.ones(2) > 0}
    return values(None, 3, NAN, "x", [], [1, 2], {}, object()) + [Hostile(label, value) for label, value in wrong.items()]


# ---- feature states -------------------------------------------------------------------------------------------------

STATE_ENTRIES = ("y", "belief", "location", "partition", "action_mask")


def no_states(y: TensorDictBase, *entries: str) -> list[Hostile]:
    """No TensorDicts, and ``y`` without one of the entries that are read."""
    wrong = {f"no {entry}": y.exclude(entry) for entry in entries}
    wrong |= {"no entries": TensorDict({}, y.batch_size)} if entries else {}
    kinds = values(None, 3, NAN, "x", [], {}, object(), torch.ones(2))
    return [h._replace(names=STATE_ENTRIES) for h in kinds + [Hostile(label, value) for label, value in wrong.items()]]


def wrong_entries(y: TensorDictBase) -> list[Hostile]:
    """Feature states of a repair model with beliefs and locations that are none."""
    belief, location = y["belief"], y["location"]
    negative = torch.zeros_like(belief)
    negative[..., 0], negative[..., 1] = -1.0, 2.0
    beliefs = {
        "all zero": torch.zeros_like(belief),
        "all one": torch.ones_like(belief),
        "halved": belief / 2,
        "negative": negative,
        "with NaN": _with_first(belief, NAN),
        "with inf": _with_first(belief, INF),
        "with a level less": belief[..., 1:],
        "with a location less": belief[..., 1:, :],
        "with a dimension more": belief.unsqueeze(-1),
        "in float64": belief.double(),
        "in float16": belief.half(),
        "of integers": belief.round().to(torch.int64),
        "complex": belief.to(torch.complex64),
    }
    locations = {
        "negative": location - 9,
        "too large": location + 99,
        "float": location.float(),
        "int32": location.to(torch.int32),
        "of another robot, too": location.expand(-1, 2),
    }
    wrong = {f"belief {what}": y.copy().set("belief", value) for what, value in beliefs.items()}
    wrong |= {f"location {what}": y.copy().set("location", value) for what, value in locations.items()}
    return [Hostile(label, value, names=STATE_ENTRIES) for label, value in wrong.items()]


def states(y: TensorDictBase) -> list[Hostile]:
    a_dict = Hostile("a dict of entries", dict(y.items()), names=STATE_ENTRIES)
    return [*no_states(y, "belief", "location"), a_dict, *wrong_entries(y)]


def entries(y: TensorDictBase, key: str, wrong: dict[str, Tensor]) -> list[Hostile]:
    """Labelled or played states whose entry ``key`` is wrong."""
    return [Hostile(f"{key} {what}", y.copy().set(key, value), names=(key,)) for what, value in wrong.items()]


def wrong_actions(y: TensorDictBase) -> list[Hostile]:
    action = torch.zeros(y.batch_size, dtype=torch.int64)
    wrong = {"negative": action - 1, "too large": action + 99, "float": action.float(), "int32": action.to(torch.int32)}
    return entries(y, "action", {**wrong, "of shape [N, 1]": action.unsqueeze(-1), "complex": action.to(torch.complex64)})


# ---- functions whose results are wrong ------------------------------------------------------------------------------


def _in_use(functions: dict[str, Callable[..., Any]], names: Iterable[str]) -> list[Hostile]:
    return [Hostile(label, function, "in use", tuple(names)) for label, function in functions.items()]


def policies() -> list[Hostile]:
    """No callables, and policies that write anything but legal controls."""

    def acting(action: Callable[[TensorDictBase], Any]) -> Callable[[TensorDictBase], TensorDictBase]:
        return lambda y: y.set("action", action(y))

    wrong = {
        "policy that gives None": lambda y: None,
        "policy that gives a tensor": lambda y: torch.zeros(y.batch_size, dtype=torch.int64),
        "policy that writes nothing": lambda y: y,
        "policy of -1": acting(lambda y: torch.full(y.batch_size, -1)),
        "policy of 99": acting(lambda y: torch.full(y.batch_size, 99)),
        "policy of floats": acting(lambda y: torch.zeros(y.batch_size)),
        "policy of int32": acting(lambda y: torch.zeros(y.batch_size, dtype=torch.int32)),
        "policy of shape [N, 1]": acting(lambda y: torch.zeros(*y.batch_size, 1, dtype=torch.int64)),
        # At location 0 of a line there is nothing to the left.
        "policy that leaves the graph": acting(lambda y: torch.ones(y.batch_size, dtype=torch.int64)),
    }
    return not_callable() + _in_use(wrong, ("action",))


def generators(valid: Callable[[Tensor], TensorDictBase]) -> list[Hostile]:
    """No callables, and generators of anything but feature states, one for each key."""

    def giving(index: int) -> Callable[[Tensor], Any]:
        return lambda keys: wrong_entries(valid(keys))[index].value

    labels = [hostile.label for hostile in wrong_entries(valid(torch.arange(2)))]
    # More digits than the model's may be rounded.
    rounded = "generator of belief in float64"
    wrong = {
        "generator of None": lambda keys: None,
        "generator of dicts": lambda keys: {},
        "generator of no entries": lambda keys: TensorDict({}, keys.shape),
        "generator of beliefs alone": lambda keys: valid(keys).select("belief"),
        "generator of one state": lambda keys: valid(keys)[:1],
        **{f"generator of {label}": giving(index) for index, label in enumerate(labels)},
    }
    found = _in_use(wrong, STATE_ENTRIES)
    return not_callable() + [h._replace(refused="or harmless") if h.label == rounded else h for h in found]


def terminal_costs() -> list[Hostile]:
    """No callables, and terminal costs that are no finite costs, one for each state."""
    wrong = {
        "terminal cost None": lambda y: None,
        "terminal cost that is a number": lambda y: 0.0,
        "terminal cost that writes nothing": lambda y: y,
        "terminal cost of one number": lambda y: torch.zeros(()),
        "terminal cost of shape [N, 1]": lambda y: torch.zeros(*y.batch_size, 1),
        "terminal cost NaN": lambda y: torch.full(y.batch_size, NAN),
        "terminal cost inf": lambda y: torch.full(y.batch_size, INF),
        "terminal cost -inf": lambda y: torch.full(y.batch_size, -INF),
        "terminal cost written as NaN": lambda y: y.set("state_value", torch.full(y.batch_size, NAN)),
        "terminal cost complex": lambda y: torch.zeros(y.batch_size, dtype=torch.complex64),
    }
    return [hostile for hostile in not_callable() if hostile.value is not None] + _in_use(wrong, ("terminal_cost",))
