"""Base policies against their definitions, row by row, and against an independent simulation."""

from __future__ import annotations

import pytest
import torch
from _oracles import random_states, small_model
from tensordict import TensorDict

from torchrl_pomdp.envs.repair import REPAIR, Graph, RepairModel, damage_chain, grid, line
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import TruncatedRollout
from torchrl_pomdp.modules.repair import GreedyRepair, UrgencyRepair
from torchrl_pomdp.problems import make_problem


def urgency_by_hand(model, belief, places):
    """Robots' controls for one state, from the definition."""
    costs = [sum(float(p) * float(c) for p, c in zip(row, model.costs, strict=True)) for row in belief]
    controls = []
    for place in places:
        distances = model.graph.distances[place].tolist()
        urgency = [cost / (distance + 1) ** 3 for cost, distance in zip(costs, distances, strict=True)]
        target = max(range(len(urgency)), key=lambda i: (urgency[i], -i))
        if urgency[target] == 0:
            controls.append(next(1 + s for s, node in enumerate(model.graph.neighbours[place].tolist()) if node >= 0))
            continue
        costs[target] = 0.0
        step = [
            1 + s
            for s, node in enumerate(model.graph.neighbours[place].tolist())
            if node >= 0 and model.graph.distances[node, target] == distances[target] - 1
        ]
        controls.append(REPAIR if target == place else step[0])
    return controls


@pytest.mark.parametrize(
    ("graph", "robots"), [(line(7), 1), (grid(4, 3), 1), (line(6), 2), (Graph.from_edges("y", 4, [(0, 1), (1, 2), (1, 3)]), 3)]
)
def test_urgency_is_its_definition(graph, robots):
    model = small_model(graph, num_robots=robots)
    y = model.with_features(random_states(model, 150, 0))
    u = UrgencyRepair(model)(y.copy())["action"]
    assert y["action_mask"].gather(1, u.unsqueeze(1)).all(), "urgency is always legal"
    for row in range(150):
        expected = urgency_by_hand(model, y["belief"][row], y["location"][row].tolist())
        assert model.split_controls(u)[row].tolist() == expected


def test_robots_that_stand_together_go_to_different_places():
    model = small_model(line(5), num_robots=2)
    belief = torch.eye(3, dtype=model.dtype)[torch.tensor([1, 0, 0, 0, 1])].unsqueeze(0)
    y = model.with_features(random_states(model, 1, 0).set("belief", belief).set("location", torch.tensor([[2, 2]])))
    left, right = 1, 2
    assert model.split_controls(UrgencyRepair(model)(y)["action"]).tolist() == [[left, right]]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("costs", "levels", "repairs"),
    [
        # A tenth here, and 100 at distance 9; 1 here, and 27 and 125 at distances 2 and 4: the lower index.
        ((0.0, 0.1, 1.0, 10.0, 100.0), {0: 1, 9: 4}, True),
        ((0.0, 1.0, 8.0, 27.0, 125.0), {0: 1, 2: 3, 4: 4}, True),
        ((0.5, 1.0, 1.5, 10.5, 500.5), {0: 1, 9: 4}, True),
        ((0.0, 0.1, 1.0, 10.0, 101.0), {0: 1, 9: 4}, False),
    ],
)
def test_ties_go_to_the_lower_index_by_tensors_and_by_loop(costs, levels, repairs, dtype):
    model = RepairModel(line(20), damage_chain((0.0, 0.1, 0.2, 0.3)), costs, 0.95, dtype=dtype)
    known = torch.zeros(20, dtype=torch.int64)
    for place, level in levels.items():
        known[place] = level
    y = TensorDict({"belief": torch.eye(5, dtype=dtype)[known], "location": torch.tensor([0])}).unsqueeze(0)
    policy, keys = UrgencyRepair(model), torch.arange(1)
    assert policy(y.copy())["action"].tolist() == [0 if repairs else 2]
    # One step, which costs the same, and the place after it.
    after = TruncatedRollout(model, policy, max_steps=1, terminal_cost=lambda y: y["location"][:, 0].to(dtype))
    assert after.scalar is not None
    paid = model.expected_cost(y, torch.tensor([0 if repairs else 2]))
    assert torch.allclose(after(y, keys), paid + 0.95 * (0.0 if repairs else 1.0))


@pytest.mark.parametrize(("name", "ratio"), [("linear20", 0.945), ("grid5x4", 0.84), ("grid6x6", 0.91)])
def test_urgency_against_greedy_as_independently_simulated(name, ratio):
    problem = make_problem(name)
    policies = UrgencyRepair(problem.model), GreedyRepair(problem.model)
    costs = [discounted_costs(problem.model, policy, problem.start, num_states=1000) for policy in policies]
    found = compare(*costs).ratio
    assert abs(found.mean - ratio) < 3 * found.standard_error + 0.005


def test_a_negative_exponent_is_refused(line3):
    with pytest.raises(ValueError, match="exponent must not be negative, got -1"):
        UrgencyRepair(line3.model, -1)
