"""Every block of the README and every tutorial runs; the notebooks are those of their scripts."""

from __future__ import annotations

import re
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "tutorials").glob("*.py"))
# Parameters of every tutorial at a size for tests.
SMALL = {
    "01_policy_iteration": {
        "ITERATIONS": 1, "SAMPLES_PER_PART": 40, "TRAJECTORIES": 2, "OPTIMIZATION_STEPS": 5, "EVALUATION_STATES": 20,
    },
    "05_peers": {
        "UPDATES": 1, "EVALUATION_STATES": 20, "STATES": 4, "BUDGETS": [2], "LARGE_STATES": 2, "LARGE_BUDGETS": [2],
    },
    "06_many_robots": {
        "TRAJECTORIES": 2, "STAGES_AHEAD": 2, "EVALUATION_STATES": 4, "SAMPLES": 50, "OPTIMIZATION_STEPS": 5, "FRAMES": 2,
    },
    "07_ray": {"ITERATIONS": 1, "SAMPLES_PER_PART": 30, "OPTIMIZATION_STEPS": 5, "EVALUATION_STATES": 20},
    "08_your_own_pomdp": {
        "PUMPS": 2, "TRAJECTORIES": 2, "ROLLOUT_STATES": 10, "EVALUATION_STATES": 100, "SAMPLES": 100, "ITERATIONS": 1,
        "OPTIMIZATION_STEPS": 5, "WEEKS": 6,
    },
}  # fmt: skip
# What each tutorial must print.
PRINTED = {
    "01_policy_iteration": ["| greedy |"],
    "05_peers": ["| PPO |", "| DESPOT |", "| POMCP, random play |", "the optimum: 168.97"],
    "06_many_robots": ["31 Q-factors for one decision of 8 robots", "| signalled |", "| rollout of it |"],
    "07_ray": ["equal to the last bit: True", "the bound was kept: True", "Ray is running: False"],
    "08_your_own_pomdp": [
        "row (0, 1) sums to 1.1", "Careless: advance: the stage cost", "Undivided: advance: the next state",
        "the model and the arrays agree", "got 'looks blue'", "state unchanged: True", "restarted, 3 controls are behind us",
    ],
}  # fmt: skip


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)


def test_readme_blocks_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert blocks("python")
    shared = {"__name__": "readme"}  # later blocks may use what earlier ones made
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), shared)
    assert capsys.readouterr().out


@pytest.mark.parametrize("document", ["README.md", "results/README.md"])
def test_the_results_in_documents_are_those_of_the_results_folder(document):
    path = ROOT / document
    section = path.read_text()
    if document == "README.md":
        section = section[section.index("## Results") : section.index("## Reproducibility")]
    rows = [line for line in section.splitlines() if line.startswith("| ")]
    tables = [table for table in (ROOT / "results").glob("*.md") if table.name != "README.md"]
    measured = {line for table in tables for line in table.read_text().splitlines()}
    assert len(rows) > 10
    assert [row for row in rows if row not in measured] == []
    pictures = re.findall(r"\]\(([^)]+\.png)\)", section)
    assert pictures
    assert all((path.parent / picture).is_file() for picture in pictures)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_notebooks_are_their_scripts(script):
    notebook = nbformat.read(script.with_suffix(".ipynb"), as_version=4)
    expected = jupytext.read(script)
    cells = [[(cell.cell_type, cell.source) for cell in each.cells] for each in (notebook, expected)]
    assert cells[0] == cells[1], f"run `make tutorials`: {script.stem}.ipynb is not made from its script"


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_tutorials_run_at_a_small_size(script, monkeypatch):
    # Ray's workers give way to all other processes: beside other tests they would hardly get on.
    monkeypatch.setenv("RAY_worker_niceness", "0")
    notebook = jupytext.read(script)
    (parameters,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    for name, value in SMALL[script.stem].items():
        parameters.source, count = re.subn(rf"^{name} = .*$", f"{name} = {value}", parameters.source, flags=re.MULTILINE)
        assert count == 1, name
    NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    text = "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")
    assert [expected for expected in PRINTED[script.stem] if expected not in text] == []


def test_the_loop_of_tutorial_1_is_short_and_uses_no_trainer():
    source = (ROOT / "tutorials" / "01_policy_iteration.py").read_text()
    loop = source[source.index("def improve(") : source.index("# ## Does it work?")]
    assert len([line for line in loop.splitlines() if line.strip() and not line.startswith("#")]) < 40
    assert "trainers" not in source
