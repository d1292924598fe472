"""Who imports whom: the heart knows no pipeline, and arrows only point down."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import torchrl_pomdp

ROOT = Path(torchrl_pomdp.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
ROOMS = ("torchrl_pomdp.envs.repair", "torchrl_pomdp.modules.repair")
# The repair problems by name and by file, the paper's experiments, and the command.
KNOW_PIPELINES = {"problems/repair.py", "reproduce.py", "changes.py", "cli.py", "commands.py"}
# What must not be imported from where; what lies beside these packages is free.
ABOVE = {
    "envs": {"modules", "problems", "collectors", "objectives", "planners", "trainers"},
    "modules": {"problems", "collectors", "objectives", "planners", "trainers"},
    "problems": {"collectors", "objectives", "planners", "trainers"},
    "collectors": {"objectives", "planners", "trainers"},
    "objectives": {"collectors", "planners", "trainers"},
    "planners": {"problems", "collectors", "objectives", "trainers"},
    "trainers": {"distributed"},
    # Given to those above by the command and by users.
    "distributed": {"envs", "modules", "problems", "collectors", "objectives", "planners", "trainers"},
    "workers.py": {"envs", "modules", "problems", "collectors", "objectives", "planners", "trainers", "distributed"},
}


def imported(path):
    """Modules of the library that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path} imports relatively"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {name for name in found if name.startswith("torchrl_pomdp.")}


def room(path):
    return path.relative_to(ROOT).as_posix()


def test_the_walk_sees_imports():
    assert "torchrl_pomdp.envs.repair" in imported(ROOT / "problems/repair.py")
    assert len(FILES) > 60


@pytest.mark.parametrize("path", FILES, ids=room)
def test_the_heart_knows_no_pipeline(path):
    name = room(path)
    if name in KNOW_PIPELINES or name.startswith(("envs/repair/", "modules/repair/")):
        return
    assert [found for found in sorted(imported(path)) if found.startswith(ROOMS)] == []


@pytest.mark.parametrize("path", FILES, ids=room)
def test_arrows_point_down(path):
    layer = room(path).split("/")[0]
    above = {f"torchrl_pomdp.{name}" for name in ABOVE.get(layer, ())}
    assert [found for found in sorted(imported(path)) if ".".join(found.split(".")[:2]) in above] == []


@pytest.mark.parametrize("path", FILES, ids=room)
def test_ray_is_for_the_cluster_alone(path):
    names = {
        alias.name for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Import) for alias in node.names
    }
    names |= {node.module for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom) and node.module}
    assert room(path).startswith("distributed/") or not any(name.split(".")[0] == "ray" for name in names)
