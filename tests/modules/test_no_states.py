"""A batch of no states has no controls and no costs, for every module."""

from __future__ import annotations

import pytest
import torch

from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.modules import MultiagentRollout, MultistepLookahead, ParallelRollout, PolicyCost, RolloutPolicy
from torchrl_pomdp.planners import DESPOT, POMCP
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.problems.rocksample import rocksample
from torchrl_pomdp.trainers.architecture import make_networks, make_values

CONFIG = PolicyIterationConfig(hidden=(8,), value_hidden=(8,))
SCHEMES = ("one_at_a_time", "order_optimised", "autonomous")


def policies(problem):
    """Every kind of policy that the problem may have, by name."""
    model, bases = problem.model, list(problem.base_policies.values())
    plain = bases[0]
    found = {**problem.base_policies, "networks": make_networks(problem, CONFIG, 0)}
    if model.num_agents > 1:
        cut = {"trajectories": 2, "max_steps": 2, "terminal_cost": problem.pessimistic_cost}
        found |= {scheme: MultiagentRollout(model, plain, scheme=scheme, **cut) for scheme in SCHEMES}
    if not model.enumerable:
        return found
    rollout = RolloutPolicy(model, plain, trajectories=2)

    def twinless(y):
        return plain(y)

    found |= {
        "rollout": rollout,
        "adaptive": RolloutPolicy(model, plain, allocation="adaptive"),
        "in time": RolloutPolicy(model, plain, seconds=0.01),
        "rollout without a twin": RolloutPolicy(model, twinless, trajectories=2),
        "rollout of networks": RolloutPolicy(model, found["networks"], trajectories=2),
        "several bases": ParallelRollout([rollout, rollout]),
    }
    if model.num_observations <= 256:
        found["two steps"] = MultistepLookahead(rollout, depth=2)
    if problem.name == "line3":
        found |= {"POMCP": POMCP(model, plain, simulations=5), "DESPOT": DESPOT(model, plain, simulations=5, scenarios=5)}
    return found


@pytest.mark.parametrize("name", ["line3", "two_robots20", "network32x8", "tiger", "rocksample-4-3", "maintenance1"])
def test_no_states_have_no_controls_and_no_costs(name):
    problem = rocksample(4, 3) if name == "rocksample-4-3" else make_problem(name)
    model = problem.model
    for shape in ((0,), (2, 0)):
        y = model.derive(problem.start(torch.arange(0).view(shape)))
        for kind, policy in policies(problem).items():
            with torch.no_grad():
                action = policy(y.clone())["action"]
            assert action.shape == (*shape, *model.control_shape), kind
        values = make_values(problem, CONFIG, 0)
        simulated = PolicyCost(
            model, next(iter(problem.base_policies.values())), max_steps=5, terminal_cost=problem.pessimistic_cost
        )
        for cost in (problem.pessimistic_cost, values, simulated):
            with torch.no_grad():
                assert cost(y).shape == shape
