from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_pomdp.evaluation import discounted_costs, estimate
from torchrl_pomdp.problems.check import check_belief_model
from torchrl_pomdp.problems.classic import WhenProbable, crying_baby, tiger
from torchrl_pomdp.trainers import PolicyIterationConfig, api

FEED, IGNORE = 0, 1
# Few samples and small networks: a policy of one number has little to learn.
QUICK = PolicyIterationConfig(
    iterations=1, samples_per_part=400, trajectories=8, hidden=(32, 16), value_samples=1, least_steps=300, epochs=1,
    validation_states=600,
)  # fmt: skip


def mean_cost(problem, policy, count=4000):
    return estimate(discounted_costs(problem.model, policy, problem.start, num_states=count, seed=9, max_steps=200))


def baby(hungry):
    return TensorDict({"belief": torch.tensor([[1.0 - hungry, hungry]], dtype=torch.float32)}, [1])


def outcomes(model):
    """P(next state, observation | state, control), ``[n, U, n, Z]``, from the model at certain beliefs."""
    joint = torch.zeros(2, model.num_controls, 2, model.num_observations, dtype=torch.float64)
    for state, u, z in torch.cartesian_prod(torch.arange(2), torch.arange(model.num_controls), torch.arange(2)).tolist():
        y, control = baby(float(state)), torch.tensor([u])
        chance = model.observation_probs(y, control)[0, z]
        joint[state, u, :, z] = chance * model.estimator(y, control, torch.tensor([z]))["belief"][0]
    return joint


def test_baby_that_cries_after_it_was_ignored():
    nxt = crying_baby().model.estimator(baby(0.0), torch.tensor([IGNORE]), torch.tensor([0]))
    assert nxt["belief"][0, 1].item() == pytest.approx(0.470588, abs=1e-6)


@pytest.mark.parametrize(("control", "full", "hungry"), [(FEED, -50.0, -60.0), (IGNORE, -47.37, -100.0)])
def test_rewards_of_feeding_always_and_never(control, full, hungry):
    problem = crying_baby()
    policy = WhenProbable(problem.model, control)
    for reward, start in ((full, 0.0), (hungry, 1.0)):
        cost = discounted_costs(
            problem.model, policy, lambda keys, p=start: baby(p).expand(keys.shape), num_states=4000, max_steps=200
        )
        assert -cost.mean().item() == pytest.approx(reward, rel=0.02)


def test_rewards_of_feeding_when_it_cries():
    """The observation of a state decides, so the values of the states satisfy two linear equations."""
    model = crying_baby().model
    joint, cost = outcomes(model), model.cost.double()
    # P(observation | state): one that was ignored shows it with what it did not become.
    seen = joint[:, IGNORE].sum(0) / joint[:, IGNORE].sum((0, 2)).unsqueeze(-1)
    move, stage = torch.zeros(2, 2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    for state in range(2):
        for z, u in ((0, FEED), (1, IGNORE)):
            move[state] += seen[state, z] * joint[state, u].sum(-1)
            stage[state] += seen[state, z] * cost[u, state]
    value = -torch.linalg.solve(torch.eye(2, dtype=torch.float64) - model.discount * move, stage)
    assert value.tolist() == pytest.approx([-17.14, -32.11], abs=0.1)


def test_optimum_of_the_crying_baby_is_met_by_a_threshold():
    problem = crying_baby()
    best = mean_cost(problem, WhenProbable(problem.model, FEED, state=1, threshold=0.28, otherwise=IGNORE), 20_000)
    assert abs(best.mean - 16.3) < 0.02 + 4 * best.standard_error
    assert best.mean < mean_cost(problem, problem.base_policies["hungry"]).mean


@pytest.mark.parametrize("make", [tiger, crying_baby])
def test_models_keep_what_they_promise(make):
    problem = make()
    check_belief_model(problem.model, problem.start)


def test_base_policies_of_tiger():
    problem = tiger()
    y = TensorDict({"belief": torch.tensor([[0.5, 0.5], [0.02, 0.98], [0.98, 0.02]])}, [3])
    named = {
        name: [problem.model.control_names[u] for u in policy(y)["action"]] for name, policy in problem.base_policies.items()
    }
    assert problem.baseline == "listen"
    assert named == {"listen": ["listen"] * 3, "myopic": ["listen", "open left", "open right"]}


def test_policy_iteration_solves_tiger_from_a_poor_policy():
    problem = tiger().unpartitioned()
    base = problem.base_policies["listen"]
    run = api(problem, QUICK, base)
    assert [iteration.accepted for iteration in run] == [True]
    best = mean_cost(problem, run.best, 5000)
    assert mean_cost(problem, base, 10).mean > 19.0
    assert abs(-best.mean - 19.371) < 0.02 * 19.371


def test_policy_iteration_improves_how_the_baby_is_fed():
    problem = crying_baby().unpartitioned()
    run = api(problem, QUICK, problem.base_policies["hungry"])
    assert [iteration.accepted for iteration in run] == [True]
    assert mean_cost(problem, run.best).mean < mean_cost(problem, problem.base_policies["hungry"]).mean


def test_wrong_thresholds_are_named():
    model = tiger().model
    with pytest.raises(ValueError, match="control must be at most 2, got 3"):
        WhenProbable(model, 3)
    with pytest.raises(ValueError, match="state must be at most 1, got 2"):
        WhenProbable(model, 0, 2)
    with pytest.raises(ValueError, match=r"threshold must be in \[0, 1\], got 1.5"):
        WhenProbable(model, 0, threshold=1.5)
