"""What is no problem is refused by name: a wrong kind of thing by TypeError, a wrong value by ValueError."""

from __future__ import annotations

import dataclasses
import math
import time

import pytest
import torch
from tensordict import TensorDict

from torchrl_pomdp.envs import BeliefEnv, FixedBelief, InPart, Mixture, SinglePart, TabularModel
from torchrl_pomdp.envs.repair import (
    CalibratedStart,
    Graph,
    RandomState,
    RepairModel,
    RepairPartition,
    UniformStart,
    damage_chain,
    grid,
    line,
    symmetries,
)
from torchrl_pomdp.problems import make_problem, tiger

NAN, INF, HUGE = math.nan, math.inf, torch.tensor([0.0, 1e300], dtype=torch.float64)
PATH = {
    "name": "path",
    "neighbours": [[-1, 1], [0, 2], [1, -1]],
    "slot_names": ("left", "right"),
    "columns": [0, 1, 2],
    "rows": [0, 0, 0],
}


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"neighbours": [[-1, 1], [-1, 2], [1, -1]]}, ValueError, "from location 0 to 1 but not back"),
        ({"neighbours": [[0, 1], [0, 2], [1, -1]]}, ValueError, "another location"),
        ({"neighbours": [[-1, 1.5], [0, 2], [1, -1]]}, TypeError, r"neighbours\[0\]\[1\]"),
        ({"neighbours": [[-1, True], [0, 2], [1, -1]]}, TypeError, r"neighbours\[0\]\[1\]"),
        ({"neighbours": [[-1, 1], [0], [1, -1]]}, ValueError, r"neighbours\[1\] must have 2 slots"),
        ({"neighbours": torch.zeros(3, 2)}, TypeError, "neighbours"),
        ({"neighbours": []}, ValueError, "neighbours must hold 1 to"),
        ({"neighbours": None}, TypeError, "neighbours"),
        ({"slot_names": ("left",)}, ValueError, "slot_names must hold 2 names"),
        ({"slot_names": ("left", "")}, ValueError, r"slot_names\[1\]"),
        ({"columns": [0, 1]}, ValueError, "columns must have shape"),
        ({"columns": [0, 1, NAN]}, ValueError, "columns must hold finite numbers"),
        ({"columns": [0, 1, 1e300]}, ValueError, "columns must hold finite numbers"),
        ({"rows": [0, INF, 0]}, ValueError, "rows must hold finite numbers"),
        ({"rows": "abc"}, TypeError, "rows"),
        ({"columns": [0, 1, 0]}, ValueError, "locations 0 and 2 are both at"),
        ({"name": ""}, ValueError, "name"),
        ({"name": None}, TypeError, "name"),
    ],
)
@pytest.mark.parametrize("make", [Graph, Graph.from_slots])
def test_graphs(make, change, error, message):
    assert make(**PATH).distances[0].tolist() == [0, 1, 2]
    with pytest.raises(error, match=message):
        make(**{**PATH, **change})


@pytest.mark.parametrize(
    ("edges", "error"),
    [
        ([("a", "b")], TypeError),
        ([(0, 1.0)], TypeError),
        ([0, 1], TypeError),
        (None, TypeError),
        ("ab", TypeError),
        ([(0, 1, 2)], ValueError),
        ([(1, 1)], ValueError),
        ([(0, 3)], ValueError),
    ],
)
def test_edges(edges, error):
    with pytest.raises(error, match="edges"):
        Graph.from_edges("broken", 3, edges)


def test_tables_of_a_graph_follow_from_its_slots():
    with pytest.raises(TypeError, match="distances"):
        Graph(**PATH, distances=torch.zeros(3, 3))
    moved = dataclasses.replace(line(3), columns=[5.0, 6.0, 7.0])
    assert torch.equal(moved.distances, line(3).distances)
    pipe = Graph.from_edges("pipe", 3, [(0, 1), (1, 2)], columns=[0.0, 0.4, 0.8], rows=[1, 1, 1])
    assert pipe.columns.tolist() == pytest.approx([0, 0.4, 0.8])
    assert pipe.rows.tolist() == [1, 1, 1]


def test_huge_sizes_are_refused_at_once():
    model = make_problem("line3").model
    began = time.perf_counter()
    for call in (
        lambda: line(10**7),
        lambda: grid(10**4, 10**4),
        lambda: Graph.from_edges("huge", 10**9, []),
        lambda: RepairModel(line(2), damage_chain((0.1,)), (0.0, 1.0), 0.9, num_robots=10**12),
        lambda: RepairModel(line(2), damage_chain((0.1,)), (0.0, 1.0), 0.9, num_robots=17),
        lambda: RepairModel(line(2), damage_chain((0.1,) * 200), (0.0,) * 201, 0.9, num_robots=16),
        lambda: RandomState(model, max_age=10**12),
        lambda: damage_chain((0.1,) * 10_000),
    ):
        with pytest.raises(ValueError, match=r"must be|must hold|must leave"):
            call()
    assert time.perf_counter() - began < 2


def repair(**change):
    return RepairModel(**{"graph": line(2), "chain": damage_chain((0.1,)), "costs": (0.0, 1.0), "discount": 0.9, **change})


def tabular(**change):
    half = torch.full((1, 2, 2), 0.5)
    return TabularModel(**{"transition": half, "observation": half, "cost": torch.zeros(1, 2), "discount": 0.9, **change})


class NoNames(SinglePart):
    names = ()


class Unstaged(SinglePart):
    names = ("a", "b")


@pytest.mark.parametrize(
    ("change", "error"),
    [
        *[({"discount": value}, ValueError) for value in (0, 1, NAN, INF)],
        *[({"discount": value}, TypeError) for value in ("a", None, True)],
        *[({"dtype": value}, ValueError) for value in (torch.float16, torch.bool, torch.int64)],
        *[({"dtype": value}, TypeError) for value in (None, "float32")],
        *[({"device": value}, ValueError) for value in ("nonsense", "cuda:77")],
        ({"device": 3.5}, TypeError),
        ({"partition": len}, TypeError),
        ({"partition": NoNames()}, ValueError),
        ({"partition": Unstaged()}, ValueError),
    ],
)
@pytest.mark.parametrize("make", [repair, tabular])
def test_models(make, change, error):
    make()
    with pytest.raises(error, match=next(iter(change))):
        make(**change)


@pytest.mark.parametrize(
    ("make", "change", "error"),
    [
        (repair, {"graph": 3}, TypeError),
        (repair, {"chain": None}, TypeError),
        (repair, {"chain": [[1, 0], [0, NAN]]}, ValueError),
        (repair, {"costs": None}, TypeError),
        (repair, {"costs": (0.0, 1e39)}, ValueError),
        (repair, {"costs": HUGE}, ValueError),
        (repair, {"num_robots": 1.0}, TypeError),
        (repair, {"num_robots": -1}, ValueError),
        (repair, {"terminal_probability": NAN}, ValueError),
        (repair, {"partition": RepairPartition(line(2), torch.ones(3))}, ValueError),
        (repair, {"partition": RepairPartition(line(3), torch.ones(2))}, ValueError),
        (tabular, {"transition": None}, TypeError),
        (tabular, {"transition": torch.zeros(0, 2, 2)}, ValueError),
        (tabular, {"transition": torch.zeros(1, 0, 0)}, ValueError),
        (tabular, {"transition": torch.full((1, 2, 2), NAN)}, ValueError),
        (tabular, {"observation": torch.zeros(1, 2, 0)}, ValueError),
        (tabular, {"cost": HUGE.view(1, 2)}, ValueError),
    ],
)
def test_arguments_of_one_model(make, change, error):
    with pytest.raises(error, match=next(iter(change))):
        make(**change)


MODEL = make_problem("line3").model


@pytest.mark.parametrize(
    ("call", "error", "name"),
    [
        (lambda: damage_chain("ab"), TypeError, "degradation"),
        (lambda: damage_chain((NAN,)), ValueError, "degradation"),
        (lambda: CalibratedStart(tiger().model), TypeError, "model"),
        (lambda: CalibratedStart(MODEL, NAN), ValueError, "damaged_fraction"),
        (lambda: CalibratedStart(MODEL, observe_start=1), TypeError, "observe_start"),
        (lambda: UniformStart(MODEL, (5,)), ValueError, "robots"),
        (lambda: UniformStart(MODEL, (0.0,)), TypeError, "robots"),
        (lambda: UniformStart(MODEL, 0), TypeError, "robots"),
        (lambda: UniformStart(MODEL, (0, 0)), ValueError, "robots"),
        (lambda: RandomState(MODEL, 0.5), TypeError, "fractions"),
        (lambda: RandomState(MODEL, (0, NAN)), ValueError, "fractions"),
        (lambda: RandomState(MODEL, (0, 1, 1)), ValueError, "fractions"),
        (lambda: RandomState(MODEL, max_age=1.5), TypeError, "max_age"),
        (lambda: InPart(MODEL, 3, 0), TypeError, "proposal"),
        (lambda: InPart(MODEL, len, 0.0), TypeError, "part"),
        (lambda: InPart(tabular(), len, 0), ValueError, "part"),
        (lambda: InPart(MODEL, len, 0, 0), ValueError, "max_tries"),
        (lambda: Mixture([], []), ValueError, "generators"),
        (lambda: Mixture([3], [1.0]), TypeError, "generators"),
        (lambda: Mixture([len], [NAN]), ValueError, "weights"),
        (lambda: Mixture([len], [1e300]), ValueError, "weights"),
        (lambda: Mixture([len], [0.0]), ValueError, "weights"),
        (lambda: Mixture([len], ["a"]), TypeError, "weights"),
        (lambda: FixedBelief([0.5, 0.5]), TypeError, "belief"),
        (lambda: FixedBelief(torch.tensor([1, 0])), TypeError, "belief"),
        (lambda: FixedBelief(torch.tensor([])), ValueError, "belief"),
        (lambda: FixedBelief(torch.tensor([0.5, 0.6])), ValueError, "belief"),
        (lambda: FixedBelief(torch.tensor([-1.0, 2.0])), ValueError, "belief"),
        (lambda: FixedBelief(torch.tensor([NAN, 1.0])), ValueError, "belief"),
        (lambda: RepairPartition(line(2), HUGE), ValueError, "costs"),
        (lambda: RepairPartition(line(2), torch.tensor([0.0, NAN])), ValueError, "costs"),
        (lambda: symmetries(tiger().model), TypeError, "model"),
        (lambda: make_problem("line4"), ValueError, "name"),
        (lambda: make_problem(3), TypeError, "name"),
        (lambda: make_problem("line3", partitioned=1), TypeError, "partitioned"),
        (lambda: make_problem("line3", device="nonsense"), ValueError, "device"),
        (lambda: tiger(2.0).model, ValueError, "discount"),
        (lambda: dataclasses.replace(make_problem("line3"), training=()), ValueError, "training must hold 6"),
        (lambda: dataclasses.replace(make_problem("line3"), training=(3,) * 6), TypeError, "training"),
        (lambda: dataclasses.replace(make_problem("line3"), model=3), TypeError, "model"),
        (lambda: dataclasses.replace(make_problem("line3"), start=3), TypeError, "start"),
        (lambda: BeliefEnv(3, len), TypeError, "model"),
        (lambda: BeliefEnv(MODEL, 3), TypeError, "generator"),
        (lambda: BeliefEnv(MODEL, len, batch_size=3), TypeError, "batch_size"),
        (lambda: BeliefEnv(MODEL, len, batch_size=(-1,)), ValueError, "batch_size"),
        (lambda: BeliefEnv(MODEL, len, batch_size=(2, 0)), ValueError, r"batch_size\[1\] must be at least 1, got 0"),
    ],
)
def test_everything_else(call, error, name):
    with pytest.raises(error, match=name):
        call()


@pytest.mark.parametrize("keys", [3, None, [1, 2], torch.rand(3), torch.arange(3).int()])
def test_keys_of_generators(keys):
    start = CalibratedStart(MODEL)
    mixed = Mixture([start], [1.0]), InPart(MODEL, start, 0), FixedBelief(torch.ones(1))
    for generator in (start, UniformStart(MODEL), RandomState(MODEL), *mixed):
        with pytest.raises(TypeError, match="keys must be an int64 tensor"):
            generator(keys)


def test_models_stay_where_they_are():
    problem = make_problem("line3")
    for module in (problem.model, torch.nn.Sequential(problem.model), BeliefEnv(problem.model, problem.start)):
        for move in (
            lambda m: m.to("meta"),
            lambda m: m.to(torch.float64),
            lambda m: m.double(),
            lambda m: m.half(),
            lambda m: m.type(torch.float64),
        ):
            with pytest.raises(ValueError, match="build the model"):
                move(module)
        assert module.to("cpu") is module
        module.float()
    problem.model.share_memory()
    assert problem.model.chain.dtype == torch.float32


def estimate(u, z, model=MODEL, level=0):
    belief = torch.eye(5)[[0, 1, 4]].expand(2, 3, 5).clone()
    belief[:, 1] = torch.eye(5)[level]
    location = torch.ones(2, model.num_robots, dtype=torch.int64)
    y = TensorDict({"belief": belief, "location": location}, [2])
    return model.estimator(y, u, z)


@pytest.mark.parametrize(
    ("u", "z", "error", "message"),
    [
        ([2, 2], [9, 4], ValueError, r"observation must be in 0\.\.4"),
        ([2, 2], [-1, 4], ValueError, r"observation must be in 0\.\.4"),
        ([2, 2], [4, 1], ValueError, r"observation 1 at batch index \(1,\) is impossible"),
        ([2, 2], [4.0, 4.0], ValueError, "observation must be int64"),
        ([2, 2], [4], ValueError, "observation must be int64 of shape"),
        ([2, 9], [4, 4], ValueError, r"action 9 at batch index \(1,\) is illegal; legal there: \[1, 2\]"),
        ([0, 2], [0, 4], ValueError, r"action 0 at batch index \(0,\) is illegal"),
        ([2.0, 2.0], [4, 4], ValueError, "action must be int64"),
    ],
)
def test_what_cannot_be_seen_or_done_is_no_belief(u, z, error, message):
    assert estimate(torch.tensor([2, 2]), torch.tensor([4, 4]))["location"].tolist() == [[2], [2]]
    with pytest.raises(error, match=message):
        estimate(torch.tensor(u), torch.tensor(z))


@pytest.mark.parametrize("name", ["line3", "two_robots20", "tiger", "maintenance1", "rocksample7x8"])
@pytest.mark.parametrize(
    ("u", "error", "message"),
    [
        (0, TypeError, "action must be a Tensor, got 0"),
        ([0, 0], TypeError, "action must be a Tensor"),
        (None, TypeError, "action must be a Tensor"),
        (torch.tensor([0.0, 0.0]), ValueError, r"action must be int64 of shape \(2,\), got torch.float32"),
        (torch.tensor([0]), ValueError, r"action must be int64 of shape \(2,\), got torch.int64 of shape \(1,\)"),
    ],
)
def test_nothing_is_seen_after_what_is_no_control(name, u, error, message):
    problem = make_problem(name)
    model, y = problem.model, problem.start(torch.arange(2))
    assert model.observation_probs(y, torch.tensor([0, 0])).shape == (2, model.num_observations)
    with pytest.raises(error, match=message):
        model.observation_probs(y, u)


def test_what_robots_see_together_and_after_a_repair():
    with pytest.raises(ValueError, match="observation 4 at batch index"):
        estimate(torch.tensor([0, 0]), torch.tensor([0, 4]), level=1)
    two = RepairModel(line(3), MODEL.chain, MODEL.costs, 0.9, num_robots=2)
    right = two.join_controls(torch.tensor([[2, 2], [2, 2]]))
    assert estimate(right, torch.tensor([24, 24]), two)["belief"][:, 2, 4].tolist() == [1, 1]
    with pytest.raises(ValueError, match="impossible"):
        estimate(right, torch.tensor([24, 23]), two)
    never = tabular(observation=torch.tensor([[[1.0, 0.0], [1.0, 0.0]]]))
    y = TensorDict({"belief": torch.tensor([[0.5, 0.5]])}, [1])
    with pytest.raises(ValueError, match="observation 1 at batch index"):
        never.estimator(y, torch.tensor([0]), torch.tensor([1]))
    with pytest.raises(ValueError, match="observation 1 is impossible after this control"):
        never.estimator(y[0], torch.tensor(0), torch.tensor(1))


@pytest.mark.parametrize("model", [MODEL, tiger().model])
def test_beliefs_must_sum_to_one_and_may_be_rounded(model):
    y = model.drawn(CalibratedStart(MODEL) if model is MODEL else FixedBelief(torch.tensor([0.5, 0.5])), torch.arange(3))
    rounded = y.clone().set("belief", (y["belief"] * (1 + 4e-7)).clone())
    model.check_state(rounded)
    for factor in (0.0, 0.5, 0.999):
        with pytest.raises(ValueError, match="sum to 1"):
            model.check_state(y.clone().set("belief", y["belief"] * factor))
    for value in (NAN, INF, -0.1, 1.1):
        broken = y.clone()
        broken["belief"][..., 0] = value
        with pytest.raises(ValueError, match="bounds"):
            model.check_state(broken)
