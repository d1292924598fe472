"""Digests: equal for equal content, different as soon as a number differs, the same in every process."""

from __future__ import annotations

import copy
import enum
import functools
import os
import re
import subprocess
import sys
import textwrap
import threading
import types
from collections import deque
from fractions import Fraction
from typing import NamedTuple

import pytest
import torch
from tensordict import NonTensorStack, TensorDict

from torchrl_pomdp.collectors.states import PartSampler
from torchrl_pomdp.envs.repair import CalibratedStart, grid, line
from torchrl_pomdp.identity import digest, identity
from torchrl_pomdp.modules import MultiagentRollout, PolicyNetwork, RolloutPolicy
from torchrl_pomdp.modules.repair import GreedyRepair, RelativeEncoder
from torchrl_pomdp.problems import make_problem


def adds(n):
    return lambda y: y + n


def default(y, n=1):
    return y + n


def other_default(y, n=2):
    return y + n


class Place(NamedTuple):
    number: int


def network(seed, hidden=(4, 3)):
    model = make_problem("line3").model
    return PolicyNetwork(RelativeEncoder(model), 3, hidden, generator=torch.Generator().manual_seed(seed))


def kind(**entries):
    """A class of a user."""
    return type("Kind", (), {"__module__": __name__, **entries})


def cached(n):
    return functools.cache(adds(n))


def calls(n):
    """A function that reads a compiled or cached helper of its module."""
    source = {"__name__": __name__, "helper": cached(n)}
    exec("def function(y):\n    return helper(y)", source)
    return source["function"]


def asks(n):
    """A function that calls one of another module."""
    helpers = types.ModuleType("helpers")
    helpers.decide = adds(n)
    source = {"__name__": __name__, "helpers": helpers}
    exec("def function(y):\n    return helpers.decide(y)", source)
    return source["function"]


def asks_within(n):
    """A function that calls one of a module in another module, which knows that one."""
    helpers, inner = types.ModuleType("helpers"), types.ModuleType("helpers.inner")
    helpers.inner, inner.decide, inner.helpers = inner, adds(n), helpers
    source = {"__name__": __name__, "helpers": helpers, "inner": inner}
    exec("def function(y):\n    return helpers.inner.decide(helpers, inner.decide(y))", source)
    return source["function"]


def calls_back(n):
    """A function that calls two others, which call each other."""
    source = {"__name__": __name__}
    exec(f"def one(y):\n    return two(y)\ndef two(y):\n    return one(y + {n})", source)
    exec("def function(y):\n    return one(y) + two(y)", source)
    return source["function"]


def imports(n):
    """A function that imports what it calls."""
    module = types.ModuleType("imported")
    module.decide = adds(n)
    sys.modules["imported"] = module
    source = {}
    exec("def function(y):\n    from imported import decide\n    return decide(y)", source)
    return source["function"]


def code(text):
    source = {}
    exec(f"def function(*y):\n{textwrap.indent(text, '    ')}", source)
    return source["function"]


def attribute(n):
    """A function that reads its own attribute."""
    function = code("return function.n")
    function.n = n
    return function


def wrapped(n):
    """A library's function in a user's."""

    def twice(*y):
        return torch.add(*y) * 2

    def thrice(*y):
        return torch.add(*y) * 3

    return functools.wraps(torch.nn.functional.relu)(twice if n == 1 else thrice)


class Node:
    def __init__(self, control):
        self.control, self.next = control, None


def controller(last):
    """A finite-state controller that plays 0, 1 and then what follows node ``last``."""
    nodes = [Node(0), Node(1)]
    nodes[0].next, nodes[1].next = nodes[1], nodes[last]
    return nodes[0]


class Mode(enum.Enum):
    WAIT, GO, LOOK = range(3)


def chain(n):
    """Longer than Python calls functions within functions."""
    first = None
    for _ in range(2000):
        first = [first]
    return [n, first]


# Pairs of makers of what is equal to itself and differs from the other one.
PAIRS = {
    "integers": (lambda: 1, lambda: 2),
    "integer and number": (lambda: 1, lambda: 1.0),
    "flag and integer": (lambda: True, lambda: 1),
    "text and bytes": (lambda: "1", lambda: b"1"),
    "nothing and text": (lambda: None, lambda: "None"),
    "lists": (lambda: [1, 2], lambda: [2, 1]),
    "list and tuple": (lambda: [1, 2], lambda: (1, 2)),
    "nested": (lambda: [[1], [2]], lambda: [[1, 2], []]),
    "texts side by side": (lambda: ["ab", "c"], lambda: ["a", "bc"]),
    "mappings": (lambda: {"a": 1, "b": 2}, lambda: {"a": 2, "b": 1}),
    "sets": (lambda: {1, 2}, lambda: {1, 3}),
    "tensors": (lambda: torch.arange(4), lambda: torch.arange(1, 5)),
    "types": (lambda: torch.ones(2), lambda: torch.ones(2).double()),
    "shapes": (lambda: torch.ones(2, 3), lambda: torch.ones(3, 2)),
    "one ulp": (lambda: torch.ones(1), lambda: torch.ones(1) + 2**-23),
    "empty": (lambda: torch.zeros(0), lambda: torch.zeros(0, 1)),
    "tensordicts": (lambda: TensorDict({"a": torch.ones(2)}, [2]), lambda: TensorDict({"a": torch.ones(2)}, [])),
    "closures": (lambda: adds(1), lambda: adds(2)),
    "defaults": (lambda: default, lambda: other_default),
    "partials": (lambda: functools.partial(default, n=1), lambda: functools.partial(default, n=2)),
    "generators": (lambda: torch.Generator().manual_seed(1), lambda: torch.Generator().manual_seed(2)),
    "graphs": (lambda: line(4), lambda: grid(4, 1)),
    "models": (lambda: make_problem("line3").model, lambda: make_problem("line3", partitioned=False).model),
    "problems": (lambda: make_problem("line3"), lambda: make_problem("linear20")),
    "policies": (lambda: GreedyRepair(make_problem("line3").model), lambda: GreedyRepair(make_problem("line3").model, 0.1)),
    "starts": (
        lambda: CalibratedStart(make_problem("line3").model),
        lambda: CalibratedStart(make_problem("line3").model, observe_start=False),
    ),
    "weights": (lambda: network(0), lambda: network(1)),
    "layers": (lambda: network(0), lambda: network(0, (4,))),
    "methods": (lambda: network(0).forward, lambda: network(1).forward),
    "class attributes": (lambda: kind(n=1), lambda: kind(n=2)),
    "class of sets": (lambda: kind(n={1}), lambda: kind(n={2})),
    "class of fractions": (lambda: kind(n=Fraction(1, 3)), lambda: kind(n=Fraction(2, 3))),
    "class of objects": (lambda: kind(n=kind(m=1)()), lambda: kind(n=kind(m=2)())),
    "class of classes": (lambda: kind(n=kind(m=1)), lambda: kind(n=kind(m=2))),
    "class methods": (lambda: kind(f=adds(1)), lambda: kind(f=adds(2))),
    "properties": (lambda: kind(f=property(adds(1))), lambda: kind(f=property(adds(2)))),
    "static methods": (lambda: kind(f=staticmethod(adds(1))), lambda: kind(f=staticmethod(adds(2)))),
    "cached properties": (
        lambda: kind(f=functools.cached_property(adds(1))),
        lambda: kind(f=functools.cached_property(adds(2))),
    ),
    "cached methods": (lambda: kind(f=cached(1)), lambda: kind(f=cached(2))),
    "partial methods": (
        lambda: kind(f=functools.partialmethod(default, n=1)),
        lambda: kind(f=functools.partialmethod(default, n=2)),
    ),
    "objects of a class": (lambda: kind(n=1)(), lambda: kind(n=2)()),
    "cached helpers": (lambda: calls(1), lambda: calls(2)),
    "helpers of a module": (lambda: asks(1), lambda: asks(2)),
    "helpers of a module in a module": (lambda: asks_within(1), lambda: asks_within(2)),
    "functions that call each other": (lambda: calls_back(1), lambda: calls_back(2)),
    "imported functions": (lambda: imports(1), lambda: imports(2)),
    "arguments": (lambda: code("return y"), lambda: eval("lambda y: y")),
    "what an exception ends": (
        lambda: code("try:\n    print()\n    abs()\nexcept TypeError:\n    pass"),
        lambda: code("print()\ntry:\n    abs()\nexcept TypeError:\n    pass"),
    ),
    "attributes of functions": (lambda: attribute(1), lambda: attribute(2)),
    "wrapped functions": (lambda: wrapped(1), lambda: wrapped(2)),
    "finite-state controllers": (lambda: controller(0), lambda: controller(1)),
    "enumerations": (lambda: Mode.WAIT, lambda: Mode.GO),
    "sets of an enumeration": (lambda: {Mode.WAIT, Mode.GO, Mode.LOOK}, lambda: {Mode.WAIT, Mode.GO}),
    "chains": (lambda: chain(1), lambda: chain(2)),
    "optional types": (lambda: kind(n=int | None), lambda: kind(n=str | None)),
    "patterns": (lambda: re.compile("a"), lambda: re.compile("b")),
    "sparse tensors": (lambda: torch.eye(2).to_sparse(), lambda: torch.eye(2)),
    "functions by type": (lambda: functools.singledispatch(adds(1)), lambda: functools.singledispatch(adds(2))),
    "named tuples": (lambda: Place(1), lambda: Place(2)),
}


@pytest.mark.parametrize("name", PAIRS)
def test_equal_content_has_equal_digests_and_other_content_others(name):
    one, other = PAIRS[name]
    assert digest(one()) == digest(one())
    assert digest(other()) == digest(other())
    assert digest(one()) != digest(other())
    assert digest([one()]) != digest([other()])
    assert identity(one()).split()[1] == digest(one())


def test_what_says_nothing_of_the_content_does_not_matter():
    assert digest(types.SimpleNamespace(a=1, b=2)) == digest(types.SimpleNamespace(b=2, a=1))
    assert digest(torch.arange(6).view(2, 3).T.contiguous()) == digest(torch.arange(6).view(2, 3).T)
    assert digest(torch.ones(2, requires_grad=True)) == digest(torch.ones(2))
    problem = make_problem("line3")
    for kind in (RolloutPolicy, MultiagentRollout):
        policy = kind(problem.model, network(0), trajectories=1)
        before = digest(policy)
        policy(problem.start(torch.arange(2)))
        assert digest(policy) == before == digest(copy.deepcopy(policy)) == digest(policy.eval())


def test_the_order_of_a_mapping_counts():
    """Layers compute in their order, and samplers take parts in turn."""
    assert digest({"a": 1, "b": 2}) != digest({"b": 2, "a": 1})
    first, second = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
    one, other = ({"a": first, "b": second}, {"b": second, "a": first})
    assert digest(torch.nn.ModuleDict(one)) != digest(torch.nn.ModuleDict(other))
    sample = make_problem("line3").start
    assert digest(PartSampler({0: sample, 4: sample}, seed=0)) != digest(PartSampler({4: sample, 0: sample}, seed=0))


class Cached:
    @functools.cached_property
    def table(self):
        return torch.ones(2)


def test_what_is_found_out_later_does_not_count():
    """Cached properties, and what an enumeration remembers of its uses."""

    class Flags(enum.Flag):
        A, B = 1, 2

    cached, model = Cached(), kind(table=Cached.table, n=1)()
    before = digest([cached, model, Flags.A])
    assert cached.table.sum() == 2
    assert Flags.A | Flags.B
    assert digest([cached, model, Flags.A]) == before
    cached.other = 1
    assert digest([cached, model, Flags.A]) != before


def test_the_order_in_which_entries_were_made_does_not_matter():
    one, two = (calls_back(n).__globals__ for n in (1, 2))
    entries, turned = types.SimpleNamespace(a=one["one"], b=one["two"]), types.SimpleNamespace(b=one["two"], a=one["one"])
    assert digest(entries) == digest(turned)
    assert digest({"a": one["one"], "b": one["two"]}) != digest({"a": two["one"], "b": two["two"]})


def test_installed_packages_count_by_name_and_version(monkeypatch):
    networkx = pytest.importorskip("networkx")
    graph = networkx.path_graph(3)
    before = digest(graph)
    assert before == digest(networkx.path_graph(3)) != digest(networkx.path_graph(4))
    monkeypatch.setattr(networkx, "__version__", "0")
    assert digest(graph) != before


def test_content_that_leads_back_to_itself_has_a_digest():
    loop = [1]
    loop.append(loop)
    other = [2]
    other.append(other)
    assert digest(loop) == digest(loop) != digest(other)


NAMES = [name for name in PAIRS if name not in ("generators",)]
SCRIPT = """
import sys
sys.path.insert(0, {here!r})
from test_digest import NAMES, PAIRS, digest
print(*(digest(make()) for name in NAMES for make in PAIRS[name]))
"""


@pytest.mark.parametrize("seed", ["1", "2"])
def test_digests_do_not_depend_on_the_process(seed):
    script = SCRIPT.format(here=os.path.dirname(__file__))
    env = os.environ | {"PYTHONHASHSEED": seed, "OMP_NUM_THREADS": "1"}
    out = subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, text=True, check=True).stdout
    assert out.split() == [digest(make()) for name in NAMES for make in PAIRS[name]]


WEIGHTS = [1.0, 2.0]


def weighted(y):
    return y * WEIGHTS[0]


def test_what_pickling_alone_tells_and_what_a_function_reads_is_told(monkeypatch):
    numpy = pytest.importorskip("numpy")
    values = [numpy.arange(3), numpy.arange(4), range(3), range(4), deque([1]), deque([2]), bytearray(b"a"), bytearray(b"b")]
    assert len({digest(value) for value in values}) == len(values)
    assert digest(numpy.arange(3)) == digest(numpy.arange(3))
    before = digest(weighted)
    monkeypatch.setitem(globals(), "WEIGHTS", [3.0, 2.0])
    assert digest(weighted) != before
    with pytest.raises(TypeError, match="cannot be told"):
        digest(threading.Lock())


def test_what_is_no_tensor_in_a_tensordict_counts():
    one, other, same = (TensorDict({"x": torch.zeros(2), "name": text}, []) for text in ("a", "b", "a"))
    assert digest(one) == digest(same) != digest(other)


def test_attributes_of_partial_functions_count():
    one, other = functools.partial(default), functools.partial(default)
    other.rate = 2
    assert digest(one) == digest(functools.partial(default)) != digest(other)


def test_what_is_no_tensor_and_differs_by_row_counts():
    one, other, same = (TensorDict({"x": NonTensorStack("a", text)}, [2]) for text in ("b", "c", "b"))
    assert digest(one) == digest(same) != digest(other)
