"""Every block of README and documentation and every tutorial runs; results, links and messages in documents are real."""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import urlsplit

import jupytext
import nbformat
import pytest
import torch
from jupyter_client import KernelManager
from nbclient import NotebookClient
from tensordict import TensorDict
from test_fuzz import PUBLIC

from torchrl_pomdp import __version__
from torchrl_pomdp.controller import Controller
from torchrl_pomdp.envs import BeliefEnv, BeliefModel, FunctionPartition, TabularModel
from torchrl_pomdp.modules import Myopic, OnEntering, RolloutPolicy, ZeroCost
from torchrl_pomdp.problems import Problem, make_problem
from torchrl_pomdp.trainers.checkpoint import load_checkpoint, open_run_folder

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "tutorials").glob("*.py"))
# Parameters of every tutorial at a size for tests.
SMALL = {
    "01_policy_iteration": {
        "ITERATIONS": 1, "SAMPLES_PER_PART": 40, "TRAJECTORIES": 2, "OPTIMIZATION_STEPS": 5, "EVALUATION_STATES": 20,
    },
    "02_rollout_improves": {"PLAYED": 12, "SEEDS": 1, "SIMULATED": (1, 4), "CUTS": (2, 6), "RELATIVE_GAP": 0.005},
    "03_policy_iteration_torchrl": {
        "ITERATIONS": 2, "SAMPLES": 60, "TRAJECTORIES": 2, "OPTIMIZATION_STEPS": 50, "EVALUATION_STATES": 20,
    },
    "04_partitions_and_truncation": {
        "LOCATIONS": 3, "PLAYED": 4, "CHECKED": 20, "SAMPLES": 30, "OPTIMIZATION_STEPS": 10, "CUTS": (1, 3),
    },
    "05_peers": {
        "UPDATES": 1, "EVALUATION_STATES": 20, "STATES": 4, "BUDGETS": [2], "LARGE_STATES": 2, "LARGE_BUDGETS": [2],
    },
    "06_many_robots": {
        "TRAJECTORIES": 2, "STAGES_AHEAD": 2, "EVALUATION_STATES": 4, "SAMPLES": 50, "OPTIMIZATION_STEPS": 5, "FRAMES": 2,
    },
    "07_ray": {
        "WORKERS": 1, "ITERATIONS": 1, "SAMPLES_PER_PART": 30, "STAGES": 8, "OPTIMIZATION_STEPS": 5, "EVALUATION_STATES": 20,
    },
    "08_your_own_pomdp": {
        "PUMPS": 2, "TRAJECTORIES": 2, "ROLLOUT_STATES": 10, "EVALUATION_STATES": 100, "SAMPLES": 100, "ITERATIONS": 1,
        "OPTIMIZATION_STEPS": 5, "WEEKS": 6,
    },
}  # fmt: skip
# What every tutorial prints, at any size.
PRINTED = {
    "01_policy_iteration": ["| greedy |"],
    "02_rollout_improves": ["the optimal cost is between 168.", "one-step rollout: ", "two-step lookahead: "],
    "03_policy_iteration_torchrl": ["iteration 2: cost ", "mean error of the value network: ", "it was read from the folder"],
    "04_partitions_and_truncation": ["0 of ", "right -> left: ", "on leaving the part: ", "pAPI-T: "],
    "05_peers": ["| PPO |", "| DESPOT |", "| POMCP, random play |", "the optimum: 168.97"],
    "06_many_robots": ["31 Q-factors for one decision of 8 robots", "| signalled |", "| rollout of it |"],
    "07_ray": ["equal to the last bit: True", "the bound was kept: True", "Ray is running: False"],
    "08_your_own_pomdp": [
        "row (0, 1) sums to 1.1", "Careless: expected_cost: the result", "Undivided: estimator: the next state",
        "the model and the arrays agree", "got 'looks blue'", "state unchanged: True", "restarted, 3 controls are behind us",
    ],
}  # fmt: skip

PAGES = sorted(
    [
        ROOT / "README.md",
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "docs" / "concepts").glob("*.md"),
        *(ROOT / "docs" / "howto").glob("*.md"),
    ]
)
DOCUMENTS = sorted(
    [*PAGES, *(ROOT / "docs" / "api").glob("*.md"), ROOT / "CONTRIBUTING.md", *(ROOT / "results").glob("**/README.md")]
)


def named(path):
    return str(path.relative_to(ROOT))


def blocks(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=named)
def test_the_blocks_of_a_page_run(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shared = {"__name__": "page"}  # later blocks may use what earlier ones made
    for block in blocks(page):
        exec(compile(block, named(page), "exec"), shared)
    if "print(" in "".join(blocks(page)):
        assert capsys.readouterr().out


def test_pages_with_blocks_are_found():
    found = {page.stem for page in PAGES if blocks(page)}
    assert {"README", "rollout", "own-problem", "controller", "torchrl"} <= found


# ---- results ---------------------------------------------------------------------------------------------------------


def table_rows(text):
    return [line for line in text.splitlines() if line.startswith("| ")]


def measured(folder):
    """Rows of the tables that commands have written."""
    return {row for path in folder.glob("*.md") if path.name != "README.md" for row in table_rows(path.read_text())}


@pytest.mark.parametrize("folder", sorted(p for p in (ROOT / "results").iterdir() if p.is_dir()), ids=lambda path: path.name)
def test_the_tables_of_a_result_are_those_that_its_command_has_written(folder):
    text = (folder / "README.md").read_text()
    assert [row for row in table_rows(text) if row not in measured(folder)] == []
    assert f"]({folder.name}/README.md)" in (ROOT / "results" / "README.md").read_text()
    assert re.search(r"^    (torchrl-pomdp|python -m torchrl_pomdp)", text, re.MULTILINE), "the command"


def test_the_headlines_are_among_the_results():
    text = (ROOT / "README.md").read_text()
    headlines = table_rows(text[text.index("## Results") : text.index("## When not")])[1:]
    cells = [
        [cell.strip() for cell in row.strip("|").split("|")]
        for f in ("table1", "architectures")
        for row in measured(ROOT / "results" / f)
    ]
    tuned = [row for row in cells if len(row) >= 8]
    assert len(headlines) == 4
    for problem, policy, ratio, interval, paper in ([cell.strip() for cell in row.strip("|").split("|")] for row in headlines):
        assert any(row[:2] + row[4:6] == [problem, policy, ratio, interval] for row in tuned), (problem, policy)
        published = {row[7] for row in tuned if row[:2] == [problem, "pAPI-NT 2"]}
        assert paper in published, "the paper's best"


# ---- links, messages, names ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_links_lead_somewhere(document):
    prose = re.sub(r"```.*?```", "", document.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", prose):
        parts = urlsplit(target)
        if parts.scheme:
            assert parts.scheme == "https", target
            assert re.fullmatch(r"[\w.-]+\.[a-z]{2,}", parts.netloc), target
        elif parts.path:
            path = (document.parent / parts.path).resolve()
            # In the documentation results and tutorials lie beside its own pages.
            beside = ROOT / path.relative_to(ROOT / "docs") if path.is_relative_to(ROOT / "docs") else path
            assert path.exists() or beside.exists(), target
            # They are copied there, and what lies elsewhere is not beside them any more.
            results = ROOT / "results"
            assert path.is_relative_to(results) or not document.is_relative_to(results), target


def test_the_readme_is_short_and_links_its_pages():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 150
    howto = {page.stem for page in (ROOT / "docs" / "howto").glob("*.md")} - {"index"}
    assert {stem for stem in howto if f"docs/howto/{stem}.md" in text} == howto


def test_every_public_name_has_a_reference():
    reference = "".join(page.read_text() for page in (ROOT / "docs" / "api").glob("*.md"))
    assert [module for module in PUBLIC if f".. automodule:: torchrl_pomdp.{module}\n" not in reference] == []


def test_the_version_to_cite_is_the_library_s():
    for document in ("CITATION.cff", "docs/cite.md"):
        assert re.search(rf"^ *version *[:=] *\{{?{re.escape(__version__)}\}}?$", (ROOT / document).read_text(), re.MULTILINE)


class Own(BeliefModel):
    state_keys, device, dtype = ("x",), torch.device("cpu"), torch.float32
    state_spec = action_mask = expected_cost = observation_probs = estimator = None


def refusals(folder):
    """What users meet, by what makes it."""
    line3 = make_problem("line3")
    model, greedy = line3.model, line3.base_policies["greedy"]
    y = line3.start(torch.arange(4))
    one = TabularModel(torch.ones(1, 1, 1), torch.ones(1, 1, 1), torch.ones(1, 1), 0.5)
    blind = TabularModel(torch.eye(2).expand(1, 2, 2), torch.tensor([[[1.0, 0.0], [1.0, 0.0]]]), torch.ones(1, 2), 0.5)
    controller = Controller(blind, Myopic(blind))
    controller.reset(TensorDict({"belief": torch.tensor([0.5, 0.5])}, []))
    last = FunctionPartition(("many", "last"), lambda y: (y["belief"][..., 0] > 2).all(-1).long())
    parted = Problem(model.with_partition(last), line3.start)

    def play_illegal():
        env = BeliefEnv(model, line3.start, seed=0)
        y = env.reset()
        env.step(y.set("action", (~y["action_mask"]).int().argmax()))

    open_run_folder(folder / "run", {"seed": 0})
    (folder / "best.pt").write_bytes(b"nonsense")
    return [
        play_illegal,
        lambda: model.with_features(TensorDict({}, [2])),
        lambda: RolloutPolicy(model, lambda y: torch.zeros(4, dtype=torch.int64))(y),
        lambda: RolloutPolicy(one, Myopic(one), truncation=OnEntering((0,)), terminal_cost=ZeroCost()),
        lambda: RolloutPolicy(model, greedy, max_steps=5),
        lambda: RolloutPolicy(model, greedy, max_steps=2, terminal_cost=lambda y: torch.full(y.batch_size, torch.nan))(y),
        lambda: controller.update(0, 1),
        lambda: TabularModel(torch.tensor([[[0.9, 0.08], [0, 1.0]]]), torch.ones(1, 2, 1), torch.ones(1, 2), 0.5),
        lambda: parted.training[1](torch.arange(3)),
        lambda: model.to(torch.float64),
        lambda: RolloutPolicy(make_problem("network32x8").model, greedy),
        lambda: Own(0.5).world(),
        lambda: open_run_folder(folder / "run", {"seed": 1}),
        lambda: load_checkpoint(folder / "best.pt"),
    ]


def test_the_messages_of_the_faq_are_real(tmp_path):
    text = (ROOT / "docs" / "faq.md").read_text()
    quoted = re.findall(r"^\*\*`(.+)`\*\*$", text[: text.index("## TorchRL")], re.MULTILINE)
    raised = []
    for refused in refusals(tmp_path):
        with pytest.raises((ValueError, TypeError)) as caught:
            refused()
        raised.append(str(caught.value).replace(str(tmp_path / "run"), "…").replace(str(tmp_path / "best.pt"), "…"))
    assert sorted(raised) == sorted(quoted)


# ---- tutorials -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_notebooks_are_their_scripts(script):
    notebook = nbformat.read(script.with_suffix(".ipynb"), as_version=4)
    expected = jupytext.read(script)
    cells = [[(cell.cell_type, cell.source) for cell in each.cells] for each in (notebook, expected)]
    assert cells[0] == cells[1], f"run `make tutorials`: {script.stem}.ipynb is not made from its script"


@pytest.fixture(scope="module")
def kernel():
    """One kernel for all tutorials: to import PyTorch and TorchRL takes longer than most of them."""
    # Ray's workers give way to all other processes: beside other tests they would hardly get on.
    manager = KernelManager(kernel_name="python3")
    manager.start_kernel(env={**os.environ, "RAY_worker_niceness": "0"})
    yield manager
    manager.shutdown_kernel(now=True)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_tutorials_run_at_a_small_size(script, kernel):
    notebook = jupytext.read(script)
    # No name of the tutorial before is left.
    notebook.cells.insert(0, nbformat.v4.new_code_cell("%reset -f"))
    (parameters,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    for name, value in SMALL[script.stem].items():
        parameters.source, count = re.subn(rf"^{name} = .*$", f"{name} = {value}", parameters.source, flags=re.MULTILINE)
        assert count == 1, name
    NotebookClient(notebook, km=kernel, timeout=300).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    text = "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")
    assert [line for line in PRINTED[script.stem] if line not in text] == []


def test_the_loop_of_tutorial_1_is_short_and_uses_no_trainer():
    source = (ROOT / "tutorials" / "01_policy_iteration.py").read_text()
    loop = source[source.index("def improve(") : source.index("# ## Does it work?")]
    assert len([line for line in loop.splitlines() if line.strip() and not line.startswith("#")]) < 40
    assert "trainers" not in source
