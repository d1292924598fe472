"""Many agents: one decides after the other; what is counted, what is legal, and what it is worth."""

from __future__ import annotations

from functools import partial
from itertools import product

import pytest
import torch
from _oracles import COSTS, random_states, varied_model

from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.envs.repair import RepairModel, UniformStart, damage_chain, grid, line
from torchrl_pomdp.envs.repair.tabular import joint_belief, tabular_model
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import MultiagentRollout, MultistepLookahead, Myopic, RolloutPolicy
from torchrl_pomdp.modules.repair import GreedyRepair, SteadyStateCost, UrgencyRepair
from torchrl_pomdp.planners import DESPOT, POMCP, solve
from torchrl_pomdp.problems import check_belief_model, make_problem
from torchrl_pomdp.trainers import ppo

SCHEMES = ("one_at_a_time", "order_optimised", "autonomous")


class ByTensors:
    """A policy without a twin: tensors simulate."""

    def __init__(self, policy):
        self.policy, self.in_keys = policy, policy.in_keys

    def __call__(self, y):
        return self.policy(y)


@pytest.fixture(scope="module")
def two():
    """Two robots on a line of 3, their locations uniform a priori."""
    return RepairModel(line(3), damage_chain((0.0, 0.02, 0.03, 0.05)), COSTS, 0.95, num_robots=2, dtype=torch.float64)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", ["line3", "tiger"])
@pytest.mark.parametrize("options", [{}, {"allocation": "adaptive", "trajectories": 30}, {"leaves": "observation"}])
def test_of_one_agent_all_are_ordinary_rollout_to_the_last_bit(name, scheme, options):
    problem = make_problem(name)
    base = problem.base_policies[problem.baseline]
    y = problem.start(torch.arange(30))
    expected = RolloutPolicy(problem.model, base, **options)(y.clone())
    found = MultiagentRollout(problem.model, base, scheme=scheme, **options)(y.clone())
    assert torch.equal(found["action"], expected["action"])
    assert torch.equal(found["q_factors"].squeeze(1), expected["q_factors"])


@pytest.mark.parametrize("scheme", SCHEMES)
def test_q_factors_are_counted(two, scheme):
    """R·A of a decision, less the illegal ones; of those that are left, in the best order."""
    y = random_states(two, 40, 0)
    legal = two.agent_mask(y).sum(-1)
    policy = MultiagentRollout(two, GreedyRepair(two), scheme=scheme, trajectories=2)
    u = two.split_controls(policy(y.clone())["action"])
    if scheme == "order_optimised":
        # Both at first, and then the one that has not decided.
        assert legal.amin(-1).sum() <= policy.evaluated - legal.sum() <= legal.amax(-1).sum()
    else:
        assert policy.evaluated == legal.sum()
    assert two.agent_mask(y).gather(-1, u.unsqueeze(-1)).all()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_single_state_has_a_single_control(two, scheme):
    y, policy = random_states(two, 3, 0), MultiagentRollout(two, GreedyRepair(two), scheme=scheme, trajectories=2)
    alone, several = policy(y[1].clone()), policy(y.clone())
    assert alone["action"].shape == ()
    assert torch.equal(alone["action"], several["action"][1])
    assert torch.equal(alone["q_factors"], several["q_factors"][1])


@pytest.mark.parametrize("wrap", [lambda policy: policy, ByTensors], ids=["loop", "tensors"])
def test_q_factors_are_those_of_joint_controls(two, wrap):
    """What a robot compares are entries of the joint table, at the others' controls."""
    y = two.with_features(random_states(two, 40, 1))
    base = wrap(GreedyRepair(two))
    joint = RolloutPolicy(two, base, trajectories=5)(y.clone())["q_factors"].view(-1, 3, 3)
    after = two.split_controls(GreedyRepair(two)(y.clone())["action"])
    found = MultiagentRollout(two, base, trajectories=5)(y.clone())
    q, rows = found["q_factors"], torch.arange(40)
    torch.testing.assert_close(q[:, 0], joint[rows, :, after[:, 1]])
    first = q[:, 0].argmin(-1)
    torch.testing.assert_close(q[:, 1], joint[rows, first])
    assert torch.equal(found["action"], 3 * first + q[:, 1].argmin(-1))
    alone = MultiagentRollout(two, base, scheme="autonomous", trajectories=5)(y.clone())["q_factors"]
    torch.testing.assert_close(alone[:, 1], joint[rows, after[:, 0]])
    told = MultiagentRollout(two, base, scheme="autonomous", signalling=UrgencyRepair(two), trajectories=5)(y.clone())
    signalled = two.split_controls(UrgencyRepair(two)(y.clone())["action"])
    torch.testing.assert_close(told["q_factors"][:, 1], joint[rows, signalled[:, 0]])


def test_the_best_order_starts_with_the_smallest_q_factor(two):
    y = two.with_features(random_states(two, 40, 2))
    base = GreedyRepair(two)
    joint = RolloutPolicy(two, base, trajectories=5)(y.clone())["q_factors"].view(-1, 3, 3)
    after = two.split_controls(base(y.clone())["action"])
    u = two.split_controls(MultiagentRollout(two, base, scheme="order_optimised", trajectories=5)(y.clone())["action"])
    for row in range(40):
        one, other = joint[row, :, after[row, 1]], joint[row, after[row, 0]]
        if one.min() <= other.min():
            assert u[row].tolist() == [one.argmin(), joint[row, one.argmin()].argmin()]
        else:
            assert u[row].tolist() == [joint[row, :, other.argmin()].argmin(), other.argmin()]


def test_exact_minimisation_agrees(two):
    """With the Q-factors of the tabular model, by enumeration of all joint controls; optimum between the certified bounds."""
    table = tabular_model(two)
    start = UniformStart(two, (0, 2), observe_start=False)(torch.arange(1))
    values = []
    # The robots look first: one solution for each pair of levels.
    for levels in product(range(5), repeat=2):
        y = start.clone()
        for place, level in zip((0, 2), levels, strict=True):
            y["belief"][0, place] = torch.eye(5, dtype=torch.float64)[level]
        values.append(y)
    states = torch.cat(values)
    solution = solve(table, joint_belief(two, states), relative_gap=0.01, seconds=60)
    generator = UniformStart(two, (0, 2))
    costs = {
        name: discounted_costs(two, policy, generator, num_states=600, seed=1)
        for name, policy in {
            "greedy": GreedyRepair(two),
            "standard": RolloutPolicy(two, GreedyRepair(two), trajectories=10),
            **{scheme: MultiagentRollout(two, GreedyRepair(two), scheme=scheme, trajectories=10) for scheme in SCHEMES},
        }.items()
    }
    for name in ("standard", "one_at_a_time", "order_optimised"):
        result = compare(costs[name], costs["greedy"])
        assert result.ratio.mean + 1.96 * result.ratio.standard_error < 1.0, name
        assert result.cost.mean + 3 * result.cost.standard_error > solution.lower, name
    assert abs(compare(costs["one_at_a_time"], costs["standard"]).ratio.mean - 1) < 0.02
    assert costs["standard"].mean() < 1.05 * solution.upper


@pytest.mark.parametrize("scheme", SCHEMES)
def test_decisions_do_not_depend_on_the_batch(scheme):
    problem = make_problem("network32x8")
    policy = MultiagentRollout(
        problem.model,
        UrgencyRepair(problem.model),
        scheme=scheme,
        trajectories=2,
        max_steps=5,
        terminal_cost=SteadyStateCost(problem.model),
    )
    y = problem.start(torch.arange(6))
    whole = policy(y.clone())
    parts = torch.cat([policy(y[:2].clone()), policy(y[2:].clone())])
    assert torch.equal(whole["q_factors"], parts["q_factors"])
    assert torch.equal(policy(y[3].clone())["action"], whole["action"][3])
    assert whole["action"].shape == (6, 8)
    assert whole["q_factors"].shape == (6, 8, 5)
    assert torch.equal(whole["q_factors"].isinf(), ~problem.model.agent_mask(y))


def test_loop_and_tensors_agree_on_many_robots():
    model = varied_model(grid(3, 2), 6, seed=3, repair_probability=0.7)
    y, base = random_states(model, 20, 0), UrgencyRepair(model)
    options = {"trajectories": 4, "max_steps": 20, "terminal_cost": SteadyStateCost(model)}
    one, other = (MultiagentRollout(model, policy, **options)(y.clone()) for policy in (base, ByTensors(base)))
    same = (one["action"] == other["action"]).all(-1)
    assert same.float().mean() > 0.9
    torch.testing.assert_close(one["q_factors"][same], other["q_factors"][same], rtol=1e-4, atol=1e-6)


def test_too_many_joint_controls_are_never_enumerated():
    problem = make_problem("network32x10")
    model = problem.model
    assert not model.enumerable
    assert model.num_controls == 5**10
    base = GreedyRepair(model)
    for component in (
        partial(RolloutPolicy, model, base),
        partial(POMCP, model, base, simulations=1),
        partial(DESPOT, model, base, simulations=1),
        partial(Myopic, model),
        partial(check_belief_model, model, problem.start),
        partial(ppo, problem, steps=4096),
    ):
        with pytest.raises(ValueError, match=r"which goes through them all, got 5\^10 = 9765625: use "):
            component()
    with pytest.raises(ValueError, match="model must have at most 131072 joint states"):
        tabular_model(model)
    y = model.with_features(problem.start(torch.arange(3)))
    with pytest.raises(ValueError, match=r"num_observations must be at most 4096"):
        model.observation_probs(y, base(y.clone())["action"])
    with pytest.raises(TypeError, match="policy must be a RolloutPolicy"):
        MultistepLookahead(MultiagentRollout(model, base))
    u = base(y.clone())["action"]
    u[1, 9] = 17
    with pytest.raises(ValueError, match=r"action \[.*\] at batch index \(1,\), of agent 9, is illegal; legal there"):
        model.check_controls(y, u)


def test_the_environment_of_many_robots():
    """TorchRL's MultiCategorical actions, drawn legally; the same trajectory as the model's."""
    problem = make_problem("network32x10")
    env = BeliefEnv(problem.model, problem.start, batch_size=(3,), seed=0)
    played = env.rollout(4)
    assert played["action"].shape == (3, 4, 10)
    assert played["action_mask"].gather(-1, played["action"].unsqueeze(-1)).all()
    assert len(played["action"].unique()) == 5
    assert env.action_spec.is_in(played["action"][:, 0])
    assert type(env.action_spec).__mro__[2].__name__ == "MultiCategorical"
    again = BeliefEnv(problem.model, problem.start, batch_size=(3,), seed=0).rollout(4)
    assert torch.equal(played["action"], again["action"])


def test_bad_input_is_refused(two):
    base = GreedyRepair(two)
    with pytest.raises(ValueError, match="scheme must be one of one_at_a_time, order_optimised, autonomous, got 'all'"):
        MultiagentRollout(two, base, scheme="all")
    with pytest.raises(ValueError, match="signalling is for scheme='autonomous', got it for 'one_at_a_time'"):
        MultiagentRollout(two, base, signalling=base)
    policy = MultiagentRollout(two, lambda y: y.set("action", torch.full(y.batch_size, 1)))
    with pytest.raises(ValueError, match="illegal"):
        policy(UniformStart(two, (0, 0))(torch.arange(3)))
