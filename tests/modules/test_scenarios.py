"""Scenarios: uniforms that are uniform and independent, and that couple what different controls find."""

from __future__ import annotations

import torch

from torchrl_pomdp.envs import make_problem
from torchrl_pomdp.modules import GreedyRepair, PolicyCost, RolloutPolicy
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.noise import fold


def group(states, count, seed=0):
    groups = fold(torch.arange(states), seed).repeat_interleave(count)
    members = torch.arange(count).repeat(states)
    return Scenarios(fold(groups, members), groups, members, torch.zeros_like(groups))


def draw(scenarios, age, name, count):
    size = len(scenarios.keys)
    noise, after = scenarios.draw(torch.full((size,), age), torch.full((size, 1), name), count)
    return noise[:, 0], after


def test_first_observations_belong_to_the_variable_later_ones_to_the_step():
    scenarios = group(50, 4)
    early, seen = draw(scenarios, 0, 7, 4)
    assert torch.equal(draw(scenarios, 12, 7, 4)[0], early), "whenever it is observed"
    other, both = draw(seen, 3, 8, 4)
    assert torch.equal(draw(scenarios, 0, 8, 4)[0], other), "and whatever was observed before"
    again, _ = draw(both, 5, 7, 4)
    later, _ = draw(both, 6, 7, 4)
    assert not torch.isclose(again, early).any()
    assert not torch.isclose(again, later).any()


def test_all_uniforms_of_a_trajectory_are_uniform_and_independent():
    scenarios = group(30_000, 3)
    columns = []
    for age, name in enumerate((4, 5, 4, 19, 5, 4)):
        noise, scenarios = draw(scenarios, age, name, 3)
        columns.append(noise.view(-1, 3)[:, 1])
    u = torch.stack(columns).double()
    assert ((u >= 0) & (u < 1)).all()
    for row in u:
        counts = (row * 20).long().bincount(minlength=20)
        assert ((counts - 1500) ** 2 / 1500).sum() < 19 + 5 * (2 * 19) ** 0.5
    assert (torch.corrcoef(u) - torch.eye(6)).abs().max() < 5 / 30_000**0.5


def test_an_estimates_first_observations_lie_one_in_each_slice():
    noise, _ = draw(group(100, 10), 0, 3, 10)
    assert ((noise.view(100, 10) * 10).long().sort(1).values == torch.arange(10)).all()
    other, _ = draw(group(100, 10), 0, 4, 10)
    ranks = [(values.view(100, 10) * 10).long() for values in (noise, other)]
    assert not torch.equal(*ranks), "in another order for another variable"


def test_variables_that_share_a_bit_are_still_independent():
    first, seen = draw(group(2000, 1), 0, 2, 1)
    second, _ = draw(seen, 1, 2 + 63, 1)
    assert float(torch.corrcoef(torch.stack([first, second]))[0, 1].abs()) < 0.1


def test_controls_are_compared_with_a_fraction_of_the_variance(linear20):
    """Scenarios against the same number of trajectories whose noise belongs to steps."""
    model, greedy, y = linear20.model, GreedyRepair(linear20.model), linear20.start(torch.arange(40))

    def variance():
        q = torch.stack([RolloutPolicy(model, greedy, seed=seed).q_factors(y) for seed in range(10)]).double()
        legal = torch.isfinite(q).all(0)
        best = q.mean(0).argmin(-1, keepdim=True).expand(10, -1, 1)
        gaps = q - q.gather(-1, best)
        return float(gaps.var(0)[legal].mean())

    coupled = variance()
    original = type(model).observed
    try:
        # One name for everything: only the very first observation is the scenario's.
        type(model).observed = lambda self, y, u: torch.zeros_like(original(self, y, u))
        by_step = variance()
    finally:
        type(model).observed = original
    assert coupled < 0.4 * by_step


def test_two_robots_have_independent_noise():
    problem = make_problem("two_robots20")
    scenarios = group(20_000, 1)
    noise, _ = scenarios.draw(torch.zeros(20_000, dtype=torch.int64), torch.tensor([[3, 9]]).expand(20_000, 2), 1)
    assert abs(float(torch.corrcoef(noise.T)[0, 1])) < 5 / 20_000**0.5
    y = problem.start(torch.arange(5))
    cost = PolicyCost(problem.model, GreedyRepair(problem.model), trajectories=3)
    assert torch.equal(torch.cat([cost.costs(row) for row in y.split(1)]), cost.costs(y))
