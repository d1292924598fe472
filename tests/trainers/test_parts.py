"""Labelled states of a part, in memory and on disk."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torchrl.record import CSVLogger

from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.trainers import PolicyIterationConfig, papi_nt, parts
from torchrl_pomdp.trainers.parts import PartData, PartImages
from torchrl_pomdp.trainers.recipes import multiagent_rollouts

CONFIG = PolicyIterationConfig(iterations=1, samples_per_part=90, validation_states=20, epochs=1, least_steps=8)


@pytest.fixture(scope="module")
def problem():
    return make_problem("line3")


def trained(problem):
    (iteration,) = papi_nt(problem, CONFIG, GreedyRepair(problem.model))
    return [p.tolist() for p in iteration.policy.parameters()]


def test_what_lies_on_disk_trains_the_same(problem, monkeypatch, tmp_path):
    expected, seen, storage = trained(problem), [], parts.LazyMemmapStorage

    def noted(*args, **options):
        seen.append(options["scratch_dir"])
        return storage(*args, **options)

    monkeypatch.setattr(parts, "LazyMemmapStorage", noted)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(parts, "MEMORY", 5000)
    assert trained(problem) == expected
    assert len(seen) == 6
    assert all(folder.startswith(str(tmp_path)) for folder in seen)
    assert list(tmp_path.iterdir()) == [], "nothing is left there"


def test_blocks_are_kept_in_memory_up_to_the_limit(problem, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    y = problem.training[0](torch.arange(64))
    data = PartData(0, PartImages(problem.partition, problem.symmetries[:1]))
    monkeypatch.setattr(parts, "MEMORY", int(2.5 * y.set("partition", torch.zeros(64, dtype=torch.int64)).bytes()))
    for number in range(4):
        data.add(0, y)
        assert data.large == (number > 1)
    rows = list(data)
    assert [block.is_memmap() for block in rows] == [False, False, True, True]
    assert all(torch.equal(block["belief"], y["belief"]) for block in rows)
    assert len(data) == 256
    data.close()
    assert list(tmp_path.iterdir()) == []


def test_states_that_do_not_fit_on_disk_are_refused(problem, monkeypatch, tmp_path):
    """A mapped file without room would kill the process."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(parts, "MEMORY", 0)
    monkeypatch.setattr(parts.shutil, "disk_usage", lambda folder: SimpleNamespace(free=2 << 20))
    y = problem.training[0](torch.arange(10)).set("rest", torch.zeros(10, 40_000))
    data = PartData(0, PartImages(problem.partition, problem.symmetries[:1]))
    with pytest.raises(
        OSError, match=r"labelled states need .* bytes more on disk, 2,097,152 are free; TMPDIR names another place"
    ):
        data.add(0, y)
    data.close()
    assert list(tmp_path.iterdir()) == []


def test_the_order_does_not_depend_on_the_blocks(problem):
    y = problem.training[1](torch.arange(100))
    images, found = PartImages(problem.partition, problem.symmetries), []
    for size in (100, 7):
        data = PartData(1, images)
        for block in y.split(size):
            data.add(1, block)
        found.append(torch.cat(list(data))["belief"])
    assert torch.equal(*found)
    assert images.counts(y) == [0, 200, 0, 0, 0, 0]


def test_every_step_is_of_a_whole_batch(problem):
    """A rest of one state would else be every second step of 257 states by batches of 256."""
    y = problem.training[0](torch.arange(9)).set("number", torch.arange(9))
    buffer = parts._filled(y, 4, seed=0)
    passes = [buffer.sample()["number"].tolist() + buffer.sample()["number"].tolist() for _ in range(20)]
    assert all(len(set(seen)) == 8 for seen in passes), "no state twice in a pass"
    assert {number for seen in passes for number in seen} == set(range(9)), "another one is left out in each"


def test_files_of_losses_are_closed_once_a_part_is_trained(problem, tmp_path):
    """Else a run of many parts and iterations ends at the system's limit of open files."""
    config = PolicyIterationConfig(iterations=1, samples_per_part=20, least_steps=60, epochs=1, validation_states=10)
    logger = CSVLogger("log", log_dir=str(tmp_path))
    list(papi_nt(problem, config, GreedyRepair(problem.model), logger=logger))
    assert list((tmp_path / "log" / "scalars").rglob("*.csv"))
    assert not logger.experiment.files
    assert not logger.experiment.scalars


def test_online_rollout_is_cut_as_labels_are(problem):
    """Where the discount asks for too many stages, those that are given count online too."""
    config = PolicyIterationConfig(max_steps=20)
    rollouts = multiagent_rollouts(problem, GreedyRepair(problem.model), config, 1)
    assert {rollout.cost_to_go.max_steps for rollout in rollouts.values()} == {20}
