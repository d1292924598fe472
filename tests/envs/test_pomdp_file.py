"""``.POMDP`` files: every form of the grammar, writing and reading again, and what is refused where."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_pomdp.envs import FixedBelief, TabularModel
from torchrl_pomdp.envs.pomdp_file import parse_pomdp, read_pomdp, write_pomdp
from torchrl_pomdp.problems import Problem, tiger

DATA = Path(__file__).parents[1] / "data"
HEAD = "discount: 0.9\nvalues: cost\nstates: a b\nactions: go stop\nobservations: x y\n"
BODY = "T: * identity\nO: * uniform\n"


def rows(text):
    return [[float(number) for number in line.split()] for line in text.split("/")]


def parsed(text):
    return parse_pomdp(text, dtype=torch.float64)


# ---- the grammar -------------------------------------------------------------------------------------------------------


def test_every_form():
    model, start = read_pomdp(DATA / "forms.POMDP", dtype=torch.float64)
    assert model.discount == 0.5
    assert (model.state_names, model.control_names, model.observation_names) == (
        None,
        ("stay-put", "jump_1"),
        ("quiet", "loud"),
    )
    assert start.belief.tolist() == [0.5, 0.0, 0.5]
    third = 1 / 3
    assert model.transition.tolist() == [
        rows("1 0 0 / 0.25 0.5 0.25 / 0 0 1"),
        [[third, third, third], [0.5, 0.0, 0.5], [0.75, 0.25, 0.0]],
    ]
    assert model.observation.tolist() == [rows("0.9 0.1 / 0.5 0.5 / 0.25 0.75"), rows("0.5 0.5 / 0.5 0.5 / 0.25 0.75")]
    stay = [-4.0, 0.75 * 1.0 + 0.25 * 6.5, 1.0]
    jump = [
        -(third * -1.0 + third * (0.5 * -1.0 + 0.5 * 30.0) + third * -1.0),
        -(0.5 * (0.5 * 1.0 + 0.5 * 2.0) + 0.5 * (0.25 * 7.0 + 0.75 * 6.0)),
        -(0.75 * (0.5 * 1.0 + 0.5 * 2.0) + 0.25 * -1.0),
    ]
    torch.testing.assert_close(model.cost, torch.tensor([stay, jump], dtype=torch.float64))


@pytest.mark.parametrize(
    ("start", "belief"),
    [
        ("", [0.5, 0.5]),
        ("start: uniform", [0.5, 0.5]),
        ("start: 0.25 0.75", [0.25, 0.75]),
        ("start:\n1\n0.0", [1.0, 0.0]),
        ("start: b", [0.0, 1.0]),
        ("start: 1", [0.0, 1.0]),
        ("start include: b", [0.0, 1.0]),
        ("start include: a 1", [0.5, 0.5]),
        ("start exclude: 0", [0.0, 1.0]),
        ("start : 0.333333 0.666667", [0.333333, 0.666667]),
        ("start: 0.3333333 0.6666668", [0.3333333 / 1.0000001, 0.6666668 / 1.0000001]),
    ],
)
def test_forms_of_start(start, belief):
    assert parsed(HEAD + start + "\n" + BODY)[1].belief.tolist() == pytest.approx(belief, rel=1e-15)


def test_later_entries_override_earlier_ones():
    model, _ = parsed(HEAD + BODY + "T: go : a : b 1 T: go : a : a 0\nT: * : b uniform T: stop : b : * 0 T: stop : * : a 1")
    assert model.transition.tolist() == [rows("0 1 / 0.5 0.5"), rows("1 0 / 1 0")]


def test_layout_is_free():
    plain = HEAD + BODY + "R: go : a : * : * 3\n"
    odd = plain.replace("\n", "\r\n").replace(" ", "\t ").replace(": ", " :")
    one_line = plain.replace("\n", " ")
    for text in (odd, one_line, plain.replace("\n", " # a comment: T R O 1 2\r"), "# é ⊕ comment\n" + plain):
        model, _ = parsed(text)
        assert model.cost.tolist() == [[3.0, 0.0], [0.0, 0.0]]


def test_states_that_no_action_leaves_or_charges_for_are_terminal():
    text = "discount: 0.9 values: cost states: 3 actions: 2 observations: 1 T: * identity T: 1 : 1 uniform O: * uniform\n"
    model, _ = parsed(text + "R: 0 : 2 : * : * 1")
    assert model.terminal.tolist() == [True, False, False]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_terminal_state_may_be_left_by_rounding(dtype):
    text = "discount: 0.9 values: cost states: 2 actions: 1 observations: 1 T: 0 : 0 0.5 0.5 T: 0 : 1 : 1 {} O: * uniform\n"
    for stay in ("0.9999999", "0.9999999999999999", "1.0"):
        model, _ = parse_pomdp(text.format(stay) + "R: 0 : 0 : * : * 1", dtype=dtype)
        assert model.terminal.tolist() == [False, True]
        assert model.transition.tolist() == [[[0.5, 0.5], [0.0, 1.0]]]


def test_terminal_states_are_read_by_what_they_do(tmp_path):
    ends, start = torch.eye(2).unsqueeze(0), FixedBelief(torch.tensor([1.0, 0.0]))
    for terminal in (None, torch.tensor([False, True])):
        model = TabularModel(ends, torch.ones(1, 2, 1), [[1.0, 0.0]], 0.9, terminal=terminal)
        write_pomdp(tmp_path / "it.POMDP", model, start)
        assert read_pomdp(tmp_path / "it.POMDP")[0].terminal.tolist() == [False, True]


@pytest.mark.parametrize("start", ["0", "00", "1", "1.0", "uniform"])
def test_forms_of_start_in_the_only_state(start):
    text = f"discount: 0.9 values: cost states: 1 actions: 1 observations: 1 start: {start} T: 0 identity O: 0 uniform"
    assert parsed(text)[1].belief.tolist() == [1.0]


def test_a_file_makes_a_problem():
    problem = Problem(*read_pomdp(DATA / "tiger.POMDP"), name="tiger")
    assert problem.model.cost.tolist() == [[1.0, 1.0], [100.0, -10.0], [-10.0, 100.0]]
    assert problem.model.control_names == ("listen", "open-left", "open-right")
    assert problem.start(torch.arange(2))["belief"].tolist() == [[0.5, 0.5]] * 2


def test_large_tables_are_sparse():
    text = (
        "discount: 0.9 values: cost states: 5000 actions: 2 observations: 5000 T: * identity T: 1 : 7 : 7 .5 T: 1 : 7 : 9 .5\n"
    )
    seen = "".join(f"O: * : {j} : {(j * 7) % 5000} 1\n" for j in range(5000))
    model, _ = parsed(text + seen + "R: * : 7 : 9 : 63 10\nR: * : * : 4000 : * 1")
    assert model.transition.is_sparse
    assert model.observation.is_sparse
    assert model.cost[1, 7] == 5.0
    assert model.cost[:, 4000].tolist() == [1.0, 1.0]
    assert int(model.cost.count_nonzero()) == 3


SIZES = U, N, Z = 2, 3, 2
wild = st.sampled_from(["*", "0", "1"])


@st.composite
def statements(draw):
    """Statements on all tables with the words of each; probabilities become distributions by a last word on each row."""
    made = []
    for _ in range(draw(st.integers(1, 12))):
        table = draw(st.sampled_from("TOR"))
        sizes = {"T": (U, N, N), "O": (U, N, Z), "R": (U, N, N, Z)}[table]
        depth = draw(st.integers(2 if table == "R" else 1, len(sizes)))
        where = [draw(st.sampled_from(["*", *map(str, range(size))])) for size in sizes[:depth]]
        count = int(torch.tensor(sizes[depth:]).prod()) if depth < len(sizes) else 1
        values = draw(st.lists(st.sampled_from(["0", "1", "0.25", "0.5"]), min_size=count, max_size=count))
        made.append((table, where, values))
    return made


@given(made=statements())
@settings(max_examples=150, deadline=None)
def test_statements_mean_what_a_table_of_everything_says(made):
    """Every number of every table is set as the statements say; rows are then made distributions by statements of their own."""
    tables = {"T": torch.zeros(U, N, N), "O": torch.zeros(U, N, Z), "R": torch.zeros(U, N, N, Z)}
    text = f"discount: 0.5 values: cost states: {N} actions: {U} observations: {Z}\n"
    for name, where, values in made:
        text += f"{name}: {' : '.join(where)} {' '.join(values)}\n"
        block = torch.tensor([float(value) for value in values])
        table = tables[name]
        index = tuple(slice(None) if one == "*" else int(one) for one in where)
        table[index] = block.view(table.shape[len(where) :]) if len(where) < table.ndim else block[0]
    for name in "TO":
        for u in range(U):
            for i in range(N):
                row = tables[name][u, i]
                if row.sum() != 1.0:
                    row.copy_(torch.tensor([0.5, 0.5, 0.0][: len(row)]))
                    text += f"{name}: {u} : {i} {' '.join(str(number) for number in row.tolist())}\n"
    model, _ = parsed(text)
    joint = tables["T"].unsqueeze(-1) * tables["O"].unsqueeze(1)
    assert torch.equal(model.transition, tables["T"].double())
    assert torch.equal(model.observation, tables["O"].double())
    torch.testing.assert_close(model.cost, (joint * tables["R"]).sum((2, 3)).double())


# ---- writing and reading again -----------------------------------------------------------------------------------------


def distributions(generator, *shape, share):
    values = torch.rand(shape, generator=generator, dtype=torch.float64) * (torch.rand(shape, generator=generator) < share)
    values[..., 0] += 1e-3
    return values / values.sum(-1, keepdim=True)


def equal(one, other):
    return torch.equal(one.to_dense(), other.to_dense()) and one.is_sparse == other.is_sparse


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("controls", "states", "observations", "share"), [(1, 1, 1, 1.0), (3, 17, 5, 0.5), (2, 300, 20, 0.01)])
def test_writing_and_reading_is_the_identity(tmp_path, dtype, controls, states, observations, share):
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        tables = (
            distributions(generator, controls, states, states, share=share),
            distributions(generator, controls, states, observations, share=share),
        )
        tables = (tables[0].to_sparse(), tables[1]) if states > 100 else tables
        cost = torch.randn(controls, states, generator=generator, dtype=torch.float64) * 10.0 ** torch.arange(-6, 6)[seed]
        names = {
            "control_names": [f"do-{u}" for u in range(controls)],
            "observation_names": [f"z{k}" for k in range(observations)],
        }
        model = TabularModel(*tables, cost, 0.1 * (seed + 1), dtype=dtype, **names)
        start = FixedBelief(distributions(generator, states, share=0.5).to(dtype))
        write_pomdp(tmp_path / "it.POMDP", model, start)
        again, start_again = read_pomdp(tmp_path / "it.POMDP", dtype=dtype)
        assert equal(again.transition, model.transition)
        assert equal(again.observation, model.observation)
        assert torch.equal(again.cost, model.cost)
        assert torch.equal(start_again.belief, start.belief)
        assert again.discount == model.discount
        assert (again.control_names, again.state_names) == (model.control_names, model.state_names)
        first = (tmp_path / "it.POMDP").read_bytes()
        write_pomdp(tmp_path / "it.POMDP", again, start_again)
        assert (tmp_path / "it.POMDP").read_bytes() == first


@pytest.mark.parametrize("name", ["tiger", "cheese", "forms"])
def test_files_are_written_again(tmp_path, name):
    model, start = read_pomdp(DATA / f"{name}.POMDP")
    write_pomdp(tmp_path / "again.POMDP", model, start)
    again, start_again = read_pomdp(tmp_path / "again.POMDP")
    assert equal(again.transition, model.transition)
    assert equal(again.observation, model.observation)
    assert torch.equal(again.cost, model.cost)
    assert torch.equal(start_again.belief, start.belief)
    assert torch.equal(again.terminal, model.terminal)
    assert again.state_names == model.state_names


def test_what_a_file_cannot_say_is_refused(tmp_path):
    path, (model, start) = tmp_path / "it.POMDP", parsed(HEAD + BODY)

    def changed(**change):
        return TabularModel(model.transition, model.observation, model.cost, 0.9, **change)

    write_pomdp(path, changed(state_names=["a b", "3"[:0] + "c:d"]), start)
    assert read_pomdp(path)[0].state_names == ("a-b", "c-d")
    for names in (["a", "T"], ["a", "1"], ["a b", "a-b"], ["a", "é"]):
        with pytest.raises(ValueError, match="state_names of model must begin with a letter"):
            write_pomdp(path, changed(state_names=names), start)
    with pytest.raises(ValueError, match="model must allow every control in every state"):
        write_pomdp(path, changed(legal=torch.tensor([[True, False], [True, True]])), start)
    with pytest.raises(ValueError, match="start must be a belief over the model's 2 states, got 3"):
        write_pomdp(path, model, FixedBelief(torch.tensor([1.0, 0.0, 0.0])))
    for arguments in ((path, start, start), (path, model, start.belief), (3, model, start)):
        with pytest.raises(TypeError):
            write_pomdp(*arguments)


# ---- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("", 1, "discount, values, states, actions, observations must be given before the first T, O or R"),
        ("T: * identity", 1, "discount, values, states, actions, observations must be given"),
        ("states: 2\nstates: 3", 2, "states is given twice, first on line 1"),
        ("start: 1", 1, "start must come after states"),
        ("discount: 1.0", 1, r"expected a discount in \(0, 1\), got '1.0'"),
        ("discount: x", 1, r"expected a number in \(0, 1\), got 'x'"),
        ("discount 0.9", 1, "expected a colon, got '0.9'"),
        ("values: profit", 1, "expected reward or cost, got 'profit'"),
        ("\n\nstates: 0", 3, "expected a number of states in 1 to 131072, got '0'"),
        ("states: 99999999999999", 1, "expected a number of states in 1 to 131072"),
        ("states: a b a", 1, "states must have different names, got 'a' twice"),
        ("states: a 7", 1, "expected a name of one of the states, which begins with a letter, got '7'"),
        ("states:", 1, "expected 1 to 131072 states, as a number or as names, got the end of the file"),
        ("hello", 1, "expected one of discount, values, states, actions, observations, start, T, O, R, got 'hello'"),
        ("discount: 0.9\0", 1, r"found '\\x00' outside a comment: a .POMDP file holds printable ASCII characters"),
        ("# é\nvalues: é", 2, "found 'é' outside a comment"),
        (HEAD + BODY + "discount: 0.9", 8, "discount must come before the first T, O or R"),
        (HEAD + "start: 0.5 0.6\n" + BODY, 6, "probabilities of the start states must sum to 1, got 1.1"),
        (HEAD + "start: 0.5 0.5 0.5\n" + BODY, 6, "expected 2 probabilities of start states and no more, got '0.5'"),
        (HEAD + "start: 2\n" + BODY, 6, "expected one of the states, a name such as 'a' or a number 0 to 1, got '2'"),
        (HEAD + "start: *\n" + BODY, 6, r"expected one of the states, a name such as 'a' or a number 0 to 1, got '\*'"),
        (HEAD + "start exclude: a b\n" + BODY, 7, "expected states to exclude, so that one is left, got 'T'"),
        (HEAD + "start include:\n" + BODY, 7, "expected states to include, so that one is left, got 'T'"),
        (HEAD + "start: reset\n" + BODY, 6, "expected one of the states"),
        (HEAD + "T: run identity", 6, r"expected one of the controls, a name such as 'go' or a number 0 to 1 or \*, got 'run'"),
        (HEAD + "T: go : c : a 1", 6, "expected one of the states, .* got 'c'"),
        (HEAD + "O: go : a : z 1", 6, "expected one of the observations, .* got 'z'"),
        (HEAD + "T: go : a\n0.5\nO: * uniform", 8, "expected 2 probabilities of states of which there are 1, got 'O'"),
        (HEAD + "T: go\n1 0 0\nO: * uniform", 8, "expected 4 probabilities of states by state of which there are 3, got 'O'"),
        (HEAD + "T: go : a\n0.5 0.5 0.5", 7, "expected 2 probabilities of states and no more, got '0.5'"),
        (HEAD + "T: go : a : b 0.5 0.5", 6, "expected a probability and no more, got '0.5'"),
        (HEAD + "T: go : a : b", 6, "expected a probability, got the end of the file"),
        (HEAD + "T: go : a : b nan", 6, "expected a probability, got 'nan'"),
        (HEAD + "T: go : a : b 1e999", 6, "expected a probability, got '1e999'"),
        (HEAD + "T: go : a : b -0.5", 6, r"expected a probability in \[0, 1\], got '-0.5'"),
        (HEAD + "T: go : a\n0.5\n1.5", 8, r"expected probabilities of states in \[0, 1\], got '1.5'"),
        (HEAD + "T: go reset", 6, "expected 4 probabilities of states by state, got 'reset'"),
        (HEAD + "O: go : a identity", 6, "expected 2 probabilities of observations, got 'identity'"),
        (HEAD + "R: go 3", 6, "expected a colon and a state, got '3'"),
        (HEAD + "R: go : a : b : x", 6, "expected a finite number, got the end of the file"),
        (HEAD + "R: go : a : b : x -", 6, "expected a finite number, got '-'"),
        (HEAD + "R: go : a : b\n 1 1e999", 7, "expected 2 values of observations, finite, got '1e999'"),
        (HEAD + "T: * identity", None, r"text: the row O: go : a, which is never given, must sum to 1, got 0"),
        (HEAD + BODY + "T: stop : b : a 0.25", 8, "the row T: stop : b must sum to 1, got 1.25"),
        (HEAD + BODY + "R: * : * : * : * 1e39", 8, r"expected a value of at most 3.4e\+38 in size, got '1e39'"),
        (HEAD + "R: go : a : b\n1\n-1e39", 8, r"expected a value of at most 3.4e\+38 in size, got '-1e39'"),
        (
            HEAD.replace("a b", "100000").replace("go stop", "100"),
            6,
            "states times actions must be at most 4194304, got 10000000",
        ),
        (HEAD.replace("a b", "5000") + "T: * uniform", 6, "more than 16777216 numbers are written to a table"),
    ],
)
def test_refusals_say_where(text, line, message):
    where = r"text: |text, line \d+: " if line is None else f"text, line {line}: "
    with pytest.raises(ValueError, match=message) as refused:
        parse_pomdp(text)
    assert re.match(where, str(refused.value))


def test_files_that_are_none(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_pomdp(tmp_path / "absent.POMDP")
    with pytest.raises(ValueError, match="path must be a file"):
        read_pomdp(tmp_path)
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        with pytest.raises(ValueError, match="path must be a file"):
            read_pomdp(tmp_path / "pipe")
    (tmp_path / "zeros.POMDP").write_bytes(bytes(1000))
    with pytest.raises(ValueError, match=r"zeros.POMDP, line 1: found '\\x00' outside a comment"):
        read_pomdp(tmp_path / "zeros.POMDP")
    with open(tmp_path / "huge.POMDP", "wb") as file:
        file.truncate(1 << 40)  # a file with a hole
    with pytest.raises(ValueError, match="must hold at most 134217728 bytes, got 1099511627776"):
        read_pomdp(tmp_path / "huge.POMDP")
    for arguments in ((3,), ("text", 3), ("text", "")):
        with pytest.raises((TypeError, ValueError)):
            parse_pomdp(*arguments)


def test_a_start_that_would_be_read_as_another_is_not_written(tmp_path):
    path = tmp_path / "model.POMDP"
    model = tiger().model
    with pytest.raises(ValueError, match=r"start must sum to 1 up to 1e-06 to be read as it is, got 1\.0000"):
        write_pomdp(path, model, FixedBelief(torch.tensor([0.500005, 0.5])))
    assert not path.exists()
