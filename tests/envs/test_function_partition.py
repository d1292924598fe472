from __future__ import annotations

import pickle

import pytest
import torch
from tensordict import TensorDict

from torchrl_pomdp.envs import InPart, Partition, TabularModel
from torchrl_pomdp.envs.partition import FunctionPartition
from torchrl_pomdp.noise import uniform
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.problems.check_partition import check_partition


def worn(y):
    return (y["belief"][..., 1] > 0.5).long()


def machine(partition):
    """A machine that wears out or is kept as it is; nothing repairs it."""
    wear = torch.tensor([[[0.5, 0.5], [0.0, 1.0]], [[1.0, 0.0], [0.0, 1.0]]])
    see = torch.eye(2).expand(2, 2, 2)
    return TabularModel(wear, see, torch.zeros(2, 2), 0.9, partition=partition)


def start(keys):
    new = (uniform(keys, 0) < 0.75).float()
    return TensorDict({"belief": torch.stack([new, 1 - new], -1)}, keys.shape)


def test_the_function_gives_the_parts():
    partition = FunctionPartition(("new", "worn"), worn)
    assert isinstance(partition, Partition)
    assert (partition.names, partition.stages, partition.num_parts) == (("new", "worn"), ((0, 1),), 2)
    model = machine(partition)
    y = model.with_features(start(torch.arange(20)))
    assert torch.equal(y["partition"], y["belief"].argmax(-1))
    assert model.with_features(start(torch.arange(0)))["partition"].shape == (0,)
    assert model.with_features(start(torch.tensor(3)))["partition"].shape == ()
    assert InPart(model, start, 1)(torch.arange(9))["belief"].argmax(-1).tolist() == [1] * 9
    assert torch.equal(pickle.loads(pickle.dumps(partition))(y), y["partition"])


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ((("a",), 3), TypeError, "function must be callable"),
        (((), worn), ValueError, "names must hold at least 1"),
        (("ab", worn), TypeError, "names must be a sequence"),
        ((("a", ""), worn), ValueError, r"names\[1\]"),
        ((("a", "b"), worn, ((0,),)), ValueError, "must hold every part 0..1 once"),
        ((("a", "b"), worn, ((0, 1), (1,))), ValueError, "must hold every part 0..1 once"),
        ((("a", "b"), worn, ()), ValueError, "stages must hold at least 1"),
        ((("a", "b"), worn, (0, 1)), TypeError, r"stages\[0\] must be a Sequence"),
        ((("a", "b"), worn, ((0.0,), (1,))), TypeError, "must be an integer"),
    ],
)
def test_wrong_partitions_are_refused(given, error, message):
    with pytest.raises(error, match=message):
        FunctionPartition(*given)


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (lambda y: y["belief"][..., 1], TypeError, "int64 tensor, got torch.float32"),
        (lambda y: 0, TypeError, "int64 tensor, got 0"),
        (lambda y: y["belief"].long(), ValueError, r"one part for each state, \(2,\), got \(2, 2\)"),
        (lambda y: worn(y) + 1, ValueError, r"parts in 0\.\.1, got 2"),
        (lambda y: worn(y) - 1, ValueError, r"parts in 0\.\.1, got -1"),
    ],
)
def test_wrong_parts_are_refused(function, error, message):
    y = TensorDict({"belief": torch.tensor([[1.0, 0.0], [0.0, 1.0]])}, [2])
    with pytest.raises(error, match=message):
        FunctionPartition(("new", "worn"), function)(y)


def test_shares_and_transitions_are_counted():
    model = machine(FunctionPartition(("new", "worn"), worn, ((1,), (0,))))
    report = check_partition(model, start, lambda y: y.set("action", y["partition"] * 0), num_states=4000, max_steps=1)
    assert report.start[0] == pytest.approx(0.75, abs=0.03)
    assert report.visited[0] == pytest.approx((0.75 + 0.375) / 2, abs=0.03)
    (stay, wear), back = report.transitions
    assert stay + wear + sum(back) == 4000
    assert wear / (stay + wear) == pytest.approx(0.5, abs=0.05)
    assert back == (0, round(4000 * report.start[1]))
    assert report.violations == {}
    assert report.stages == (1, 0)
    assert str(report).splitlines()[-1] == "0 of 4000 transitions lead to a later stage"


def test_the_wrong_order_of_stages_is_seen():
    model = machine(FunctionPartition(("new", "worn"), worn, ((0,), (1,))))
    report = check_partition(model, start, num_states=500, seed=7)
    assert report.violations == {("new", "worn"): report.transitions[0][1]}
    assert report.transitions[0][1] > 100
    assert str(report).splitlines()[-1] == f"  new -> worn: {report.transitions[0][1]}"
    assert report == check_partition(model, start, num_states=500, seed=7)
    assert report != check_partition(model, start, num_states=500, seed=8)


def test_the_stages_of_the_repair_problem_are_in_order(line3):
    report = check_partition(line3.model, line3.start, line3.base_policies["greedy"], num_states=300)
    assert report.violations == {}
    assert sum(report.visited) == pytest.approx(1.0)


def test_what_cannot_be_checked_is_refused():
    tiger = make_problem("tiger")
    with pytest.raises(ValueError, match="model must have a partition"):
        check_partition(machine(None), start)
    with pytest.raises(TypeError, match="model must be a BeliefModel"):
        check_partition(tiger, tiger.start)
    with pytest.raises(TypeError, match="policy must be callable"):
        check_partition(tiger.model, tiger.start, 3)
    with pytest.raises(ValueError, match="num_states must be at least 1"):
        check_partition(tiger.model, tiger.start, num_states=0)
    with pytest.raises(ValueError, match="action 5 at batch index"):
        check_partition(tiger.model, tiger.start, lambda y: y.set("action", y["partition"] + 5))


def test_random_controls_do_not_depend_on_how_the_start_was_drawn(linear20, monkeypatch):
    """Where a robot stands says nothing of what it draws: half of those inside the line that do not repair go left."""
    seen, advance = [], type(linear20.model).advance

    def looked_at(model, y, u, noise):
        seen.append((y.clone(), u))
        return advance(model, y, u, noise)

    monkeypatch.setattr(type(linear20.model), "advance", looked_at)
    check_partition(linear20.model, linear20.start, num_states=4000, max_steps=1)
    ((y, u),) = seen
    place = y["location"][:, 0]
    for part in (place.ge(1) & place.lt(10), place.ge(10) & place.lt(19)):
        left = (u[part & (u != 0)] == 1).double().mean()
        assert 0.44 < left < 0.56


def test_many_robots_choose_each_for_itself():
    problem = make_problem("network32x8")
    report = check_partition(problem.model, problem.start, num_states=20, max_steps=3)
    assert sum(map(sum, report.transitions)) == 60
