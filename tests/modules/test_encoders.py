"""Encoders on graphs with any coordinates, under function transforms, in both precisions; values that are replaced."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from _oracles import random_states, small_model
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.objectives.value import GAE

from torchrl_pomdp.collectors import PolicyEvaluation, RolloutImprovement
from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.envs.repair import CalibratedStart, Graph, RepairModel, damage_chain, grid, line, symmetries
from torchrl_pomdp.modules import (
    FlatEncoder,
    PartitionedPolicy,
    PartitionedValue,
    PolicyCost,
    PolicyNetwork,
    RolloutPolicy,
    ValueNetwork,
    ZeroCost,
)
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, RelativeEncoder, SteadyStateCost

ENCODERS = [FlatEncoder, RelativeEncoder]
PATH = [[-1, 1], [0, 2], [1, 3], [2, -1]]


def path(columns, rows=(0, 0, 0, 0)):
    return Graph.from_slots("pipe", PATH, ("left", "right"), list(columns), list(rows))


def metres(width, height):
    """A grid whose coordinates are metres, 4200 by 900 in all, a little off from place to place."""
    plain = grid(width, height)
    shift = torch.arange(plain.num_locations) * 0.37 % 1.0
    columns, rows = plain.columns * (4200 / (width - 1)) + shift, plain.rows * (900 / (height - 1)) + shift.flip(0)
    return Graph.from_slots("field", plain.neighbours.tolist(), plain.control_names[1:], columns.tolist(), rows.tolist())


GRAPHS = {
    "line": line(4),
    "grid": grid(4, 3),
    "tenths": path((0, 0.4, 0.8, 1.2)),
    "close": path((0, 0.01, 0.02, 0.03)),
    "uneven": path((0, 0.1, 0.3, 0.7)),
    "column": path((5, 5, 5, 5), (0, 0.4, 0.8, 1.2)),
    "diagonal": path((0, 1, 1, 2), (0, 0.25, 0.5, 0.75)),
    "negative": path((-0.6, -0.2, 0.2, 0.6)),
    "metres": metres(4, 3),
    "millions": path((1e6, 1e6 + 400, 1e6 + 800, 1e6 + 1200)),
}


def policy_of(model, encoder=RelativeEncoder, seed=0):
    return PolicyNetwork(encoder(model), model.num_controls, (8,), generator=torch.Generator().manual_seed(seed))


def value_of(model, encoder=RelativeEncoder, scale=None):
    scale = scale or NeverRepairCost(model)
    return ValueNetwork(encoder(model), scale, (8,), generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("name", GRAPHS)
def test_every_location_has_features_of_its_own(name):
    """What is known of a location is found among the features, apart from what is known of every other one."""
    model = small_model(GRAPHS[name])
    size, levels = model.num_locations, model.num_levels
    encoder = RelativeEncoder(model)
    assert encoder.num_features <= size * size * levels + size
    for place in range(size):
        y = random_states(model, size, 0)
        y["location"][:] = place
        y["belief"][:] = torch.eye(levels, dtype=model.dtype)[0]
        known = torch.tensor([0.2, 0.3, 0.5], dtype=model.dtype)
        for other in range(size):
            y["belief"][other, other] = known
        features = encoder(y)[:, :-size]
        rows, columns = features.nonzero(as_tuple=True)
        assert torch.equal(rows.bincount(minlength=size), torch.full((size,), levels)), "K numbers for one damaged location"
        assert len(columns.unique()) == size * levels, "in columns that no other location has"
        found = features[rows, columns].view(size, levels)
        torch.testing.assert_close(found, torch.tensor([1.0, 0.3, 0.5], dtype=model.dtype).expand(size, levels))


@pytest.mark.parametrize("name", GRAPHS)
def test_equal_offsets_share_features(name):
    """Whatever the unit, and though coordinates are rounded."""
    model = small_model(GRAPHS[name])
    graph = model.graph
    offsets = torch.stack([c.unsqueeze(0) - c.unsqueeze(1) for c in (graph.columns.double(), graph.rows.double())], -1)
    span = float(offsets.abs().max())
    expected = (offsets.view(-1, 1, 2) - offsets.view(1, -1, 2)).abs().amax(-1) < 1e-4 * span
    first = RelativeEncoder(model).columns[:, :: model.num_levels].flatten()
    assert torch.equal(first.unsqueeze(0) == first.unsqueeze(1), expected)
    assert len(symmetries(model)) >= 1


@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize("robots", [1, 2])
def test_outputs_in_training_and_in_use_are_the_same(name, robots):
    model = small_model(GRAPHS[name], num_robots=robots, dtype=torch.float32)
    y = model.with_features(random_states(model, 40, 1))
    network = policy_of(model)
    with torch.no_grad():
        used = network(y.copy())["logits"]
        dense = torch.nn.Sequential(*network.network)(torch.nn.functional.pad(network.encoder(y), (0, 0, 0, 8)))[:40]
    assert torch.equal(network(y.copy())["logits"], used)
    torch.testing.assert_close(dense[y["action_mask"]], used[y["action_mask"]])


@pytest.mark.parametrize("scale", [1e-3, 0.5, 30.0, 1e5])
def test_the_unit_of_the_coordinates_changes_nothing(scale):
    plain = grid(3, 2)
    scaled = Graph.from_slots(
        "scaled",
        plain.neighbours.tolist(),
        plain.control_names[1:],
        (plain.columns * scale).tolist(),
        (plain.rows * scale).tolist(),
    )
    y = random_states(small_model(plain), 20, 0)
    assert torch.equal(RelativeEncoder(small_model(scaled))(y), RelativeEncoder(small_model(plain))(y))


def test_there_is_no_feature_that_nothing_has():
    """Metres: about as many features as offsets, not as square metres."""
    assert RelativeEncoder(small_model(metres(5, 4))).num_features <= 20 * 20 * 3 + 20
    assert RelativeEncoder(small_model(line(20))).num_features == 39 * 3 + 20


@pytest.mark.parametrize("encoder", ENCODERS)
@pytest.mark.parametrize("make", [policy_of, value_of])
def test_networks_work_under_vmap(encoder, make):
    """Over the batch, over weights of several networks, and with gradients."""
    model = small_model(line(4), dtype=torch.float32)
    y = model.with_features(random_states(model, 24, 0))
    network = make(model, encoder)
    key, read = network.out_keys[0], y.select(*network.in_keys)
    expected = network(read.copy())[key].detach()

    def output(belief, location, mask):
        entries = {"belief": belief, "location": location, "action_mask": mask}
        return network(type(y)({k: entries[k] for k in network.in_keys}, belief.shape[:-2]))[key]

    entries = [y[k] for k in ("belief", "location", "action_mask")]
    torch.testing.assert_close(torch.vmap(output)(*(e.view(4, 6, *e.shape[1:]) for e in entries)).flatten(0, 1), expected)
    torch.testing.assert_close(torch.vmap(output)(*entries), expected)

    weights = {name: torch.stack([p.detach(), -p.detach()]) for name, p in network.named_parameters()}

    def of_weights(own):
        return torch.func.functional_call(network, own, (read.copy(),))[key]

    both = torch.vmap(of_weights)(weights)
    torch.testing.assert_close(both[0], expected)
    assert not torch.allclose(both[1].nan_to_num(neginf=0.0), expected.nan_to_num(neginf=0.0))

    def loss(own):
        out = torch.func.functional_call(network, own, (read.copy(),))[key]
        return out.masked_fill(~torch.isfinite(out), 0.0).square().sum()

    plain = dict(network.named_parameters())
    found = torch.func.grad(loss)({name: p.detach() for name, p in plain.items()})
    wanted = torch.autograd.grad(loss(plain), list(plain.values()))
    for (name, gradient), other in zip(found.items(), wanted, strict=True):
        torch.testing.assert_close(gradient, other, msg=name)


class Critic(torch.nn.Module):
    """A critic of rewards over an encoder, in plain PyTorch."""

    def __init__(self, encoder):
        super().__init__()
        self.encoder, self.head = encoder, torch.nn.Linear(encoder.num_features, 1, dtype=encoder.dtype)
        torch.nn.init.constant_(self.head.weight, 0.01)
        torch.nn.init.constant_(self.head.bias, -1.0)

    def forward(self, belief, location):
        return self.head(self.encoder(TensorDict({"belief": belief, "location": location}, location.shape[:-1])))


@pytest.mark.parametrize("kind", ["encoder", "value network"])
@pytest.mark.parametrize("encoder", ENCODERS)
def test_critics_over_encoders_give_advantages(linear20, encoder, kind):
    """GAE with and without vmap, and by hand for one step."""
    model = linear20.model
    if kind == "encoder":
        critic = TensorDictModule(Critic(encoder(model)), in_keys=["belief", "location"], out_keys=["state_value"])
    else:
        network = value_of(model, encoder)
        critic = TensorDictModule(
            lambda belief, location: (
                -network(
                    linear20.start(torch.arange(1))
                    .new_empty(location.shape[:-1])
                    .update({"belief": belief, "location": location})
                )["state_value"].unsqueeze(-1)
            ),
            in_keys=["belief", "location"],
            out_keys=["state_value"],
        )
    env = BeliefEnv(model, linear20.start, batch_size=(3,), seed=0)
    steps = env.rollout(6, GreedyRepair(model))
    found = [
        GAE(gamma=0.9, lmbda=0.0, value_network=critic, deactivate_vmap=without)(steps.copy())["advantage"]
        for without in (False, True)
    ]
    torch.testing.assert_close(found[0], found[1])
    with torch.no_grad():
        now, after = critic(steps.copy())["state_value"], critic(steps["next"].copy())["state_value"]
    going = (~steps["next", "terminated"]).float()
    torch.testing.assert_close(found[0], steps["next", "reward"] + 0.9 * going * after - now)


@pytest.mark.parametrize("default", [torch.float32, torch.float64])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("encoder", ENCODERS)
def test_networks_have_the_models_type(encoder, dtype, default):
    before = torch.get_default_dtype()
    try:
        torch.set_default_dtype(default)
        model = small_model(grid(3, 2), dtype=dtype)
        y = model.with_features(CalibratedStart(model)(torch.arange(9)))
        policy, value = policy_of(model, encoder), value_of(model, encoder)
        assert {p.dtype for p in (*policy.parameters(), *value.parameters())} == {dtype}
        assert encoder(model)(y).dtype == dtype
        logits, cost = policy(y.copy())["logits"], value(y.copy())["state_value"]
        assert (logits.dtype, cost.dtype) == (dtype, dtype)
        (logits[torch.isfinite(logits)].sum() + cost.sum()).backward()
        assert all(bool(torch.isfinite(p.grad).all()) for p in (*policy.parameters(), *value.parameters()))
    finally:
        torch.set_default_dtype(before)


@pytest.mark.parametrize("encoder", ENCODERS)
def test_double_precision_from_end_to_end(encoder):
    """The same network in both precisions, and labels of a double precision policy."""
    single, double = (small_model(line(4), dtype=dtype) for dtype in (torch.float32, torch.float64))
    y = random_states(double, 30, 0)
    networks = [policy_of(model, encoder) for model in (single, double)]
    networks[1].load_state_dict({k: v.double() for k, v in networks[0].state_dict().items()})
    logits = networks[1](double.with_features(y))["logits"]
    with_single = networks[0](single.with_features(y.clone().apply(lambda x: x.float() if x.is_floating_point() else x)))
    torch.testing.assert_close(with_single["logits"].double(), logits, rtol=1e-4, atol=1e-5)
    start = CalibratedStart(double)
    options = {"states": start, "frames_per_batch": 3, "total_frames": 3}
    for kind, label, key in ((RolloutImprovement, RolloutPolicy, "q_factors"), (PolicyEvaluation, PolicyCost, "cost_to_go")):
        label = partial(label, max_steps=9, terminal_cost=value_of(double, encoder))
        batch = next(iter(kind(BeliefEnv(double, start), networks[1], label=label, **options)))
        assert batch[key].dtype == torch.float64


def test_values_that_are_replaced_are_used(line3):
    model, never, steady = line3.model, NeverRepairCost(line3.model), SteadyStateCost(line3.model)
    y = model.with_features(torch.cat([states(torch.arange(5)) for states in line3.training]))
    value = PartitionedValue([never] * 6)
    assert torch.equal(value(y.copy())["state_value"], never.costs(y))
    for part in range(6):
        value.values[part] = steady
    assert torch.equal(value(y.copy())["state_value"], steady.costs(y))
    network = value_of(model)
    value.values[4], value.values[1] = network, ZeroCost()
    expected = steady.costs(y)
    expected[y["partition"] == 1] = 0.0
    expected[y["partition"] == 4] = network(y[y["partition"] == 4])["state_value"].detach()
    assert torch.equal(value(y.copy())["state_value"].detach(), expected)


def test_policies_that_are_replaced_are_used(line3):
    model, greedy = line3.model, GreedyRepair(line3.model)
    y = model.with_features(torch.cat([states(torch.arange(5)) for states in line3.training]))
    policy = PartitionedPolicy([greedy] * 6)
    assert policy(y.copy())["action"].equal(greedy(y.copy())["action"])
    first, second = (policy_of(model, seed=seed) for seed in (1, 2))
    for network in (first, second):
        for part in range(6):
            policy.policies[part] = network
        assert policy(y.copy())["action"].equal(network(y.copy())["action"])
    assert policy.out_keys == ["logits", "action"]
    assert "action_mask" in policy.in_keys
    policy.policies[3] = greedy
    assert policy.out_keys == ["action"]
    rows = y["partition"] == 3
    assert policy(y.copy())["action"][rows].equal(greedy(y[rows])["action"])
    assert policy(y.copy())["action"][~rows].equal(second(y[~rows])["action"])


@pytest.mark.parametrize("columns", [[0.0, 1e-6, 1.0, 2.0], [0.0, 1e-3, 100.0, 1000.0], [0.0, 4e-6, 8e-6, 1.0]])
def test_near_locations_are_not_taken_for_one(columns):
    table = [[-1, 1], [0, 2], [1, 3], [2, -1]]
    graph = Graph.from_slots("pipe", table, ("left", "right"), columns, [0.0] * 4)
    model = RepairModel(graph, damage_chain((0.0, 0.3)), (0.0, 1.0, 5.0), 0.95)
    seen = RelativeEncoder(model).columns.view(4, 4, 3)[..., 0]
    assert all(len(row.unique()) == 4 for row in seen)
