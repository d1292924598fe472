"""The collector of costs-to-go, the loss and the router of value networks."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from _oracles import exact_cost

from torchrl_pomdp.collectors import PartSampler, PolicyEvaluation
from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.modules import FlatEncoder, PartitionedPolicy, PartitionedValue, PolicyCost, ValueNetwork
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, SteadyStateCost, UrgencyRepair
from torchrl_pomdp.objectives import ValueLoss


def collect(problem, policy, parts, **options):
    collector = PolicyEvaluation(
        BeliefEnv(problem.model, problem.start),
        policy,
        states=PartSampler({part: problem.training[part] for part in parts}, seed=1),
        **options,
    )
    return torch.cat(list(collector)), collector


def test_labels_are_costs_of_the_global_policy(line3):
    """Startgame states followed into the endgame, where another local policy decides."""
    model = line3.model
    policy = PartitionedPolicy([GreedyRepair(model)] * 3 + [UrgencyRepair(model)] * 3)
    label = partial(PolicyCost, trajectories=300)
    batch, collector = collect(line3, policy, (1, 4), frames_per_batch=8, total_frames=8, label=label)
    assert batch["partition"].tolist() == [1, 4] * 4
    for row in range(8):
        exact = exact_cost(model, policy, batch[row : row + 1].select("belief", "location"))
        assert float(batch["cost_to_go"][row]) == pytest.approx(exact, rel=0.08)
    assert collector.simulated_steps > 8 * 300


def test_any_batch_size_gives_the_same_labels(line3):
    greedy = GreedyRepair(line3.model)
    whole, _ = collect(line3, greedy, (3, 4), frames_per_batch=20, total_frames=20)
    pieces, _ = collect(line3, greedy, (3, 4), frames_per_batch=4, total_frames=20)
    assert torch.equal(whole["cost_to_go"], pieces["cost_to_go"])


def test_the_loss_is_the_squared_error_relative_to_the_scale(linear20):
    model, scale = linear20.model, NeverRepairCost(linear20.model)
    network = ValueNetwork(FlatEncoder(model), scale, (8,), generator=torch.Generator().manual_seed(0))
    y = model.with_features(linear20.start(torch.arange(6)))
    y.set("cost_to_go", torch.arange(1.0, 7.0))
    loss = ValueLoss(network, scale)
    found = loss(y)
    value = network(y.copy())["state_value"]
    expected = ((value - y["cost_to_go"]) / scale.costs(y)).square().mean()
    torch.testing.assert_close(found["loss_value"], expected)
    torch.testing.assert_close(found["relative_error"], (value - y["cost_to_go"]).abs().mean() / 3.5)
    found["loss_value"].backward()
    assert all(p.grad is not None and bool((p.grad != 0).any()) for p in loss.parameters())


def test_a_partitioned_value_gives_every_row_its_own_parts_value(linear20):
    model, scale = linear20.model, NeverRepairCost(linear20.model)
    encoder, generator = FlatEncoder(model), torch.Generator().manual_seed(0)
    networks = [ValueNetwork(encoder, scale, (8,), generator=generator) for _ in range(3)]
    local = [scale, scale, SteadyStateCost(model), *networks]
    value = PartitionedValue(local)
    y = model.with_features(torch.cat([training(torch.arange(5)) for training in linear20.training]))
    with torch.no_grad():
        routed = value(y.copy())["state_value"]
        for row in range(len(y)):
            alone = local[int(y["partition"][row])](y[row : row + 1].clone())["state_value"]
            assert routed[row] == alone[0]
    with pytest.raises(ValueError, match="values is empty"):
        PartitionedValue([])
