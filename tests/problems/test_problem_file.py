"""Problems as files: what is read, and forty broken ones that each get one line."""

from __future__ import annotations

import re

import pytest
import torch

from torchrl_pomdp.problems import Problem, make_problem, problem_from_spec, read_problem
from torchrl_pomdp.problems.find import find_problem
from torchrl_pomdp.trainers.checkpoint import problem_digest

REPAIR = """
[repair]
graph = { edges = [[0, 1], [1, 2], [1, 3]] }
degradation = [0.0, 0.1, 0.2]
costs = [0, 1, 5, 20]
discount = 0.95
robots = 2
start = { uniform = [0, 3] }
"""
TABULAR = """
name = "machine"
[tabular]
transition = [[[0.9, 0.1], [0, 1]], [[1, 0], [1, 0]]]
observation = [[[0.8, 0.2], [0.2, 0.8]], [[1, 0], [1, 0]]]
cost = [[0, 5], [2, 7]]
start = [1, 0]
discount = 0.9
controls = ["run", "replace"]
"""
TIGER = """
discount: 0.95
values: reward
states: left right
actions: listen open-left open-right
observations: left right
T: listen identity
T: open-left uniform
T: open-right uniform
O: listen
0.85 0.15
0.15 0.85
O: open-left uniform
O: open-right uniform
R: listen : * : * : * -1
R: open-left : left : * : * -100
R: open-left : right : * : * 10
R: open-right : left : * : * 10
R: open-right : right : * : * -100
"""


@pytest.fixture
def path(tmp_path):
    return tmp_path / "mine.toml"


def written(path, text):
    path.write_text(text)
    return path


def test_a_repair_problem(path):
    problem = read_problem(written(path, REPAIR))
    assert problem.name == "mine"
    assert problem.model.describe() == "graph, 2 robots: 4.1e+03 states, 16 controls, 16 observations, discount 0.95"
    assert problem.start(torch.arange(2))["location"].tolist() == [[0, 3], [0, 3]]
    assert problem.model.costs.tolist() == [0, 1, 5, 20]
    assert problem.partition.num_parts == 6
    single = read_problem(written(path, REPAIR + "partition = 'single'\n"))
    assert single.partition.num_parts == 1
    grid = read_problem(written(path, REPAIR.replace("edges = [[0, 1], [1, 2], [1, 3]]", "grid = [3, 2]")))
    assert grid.model.num_locations == 6


def test_a_tabular_problem(path):
    problem = read_problem(written(path, TABULAR))
    assert (problem.name, problem.model.control_names) == ("machine", ("run", "replace"))
    assert problem.model.cost.tolist() == [[0, 5], [2, 7]]
    assert problem.start(torch.tensor([3]))["belief"].tolist() == [[1, 0]]


def test_a_pomdp_file_by_itself_and_by_its_name(path):
    own = written(path.with_name("tiger.POMDP"), TIGER)
    known = make_problem("tiger").model
    for problem in (read_problem(own), find_problem(str(own)), read_problem(written(path, 'pomdp = "tiger.POMDP"'))):
        assert torch.equal(problem.model.cost, known.cost)
        assert torch.equal(problem.model.transition, known.transition)
        assert problem.start(torch.tensor([0]))["belief"].tolist() == [[0.5, 0.5]]


def test_a_preset_with_options(path):
    problem = read_problem(written(path, 'preset = "tiger"\ndiscount = 0.75\nname = "small tiger"\n'))
    assert (problem.name, problem.model.discount) == ("small tiger", 0.75)


@pytest.mark.parametrize("text", [REPAIR, TABULAR, 'preset = "tiger"', 'preset = "linear20"\npartitioned = false'])
def test_the_spec_builds_the_same_problem_again(path, text):
    problem = read_problem(written(path, text))
    again = problem_from_spec(problem.spec)
    assert isinstance(again, Problem)
    assert (again.name, problem_digest(again)) == (problem.name, problem_digest(problem))


def changed(text, old, new):
    assert old in text
    return text.replace(old, new)


# The text, where the fault is, and what is said of it.
# ruff: noqa: E501
BROKEN = [
    ("", "", "exactly one of preset, repair, tabular and pomdp"),
    ("x = ", ", line 1", "Invalid value"),
    ("[repair\n", ", line 1", "Expected ']'"),
    ("[repair]\nrobots = 1\nrobots = 2", ", line 3", "Cannot overwrite a value"),
    ("preset = 3", ", line 1", "preset: must be one of"),
    ('preset = "liner20"', ", line 1", "preset: must be one of .*linear20.*, got 'liner20'"),
    ('preset = "tiger"\ndiscount = 1.5', ", line 2", r"discount: discount must be in \(0, 1\), got 1.5"),
    ('preset = "line3"\nuneven = "no"', ", line 2", "uneven: uneven must be True or False, got 'no'"),
    ('preset = "tiger"\nlevels = 3', ", line 2", "levels: tiger takes no such option; allowed are discount"),
    ('preset = "tiger"\n[repair]', "", "exactly one of .* got preset and repair"),
    ("repair = 3", ", line 1", "repair: must be a table, got 3"),
    ("[repair]\n", ", line 1", "repair: lacks the entry graph"),
    (changed(REPAIR, "discount = 0.95\n", ""), ", line 2", "repair: lacks the entry discount"),
    (changed(REPAIR, "costs = [0, 1, 5, 20]\n", ""), ", line 2", "repair: lacks the entry costs"),
    (changed(REPAIR, "discount = 0.95", "discont = 0.95"), ", line 6", "repair.discont: unknown entry; allowed are graph, chain"),
    (changed(REPAIR, "0.95", "1.0"), ", line 6", r"repair.discount: discount must be in \(0, 1\), got 1.0"),
    (changed(REPAIR, "0.95", "'a'"), ", line 6", "repair.discount: discount must be a number"),
    (changed(REPAIR, "robots = 2", "robots = 0"), ", line 7", "repair.robots: num_robots must be at least 1, got 0"),
    (changed(REPAIR, "robots = 2", "robots = 1.5"), ", line 7", "repair.robots: num_robots must be an integer"),
    (changed(REPAIR, "[0, 1, 5, 20]", "[0, 1, 5]"), ", line 5", "repair.costs: costs must"),
    (changed(REPAIR, "[0, 1, 5, 20]", "[0, 1, 5, -20]"), ", line 5", "repair.costs: costs must"),
    (changed(REPAIR, "[0, 1, 5, 20]", "'cheap'"), ", line 5", "repair.costs: must be an array of numbers, got 'cheap'"),
    (changed(REPAIR, "[0.0, 0.1, 0.2]", "[0.0, 0.1, 1.2]"), ", line 4", "repair.degradation: degradation"),
    (changed(REPAIR, "degradation", "chain"), ", line 4", "repair.chain: chain must"),
    (REPAIR + "chain = [[1, 0], [0, 1]]", ", line 2", "repair: must have either chain or degradation"),
    (changed(REPAIR, "{ edges = [[0, 1], [1, 2], [1, 3]] }", "3"), ", line 3", "repair.graph: must be a table with exactly one of"),
    (changed(REPAIR, "edges", "nodes"), ", line 3", "repair.graph: must be a table with exactly one of line, grid, edges"),
    (changed(REPAIR, "[1, 3]", "[1]"), ", line 3", r"repair.graph: edges must hold pairs of locations, got \(1,\)"),
    (changed(REPAIR, "[1, 3]", "[1, -3]"), ", line 3", "repair.graph: edges must be at least 0, got -3"),
    (changed(REPAIR, "[1, 3]", "[5, 6]"), ", line 3", "repair.graph: location 3 is unreachable"),
    (changed(REPAIR, "edges = [[0, 1], [1, 2], [1, 3]]", "line = 0"), ", line 3", "repair.graph: num_locations must be"),
    (changed(REPAIR, "edges = [[0, 1], [1, 2], [1, 3]]", "grid = [3]"), ", line 3", r"repair.graph: grid must be \[width, height\]"),
    (changed(REPAIR, "[1, 3]] }", "[1, 3]], color = 3 }"), ", line 3", "repair.graph.color: edges takes no such option; allowed are locations, columns, rows"),
    (changed(REPAIR, "{ uniform = [0, 3] }", "{ uniform = [0] }"), ", line 8", "repair.start: robots must be 2 locations"),
    (changed(REPAIR, "{ uniform = [0, 3] }", "{ calibrated = 1.5 }"), ", line 8", "repair.start: damaged_fraction must be in"),
    (changed(REPAIR, "{ uniform = [0, 3] }", "'anywhere'"), ", line 8", "repair.start: must be a table with exactly one of calibrated"),
    (changed(REPAIR, "{ edges = [[0, 1], [1, 2], [1, 3]] }", "{ line = 2 }").replace("3] }", "1] }") + "partition = 'six'", ", line 9", "repair.partition: must be single: of six, some parts of the line of 2 have no states"),
    (REPAIR + "partition = 'seven'", ", line 9", "repair.partition: must be one of six, single, got 'seven'"),
    ("partitioned = 3" + REPAIR, ", line 1", "partitioned: partitioned must be True or False, got 3"),
    ("name = 3" + REPAIR, ", line 1", "name: name must be a text, got 3"),
    ("more = 3" + REPAIR, ", line 1", "more: unknown entry beside repair; allowed are name, partitioned"),
    (changed(TABULAR, "[0.9, 0.1]", "[0.9, 0.2]"), ", line 4", r"tabular.transition: rows of transition must .* row \(0, 0\)"),
    (changed(TABULAR, "[0.9, 0.1]", "[0.9]"), ", line 4", "tabular.transition: must be an array of numbers"),
    (changed(TABULAR, "[0.8, 0.2]", "['a', 0.2]"), ", line 5", "tabular.observation: must be an array of numbers"),
    (changed(TABULAR, "[[0, 5], [2, 7]]", "[0, 5]"), ", line 6", "tabular.cost: cost must"),
    (changed(TABULAR, "[[0, 5], [2, 7]]", "[[0, 5], [2, 1e38]]"), ", line 6", "tabular.cost: cost of the model, paid for ever, must be finite in torch.float32, got"),
    (changed(TABULAR, "start = [1, 0]", "start = [1, 1]"), ", line 7", "tabular.start: belief must"),
    (changed(TABULAR, "start = [1, 0]", "start = [1, 0, 0]"), ", line 7", "tabular.start: start must be a distribution over 2 states"),
    (changed(TABULAR, '"replace"]', '"run"]'), ", line 9", "tabular.controls: control_names"),
    ('pomdp = "none.POMDP"', ", line 1", "pomdp: must be a file that can be read, got 'none.POMDP'.*there is no file"),
    ('pomdp = "."', ", line 1", "pomdp: must be a file that can be read, got '.'.*must be a file"),
    ('pomdp = "a\\u0000b"', ", line 1", "pomdp: must be a file that can be read"),
    ('name = "../../x"' + REPAIR, ", line 1", "name: name must have .* no slash"),
    ("name = '" + "x" * 300 + "'" + REPAIR, ", line 1", "name: name must have at most 100 bytes in UTF-8"),
    (changed(REPAIR, "20]", "1" + "0" * 400 + "]"), ", line 5", "repair.costs: must be an array of numbers"),
    (changed(REPAIR, "0.95", "1" + "0" * 5000), "", "Exceeds the limit"),
    ("pomdp = 3", ", line 1", "pomdp: must be the text of a file .POMDP, got 3"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "where", "message"), BROKEN)
def test_broken_files_get_one_line(path, text, where, message):
    with pytest.raises(ValueError) as error:
        read_problem(written(path, text))
    told = str(error.value)
    assert "\n" not in told
    assert told.startswith(f"{path}{where}: "), told
    assert re.search(message, told), told


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"[" * 100_000, b"a = " + b"[" * 100_000, b"\x00" * 50])
def test_foreign_files_are_refused(path, content):
    path.write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(str(path))):
        read_problem(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nosuch", "problem must be a preset .*linear20.*, a file .toml or .POMDP, or module:function, got 'nosuch'"),
        ("no_module:make", "problem must name a module and a function in it, got 'no_module:make'"),
        ("os.path:nothing", "problem must name a module and a function in it"),
        ("os:getcwd", "os:getcwd must return a Problem"),
        (":make", "problem must name a module"),
        (".os:make", "problem must name a module"),
        ("math:pi", "math:pi must be a function, got 3.14"),
        ("os:mkdir", "os:mkdir must be a function without arguments"),
        ("builtins:dict", "builtins:dict must be a function without arguments"),
    ],
)
def test_what_names_no_problem(text, message):
    with pytest.raises((ValueError, TypeError), match=message):
        find_problem(text)
