"""The controller on real streams of observations: it knows what the transform knows, and pays what is expected."""

from __future__ import annotations

import pytest
import torch
from _oracles import line3_cost
from torchrl.envs import TransformedEnv

from torchrl_pomdp.controller import Controller
from torchrl_pomdp.envs import TrackBelief, WorldEnv
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.problems import make_problem


def play(model, policy, start, episodes, stages, acting):
    """Episodes, the first of which have a controller each; realised and expected discounted costs ``[N]``."""
    env = TransformedEnv(WorldEnv(model, start, batch_size=(episodes,), seed=5), TrackBelief(model))
    td, controllers = env.reset(), [Controller(model, policy) for _ in range(acting)]
    for controller, y in zip(controllers, td[:acting].select(*model.state_keys).unbind(0), strict=True):
        controller.reset(y)
    realised, expected, weight = torch.zeros(episodes), torch.zeros(episodes), 1.0
    for _ in range(stages):
        over = td["terminated"].squeeze(-1)
        live = (~over).nonzero().flatten().tolist()
        if not live:
            break
        u = policy(td.copy())["action"]
        watched = [i for i in live if i < acting]
        assert all(controllers[i].act().control == int(u[i]) for i in watched)
        expected += weight * model.expected_cost(td, u).masked_fill(over, 0.0)
        td = env.step(td.set("action", u))["next"]
        realised -= weight * td["reward"].squeeze(-1)
        seen = told(model, td["observation"])
        for i in watched:
            controllers[i].update(int(u[i]), seen[i])
        if watched:
            check(model, [controllers[i] for i in watched], td[torch.tensor(watched)])
        td, weight = td.exclude("reward"), weight * model.discount
    return realised, expected, controllers


def told(model, z):
    """Observations as a controller takes them: of several robots the level that each one sees."""
    robots = getattr(model, "num_robots", 1)
    if robots == 1:
        return z.tolist()
    levels = [z // model.num_levels**power % model.num_levels for power in range(robots - 1, -1, -1)]
    return torch.stack(levels, -1).tolist()


def check(model, controllers, y):
    """The controllers know the feature states ``y`` to the last bit, and whether all is over."""
    known = torch.stack([controller.state for controller in controllers])
    for key in model.state_keys:
        assert torch.equal(known[key], y[key])
    assert torch.equal(model.is_terminal(known), y["terminated"].squeeze(-1))


def test_a_thousand_episodes(line3):
    """Realised costs have the mean of the expected ones, episode by episode, and that of the exact cost of the policy."""
    model, greedy = line3.model, GreedyRepair(line3.model)
    realised, expected, controllers = play(model, greedy, line3.start, 1000, 400, acting=150)
    assert all(controller.finished for controller in controllers)
    apart = realised - expected
    assert float(apart.std()) > 10.0, "costs are realised"
    assert abs(float(apart.mean())) <= 4.0 * float(apart.std()) / 1000**0.5
    exact, _ = line3_cost(model, greedy)
    assert abs(float(realised.mean()) - exact) <= 4.0 * float(realised.std()) / 1000**0.5


@pytest.mark.parametrize(
    ("name", "episodes", "stages"),
    [
        ("linear20", 4, 30),
        ("two_robots20", 4, 30),
        ("rocksample7x8", 4, 30),
        ("maintenance3", 4, 50),
        ("tiger", 4, 15),
    ],
)
def test_controllers_that_act_themselves(name, episodes, stages):
    problem = make_problem(name)
    policy = problem.base_policies[problem.baseline]
    _, _, controllers = play(problem.model, policy, problem.start, episodes, stages, acting=episodes)
    assert max(controller.steps for controller in controllers) > 8
