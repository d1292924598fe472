"""Old policies in changed models: what they do there, and what rollout with them is worth."""

from __future__ import annotations

import pytest
import torch
from _oracles import random_states, small_model

from torchrl_pomdp.envs.repair import UniformStart, grid, line
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import RolloutPolicy
from torchrl_pomdp.modules.repair import OldPolicy, UrgencyRepair


def test_in_the_same_model_it_is_the_policy():
    model = small_model(line(4), num_robots=2)
    y = random_states(model, 50, 0)
    policy = UrgencyRepair(model)
    assert torch.equal(OldPolicy(policy, model, model)(y.clone())["action"], policy(y.clone())["action"])
    assert OldPolicy(policy, model, model)(y[0].clone())["action"].shape == ()


def test_a_blocked_edge_is_not_taken():
    old, new = small_model(grid(3, 2)), small_model(grid(3, 2).without_edge(0, 1))
    y = random_states(new, 200, 0)
    before, u = UrgencyRepair(old)(y.clone())["action"], OldPolicy(UrgencyRepair(old), old, new)(y.clone())["action"]
    legal = new.action_mask(y).gather(-1, before.unsqueeze(-1)).squeeze(-1)
    assert torch.equal(u[legal], before[legal])
    assert not legal.all()
    assert torch.equal(u[~legal], new.action_mask(y)[~legal].int().argmax(-1))


def test_a_lost_robot_stands_where_it_broke_down():
    old, new = small_model(line(4), num_robots=3), small_model(line(4), num_robots=2)
    y = random_states(new, 50, 1)
    seen = y.clone().set("location", torch.cat([y["location"][:, :1], torch.full((50, 1), 3), y["location"][:, 1:]], -1))
    expected = old.split_controls(UrgencyRepair(old)(seen)["action"])[:, [0, 2]]
    found = OldPolicy(UrgencyRepair(old), old, new, lost=1, place=3)(y.clone())["action"]
    legal = new.agent_mask(y).gather(-1, expected.unsqueeze(-1)).squeeze(-1).all(-1)
    assert legal.any()
    assert torch.equal(new.split_controls(found)[legal], expected[legal])


def test_rollout_adapts_to_a_wall():
    """A grid whose middle is blocked but for a long way round: the old policy walks against the wall."""
    graph = grid(4, 2).without_edge(1, 2)
    old, new = small_model(grid(4, 2), dtype=torch.float32), small_model(graph, dtype=torch.float32)
    policy, start = OldPolicy(UrgencyRepair(old), old, new), UniformStart(new, (0,))
    costs = [discounted_costs(new, each, start, num_states=200, seed=0) for each in (RolloutPolicy(new, policy), policy)]
    ratio = compare(*costs).ratio
    assert ratio.mean + 1.96 * ratio.standard_error < 1.0


def test_models_that_do_not_fit_are_refused():
    old = small_model(line(4), num_robots=2)
    policy = UrgencyRepair(old)
    with pytest.raises(ValueError, match="new must have as many locations as old, got 3 for 4"):
        OldPolicy(policy, old, small_model(line(3), num_robots=2))
    with pytest.raises(ValueError, match="new must have as many robots that are left as old, got 2 for 1"):
        OldPolicy(policy, old, old, lost=0)
    with pytest.raises(ValueError, match="place is that of a lost robot, got 2 without one"):
        OldPolicy(policy, old, old, place=2)
    with pytest.raises(ValueError, match="as many levels"):
        OldPolicy(policy, old, small_model(line(4), num_robots=2, degradation=(0.1,), costs=(0.0, 1.0)))
