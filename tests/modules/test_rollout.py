from __future__ import annotations

import math

import pytest
import torch
from _oracles import COSTS, LINE3_OPTIMUM, LINE3_OPTIMUM_BY_START_LEVEL, Memo, line3_cost
from tensordict import TensorDict

from torchrl_pomdp.envs.repair import CalibratedStart, RepairModel, UniformStart, damage_chain, grid, line
from torchrl_pomdp.evaluation import compare, discounted_costs, estimate
from torchrl_pomdp.modules import AfterSteps, ConstantCost, OnEntering, RolloutPolicy, TruncatedRollout
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, UrgencyRepair
from torchrl_pomdp.noise import fold, seed_keys
from torchrl_pomdp.problems import tiger


def test_greedy_on_the_line_of_3_exactly_and_simulated(line3):
    greedy = GreedyRepair(line3.model)
    exact, by_level = line3_cost(line3.model, greedy)
    assert abs(exact - 194.9) < 3 * 0.4
    assert exact > LINE3_OPTIMUM[1]
    assert all(cost >= best - 0.01 for cost, best in zip(by_level, LINE3_OPTIMUM_BY_START_LEVEL, strict=True))
    simulated = estimate(discounted_costs(line3.model, greedy, line3.start, num_states=20_000))
    assert abs(simulated.mean - exact) < 3 * simulated.standard_error


def test_rollout_improves_on_the_line_of_3_towards_the_optimum(line3):
    model, greedy = line3.model, GreedyRepair(line3.model)
    once = Memo(model, RolloutPolicy(model, greedy, trajectories=100))
    cost, by_level = line3_cost(model, once)
    assert abs(cost - 187.0) < 2.0
    assert all(cost >= best - 0.01 for cost, best in zip(by_level, LINE3_OPTIMUM_BY_START_LEVEL, strict=True))
    twice = Memo(model, RolloutPolicy(model, once, trajectories=30, seed=1))
    improved, by_level = line3_cost(model, twice)
    assert LINE3_OPTIMUM[0] <= improved <= 1.03 * LINE3_OPTIMUM[1]
    assert all(cost >= best - 0.01 for cost, best in zip(by_level, LINE3_OPTIMUM_BY_START_LEVEL, strict=True))


@pytest.mark.parametrize(
    ("degradation", "discount", "expected", "error"),
    [((0.0, 0.1, 0.1, 0.1), 0.95, 194.09, 0.90)],
)
def test_greedy_with_uniform_drift(degradation, discount, expected, error):
    model = RepairModel(line(3), damage_chain(degradation), COSTS, discount)
    exact, _ = line3_cost(model, GreedyRepair(model))
    assert abs(exact - expected) < 3 * error


@pytest.mark.parametrize(
    ("graph", "robots", "expected", "error"),
    [
        (line(20), 1, 7193.0, 81.0),
        (grid(5, 4), 1, 5520.0, 63.0),
        (grid(6, 6), 1, 18469.0, 140.0),
        (line(20), 2, 4155.0, 62.0),
    ],
)
def test_greedy_on_the_papers_problems(graph, robots, expected, error):
    model = RepairModel(graph, damage_chain((0.0, 0.02, 0.03, 0.05)), COSTS, 0.99, num_robots=robots)
    cost = estimate(discounted_costs(model, GreedyRepair(model), CalibratedStart(model), num_states=4000))
    assert abs(cost.mean - expected) < 3 * math.hypot(error, cost.standard_error)


def test_rollout_improves_linear20_by_four_percent(linear20):
    model, greedy = linear20.model, GreedyRepair(linear20.model)
    baseline = discounted_costs(model, greedy, linear20.start, num_states=300)
    rollout = RolloutPolicy(model, greedy, trajectories=10)
    comparison = compare(discounted_costs(model, rollout, linear20.start, num_states=300), baseline)
    assert comparison.ratio.mean < 0.96
    assert comparison.difference.interval[1] < 0


def test_realised_costs_with_independent_noise_make_rollout_worse_than_greedy(linear20):
    """Why the stage cost is the expectation and the controls share their noise: without both, rollout is ruined."""
    model, greedy = linear20.model, GreedyRepair(linear20.model)
    policies = [_NaiveRollout(model, greedy, trajectories=4), RolloutPolicy(model, greedy, trajectories=4), greedy]
    options = {"num_states": 6, "max_steps": 30, "terminal_cost": NeverRepairCost(model)}
    naive, ours, baseline = (discounted_costs(model, policy, linear20.start, **options) for policy in policies)
    assert compare(naive, baseline).difference.interval[0] > 0
    assert ours.mean() < baseline.mean()


class _NaiveRollout:
    """One-step rollout as it is often written: hidden states drawn from the belief, realised costs, no common noise."""

    in_keys = ["belief", "location", "action_mask"]

    def __init__(self, model, base, trajectories):
        self.model, self.base, self.trajectories = model, base, trajectories
        self.generator = torch.Generator().manual_seed(0)

    def __call__(self, y):
        model, n = self.model, self.trajectories
        state, control = y["action_mask"].nonzero(as_tuple=True)
        rows = model.with_features(y)[state.repeat_interleave(n)]
        levels = torch.multinomial(rows["belief"].reshape(-1, 5), 1, generator=self.generator).view(-1, model.num_locations)
        cost, u, discount = torch.zeros(len(levels)), control.repeat_interleave(n), 1.0
        for _ in range(80):
            cost += discount * model.costs[levels].sum(-1)
            discount *= model.discount
            place, repair = rows["location"][:, 0], u == 0
            rise = torch.rand(levels.shape, generator=self.generator) < model.chain[levels, (levels + 1).clamp_max(4)]
            levels = levels + (rise & (levels < 4)).long()
            here = torch.arange(len(levels))
            levels[here[repair], place[repair]] = 0
            after = model.destinations[place, u]
            rows = model.estimator(rows, u, levels[here, after])
            done = model.is_terminal(rows)
            levels[done] = 0
            u = self.base(rows.copy())["action"]
        q = torch.full(y["action_mask"].shape, torch.inf)
        q[state, control] = cost.view(-1, n).mean(1)
        return y.set("action", q.argmin(-1))


def always(model, control):
    """Policy that always applies one control."""

    def policy(y):
        return y.set("action", torch.full(y.batch_size, control, dtype=torch.int64))

    return policy


def test_a_cut_rollout_adds_the_discounted_terminal_cost():
    model = tiger().model
    y = TensorDict({"belief": torch.tensor([[0.3, 0.7]])}, [1])
    rollout = TruncatedRollout(model, always(model, 0), max_steps=3, terminal_cost=lambda y: y["belief"].sum(-1) * 50)
    expected = 1 + 0.95 + 0.95**2 + 0.95**3 * 50
    assert rollout(y, torch.zeros(1, dtype=torch.int64)).item() == pytest.approx(expected)


def test_terminal_states_cost_nothing_not_even_the_terminal_cost(line3):
    y = line3.start(torch.arange(6))
    y["belief"][:] = torch.eye(5)[0]
    rollout = TruncatedRollout(
        line3.model, GreedyRepair(line3.model), max_steps=3, terminal_cost=lambda y: y["belief"].sum((-1, -2))
    )
    assert rollout(y, torch.arange(6)).tolist() == [0.0] * 6


def test_listening_forever_has_its_closed_form_cost():
    model = tiger().model
    y = TensorDict({"belief": torch.full((5, 2), 0.5)}, [5])
    cost = TruncatedRollout(model, always(model, 0), max_steps=400)(y, torch.arange(5))
    torch.testing.assert_close(cost, torch.full((5,), 1 / (1 - 0.95)), rtol=1e-5, atol=0)
    # By default what is left out is what the discount makes negligible.
    cost = TruncatedRollout(model, always(model, 0))(y, torch.arange(5))
    torch.testing.assert_close(cost, torch.full((5,), (1 - 0.95**135) / (1 - 0.95)), rtol=1e-5, atol=0)


@pytest.mark.parametrize("size", [1, 3, 7, 64, 333])
def test_costs_do_not_depend_on_the_batch(linear20, size):
    keys = seed_keys(0, torch.arange(400))
    y = linear20.start(fold(keys, 0))
    rollout = TruncatedRollout(linear20.model, GreedyRepair(linear20.model))
    together = rollout(y, keys)
    apart = torch.cat([rollout(y[i : i + size], keys[i : i + size]) for i in range(0, 400 if size > 5 else 20, size)])
    assert torch.equal(apart, together[: len(apart)])


def test_bad_numbers_are_refused(line3):
    with pytest.raises(ValueError, match="max_steps"):
        TruncatedRollout(line3.model, GreedyRepair(line3.model), max_steps=0)
    with pytest.raises(ValueError, match=r"max_steps=10 needs a terminal_cost, got None: the first stage cut weighs 0.9"):
        TruncatedRollout(line3.model, GreedyRepair(line3.model), max_steps=10)
    with pytest.raises(ValueError, match="damage_threshold"):
        GreedyRepair(line3.model, damage_threshold=1.0)
    with pytest.raises(ValueError, match="robots must be 1 locations"):
        UniformStart(line3.model, (0, 1))


FIXED = {
    "damage_threshold": lambda model: GreedyRepair(model),
    "exponent": lambda model: UrgencyRepair(model),
    "cost": lambda model: ConstantCost(model, 1.0),
    "m": lambda model: AfterSteps(3),
    "parts": lambda model: OnEntering((1,)),
    "max_steps": lambda model: TruncatedRollout(model, GreedyRepair(model)),
}


@pytest.mark.parametrize("name", FIXED)
def test_numbers_that_loops_and_tables_have_read_stay(line3, name):
    made = FIXED[name](line3.model)
    before = getattr(made, name)
    with pytest.raises(AttributeError):
        setattr(made, name, 0)
    assert getattr(made, name) == before


def test_what_a_policy_writes_is_its_own_affair():
    """A policy may store what it makes of the belief under the same name; the state goes on from what it was."""
    problem = tiger()

    def plain(y):
        belief = y["belief"]
        return y.set("action", torch.where(belief.amax(-1) > 0.9, 2 - belief.argmax(-1), 0))

    def rounds(y):
        return plain(y).set("belief", torch.nn.functional.one_hot(y["belief"].argmax(-1), 2).to(y["belief"].dtype))

    costs = [discounted_costs(problem.model, policy, problem.start, num_states=50) for policy in (plain, rounds)]
    assert torch.equal(*costs)
