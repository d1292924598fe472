"""The value loss: states of scale zero are left out, and what is no number is refused by both losses."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type
from torchrl.modules.tensordict_module.rnn import recurrent_mode

from torchrl_pomdp.envs.repair import RandomState, RepairModel, damage_chain, line
from torchrl_pomdp.modules import FlatEncoder, PolicyCost, PolicyNetwork, RolloutPolicy, ValueNetwork, ZeroCost
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, SteadyStateCost
from torchrl_pomdp.objectives import ClassificationLoss, ValueLoss
from torchrl_pomdp.trainers import PolicyIterationConfig, train_part

CONFIG = PolicyIterationConfig(epochs=1, least_steps=2, batch_size=20)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def labelled(line3):
    """400 random states with costs and rollout controls, some of them terminal."""
    model = line3.model
    y = PolicyCost(model, GreedyRepair(model))(model.with_features(RandomState(model)(torch.arange(400))))
    y = RolloutPolicy(model, GreedyRepair(model), trajectories=1)(y)
    assert 5 < int(model.is_terminal(y).sum()) < 100
    return y


def value_network(model, scale=None):
    return ValueNetwork(FlatEncoder(model), scale or NeverRepairCost(model), (8,), generator=generator())


def loss_and_gradient(network, scale, batch):
    loss = ValueLoss(network, scale)
    out = loss(batch)
    gradients = torch.autograd.grad(out["loss_value"], list(loss.parameters()))
    return out, torch.cat([gradient.flatten() for gradient in gradients])


@pytest.mark.parametrize("kind", [NeverRepairCost, SteadyStateCost])
def test_states_of_scale_zero_are_left_out(line3, labelled, kind):
    scale, network = kind(line3.model), value_network(line3.model)
    known = scale.costs(labelled) > 0
    out, gradient = loss_and_gradient(network, scale, labelled)
    alone, expected = loss_and_gradient(network, scale, labelled[known])
    assert 0 < int(known.sum()) < 400
    torch.testing.assert_close(out["loss_value"], alone["loss_value"])
    torch.testing.assert_close(out["relative_error"], alone["relative_error"])
    torch.testing.assert_close(gradient, expected)
    assert bool((expected != 0).any())
    value, target = network(labelled[known].copy())["state_value"], labelled[known]["cost_to_go"]
    torch.testing.assert_close(out["loss_value"], ((value - target) / scale.costs(labelled[known])).square().mean())


@pytest.mark.parametrize("target", [0.0, 7.0, -3.0])
def test_what_labels_say_of_states_of_scale_zero_does_not_matter(line3, labelled, target):
    scale, network = NeverRepairCost(line3.model), value_network(line3.model)
    changed = labelled.clone()
    changed["cost_to_go"][scale.costs(changed) == 0] = target
    (out, gradient), (other, expected) = (loss_and_gradient(network, scale, batch) for batch in (changed, labelled))
    assert torch.equal(out["loss_value"], other["loss_value"])
    assert torch.equal(gradient, expected)
    assert torch.equal(out["relative_error"], other["relative_error"])


@pytest.mark.parametrize("count", [1, 2, 50])
def test_states_that_are_all_of_scale_zero_teach_nothing(line3, labelled, count):
    network = value_network(line3.model)
    for scale, batch in (
        (NeverRepairCost(line3.model), labelled[line3.model.is_terminal(labelled)][:count]),
        (ZeroCost(), labelled[:count]),
    ):
        out, gradient = loss_and_gradient(network, scale, batch)
        assert (float(out["loss_value"]), float(out["relative_error"])) == (0.0, 0.0)
        assert torch.equal(gradient, torch.zeros_like(gradient))


def test_a_network_that_is_wild_there_does_not_matter(line3, labelled):
    """Infinite errors at states that are left out spoil neither loss nor gradient."""

    class Wild(TensorDictModuleBase):
        in_keys, out_keys = ["belief"], ["state_value"]

        def __init__(self):
            super().__init__()
            self.factor = torch.nn.Parameter(torch.tensor(2.0))

        def forward(self, y):
            scale = NeverRepairCost(line3.model).costs(y)
            return y.set("state_value", self.factor * torch.where(scale > 0, scale, 3e38))

    out, gradient = loss_and_gradient(Wild(), NeverRepairCost(line3.model), labelled)
    assert bool(torch.isfinite(out["loss_value"]))
    assert bool(torch.isfinite(gradient).all())


def test_negative_scales_are_refused(line3, labelled):
    class Negative(ZeroCost):
        def costs(self, y):
            return super().costs(y) - 2.0

    with pytest.raises(ValueError, match=r"scale must give costs that are not negative, got -2"):
        ValueLoss(value_network(line3.model), Negative())(labelled)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("row", [0, 399])
def test_cost_labels_that_are_no_numbers_are_refused(line3, labelled, value, row):
    batch = labelled.clone()
    batch["cost_to_go"][row] = value
    with pytest.raises(ValueError, match=rf"cost_to_go must be finite, got {value} at batch index \({row},\)"):
        ValueLoss(value_network(line3.model), NeverRepairCost(line3.model))(batch)


LOSSES = ["soft", "cross_entropy", "cost_weighted", "l2"]


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize(
    ("row", "message"),
    [
        ([math.nan, 1.0, 2.0], "q_factors must be finite"),
        ([1.0, 2.0, -math.inf], "q_factors must be finite"),
        ([math.inf, math.inf, math.inf], "q_factors must be finite"),
        ([math.nan, math.nan, math.nan], "q_factors must be finite"),
        ([-3e38, 3e38, 1.0], "q_factors must be finite, .* and not overflow"),
        ([math.inf, 1.0, 2.0], "action must be a legal control"),
    ],
)
def test_q_factors_that_are_no_numbers_are_refused(line3, labelled, loss, row, message):
    batch = labelled.clone()
    batch["q_factors"][7], batch["action"][7] = torch.tensor(row), 0
    network = PolicyNetwork(FlatEncoder(line3.model), 3, (8,), generator=generator())
    with pytest.raises(ValueError, match=message):
        ClassificationLoss(network, loss)(batch)


@pytest.mark.parametrize("action", [-1, 3, 2**40])
def test_labels_that_are_no_controls_are_refused(line3, labelled, action):
    batch = labelled.clone()
    batch["action"][3] = action
    network = PolicyNetwork(FlatEncoder(line3.model), 3, (8,), generator=generator())
    with pytest.raises(ValueError, match="action must be a legal control"):
        ClassificationLoss(network)(batch)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_weights_that_are_no_numbers_are_refused(line3, labelled, value):
    policy, values = PolicyNetwork(FlatEncoder(line3.model), 3, (8,), generator=generator()), value_network(line3.model)
    losses = [ClassificationLoss(policy, loss) for loss in LOSSES] + [ValueLoss(values, NeverRepairCost(line3.model))]
    with torch.no_grad():
        for loss in losses:
            next(loss.parameters())[0, 0] = value
    for loss in losses:
        with pytest.raises(ValueError, match="must be finite"):
            loss(labelled)


@pytest.mark.parametrize("kind", ["labels", "weight", "overflow"])
@pytest.mark.parametrize("what", ["policy", "value"])
def test_training_stops_where_a_number_is_none(line3, labelled, what, kind):
    """A label, a weight, or outputs that overflow: an error, and no network of NaN that looks trained."""
    model = line3.model
    batch = labelled.clone()
    if what == "policy":
        loss = ClassificationLoss(PolicyNetwork(FlatEncoder(model), 3, (8,), generator=generator()))
    else:
        loss = ValueLoss(value_network(model), NeverRepairCost(model))
    if kind == "labels":
        key = "q_factors" if what == "policy" else "cost_to_go"
        batch[key][11] = torch.nan
    elif kind == "weight":
        with torch.no_grad():
            next(loss.parameters())[0, 0] = torch.nan
    else:
        with torch.no_grad():
            for parameter in loss.parameters():
                parameter.mul_(1e25)
    with pytest.raises(ValueError, match="must be finite"):
        train_part(batch, loss, CONFIG, seed=0, name="part")


def test_training_among_states_of_scale_zero_leaves_finite_weights():
    """Damage that costs nothing and does not grow: most states have scale zero."""
    model = RepairModel(line(3), damage_chain((0.0, 0.0, 0.3)), (0.0, 0.0, 0.0, 5.0), 0.9)
    scale = NeverRepairCost(model)
    y = PolicyCost(model, GreedyRepair(model), max_steps=40)(model.with_features(RandomState(model)(torch.arange(300))))
    assert 0 < int((scale.costs(y) == 0).sum()) < 300
    loss = ValueLoss(value_network(model, scale), scale)
    before = float(loss(y)["loss_value"].detach())
    _, losses = train_part(y, loss, PolicyIterationConfig(epochs=20, batch_size=30, least_steps=1), seed=0, name="part")
    assert all(bool(torch.isfinite(p).all()) for p in loss.parameters())
    assert losses["loss_value"] < before


def test_losses_leave_the_modes_of_the_process_alone(line3, labelled):
    """TorchRL's exploration type and recurrent mode are of the process: of two losses in threads one would leave them set."""
    policy = PolicyNetwork(FlatEncoder(line3.model), line3.model.num_controls, (8,), generator=generator())
    for loss in ClassificationLoss(policy), ValueLoss(value_network(line3.model), NeverRepairCost(line3.model)):
        seen = []
        loss.network.register_forward_hook(lambda *_, seen=seen: seen.append((exploration_type(), recurrent_mode())))
        loss(labelled[:5])
        assert seen == [(exploration_type(), recurrent_mode())]
        with set_exploration_type(ExplorationType.RANDOM):
            loss(labelled[:5])
        assert seen[1] == (ExplorationType.RANDOM, recurrent_mode())


def test_ctrl_c_in_a_loss_is_ctrl_c(line3, labelled):
    """TensorDict's way of lending weights would make another error of it; the module has its own weights afterwards."""

    def interrupt(*_):
        raise KeyboardInterrupt

    policy = PolicyNetwork(FlatEncoder(line3.model), line3.model.num_controls, (8,), generator=generator())
    for loss in ClassificationLoss(policy), ValueLoss(value_network(line3.model), NeverRepairCost(line3.model)):
        expected = loss(labelled[:5])
        hook = loss.network.register_forward_hook(interrupt)
        with pytest.raises(KeyboardInterrupt):
            loss(labelled[:5])
        hook.remove()
        assert (loss(labelled[:5]) == expected).all()
