"""Comparing costs: verdicts that do not depend on where zero lies, and ratios only where they mean something."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_pomdp.envs import FixedBelief, TabularModel
from torchrl_pomdp.evaluation import compare, discounted_costs, estimate
from torchrl_pomdp.problems import tiger
from torchrl_pomdp.trainers.policy_iteration import judge


def sample(mean, spread=3.0, count=400, seed=0):
    noise = torch.randn(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return mean + spread * (noise - noise.mean()) / noise.std()


@pytest.mark.parametrize("base", [-1000.0, -10.5, -1.0, 0.0, 1.0, 10.5, 1000.0])
@pytest.mark.parametrize("change", [-5.0, -1.0, 1.0, 5.0])
def test_cheaper_policies_are_accepted_and_dearer_ones_are_not(base, change):
    baseline = sample(base)
    comparison = compare(baseline + sample(change, spread=2.0, seed=1), baseline)
    accepted, reason = judge(comparison)
    assert accepted == (change < 0)
    assert comparison.difference.mean == pytest.approx(change)
    assert comparison.difference.standard_error == pytest.approx(2.0 / 20)
    assert f"{change:+.4g}" in reason
    assert ("times it" in reason) == (comparison.ratio is not None)


@pytest.mark.parametrize("change", [-0.15, 0.0, 0.15])
@pytest.mark.parametrize("base", [-10.5, 0.0, 10.5])
def test_differences_within_the_noise_are_not_accepted(base, change):
    baseline = sample(base)
    accepted, reason = judge(compare(baseline + sample(change, spread=2.0, seed=1), baseline))
    assert not accepted
    assert "not lower with confidence" in reason


@given(offset=st.floats(-1e6, 1e6), change=st.floats(-3.0, 3.0), seed=st.integers(0, 1000))
@settings(max_examples=60, deadline=None)
def test_a_constant_on_all_costs_changes_no_verdict(offset, change, seed):
    baseline, costs = sample(0.0, seed=seed), sample(change, seed=seed + 1)
    plain, moved = compare(costs, baseline), compare(costs + offset, baseline + offset)
    if abs(plain.difference.interval[1]) > 1e-6:
        assert judge(moved)[0] == judge(plain)[0]
    assert moved.difference.mean == pytest.approx(plain.difference.mean, abs=1e-6)


def test_a_constant_on_all_stage_costs_changes_no_verdict():
    """A model whose every stage is 50 cheaper is the same problem."""
    known, start = tiger().model, FixedBelief(torch.tensor([0.5, 0.5]))

    def listen_until(sure):
        return lambda y: y.set("action", torch.where(y["belief"].amax(-1) > sure, 2 - y["belief"].argmax(-1), 0))

    verdicts, differences = [], []
    for offset in (-50.0, 0.0, 50.0):
        model = TabularModel(known.transition, known.observation, known.cost + offset, 0.9)
        costs = {
            sure: discounted_costs(model, listen_until(sure), start, num_states=300, max_steps=100) for sure in (0.8, 0.95, 1.0)
        }
        pairs = [compare(costs[one], costs[other]) for one in costs for other in costs]
        verdicts.append([judge(pair)[0] for pair in pairs])
        differences.append([pair.difference.mean for pair in pairs])
        assert all(pair.ratio is None for pair in pairs) == (offset < 0)
    assert verdicts[0] == verdicts[1] == verdicts[2]
    assert True in verdicts[0]
    assert differences[0] == pytest.approx(differences[1], abs=0.01)
    assert differences[2] == pytest.approx(differences[1], abs=0.01)


@pytest.mark.parametrize(
    "baseline",
    [
        [0.0, 0.0, 0.0],
        [-1.0, -2.0, -3.0],
        [-5.0, 1.0, 4.0],
        [-1.0, 1.0, 1.0],
        [-30.0, 20.0, 15.0],
        [-1.0],
        [0.0],
        [-0.0, 0.0],
        [1.0, -3.0],
    ],
)
def test_there_is_no_ratio_to_what_is_not_clearly_a_cost(baseline):
    baseline = torch.tensor(baseline)
    comparison = compare(baseline + 1.0, baseline)
    assert comparison.ratio is None
    assert comparison.difference.mean == pytest.approx(1.0)


@pytest.mark.parametrize("baseline", [[4.0], [1.0, 2.0, 3.0], [0.0, 0.0, 6.0], [0.0, 5.0], [1e-30, 1e-30], [1e30, 3e30]])
@pytest.mark.parametrize("factor", [0.0, 0.5, 1.0, 3.0])
def test_a_ratio_to_costs_is_that_of_the_means(baseline, factor):
    baseline = torch.tensor(baseline, dtype=torch.float64)
    ratio = compare(factor * baseline, baseline).ratio
    assert ratio.mean == pytest.approx(factor)
    assert ratio.count == len(baseline)
    assert ratio.standard_error == pytest.approx(0.0, abs=1e-12) or len(baseline) == 1


def test_a_reward_is_no_multiple_of_a_cost():
    comparison = compare(torch.tensor([-2.0, 1.0]), torch.tensor([1.0, 2.0]))
    assert comparison.ratio is None
    assert comparison.difference.mean == pytest.approx(-2.0)


def test_the_ratios_error_is_that_of_the_delta_method():
    """Against the spread of the ratio over many samples."""
    generator = torch.Generator().manual_seed(0)
    ratios, errors = [], []
    for _ in range(400):
        baseline = torch.rand(100, generator=generator) * 10
        costs = 0.8 * baseline + torch.randn(100, generator=generator)
        ratio = compare(costs, baseline).ratio
        ratios.append(ratio.mean)
        errors.append(ratio.standard_error)
    assert float(torch.tensor(errors).mean()) == pytest.approx(float(torch.tensor(ratios).std()), rel=0.15)


def test_mostly_positive_costs_with_a_clear_mean_have_a_ratio():
    baseline = sample(10.0, spread=8.0)
    assert bool((baseline < 0).any())
    assert compare(0.5 * baseline, baseline).ratio.mean == pytest.approx(0.5)
    assert compare(baseline, sample(0.2, spread=8.0)).ratio is None


GOOD = torch.tensor([1.0, 2.0])


@pytest.mark.parametrize("name", ["costs", "baseline", "values"])
@pytest.mark.parametrize(
    ("value", "error"),
    [
        (torch.zeros(0), ValueError),
        (torch.tensor([1.0, math.nan]), ValueError),
        (torch.tensor([1.0, math.inf]), ValueError),
        (torch.tensor([-math.inf, 1.0]), ValueError),
        (torch.ones(2, 1), ValueError),
        (torch.tensor(1.0), ValueError),
        (torch.tensor([1j, 2j]), TypeError),
        ([1.0, 2.0], TypeError),
        (None, TypeError),
    ],
)
def test_what_is_no_sample_is_refused_by_name(name, value, error):
    with pytest.raises(error, match=f"^{name} must"):
        estimate(value) if name == "values" else compare(**({"costs": GOOD, "baseline": GOOD} | {name: value}))


def test_samples_that_are_not_paired_are_refused():
    for costs, baseline in ((GOOD, torch.ones(3)), (torch.ones(1), GOOD)):
        with pytest.raises(ValueError, match="costs and baseline must be paired"):
            compare(costs, baseline)


def test_single_values_have_no_error_and_are_not_accepted():
    comparison = compare(torch.tensor([1.0]), torch.tensor([9.0]))
    assert math.isnan(comparison.difference.standard_error)
    assert not judge(comparison)[0]


def test_single_precision_costs_are_compared_in_double_precision():
    baseline = torch.full((1000,), 1e7) + torch.arange(1000)
    comparison = compare(baseline - 1, baseline)
    assert comparison.difference.mean == -1.0
    assert judge(comparison)[0]
