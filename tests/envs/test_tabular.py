from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_pomdp.envs import TabularModel
from torchrl_pomdp.problems import tiger


def random_model(seed, controls=2, states=4, observations=3):
    generator = torch.Generator().manual_seed(seed)

    def rows(*shape):
        values = torch.rand(shape, generator=generator, dtype=torch.float64)
        values = values * (torch.rand(shape, generator=generator) < 0.7) + 1e-3
        return values / values.sum(-1, keepdim=True)

    cost = torch.rand(states, controls, generator=generator, dtype=torch.float64)
    return TabularModel(rows(controls, states, states), rows(controls, states, observations), cost, 0.9, dtype=torch.float64)


@given(seed=st.integers(0, 10_000), u=st.integers(0, 1))
@settings(max_examples=40, deadline=None)
def test_equals_bayes_written_out(seed, u):
    model = random_model(seed)
    belief = torch.rand(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    belief = belief / belief.sum()
    y, control = TensorDict({"belief": belief.unsqueeze(0)}, [1]), torch.tensor([u])
    assert model.expected_cost(y, control).item() == pytest.approx(sum(float(belief[i] * model.cost[i, u]) for i in range(4)))
    for z in range(3):
        joint = [
            sum(float(belief[i] * model.transition[u, i, j]) for i in range(4)) * float(model.observation[u, j, z])
            for j in range(4)
        ]
        assert model.observation_probs(y, control)[0, z].item() == pytest.approx(sum(joint))
        posterior = model.estimator(y, control, torch.tensor([z]))["belief"][0]
        torch.testing.assert_close(posterior, torch.tensor(joint, dtype=torch.float64) / sum(joint))


def test_tiger_beliefs_by_hand():
    model = tiger()
    y = TensorDict({"belief": torch.tensor([[0.5, 0.5]])}, [1])
    listen, hear_left = torch.tensor([0]), torch.tensor([0])
    once = model.estimator(y, listen, hear_left)
    assert once["belief"][0, 0].item() == pytest.approx(0.85)
    twice = model.estimator(once, listen, hear_left)
    assert twice["belief"][0, 0].item() == pytest.approx(0.85**2 / (0.85**2 + 0.15**2))
    opened = model.estimator(twice, torch.tensor([2]), hear_left)
    assert opened["belief"][0].tolist() == [0.5, 0.5]


def test_bad_arrays_are_named():
    eye, half = torch.eye(2).unsqueeze(0), torch.full((1, 2, 2), 0.5)
    cost = torch.zeros(2, 1)
    with pytest.raises(ValueError, match=r"rows of transition must .* row \(0, 1\) sums to 2"):
        TabularModel(torch.tensor([[[1.0, 0.0], [1.0, 1.0]]]), half, cost, 0.9)
    with pytest.raises(ValueError, match="rows of observation"):
        TabularModel(eye, -half, cost, 0.9)
    with pytest.raises(ValueError, match=r"cost must be finite of shape \[2, 1\]"):
        TabularModel(eye, half, torch.full((2, 1), torch.nan), 0.9)
    with pytest.raises(ValueError, match="transition must have shape"):
        TabularModel(torch.eye(2), half, cost, 0.9)
    with pytest.raises(ValueError, match="observation must have shape"):
        TabularModel(eye, torch.eye(2), cost, 0.9)
    with pytest.raises(ValueError, match="discount"):
        TabularModel(eye, half, cost, 1.5)
