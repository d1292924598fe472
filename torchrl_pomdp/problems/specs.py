"""Problems from plain JSON: what a file says of a problem is enough to build it again, and no code of a user is run."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import torch

from torchrl_pomdp.checks import check_flag, check_label, check_mapping, check_sequence, shown
from torchrl_pomdp.envs.generators import FixedBelief
from torchrl_pomdp.envs.partition import SinglePart
from torchrl_pomdp.envs.pomdp_file import parse_pomdp
from torchrl_pomdp.envs.tabular import TabularModel
from torchrl_pomdp.problems.presets import PRESETS, fixed_options, make_problem
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.problems.repair import GRAPHS, STARTS, chain_of, has_six_parts, repair_problem
from torchrl_pomdp.tensor_checks import check_device

__all__ = ["SpecError", "problem_from_spec"]

# The kinds of problems; what else a description of any kind may have.
_COMMON = ("name", "partitioned")
_REPAIR = ("graph", "chain", "degradation", "costs", "discount", "robots", "repair_probability", "start", "partition")
_TABULAR = ("discount", "transition", "observation", "cost", "start", "legal", "terminal", "controls", "observations", "states")
# What the library's functions call what descriptions call otherwise.
_RENAMED = {
    "num_robots": "robots",
    "control_names": "controls",
    "observation_names": "observations",
    "state_names": "states",
    "belief": "start",
}


class SpecError(ValueError):
    """A description of a problem is wrong; ``key`` is the path of the entry, such as ``("repair", "costs")``."""

    def __init__(self, key: tuple[str, ...], message: str) -> None:
        super().__init__(f"{'.'.join(key)} of spec: {message}" if key else message)
        self.key, self.message = key, message


def problem_from_spec(spec: Mapping[str, Any], *, device: torch.device | str = "cpu") -> Problem:
    """Build the problem that :attr:`Problem.spec` describes.

    Args:
        spec: one of ``preset``, the name of a known problem, with its options beside it; ``repair``, a table of graph, chain,
            costs, discount and more; ``tabular``, a table of arrays; ``pomdp``, the text of a file ``.POMDP``. Beside it
            ``name``, and ``partitioned``, false for a single part. The how-to page on problems of one's own shows all entries.

    Keyword Args:
        device: where the model computes.

    Raises:
        TypeError: if it is no mapping from texts.
        SpecError: a ``ValueError`` that knows the entry, if it describes no problem.

    Examples:
        >>> problem_from_spec({"preset": "tiger", "discount": 0.75}).model.discount
        0.75
        >>> costs = {"degradation": [0.0, 0.1], "costs": [0, 1, 5], "discount": 0.95}
        >>> problem_from_spec({"repair": {"graph": {"line": 4}, **costs}}).model.describe()
        'line of 4, 1 robot: 3.2e+02 states, 3 controls, 3 observations, discount 0.95'
    """
    check_mapping("spec", spec, object)
    device = check_device("device", device)
    kinds = [kind for kind in ("preset", "repair", "tabular", "pomdp") if kind in spec]
    if len(kinds) != 1:
        found = f"{kinds[0]} and {kinds[1]}" if kinds else f"the entries {sorted(spec)}"
        raise SpecError((), f"spec must have exactly one of preset, repair, tabular and pomdp, got {found}")
    (kind,) = kinds
    rest = {key: value for key, value in spec.items() if key not in (kind, *_COMMON)}
    if rest and kind != "preset":
        raise SpecError((next(iter(rest)),), f"unknown entry beside {kind}; allowed are {', '.join(_COMMON)}")
    partitioned = _checked((), "partitioned", lambda: check_flag("partitioned", spec.get("partitioned", True)))
    name = _checked((), "name", lambda: check_label("name", spec["name"])) if "name" in spec else None
    problem = _BUILDERS[kind](spec[kind], rest, device)
    own = {key: value for key, value in spec.items() if key != "partitioned"}
    problem = replace(problem, name=name or problem.name, spec=own)
    return problem if partitioned else problem.unpartitioned()


def _checked(path: tuple[str, ...], default: str, build: Callable[[], Any]) -> Any:
    """What ``build`` makes; its errors name an argument first, which tells the entry."""
    try:
        return build()
    except SpecError:
        raise
    except (ValueError, TypeError, OverflowError) as error:
        raise SpecError((*path, *filter(None, [_named(str(error), path, default)])), str(error)) from error


def _named(message: str, path: tuple[str, ...], default: str) -> str:
    """The entry that a message speaks of, the first word that names one."""
    entries = {"repair": _REPAIR, "tabular": _TABULAR}.get(".".join(path), ())
    for word in re.findall(r"\w+", message):
        name = _RENAMED.get(word, word)
        if name in entries:
            return name
    return default


def _table(path: str, value: Any, allowed: tuple[str, ...], needed: tuple[str, ...]) -> dict[str, Any]:
    """The entries of a table, none unknown, none missing."""
    if not isinstance(value, Mapping):
        raise SpecError((path,), f"must be a table, got {shown(value)}")
    for key in value:
        if key not in allowed:
            raise SpecError((path, str(key)), f"unknown entry; allowed are {', '.join(allowed)}")
    for key in needed:
        if key not in value:
            raise SpecError((path,), f"lacks the entry {key}; needed are {', '.join(needed)}")
    return dict(value)


def _one_of(path: tuple[str, ...], value: Any, known: Mapping[str, Callable[..., Any]]) -> tuple[str, dict[str, Any]]:
    """The kind of a table, the one of its entries that is ``known``, and its other entries."""
    kinds = [kind for kind in known if isinstance(value, Mapping) and kind in value]
    if len(kinds) != 1:
        raise SpecError(path, f"must be a table with exactly one of {', '.join(known)}, got {shown(value)}")
    options = {key: entry for key, entry in value.items() if key != kinds[0]}
    # What follows the star of the function is what a file may say beside the kind.
    takes = [each.name for each in inspect.signature(known[kinds[0]]).parameters.values() if each.kind is each.KEYWORD_ONLY]
    _check_options(path, kinds[0], options, takes)
    return kinds[0], options


def _check_options(path: tuple[str, ...], kind: str, options: Mapping[str, Any], takes: Sequence[str]) -> None:
    """Raise if a kind is given an option that it does not take."""
    for key in options:
        if key not in takes:
            raise SpecError((*path, key), f"{kind} takes no such option; allowed are {', '.join(takes) or 'none'}")


def _numbers(path: str, table: Mapping[str, Any], name: str) -> torch.Tensor:
    try:
        return torch.tensor(table[name], dtype=torch.float64)
    except (ValueError, TypeError, RuntimeError, OverflowError) as error:
        raise SpecError((path, name), f"must be an array of numbers, got {shown(table[name])}") from error


def _flags(path: str, table: Mapping[str, Any], name: str) -> torch.Tensor:
    """An array of truth values; 0 and 1 are some."""
    numbers = _numbers(path, table, name)
    if not bool(((numbers == 0) | (numbers == 1)).all()):
        raise SpecError((path, name), f"must be an array of truth values, got {shown(table[name])}")
    return numbers.bool()


def _names(path: str, table: Mapping[str, Any], name: str) -> tuple[str, ...]:
    return tuple(_checked((path, name), "", lambda: check_sequence(name, table[name], str)))


def _preset(value: Any, options: Mapping[str, Any], device: torch.device) -> Problem:
    if not isinstance(value, str) or value not in PRESETS:
        raise SpecError(("preset",), f"must be one of {', '.join(sorted(PRESETS))}, got {shown(value)}")
    # Of what the function takes, what a file can say.
    unsaid = {"graph", "start", "name", "device", *fixed_options(value)}
    takes = [key for key in inspect.signature(PRESETS[value]).parameters if key not in unsaid]
    _check_options((), value, options, takes)
    try:
        return make_problem(value, device=device, **options)
    except (ValueError, TypeError) as error:
        # A function says of unknown options no more than that they are.
        named = next((key for key in options if key in str(error)), "preset")
        raise SpecError((named,), str(error)) from error


def _repair(value: Any, _: Mapping[str, Any], device: torch.device) -> Problem:
    table = _table("repair", value, _REPAIR, ("graph", "costs", "discount"))
    if ("chain" in table) == ("degradation" in table):
        raise SpecError(("repair",), "must have either chain or degradation")
    kind, options = _one_of(("repair", "graph"), table["graph"], GRAPHS)
    graph = _checked(("repair", "graph"), "", lambda: GRAPHS[kind](table["graph"][kind], **options))
    starts = table.get("start", {"calibrated": 0.7})
    started, more = _one_of(("repair", "start"), starts, STARTS)
    partition = table.get("partition")
    if partition not in (None, "six", "single"):
        raise SpecError(("repair", "partition"), f"must be one of six, single, got {shown(partition)}")
    if partition == "six" and not has_six_parts(graph):
        raise SpecError(("repair", "partition"), f"must be single: of six, some parts of the {graph.name} have no states")
    return _checked(
        ("repair",),
        "start",
        lambda: repair_problem(
            graph,
            chain_of(table.get("chain"), table.get("degradation")),
            _numbers("repair", table, "costs"),
            table["discount"],
            num_robots=table.get("robots", 1),
            repair_probability=table.get("repair_probability", 1.0),
            start=lambda model: _checked(("repair", "start"), "", lambda: STARTS[started](model, starts[started], **more)),
            partition=SinglePart() if partition == "single" else None,
            device=device,
        ),
    )


def _tabular(value: Any, _: Mapping[str, Any], device: torch.device) -> Problem:
    table = _table("tabular", value, _TABULAR, ("discount", "transition", "observation", "cost", "start"))

    def given(name: str, read: Callable[[str, Mapping[str, Any], str], Any] = _numbers) -> Any:
        return read("tabular", table, name) if name in table else None

    def build() -> Problem:
        names = {"control_names": "controls", "observation_names": "observations", "state_names": "states"}
        model = TabularModel(
            given("transition"),
            given("observation"),
            given("cost"),
            table["discount"],
            legal=given("legal", _flags),
            terminal=given("terminal", _flags),
            device=device,
            **cast(Any, {argument: given(key, _names) for argument, key in names.items()}),
        )
        start = given("start")
        if start.shape != (model.num_states,):
            raise ValueError(f"start must be a distribution over {model.num_states} states, got {shown(table['start'])}")
        return Problem(model, FixedBelief(start.to(device, model.dtype)), name="tabular")

    return _checked(("tabular",), "transition", build)


def _pomdp(value: Any, _: Mapping[str, Any], device: torch.device) -> Problem:
    if not isinstance(value, str):
        raise SpecError(("pomdp",), f"must be the text of a file .POMDP, got {shown(value)}")
    model, start = _checked((), "pomdp", lambda: parse_pomdp(value, device=device))
    return Problem(model, start, name="pomdp")


_BUILDERS = {"preset": _preset, "repair": _repair, "tabular": _tabular, "pomdp": _pomdp}
