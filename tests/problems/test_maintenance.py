from __future__ import annotations

import math
from itertools import product

import pytest
import torch
from tensordict import TensorDict

from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.envs.digits import joined
from torchrl_pomdp.evaluation import discounted_costs, estimate
from torchrl_pomdp.modules import MultiagentRollout, RolloutPolicy, ZeroCost
from torchrl_pomdp.problems.check import check_belief_model
from torchrl_pomdp.problems.maintenance import PeriodicInspection, RandomWear, ReplaceFailed, WearEncoder, maintenance
from torchrl_pomdp.problems.maintenance_model import INSPECT, REPLACE, Component, MaintenanceModel

# Mean discounted costs with their standard errors, as published: replace failed components only.
PUBLISHED = {1: (1503.9, 4.3), 2: (1502.8, 4.4), 3: (1658.0, 7.2), 4: (4040.2, 22.2), 5: (23825.0, 50.0)}
CHAINS = [[[0.7, 0.2, 0.1], [0.0, 0.6, 0.4], [0.0, 0.0, 1.0]], [[0.5, 0.5, 0.0], [0.1, 0.8, 0.1], [0.0, 0.3, 0.7]]]
PARTS = [Component(7.0, 0.8, 2.0, 0.9, CHAINS[0]), Component(5.0, 1.0, 1.0, 0.6, CHAINS[1])]


def small(needed=1, dtype=torch.float64):
    return MaintenanceModel(PARTS, needed, penalty=100.0, stages=6, discount=0.9, dtype=dtype)


def random_states(model, count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    weight = torch.rand(count, model.num_components, model.num_levels, generator=generator, dtype=torch.float64)
    belief = weight * (torch.rand(weight.shape, generator=generator) < 0.7) + 1e-3 * weight
    belief = (belief / belief.sum(-1, keepdim=True)).to(model.dtype)
    return TensorDict({"belief": belief, "time": torch.arange(count) % model.num_stages}, [count])


def spelled_out(part, control, levels=3):
    """P(next level, level shown | level) of a component, from the words of the problem."""
    joint = torch.zeros(levels, levels, levels, dtype=torch.float64)
    for level, after in product(range(levels), repeat=2):
        chance = part.chain[level][after]
        if control == REPLACE:
            chance = part.success * part.chain[0][after] + (1 - part.success) * part.chain[level][after]
        if after == levels - 1:
            joint[level, after, after] = chance
        elif control == INSPECT:
            joint[level, after, after] = chance * part.accuracy
            joint[level, after, 1 - after] = chance * (1 - part.accuracy)
        else:
            joint[level, after, 0] = chance
    return joint


@pytest.mark.parametrize("controls", list(product(range(3), repeat=2)))
def test_equals_bayes_on_the_joint_chain(controls):
    model, y = small(), random_states(small(), 1)
    u = joined(torch.tensor([controls]), 3)
    joint = [spelled_out(part, control) for part, control in zip(PARTS, controls, strict=True)]
    both = torch.einsum("iax,jby->ijabxy", *joint)
    before = torch.einsum("i,j->ij", *y["belief"][0])
    after = torch.einsum("ij,ijabxy->abxy", before, both)
    assert model.observation_probs(y, u)[0].tolist() == pytest.approx(after.sum((0, 1)).flatten().tolist())
    for x, z in product(range(3), repeat=2):
        total = after[..., x, z].sum()
        observation = torch.tensor([3 * x + z])
        if total == 0:
            with pytest.raises(ValueError, match="impossible after this control"):
                model.estimator(y, u, observation)
            continue
        belief = model.estimator(y, u, observation)["belief"][0]
        posterior = after[..., x, z] / total
        torch.testing.assert_close(belief, torch.stack([posterior.sum(1), posterior.sum(0)]))


@pytest.mark.parametrize("k", range(1, 6))
def test_stage_cost_is_the_expectation_over_which_components_work(k):
    model = maintenance(k).model
    y, u = random_states(model, 20), torch.arange(20) * 12
    failed = y["belief"][..., -1].double()
    expected = torch.zeros(20, dtype=torch.float64)
    for pattern in product((0, 1), repeat=5):
        chance = torch.where(torch.tensor(pattern) == 1, 1 - failed, failed).prod(-1)
        expected += chance * (2400.0 if sum(pattern) < k else 0.0)
    prices = [(0, 30, 20), (0, 90, 40), (0, 80, 25), (0, 250, 50), (0, 350, 100)]
    for row, control in enumerate(model.controls[:, u].T.tolist()):
        expected[row] += sum(price[each] for price, each in zip(prices, control, strict=True))
    torch.testing.assert_close(model.expected_cost(y, u).double(), expected, rtol=1e-5, atol=1e-3)
    assert model.max_cost == 3200.0 >= float(expected.max())


def test_what_an_inspection_shows():
    shown = Component(1.0, 1.0, 1.0, 0.8, torch.eye(4)).inspection(4)
    rows = [[0.8, 0.2, 0, 0], [0.1, 0.8, 0.1, 0], [0, 0.2, 0.8, 0], [0, 0, 0, 1]]
    torch.testing.assert_close(shown, torch.tensor(rows, dtype=torch.float64))


def test_a_failure_is_always_seen_and_nothing_else_without_inspection():
    model = maintenance(5).model
    y = TensorDict({"belief": torch.tensor([0.1, 0.3, 0.5, 0.1]).expand(1, 5, 4).clone(), "time": torch.tensor([7])}, [1])
    probs = model.observation_probs(y, torch.tensor([0]))[0].view(4, 4, 4, 4, 4)
    assert probs[[1, 2]].sum() == 0.0
    assert probs[0].sum() > 0.0
    assert probs[3].sum() > 0.0
    nxt = model.estimator(y, torch.tensor([0]), torch.tensor([3 * 256]))
    assert nxt["belief"][0, 0].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert nxt["belief"][0, 1:, 3].tolist() == [0.0] * 4
    assert nxt["time"].tolist() == [8]


@pytest.mark.parametrize("k", range(1, 6))
def test_published_cost_of_replacing_what_has_failed(k):
    problem = maintenance(k)
    costs = estimate(discounted_costs(problem.model, ReplaceFailed(problem.model), problem.start, num_states=10_000, seed=1))
    mean, error = PUBLISHED[k]
    assert abs(costs.mean - mean) < 3.5 * (costs.standard_error**2 + error**2) ** 0.5


def test_inspections_pay_when_all_components_are_needed():
    problem = maintenance(5)
    assert problem.baseline == "condition"
    costs = estimate(discounted_costs(problem.model, problem.base_policies["condition"], problem.start, num_states=4000))
    # A simulation of hidden states, with the level seen last instead of a belief, gave 14967 ± 30.
    assert abs(costs.mean - 14967) < 4 * (costs.standard_error**2 + 30**2) ** 0.5
    problem = maintenance(4)
    assert problem.baseline == "failed"
    means = [
        discounted_costs(problem.model, policy, problem.start, num_states=4000).mean()
        for policy in problem.base_policies.values()
    ]
    assert means[0] < means[1]


def test_periodic_inspection_by_hand():
    model = maintenance(5).model
    belief = torch.tensor([[1.0, 0, 0, 0], [0.4, 0.3, 0.3, 0], [0.6, 0.2, 0.2, 0], [0, 0.5, 0.5, 0], [0, 0, 0, 1.0]])
    y = TensorDict({"belief": belief.expand(5, 5, 4).clone(), "time": torch.tensor([0, 4, 5, 6, 49])}, [5])
    names = [model.control_names[u] for u in PeriodicInspection(model, 5, 1)(y)["action"].tolist()]
    assert names == ["replace 5", "replace 5, inspect 1 2 3 4", "replace 2 4 5", "replace 5", "replace 5"]


def test_steps_do_not_depend_on_the_batch():
    model = maintenance(3).model
    generator = torch.Generator().manual_seed(3)
    y, u = random_states(model, 1003), torch.randint(0, 243, (1003,), generator=generator)
    noise = torch.rand(1003, 5, generator=generator)
    cost, nxt = model.advance(y, u, noise)
    for rows in (slice(0, 1), slice(5, 18), slice(500, 1003)):
        part_cost, part = model.advance(y[rows], u[rows], noise[rows])
        assert torch.equal(part_cost, cost[rows])
        assert torch.equal(part["belief"], nxt["belief"][rows])
    shaped = model.advance(y[:1000].view(10, 2, 50), u[:1000].view(10, 2, 50), noise[:1000].view(10, 2, 50, 5))
    assert torch.equal(shaped[1]["belief"].reshape(1000, 5, 4), nxt["belief"][:1000])
    single = model.advance(y[7], u[7], noise[7])
    assert torch.equal(single[0], cost[7])
    assert torch.equal(single[1]["belief"], nxt["belief"][7])
    assert model.advance(y[:0], u[:0], noise[:0])[0].shape == (0,)


def test_keeps_what_a_belief_model_promises():
    model = small(dtype=torch.float32)
    check_belief_model(model, RandomWear(model))


def test_ends_after_fifty_stages_at_no_further_cost():
    problem = maintenance(2)
    y = problem.start(torch.arange(3)).set("time", torch.tensor([49, 50, 12]))
    assert problem.model.is_terminal(y).tolist() == [False, True, False]
    cost, nxt = problem.model.advance(y, torch.full((3,), 81), torch.full((3, 5), 0.5))
    assert cost.tolist() == [30.0, 0.0, 30.0]
    assert nxt["time"].tolist() == [50, 50, 13]


def test_random_states_fit_the_model_and_belong_to_their_keys():
    problem = maintenance(4)
    keys = torch.arange(400)
    y = problem.model.drawn(problem.training[0], keys)
    assert torch.equal(y["belief"][100:103], problem.training[0](keys[100:103])["belief"])
    failed = y["belief"][..., -1]
    assert ((failed == 0) | (failed == 1)).all()
    assert 0.15 < float(failed.mean()) < 0.25
    assert (problem.pessimistic_cost.costs(y) > 0).all()


def test_encoding_by_hand():
    model = small()
    belief = torch.tensor([[0.25, 0.75, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    y = TensorDict({"belief": belief.expand(2, 2, 3), "time": torch.tensor([0, 6])}, [2])
    encoder = WearEncoder(model)
    ends = [[1.0, math.exp(-6 / 3), math.exp(-6 / 10)], [0.0, 1.0, 1.0]]
    expected = [[0.25, 0.75, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, *end] for end in ends]
    assert torch.allclose(encoder(y), torch.tensor(expected, dtype=torch.float64))
    assert torch.equal(encoder.encode_rows(y, torch.tensor([1, 0])), encoder(y).flip(0))
    assert encoder(y[0]).shape == (encoder.num_features,)


def test_environment_keeps_its_specs():
    from torchrl.envs.utils import check_env_specs

    problem = maintenance(1)
    check_env_specs(BeliefEnv(problem.model, problem.start, batch_size=(2,)))


def test_names_of_controls():
    names = maintenance(1).model.control_names
    assert len(set(names)) == 243
    assert names[0] == "nothing"
    assert names[81 + 2] == "replace 1, inspect 5"


def test_wrong_numbers_are_named():
    with pytest.raises(ValueError, match="k must be at most 5, got 6"):
        maintenance(6)
    with pytest.raises(ValueError, match=r"success must be in \[0, 1\], got 2"):
        Component(1.0, 2, 1.0, 0.5, [[1.0]])
    with pytest.raises(ValueError, match=r"chain of component 2 must have shape \(K, K\)"):
        MaintenanceModel([PARTS[0], Component(1.0, 1.0, 1.0, 0.5, torch.eye(2))], 1, penalty=1.0)
    with pytest.raises(ValueError, match="chain of component 1 must hold probabilities"):
        MaintenanceModel([Component(1.0, 1.0, 1.0, 0.5, [[0.5, 0.6], [0.0, 1.0]])], 1, penalty=1.0)
    with pytest.raises(ValueError, match="needed must be at most 2, got 3"):
        small(3)
    with pytest.raises(ValueError, match="period must be at least 1"):
        PeriodicInspection(maintenance(1).model, 0, 1)
    with pytest.raises(ValueError, match=r"failed must be in \[0, 1\]"):
        RandomWear(maintenance(1).model, failed=1.5)
    with pytest.raises(ValueError, match=r"failed and new must add up to at most 1, got 0.8 and 0.8"):
        RandomWear(maintenance(1).model, failed=0.8, new=0.8)
    bulb = Component(3.0, 1.0, 0.0, 1.0, [[0.9, 0.1], [0.0, 1.0]])
    with pytest.raises(ValueError, match=r"components must have at most 1048576 joint controls.* got 3\^22 controls and 2\^22"):
        MaintenanceModel([bulb] * 22, 1, penalty=1.0)


def test_what_is_written_into_a_chain_later_changes_nothing():
    chain = torch.tensor([[0.9, 0.1], [0.0, 1.0]], requires_grad=True)
    part = Component(3.0, 1.0, 0.0, 1.0, chain)
    with torch.no_grad():
        chain.fill_(0.5)
    assert torch.equal(part.chain, torch.tensor([[0.9, 0.1], [0.0, 1.0]]))
    model = MaintenanceModel([part], 1, penalty=1.0)
    assert model.chain.tolist() == [[pytest.approx([0.9, 0.1]), [0.0, 1.0]]]
    assert not model.chain.requires_grad


def test_agents_controls_are_those_of_one_agent():
    """What is for many agents works for the one there is."""
    problem = maintenance(3)
    model, y = problem.model, problem.start(torch.arange(2))
    every = torch.arange(model.num_controls)
    assert torch.equal(model.join_controls(model.split_controls(every)), every)
    base, options = problem.base_policies["failed"], {"trajectories": 1, "max_steps": 30, "terminal_cost": ZeroCost()}
    in_turn, at_once = (kind(model, base, **options)(y.copy()) for kind in (MultiagentRollout, RolloutPolicy))
    assert torch.equal(in_turn["action"], at_once["action"])


def test_costs_that_are_too_large_for_the_type_are_refused():
    bulb = Component(3.0, 1.0, 0.0, 1.0, [[0.9, 0.1], [0.0, 1.0]])
    with pytest.raises(
        ValueError, match=r"penalty and costs of the components, in all, must be finite in torch.float32, got 1e\+39"
    ):
        MaintenanceModel([bulb, bulb], 1, penalty=1e39, stages=10)
    assert MaintenanceModel([bulb, bulb], 1, penalty=1e39, stages=10, dtype=torch.float64).penalty == 1e39
