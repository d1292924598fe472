"""Point-based bounds against known optima, hand-made problems, and the enumeration of all policies of a small one."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise, product
from math import inf
from pathlib import Path

import numpy as np
import pytest
import torch
from _oracles import COSTS, line3_cost
from tensordict import TensorDict

from torchrl_pomdp.envs import FixedBelief, TabularModel, read_pomdp
from torchrl_pomdp.envs.repair import RepairModel, UniformStart, damage_chain, line
from torchrl_pomdp.envs.repair.tabular import joint_belief, tabular_model
from torchrl_pomdp.evaluation import discounted_costs, estimate
from torchrl_pomdp.planners import AlphaVectorPolicy, Interval, belief_mdp, solve
from torchrl_pomdp.planners.joint_table import JointTable
from torchrl_pomdp.planners.point_based import Search
from torchrl_pomdp.problems import crying_baby, tiger
from torchrl_pomdp.problems.random_tabular import random_model

DATA = Path(__file__).parents[1] / "data"

# Published values, as costs, with half a unit of their last digit.
FILES = [("tiger", 0.95, -19.371368, 5e-7), ("tiger", 0.75, -1.933439, 5e-7), ("cheese", 0.95, -3.486207, 5e-7)]
# Small repair problems: line of L, degradation, discount, and the optimum's bounds by an independent solver.
REPAIR = {
    "line of 3": (3, (0, 0.02, 0.03, 0.05), 0.99, (168.962, 168.971)),
    "discount 0.95": (3, (0, 0.02, 0.03, 0.05), 0.95, (161.541, 161.546)),
    "repaired fail again": (3, (0.01, 0.02, 0.03, 0.05), 0.95, (161.674, 161.683)),
    "uniform drift": (3, (0, 0.1, 0.1, 0.1), 0.95, (174.7352, 174.7358)),
    "line of 5": (5, (0, 0.1), 0.95, (8.1563, 8.1571)),
}
BY_START_LEVEL = [(124.741, 124.750), (125.919, 125.927), (138.040, 138.048), (183.055, 183.065), (273.055, 273.065)]
NOT_OBSERVED = 196.667


def assert_meet(interval, known, tolerance=0.0):
    """Two intervals for the same number have a number in common."""
    assert interval[0] <= known[1] + tolerance
    assert known[0] <= interval[1] + tolerance


def repair(name):
    size, degradation, discount, optimum = REPAIR[name]
    chain = damage_chain(degradation)
    return RepairModel(line(size), chain, COSTS[: len(chain)], discount, dtype=torch.float64), optimum


def starts(model):
    """The uniform prior, the level of location 0 observed: a state for each level."""
    y = UniformStart(model, observe_start=False)(torch.arange(model.num_levels))
    y["belief"][:, 0] = torch.eye(model.num_levels, dtype=model.dtype)
    return y


@pytest.mark.parametrize("gap", [0.005, 1e-4])
@pytest.mark.parametrize(("name", "discount", "value", "rounding"), FILES)
def test_known_optima_lie_in_the_interval(name, discount, value, rounding, gap):
    model, start = read_pomdp(DATA / f"{name}.POMDP", dtype=torch.float64)
    model = TabularModel(model.transition, model.observation, model.cost, discount, dtype=torch.float64)
    found = solve(model, start.belief, relative_gap=gap)
    assert found.lower - rounding <= value <= found.upper + rounding
    assert found.interval.relative_gap <= gap


def test_the_crying_baby():
    found = solve(crying_baby().model, torch.tensor([1.0, 0.0]), relative_gap=1e-4)
    assert_meet(found.interval, (16.28, 16.32))


@pytest.mark.parametrize("gap", [0.005, 1e-4])
@pytest.mark.parametrize("name", REPAIR)
def test_optima_of_small_repair_problems(name, gap):
    model, optimum = repair(name)
    found = solve(tabular_model(model), joint_belief(model, starts(model)), relative_gap=gap)
    assert_meet(found.interval, optimum)
    assert found.interval.relative_gap <= gap
    assert found.lower == pytest.approx(sum(each.lower for each in found.by_start) / model.num_levels)
    if name == "line of 3":
        for each, known in zip(found.by_start, BY_START_LEVEL, strict=True):
            assert_meet(each, known)


def test_a_start_that_is_not_observed():
    model, _ = repair("uniform drift")
    y = UniformStart(model, observe_start=False)(torch.arange(1))
    table = tabular_model(model, start_observed=False)
    found = solve(table, joint_belief(model, y, start_observed=False), relative_gap=1e-5)
    assert_meet(found.interval, (NOT_OBSERVED, NOT_OBSERVED), tolerance=5e-4)


def test_intervals_are_nested():
    problem = tiger()
    found = [solve(problem.model, torch.tensor([0.5, 0.5]), relative_gap=gap).interval for gap in (0.3, 0.03, 0.003)]
    for wide, narrow in pairwise(found):
        assert wide.lower <= narrow.lower <= narrow.upper <= wide.upper
        assert narrow.relative_gap < wide.relative_gap


@pytest.mark.parametrize("seed", range(12))
def test_random_problems_against_the_mdp_of_their_beliefs(seed):
    model = random_model(seed)
    start = torch.eye(model.num_states, dtype=torch.float64)[:2]
    found = solve(model, start, relative_gap=1e-4)
    for row, interval in zip(start, found.by_start, strict=True):
        mdp = belief_mdp(model, row)
        optimum = float(mdp.optimal_cost()[0])
        assert interval.lower <= optimum <= interval.upper
        # The policy meets the upper bound, exactly.
        u = found.policy(mdp.states())["action"]
        assert optimum - 1e-9 <= float(mdp.policy_cost(u)[0]) <= interval.upper


def two_stages(rng, num_controls=2, num_observations=2):
    """Hidden states 0, 1, then 2, 3, then the end; all else random."""
    half = torch.rand(num_controls, 2, 1, generator=rng, dtype=torch.float64)
    transition = torch.zeros(num_controls, 5, 5, dtype=torch.float64)
    transition[:, :2, 2:4] = torch.cat([half, 1 - half], -1)
    transition[:, 2:, 4] = 1.0
    sees = torch.rand(num_controls, 5, num_observations, generator=rng, dtype=torch.float64) + 0.1
    cost = torch.randn(num_controls, 5, generator=rng, dtype=torch.float64) * torch.tensor([1, 1, 9, 9, 0])
    terminal = torch.arange(5) == 4
    sees = sees / sees.sum(-1, keepdim=True)
    return TabularModel(transition, sees, cost, 0.8, terminal=terminal, dtype=torch.float64)


def cost_of_tree(model, belief, first, then):
    """Cost of a policy tree, summed over the paths of the hidden state."""
    total = 0.0
    for i in (0, 1):
        total += float(belief[i] * model.cost[first, i])
        for j, z in product((2, 3), range(model.num_observations)):
            chance = belief[i] * model.transition[first, i, j] * model.observation[first, j, z]
            total += model.discount * float(chance * model.cost[then[z], j])
    return total


@pytest.mark.parametrize("seed", range(5))
def test_the_best_of_all_policies_of_two_stages(seed):
    model = two_stages(torch.Generator().manual_seed(seed))
    belief = torch.tensor([0.3, 0.7, 0, 0, 0], dtype=torch.float64)
    trees = [(first, then) for first in (0, 1) for then in product((0, 1), repeat=2)]
    costs = [cost_of_tree(model, belief, *tree) for tree in trees]
    found = solve(model, belief, relative_gap=1e-6)
    assert found.lower <= min(costs) <= found.upper
    assert found.upper - found.lower < 1e-5
    best_first = trees[min(range(len(trees)), key=costs.__getitem__)][0]
    assert int(found.policy(TensorDict({"belief": belief.unsqueeze(0)}, [1]))["action"]) == best_first


def blind(cost, legal=None, discount=0.5, **options):
    """States that stay what they are and that nobody sees."""
    cost = torch.tensor(cost, dtype=torch.float64)
    num_controls, n = cost.shape
    stay, nothing = torch.eye(n).expand(num_controls, n, n), torch.ones(num_controls, n, 1)
    return TabularModel(stay, nothing, cost, discount, legal=legal, dtype=torch.float64, **options)


def test_one_state_costs_the_cheaper_control_for_ever():
    found = solve(blind([[3.0], [1.0]]), torch.tensor([1.0]), relative_gap=1e-6)
    assert found.lower <= 2.0 <= found.upper < 2.0 + 1e-5


def test_rewards_are_negative_costs():
    found = solve(blind([[-3.0], [1.0]]), torch.tensor([1.0]), relative_gap=1e-6)
    assert found.lower <= -6.0 <= found.upper < -6.0 + 1e-5


def test_a_control_must_be_legal_in_every_possible_state():
    # Control 0 is free, but illegal in state 1; control 1 costs 1.
    model = blind([[0.0, 0.0], [1.0, 1.0]], legal=torch.tensor([[True, True], [False, True]]))
    found = solve(model, torch.tensor([[1.0, 0.0], [0.5, 0.5], [1.0 - 1e-9, 1e-9]]), relative_gap=1e-6)
    for interval, optimum in zip(found.by_start, (0.0, 2.0, 2.0), strict=True):
        assert interval.lower <= optimum <= interval.upper
        assert interval.upper - interval.lower < 1e-5
    y = TensorDict({"belief": torch.tensor([[1.0, 0.0], [0.5, 0.5], [1.0 - 1e-9, 1e-9]], dtype=torch.float64)}, [3])
    assert found.policy(y)["action"].tolist() == [0, 1, 1]


def test_nothing_is_left_after_a_terminal_state():
    ends = torch.tensor([[[0.0, 1.0], [0.0, 1.0]]])
    model = TabularModel(ends, torch.ones(1, 2, 1), [[5.0, 0.0]], 0.99, terminal=torch.tensor([False, True]))
    found = solve(model, torch.tensor([1.0, 0.0]), relative_gap=1e-9)
    assert found.lower <= 5.0 <= found.upper
    assert found.upper - found.lower < 1e-6


def test_a_problem_without_any_cost():
    found = solve(blind([[0.0, 0.0]]), torch.tensor([0.5, 0.5]))
    assert found.interval == (0.0, 0.0)


def test_dense_and_sparse_tables_give_the_same():
    model, _ = repair("line of 3")
    table, belief = tabular_model(model), joint_belief(model, starts(model))
    dense = TabularModel(
        table.transition.to_dense(), table.observation.to_dense(), table.cost, 0.99, legal=table.legal, dtype=torch.float64
    )
    assert table.transition.is_sparse
    assert solve(dense, belief).interval == solve(table, belief).interval


def test_time_that_is_over_leaves_valid_bounds():
    model, optimum = repair("repaired fail again")
    table, belief = tabular_model(model), joint_belief(model, starts(model))
    found = solve(table, belief, relative_gap=1e-6, seconds=1e-3)
    assert found.interval.relative_gap > 0.01
    assert_meet(found.interval, optimum)
    assert found.seconds < 5.0


def renewal():
    """Seen states: going on is free in the first one and costs 5 in the other; mending costs 2 or 8."""
    transition = torch.tensor([[[0.9, 0.1], [0.0, 1.0]], [[1.0, 0.0], [1.0, 0.0]]], dtype=torch.float64)
    return TabularModel(transition, torch.eye(2).expand(2, 2, 2), [[0.0, 5.0], [2.0, 8.0]], 0.999, dtype=torch.float64)


def test_what_later_plans_and_points_surpass_is_dropped():
    model = renewal()
    search = Search(JointTable(model), inf)
    root, made = search.start(np.array([1.0, 0.0])), []
    add, add_point = search._add_vector, search._add_point
    search._add_vector = lambda *of: (made.append(0), add(*of))
    search._add_point = lambda *of: (made.append(1), add_point(*of))
    while len(made) < 4000:
        search.trial(root, 0.5 * root.gap, inf)
    assert made.count(0) > 1000
    assert made.count(1) > 1000
    # A trial adds some hundreds.
    assert search.vectors.count < 600
    assert search._bits.count < 600
    optimum = float(belief_mdp(model, torch.tensor([1.0, 0.0])).optimal_cost()[0])
    assert root.lower <= optimum <= root.upper
    assert 2 <= len(search.kept()) <= 4


def test_plans_that_are_kept_go_on_with_plans_that_are_kept(monkeypatch):
    dropped = []
    for name in ("_drop_vectors", "_drop_points"):
        drop = getattr(Search, name)
        monkeypatch.setattr(Search, name, lambda search, drop=drop: (dropped.append(drop), drop(search)))
    table = JointTable(tiger().model)
    search = Search(table, inf)
    root = search.start(np.array([0.5, 0.5]))
    while root.gap > 2e-6:
        search.trial(root, 0.5 * root.gap, inf)
    assert len(set(dropped)) == 2
    assert root.lower - 5e-7 <= -19.371368 <= root.upper + 5e-7
    kept = search.kept()
    for number in kept:
        u, successors = search.controls[number], [search._current(k) for k in search.successors[number]]
        assert set(successors) <= set(kept)
        if u >= 0:
            # A constant plan has a single one.
            chosen = np.array(successors * (1 if len(successors) > 1 else table.num_observations))
            cost = table.backup(u, search.vectors.rows, chosen)
            assert (cost <= search.vectors.rows[number] + 1e-12 * np.abs(cost)).all()


@pytest.mark.parametrize("bound", ["worst", "constant", "informed"])
def test_first_bounds_hold_whenever_they_are_left(bound):
    """They take 20000 stages, or one."""
    table = JointTable(renewal())
    optimum = belief_mdp(renewal(), torch.tensor([1.0, 0.0])).optimal_cost()[:2].numpy()
    early, late = (_first_bound(table, bound, until) for until in (0.0, inf))
    if bound == "informed":
        assert (early < late).all()
        assert (late <= optimum * (1 + 1e-9)).all()
    else:
        assert (early > late).all()
        assert (late >= optimum * (1 - 1e-9)).all()


def _first_bound(table, bound, until):
    if bound == "constant":
        return table.constant(0, table.worst(until), until)
    return table.worst(until) if bound == "worst" else table.informed(until).min(1)


def test_a_control_that_becomes_illegal_later_has_no_constant_plan_even_without_time():
    # Control 0 leads from 0 to 1 to 2, where it is illegal.
    move = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]).expand(2, 3, 3)
    legal = torch.tensor([[True, True], [True, True], [False, True]])
    model = TabularModel(move, torch.ones(2, 3, 1), torch.ones(2, 3), 0.5, legal=legal)
    table = JointTable(model)
    assert np.isinf(table.constant(0, table.worst(0.0), 0.0)).all()
    assert np.isfinite(table.constant(1, table.worst(0.0), 0.0)).all()


def test_rounding_is_measured_by_the_costs_to_go():
    # 100 once, then nothing; at 100 for ever it would be 1e8.
    ends = torch.tensor([[[0.0, 1.0], [0.0, 1.0]]])
    model = TabularModel(ends, torch.ones(1, 2, 1), [[100.0, 0.0]], 0.999999, dtype=torch.float64)
    found = solve(model, torch.tensor([1.0, 0.0]))
    assert found.lower <= 100.0 <= found.upper
    assert found.interval.relative_gap < 1e-6


def test_the_interval_is_as_narrow_as_was_asked_for_with_its_rounding():
    # What rounding can do alone is wider than the gap that is asked for: the search ends and says so.
    ends = torch.tensor([[[0.0, 1.0], [0.0, 1.0]]])
    model = TabularModel(ends, torch.ones(1, 2, 1), [[100.0, 0.0]], 0.999999, dtype=torch.float64)
    found = solve(model, torch.tensor([1.0, 0.0]), relative_gap=1e-9)
    assert found.interval.relative_gap > 1e-9
    assert found.lower <= 100.0 <= found.upper


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_no_interval_is_wider_than_all_costs(sign):
    # A number whose quotient by 1 - discount is rounded, for ever.
    found = solve(blind([[sign]], discount=0.999999), torch.tensor([1.0]), seconds=0.1)
    optimum = Fraction(sign) / (1 - Fraction(0.999999))
    assert Fraction(found.lower) <= optimum <= Fraction(found.upper)
    assert min(abs(found.lower - float(optimum)), abs(found.upper - float(optimum))) < 1e-8


def test_the_policy_meets_the_upper_bound_where_plans_cost_nearly_the_same():
    # In state 0 control 1 costs a little more, for ever; in state 1 only it is free.
    stay, seen = torch.eye(2).expand(2, 2, 2), torch.eye(2).expand(2, 2, 2)
    model = TabularModel(stay, seen, [[1.0, 1.0], [1.0 + 5e-10, 0.0]], 0.5, dtype=torch.float64)
    found = solve(model, torch.eye(2, dtype=torch.float64), relative_gap=1e-12)
    mdp = belief_mdp(model, torch.tensor([1.0, 0.0]))
    assert float(mdp.policy_cost(found.policy(mdp.states())["action"])[0]) <= found.by_start[0].upper
    assert found.by_start[0].lower <= 2.0 <= found.by_start[0].upper < 2.0 + 2e-9


def test_the_policy_meets_the_upper_bound_on_the_line_of_3():
    model, _ = repair("line of 3")
    found = solve(tabular_model(model), joint_belief(model, starts(model)))

    def policy(y):
        table_y = TensorDict({"belief": joint_belief(model, y)}, y.batch_size)
        return y.set("action", found.policy(table_y)["action"])

    cost, by_level = line3_cost(model, policy)
    assert found.lower - 1e-3 <= cost <= found.upper + 1e-3
    for level, interval in zip(by_level, found.by_start, strict=True):
        assert interval.lower - 1e-3 <= level <= interval.upper + 1e-3


def test_the_policy_is_a_base_policy_for_rollout():
    problem = tiger()
    found = solve(problem.model, torch.tensor([0.5, 0.5]))
    sample = estimate(discounted_costs(problem.model, found.policy, problem.start, num_states=1000))
    assert found.lower - 3 * sample.standard_error <= sample.mean <= found.upper + 3 * sample.standard_error


def test_the_policy_does_what_the_least_vector_says():
    vectors = torch.tensor([[4.0, torch.inf], [5.0, 5.0], [torch.inf, 1.0]])
    policy = AlphaVectorPolicy(tiger().model, vectors, torch.tensor([2, 0, 1]))
    belief = torch.tensor([[[1.0, 0.0], [0.9, 0.1]], [[0.0, 1.0], [0.1, 0.9]]])
    assert policy(TensorDict({"belief": belief}, [2, 2]))["action"].tolist() == [[2, 0], [1, 0]]
    assert len(policy) == 3
    cost = policy.cost(TensorDict({"belief": belief}, [2, 2]))
    torch.testing.assert_close(cost, torch.tensor([[4.0, 5.0], [1.0, 5.0]]).double(), rtol=1e-6, atol=0)


def test_any_legal_control_is_the_first_one():
    model = blind([[0.0, 0.0], [1.0, 1.0]], legal=torch.tensor([[True, True], [False, True]]))
    policy = AlphaVectorPolicy(model, torch.tensor([[9.0, 9.0]]), torch.tensor([-1]))
    y = TensorDict({"belief": torch.eye(2, dtype=torch.float64)}, [2])
    assert policy(y)["action"].tolist() == [0, 1]


def test_nearly_equal_vectors_go_to_the_first():
    vectors = torch.tensor([[1.0 + 1e-12, 1.0], [1.0, 1.0]], dtype=torch.float64)
    policy = AlphaVectorPolicy(tiger().model, vectors, torch.tensor([2, 1]))
    assert policy(FixedBelief(torch.tensor([0.5, 0.5]))(torch.arange(3)))["action"].tolist() == [2, 2, 2]


def test_vectors_that_differ_by_more_than_rounding_do_not():
    vectors = torch.tensor([[1.0 + 1e-10, 1.0], [1.0, 1.0]], dtype=torch.float64)
    policy = AlphaVectorPolicy(tiger().model, vectors, torch.tensor([2, 1]))
    assert policy(FixedBelief(torch.tensor([0.5, 0.5]))(torch.arange(3)))["action"].tolist() == [1, 1, 1]


def test_what_is_written_into_vectors_and_controls_later_changes_nothing():
    vectors, controls = torch.tensor([[4.0, 9.0], [9.0, 1.0]], dtype=torch.float64), torch.tensor([2, 1])
    policy = AlphaVectorPolicy(tiger().model, vectors.requires_grad_(), controls)
    with torch.no_grad():
        vectors.zero_()
    controls.zero_()
    y = TensorDict({"belief": torch.eye(2)}, [2])
    assert policy(y)["action"].tolist() == [2, 1]
    assert policy.cost(y).tolist() == [4.0, 1.0]
    assert not policy.cost(y).requires_grad


def test_a_belief_without_a_legal_plan_is_refused():
    policy = AlphaVectorPolicy(tiger().model, torch.tensor([[1.0, torch.inf]]), torch.tensor([0]))
    with pytest.raises(ValueError, match="y has a belief at which no plan is legal"):
        policy(TensorDict({"belief": torch.tensor([[0.5, 0.5]])}, [1]))


def test_a_belief_that_can_get_stuck_is_refused():
    # Each state allows a control of its own: alone they can go on, mixed they cannot.
    model = blind([[1.0, 1.0], [1.0, 1.0]], legal=torch.eye(2, dtype=torch.bool))
    assert solve(model, torch.tensor([0.0, 1.0])).lower == pytest.approx(2.0, rel=0.01)
    with pytest.raises(
        ValueError, match=r"belief must not lead to one whose states share no legal control: one of the states \[0, 1\] is"
    ):
        solve(model, torch.tensor([0.5, 0.5]))


def test_a_belief_that_gets_stuck_later_is_refused():
    # State 0 goes to 1 or 2, unseen, which share no control.
    half = torch.tensor([[0.0, 0.5, 0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]).expand(2, 3, 3)
    legal = torch.tensor([[True, True], [True, False], [False, True]])
    model = TabularModel(half, torch.ones(2, 3, 1), torch.ones(2, 3), 0.5, legal=legal)
    with pytest.raises(
        ValueError, match=r"belief must not lead to .* one of the states \[0\] is such a belief, or leads to one"
    ):
        solve(model, torch.tensor([1.0, 0.0, 0.0]))


def one_way_out():
    """From state 0 control 0 leads to states 1 or 2, unseen, which share no control; control 1 does not."""
    moves, seen = torch.zeros(2, 5, 5, dtype=torch.float64), torch.zeros(2, 5, 5, dtype=torch.float64)
    moves[0, 0, 1] = moves[0, 0, 2] = 0.5
    moves[1, 0, 3] = 1.0
    moves[:, 1, 1] = moves[:, 2, 2] = moves[:, 3, 4] = moves[:, 4, 3] = 1.0
    seen[:, [0, 3, 4], [0, 3, 4]] = 1.0
    seen[:, [1, 2], 1] = 1.0
    cost = torch.full((2, 5), 5.0, dtype=torch.float64)
    legal = torch.tensor([[True, True], [True, False], [False, True], [True, False], [False, True]])
    return TabularModel(moves, seen, cost, 0.9, legal=legal, dtype=torch.float64)


def test_a_single_control_that_leads_to_where_none_is_legal_is_refused():
    with pytest.raises(
        ValueError, match=r"belief must not lead to one whose states share no legal control: one of the states \[1, 2\] is"
    ):
        solve(one_way_out(), torch.eye(5)[0])


def test_a_policy_plays_nothing_where_nothing_is_legal():
    model = one_way_out()
    anything = AlphaVectorPolicy(model, torch.zeros(1, 5), torch.tensor([-1]))
    with pytest.raises(ValueError, match="no plan is legal"):
        anything(TensorDict({"belief": torch.tensor([[0.0, 0.5, 0.5, 0.0, 0.0]], dtype=torch.float64)}, [1]))
    with pytest.raises(ValueError, match="'belief' of y must hold finite numbers"):
        anything.cost(TensorDict({"belief": torch.full((1, 5), torch.nan, dtype=torch.float64)}, [1]))


def test_time_is_kept_where_the_discount_makes_walks_long(monkeypatch):
    """A clock that goes on with every backup: without it a walk of a hundred thousand beliefs is backed up."""
    made = []
    backup = Search.backup
    monkeypatch.setattr(Search, "backup", lambda self, node: (made.append(node), backup(self, node))[1])
    monkeypatch.setattr("torchrl_pomdp.planners.exact.monotonic", lambda: float(len(made)))
    monkeypatch.setattr("torchrl_pomdp.planners.point_based.monotonic", lambda: float(len(made)))
    # First bounds take no time by this clock; a walk ends at its target.
    solve(tiger(0.9999).model, torch.tensor([0.5, 0.5]), relative_gap=1e-6, seconds=10.0)
    assert len(made) == 10


@pytest.mark.parametrize("belief", [torch.ones(3) / 3, torch.ones(2, 2, 2) / 2, torch.ones(0, 2)])
def test_beliefs_of_another_shape_are_refused(belief):
    with pytest.raises(ValueError, match=r"belief must have shape \(2,\) or \(any, 2\), at least one row"):
        solve(tiger().model, belief)


def test_the_relative_gap():
    assert Interval(-20.0, -19.0).relative_gap == 0.05
    assert Interval(0.0, 0.0).relative_gap == 0.0


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_the_unit_of_costs_changes_nothing(unit):
    model = tiger().model
    scaled = TabularModel(model.transition, model.observation, unit * model.cost.double(), model.discount, dtype=torch.float64)
    one, other = JointTable(model), JointTable(scaled)
    assert np.allclose(unit * one.informed(inf), other.informed(inf), rtol=1e-6, atol=0.0)
    assert np.allclose(unit * one.worst(inf), other.worst(inf), rtol=1e-6, atol=0.0)
    assert np.allclose(
        unit * one.constant(0, one.worst(inf), inf), other.constant(0, other.worst(inf), inf), rtol=1e-6, atol=0.0
    )


@pytest.mark.parametrize("cost", [1.0, -1.0])
def test_where_every_stage_costs_the_same_nothing_is_searched(cost):
    """A discount very near 1 makes all bounds move slowly; the first ones are there at once."""
    model = TabularModel(torch.ones(1, 1, 1), torch.ones(1, 1, 1), torch.tensor([[cost]]), 0.999999)
    solution = solve(model, torch.ones(1), seconds=5.0)
    assert solution.lower == pytest.approx(cost / (1 - 0.999999), rel=1e-8)
    assert solution.upper == pytest.approx(cost / (1 - 0.999999), rel=1e-8)
    assert solution.lower <= cost / (1 - 0.999999) <= solution.upper
