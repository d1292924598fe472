from __future__ import annotations

import pytest
import torch
from _oracles import random_states, small_model
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_pomdp.envs.repair import grid, line
from torchrl_pomdp.modules import FlatEncoder, PartitionedPolicy, PartitionedValue, PolicyNetwork, ValueNetwork
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, RelativeEncoder, SteadyStateCost
from torchrl_pomdp.problems import tiger


def network(model, seed=0, encoder=FlatEncoder):
    return PolicyNetwork(encoder(model), model.num_controls, (16, 8), generator=torch.Generator().manual_seed(seed))


def test_flat_encoding_holds_beliefs_and_one_hot_location(linear20):
    y = linear20.start(torch.arange(4))
    features = FlatEncoder(linear20.model)(y)
    torch.testing.assert_close(features[:, :100].view(4, 20, 5), y["belief"])
    assert torch.equal(features[:, 100:].argmax(-1), y["location"][:, 0])
    assert FlatEncoder(tiger().model).num_features == 2


def test_relative_encoding_by_hand():
    model = small_model(line(3), dtype=torch.float32)
    y = random_states(model, 6, 0)
    features = RelativeEncoder(model)(y)
    window = features[:, :15].view(6, 5, 3)
    for row in range(6):
        place = int(y["location"][row, 0])
        for offset in range(-2, 3):
            seen = window[row, offset + 2]
            if not 0 <= place + offset < 3:
                assert seen.tolist() == [0, 0, 0]
                continue
            belief = y["belief"][row, place + offset]
            assert seen[0] == float(belief[0] < 1)
            assert torch.equal(seen[1:], belief[1:])
    assert torch.equal(features[:, 15:].argmax(-1), y["location"][:, 0])


def test_relative_encoding_sees_the_same_from_everywhere():
    model = small_model(grid(5, 4), dtype=torch.float32)
    y = random_states(model, 1, 0).expand(2).clone()
    y["belief"][:] = torch.eye(3)[0]
    y["location"][:] = torch.tensor([[6], [12]])
    y["belief"][0, 6 + 1] = y["belief"][1, 12 + 1] = torch.tensor([0.2, 0.3, 0.5])
    features = RelativeEncoder(model)(y)
    assert torch.equal(features[0, :-21], features[1, :-21])


@pytest.mark.parametrize("encoder", [FlatEncoder, RelativeEncoder])
@pytest.mark.parametrize("gradients", [False, True])
@pytest.mark.parametrize("size", [1, 2, 5, 17, 100])
def test_outputs_do_not_depend_on_the_batch(linear20, encoder, size, gradients):
    policy = network(linear20.model, encoder=encoder)
    y = linear20.model.with_features(linear20.start(torch.arange(300)))
    with torch.set_grad_enabled(gradients):
        together, apart = policy(y.copy())["logits"], policy(y[100 : 100 + size].clone())["logits"]
    assert torch.equal(apart, together[100 : 100 + size])


@pytest.mark.parametrize(("graph", "robots"), [(line(6), 1), (grid(4, 3), 1), (line(5), 2), (grid(3, 2), 3)])
def test_grouping_by_location_changes_no_output(graph, robots):
    model = small_model(graph, num_robots=robots, dtype=torch.float32)
    y = model.with_features(random_states(model, 200, 0))
    policy = network(model, encoder=RelativeEncoder)
    grouped = policy(y.copy())["logits"]
    dense = torch.nn.Sequential(*policy.network)(policy.encoder(y)[:192])
    legal = y["action_mask"][:192]
    torch.testing.assert_close(grouped[:192][legal], dense[legal])
    with torch.no_grad():
        assert torch.equal(policy(y.copy())["logits"], grouped), "gradients change no bit"
    weight = policy.network[0].weight
    mine = torch.autograd.grad(grouped[:192][legal].square().sum(), weight)[0]
    torch.testing.assert_close(mine, torch.autograd.grad(dense[legal].square().sum(), weight)[0])


def test_initial_weights_come_from_the_generator_alone(linear20):
    state = torch.random.get_rng_state()
    first, second, other = (network(linear20.model, seed).state_dict() for seed in (0, 0, 1))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert all(torch.equal(first[key], second[key]) for key in first)
    assert not all(torch.equal(first[key], other[key]) for key in first)


def test_router_gives_every_row_its_own_parts_answer(linear20):
    model = linear20.model
    policies = [network(model, seed) for seed in range(5)] + [GreedyRepair(model)]
    router = PartitionedPolicy(policies)
    y = torch.cat([generator(torch.arange(5)) for generator in linear20.training])
    y = model.with_features(y[torch.randperm(30, generator=torch.Generator().manual_seed(0))])
    u = router(y.copy())["action"]
    for row in range(30):
        alone = policies[int(y["partition"][row])](y[row : row + 1].clone())["action"]
        assert u[row] == alone[0]
    assert torch.equal(router(y.reshape(5, 6).clone())["action"], u.view(5, 6))
    assert router.out_keys == ["action"], "the greedy policy has no logits"


def test_values_of_different_scales_are_not_mixed_up(linear20):
    model, encoder = linear20.model, RelativeEncoder(linear20.model)
    generator = torch.Generator().manual_seed(0)
    scales = [NeverRepairCost(model), SteadyStateCost(model)]
    values = [ValueNetwork(encoder, scales[part % 2], (16,), generator=generator) for part in range(6)]
    y = model.with_features(torch.cat([states(torch.arange(20)) for states in linear20.training]))
    together = PartitionedValue(values)(y.copy())["state_value"]
    for part, value in enumerate(values):
        rows = y["partition"] == part
        assert torch.equal(together[rows], value(y[rows])["state_value"])


def test_gradients_reach_the_networks_of_the_rows_parts_alone(linear20):
    model = linear20.model
    router = PartitionedPolicy([network(model, seed) for seed in range(6)])
    y = model.with_features(linear20.training[2](torch.arange(8)))
    logits = router(y)["logits"]
    logits[torch.isfinite(logits)].sum().backward()
    touched = [any(p.grad is not None for p in policy.parameters()) for policy in router.policies]
    assert touched == [False, False, True, False, False, False]


def test_router_refuses_parts_without_a_policy(linear20):
    y = linear20.model.with_features(linear20.start(torch.arange(3))).set("partition", torch.tensor([0, 1, 6]))
    with pytest.raises(ValueError, match=r"partition must hold parts 0\.\.5"):
        PartitionedPolicy([GreedyRepair(linear20.model)] * 6)(y)
    with pytest.raises(ValueError, match="policies is empty"):
        PartitionedPolicy([])


def test_a_network_stays_in_its_models_type(linear20):
    policy = network(linear20.model, encoder=RelativeEncoder)
    y = linear20.model.with_features(linear20.start(torch.arange(3)))
    logits = policy(y.copy())["logits"]
    for convert in (policy.double, policy.half, PartitionedPolicy([policy] * 6).bfloat16):
        with pytest.raises(ValueError, match=r"stays in the type torch\.float32"):
            convert()
    assert torch.equal(policy.to("cpu", torch.float32)(y.copy())["logits"], logits), "nothing was converted"


def test_an_actor_draws_legal_controls_by_the_softmax_of_the_logits(linear20):
    network = PolicyNetwork(RelativeEncoder(linear20.model), 3, (16,), generator=torch.Generator().manual_seed(1))
    y = linear20.model.with_features(linear20.start(torch.arange(5)))
    logits = network(y.clone())["logits"].masked_fill(~y["action_mask"], -torch.inf)
    rows = y.repeat_interleave(4000).reshape(-1)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        drawn = network.actor()(rows)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(network.actor()(y.clone())["action"], logits.argmax(-1))
    counts = torch.zeros(5, 3).index_put_(
        (torch.arange(5).repeat_interleave(4000), drawn["action"]), torch.ones(()), accumulate=True
    )
    probs = logits.softmax(-1)
    assert bool((counts[~y["action_mask"]] == 0).all())
    assert bool(((counts / 4000 - probs).abs() <= 4.5 * (probs * (1 - probs) / 4000).sqrt() + 1e-6).all())
    exact = logits.log_softmax(-1).repeat_interleave(4000, 0).gather(-1, drawn["action"].unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(drawn["action_log_prob"], exact)


def test_a_value_reads_what_its_scale_reads(linear20):
    """The encoder reads the robot's location alone, the scale the belief."""

    class Place(FlatEncoder):
        def encode_rows(self, y, rows):
            place = y["location"] if rows is None else y["location"][rows]
            return torch.nn.functional.one_hot(place[:, 0], 20).to(self.dtype)

    encoder = Place(linear20.model)
    encoder.keys, encoder.num_features = ["location"], 20
    network = ValueNetwork(encoder, NeverRepairCost(linear20.model), (4,), generator=torch.Generator().manual_seed(0))
    assert network.in_keys == ["location", "belief"]
    y = linear20.model.with_features(linear20.start(torch.arange(9)))
    value = network(y.select("location", "belief"))["state_value"]
    assert torch.equal(PartitionedValue([network] * 6)(y)["state_value"], value)
