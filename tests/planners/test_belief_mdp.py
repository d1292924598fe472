"""Reachable beliefs as a finite decision problem, against the model's own functions and against known costs of policies."""

from __future__ import annotations

import pytest
import torch

from torchrl_pomdp.envs import FixedBelief, TabularModel
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


@pytest.mark.parametrize("turned", [False, True])
def test_beliefs_of_other_states_are_others_however_near(turned):
    """What is possible decides what is legal; the answer must not depend on how controls are numbered."""
    rare = 1e-13
    moves = torch.zeros(2, 3, 3, dtype=torch.float64)
    moves[0, 0, 2] = moves[0, 1, 1] = moves[1, 1, 1] = moves[0, 2, 2] = moves[1, 2, 2] = 1.0
    moves[1, 0, 1], moves[1, 0, 2] = rare, 1.0 - rare
    cost = torch.tensor([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    legal = torch.tensor([[True, True], [True, False], [True, True]])
    if turned:
        moves, cost, legal = moves.flip(0), cost.flip(0), legal.flip(1)
    seen = torch.ones(2, 3, 1, dtype=torch.float64)
    model = TabularModel(moves, seen, cost, 0.9, legal=legal, dtype=torch.float64)
    # Free first, then for ever where control 0 alone is certain to be legal: 10 from there; or 1 and then nothing.
    assert float(belief_mdp(model, torch.eye(3)[0]).optimal_cost()[0]) == pytest.approx(1.0)


@pytest.mark.parametrize("size", [1e-14, 1e-6, 1e6])
def test_optima_grow_with_the_costs(size):
    model = random_model(4)
    smaller = TabularModel(
        model.transition, model.observation, model.cost * size, model.discount, legal=model.legal, dtype=model.dtype
    )
    one, other = (belief_mdp(each, torch.eye(model.num_states)[0]).optimal_cost() for each in (model, smaller))
    assert torch.allclose(other / size, one, rtol=1e-5)
