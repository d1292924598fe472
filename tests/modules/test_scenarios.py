"""Scenarios: uniforms that are uniform and independent, and that couple what different controls find."""

from __future__ import annotations

import itertools
import statistics

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite

from torchrl_pomdp.envs import BeliefModel
from torchrl_pomdp.envs.repair import RepairModel, UniformStart, damage_chain, line
from torchrl_pomdp.modules import PolicyCost, RolloutPolicy, TruncatedRollout, ZeroCost
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.noise import fold, permuted
from torchrl_pomdp.problems import make_problem


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


class Coins(BeliefModel):
    """Two fair coins, seen each time; it costs 1 where both show heads."""

    state_keys = ("belief",)
    num_controls, num_observations, noise_dim = 1, 4, 2
    device, dtype = torch.device("cpu"), torch.float32

    def state_spec(self, batch_size=()):
        return Composite(belief=Bounded(0.0, 1.0, shape=(*batch_size, 4)), shape=batch_size)

    def action_mask(self, y):
        return torch.ones(*y.batch_size, 1, dtype=torch.bool)

    def expected_cost(self, y, u):
        return y["belief"][..., 3]

    def observation_probs(self, y, u):
        return torch.full((*y.batch_size, 4), 0.25)

    def estimator(self, y, u, z):
        return self.successor(y, belief=torch.eye(4)[z])

    def advance(self, y, u, noise):
        heads = (noise < 0.5).long()
        return self.expected_cost(y, u), self.estimator(y, u, 2 * heads[..., 0] + heads[..., 1])


def test_the_uniforms_of_a_model_of_ones_own_are_independent():
    model = Coins(0.5)
    y = TensorDict({"belief": torch.eye(4)[:1].expand(4000, 4)}, [4000])
    nothing = lambda y: y.set("action", torch.zeros(y.batch_size, dtype=torch.int64))  # noqa: E731
    costs = TruncatedRollout(model, nothing, max_steps=2, terminal_cost=ZeroCost())(y, torch.arange(4000))
    # Half of a quarter.
    assert abs(costs.mean() - 0.125) < 4 * 0.5 * (0.1875 / 4000) ** 0.5


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
        policies = [RolloutPolicy(model, greedy, seed=seed) for seed in range(10)]
        for policy in policies:
            # What is observed is changed below, for tensors.
            policy.cost_to_go.scalar = None
        q = torch.stack([policy.q_factors(y) for policy in policies]).double()
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


def spread_over_seeds(count):
    """Mean and standard deviation, over 24 seeds, of the cost of greedy at one state by ``count`` trajectories."""
    model = RepairModel(line(3), damage_chain((0.0, 0.3)), (0.0, 1.0, 10.0), 0.9, terminal_probability=0.0, dtype=torch.float64)
    y, never = UniformStart(model, (1,))(torch.tensor([0])), NeverRepairCost(model)
    options = {"trajectories": count, "max_steps": 4, "terminal_cost": never}
    costs = [float(PolicyCost(model, GreedyRepair(model), seed=seed, **options).costs(y)) for seed in range(24)]
    return statistics.mean(costs), statistics.stdev(costs)


def test_estimates_converge_on_an_instance_that_is_not_additive():
    """The cost depends on two first observations together; independent trajectories spread by 33.9 / sqrt(n)."""
    counts = (10, 100, 1000, 10_000)
    means, spreads = zip(*map(spread_over_seeds, counts), strict=True)
    assert spreads[0] < 10.7
    for count, mean, spread in zip(counts, means, spreads, strict=True):
        # The spread itself is known to about 15 %.
        assert spread < 1.5 * 33.9 / count**0.5
        assert spread < 1.5 * spreads[0] * (10 / count) ** 0.5
        assert abs(mean - 52.2) < 4 * spread / 24**0.5 + 0.05


def permutations(keys, count):
    """Places of all members under every key, ``[K, count]``."""
    members = torch.arange(count)
    return permuted(keys.unsqueeze(-1).expand(-1, count).reshape(-1), members.repeat(len(keys)), count).view(-1, count)


def chi_square(cells, size):
    """Whether all ``size`` values of ``cells`` are equally likely, five standard deviations allowed."""
    expected = len(cells) / size
    statistic = float(((cells.bincount(minlength=size) - expected) ** 2 / expected).sum())
    return statistic < size - 1 + 5 * (2 * (size - 1)) ** 0.5


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 7, 10, 17, 64, 100, 1000, 4097])
def test_places_are_a_permutation(count):
    places = permutations(fold(torch.arange(20), count), count)
    assert torch.equal(places.sort(-1).values, torch.arange(count).expand(20, count))
    assert count < 5 or len({tuple(row) for row in places.tolist()}) == 20


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_all_permutations_are_equally_likely(count):
    every = list(itertools.permutations(range(count)))
    number = {order: index for index, order in enumerate(every)}
    places = permutations(fold(torch.arange(300 * len(every)), 7), count)
    assert chi_square(torch.tensor([number[tuple(row)] for row in places.tolist()]), len(every))


@pytest.mark.parametrize(("count", "bins"), [(10, 10), (64, 8), (1000, 10)])
def test_two_members_of_larger_permutations_are_anywhere(count, bins):
    keys = fold(torch.arange(4000), 3)
    for members in ((0, 1), (0, count // 2), (count - 2, count - 1)):
        first, second = (permuted(keys, torch.full_like(keys, member), count) for member in members)
        gap = (second - first) % count - 1
        assert chi_square(gap * 9 // (count - 1), 9), "a rotation alone would leave the gap as it is"
        assert chi_square(first * bins // count, bins)


@pytest.mark.parametrize("count", [2, 3, 5, 10])
def test_permutations_of_different_keys_are_independent(count):
    states = fold(torch.arange(200 * count * count), 1)
    first, second, next_state = (
        permutations(keys, count) for keys in (fold(states, 4), fold(states, 5), fold(states.roll(1), 4))
    )
    for other in (second, next_state):
        for member in range(count):
            assert chi_square(first[:, member] * count + other[:, 0], count * count)


@pytest.mark.parametrize("count", [1, 2, 3, 10, 1000])
def test_a_place_is_a_function_of_key_and_member(count):
    keys = fold(torch.arange(200), 0)
    members = torch.arange(200) * 7 % count
    places = permuted(keys, members, count)
    order = torch.randperm(200, generator=torch.Generator().manual_seed(0))
    assert torch.equal(permuted(keys[order], members[order], count), places[order])
    assert torch.equal(permuted(keys.view(20, 10), members.view(20, 10), count).view(-1), places)
    assert [int(permuted(k, m, count)) for k, m in zip(keys[:20], members[:20], strict=True)] == places[:20].tolist()


def test_first_observations_of_two_variables_fill_the_square():
    """Slices of the one in an order that is independent of the other's, not a rotation of it."""
    groups = group(400, 100)
    first, second = ((draw(groups, 0, name, 100)[0].view(400, 100) * 100).long() for name in (3, 4))
    assert chi_square((first // 10 * 10 + second // 10).flatten(), 100)
    pairs = torch.stack([first, second]).double()
    inside = [float(torch.corrcoef(pairs[:, row])[0, 1]) for row in range(400)]
    assert abs(statistics.mean(inside)) < 5 * 0.1 / 400**0.5
    assert 0.08 < statistics.stdev(inside) < 0.12, "as 100 independent pairs have it"
