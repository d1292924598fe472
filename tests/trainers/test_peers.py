"""All methods beside each other: which, from which states, kept and gone on with."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace

import pytest
import torch

from torchrl_pomdp import cli, commands
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import PartitionedValue
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.trainers import Checkpoint, PolicyIterationConfig, compare_peers, make_networks, make_values, peers
from torchrl_pomdp.trainers.checkpoint import problem_digest, save_checkpoint
from torchrl_pomdp.trainers.ppo import Training

SEARCHES = [f"{name} {mode}" for name in ("POMCP", "DESPOT") for mode in ("orig", "mod", "fair")]
LEARNT = ["R-T of urgency", "pAPI-NT 1", "pAPI-NT 1 + R-NT"]


@pytest.fixture(scope="module")
def checkpoint(line3):
    config = PolicyIterationConfig(hidden=(8, 5), value_hidden=(8,))
    policy = make_networks(line3, config, 0).eval()
    value = PartitionedValue(list(make_values(line3, config, 0).values)).eval()
    return Checkpoint(line3, config, "pAPI-NT", 1, policy, value)


@pytest.fixture(scope="module")
def folder(line3, checkpoint, tmp_path_factory):
    """A comparison that has been carried out, and its outcomes."""
    path = tmp_path_factory.mktemp("peers") / "run"
    outcomes = compare_peers(line3, path, checkpoint=checkpoint, states=3, seconds=0.001)
    return path, outcomes


def test_every_method_is_there(folder):
    _, outcomes = folder
    assert list(outcomes) == ["greedy", "urgency", "R-NT of urgency", *LEARNT, *SEARCHES]
    for name, outcome in outcomes.items():
        assert outcome.comparison.cost.count == 3
        assert outcome.seconds > 0.0
        assert (outcome.steps == 0.0) == (name in ("greedy", "urgency", "pAPI-NT 1")), name
    assert outcomes["greedy"].comparison.ratio.mean == 1.0


def test_it_goes_on_where_it_stopped(line3, folder, checkpoint, monkeypatch):
    path, outcomes = folder
    evaluated = []

    def watched(model, policy, start, *, num_states, first, **options):
        evaluated.append((first, num_states))
        return torch.full((num_states,), 100.0)

    monkeypatch.setattr(peers, "discounted_costs", watched)
    again = compare_peers(line3, path, checkpoint=checkpoint, states=3, seconds=0.001)
    assert evaluated == []
    assert {name: outcome.to_dict() for name, outcome in again.items()} == {n: o.to_dict() for n, o in outcomes.items()}
    # Only what was lost is made again.
    (path / "urgency" / "0000000-3.pt").unlink()
    again = compare_peers(line3, path, checkpoint=checkpoint, states=3, seconds=0.001)
    assert evaluated == [(0, 3)]
    assert again["urgency"].comparison.cost.mean == 100.0


def test_states_come_in_blocks_that_do_not_matter(line3, tmp_path, monkeypatch):
    monkeypatch.setattr(peers, "_peers", lambda problem, *_: {"greedy": peers._Peer(GreedyRepair(problem.model))})
    whole = compare_peers(line3, tmp_path / "whole", states=7, seconds=0.001)
    monkeypatch.setattr(peers, "_BLOCK", 2)
    parts = compare_peers(line3, tmp_path / "parts", states=7, seconds=0.001)
    assert parts["greedy"].comparison == whole["greedy"].comparison
    assert len(list((tmp_path / "parts" / "greedy").glob("0*.pt"))) == 4


def test_a_checkpoint_without_parts_is_of_the_problem_too(line3, tmp_path):
    """That of API: it costs what it costs where it was trained."""
    problem, config = line3.unpartitioned(), PolicyIterationConfig(hidden=(8, 5), value_hidden=(8,))
    policy, value = make_networks(problem, config, 0).eval(), make_values(problem, config, 0).eval()
    own = Checkpoint(problem, config, "API", 1, policy, value)
    options = {"checkpoint": own, "methods": ["API 1", "API 1 + R-NT"], "states": 4, "seconds": 0.001, "seed": 3}
    outcomes = compare_peers(line3, tmp_path, **options)
    assert list(outcomes) == ["greedy", "API 1", "API 1 + R-NT"]
    costs = discounted_costs(problem.model, policy, problem.start, num_states=4, seed=3, terminal_cost=problem.evaluation_cost)
    assert list(outcomes["API 1"].costs) == costs.tolist()
    bare = replace(own, policy=line3.base_policies["urgency"], iteration=0)
    assert "R-T of urgency" not in peers._peers(line3, bare, 0.01)


@pytest.mark.parametrize("name", ["POMCP mod", "PPO", "R-NT of urgency", "pAPI-NT 1", "pAPI-NT 1 + R-NT"])
def test_no_base_policy_is_named_like_another_method(line3, checkpoint, tmp_path, name):
    first, last = line3.base_policies.items()
    problem = replace(line3, base_policies=dict([first, (name, GreedyRepair(line3.model)), last]), spec=None)
    with pytest.raises(ValueError, match=f"base_policies must have names that no other method has, got '{re.escape(name)}'"):
        compare_peers(problem, tmp_path / "run", checkpoint=checkpoint, states=2, seconds=0.001)
    assert not list(tmp_path.iterdir())


def test_a_checkpoint_of_a_base_policy_has_its_name(line3, checkpoint):
    greedy, urgency = line3.base_policies.values()
    own = replace(checkpoint, policy=urgency, iteration=0)
    assert peers._peers(line3, own, 0.01)["urgency"].policy is urgency
    other = replace(line3, base_policies={"greedy": greedy, "urgency": GreedyRepair(line3.model)}, spec=None)
    with pytest.raises(ValueError, match="got 'urgency'"):
        peers._peers(other, own, 0.01)


def test_only_the_original_mode_may_do_everything(line3):
    every = peers._peers(line3, None, 0.01)
    for name, peer in every.items():
        assert peer.unrestricted == name.endswith("orig")
        if name in SEARCHES:
            model = peer.policy.model
            y = line3.start(torch.arange(1)).set("belief", torch.eye(5)[:1].expand(1, 3, 5))
            assert bool(model.action_mask(y)[0, 0]) == name.endswith("orig")


def test_ppo_is_trained_once(line3, tmp_path, monkeypatch):
    monkeypatch.setattr(peers, "_peers", lambda problem, *_: {"greedy": peers._Peer(GreedyRepair(problem.model))})
    updates, own = [], Training.update

    def update(training, batch):
        updates.append(training.seed)
        own(training, batch)

    monkeypatch.setattr(Training, "update", update)
    options = {"ppo_steps": 4096, "seconds": 0.001, "seed": 3}
    first = compare_peers(line3, tmp_path, states=2, **options)["PPO"].costs
    more = compare_peers(line3, tmp_path, states=12, **options)["PPO"].costs
    assert updates == [3]
    assert more[:2] == first
    # More steps are another training, which leaves the first one alone.
    compare_peers(line3, tmp_path, states=2, **(options | {"ppo_steps": 8192}))
    assert updates == [3, 3, 3]
    assert compare_peers(line3, tmp_path, states=2, **options)["PPO"].costs == first
    assert updates == [3, 3, 3]


def test_what_does_not_belong_is_refused(folder, line3, checkpoint, linear20, tmp_path):
    path, _ = folder
    before = sorted(path.rglob("*"))
    with pytest.raises(ValueError, match="holds another run, which differs in seconds"):
        compare_peers(line3, path, states=3, seconds=0.002)
    with pytest.raises(ValueError, match="checkpoint must be of the problem linear20, got one of line3"):
        compare_peers(linear20, tmp_path / "other", checkpoint=checkpoint)
    with pytest.raises(ValueError, match=r"model must have a scalar twin.*RockSample"):
        compare_peers(make_problem("rocksample7x8"), tmp_path / "rocks", states=2, seconds=0.001)
    assert sorted(path.rglob("*")) == before
    assert not list(tmp_path.iterdir())


def write_iterations(folder, *iterations):
    """Iterations by the belief steps of their parts."""
    numbers = {"samples": 1, "label_seconds": 1.0, "train_seconds": 1.0, "losses": {}}
    content = []
    for number, steps in enumerate(iterations, 1):
        made = {f"iteration-{number}/1-improve-part-{part}": own for part, own in enumerate(steps)}
        parts = {name: {"simulated_steps": own, **numbers} for name, own in made.items()}
        content.append({"number": number, "reason": "better", "parts": parts})
    (folder / "iterations.json").write_text(json.dumps(content))


def test_ppo_takes_as_many_steps_as_the_labels_did_but_no_fewer_than_it_can(line3, checkpoint, tmp_path, capsys):
    assert commands._ppo_steps(tmp_path, checkpoint) is None
    path = tmp_path / "iterations.json"
    assert f"without PPO, which takes as many belief steps as the labels of pAPI-NT took up to iteration 1: {path} does" in (
        capsys.readouterr().out
    )
    write_iterations(tmp_path, (3000, 4000), (500, 600))
    assert commands._ppo_steps(tmp_path, checkpoint) == 7000
    assert "labels of pAPI-NT took up to iteration 1, and 4,096 at least: 7,000" in capsys.readouterr().out
    assert commands._ppo_steps(tmp_path, replace(checkpoint, iteration=2)) == 8100
    # What a run has not finished, or never begun, has no number of steps.
    assert commands._ppo_steps(tmp_path, replace(checkpoint, iteration=3)) is None
    assert commands._ppo_steps(tmp_path, replace(checkpoint, policy=line3.base_policies["greedy"], iteration=0)) is None
    assert "up to iteration 0: a base policy has none" in capsys.readouterr().out
    write_iterations(tmp_path, (3, 4))
    assert commands._ppo_steps(tmp_path, checkpoint) == 4096


def test_the_command_writes_table_and_pictures(line3, checkpoint, tmp_path, capsys, monkeypatch):
    save_checkpoint(tmp_path / "best.pt", checkpoint)
    write_iterations(tmp_path, (40_000, 2_000), (5_000,))
    given = []

    def few(problem, folder, **options):
        given.append(options)
        some = {name: peers._peers(problem, None, 0.001)[name] for name in ("greedy", "urgency")}
        monkeypatch.setattr(peers, "_peers", lambda *_: some)
        return compare_peers(problem, folder, **(options | {"ppo_steps": None}))

    monkeypatch.setattr("torchrl_pomdp.commands.compare_peers", few)
    command = ["compare", "line3", "--checkpoint", str(tmp_path / "best.pt"), "--states", "3", "--seconds", "0.001"]
    assert cli.main([*command, "--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]) == 0
    (options,) = given
    assert options["ppo_steps"] == 42_000
    assert problem_digest(options["checkpoint"].problem) == problem_digest(line3)
    name = "compare-line3-0.001s"
    assert {file.name for file in (tmp_path / "out" / "compare").iterdir()} == {
        f"{name}{end}" for end in (".json", ".md", ".png", "-time.png")
    }
    content = json.loads((tmp_path / "out" / "compare" / f"{name}.json").read_text())
    assert list(content["outcomes"]) == ["greedy", "urgency"]
    shown = capsys.readouterr().out
    assert "| greedy |" in shown
    assert "pictures:" in shown


def test_the_command_writes_over_no_other_results(line3, checkpoint, tmp_path, capsys, monkeypatch):
    save_checkpoint(tmp_path / "best.pt", checkpoint)
    monkeypatch.setattr(peers, "_peers", lambda problem, *_: {"greedy": peers._Peer(GreedyRepair(problem.model))})
    path = tmp_path / "out/compare/compare-line3-0.001s.json"

    def compared(*more, runs="runs", out="out", states=3):
        command = ["compare", "line3", "--states", str(states), "--seconds", "0.001", "--runs", str(tmp_path / runs)]
        return cli.main([*command, "--out", str(tmp_path / out), *more])

    assert compared("--methods", "greedy") == 0
    before = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    others = {
        "states": {"states": 4, "runs": "more"},
        "seed": {"more": ("--seed", "5")},
        "checkpoint, policy": {"more": ("--checkpoint", str(tmp_path / "best.pt"))},
    }
    for name, options in others.items():
        assert compared("--methods", "greedy", *options.pop("more", ()), **options) == 2
        assert f"{path} holds another comparison, which differs in {name}\n" in capsys.readouterr().err
    assert compared() == 2
    assert "differs in methods\n" in capsys.readouterr().err
    assert {file.name: file.read_bytes() for file in path.parent.iterdir()} == before
    assert not (tmp_path / "more").exists()
    # The same one again, from wherever, and another one elsewhere.
    assert compared("--methods", "greedy", runs="more") == 0
    assert (
        json.loads(path.read_bytes())["outcomes"]["greedy"]["costs"]
        == json.loads(before[path.name])["outcomes"]["greedy"]["costs"]
    )
    assert compared(states=4, runs="more", out="other") == 0
    path.write_text("{")
    assert compared("--methods", "greedy") == 2
    assert "is damaged" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--states 1", "states must be at least 2, got 1"),
        ("--seconds 0", "seconds must be"),
        ("--checkpoint nowhere.pt", "nowhere.pt"),
    ],
)
def test_the_command_refuses_nonsense(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["compare", "line3", *arguments.split()]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_without_value_networks_nothing_is_cut(line3, checkpoint):
    bare = PartitionedValue([line3.pessimistic_cost] * line3.partition.num_parts)
    names = [set(peers._peers(line3, each, 0.01)) for each in (checkpoint, replace(checkpoint, value=bare))]
    assert names[0] - names[1] == {"R-T of urgency"}


def test_some_methods_of_all(folder, line3, checkpoint, monkeypatch):
    """They come in the order of all, beside the baseline, and from what has been kept."""
    path, outcomes = folder
    monkeypatch.setattr(peers, "discounted_costs", None)
    some = compare_peers(line3, path, checkpoint=checkpoint, methods=["POMCP fair", "pAPI-NT 1"], states=3, seconds=0.001)
    assert some == {name: outcomes[name] for name in ("greedy", "pAPI-NT 1", "POMCP fair")}
    assert list(some) == ["greedy", "pAPI-NT 1", "POMCP fair"]
    with pytest.raises(ValueError, match=r"methods must be one of greedy, urgency, R-NT of urgency, .* got 'PPO'"):
        compare_peers(line3, path, methods=["PPO"], states=3, seconds=0.001)


def test_costs_of_two_comparisons_are_paired(folder):
    """Each method's costs are those of the same start states, so that two tables can be put beside each other."""
    _, outcomes = folder
    costs, baseline = (torch.tensor(outcomes[name].costs) for name in ("POMCP fair", "greedy"))
    assert compare(costs, baseline) == outcomes["POMCP fair"].comparison


def test_ppo_comes_last(line3, tmp_path, monkeypatch):
    order = []
    monkeypatch.setattr(peers, "_peers", lambda problem, *_: {"greedy": peers._Peer(GreedyRepair(problem.model))})
    monkeypatch.setattr(peers, "ppo", lambda problem, **_: order.append("trained") or GreedyRepair(problem.model))
    compare_peers(line3, tmp_path, ppo_steps=5000, states=2, seconds=0.001, report=lambda name, _: order.append(name))
    assert order == ["greedy", "trained", "PPO"]


@pytest.mark.parametrize("spoil", ["bit", "version"])
def test_a_training_of_ppo_that_cannot_be_used_is_made_again(line3, tmp_path, monkeypatch, spoil):
    """As all else in the folder; nobody could do more about it than delete it."""
    monkeypatch.setattr(peers, "_peers", lambda problem, *_: {"greedy": peers._Peer(GreedyRepair(problem.model))})
    options = {"ppo_steps": 4096, "seconds": 0.001, "states": 2}
    first = compare_peers(line3, tmp_path, **options)["PPO"].costs
    path = tmp_path / "ppo-4096.pt"
    if spoil == "bit":
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    else:
        monkeypatch.setattr(sys.modules["torchrl_pomdp.trainers.ppo"], "__version__", "another")
    assert compare_peers(line3, tmp_path, **options)["PPO"].costs == first


def test_decisions_in_terminal_states_are_none(line3):
    model = line3.model
    y = line3.start(torch.arange(4))
    y["belief"][:3] = torch.eye(model.num_levels)[0]
    counted = peers._Counted(GreedyRepair(model), model)
    counted(model.with_features(y))
    assert counted.decisions == 1


def test_a_training_of_ppo_that_is_not_asked_for_is_left_alone(line3, tmp_path, monkeypatch):
    monkeypatch.setattr(peers, "_peers", lambda problem, *_: {"greedy": peers._Peer(GreedyRepair(problem.model))})
    options = {"ppo_steps": 4096, "seconds": 0.001, "states": 2}
    compare_peers(line3, tmp_path, methods=["greedy"], **options)
    (tmp_path / "ppo-4096.pt").write_bytes(b"of another version")
    compare_peers(line3, tmp_path, methods=["greedy"], **options)
    assert (tmp_path / "ppo-4096.pt").read_bytes() == b"of another version"
