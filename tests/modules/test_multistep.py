"""Multistep lookahead against its definition, written as a recursion over single states, and against exact optima."""

from __future__ import annotations

import pytest
import torch
from _oracles import LINE3_OPTIMUM, Memo, line3_cost, random_states, small_model

from torchrl_pomdp.envs.repair import line
from torchrl_pomdp.modules import AfterSteps, MultistepLookahead, RolloutPolicy
from torchrl_pomdp.modules.repair import GreedyRepair, SteadyStateCost
from torchrl_pomdp.problems import tiger


def recursion(model, y, depth):
    """Q-factors of one state by the definition; below the last step the steady-state cost."""
    terminal = SteadyStateCost(model)
    q = []
    for u in range(model.num_controls):
        if not model.action_mask(y)[0, u]:
            q.append(float("inf"))
            continue
        control = torch.tensor([u])
        total = float(model.expected_cost(y, control))
        for z, p in enumerate(model.observation_probs(y, control)[0].tolist()):
            if p > 0:
                nxt = model.estimator(y, control, torch.tensor([z]))
                if not model.is_terminal(nxt):
                    rest = min(recursion(model, nxt, depth - 1)) if depth > 1 else float(terminal.costs(nxt))
                    total += model.discount * p * rest
        q.append(total)
    return q


def at_once(model, **options):
    """One-step lookahead onto the steady-state cost, without any simulation: exact Q-factors."""
    cut = {"truncation": AfterSteps(0), "terminal_cost": SteadyStateCost(model), "leaves": "observation", "trajectories": 1}
    return RolloutPolicy(model, GreedyRepair(model), **cut, **options)


@pytest.mark.parametrize("depth", [1, 2, 3])
@pytest.mark.parametrize("robots", [1, 2])
def test_q_factors_are_those_of_the_definition(depth, robots):
    if (depth, robots) == (3, 2):
        pytest.skip("the recursion over single states takes minutes")
    model = small_model(line(3), num_robots=robots)
    y = random_states(model, 4, seed=robots)
    q = MultistepLookahead(at_once(model), depth, branches=9).q_factors(y)
    expected = [recursion(model, y[i : i + 1], depth) for i in range(4)]
    torch.testing.assert_close(q, torch.tensor(expected, dtype=q.dtype))


def test_two_steps_are_at_least_as_good_as_one_on_the_line_of_3(line3):
    model = line3.model
    rollout = RolloutPolicy(model, GreedyRepair(model), trajectories=60)
    one, two = (line3_cost(model, Memo(model, policy))[0] for policy in (rollout, MultistepLookahead(rollout, 2)))
    assert LINE3_OPTIMUM[0] - 0.05 <= two <= one + 0.05
    assert two < line3_cost(model, GreedyRepair(model))[0] - 10


def test_dominated_controls_are_pruned(line3):
    """By hand: which controls are kept, what they are worth then, and that pruning saves simulations."""
    model = small_model(line(3))
    y = random_states(model, 40, seed=3)
    one, margin = at_once(model).q_factors(y), 0.05
    kept = one <= 1.05 * one.amin(-1, keepdim=True)
    assert int((~kept & torch.isfinite(one)).sum()) > 0
    pruned = MultistepLookahead(at_once(model), 2, branches=3, margin=margin).q_factors(y)
    assert torch.equal(torch.isfinite(pruned), kept)
    expected = torch.tensor([recursion(model, row, 2) for row in y.split(1)], dtype=pruned.dtype)
    torch.testing.assert_close(pruned[kept], expected[kept], rtol=1e-4, atol=1e-12)
    y = line3.start(torch.arange(50))
    steps, actions = [], []
    for margin in (None, 1e6, 0.02):
        rollout = RolloutPolicy(line3.model, GreedyRepair(line3.model), trajectories=10)
        actions.append(MultistepLookahead(rollout, 3, margin=margin)(y.clone())["action"])
        steps.append(rollout.simulated_steps)
    assert torch.equal(actions[0], actions[1])
    assert steps[2] < 0.7 * steps[0]


def test_two_steps_with_pruning_are_at_least_as_good_as_one_on_the_line_of_3(line3):
    model = line3.model
    rollout = RolloutPolicy(model, GreedyRepair(model), trajectories=20)
    one, two = (line3_cost(model, Memo(model, p))[0] for p in (rollout, MultistepLookahead(rollout, 2, margin=0.1)))
    assert LINE3_OPTIMUM[0] - 0.05 <= two <= one + 0.3


def test_decisions_do_not_depend_on_the_batch(linear20):
    y = linear20.start(torch.arange(6))
    policy = MultistepLookahead(RolloutPolicy(linear20.model, GreedyRepair(linear20.model), trajectories=2), 2, branches=3)
    whole = policy.q_factors(y)
    assert torch.equal(torch.cat([policy.q_factors(rows) for rows in y.split(1)]), whole)
    assert torch.equal(policy(y.reshape(2, 3).clone())["q_factors"], whole.view(2, 3, 3))


def test_drawn_branches_are_right_on_average():
    model = small_model(line(3))
    y = random_states(model, 6, seed=5)
    exact = MultistepLookahead(at_once(model), 2, branches=3).q_factors(y)
    drawn = torch.stack([MultistepLookahead(at_once(model, seed=seed), 2, branches=2).q_factors(y) for seed in range(400)])
    assert not torch.equal(drawn[0], exact)
    legal = torch.isfinite(exact)
    error = (drawn.mean(0) - exact)[legal].abs()
    assert (error <= 4 * drawn.std(0)[legal] / 20 + 1e-9).all()


def test_tiger_listens_until_it_knows():
    model = tiger().model

    def listen(y):
        return y.set("action", torch.zeros(y.batch_size, dtype=torch.int64))

    rollout = RolloutPolicy(model, listen, trajectories=1, leaves="observation", max_steps=80)
    y = model.with_features(random_tiger([0.5, 0.85, 0.998, 0.002]))
    assert MultistepLookahead(rollout, 3)(y)["action"].tolist() == [0, 0, 2, 1]


def random_tiger(left):
    from tensordict import TensorDict

    left = torch.tensor(left)
    return TensorDict({"belief": torch.stack([left, 1 - left], -1)}, [len(left)])


def test_bad_arguments_are_refused(line3):
    rollout = RolloutPolicy(line3.model, GreedyRepair(line3.model))
    with pytest.raises(ValueError, match="depth must be 1, 2 or 3, got 4"):
        MultistepLookahead(rollout, 4)
    with pytest.raises(ValueError, match="branches must be at least 1, got 0"):
        MultistepLookahead(rollout, 2, branches=0)
    with pytest.raises(ValueError, match="margin must not be negative"):
        MultistepLookahead(rollout, 2, margin=-0.1)
