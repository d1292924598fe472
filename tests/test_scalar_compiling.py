"""Compiled functions: their random numbers, their digests, where they are kept, and what is said of it."""

from __future__ import annotations

import itertools
import logging
import os
import pickle
import subprocess
import sys
import threading
from types import ModuleType
from typing import NamedTuple

import numba
import numpy as np
import pytest
import torch
from numba.core.dispatcher import Dispatcher

from torchrl_pomdp import noise
from torchrl_pomdp.identity import digest
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.scalar import compiling, scalar_twin
from torchrl_pomdp.scalar.compiling import code_digest, entry, inner, outer
from torchrl_pomdp.scalar.models import _OPERATIONS, ScalarModel
from torchrl_pomdp.scalar.noise import finished, fold, hash_numbers, hash_words, scenario_noise, uniform
from torchrl_pomdp.scalar.twins import choose

KEYS = noise.seed_keys(5, torch.arange(200))


@outer
def every(keys, members, names, steps, first, count, out):
    for i in range(len(keys)):
        out[i, 0] = uniform(keys[i], np.uint64(names[i]))
        out[i, 1] = scenario_noise(fold(keys[i], np.uint64(1)), keys[i], members[i], count, first[i], names[i], steps[i])


@pytest.mark.parametrize("count", [1, 2, 3, 10, 1000])
def test_random_numbers_are_those_of_tensors_to_the_last_bit(count):
    generator = torch.Generator().manual_seed(count)
    members = torch.randint(count, (200,), generator=generator)
    names, steps = torch.randint(70, (200,), generator=generator), torch.randint(-2, 400, (200,), generator=generator)
    first = torch.rand(200, generator=generator) < 0.5
    out = np.empty((200, 2), np.float32)
    unsigned = KEYS.numpy().view(np.uint64)
    every(unsigned, members.numpy(), names.numpy(), steps.numpy(), first.numpy(), count, out)
    assert torch.equal(torch.from_numpy(out[:, 0]), noise.uniform(KEYS, names))
    seen = torch.where(first, 0, -1)
    scenarios = Scenarios(noise.fold(KEYS, 1), KEYS, members, seen)
    drawn, _ = scenarios.draw(steps, names.unsqueeze(-1), count)
    assert torch.equal(torch.from_numpy(out[:, 1]), drawn[:, 0])


@outer
def hashed(bits, out):
    for i in range(len(bits)):
        out[i] = finished(hash_numbers(np.uint64(0), bits[i], 0, bits.itemsize == 8))


@pytest.mark.parametrize(("dtype", "bits"), [(torch.float32, np.int32), (torch.float64, np.int64)])
def test_fingerprints_are_those_of_tensors(dtype, bits):
    from tensordict import TensorDict

    belief, out = torch.rand(7, 5, generator=torch.Generator().manual_seed(0), dtype=dtype), np.empty(7, np.uint64)
    hashed(belief.numpy().view(bits), out)
    assert torch.equal(torch.from_numpy(out.view(np.int64)), noise.fingerprint(TensorDict({"belief": belief}, [7])))


@pytest.mark.parametrize("width", [3, 8, 16, 64])
def test_rows_that_change_places_change_the_hash_of_a_layer(width):
    layer = np.eye(8, width, dtype=np.float32)
    orders = [list(range(8))]
    for a, b in itertools.combinations(range(8), 2):
        order = list(range(8))
        order[a], order[b] = b, a
        orders.append(order)
    layers = {layer[order].tobytes() for order in orders}
    hashes = {int(hash_words((layer[order].reshape(-1).view(np.uint32),))) for order in orders}
    assert len(hashes) == len(layers)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_states_that_are_known_have_fingerprints_of_their_own(dtype):
    """Though the bits of 0, 1 and 0.5 are nearly all zero."""
    from tensordict import TensorDict

    known = torch.eye(3000, dtype=dtype)
    mixed = (known + known.roll(1, 0)) / 2
    assert noise.fingerprint(TensorDict({"belief": torch.cat([known, mixed])}, [6000])).unique().numel() == 6000


def test_a_digest_tells_code_constants_and_what_is_called_apart():
    def make(number, other):
        @inner
        def called(x):
            return x + other

        def function(x):
            return called(x) * number

        return function

    digests = {code_digest(make(number, other)) for number, other in [(1, 1), (2, 1), (1, 2)]}
    assert len(digests) == 3
    assert code_digest(make(1, 1)) == code_digest(make(1, 1))


def closure(value):
    return lambda x: x + value


def default(value):
    def function(x, value=value):
        return x

    return function


def keyword(value):
    def function(x, *, value=value):
        return x

    return function


def attribute(value):
    constants = ModuleType("constants")
    constants.value = value
    source = {"constants": constants}
    exec("def function(x):\n    return x + constants.value", source)
    return source["function"]


def helper(value):
    def adds(x):
        return x + value

    return lambda x: adds(x)


def within(value):
    return eval(f"lambda x: [i for i in x if i == {value!r}]")


class Goal(NamedTuple):
    place: int


LONG = np.arange(5000.0)


@pytest.mark.parametrize("make", [closure, default, keyword, attribute, helper])
@pytest.mark.parametrize(
    "values",
    [
        (1, 2), (True, 1), (1, 1.0), ((0,), (19,)), (Goal(1), Goal(2)), ("a", "b"),
        (LONG, np.where(LONG == 2500, -1.0, LONG)), (np.array([0.1]), np.array([0.1 + 1e-10])),
        (np.zeros(2), np.zeros(2, np.float32)), (inner(closure(1)), inner(closure(2))),
    ],
)  # fmt: skip
def test_a_digest_tells_apart_all_that_a_function_reads(make, values):
    one, other = values
    assert code_digest(make(one)) == code_digest(make(one)) != code_digest(make(other))


def test_a_digest_tells_functions_within_a_function_apart():
    assert code_digest(within(1)) == code_digest(within(1)) != code_digest(within(2))


def test_what_a_digest_cannot_tell_is_refused():
    with pytest.raises(TypeError, match="cannot be told"):
        code_digest(closure(threading.Lock()))


def test_a_twin_that_changes_is_another_type():
    def make(control):
        @scalar_twin
        def twin(data, view, controls):
            controls[0] = control

        return twin

    assert make(0).type == make(0).type != make(1).type


def test_policies_with_twins_have_digests_which_tell_their_twins_apart():
    """The policy holds neither; its method reads them."""

    def make(n):
        called = inner(closure(n))

        @scalar_twin
        def twin(data, view, controls):
            controls[0] = called(1)

        return type("Policy", (), {"__module__": __name__, "scalar_engine": lambda self: twin, "other": lambda self: called})

    texts = [digest(make(n)()) for n in (1, 1, 2)]
    assert texts[0] == texts[1] != texts[2]
    script = f"import sys; sys.path.insert(0, {os.path.dirname(__file__)!r}); from test_scalar_compiling import *\n"
    assert in_another_process(script + "print(digest(Stays()))") == [digest(Stays())]


def in_another_process(script, *args):
    return subprocess.run([sys.executable, "-c", script, *args], capture_output=True, text=True, check=True).stdout.split()


def test_what_a_document_defines_is_read_from_disk_again(tmp_path):
    """It is executed under a name that is no module's, which numba would import."""
    block = """
from torchrl_pomdp.scalar.compiling import inner
@inner
def half(x):
    if x < 0:
        raise ValueError("negative")
    return x / 2
"""
    script = """
import sys
from torchrl_pomdp.scalar.compiling import entry, outer
shared = {"__name__": "page"}
exec(compile(sys.argv[1], "page.md", "exec"), shared)
half = shared["half"]
@outer
def loop(n):
    return half(n) + half(n)
print(entry(loop, 3)(4), sum(loop.stats.cache_hits.values()))
"""
    (tmp_path / "document.py").write_text(script)
    command = [sys.executable, str(tmp_path / "document.py"), block]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    found = [subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout for _ in range(2)]
    assert found == ["4.0 0\n", "4.0 1\n"]


@scalar_twin
def stay(data, view, controls):
    controls[0] = 7


ended = ScalarModel(**dict.fromkeys(_OPERATIONS, lambda data, state: state > data))


class Stays:
    def scalar_engine(self):
        return stay, ended


RECEIVED = """
import pickle, sys
import numpy as np
from torchrl_pomdp.scalar.compiling import outer
from torchrl_pomdp.scalar.models import over
from torchrl_pomdp.scalar.twins import choose
@outer
def loop(policy, model, out):
    choose(policy, (), out)
    out[1], out[2] = over(model, 2), over(model, 4)
twin, model = pickle.loads(bytes.fromhex(sys.argv[1]))
out = np.zeros(3, np.int64)
loop((twin, ()), (model, 3), out)
print(*out)
"""


def test_compiled_functions_read_globals_as_they_are_when_they_are_made():
    """As their digests do, by which they are kept on disk."""
    source = {"__name__": __name__, "scalar_twin": scalar_twin, "extra": 1}
    exec("def twin(data, view, controls):\n    controls[0] = extra", source)
    policy, out = scalar_twin(source["twin"]), np.zeros(1, np.int64)
    source["extra"] = 2
    chosen((policy, ()), out)
    assert out[0] == 1
    chosen((scalar_twin(source["twin"]), ()), out)
    assert out[0] == 2


def test_what_a_compiled_function_reads_is_defined_above_it():
    source = {"__name__": __name__}
    exec("def twin(data, view, controls):\n    controls[0] = later(1)", source)
    with pytest.raises(NameError, match="twin reads later, which must be defined above it"):
        scalar_twin(source["twin"])
    with pytest.raises(TypeError, match="function must be a function"):
        scalar_twin(3)


@outer
def chosen(policy, out):
    choose(policy, (), out)


def test_a_compiled_function_may_call_itself():
    source = {"__name__": __name__}
    exec("def sums(n):\n    return n + sums(n - 1) if n > 0 else 0", source)
    assert outer(source["sums"])(4) == 10


def test_the_digest_of_a_compiled_function_does_not_depend_on_how_often_it_was_compiled():
    first, second = inner(closure(1)), inner(closure(1))
    assert digest(first) == digest(second)
    assert first.__qualname__ == second.__qualname__
    function = closure(1)
    assert inner(function).__qualname__ == inner(function).__qualname__


def test_options_of_compiling_count():
    function = closure(1)
    assert len({code_digest(made) for made in (numba.njit(function), numba.njit(fastmath=True)(function), function)}) == 3


def test_twins_and_models_go_to_other_processes():
    """The module that made them is not known there."""
    assert in_another_process(RECEIVED, pickle.dumps((stay, ended)).hex()) == ["7", "0", "1"]


def test_a_long_compilation_is_announced_and_a_short_one_is_not(caplog, monkeypatch):
    def slow(x):
        return x + 1

    with caplog.at_level(logging.WARNING):
        assert entry(outer(lambda x: x + 2), 1.5)(1.5) == 3.5
        assert not caplog.records
        monkeypatch.setattr(compiling, "_SOON", 0.0)
        compiling._announce.cache_clear()
        for _ in range(2):
            assert entry(outer(slow), 1.0)(1.0) == 2.0
    (told,) = [record.getMessage() for record in caplog.records]
    assert told.startswith("preparing compiled simulations: the first time up to 20 seconds")


def test_where_nothing_can_be_written_every_process_compiles(monkeypatch):
    def refuse(self):
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(Dispatcher, "enable_caching", refuse)
    assert outer(lambda x: 3 * x)(2) == 6


def test_names_may_be_long():
    def function_of_a_very_long_name(x):
        return 5 * x

    function_of_a_very_long_name.__name__ = 300 * "x"
    assert outer(function_of_a_very_long_name)(2) == 10


SCRIPT = """
import sys
from torchrl_pomdp.scalar.compiling import entry, inner, outer
@inner
def part(x):
    return 3 * x
@outer
def once(x):
    return part(x)
@outer
def twice(x):
    return part(x) + part(x)
loop = globals()[sys.argv[1]]
assert entry(loop, 1.0)(1.0) == {"once": 3.0, "twice": 6.0}[sys.argv[1]]
for function in (loop, part):
    print(sum(function.stats.cache_hits.values()), sum(function.stats.cache_misses.values()))
"""


def test_another_process_reads_what_has_been_compiled_and_another_loop_the_parts(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    told = [
        subprocess.run([sys.executable, "script.py", loop], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
        for loop in ("once", "once", "twice")
    ]
    # Hits and misses of the loop and of its part; a loop that is read asks for no part.
    assert told == ["0 1\n0 1\n", "1 0\n0 0\n", "0 1\n1 0\n"]
