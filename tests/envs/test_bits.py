"""Models and generators are functions of a row alone, to the last bit: in any batch, order, layout and number of threads."""

from __future__ import annotations

import pytest
import torch
from _oracles import random_states
from tensordict import TensorDict

from torchrl_pomdp.envs import InPart, Mixture, TabularModel
from torchrl_pomdp.envs.repair import (
    CalibratedStart,
    Graph,
    RandomState,
    RepairModel,
    RepairPartition,
    UniformStart,
    damage_chain,
    grid,
    line,
)
from torchrl_pomdp.noise import seed_keys

ROWS = 67


def distributions(generator, *shape):
    values = torch.rand(shape, generator=generator, dtype=torch.float64) ** 3
    return values / values.sum(-1, keepdim=True)


def tabular(size, controls, observations, dtype):
    generator = torch.Generator().manual_seed(size)
    cost = torch.randn(controls, size, generator=generator, dtype=torch.float64) * 100
    rows = distributions(generator, controls, size, size), distributions(generator, controls, size, observations)
    model = TabularModel(*rows, cost, 0.95, dtype=dtype)
    belief = distributions(generator, ROWS, size).to(dtype)
    return model, TensorDict({"belief": belief}, [ROWS])


def repair(graph, chain, robots, dtype):
    generator = torch.Generator().manual_seed(7)
    costs = torch.rand(chain.shape[0], generator=generator, dtype=torch.float64) * 100
    partition = RepairPartition(graph, costs)
    model = RepairModel(graph, chain, costs, 0.95, num_robots=robots, dtype=dtype, partition=partition)
    return model, random_states(model, ROWS, 3)


def batch_innermost(leaf):
    return leaf.movedim(0, -1).contiguous().movedim(-1, 0)


def results(model, y, u, noise):
    """Everything a model computes for rows ``[N]``."""
    probs = model.observation_probs(y, u)
    z = probs.argmax(-1)
    cost, drawn = model.advance(y, u, noise)
    return {
        "cost": model.expected_cost(y, u),
        "cost of advance": cost,
        "probs": probs,
        "mask": model.action_mask(y),
        "terminal": model.is_terminal(y),
        **{f"drawn {key}": leaf for key, leaf in drawn.items()},
        **{f"filtered {key}": leaf for key, leaf in model.estimator(y, u, z).items()},
    }


def assert_rowwise(model, y):
    y = model.with_features(y)
    noise = torch.rand(ROWS, model.noise_dim, generator=torch.Generator().manual_seed(1))
    u = model.action_mask(y).to(torch.float32).mul(torch.rand(ROWS, model.num_controls, generator=torch.Generator())).argmax(-1)
    whole = results(model, y, u, noise)

    def same(label, parts, index):
        for key, value in whole.items():
            assert torch.equal(torch.cat([part[key] for part in parts]), value[index]), f"{key} differs by {label}"

    everything = torch.arange(ROWS)
    for size in (1, 17):
        pieces = [results(model, *rows) for rows in zip(y.split(size), u.split(size), noise.split(size), strict=True)]
        same(f"batches of {size}", pieces, everything)
    order = torch.randperm(ROWS, generator=torch.Generator().manual_seed(2))
    same("order", [results(model, y[order], u[order], noise[order])], order)
    turned = TensorDict({key: batch_innermost(leaf) for key, leaf in y.items()}, [ROWS])
    same("layout", [results(model, turned, u, noise)], everything)
    rowwise = TensorDict({key: leaf.contiguous() for key, leaf in y.items()}, [ROWS])
    same("layout", [results(model, rowwise, u, noise)], everything)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if threads > 1 else 2)
        same("threads", [results(model, y, u, noise)], everything)
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("size", "controls", "observations"),
    [(1, 1, 1), (2, 3, 2), (5, 1, 33), (16, 2, 3), (17, 3, 16), (33, 4, 7), (64, 2, 1), (100, 3, 5), (129, 2, 2)],
)
def test_tabular_models(size, controls, observations, dtype):
    assert_rowwise(*tabular(size, controls, observations, dtype))


DENSE = distributions(torch.Generator().manual_seed(0), 33, 33)
METRES = Graph.from_edges("pipe", 4, [(0, 1), (1, 2), (2, 3)], columns=[0.0, 0.4, 0.8, 1.2])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("graph", "chain", "robots"),
    [
        (line(1), damage_chain((0.5,)), 1),
        (line(20), damage_chain((0.0, 0.02, 0.03, 0.05)), 1),
        (grid(6, 6), damage_chain((0.1, 0.2, 0.3, 0.4)), 1),
        (line(7), damage_chain((1e-5, 0.3)), 2),
        (METRES, damage_chain((0.0, 0.3)), 3),
        (grid(3, 3), DENSE, 1),
        (line(4), DENSE[:5, :5] / DENSE[:5, :5].sum(-1, keepdim=True), 3),
    ],
)
def test_repair_models(graph, chain, robots, dtype):
    assert_rowwise(*repair(graph, chain, robots, dtype))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("chain", [damage_chain((0.0, 0.02, 0.03, 0.05)), damage_chain((0.3,)), DENSE])
@pytest.mark.parametrize("robots", [1, 2])
def test_generators(chain, robots, dtype):
    model, _ = repair(line(7), chain, robots, dtype)
    random = RandomState(model, max_age=20)
    inside = InPart(model, random, 1)
    for generator in (
        random,
        CalibratedStart(model),
        UniformStart(model, (2,) * robots),
        inside,
        Mixture([random, inside], [0.3, 0.7]),
    ):
        keys = seed_keys(5, torch.arange(10))
        whole = model.drawn(generator, keys)
        order = torch.randperm(10, generator=torch.Generator().manual_seed(2))
        pieces = [torch.cat([generator(part) for part in keys.split(size)]) for size in (1, 7)]
        for other, index in [*((piece, torch.arange(10)) for piece in pieces), (generator(keys[order]), order)]:
            assert torch.equal(other["belief"], whole["belief"][index])
            assert torch.equal(other["location"], whole["location"][index])
        assert generator(keys[:0])["belief"].shape == (0, 7, model.num_levels)
