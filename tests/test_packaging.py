"""What is built and installed: a wheel that works without the source tree, and an sdist that has all of it."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest
from hatchling import build

import torchrl_pomdp

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a wheel and an sdist."""
    folder, here = tmp_path_factory.mktemp("dist"), Path.cwd()
    os.chdir(ROOT)
    try:
        build.build_wheel(str(folder))
        build.build_sdist(str(folder))
    finally:
        os.chdir(here)
    return folder


def python(*args, cwd, path):
    """Run Python with modules of ``path`` before the installed ones, and without those of the working directory."""
    environment = {**os.environ, "PYTHONPATH": str(path), "PYTHONSAFEPATH": "1"}
    result = subprocess.run([sys.executable, *args], cwd=cwd, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_a_wheel_works_without_the_source_tree(folder, tmp_path):
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
        file.extractall(tmp_path / "site")
        (metadata,) = [message_from_bytes(file.read(name)) for name in names if name.endswith("METADATA")]
    assert metadata["Version"] == torchrl_pomdp.__version__
    assert {name.split("/")[0] for name in names} == {"torchrl_pomdp", f"torchrl_pomdp-{metadata['Version']}.dist-info"}
    source = {path.relative_to(ROOT).as_posix() for path in (ROOT / "torchrl_pomdp").rglob("*") if path.is_file()}
    assert {name for name in source if "__pycache__" not in name} == {name for name in names if "dist-info" not in name}
    run = "import torchrl_pomdp.cli as cli; print(cli.__file__); cli.main(['evaluate', 'listen', *'{}'.split()])"
    found = python("-c", run.format("--problem tiger --states 20"), cwd=tmp_path, path=tmp_path / "site")
    assert found.splitlines()[0] == str(tmp_path / "site/torchrl_pomdp/cli.py")
    assert "| listen |" in found


def test_an_sdist_has_all_that_the_tests_need(folder):
    (sdist,) = folder.glob("*.tar.gz")
    with tarfile.open(sdist) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    needed = ["torchrl_pomdp", "tests", "tutorials", "benchmarks", "results"]
    source = {path.relative_to(ROOT).as_posix() for room in needed for path in (ROOT / room).rglob("*") if path.is_file()}
    ignored = "__pycache__", ".ipynb_checkpoints"
    assert {name for name in source if not any(part in name for part in ignored)} <= names
    assert {"README.md", "LICENSE", "Makefile", "constraints.txt", "pyproject.toml", "CHANGELOG.md"} <= names
    assert not any(part in name for name in names for part in ignored)


def test_what_is_imported_first_is_light():
    """The command line and the package itself wait for no other library."""
    shown = python("-c", "import sys, torchrl_pomdp; print('torch' in sys.modules)", cwd=ROOT, path=ROOT)
    assert shown.strip() == "False"
