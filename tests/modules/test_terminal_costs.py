"""Terminal costs against closed forms, long simulations and exact costs."""

from __future__ import annotations

import math

import pytest
import torch
from _oracles import exact_cost, random_states, small_model, varied_model
from tensordict import TensorDict

from torchrl_pomdp.envs.repair import RepairModel, damage_chain, line
from torchrl_pomdp.modules import AfterSteps, OnEntering, PolicyCost, RolloutPolicy, TruncatedRollout, ZeroCost
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, SteadyStateCost
from torchrl_pomdp.problems import tiger

CHAINS = [(0.0, 0.3, 0.1), (0.2, 0.3, 0.1), (0.0, 1.0, 0.0)]


def chain_model(degradation, discount=0.99, dtype=torch.float64):
    return RepairModel(line(3), damage_chain(degradation), (0.0, 1.0, 5.0, 25.0), discount, dtype=dtype)


@pytest.mark.parametrize("degradation", CHAINS)
def test_never_repairing_costs_what_3000_steps_of_degradation_cost(degradation):
    model = chain_model(degradation)
    y = random_states(model, 20, seed=0)
    belief, total = y["belief"], torch.zeros(20, dtype=torch.float64)
    for step in range(3000):
        total += 0.99**step * (belief @ model.costs).sum(-1)
        belief = belief @ model.chain
    cost = NeverRepairCost(model).costs(y)
    torch.testing.assert_close(cost, total, rtol=1e-10, atol=1e-9)
    single = NeverRepairCost(chain_model(degradation, dtype=torch.float32)).costs(y.clone().apply(lambda x: x.float()))
    torch.testing.assert_close(single.double(), cost, rtol=1e-4, atol=0)


def test_never_repairing_locations_of_their_own_by_hand():
    """One location stays as it is; the other is damaged, and then intact again, in turn."""
    chains = torch.tensor([[[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [1.0, 0.0]]])
    model = RepairModel(line(2), chains, torch.tensor([[1.0, 3.0], [2.0, 5.0]]), 0.5, dtype=torch.float64)
    # 1 or 3 at every stage; 2 + 5/2 + 2/4 + ... = (2 + 5/2) / (1 - 1/4), or 5 first.
    by_level = torch.tensor([[2.0, 6.0], [6.0, 8.0]], dtype=torch.float64)
    belief = torch.eye(2, dtype=torch.float64)[torch.cartesian_prod(torch.arange(2), torch.arange(2))]
    y = TensorDict({"belief": belief, "location": torch.zeros(4, 1, dtype=torch.int64)}, [4])
    expected = (belief * by_level).sum((-2, -1))
    torch.testing.assert_close(NeverRepairCost(model).costs(y), expected, rtol=1e-12, atol=0)
    assert SteadyStateCost(model).costs(y).tolist() == [6.0, 12.0, 10.0, 16.0]


@pytest.mark.parametrize("works", [0.4, 1.0])
def test_never_repairing_costs_the_sum_over_locations_of_their_own(works):
    model = varied_model(line(4), seed=3, repair_probability=works)
    y, total = random_states(model, 20, seed=0), torch.zeros(20, dtype=torch.float64)
    for place, (chain, costs) in enumerate(zip(model.chain, model.costs, strict=True)):
        belief = y["belief"][:, place]
        for step in range(400):
            total += 0.9**step * (belief @ costs)
            belief = belief @ chain
    torch.testing.assert_close(NeverRepairCost(model).costs(y), total, rtol=1e-10, atol=1e-9)
    steady = 10 * (y["belief"] * model.costs).sum((-2, -1))
    torch.testing.assert_close(SteadyStateCost(model).costs(y), steady, rtol=1e-12, atol=0)


def test_never_repairing_costs_more_than_greedy_and_than_the_present_cost_forever(linear20):
    y, keys, greedy = linear20.start(torch.arange(300)), torch.arange(300), GreedyRepair(linear20.model)
    never = NeverRepairCost(linear20.model).costs(y)
    assert bool((never > TruncatedRollout(linear20.model, greedy)(y, keys)).all())
    assert bool((never > SteadyStateCost(linear20.model).costs(y)).all())
    small = small_model()
    for row in random_states(small, 20, seed=1).split(1):
        assert exact_cost(small, GreedyRepair(small), row) <= float(NeverRepairCost(small).costs(row)) + 1e-9


def test_the_present_cost_forever_is_exact_where_nothing_changes():
    model = chain_model((0.0, 0.0, 0.0), discount=0.9)
    y = random_states(model, 15, seed=2)
    expected = 10 * (y["belief"] @ model.costs).sum(-1)
    torch.testing.assert_close(SteadyStateCost(model).costs(y), expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(NeverRepairCost(model).costs(y), expected, rtol=1e-12, atol=1e-12)


def test_zero_is_zero_for_any_model_and_the_cut_rollout_is_the_sum_of_its_stage_costs():
    y = TensorDict({"belief": torch.full((5, 2), 0.5)}, [5])
    listen = TruncatedRollout(
        tiger().model,
        lambda y: y.set("action", torch.zeros(y.batch_size, dtype=torch.int64)),
        truncation=AfterSteps(2),
        terminal_cost=ZeroCost(),
    )
    torch.testing.assert_close(listen(y, torch.arange(5)), torch.full((5,), 1.95))
    assert torch.equal(ZeroCost().costs(y), torch.zeros(5))


def functions(model):
    greedy = GreedyRepair(model)
    policy_cost = PolicyCost(model, greedy, trajectories=13, max_steps=40, terminal_cost=NeverRepairCost(model), chunk_rows=64)
    return {
        "zero": ZeroCost().costs,
        "steady": SteadyStateCost(model).costs,
        "never": NeverRepairCost(model).costs,
        "policy": policy_cost.costs,
    }


@pytest.mark.parametrize("name", ["zero", "steady", "never", "policy"])
def test_costs_depend_on_the_state_alone_to_the_last_bit(linear20, name):
    function = functions(linear20.model)[name]
    y = linear20.start(torch.arange(48))
    costs = function(y)
    assert costs.shape == (48,)
    assert costs.dtype == torch.float32
    assert torch.equal(torch.cat([function(row) for row in y.split(1)]), costs)
    assert torch.equal(torch.cat([function(rows) for rows in y.split(7)]), costs)
    assert torch.equal(function(y[torch.arange(47, -1, -1)]).flip(0), costs)
    assert torch.equal(function(y.reshape(2, 3, 8)), costs.view(2, 3, 8))
    # The same states with beliefs in another memory layout.
    planes = y.clone()
    planes["belief"] = y["belief"].permute(1, 2, 0).contiguous().permute(2, 0, 1)
    assert planes["belief"].stride() != y["belief"].contiguous().stride()
    assert torch.equal(function(planes), costs)
    assert torch.equal(function(y[0].contiguous()), costs[0])
    assert (len(set(costs.tolist())) > 1) == (name != "zero")


def test_a_policys_cost_is_its_exact_cost_on_average():
    model = small_model()
    greedy, y = GreedyRepair(model), random_states(model, 6, seed=3)
    exact = torch.tensor([exact_cost(model, greedy, row) for row in y.split(1)], dtype=torch.float64)
    one = torch.stack([PolicyCost(model, greedy, seed=seed).costs(y) for seed in range(200)])
    many = PolicyCost(model, greedy, trajectories=4000)(y.clone())["cost_to_go"]
    spread = one.std(0)
    assert bool((spread > 0.1).any())
    assert bool(((many - exact).abs() <= 4 * spread / math.sqrt(4000) + 1e-5).all())
    assert bool(((one.mean(0) - exact).abs() <= 4 * spread / math.sqrt(200) + 1e-5).all())


def test_trajectories_are_stratified():
    """Means of several trajectories are steadier than independent ones would be."""
    model = small_model()
    greedy, y = GreedyRepair(model), random_states(model, 40, seed=4)
    one, eight = (
        torch.stack([PolicyCost(model, greedy, trajectories=n, seed=seed).costs(y) for seed in range(60)]) for n in (1, 8)
    )
    assert float(eight.var(0).mean()) < 0.5 * float(one.var(0).mean()) / 8
    assert not torch.equal(eight[0], eight[1])
    assert torch.equal(PolicyCost(model, greedy, trajectories=8, seed=0, chunk_rows=4).costs(y), eight[0])


@pytest.mark.parametrize("use", ["labels", "terminal cost"])
def test_a_policys_cost_does_not_depend_on_threads(linear20, use):
    model, greedy, y = linear20.model, GreedyRepair(linear20.model), linear20.start(torch.arange(8))
    cost = PolicyCost(model, greedy, trajectories=2, max_steps=30, terminal_cost=ZeroCost())
    options = {"trajectories": 2, "truncation": OnEntering((3, 4, 5)) | AfterSteps(20), "terminal_cost": cost.costs}
    run = cost.costs if use == "labels" else RolloutPolicy(model, greedy, **options).q_factors
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = run(y)
        torch.set_num_threads(2)
        two = run(y)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert torch.equal(one, two)


def test_a_truncated_policy_cost_ends_with_its_terminal_cost(linear20):
    model, greedy, y = linear20.model, GreedyRepair(linear20.model), linear20.start(torch.arange(10))
    never = NeverRepairCost(model)
    at_once = PolicyCost(model, greedy, truncation=AfterSteps(0), terminal_cost=never).costs(y)
    torch.testing.assert_close(at_once, never.costs(y), rtol=1e-6, atol=0)
    later = PolicyCost(model, greedy, trajectories=100, max_steps=40, terminal_cost=never).costs(y)
    assert bool((later < at_once).all())


def test_labels_are_added_to_the_states_and_can_be_trained_on(linear20):
    y = linear20.start(torch.arange(4)).reshape(2, 2)
    labelled = PolicyCost(linear20.model, GreedyRepair(linear20.model))(y)
    assert labelled is y
    weight = torch.ones(2, requires_grad=True)
    (labelled["cost_to_go"] @ weight).sum().backward()
    assert weight.grad is not None
    assert PolicyCost(linear20.model, GreedyRepair(linear20.model)).costs(linear20.start(torch.arange(0))).shape == (0,)


def test_bad_arguments_are_refused(linear20):
    model, greedy, y = linear20.model, GreedyRepair(linear20.model), linear20.start(torch.arange(4))
    with pytest.raises(ValueError, match="trajectories must be at least 1, got 0"):
        PolicyCost(model, greedy, trajectories=0)
    with pytest.raises(ValueError, match="truncation needs a terminal_cost"):
        PolicyCost(model, greedy, truncation=AfterSteps(3))
    with pytest.raises(ValueError, match="y lacks the entry 'location'"):
        PolicyCost(model, greedy).costs(y.select("belief"))
    with pytest.raises(ValueError, match="must return costs or write 'state_value'"):
        TruncatedRollout(model, greedy, max_steps=1, terminal_cost=PolicyCost(model, greedy))(y, torch.arange(4))
