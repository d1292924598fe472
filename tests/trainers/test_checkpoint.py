"""Checkpoints: what is restored, what is refused when saved, and what is refused when loaded."""

from __future__ import annotations

import copy
import json
import random
import time
from dataclasses import replace

import pytest
import torch

from torchrl_pomdp.envs.repair import CalibratedStart, RepairModel, damage_chain, line
from torchrl_pomdp.files import DamagedFileError, load_tensors, save_tensors
from torchrl_pomdp.identity import digest
from torchrl_pomdp.modules import FlatEncoder, PartitionedPolicy, PartitionedValue
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, SteadyStateCost, UrgencyRepair
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.trainers import (
    Checkpoint,
    PolicyIterationConfig,
    load_checkpoint,
    make_networks,
    make_values,
    save_checkpoint,
)

CONFIG = PolicyIterationConfig(hidden=(8,), value_hidden=(6, 5))


def networks(problem, config=CONFIG, seed=5):
    return make_networks(problem, config, seed=seed), make_values(problem, config, seed=seed + 1)


@pytest.fixture
def small():
    """A checkpoint of few weights."""
    problem = make_problem("line3", partitioned=False)
    return Checkpoint(problem, CONFIG, "API", 2, *networks(problem))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "policy.pt"


def same(one, other):
    assert (one.problem.name, one.problem.spec) == (other.problem.name, other.problem.spec)
    assert (one.config, one.algorithm, one.iteration) == (other.config, other.algorithm, other.iteration)
    mine, theirs = ([*c.policy.policies, *c.value.values] for c in (one, other))
    return digest(mine) == digest(theirs)


def rewrite(path, **about):
    """Change what a checkpoint says of itself, and make its digest agree."""
    content = load_tensors(path)
    content["about"] = json.dumps(json.loads(content["about"]) | about)
    save_tensors(path, redigested(content))


def redigested(content):
    return content | {"digest": digest({key: content[key] for key in ("about", "policy", "value")})}


@pytest.mark.parametrize("partitioned", [True, False])
@pytest.mark.parametrize("encoder", ["flat", "own"])
def test_restores_policy_values_partition_problem_and_configuration(path, partitioned, encoder):
    problem, config = make_problem("line3", partitioned=partitioned), replace(CONFIG, encoder=encoder)
    policy, value = networks(problem, config)
    given = Checkpoint(problem, config, "pAPI-T", 3, policy, value)
    save_checkpoint(str(path), given)
    loaded = load_checkpoint(str(path))
    assert same(loaded, given)
    assert (loaded.iteration, loaded.name) == (3, "pAPI-T 3")
    y = problem.model.with_features(problem.start(torch.arange(20)))
    for mine, theirs in ((loaded.policy, policy), (loaded.value, value)):
        with torch.no_grad():
            assert torch.equal(mine(y.copy())[mine.out_keys[-1]], theirs(y.copy())[theirs.out_keys[-1]])
    assert [p.name for p in path.parent.iterdir()] == ["policy.pt"], "no temporary file is left"


def test_knows_which_parts_have_value_networks(line3, path):
    policy, value = networks(line3)
    mixed = PartitionedValue([NeverRepairCost(line3.model)] * 3 + list(value.values[3:]))
    save_checkpoint(path, Checkpoint(line3, CONFIG, "pAPI-T", 1, policy, mixed))
    kinds = [type(v).__name__ for v in load_checkpoint(path).value.values]
    assert kinds == ["NeverRepairCost"] * 3 + ["ValueNetwork"] * 3


@pytest.mark.parametrize(("name", "kind"), [("greedy", GreedyRepair), ("urgency", UrgencyRepair)])
def test_holds_a_base_policy(line3, path, name, kind):
    value = PartitionedValue([NeverRepairCost(line3.model)] * 6)
    save_checkpoint(path, Checkpoint(line3, CONFIG, "pAPI-NT", 0, kind(line3.model), value))
    loaded = load_checkpoint(path)
    assert (loaded.name, loaded.iteration, type(loaded.policy)) == (name, 0, kind)
    y = line3.model.with_features(line3.start(torch.arange(20)))
    assert torch.equal(loaded.policy(y.copy())["action"], kind(line3.model)(y.copy())["action"])
    rewrite(path, base={"name": name, "digest": "0" * 32})
    with pytest.raises(DamagedFileError, match=f"base policy {name} is not what it was"):
        load_checkpoint(path)


def test_equal_checkpoints_have_equal_bytes(line3, tmp_path):
    one, other = networks(line3), copy.deepcopy(networks(line3))
    weight = other[0].policies[0].network[0].weight
    # As an optimiser may leave it: the same numbers, elsewhere in memory and in another order.
    weight.data = weight.data.T.contiguous().T
    for name, (policy, value) in (("one", one), ("other", other)):
        save_checkpoint(tmp_path / name, Checkpoint(line3, CONFIG, "pAPI-NT", 1, policy, value))
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()
    save_checkpoint(tmp_path / "again", load_checkpoint(tmp_path / "one"))
    assert (tmp_path / "one").read_bytes() == (tmp_path / "again").read_bytes()


def test_a_problem_is_told_by_its_content(line3, path):
    """Discount, chain, start states, training states, partition: under the preset's name each makes another problem."""
    policy, value = networks(line3)
    model = line3.model
    others = [
        replace(line3, model=RepairModel(line(3), model.chain, model.costs, 0.9, partition=model.partition)),
        replace(
            line3, model=RepairModel(line(3), damage_chain((0, 0.1, 0.1, 0.1)), model.costs, 0.99, partition=model.partition)
        ),
        replace(line3, start=CalibratedStart(model)),
        replace(line3, training=line3.training[::-1]),
        replace(line3, encoder=FlatEncoder),
        replace(line3, symmetries=line3.symmetries[:1]),
        replace(line3, pessimistic_cost=SteadyStateCost(model)),
    ]
    for other in others:
        with pytest.raises(
            ValueError, match=r"checkpoint.problem must be what its spec describes, got another problem 'line3'"
        ):
            save_checkpoint(path, Checkpoint(other, CONFIG, "pAPI-NT", 1, policy, value))
    with pytest.raises(ValueError, match=r"checkpoint.problem must be what its spec describes, got another problem 'mine'"):
        save_checkpoint(path, Checkpoint(replace(line3, name="mine"), CONFIG, "pAPI-NT", 1, policy, value))
    assert not path.exists()
    save_checkpoint(path, Checkpoint(line3, CONFIG, "pAPI-NT", 1, policy, value))
    rewrite(path, problem_digest="0" * 32)
    with pytest.raises(DamagedFileError, match=r"policy\.pt .*problem line3 is not what it was"):
        load_checkpoint(path)


def doubled(policy):
    """A copy with weights of another type, which a network itself refuses to be converted to."""
    policy = copy.deepcopy(policy)
    for parameter in policy.parameters():
        parameter.data = parameter.data.double()
    return policy


def test_what_could_not_be_loaded_is_refused_when_saved(line3, linear20, path):
    policy, value = networks(line3)
    greedy = GreedyRepair(line3.model)
    nan = copy.deepcopy(policy)
    nan.policies[2].network[0].bias.data[1] = torch.nan
    infinite = copy.deepcopy(value)
    infinite.values[2].network[0].bias.data[1] = torch.inf
    steady = PartitionedValue([SteadyStateCost(line3.model)] * 6)
    wrong = [
        (
            "must have a PolicyNetwork or an AgentNetwork in every part, got GreedyRepair",
            PartitionedPolicy([greedy] * 6),
            value,
        ),
        ("or one of greedy, urgency as it is by name, got another GreedyRepair", GreedyRepair(line3.model, 0.3), value),
        ("or one of greedy, urgency as it is by name, got another UrgencyRepair", UrgencyRepair(line3.model, 2.0), value),
        ("could not be loaded again: policies.2.network.0.bias holds numbers that are not finite", nan, value),
        ("could not be loaded again: values.2.network.0.bias holds numbers that are not finite", policy, infinite),
        ("checkpoint.value must be what", policy, steady),
        ("its policies are not networks of sizes", networks(line3, replace(CONFIG, hidden=(8, 8)))[0], value),
        ("policies.0.network.0.weight must have shape", networks(line3, replace(CONFIG, hidden=(9,)))[0], value),
        ("policies.0.network.0.weight must have shape", networks(linear20)[0], value),
        ("values.0.network.0.weight must have shape", policy, networks(line3, replace(CONFIG, value_hidden=(9, 9)))[1]),
        ("and type torch.float32, got .* and torch.float64", doubled(policy), value),
    ]
    for message, policy_, value_ in wrong:
        with pytest.raises(ValueError, match=message):
            save_checkpoint(path, Checkpoint(line3, CONFIG, "pAPI-NT", 1, policy_, value_))
    assert not path.exists()


def test_encoders_of_equal_size_are_told_apart(line3, path):
    """A network whose encoder is not the configuration's would read other numbers once it is loaded."""
    policy, value = networks(line3, replace(CONFIG, encoder="flat"))
    encoder = policy.policies[0].encoder
    encoder.keys = tuple(reversed(encoder.keys))
    with pytest.raises(ValueError, match=r"checkpoint.policy must be what checkpoint.problem and checkpoint.config describe"):
        save_checkpoint(path, Checkpoint(line3, replace(CONFIG, encoder="flat"), "pAPI-NT", 1, policy, value))


@pytest.mark.parametrize(
    "change",
    [
        {"problem": "line3"}, {"config": {}}, {"algorithm": 3}, {"algorithm": "\x1b[31mred"}, {"algorithm": ""},
        {"algorithm": "/x"}, {"algorithm": "../x"}, {"algorithm": "x" * 101},
        {"iteration": -1}, {"iteration": 1.0}, {"iteration": "x"}, {"iteration": True}, {"policy": None}, {"value": None},
    ],
)  # fmt: skip
def test_fields_are_checked(small, change):
    with pytest.raises((TypeError, ValueError), match=f"^checkpoint.{next(iter(change))} must (be|have)"):
        replace(small, **change)


@pytest.mark.parametrize("path", [None, 3, b"policy.pt", ["policy.pt"]])
def test_paths_are_texts_or_paths(small, path):
    with pytest.raises(TypeError, match="path must be a path"):
        load_checkpoint(path)
    with pytest.raises(TypeError, match="path must be a path"):
        save_checkpoint(path, small)
    with pytest.raises(TypeError, match="checkpoint must be a Checkpoint"):
        save_checkpoint("policy.pt", path)


def test_a_flipped_bit_never_loads_as_another_policy(path, small):
    save_checkpoint(path, small)
    whole, chance = path.read_bytes(), random.Random(0)
    errors = []
    for _ in range(300):
        content = bytearray(whole)
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        path.write_bytes(content)
        try:
            assert same(load_checkpoint(path), small)
        except DamagedFileError as error:
            errors.append(str(error))
    assert len(errors) > 100
    assert all(str(path) in error for error in errors)


def test_damaged_and_foreign_files_are_refused_by_name(path, small):
    with pytest.raises(ValueError, match=r"there is no checkpoint .*policy\.pt"):
        load_checkpoint(path)
    save_checkpoint(path, small)
    whole = path.read_bytes()
    for content in (b"", b"hello", whole[: len(whole) // 2], whole[:-1], whole[1:]):
        path.write_bytes(content)
        with pytest.raises(DamagedFileError, match=r"policy\.pt is damaged or no"):
            load_checkpoint(path)
    for foreign in ({"weights": torch.ones(3)}, torch.ones(3), [], {"about": 3}, {"about": "[]"}, {"about": "{"}, small.config):
        torch.save(foreign, path)
        with pytest.raises(DamagedFileError, match=r"policy\.pt is damaged or no"):
            load_checkpoint(path)


@pytest.mark.parametrize(
    "about",
    [
        {"iteration": "x"}, {"iteration": ["x"]}, {"iteration": -1}, {"iteration": True}, {"iteration": 1.5},
        {"algorithm": "\x1b[2Jgone"}, {"algorithm": None}, {"problem": "grid5x4"}, {"problem": "line4"}, {"problem": ["line3"]},
        {"spec": {"preset": "line3"}}, {"spec": {"preset": "line3", "partitioned": 1}}, {"spec": 3}, {"spec": {}},
        {"config": {"hidden": [8], "nonsense": 1}}, {"config": []},
        {"config": {"hidden": [9]}}, {"config": {"seed": -1}}, {"config": {"learning_rate": float("nan")}},
        {"value_parts": [0, 0]}, {"value_parts": [5]}, {"value_parts": 0}, {"value_parts": []}, {"value_parts": ["0"]},
        {"base": "greedy"}, {"base": {"name": "lazy", "digest": ""}}, {"base": {}}, {"format": "torchrl_pomdp policy 2"},
        {"more": 1},
    ],
)  # fmt: skip
def test_descriptions_that_do_not_fit_are_refused(path, small, about):
    save_checkpoint(path, small)
    rewrite(path, **about)
    with pytest.raises(DamagedFileError, match=r"policy\.pt is damaged or no checkpoint"):
        load_checkpoint(path)


@pytest.mark.parametrize("entry", ["about", "policy", "value", "digest"])
def test_every_entry_is_needed(path, small, entry):
    save_checkpoint(path, small)
    content = load_tensors(path)
    del content[entry]
    save_tensors(path, content)
    with pytest.raises(DamagedFileError, match=r"policy\.pt is damaged or no checkpoint"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    "name", ["algorithm", "iteration", "config", "problem", "base", "value_parts", "problem_digest", "spec"]
)
def test_every_line_of_the_description_is_needed(path, small, name):
    save_checkpoint(path, small)
    content = load_tensors(path)
    about = json.loads(content["about"])
    del about[name]
    save_tensors(path, redigested(content | {"about": json.dumps(about)}))
    with pytest.raises(DamagedFileError, match="its entries are not those of a checkpoint"):
        load_checkpoint(path)


def test_weights_that_are_none_are_refused(path, small):
    save_checkpoint(path, small)
    content = load_tensors(path)
    key = "policies.0.network.0.weight"
    good = content["policy"][key]
    bad = [torch.full_like(good, torch.nan), good.double(), good[:, 1:].clone(), good.T, torch.zeros(1, 1).expand_as(good), 3]
    for tensor in bad:
        save_tensors(path, redigested(content | {"policy": content["policy"] | {key: tensor}}))
        with pytest.raises(DamagedFileError, match=r"policy\.pt is damaged or no checkpoint"):
            load_checkpoint(path)
    content["policy"] = content["policy"] | {key: good + 1}
    save_tensors(path, content)
    with pytest.raises(DamagedFileError, match="does not agree with its digest"):
        load_checkpoint(path)


def test_huge_networks_are_refused_before_they_are_built(path, small):
    save_checkpoint(path, small)
    whole = path.read_bytes()
    for hidden in ([1] * 200_000, [1 << 14] * 16):
        path.write_bytes(whole)
        rewrite(path, config={"hidden": hidden})
        begin = time.perf_counter()
        with pytest.raises(DamagedFileError):
            load_checkpoint(path)
        assert time.perf_counter() - begin < 2.0
    path.write_bytes(whole)
    content = load_tensors(path)
    content["policy"]["policies.0.network.0.weight"] = torch.zeros(1).expand(1 << 50)
    save_tensors(path, content | {"digest": ""})
    with pytest.raises(DamagedFileError, match="its weights are no plain tensors"):
        load_checkpoint(path)


def test_a_device_that_is_not_there_is_no_damage(path, small):
    save_checkpoint(path, small)
    with pytest.raises(ValueError, match="device must be a device of this machine"):
        load_checkpoint(path, device="nonsense")
