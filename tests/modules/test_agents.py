"""The network that many agents share: in turn and taught, legal, of the batch independent, trained and kept."""

from __future__ import annotations

import math

import pytest
import torch
from _oracles import random_states, small_model
from tensordict import TensorDict

from torchrl_pomdp.controller import Controller
from torchrl_pomdp.envs.repair import line
from torchrl_pomdp.modules import AgentNetwork, FlatAgentEncoder, MultiagentRollout, PartitionedPolicy
from torchrl_pomdp.modules.repair import GreedyRepair, RobotEncoder, SteadyStateCost
from torchrl_pomdp.objectives import ClassificationLoss
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.trainers import Checkpoint, PolicyIterationConfig, api, load_checkpoint, make_networks, save_checkpoint

MODEL = small_model(line(4), num_robots=3, dtype=torch.float32)


def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture(params=[FlatAgentEncoder, RobotEncoder])
def network(request):
    return AgentNetwork(request.param(MODEL), (8, 5), generator=generator())


def by_hand(network, y, told=None):
    """Every agent's logits by the whole first layer: features and marks as zeros and ones."""
    encoder, layers = network.encoder, [layer for layer in network.network if hasattr(layer, "weight")]
    features, own = encoder(y), encoder.own_marks(y)
    seen = torch.zeros(len(y), encoder.num_marks)
    logits, controls = [], []
    for agent in range(MODEL.num_agents):
        marks = seen + torch.nn.functional.one_hot(own[:, agent], encoder.num_marks).sum(1)
        out = features @ layers[0].weight.T + layers[0].bias + marks @ network.marks
        out = out + encoder.own_features(y)[:, agent] @ network.own
        for layer in layers[1:]:
            out = out.relu() @ layer.weight.T + layer.bias
        logits.append(out.masked_fill(~MODEL.agent_mask(y)[:, agent], -torch.inf))
        controls.append(logits[-1].argmax(-1) if told is None else told[:, agent])
        choice = encoder.choice_marks(y, slice(agent, agent + 1), controls[-1].unsqueeze(-1)).squeeze(1)
        seen = seen + torch.nn.functional.one_hot(choice, encoder.num_marks).sum(1)
    return torch.stack(logits, 1), torch.stack(controls, 1)


def test_agents_decide_in_turn(network):
    y = random_states(MODEL, 50, 0)
    before = y.clone()
    logits, controls = by_hand(network, y)
    found = network(y.clone())
    assert (y == before).all(), "what a network sees is not written into"
    torch.testing.assert_close(found["logits"], logits)
    assert torch.equal(MODEL.split_controls(found["action"]), controls)
    assert len(found["action"].unique()) > 5


def test_how_much_damage_lies_each_way_by_hand():
    """Robots at 0 and 2 of a line of 4, damage at 3 alone, which costs 5 more than an intact location does."""
    model = small_model(line(4), num_robots=2, dtype=torch.float64)
    belief = torch.eye(3, dtype=torch.float64)[torch.tensor([[0, 0, 0, 2]])]
    y = TensorDict({"belief": belief, "location": torch.tensor([[0, 2]])}, [1])
    found = RobotEncoder(model).own_features(y)[0].view(2, 2, 3, 3)
    near = 1 / 4**3 + 1 / 2**3
    for robot, distance in ((0, 3), (1, 1)):
        for power in range(3):
            alone = 5 / (distance + 1) ** (power + 1)
            for row, expected in ((0, alone), (1, alone / near)):
                # Controls are repair, left, right.
                assert found[robot, row, :, power].tolist() == pytest.approx([0.0, 0.0, math.log1p(expected)])


def test_what_agents_are_told_takes_the_place_of_choices(network):
    y = random_states(MODEL, 50, 1)
    own = network(y.clone())
    told = network(y.clone().set("told", MODEL.split_controls(own["action"])))
    torch.testing.assert_close(told["logits"], own["logits"])
    other = MODEL.split_controls(GreedyRepair(MODEL)(y.clone())["action"])
    logits, _ = by_hand(network, y, other)
    torch.testing.assert_close(network(y.clone().set("told", other))["logits"], logits)


def test_a_decision_does_not_depend_on_the_batch(network):
    y = random_states(MODEL, 50, 2)
    whole = network(y.clone())["logits"]
    assert torch.equal(whole, torch.cat([network(part.clone())["logits"] for part in y.split(7)]))
    assert torch.equal(network(y[3].clone())["logits"], whole[3])


def test_the_loss_is_that_of_each_agents_decision():
    network = AgentNetwork(RobotEncoder(MODEL), (8,), generator=generator())
    labelled = MultiagentRollout(MODEL, GreedyRepair(MODEL), trajectories=2)(random_states(MODEL, 20, 0))
    label = MODEL.split_controls(labelled["action"])
    logits = network(labelled.clone().set("told", label))["logits"]
    expected = torch.nn.functional.cross_entropy(logits.flatten(0, 1), label.flatten())
    found = ClassificationLoss(network, "cross_entropy")(labelled)
    torch.testing.assert_close(found["loss_policy"], expected)
    assert found["accuracy"] == (logits.argmax(-1) == label).float().mean()
    with pytest.raises(ValueError, match="action must be a legal control"):
        ClassificationLoss(network)(labelled.clone().set("action", torch.full((20,), 99)))


def test_the_loss_of_networks_of_parts_is_that_of_each_in_its_part():
    networks = [AgentNetwork(RobotEncoder(MODEL), (8,), generator=generator()) for _ in range(2)]
    with torch.no_grad():
        networks[1].own.mul_(3.0)
        networks[1].network[-1].weight.mul_(-2.0)
    labelled = MultiagentRollout(MODEL, GreedyRepair(MODEL), trajectories=2)(random_states(MODEL, 20, 0))
    part = (torch.arange(20) % 4 == 1).long()
    found = ClassificationLoss(PartitionedPolicy(networks), "cross_entropy")(labelled.set("partition", part))
    losses = [ClassificationLoss(network, "cross_entropy") for network in networks]
    own = [loss(labelled[part == number])["loss_policy"] for number, loss in enumerate(losses)]
    torch.testing.assert_close(found["loss_policy"], 0.75 * own[0] + 0.25 * own[1])
    assert not torch.isclose(own[0], own[1])
    whole = ClassificationLoss(PartitionedPolicy(networks[:1] * 2), "cross_entropy")(labelled)
    torch.testing.assert_close(whole["loss_policy"], losses[0](labelled)["loss_policy"])


@pytest.mark.parametrize("name", ["two_robots20", "network32x8"])
def test_policy_iteration_of_many_agents(name, tmp_path):
    """Trained on one-at-a-time labels; a run goes on where it stopped; the policy is kept in a file."""
    problem = make_problem(name, partitioned=False)
    config = PolicyIterationConfig(
        iterations=2,
        samples_per_part=60,
        least_steps=60,
        visits_per_label=0.1,
        max_steps=40,
        validation_states=12,
        hidden=(16,),
        trajectories=2,
        multiagent=True,
        label_steps=3,
    )
    # Nothing is better than a policy that nearly never repairs: the first iteration is accepted.
    base = GreedyRepair(problem.model)
    run = api(problem, config, base, folder=tmp_path / "run")
    policies = [iteration.policy for iteration in run]
    assert all(isinstance(policy.policies[0], AgentNetwork) for policy in policies)
    y = problem.model.with_features(problem.start(torch.arange(20)))
    u = policies[-1](y.clone())["action"]
    problem.model.check_controls(y, u)
    (tmp_path / "run" / "iteration-2").rename(tmp_path / "gone")
    again = [iteration.policy for iteration in api(problem, config, base, folder=tmp_path / "run")]
    assert torch.equal(again[-1](y.clone())["action"], u)
    checkpoint = Checkpoint(problem, config, "API", 2, policies[-1], run_value(problem))
    save_checkpoint(tmp_path / "best.pt", checkpoint)
    loaded = load_checkpoint(tmp_path / "best.pt")
    assert torch.equal(loaded.policy(y.clone())["action"], u)


def run_value(problem):
    from torchrl_pomdp.modules import PartitionedValue

    return PartitionedValue([problem.pessimistic_cost])


def test_a_network_rolls_out():
    problem = make_problem("network32x10")
    network = make_networks(problem, PolicyIterationConfig(hidden=(8,)), 0)
    assert isinstance(network, PartitionedPolicy)
    assert isinstance(network.policies[0], AgentNetwork)
    y = problem.start(torch.arange(4))
    options = {"trajectories": 2, "max_steps": 3, "terminal_cost": SteadyStateCost(problem.model)}
    found = MultiagentRollout(problem.model, network, **options)(y.clone())
    signalled = MultiagentRollout(
        problem.model, GreedyRepair(problem.model), scheme="autonomous", signalling=network, **options
    )(y.clone())
    assert found["action"].shape == signalled["action"].shape == (4, 10)


def test_many_robots_are_controlled_one_by_one_from_a_file(tmp_path):
    """What a real team does: named controls out, reported levels in, rollout on top of the network."""
    problem = make_problem("network32x8")
    config = PolicyIterationConfig(hidden=(4,))
    save_checkpoint(
        tmp_path / "best.pt", Checkpoint(problem, config, "API", 1, make_networks(problem, config, 0), run_value(problem))
    )
    controller = Controller.from_checkpoint(tmp_path / "best.pt")
    controller.reset(problem.start(torch.tensor(0)))
    decision = controller.act()
    assert len(decision.control) == len(decision.names) == 8
    controller.update(decision.control, [None] * 8)
    controller.update(controller.act().names, [None] * 8)
    assert controller.steps == 2
    with pytest.raises(ValueError, match="control must be legal for every robot"):
        controller.update(["neighbour 3"] * 8, [None] * 8)
    online = Controller.from_checkpoint(tmp_path / "best.pt", online=True)
    assert isinstance(online.policy, MultiagentRollout)
