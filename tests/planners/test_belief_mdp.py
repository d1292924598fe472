"""Reachable beliefs as a finite decision problem, against the model's own functions and against known costs of policies."""

from __future__ import annotations

import pytest
import torch

from torchrl_pomdp.envs import FixedBelief
from torchrl_pomdp.evaluation import discounted_costs, estimate
from torchrl_pomdp.planners import belief_mdp
from torchrl_pomdp.problems import tiger
from torchrl_pomdp.problems.random_tabular import random_model

HALF = torch.tensor([0.5, 0.5])


def test_the_beliefs_are_those_of_the_model():
    model = random_model(5)
    mdp = belief_mdp(model, torch.eye(model.num_states)[0])
    y = mdp.states()
    mask = model.action_mask(y)
    assert torch.equal(mask, mdp.cost.isfinite())
    for u in range(model.num_controls):
        legal = mask[:, u].nonzero().squeeze(-1)
        controls, there = torch.full((len(legal),), u), y[legal]
        torch.testing.assert_close(model.expected_cost(there, controls), mdp.cost[legal, u])
        torch.testing.assert_close(model.observation_probs(there, controls), mdp.probs[legal, u])
        row, z = (mdp.probs[legal, u] > 0).nonzero(as_tuple=True)
        after = model.estimator(there[row], controls[row], z)["belief"]
        torch.testing.assert_close(after, mdp.belief[mdp.after[legal[row], u, z]], atol=1e-11, rtol=0)


@pytest.mark.parametrize("seed", range(20, 40))
def test_the_optimum_solves_bellmans_equation(seed):
    model = random_model(seed)
    mdp = belief_mdp(model, torch.eye(model.num_states)[0])
    optimum = mdp.optimal_cost()
    torch.testing.assert_close(mdp.q_factors(optimum).amin(-1), optimum, atol=1e-10, rtol=1e-10)


def test_costs_of_a_policy_are_those_of_the_rollout_engine():
    model = random_model(7)
    start = torch.eye(model.num_states, dtype=torch.float64)[0]
    mdp = belief_mdp(model, start)

    def policy(y):
        scores = torch.arange(model.num_controls) + 2.0 * y["belief"] @ torch.arange(model.num_states).double().sin().unsqueeze(
            -1
        )
        return y.set("action", scores.sin().masked_fill(~model.action_mask(y), torch.inf).argmin(-1))

    controls = policy(mdp.states())["action"]
    assert len(controls.unique()) > 1
    sample = estimate(discounted_costs(model, policy, FixedBelief(start), num_states=2000))
    assert abs(sample.mean - float(mdp.policy_cost(controls)[0])) < 3 * sample.standard_error


def test_too_many_beliefs_are_refused():
    with pytest.raises(ValueError, match=r"belief must lead to at most 5 beliefs \(most\), got more"):
        belief_mdp(tiger().model, HALF, most=5)


def test_illegal_controls_are_refused():
    mdp = belief_mdp(tiger().model, HALF)
    with pytest.raises(ValueError, match=r"controls must be legal controls, got 7 at belief 0; legal there: \[0, 1, 2\]"):
        mdp.policy_cost(torch.full((len(mdp),), 7))
