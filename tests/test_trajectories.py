"""Trajectories that are played to be looked at: the truth, the noise, the costs."""

from __future__ import annotations

import pytest
import torch

from torchrl_pomdp.envs import BeliefModel, FixedBelief, TabularModel
from torchrl_pomdp.modules import RolloutPolicy
from torchrl_pomdp.noise import seed_keys
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.trajectories import has_world, play

KEYS = seed_keys(5, torch.arange(3))


@pytest.mark.parametrize("name", ["line3", "two_robots20", "tiger", "rocksample7x8", "maintenance1"])
def test_trajectories_follow_the_model_and_its_world(name):
    problem = make_problem(name)
    model, world = problem.model, problem.model.world()
    policy = problem.base_policies[problem.baseline]
    played = play(model, policy, problem.start(KEYS), KEYS, max_steps=6)
    stages = played.batch_size[1]
    assert played.batch_size == (3, stages)
    over = torch.zeros(3, dtype=torch.bool)
    for stage in range(stages):
        now = played[:, stage]
        y = now.select(*model.state_keys)
        assert torch.equal(now["action_mask"], model.action_mask(y))
        over |= model.is_terminal(y)
        assert torch.equal(now["cost"], model.expected_cost(y, now["action"]).masked_fill(over, 0.0))
        model.check_state(now["next"])
        world.check_hidden(now["next", "hidden"])
        if stage + 1 < stages:
            for key in (*model.state_keys, *(("hidden", key) for key in world.hidden_spec())):
                assert torch.equal(now["next"][key], played[:, stage + 1][key])
    if name == "line3":
        # The hidden level is never one that is known to be impossible.
        for each in (played, played["next"]):
            assert bool((each["belief"].gather(-1, each["hidden", "level"].unsqueeze(-1)) > 0).all())


def test_policies_meet_the_same_noise(linear20):
    model, bases = linear20.model, linear20.base_policies
    y = linear20.start(KEYS)
    one, other = (play(model, bases[name], y, KEYS, max_steps=20) for name in ("greedy", "urgency"))
    assert torch.equal(one[:, 0]["hidden", "level"], other[:, 0]["hidden", "level"])
    levels, theirs = (each["hidden", "level"] for each in (one, other))
    # Until a location is repaired by one of them, it wears alike.
    untouched = ((levels.diff(dim=1) >= 0).cumprod(1) * (theirs.diff(dim=1) >= 0).cumprod(1)).bool()
    assert int(untouched.sum()) > 500
    assert torch.equal(levels[:, 1:][untouched], theirs[:, 1:][untouched])
    alone = play(model, bases["greedy"], y[1], KEYS[1], max_steps=20)
    assert torch.equal(alone["hidden", "level"], one[1]["hidden", "level"])


def test_a_trajectory_ends_where_it_is_terminal_and_costs_what_it_costs(line3):
    keys = seed_keys(5, torch.arange(20))
    y = line3.start(keys)
    played = play(line3.model, line3.base_policies["greedy"], y, keys)
    assert played.batch_size[1] < 100
    assert bool(line3.model.is_terminal(played[:, -1]["next"].select(*line3.model.state_keys)).all())
    lengths = [play(line3.model, line3.base_policies["greedy"], y[i], keys[i]).batch_size[0] for i in range(20)]
    assert max(lengths) == played.batch_size[1]
    assert min(lengths) < max(lengths)
    for i, length in enumerate(lengths):
        assert bool((played["cost"][i, length:] == 0).all())


def test_costs_are_those_of_evaluations_on_average(line3):
    keys = seed_keys(1, torch.arange(4000))
    played = play(line3.model, line3.base_policies["greedy"], line3.start(keys), keys)
    discounts = line3.model.discount ** torch.arange(played.batch_size[1])
    # As the test of TruncatedRollout has it.
    assert (played["cost"] * discounts).sum(-1).mean() == pytest.approx(195, abs=10)


def test_rollout_shows_its_q_factors(line3):
    policy = RolloutPolicy(line3.model, line3.base_policies["greedy"], trajectories=2)
    played = play(line3.model, policy, line3.start(KEYS), KEYS, max_steps=2)
    assert torch.equal(played["q_factors"].argmin(-1), played["action"])


def test_a_model_without_hidden_states_can_be_played():
    class Seen(TabularModel):
        world = BeliefModel.world

    tables = torch.tensor([[[0.9, 0.1], [0.0, 1.0]]]), torch.tensor([[[0.8, 0.2], [0.3, 0.7]]]), torch.tensor([[0.0, 5.0]])
    model = Seen(*tables, 0.9)
    start = FixedBelief(torch.tensor([1.0, 0.0]))
    assert not has_world(model)
    first = lambda y: y.set("action", torch.zeros(y.batch_size, dtype=torch.int64))  # noqa: E731
    played, again = (play(model, first, start(KEYS), KEYS, max_steps=4) for _ in range(2))
    assert "hidden" not in played
    assert torch.equal(played["belief"], again["belief"])
    assert len(set(played["belief"][:, -1, 0].tolist())) > 1, "each key has its own noise"


def test_an_illegal_control_is_refused(line3):
    left = lambda y: y.set("action", torch.ones(y.batch_size, dtype=torch.int64))  # noqa: E731
    with pytest.raises(ValueError, match="action"):
        play(line3.model, left, line3.start(KEYS), KEYS)
