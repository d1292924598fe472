"""Repair problems as tabular models: the same controls, costs, observations and beliefs, whatever is done."""

from __future__ import annotations

import pytest
import torch
from _oracles import brute_force, random_states, small_model, varied_model
from tensordict import TensorDict

from benchmarks.setting import by_tensors
from torchrl_pomdp.envs.repair import Graph, RepairModel, UniformStart, damage_chain, grid, line
from torchrl_pomdp.envs.repair.tabular import joint_belief, tabular_model
from torchrl_pomdp.modules import TruncatedRollout
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.problems import make_problem

GRAPHS = {
    "line of 3": {},
    "two levels": {"graph": line(2), "degradation": (0.2,), "costs": (0.0, 1.0)},
    "repaired fail again": {"graph": line(3), "degradation": (0.1, 0.3)},
    "grid": {"graph": grid(2, 2), "degradation": (0.0,), "costs": (0.0, 1.0)},
    "two robots": {"graph": line(3), "num_robots": 2},
    "nowhere to go": {"graph": line(1)},
    "two robots, nowhere to go": {"graph": line(1), "num_robots": 2},
    "three robots": {"graph": line(2), "num_robots": 3, "degradation": (0.1,), "costs": (0.0, 1.0)},
    "repairs that fail": {"graph": line(3), "repair_probability": 0.75},
}

# Locations with chains and costs of their own.
VARIED = {
    "own chains and costs": {"graph": line(3), "repair_probability": 1.0},
    "own chains and costs, repairs that fail": {"graph": line(3)},
    "own chains and costs, two robots": {"graph": line(2), "num_robots": 2},
    "own chains and costs, grid": {"graph": grid(2, 2), "seed": 1},
}


@pytest.fixture(params=[*GRAPHS, *VARIED])
def model(request):
    name = request.param
    return small_model(**GRAPHS[name]) if name in GRAPHS else varied_model(**VARIED[name])


def looked(model, y):
    """The robots have looked where they stand."""
    return model.observe(y, torch.rand(len(y), model.num_robots, generator=torch.Generator().manual_seed(1)))


def as_table(model, y, **options):
    return TensorDict({"belief": joint_belief(model, y, **options)}, y.batch_size)


def pairs(mask):
    return mask.nonzero(as_tuple=True)


def assert_same_law(model, table, y, **options):
    """Every legal control costs the same, shows the same and leads to the same beliefs."""
    there = as_table(model, y, **options)
    assert torch.equal(table.action_mask(there), model.action_mask(y))
    row, u = pairs(model.action_mask(y))
    torch.testing.assert_close(table.expected_cost(there[row], u), model.expected_cost(y[row], u))
    probs = model.observation_probs(y[row], u)
    torch.testing.assert_close(table.observation_probs(there[row], u), probs)
    pair, z = pairs(probs > 0)
    after = model.estimator(y[row[pair]], u[pair], z)
    found = table.estimator(there[row[pair]], u[pair], z)["belief"]
    torch.testing.assert_close(found, as_table(model, after, **options)["belief"])
    return after


def test_the_same_law_at_random_states_and_after_them(model):
    table = tabular_model(model)
    after = assert_same_law(model, table, looked(model, random_states(model, 12, seed=3)))
    some = torch.randperm(len(after), generator=torch.Generator().manual_seed(2))[:12]
    assert_same_law(model, table, after[some])


def test_the_same_law_before_the_robots_have_looked(model):
    y = random_states(model, 12, seed=4)
    intact = y["belief"][..., 0].gather(-1, y["location"])
    assert bool(((intact > 0) & (intact < 1)).any())
    table = tabular_model(model, start_observed=False)
    after = assert_same_law(model, table, y, start_observed=False)
    assert_same_law(model, table, after[:12], start_observed=False)


@pytest.mark.parametrize("make", [small_model, varied_model])
def test_the_same_law_by_counting_all_joint_states(make):
    """The oracle of the repair model's own tests, which is written from the problem's statement."""
    model = make(line(3), num_robots=2)
    table, y = tabular_model(model), looked(model, random_states(model, 4, seed=5))
    there = as_table(model, y)
    for row, u in zip(*pairs(model.action_mask(y)), strict=True):
        controls = model.split_controls(u).tolist()
        cost, probs, posterior, after = brute_force(model, y["belief"][row], y["location"][row].tolist(), controls)
        state, control = there[row : row + 1], u.unsqueeze(0)
        assert float(table.expected_cost(state, control)) == pytest.approx(cost)
        found = table.observation_probs(state, control)[0]
        for z in range(table.num_observations):
            assert float(found[z]) == pytest.approx(probs.get(z, 0.0), abs=1e-12)
        for z, marginals in posterior.items():
            belief = table.estimator(state, control, torch.tensor([z]))["belief"][0].view(3, 3, 3, 3, 3)
            joint = belief[tuple(after)]
            assert float(joint.sum()) == pytest.approx(1.0)
            for place in range(3):
                others = [axis for axis in range(3) if axis != place]
                torch.testing.assert_close(joint.sum(others), marginals[place])


def test_states_are_numbered_by_places_then_levels():
    model = small_model(line(2), num_robots=2, degradation=(0.5,), costs=(0.0, 1.0))
    belief = torch.tensor([[[0.0, 1.0], [1.0, 0.0]]], dtype=torch.float64)
    y = TensorDict({"belief": belief, "location": torch.tensor([[1, 0]])}, [1])
    # Places 1, 0 are block 2 of 4; levels 1, 0 are number 2 of 4.
    assert joint_belief(model, y)[0].nonzero().tolist() == [[10]]
    assert tabular_model(model).num_states == 16


def test_tables_by_hand():
    """Two locations, two levels: from location 0, damaged, the other one intact."""
    model = small_model(line(2), degradation=(0.25,), costs=(0.0, 3.0))
    table, state = tabular_model(model), 2
    assert table.legal[state].tolist() == [True, False, True]
    assert table.legal[0].tolist() == [False, False, True]
    assert table.cost[:, state].tolist() == [3.0, 3.0, 3.0]
    transition, observation = table.transition.to_dense(), table.observation.to_dense()
    # Repair stays in block 0 with level 0; the right move goes to block 1, both locations take a step of the chain.
    assert transition[0, state].tolist() == [0.75, 0.25, 0, 0, 0, 0, 0, 0]
    assert transition[2, state].tolist() == [0, 0, 0, 0, 0, 0, 0.75, 0.25]
    assert observation[0].argmax(-1).tolist() == [0, 0, 1, 1, 0, 1, 0, 1]


def test_a_location_that_may_be_intact_may_be_repaired_only_if_the_robot_has_not_looked():
    model = small_model(line(2), degradation=(0.0,), costs=(0.0, 1.0))
    y = UniformStart(model, observe_start=False)(torch.arange(1))
    assert model.action_mask(y).tolist() == [[True, False, True]]
    table = tabular_model(model, start_observed=False)
    assert table.num_states == 2 * tabular_model(model).num_states
    assert table.action_mask(as_table(model, y, start_observed=False)).tolist() == [[True, False, True]]
    with pytest.raises(ValueError, match=r"y must have robots that know .* start_observed be False; got P\(level 0\) = 0.5"):
        joint_belief(model, y)


def test_own_graphs_and_types():
    graph = Graph.from_edges("star", 4, [(0, 1), (0, 2), (0, 3)])
    for dtype in (torch.float32, torch.float64):
        model = small_model(graph, degradation=(0.5,), costs=(0.0, 1.0), dtype=dtype)
        table = tabular_model(model)
        assert table.dtype == dtype
        assert_same_law(model, table, looked(model, random_states(model, 8, seed=6)))


def test_a_location_that_never_changes():
    model = small_model(line(3), degradation=(0.0, 0.0))
    assert torch.equal(model.chain, damage_chain((0.0, 0.0)).double())
    assert_same_law(model, tabular_model(model), looked(model, random_states(model, 8, seed=7)))


def test_problems_that_are_too_large_are_refused():
    model = make_problem("linear20").model
    for call in (lambda: tabular_model(model), lambda: joint_belief(model, make_problem("linear20").start(torch.arange(1)))):
        with pytest.raises(ValueError, match=r"model must have at most 131072 joint states .*, got 1907348632812500 with"):
            call()


def test_what_is_legal_without_restrictions_is_so_in_the_table():
    model = make_problem("line3").model.unrestricted()
    belief = torch.eye(5)[torch.tensor([0, 3, 1])].expand(1, 3, 5)
    y = TensorDict({"belief": belief, "location": torch.zeros(1, 1, dtype=torch.int64)}, [1])
    table = tabular_model(model)
    mask = table.action_mask(TensorDict({"belief": joint_belief(model, y)}, [1]))
    assert mask.tolist() == model.action_mask(y).tolist() == [[True, False, True]]


def test_intact_locations_that_cost_something_are_paid_for_ever():
    """One law for beliefs, hidden states and tables: nothing is terminal where level 0 costs something."""
    model = RepairModel(line(2), damage_chain((0.0,)), (1.0, 5.0), 0.9, dtype=torch.float64)
    intact = torch.tensor([[[1.0, 0.0], [1.0, 0.0]], [[0.5, 0.5], [0.5, 0.5]]], dtype=torch.float64)
    y = model.with_features(TensorDict({"belief": intact, "location": torch.tensor([[0], [0]])}, [2]))
    table, u = tabular_model(model, start_observed=False), torch.tensor([1, 0])
    joint = table.with_features(TensorDict({"belief": joint_belief(model, y, start_observed=False)}, [2]))
    assert not model.ends
    assert not model.is_terminal(y).any()
    assert not table.is_terminal(joint).any()
    assert model.expected_cost(y, u).tolist() == pytest.approx([2.0, 6.0])
    assert table.expected_cost(joint, u).tolist() == pytest.approx([2.0, 6.0])
    world = model.world()
    hidden = TensorDict({"level": torch.zeros(1, 2, dtype=torch.int64), "location": torch.tensor([[0]])}, [1])
    assert not world.is_terminal(hidden).any()
    assert float(world.step(hidden, torch.tensor([2]), torch.arange(1))[0]) == pytest.approx(2.0)
    # For ever 2 a stage: both engines, cut after 300 stages.
    rollout = TruncatedRollout(model, GreedyRepair(model), max_steps=300)
    for each in (rollout, by_tensors(rollout)):
        assert float(each(y[:1], torch.arange(1))) == pytest.approx(20.0, rel=1e-9)
