from __future__ import annotations

import copy
import math

import pytest
import torch
from _oracles import COSTS, brute_force, random_states, small_model, varied_model
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_pomdp.envs.repair import Graph, RepairModel, RepairPartition, damage_chain, grid, line
from torchrl_pomdp.modules.repair import NeverRepairCost
from torchrl_pomdp.problems import make_problem, repair_problem

TRIANGLE = Graph.from_edges("triangle with a tail", 4, [(0, 1), (1, 2), (2, 0), (2, 3)])


@given(
    seed=st.integers(0, 10_000),
    case=st.sampled_from(
        [(line(3), 1, (0.0, 0.3)), (line(3), 2, (0.2, 0.3)), (TRIANGLE, 1, (0.0, 0.3)), (line(2), 3, (0.1, 0.4))]
    ),
)
@settings(max_examples=60, deadline=None)
def test_cost_observations_and_estimator_equal_brute_force_bayes(seed, case):
    _equals_brute_force(small_model(*case), seed)


def _equals_brute_force(model, seed):
    y = model.with_features(random_states(model, 1, seed))
    legal = y["action_mask"][0].nonzero().flatten()
    u = legal[seed % len(legal)].reshape(1)
    controls = model.split_controls(u)[0].tolist()
    cost, z_probs, posterior, after = brute_force(model, y["belief"][0], y["location"][0].tolist(), controls)
    assert model.expected_cost(y, u).item() == pytest.approx(cost)
    probs = model.observation_probs(y, u)[0]
    assert probs.sum().item() == pytest.approx(1.0)
    for z in range(model.num_observations):
        assert probs[z].item() == pytest.approx(z_probs.get(z, 0.0), abs=1e-12)
        if z_probs.get(z, 0.0) > 1e-9:
            nxt = model.estimator(y, u, torch.tensor([z]))
            # The exact posterior of a product prior is a product, so its marginals are the whole belief.
            torch.testing.assert_close(nxt["belief"][0], posterior[z], atol=1e-12, rtol=0)
            assert nxt["location"][0].tolist() == after


@given(
    seed=st.integers(0, 10_000),
    case=st.sampled_from([(line(3), 1), (line(3), 2), (TRIANGLE, 1), (line(2), 2), (line(2), 3), (grid(2, 2), 2)]),
    works=st.sampled_from([0.3, 0.8, 1.0]),
)
@settings(max_examples=80, deadline=None)
def test_locations_of_many_kinds_and_repairs_that_fail_equal_brute_force_bayes(seed, case, works):
    _equals_brute_force(varied_model(*case, seed=seed, repair_probability=works), seed)


def test_robots_at_one_location_make_one_attempt():
    """By hand: two robots repair together; it works with probability 0.6, whoever else tries."""
    model = small_model(line(2), 2, (0.0, 0.25), repair_probability=0.6)
    certain = torch.eye(3, dtype=torch.float64)
    y = TensorDict({"belief": certain[[1, 0]].unsqueeze(0), "location": torch.tensor([[0, 0]])}, [1])
    u = torch.tensor([0])
    probs = model.observation_probs(y, u)[0]
    assert {z: round(p, 12) for z, p in enumerate(probs.tolist()) if p > 0} == {0: 0.6, 4: 0.3, 8: 0.1}
    assert model.estimator(y, u, torch.tensor([4]))["belief"].tolist() == [[[0, 1, 0], [1, 0, 0]]]
    nobody = model.follow(y[0], u[0], None)["belief"][0]
    torch.testing.assert_close(nobody, torch.tensor([0.6, 0.3, 0.1], dtype=torch.float64))


@pytest.mark.parametrize("by_location", [False, True])
def test_what_the_caller_does_with_a_table_later_does_not_concern_the_model(by_location):
    costs, chain = torch.tensor([0.0, 1.0, 5.0]), damage_chain((0.1, 0.3)).float().requires_grad_()
    costs = costs.expand(3, 3).clone() if by_location else costs
    partition = RepairPartition(line(3), costs)
    model = RepairModel(line(3), chain, costs.requires_grad_(), 0.9, partition=partition)
    y = model.with_features(random_states(model, 20, 0))
    before = [model.costs.clone(), model.expected_cost(y).clone(), model.partition(y).clone(), NeverRepairCost(model)(y)]
    copy.deepcopy(model)
    with torch.no_grad():
        costs.fill_(9.0)
        chain.fill_(0.0)
    after = [model.costs, model.expected_cost(y), model.partition(y), NeverRepairCost(model)(y)]
    assert not model.costs.requires_grad
    for one, other in zip(before, after, strict=True):
        assert torch.equal(one["state_value"], other["state_value"]) if hasattr(one, "keys") else torch.equal(one, other)


@pytest.mark.parametrize("costs", [None, [1, 2, None], {0: 1}, "abc", [0, 1, "x"], [0, 1, 10**400]])
def test_costs_that_are_no_numbers_are_named(costs):
    with pytest.raises((TypeError, ValueError), match="costs"):
        repair_problem(line(3), damage_chain((0.0, 0.1)), costs, 0.9)


def test_equal_locations_are_one_kind():
    """Tables that say the same of every location make the same model, to the last bit."""
    one = small_model(line(3))
    chain, costs = one.chain.expand(3, -1, -1), one.costs.expand(3, -1)
    other = RepairModel(line(3), chain, costs, 0.9, dtype=torch.float64)
    assert other.chain.shape == (3, 3)
    assert other.costs.shape == (3,)
    y = random_states(one, 20, 0)
    assert torch.equal(one.expected_cost(y), other.expected_cost(y))


@pytest.mark.parametrize("num_robots", [1, 2])
def test_advance_draws_observations_with_their_probabilities(num_robots):
    model = small_model(line(3), num_robots, (0.2, 0.3))
    y = random_states(model, 1, 5)
    count = 40_000
    u = model.with_features(y)["action_mask"][0].nonzero()[-1].expand(count)
    many = y.expand(count).clone()
    noise = torch.rand(count, num_robots, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    cost, nxt = model.advance(many, u, noise)
    assert torch.equal(cost, model.expected_cost(many, u))
    probs = model.observation_probs(y, u[:1])[0]
    seen = nxt["belief"].gather(1, nxt["location"].unsqueeze(-1).expand(-1, -1, model.num_levels))
    assert ((seen == 0) | (seen == 1)).all(), "robots know the levels where they stand"
    levels = seen.argmax(-1)
    z = levels[:, 0] if num_robots == 1 else levels[:, 0] * model.num_levels + levels[:, 1]
    frequency = z.bincount(minlength=model.num_observations) / count
    assert (frequency - probs).abs().max() < 4 * 0.5 / math.sqrt(count)
    torch.testing.assert_close(nxt["belief"], model.estimator(many, u, z)["belief"])


def test_order_of_events_by_hand():
    model = small_model(line(3), degradation=(0.0, 0.25))
    certain = torch.eye(3, dtype=torch.float64)
    y = TensorDict({"belief": certain[[1, 1, 0]].unsqueeze(0), "location": torch.tensor([[0]])}, [1])
    # Repair: both damaged locations cost 1 in this stage, the repaired one does not degrade, the other does.
    cost, nxt = model.advance(y, torch.tensor([0]), torch.zeros(1, 1, dtype=torch.float64))
    assert cost.tolist() == [2.0]
    assert nxt["belief"].tolist() == [[[1, 0, 0], [0, 0.75, 0.25], [1, 0, 0]]]
    # Move right: the location left behind degrades unseen, the one reached is observed after it degraded.
    cost, nxt = model.advance(y, torch.tensor([2]), torch.full((1, 1), 0.9, dtype=torch.float64))
    assert nxt["belief"].tolist() == [[[0, 0.75, 0.25], [0, 0, 1], [1, 0, 0]]]
    assert nxt["location"].tolist() == [[1]]


def test_legal_controls():
    model = small_model(line(3))
    certain = torch.eye(3, dtype=torch.float64)
    belief = certain[[0, 1, 2]].expand(3, 3, 3)
    y = TensorDict({"belief": belief, "location": torch.tensor([[0], [1], [2]])}, [3])
    assert model.action_mask(y).tolist() == [[False, False, True], [True, True, True], [True, True, False]]
    single = small_model(line(1))
    intact = TensorDict({"belief": certain[:1].unsqueeze(0), "location": torch.tensor([[0]])}, [1])
    assert single.action_mask(intact)[0].tolist()[0], "waiting is legal where nothing else is"


def test_joint_controls_are_legal_robot_by_robot():
    model = small_model(line(3), num_robots=2)
    y = random_states(model, 50, 3)
    joint = model.action_mask(y)
    for robot in range(2):
        alone = small_model(line(3))
        single = TensorDict({"belief": y["belief"], "location": y["location"][:, robot : robot + 1]}, [50])
        mask = alone.action_mask(single)
        digits = model.split_controls(torch.arange(9))[:, robot]
        assert not (joint & ~mask[:, digits]).any()
    assert torch.equal(model.join_controls(model.split_controls(torch.arange(9))), torch.arange(9))


def test_terminal_means_no_damage_possible():
    model = small_model(line(2), terminal_probability=0.01)
    belief = torch.tensor([[[1.0, 0, 0], [0.995, 0.005, 0]], [[1.0, 0, 0], [0.98, 0.02, 0]]], dtype=torch.float64)
    y = TensorDict({"belief": belief, "location": torch.zeros(2, 1, dtype=torch.int64)}, [2])
    assert model.is_terminal(y).tolist() == [True, False]
    assert not small_model(line(2), degradation=(0.1, 0.1)).is_terminal(y).any(), "level 0 is not absorbing"


def test_beliefs_stay_normalised_and_equal_float64():
    steps, generator = 400, torch.Generator().manual_seed(0)
    single = make_problem("linear20").model
    double = RepairModel(line(20), damage_chain((0.0, 0.02, 0.03, 0.05)), COSTS, 0.99, dtype=torch.float64)
    y = random_states(double, 64, 1)
    x = y.clone().set("belief", y["belief"].float())
    totals = torch.zeros(2, 64, dtype=torch.float64)
    for step in range(steps):
        u = 1 + torch.randint(2, (64,), generator=generator)
        u = torch.where(y["location"][:, 0] == 0, 2, torch.where(y["location"][:, 0] == 19, 1, u))
        z = double.observation_probs(y, u).argmax(-1)
        for row, (model, state) in enumerate(((single, x), (double, y))):
            totals[row] += 0.99**step * model.expected_cost(state, u)
        x, y = single.estimator(x, u, z), double.estimator(y, u, z)
    assert (x["belief"].sum(-1) - 1).abs().max() < 1e-4
    torch.testing.assert_close(totals[0], totals[1], rtol=1e-4, atol=0)


def test_general_chains_are_supported():
    chain = torch.tensor([[0.9, 0.1, 0.0], [0.2, 0.5, 0.3], [0.1, 0.2, 0.7]], dtype=torch.float64)
    model = RepairModel(line(3), chain, (0.0, 1.0, 5.0), 0.9, dtype=torch.float64)
    y = random_states(model, 20, 2)
    u = torch.where(y["location"][:, 0] == 0, 2, 1)
    z = model.observation_probs(y, u).argmax(-1)
    nxt = model.estimator(y, u, z)
    far = (y["location"][:, 0] + 2) % 3
    rows = torch.arange(20)
    unseen = far != nxt["location"][:, 0]
    torch.testing.assert_close(nxt["belief"][rows, far][unseen], (y["belief"] @ chain)[rows, far][unseen])


SLOW = torch.tensor([[1 - 1e-6, 1e-6, 0], [2e-6, 0.499998, 0.5], [0, 1e-3, 1 - 1e-3]], dtype=torch.float64)
DENSE = torch.tensor([[0.9, 0.1, 0.0], [0.2, 0.5, 0.3], [0.1, 0.2, 0.7]], dtype=torch.float64)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "chain", [damage_chain((0.3,)), damage_chain((0.1, 0.2, 0.3, 0.4)), damage_chain((1e-7, 1e-5)), SLOW, DENSE, DENSE.float()]
)
def test_beliefs_of_unvisited_locations_never_leave_their_bounds(chain, dtype):
    """Rounding must neither lift a probability above one nor let the sums drift, however long nobody comes."""
    levels = chain.shape[0]
    model = RepairModel(line(40), chain, torch.ones(levels), 0.9, dtype=dtype)
    y = random_states(model, 1, 0).repeat(2)
    planes, highest, worst = model._planes(y), 0.0, 0.0
    for step in range(20_000):
        planes = model._degrade_planes(planes)
        if step % 50 == 0:
            highest = max(highest, float(planes.max()))
            worst = max(worst, float((planes.double().sum(1) - 1).abs().max()))
    assert highest <= 1
    assert worst < 1e-4
    nobody = y.clone().set("belief", planes.movedim(-1, 0).contiguous())
    model.check_state(nobody)


@pytest.mark.parametrize(
    ("graph", "robots", "states", "controls", "text"),
    [
        (line(20), 1, 20 * 5**20, 3, "1.9e+15"),
        (grid(6, 6), 1, 36 * 5**36, 5, "5.2e+26"),
        (line(20), 2, 400 * 5**20, 9, "3.8e+16"),
    ],
)
def test_sizes_of_the_papers_problems(graph, robots, states, controls, text):
    model = RepairModel(graph, damage_chain((0, 0.02, 0.03, 0.05)), COSTS, 0.99, num_robots=robots)
    assert (model.num_states, model.num_controls, model.num_observations) == (states, controls, 5**robots)
    assert text in model.describe()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"chain": torch.tensor([[0.9, 0.2], [0.0, 1.0]])}, "row 0 sums to 1.1"),
        ({"chain": torch.tensor([[1.1, -0.1], [0.0, 1.0]])}, "nonnegative"),
        ({"chain": torch.ones(2, 3)}, "square"),
        ({"costs": (0.0, -1.0)}, "costs must be finite and nonnegative"),
        ({"costs": (0.0, math.nan)}, "costs must be finite and nonnegative"),
        ({"costs": (0.0, 1.0, 2.0)}, "shape"),
        ({"discount": 1.0}, "discount must be in"),
        ({"discount": 0.0}, "discount must be in"),
        ({"num_robots": 0}, "num_robots"),
        ({"terminal_probability": 1.0}, "terminal_probability"),
    ],
)
def test_bad_arguments_are_named(change, message):
    arguments = {"graph": line(2), "chain": damage_chain((0.1,)), "costs": (0.0, 1.0), "discount": 0.9, **change}
    with pytest.raises(ValueError, match=message):
        RepairModel(**arguments)


def test_bad_degradation_is_refused():
    with pytest.raises(ValueError, match="degradation"):
        damage_chain((0.1, 1.5))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"belief": torch.zeros(4, 3, 2)}, ValueError, r"'belief' of y has shape \(4, 3, 2\), expected \(4, 3, 3\)"),
        ({"location": torch.zeros(4, dtype=torch.int64)}, ValueError, "'location' of y has shape"),
        ({"location": None}, ValueError, "lacks the entry 'location'"),
        ({"location": torch.zeros(4, 1)}, TypeError, "dtype"),
        ({"location": torch.full((4, 1), 3)}, ValueError, "bounds"),
        ({"belief": torch.full((4, 3, 3), 2.0, dtype=torch.float64)}, ValueError, "bounds"),
    ],
)
def test_states_that_do_not_fit_are_named(change, error, message):
    model = small_model()
    y = random_states(model, 4, 0)
    for key, value in change.items():
        y = y.exclude(key) if value is None else y.set(key, value)
    with pytest.raises(error, match=message):
        model.check_state(y)
