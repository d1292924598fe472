"""POMCP and DESPOT: legality, determinism, convergence to known optima, refusals."""

from __future__ import annotations

import copy
import pickle
from itertools import pairwise

import pytest
import torch
from tensordict import TensorDict

from torchrl_pomdp.envs import TabularModel
from torchrl_pomdp.envs.repair import Graph, RepairModel, UniformStart, damage_chain, joint_belief, line, tabular_model
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import Myopic, PartitionedPolicy
from torchrl_pomdp.modules.lookahead import simulated_steps
from torchrl_pomdp.modules.repair import GreedyRepair, UrgencyRepair
from torchrl_pomdp.planners import DESPOT, POMCP, solve, tree_search
from torchrl_pomdp.planners import despot as despot_module
from torchrl_pomdp.problems import make_problem

SEARCHES = {
    "pomcp": lambda model, policy, **options: POMCP(model, policy, **{"simulations": 60, **options}),
    "despot": lambda model, policy, **options: DESPOT(model, policy, **{"simulations": 4, "scenarios": 12, **options}),
}


@pytest.fixture(scope="module", params=sorted(SEARCHES))
def make(request):
    return SEARCHES[request.param]


def test_decisions_do_not_depend_on_the_batch(make, linear20):
    policy = UrgencyRepair(linear20.model)
    y = linear20.start(torch.arange(5))
    together = make(linear20.model, policy)(y.clone())
    for number in (0, 4):
        alone = make(linear20.model, policy)(y[number].clone())
        assert torch.equal(alone["q_factors"], together["q_factors"][number])
        assert int(alone["action"]) == int(together["action"][number])
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if threads > 1 else 2)
        assert torch.equal(make(linear20.model, policy)(y.clone())["q_factors"], together["q_factors"])
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(make(linear20.model, policy)(y.unsqueeze(0).clone())["q_factors"][0], together["q_factors"])
    assert not torch.equal(make(linear20.model, policy, seed=1)(y.clone())["q_factors"], together["q_factors"])
    assert make(linear20.model, policy)(y[:0].clone())["q_factors"].shape == (0, 3)


def test_copies_decide_alike(make, line3):
    search = make(line3.model, UrgencyRepair(line3.model))
    y = line3.start(torch.arange(3))
    first = search(y.clone())["q_factors"]
    for other in (copy.deepcopy(search), pickle.loads(pickle.dumps(search))):
        assert torch.equal(other(y.clone())["q_factors"], first)
    assert search.simulated_steps > 0


@pytest.mark.parametrize("name", ["linear20", "two_robots20", "tiger"])
@pytest.mark.parametrize("base", ["policy", None])
def test_play_is_legal(make, name, base):
    problem = make_problem(name)
    model = problem.model
    policy = None if base is None else Myopic(model) if name == "tiger" else UrgencyRepair(model)
    search = make(model, policy, max_steps=30)
    y = model.with_features(problem.start(torch.arange(8)))
    noise = torch.rand(6, 8, model.noise_dim, generator=torch.Generator().manual_seed(0))
    for step in range(6):
        decided = search(y.clone())
        # Raises where one is illegal.
        model.check_controls(y, decided["action"])
        assert torch.isinf(decided["q_factors"][~y["action_mask"]]).all()
        assert torch.isfinite(decided["q_factors"].gather(-1, decided["action"].unsqueeze(-1))).all()
        _, y = model.advance(y, decided["action"], noise[step])


def test_more_than_what_is_legal_can_be_searched(make, line3):
    model = line3.model.unrestricted()
    belief = torch.eye(5)[torch.tensor([0, 3, 3])].expand(1, 3, 5)
    y = line3.start(torch.arange(1)).set("belief", belief).set("location", torch.zeros(1, 1, dtype=torch.int64))
    assert torch.isfinite(make(model, None)(y.clone())["q_factors"]).tolist() == [[True, False, True]]
    assert torch.isfinite(make(line3.model, None)(y.clone())["q_factors"]).tolist() == [[False, False, True]]


def test_a_terminal_state_asks_for_anything_legal(make, line3):
    y = line3.start(torch.arange(1)).set("belief", torch.eye(5)[:1].expand(1, 3, 5))
    decided = make(line3.model, UrgencyRepair(line3.model))(y)
    line3.model.check_controls(y, decided["action"])
    assert decided["q_factors"][0, decided["action"]] == 0.0


def test_time_is_a_budget(make, linear20):
    search = make(linear20.model, UrgencyRepair(linear20.model), simulations=None, seconds=0.02)
    y = linear20.start(torch.arange(2))
    search(y.clone())
    little = search.simulated_steps
    more = make(linear20.model, UrgencyRepair(linear20.model), simulations=None, seconds=0.4)
    decided = more(y.clone())
    linear20.model.check_controls(y, decided["action"])
    assert more.simulated_steps > 2 * little


def regrets(problem, table, y, search, exact):
    """How much more than the optimum a search's control costs, followed by the best policy, for each of ``y``."""
    model, decided = problem.model, search(y.clone())
    u = decided["action"]
    cost = model.expected_cost(y, u).double()
    probs = model.observation_probs(y, u).double()
    for z in range(model.num_observations):
        rows = (probs[:, z] > 0).nonzero().squeeze(-1)
        after = model.estimator(y[rows], u[rows], torch.full_like(rows, z))
        cost[rows] += model.discount * probs[rows, z] * exact(table(after))
    return cost - exact(table(y))


@pytest.fixture(scope="module")
def line3_exact(line3):
    start = UniformStart(line3.model)(torch.arange(40))
    table = tabular_model(line3.model)
    solution = solve(table, joint_belief(line3.model, start), relative_gap=0.003)
    return start, lambda y: TensorDict({"belief": joint_belief(line3.model, y)}, y.batch_size), solution


@pytest.mark.parametrize(
    ("search", "few", "many"),
    [
        (lambda model, n: POMCP(model, UrgencyRepair(model), simulations=n), 10, 10_000),
        (lambda model, n: DESPOT(model, UrgencyRepair(model), simulations=n, scenarios=max(5, n)), 1, 1000),
    ],
    ids=["pomcp", "despot"],
)
def test_decisions_on_the_line_of_3_become_those_of_the_optimum(line3, line3_exact, search, few, many):
    y, table, solution = line3_exact
    exact = solution.policy.cost
    loose, tight = (regrets(line3, table, y, search(line3.model, n), exact).mean() for n in (few, many))
    optimum = float(exact(table(y)).mean())
    assert tight < 0.002 * optimum
    assert tight <= loose + 1e-9


def test_bounds_hold_the_optimum_of_the_line_of_3(line3, line3_exact):
    y, table, solution = line3_exact
    low, high = DESPOT(line3.model, UrgencyRepair(line3.model), simulations=300, scenarios=2000).bounds(y)
    exact = solution.policy.cost(table(y))
    # The mean over 2000 scenarios errs by about half a percent of a cost.
    assert bool((low <= exact * 1.01).all())
    assert bool((high >= exact * 0.99).all())
    assert float((high - low).mean()) < 0.1 * float(exact.mean())


@pytest.mark.parametrize("base", [None, "myopic"])
def test_tiger_is_solved(base):
    problem = make_problem("tiger")
    policy = None if base is None else Myopic(problem.model)
    y = problem.start(torch.arange(1))
    for belief, best in ((0.5, 0), (0.85, 0), (0.9698, 1), (0.0302, 2)):
        y.set("belief", torch.tensor([[1 - belief, belief]]))
        names = problem.model.control_names
        # With random play for a guide POMCP takes very long: opening a door pays only with a plan for what comes after it.
        searches = [DESPOT(problem.model, policy, simulations=1500, scenarios=300, max_steps=10)]
        searches += [POMCP(problem.model, policy, simulations=20_000, max_steps=40)] if policy else []
        for search in searches:
            assert int(search(y.clone())["action"]) == best, (belief, names, type(search).__name__)


def test_the_base_policy_answers_where_nothing_is_better(linear20):
    model = linear20.model
    y = linear20.start(torch.arange(6))
    heavy = DESPOT(model, UrgencyRepair(model), simulations=3, scenarios=5, regularisation=1e9)
    assert torch.equal(heavy(y.clone())["action"], UrgencyRepair(model)(y.clone())["action"])


def test_the_relaxation_closes_the_gap_sooner(linear20):
    model, y = linear20.model, linear20.start(torch.arange(4))
    gaps = []
    for bound in ("trivial", "relaxed"):
        low, high = DESPOT(model, UrgencyRepair(model), simulations=3, scenarios=20, bound=bound).bounds(y)
        assert bool((low <= high).all())
        gaps.append((high - low) / high)
    assert bool((gaps[1] < 0.7 * gaps[0]).all())


def test_searches_improve_their_base_policy(make, linear20):
    urgency = UrgencyRepair(linear20.model)
    costs = [
        discounted_costs(linear20.model, policy, linear20.start, num_states=25, seed=3)
        for policy in (make(linear20.model, urgency), urgency)
    ]
    assert compare(*costs).ratio.interval[1] < 1.0


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (POMCP, {}, "simulations or seconds must be given, and not both"),
        (POMCP, {"simulations": 5, "seconds": 1.0}, "simulations or seconds must be given, and not both"),
        (DESPOT, {"simulations": 5, "scenarios": 0}, "scenarios must be at least 1, got 0"),
        (DESPOT, {"simulations": 5, "regularisation": -1.0}, "regularisation must not be negative"),
        (DESPOT, {"simulations": 5, "gap": 1.0}, "gap must be"),
        (DESPOT, {"simulations": 5, "depth": 0}, "depth must be at least 1, got 0"),
        (DESPOT, {"simulations": 5, "bound": "magic"}, "bound must be"),
        (POMCP, {"simulations": 5, "exploration": -0.1}, "exploration must not be negative"),
        (POMCP, {"seconds": 0.0}, "seconds must be"),
        (POMCP, {"simulations": 0}, "simulations must be at least 1, got 0"),
    ],
)
def test_refusals(kind, options, message, line3):
    with pytest.raises(ValueError, match=message):
        kind(line3.model, None, **options)


def test_models_and_policies_without_a_twin_are_refused(make, line3, linear20):
    rocks = make_problem("rocksample7x8")
    with pytest.raises(ValueError, match=r"model must have a scalar twin.*RockSample"):
        make(rocks.model, None)
    with pytest.raises(ValueError, match=r"base_policy must have a scalar twin.*function"):
        make(line3.model, lambda y: y)
    with pytest.raises(ValueError, match="base_policy must have a scalar twin for this very model"):
        make(line3.model, UrgencyRepair(linear20.model))
    with pytest.raises(ValueError, match=r"model must have a scalar twin.*RockSample"):
        make(rocks.model, rocks.base_policies[rocks.baseline])


def test_without_numba_it_says_what_to_install(make, line3, monkeypatch):
    monkeypatch.setattr(tree_search, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"needs numba: pip install '\.\[fast\]' in the library's folder"):
        make(line3.model, None)


def test_equal_bounds_at_the_root_are_answered(line3):
    # One location is damaged, and the robot stands on it: repair is the only thing to do, and its cost is certain.
    belief = torch.eye(5)[torch.tensor([4, 0, 0])].expand(1, 3, 5)
    y = line3.start(torch.arange(1)).set("belief", belief).set("location", torch.zeros(1, 1, dtype=torch.int64))
    search = DESPOT(line3.model, UrgencyRepair(line3.model), simulations=5, scenarios=7)
    low, high = search.bounds(y)
    assert float(low) == pytest.approx(100.0)
    assert float(high) == pytest.approx(100.0)
    decided = search(y.clone())
    assert int(decided["action"]) == 0
    assert float(decided["q_factors"][0, 0]) == pytest.approx(100.0)


def test_random_play_vouches_for_no_control():
    # One stage: a control costs what it costs, whatever controls the scenarios have drawn.
    problem = make_problem("tiger")
    y = problem.start(torch.arange(1))
    exact = torch.stack([problem.model.expected_cost(y, torch.tensor([u])) for u in range(3)], -1)
    for search in (DESPOT(problem.model, simulations=300, max_steps=1), POMCP(problem.model, simulations=300, max_steps=1)):
        torch.testing.assert_close(search(y.clone())["q_factors"], exact)


@pytest.mark.parametrize("depth", [2, 3])
def test_short_horizons_are_solved_exactly_but_for_the_scenarios(depth):
    problem = make_problem("tiger")
    model = problem.model

    def best(y, left):
        """Cost of the best plan for so many stages, by enumeration."""
        if left == 0:
            return torch.zeros(1)
        return q(y, left).amin(-1)

    def q(y, left):
        costs = []
        for u in range(3):
            control = torch.tensor([u])
            probs, cost = model.observation_probs(y, control)[0], model.expected_cost(y, control)
            for z in range(2):
                cost = cost + model.discount * probs[z] * best(model.estimator(y, control, torch.tensor([z])), left - 1)
            costs.append(cost)
        return torch.stack(costs, -1)

    y = problem.start(torch.arange(1)).set("belief", torch.tensor([[0.1, 0.9]]))
    exact = q(y, depth)
    found = DESPOT(model, simulations=400, scenarios=4000, max_steps=depth, gap=0.0)(y.clone())["q_factors"]
    best_control = int(exact.argmin())
    assert int(found.argmin()) == best_control
    assert float(found[0, best_control]) == pytest.approx(float(exact.min()), abs=1.5)


def test_costs_that_overflow_are_refused(make):
    half = torch.full((2, 2, 2), 0.5)
    model = TabularModel(torch.eye(2).expand(2, 2, 2), half, torch.tensor([[1e38, 1e38], [2e38, 2e38]]), 0.9)
    y = TensorDict({"belief": torch.tensor([[0.5, 0.5]])}, [1])
    with pytest.raises(ValueError, match=r"q_factors must be finite as torch\.float32"):
        make(model, None)(y)


@pytest.mark.parametrize("size", [1e307, 1e308])
def test_costs_that_all_overflow_double_precision_are_refused(make, size):
    half = torch.full((2, 2, 2), 0.5).double()
    model = TabularModel(half, half, torch.full((2, 2), size, dtype=torch.float64), 0.95, dtype=torch.float64)
    y = TensorDict({"belief": torch.tensor([[0.5, 0.5]], dtype=torch.float64)}, [1])
    with pytest.raises(ValueError, match=r"must be finite, got .*: the model's costs overflow"):
        make(model, Myopic(model))(y)
    with pytest.raises(ValueError, match="model must have smaller costs"):
        solve(model, torch.tensor([0.5, 0.5]))


def test_costs_that_overflow_double_precision_are_refused():
    half, cost = torch.full((2, 2, 2), 0.5).double(), torch.tensor([[1e308, 1e308], [-1e308, -1e308]], dtype=torch.float64)
    model = TabularModel(half, half, cost, 0.99, dtype=torch.float64)
    y = TensorDict({"belief": torch.tensor([[0.5, 0.5]], dtype=torch.float64)}, [1])
    with pytest.raises(ValueError, match="q_factors must be finite, got nan or -inf"):
        POMCP(model, None, simulations=200)(y)


def test_large_costs_that_differ_a_little_decide(make):
    # Control 0 costs 2 more, once, before 1e7 at every stage: in float32 the sums, about 1e8, are 8 apart.
    move = torch.tensor([[0.0, 1.0], [0.0, 1.0]]).expand(2, 2, 2)
    model = TabularModel(move, torch.ones(2, 2, 1), [[1e7 + 2.0, 1e7], [1e7, 1e7]], 0.9)
    decided = make(model, Myopic(model), max_steps=400)(TensorDict({"belief": torch.tensor([[1.0, 0.0]])}, [1]))
    assert decided["q_factors"].dtype == torch.float32
    torch.testing.assert_close(decided["q_factors"], torch.full((1, 2), 1e8), rtol=1e-6, atol=0.0)
    assert decided["action"].tolist() == [1]


def test_a_long_search_is_cut_into_stretches_and_finds_the_same(make, line3, monkeypatch):
    y = line3.start(torch.arange(2))
    whole = make(line3.model, UrgencyRepair(line3.model))(y.clone())["q_factors"]
    assert list(tree_search.Budget(250_000, None).stretches()) == [100_000, 100_000, 50_000]
    monkeypatch.setattr(tree_search, "_STRETCH", 7)
    assert max(tree_search.Budget(None, 0.1).stretches()) <= 7
    assert torch.equal(make(line3.model, UrgencyRepair(line3.model))(y.clone())["q_factors"], whole)


def test_any_seed_will_do(make, line3):
    for problem in (line3, make_problem("tiger")):
        y = problem.start(torch.arange(1))
        assert make(problem.model, None, seed=2**70, max_steps=20)(y.clone())["q_factors"].shape == (1, 3)


def test_a_long_exploration_ends_with_the_time(linear20, monkeypatch):
    search = DESPOT(linear20.model, None, seconds=1.0, scenarios=10, bound="trivial")
    y = linear20.start(torch.arange(1))
    search(y.clone())
    # As if the time were over after the first node: it has children, and their bounds have come up to the root.
    clock = iter([0.0, *[2.0] * 100])
    monkeypatch.setattr(despot_module, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(search.budget, "stretches", lambda: iter([1]))
    before = search.simulated_steps
    decided = search(y.clone())
    little = search.simulated_steps - before
    assert torch.equal(torch.isfinite(decided["q_factors"]), linear20.model.action_mask(y))
    monkeypatch.setattr(despot_module, "perf_counter", lambda: 0.0)
    search(y.clone())
    assert search.simulated_steps - before - little > 3 * little


@pytest.mark.parametrize(("epsilon", "damage"), [(0.01, 0.005), (1e-6, 5e-7)])
def test_damage_too_improbable_to_go_on_for_is_not_charged(epsilon, damage):
    """All is over once the first location is repaired: the last one, far away, is never seen."""
    costs = (0.0, 0.1, 1.0, 10.0, 100.0)
    model = RepairModel(line(6), damage_chain((0.0, 0.02, 0.03, 0.05)), costs, 0.99, terminal_probability=epsilon)
    belief = torch.zeros(1, 6, 5)
    belief[..., 0] = 1.0
    belief[0, 0] = torch.tensor([0.0, 1.0, 0.0, 0.0, 0.0])
    belief[0, 5] = torch.tensor([1 - damage, 0.0, 0.0, 0.0, damage])
    y = TensorDict({"belief": belief, "location": torch.zeros(1, 1, dtype=torch.int64)}, [1])
    search = DESPOT(model, GreedyRepair(model), simulations=50, scenarios=20)
    assert search(y.clone())["action"] == 0
    low, high = (float(bound) for bound in search.bounds(y))
    paid = 0.1 + 100 * damage
    assert low <= paid * (1 + 1e-6)
    assert high == pytest.approx(paid, rel=1e-4)


def test_nothing_is_over_where_level_0_costs():
    """20 a stage for ever, and 1 in the first one."""
    model = RepairModel(line(2), damage_chain((0.0,)), (10.0, 11.0), 0.9)
    y = TensorDict({"belief": torch.tensor([[0.0, 1.0], [1.0, 0.0]]), "location": torch.tensor([0])}, [])
    found = solve(tabular_model(model), joint_belief(model, y))
    assert list(found.interval) == pytest.approx([201.0, 201.0], rel=0.005)
    low, high = DESPOT(model, GreedyRepair(model), simulations=20, max_steps=300).bounds(y[None])
    assert [float(low), float(high)] == pytest.approx([201.0, 201.0], rel=1e-5)


@pytest.mark.parametrize("size", [63, 64])
def test_locations_that_share_a_bit_do_not_break_the_relaxation(size):
    """On the path 1 - 0 - z - 2 - ... the robot looks at 0 on its way to z; with 64 locations they share a bit."""
    last = size - 1
    path = [1, 0, last, *range(2, last)]
    graph = Graph.from_edges("path", size, list(pairwise(path)))
    model = RepairModel(graph, damage_chain((0.0, 0.0)), (0.0, 1.0, 100.0), 0.95)
    belief = torch.eye(3)[0].repeat(1, size, 1)
    belief[0, last] = torch.tensor([0.0, 0.5, 0.5])
    y = TensorDict({"belief": belief, "location": torch.tensor([[1]])}, [1])
    for seed in range(20):
        low, high = DESPOT(model, GreedyRepair(model), simulations=5, scenarios=1, seed=seed).bounds(y)
        assert 0.0 < float(low) <= float(high)


@pytest.mark.parametrize("policies", [("myopic", None), (None, "myopic")])
def test_a_base_policy_that_is_replaced_is_simulated(make, policies):
    """Compiled loops are for one policy; nothing would see that they are called with another one's data."""
    problem = make_problem("tiger")
    model, y = problem.model, problem.start(torch.arange(2))
    first, second = (None if name is None else Myopic(model) for name in policies)
    search = make(model, first)
    search(y.clone())
    search.base_policy = second
    assert torch.equal(search(y.clone())["q_factors"], make(model, second)(y.clone())["q_factors"])


def test_a_base_policy_that_is_replaced_by_one_with_other_data_is_simulated(make, linear20):
    y = linear20.start(torch.arange(2))
    search = make(linear20.model, GreedyRepair(linear20.model))
    search(y.clone())
    search.base_policy = UrgencyRepair(linear20.model)
    expected = make(linear20.model, UrgencyRepair(linear20.model))(y.clone())["q_factors"]
    assert torch.equal(search(y.clone())["q_factors"], expected)


def test_what_compiled_simulations_are_made_for_is_fixed(make, line3):
    search = make(line3.model, UrgencyRepair(line3.model), max_steps=60)
    with pytest.raises(AttributeError):
        search.max_steps = 1
    assert search.max_steps == 60


def test_beliefs_that_add_up_to_a_little_more_than_one_are_no_fault_of_the_model():
    """Thirds in single precision do: a cost of -1 at every stage is then a little less than any bound of it."""
    model = TabularModel(torch.eye(3).expand(2, 3, 3), torch.ones(2, 3, 1), -torch.ones(2, 3), 0.5)
    y = TensorDict({"belief": torch.full((1, 3), 1 / 3)}, [1])
    assert float(y["belief"].double().sum()) > 1.0
    for bound in ("trivial", "relaxed"):
        search = DESPOT(model, None, simulations=5, bound=bound, max_steps=100)
        assert search(y.clone())["q_factors"].tolist() == [[-2.0, -2.0]]


def test_beliefs_without_a_legal_control_are_not_blamed_on_a_base_policy(make):
    half = torch.tensor([[0.0, 0.5, 0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]).expand(2, 3, 3)
    legal = torch.tensor([[True, True], [True, False], [False, True]])
    model = TabularModel(half, torch.ones(2, 3, 1), torch.ones(2, 3), 0.5, legal=legal)
    with pytest.raises(ValueError, match="y must not lead to beliefs whose states share no legal control"):
        make(model, None)(TensorDict({"belief": torch.eye(3)[:1]}, [1]))


def test_tables_that_are_too_large_are_named(make):
    size = 1500
    moves = torch.eye(size).to_sparse()
    model = TabularModel(torch.stack([moves, moves]), torch.ones(2, size, 1), torch.ones(2, size), 0.9)
    with pytest.raises(ValueError, match="whose tables hold at most 4,194,304 numbers"):
        make(model, None)


def test_simulations_are_counted_inside_of_other_modules(make, line3):
    search = make(line3.model, UrgencyRepair(line3.model))
    policy = PartitionedPolicy([search] * line3.partition.num_parts)
    policy(line3.model.with_features(line3.start(torch.arange(2))))
    assert simulated_steps(policy) == search.simulated_steps > 0


def test_states_are_left_alone(make):
    """Also beliefs in double precision, which no conversion copies."""
    problem = make_problem("tiger")
    given = problem.model
    model = TabularModel(given.transition, given.observation, given.cost, given.discount, dtype=torch.float64)
    first = torch.rand(64, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    y = TensorDict({"belief": torch.stack([first, 1.0 - first], -1) * (1.0 + 1e-8)}, [64])
    before, key = y["belief"].clone(), model.fingerprint(y)
    make(model, None, simulations=2)(y)
    assert torch.equal(y["belief"], before)
    assert torch.equal(model.fingerprint(y), key)
