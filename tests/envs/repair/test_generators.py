"""Random feature states of locations that have chains of their own."""

from __future__ import annotations

import pytest
import torch
from _oracles import varied_model

from torchrl_pomdp.envs.repair import RandomState, RepairModel, line
from torchrl_pomdp.envs.repair.chains import chain_powers


@pytest.mark.parametrize("robots", [1, 2])
def test_random_states_have_aged_by_the_chains_of_their_locations(robots):
    model = varied_model(line(6), robots, seed=2)
    # Whose locations do not change, so that beliefs are as they were made.
    kept = RepairModel(line(6), torch.eye(3), model.costs, 0.9, num_robots=robots, dtype=model.dtype)
    keys = torch.arange(500)
    aged, fresh = (RandomState(each, max_age=3)(keys) for each in (model, kept))
    assert torch.equal(aged["location"], fresh["location"])
    expected, found = fresh["belief"], []
    # Robots have looked, and may have seen another level.
    unseen = torch.ones(500, 6, dtype=torch.bool).scatter(1, aged["location"], False)
    for _ in range(4):
        near = torch.isclose(aged["belief"], expected, rtol=1e-12, atol=1e-14).all(-1)
        found.append((near | ~unseen).all(-1))
        expected = torch.einsum("nlk,lkj->nlj", expected, model.chain)
    # Every state has one age, and all ages occur as often but for chance.
    counts = torch.stack(found).sum(-1)
    assert (torch.stack(found).sum(0) == 1).all()
    assert ((counts - 125).abs() < 45).all()
    seen = aged["belief"].gather(1, aged["location"].unsqueeze(-1).expand(-1, -1, 3))
    assert (seen.amax(-1) == 1).all()


def test_powers_of_a_chain_are_those_of_plain_floats_on_every_machine():
    def row(p, q):
        return [p * (1 - a) + q * b, p * a + q * (1 - b)]

    a, b = 0.3, 0.1
    chain, expected = torch.tensor([[1 - a, a], [b, 1 - b]], dtype=torch.float64), [[[1.0, 0.0], [0.0, 1.0]]]
    for _ in range(40):
        expected.append([row(*level) for level in expected[-1]])
    assert chain_powers(chain, 40).tolist() == expected


def test_powers_of_the_chains_of_many_locations():
    chain = torch.rand(7, 5, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    chain /= chain.sum(-1, keepdim=True)
    expected = torch.stack([torch.linalg.matrix_power(chain, age) for age in range(41)])
    torch.testing.assert_close(chain_powers(chain, 40), expected, rtol=1e-12, atol=1e-15)
