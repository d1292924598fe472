"""Texts that are no ``.POMDP`` files, by chance or malice: each is refused with a reason, soon, or means something."""

from __future__ import annotations

import random
import re
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchrl_pomdp.envs import parse_pomdp, read_pomdp

DATA = Path(__file__).parents[1] / "data"
HEAD = "discount: 0.9\nvalues: cost\nstates: a b\nactions: go stop\nobservations: x y\n"


@pytest.mark.parametrize(
    "text",
    [
        "states: " + "9" * 1_000_000 + "x",
        "discount: " + "9" * 1_000_000 + "x",
        "discount: 0." + "9" * 1_000_000,
        "discount: 1e" + "9" * 100_000,
        ":" * 1_000_000,
        "- " * 1_000_000,
        "#" * 1_000_000,
        "states: " + "a" * 1_000_000,
        "states: " + " ".join(f"s{i}" for i in range(200_000)),
        HEAD + "T: * : * : * 0\n" * 10_000,
        HEAD.replace("a b", "131072").replace("go stop", "32") + "T: * : * : * 0\n" * 1000,
        HEAD.replace("a b", "131072") + "O: *\n" + "0 " * 100_000,
        HEAD.replace("a b", "3000") + "T: * : * : 0 1 O: * : * uniform R: * : * : * : 1 1\n" * 6000,
    ],
    ids=range(13),
)
def test_hostile_texts_come_to_an_end(text):
    with pytest.raises(ValueError, match="text"):
        parse_pomdp(text)


# fmt: off
WORDS = [
    "discount", "values", "states", "actions", "observations", "start", "T", "O", "R", "reward", "cost", "uniform", "identity",
    "reset", "include", "exclude", ":", ":", ":", "*", "0", "1", "2", "0.5", "-1", "-", "1e999", "nan", "a", "b", "go", "x",
    "99999999999", "#", "\n", "\0", "é", "1e-400", "0x1", "1_0", "inf",
]
# fmt: on


def parses_or_says_why(text):
    refusal = ""
    try:
        model, start = parse_pomdp(text, "it")
    except ValueError as error:
        refusal = str(error)
    if refusal:
        assert re.match(r"it(, line \d+)?: ", refusal)
        return
    belief = model.drawn(start, torch.arange(1))
    u = torch.zeros(1, dtype=torch.int64)
    assert torch.isfinite(model.expected_cost(belief, u)).all()
    torch.testing.assert_close(model.observation_probs(belief, u).sum(-1), torch.ones(1))


@given(words=st.lists(st.sampled_from(WORDS), max_size=60), head=st.booleans())
@settings(max_examples=150, deadline=None)
def test_random_words(words, head):
    parses_or_says_why((HEAD if head else "") + " ".join(words))


@given(text=st.text(max_size=200))
@settings(max_examples=100, deadline=None)
def test_random_texts(text):
    parses_or_says_why(text)


@given(data=st.binary(max_size=200))
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_random_bytes(tmp_path, data):
    (tmp_path / "it").write_bytes(data)
    with pytest.raises(ValueError, match=r"^it"):
        read_pomdp(tmp_path / "it")


@pytest.mark.parametrize("name", ["tiger", "cheese", "forms"])
@given(seed=st.integers(0, 2**32))
@settings(max_examples=100, deadline=None)
def test_files_with_mistakes(name, seed):
    """Words and characters of valid files are left out, doubled, swapped and replaced."""
    source, text = random.Random(seed), (DATA / f"{name}.POMDP").read_text()
    for _ in range(source.randint(1, 3)):
        parts = re.split(r"(\s+|:)", text) if source.random() < 0.7 else list(text)
        i, j = source.randrange(len(parts)), source.randrange(len(parts))
        match source.randrange(5):
            case 0:
                del parts[i]
            case 1:
                parts.insert(j, parts[i])
            case 2:
                parts[i], parts[j] = parts[j], parts[i]
            case 3:
                parts[i] = source.choice(WORDS)
            case 4:
                del parts[min(i, j) : max(i, j)]
        text = "".join(parts)
    parses_or_says_why(text)
