"""Results that a run keeps are used for what they are results of, and for nothing else."""

from __future__ import annotations

import shutil
from functools import partial

import pytest
import torch

from torchrl_pomdp import kept as module
from torchrl_pomdp.collectors import PartSampler, PolicyEvaluation, RolloutImprovement, labels
from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.files import load_tensors, save_tensors
from torchrl_pomdp.kept import keep, kept
from torchrl_pomdp.modules import FlatEncoder, PolicyCost, PolicyNetwork, RolloutPolicy
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, UrgencyRepair
from torchrl_pomdp.problems import make_problem

CONTENT = {"x": torch.arange(6.0).view(2, 3), "deep": {"n": 3, "text": "abc", "flag": True}, "seconds": 0.25}


@pytest.fixture
def warnings(monkeypatch):
    told = []
    monkeypatch.setattr(module.logger, "warning", lambda text, *args: told.append(text))
    return told


def equal(one, other):
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[key], other[key]) for key in one)
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    return type(one) is type(other) and one == other


def test_what_is_kept_comes_back(tmp_path, warnings):
    path = tmp_path / "deep" / "result.pt"
    path.parent.mkdir()
    keep(path, "mine", CONTENT)
    assert equal(kept(path, "mine"), CONTENT)
    keep(path, "mine", {"x": torch.zeros(0)})
    assert equal(kept(path, "mine"), {"x": torch.zeros(0)})
    assert warnings == []
    assert [p.name for p in path.parent.iterdir()] == ["result.pt"]


def test_nothing_is_kept_where_there_is_no_file(tmp_path, warnings):
    assert kept(tmp_path / "none.pt", "mine") is None
    assert warnings == [], "that is no damage"


@pytest.mark.parametrize("owner", ["", "other", "mine ", "Mine", "min"])
def test_others_results_are_not_used(tmp_path, warnings, owner):
    keep(tmp_path / "a.pt", owner, CONTENT)
    assert kept(tmp_path / "a.pt", "mine") is None
    assert warnings == [f"{tmp_path / 'a.pt'} is damaged or the result of another run: made again"]


def altered(content):
    """Results that are not what was kept, though files of the right form."""
    whole = {"owner": "mine", "digest": module.digest(content), "content": content}
    nan, shape, kind = content["x"].clone(), content["x"].view(3, 2), content["x"].double()
    nan[0, 0] = torch.nan
    return {
        "a number": whole | {"content": content | {"seconds": 0.5}},
        "NaN": whole | {"content": content | {"x": nan}},
        "a shape": whole | {"content": content | {"x": shape}},
        "a type": whole | {"content": content | {"x": kind}},
        "an entry more": whole | {"content": content | {"y": 1}},
        "an entry less": whole | {"content": {"x": content["x"]}},
        "a deep text": whole | {"content": content | {"deep": content["deep"] | {"text": "abd"}}},
        "no content": {"owner": "mine", "digest": whole["digest"]},
        "no digest": {"owner": "mine", "content": content},
        "no owner": {"digest": whole["digest"], "content": content},
        "content alone": content,
        "a list": [1, 2],
        "nothing": None,
        "a tensor": torch.zeros(3),
    }


@pytest.mark.parametrize("name", altered(CONTENT))
def test_altered_results_are_not_used(tmp_path, warnings, name):
    path = tmp_path / "a.pt"
    torch.save(altered(CONTENT)[name], path)
    assert kept(path, "mine") is None
    assert len(warnings) == 1
    assert str(path) in warnings[0]
    assert warnings[0].endswith("made again")


def test_damaged_bytes_are_never_used_as_something_else(tmp_path, warnings):
    path = tmp_path / "a.pt"
    keep(path, "mine", CONTENT)
    whole, generator = path.read_bytes(), torch.Generator().manual_seed(0)
    places = torch.randint(len(whole), (120,), generator=generator).tolist()
    for number, place in enumerate(places):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << number % 8
        path.write_bytes(damaged if number % 3 else whole[:place])
        found = kept(path, "mine")
        assert found is None or equal(found, CONTENT)
        assert (found is None) == bool(warnings)
        warnings.clear()


# Blocks of labels.

PROBLEM = make_problem("line3")
CUT = {"max_steps": 6, "terminal_cost": NeverRepairCost(PROBLEM.model)}


def network(seed):
    return PolicyNetwork(FlatEncoder(PROBLEM.model), 3, (4, 3), generator=torch.Generator().manual_seed(seed))


def collector(cache, kind=RolloutImprovement, policy=None, states_seed=0, size=10, told=None, **label):
    make = {RolloutImprovement: partial(RolloutPolicy, trajectories=2), PolicyEvaluation: PolicyCost}[kind]
    return kind(
        BeliefEnv(PROBLEM.model, PROBLEM.start),
        GreedyRepair(PROBLEM.model) if policy is None else policy,
        states=PartSampler(dict(enumerate(PROBLEM.training)), seed=states_seed),
        label=partial(make, **(CUT | label)),
        frames_per_batch=size,
        total_frames=size,
        cache=cache,
        on_labels=None if told is None else lambda count, cached: told.append((count, cached)),
    )


def collected(*args, **options):
    """The labelled states, the belief steps behind them, and which blocks were read back."""
    told = []
    source = collector(*args, told=told, **options)
    batch = next(iter(source))
    return {key: batch[key] for key in batch.keys(True, True)}, source.simulated_steps, told


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(labels, "_BLOCK", 4)


NEW, READ = [(4, False), (4, False), (2, False)], [(4, True), (4, True), (2, True)]


@pytest.mark.parametrize("kind", [RolloutImprovement, PolicyEvaluation])
def test_blocks_are_read_back(tmp_path, warnings, kind):
    first, steps, told = collected(tmp_path, kind)
    assert told == NEW
    again, more, told = collected(tmp_path, kind)
    assert told == READ
    assert again.keys() == first.keys()
    assert all(torch.equal(again[key], first[key]) for key in first)
    assert more == steps > 0
    without, _, _ = collected(None, kind)
    assert all(torch.equal(without[key], first[key]) for key in first)
    assert warnings == []


def test_a_longer_run_reads_the_blocks_that_it_shares(tmp_path, warnings):
    short, _, _ = collected(tmp_path, size=8)
    long, _, told = collected(tmp_path, size=10)
    assert told == [(4, True), (4, True), (2, False)]
    assert torch.equal(long["q_factors"][:8], short["q_factors"])


OTHERS = {
    "seed of the labels": {"seed": 1},
    "trajectories": {"trajectories": 3},
    "longest simulation": {"max_steps": 7},
    "seed of the states": {"states_seed": 1},
    "base policy": {"policy": UrgencyRepair(PROBLEM.model)},
    "its number": {"policy": GreedyRepair(PROBLEM.model, 0.3)},
    "its weights": {"policy": network(1)},
}


@pytest.mark.parametrize("name", OTHERS)
def test_blocks_of_other_labels_are_made_again(tmp_path, warnings, name):
    mine = {"policy": network(0)} if name == "its weights" else {}
    expected, steps, _ = collected(tmp_path / "mine", **mine)
    collected(tmp_path / "mixed", **OTHERS[name])
    found, more, told = collected(tmp_path / "mixed", **mine)
    assert told == NEW
    assert all(torch.equal(found[key], expected[key]) for key in expected)
    assert more == steps
    assert len(warnings) == 3
    assert collected(tmp_path / "mixed", **mine)[2] == READ, "and are kept then"


def test_blocks_in_each_others_place_are_made_again(tmp_path, warnings):
    expected, _, _ = collected(tmp_path)
    first, second, last = sorted(tmp_path.iterdir())
    content = first.read_bytes()
    shutil.copy(second, first)
    second.write_bytes(content)
    found, _, told = collected(tmp_path)
    assert told == [(4, False), (4, False), (2, True)]
    assert all(torch.equal(found[key], expected[key]) for key in expected)
    assert sorted(tmp_path.iterdir()) == [first, second, last]


@pytest.mark.parametrize("damage", ["flipped", "short", "empty", "text", "NaN", "another kind"])
def test_damaged_blocks_are_made_again(tmp_path, warnings, damage):
    expected, _, _ = collected(tmp_path / "cache")
    path = sorted((tmp_path / "cache").iterdir())[1]
    whole = path.read_bytes()
    if damage == "NaN":
        content = load_tensors(path)
        content["content"]["states"]["q_factors"][0, 0] = torch.nan
        save_tensors(path, content)
    elif damage == "another kind":
        collected(tmp_path / "other", PolicyEvaluation)
        shutil.copy(tmp_path / "other" / path.name, path)
    else:
        # Within the numbers of the labels, not in padding.
        place = whole.index(expected["q_factors"][4:8].contiguous().numpy().tobytes())
        path.write_bytes(
            {
                "flipped": whole[:place] + bytes([whole[place] ^ 64]) + whole[place + 1 :],
                "short": whole[: len(whole) // 2],
                "empty": b"",
                "text": b"labels",
            }[damage]
        )
    found, _, told = collected(tmp_path / "cache")
    assert told == [(4, True), (4, False), (2, True)]
    assert all(torch.equal(found[key], expected[key]) for key in expected)
    assert len(warnings) == 1
    assert str(path) in warnings[0]
    assert collected(tmp_path / "cache")[2] == READ
