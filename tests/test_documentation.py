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
    "02_ppo": {"UPDATES": 1, "EVALUATION_STATES": 20},
    "02_rollout_improves": {"PLAYED": 12, "SEEDS": 1, "SIMULATED": (1, 4), "CUTS": (2, 6), "RELATIVE_GAP": 0.005},
    "03_policy_iteration_torchrl": {
        "ITERATIONS": 2, "SAMPLES": 60, "TRAJECTORIES": 2, "OPTIMIZATION_STEPS": 50, "EVALUATION_STATES": 20,
    },
    "04_partitions_and_truncation": {
        "LOCATIONS": 4, "PLAYED": 8, "CHECKED": 50, "SAMPLES": 40, "OPTIMIZATION_STEPS": 20, "CUTS": (1, 4),
    },
}  # fmt: skip
# What every tutorial prints, at any size.
PRINTED = {
    "01_policy_iteration": ["| greedy |"],
    "02_ppo": ["greedy: "],
    "02_rollout_improves": ["the optimal cost is between 168.", "one-step rollout: ", "two-step lookahead: "],
    "03_policy_iteration_torchrl": ["iteration 2: cost ", "mean error of the value network: ", "it was read from the folder"],
    "04_partitions_and_truncation": ["0 of ", "right -> left: ", "on leaving the part: ", "pAPI-T: "],
}


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
def test_tutorials_run_at_a_small_size(script):
    notebook = jupytext.read(script)
    (parameters,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    for name, value in SMALL[script.stem].items():
        parameters.source, count = re.subn(rf"^{name} = .*$", f"{name} = {value}", parameters.source, flags=re.MULTILINE)
        assert count == 1, name
    NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    text = "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")
    assert [line for line in PRINTED[script.stem] if line not in text] == []


def test_the_loop_of_tutorial_1_is_short_and_uses_no_trainer():
    source = (ROOT / "tutorials" / "01_policy_iteration.py").read_text()
    loop = source[source.index("def improve(") : source.index("# ## Does it work?")]
    assert len([line for line in loop.splitlines() if line.strip() and not line.startswith("#")]) < 40
    assert "trainers" not in source
