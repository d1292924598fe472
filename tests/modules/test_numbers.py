"""Numbers that are none, in costs, terminal costs and networks: an error that says where, and never an illegal control."""

from __future__ import annotations

import math

import pytest
import torch
from _oracles import random_states, small_model
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from torchrl_pomdp.envs import FixedBelief, TabularModel
from torchrl_pomdp.envs.repair import CalibratedStart, RepairModel, UniformStart, damage_chain, line
from torchrl_pomdp.evaluation import discounted_costs
from torchrl_pomdp.modules import (
    AfterSteps,
    FlatEncoder,
    MultistepLookahead,
    OnEntering,
    ParallelRollout,
    PartitionedPolicy,
    PartitionedValue,
    PolicyCost,
    PolicyNetwork,
    RolloutPolicy,
    TruncatedRollout,
    ValueNetwork,
)
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, RelativeEncoder
from torchrl_pomdp.problems import tiger

BROKEN = [math.nan, math.inf, -math.inf]
# In which of the states that are met.
WHERE = {
    "all": lambda y: torch.ones(y.batch_size, dtype=torch.bool),
    "one place": lambda y: y["location"][:, 0] == 5,
    "a tenth": lambda y: y["belief"][:, 3, 1:].sum(-1) * 1e4 % 1 < 0.1,
}


class Writer(TensorDictModuleBase):
    """A terminal cost in its other form: a module that writes its costs."""

    in_keys = ["belief", "location"]
    out_keys = ["state_value"]

    def __init__(self, costs):
        super().__init__()
        self.costs = costs

    def forward(self, y):
        return y.set("state_value", self.costs(y))


def broken_cost(model, value, where):
    never = NeverRepairCost(model)
    return lambda y: torch.where(WHERE[where](y), value, never.costs(y))


def users(model, cut):
    """Everything that simulates with a terminal cost, as functions of feature states ``[N]``."""
    greedy = GreedyRepair(model)

    def rollout(**options):
        return RolloutPolicy(model, greedy, trajectories=4, **cut, **options)

    return {
        "control leaves": rollout(),
        "observation leaves": rollout(leaves="observation"),
        "adaptive": rollout(allocation="adaptive"),
        "adaptive, observation leaves": rollout(allocation="adaptive", leaves="observation"),
        "multistep": MultistepLookahead(rollout(), 2, branches=2),
        "multistep, margin": MultistepLookahead(rollout(), 2, branches=2, margin=0.1),
        "parallel": ParallelRollout([RolloutPolicy(model, greedy, trajectories=2), rollout()]),
        "policy cost": PolicyCost(model, greedy, trajectories=4, **cut),
        "rollout": lambda y: TruncatedRollout(model, greedy, **cut)(y, torch.arange(len(y))),
    }


USERS = list(users(small_model(), {}))


@pytest.fixture(scope="module")
def beside(linear20):
    """States whose robot stands beside location 5, and other ones."""
    y = linear20.start(torch.arange(12))
    y["location"][:6] = 4
    return linear20.model.with_features(y)


@pytest.mark.parametrize("value", BROKEN[:2])
@pytest.mark.parametrize("user", USERS)
def test_terminal_costs_that_are_no_numbers_are_refused(linear20, beside, user, value):
    for where, form in (("all", Writer), ("one place", Writer), ("one place", lambda cost: cost), ("a tenth", Writer)):
        cut = {"truncation": AfterSteps(1), "terminal_cost": form(broken_cost(linear20.model, value, where))}
        with pytest.raises(ValueError, match=rf"^terminal_cost must give finite costs, got {value}"):
            users(linear20.model, cut)[user](beside.clone())


@pytest.mark.parametrize("rule", [AfterSteps(0), OnEntering((3, 4, 5)), None])
def test_wherever_a_trajectory_is_cut(linear20, beside, rule):
    cut = {"truncation": rule, "terminal_cost": lambda y: torch.full(y.batch_size, torch.nan), "max_steps": 20}
    for user in ("control leaves", "policy cost", "rollout"):
        with pytest.raises(ValueError, match=r"^terminal_cost must give finite costs, got nan"):
            users(linear20.model, cut)[user](beside.clone())


def test_terminal_costs_of_trajectories_that_are_not_cut_do_not_matter(linear20, beside):
    """What a cost says of states that it is not asked about changes nothing."""
    model, never = linear20.model, NeverRepairCost(linear20.model)
    asked = []

    def endgame_only(y):
        asked.append(bool((y["partition"] >= 3).all()))
        return torch.where(y["partition"] < 3, torch.nan, never.costs(y))

    cut = {"truncation": OnEntering((3, 4, 5)), "max_steps": 2000}
    q = RolloutPolicy(model, GreedyRepair(model), trajectories=2, terminal_cost=endgame_only, **cut).q_factors(beside)
    # In closed form the cost is rounded otherwise.
    closed = RolloutPolicy(model, GreedyRepair(model), trajectories=2, terminal_cost=never, **cut).q_factors(beside)
    torch.testing.assert_close(q, closed, rtol=1e-5, atol=0)
    assert all(asked)


def networks(model, kind, encoder):
    generator = torch.Generator().manual_seed(0)
    if kind == "logits":
        return PolicyNetwork(encoder(model), model.num_controls, (8, 4), generator=generator)
    return ValueNetwork(encoder(model), NeverRepairCost(model), (8, 4), generator=generator)


@pytest.mark.parametrize("value", BROKEN)
@pytest.mark.parametrize("encoder", [FlatEncoder, RelativeEncoder])
@pytest.mark.parametrize("kind", ["logits", "state_value"])
def test_weights_that_are_no_numbers_are_refused(linear20, kind, encoder, value):
    """One weight or all, of any layer, whatever uses the network."""
    model = linear20.model
    y = model.with_features(linear20.start(torch.arange(4)))
    for layer in (0, 2, 4):
        for rows in (slice(0, 1), slice(None)):
            network = networks(model, kind, encoder)
            with torch.no_grad():
                # In the last layer -inf and +inf of all controls alike; elsewhere ReLU would make 0 of -inf.
                network.network[layer].bias[rows] = value if layer == 4 else abs(value)
            if kind == "logits" and value == -torch.inf and rows == slice(0, 1) and layer == 4:
                continue
            with pytest.raises(ValueError, match=f"^{kind} of a network must be finite"):
                network(y.copy())
    partitioned = PartitionedPolicy([network] * 6) if kind == "logits" else PartitionedValue([network] * 6)
    with pytest.raises(ValueError, match=f"^{kind} of a network must be finite"):
        partitioned(y.copy())
    if kind == "logits":
        policy, options = network, {}
    else:
        policy, options = GreedyRepair(model), {"max_steps": 3, "terminal_cost": partitioned}
    with pytest.raises(ValueError, match=f"^{kind} of a network must be finite"):
        discounted_costs(model, policy, linear20.start, num_states=3, **options)


def overflowing(cost, dtype=torch.float32, length=20, robots=1):
    return RepairModel(line(length), damage_chain((0.0, 0.3)), (0.0, 1.0, cost), 0.95, num_robots=robots, dtype=dtype)


@pytest.mark.parametrize("allocation", ["uniform", "adaptive"])
@pytest.mark.parametrize("leaves", ["control", "observation"])
@pytest.mark.parametrize(
    ("cost", "dtype", "robots"), [(3e37, torch.float32, 1), (1e38, torch.float32, 2), (1e308, torch.float64, 1)]
)
def test_costs_that_overflow_give_no_control(cost, dtype, robots, leaves, allocation):
    model = overflowing(cost, dtype, robots=robots)
    start = CalibratedStart(model)
    y = model.with_features(start(torch.arange(3)))
    policy = RolloutPolicy(model, GreedyRepair(model), trajectories=3, leaves=leaves, allocation=allocation)
    message = "simulated costs must be finite|q_factors of legal controls must be finite"
    with pytest.raises(ValueError, match=message):
        policy(y.copy())
    with pytest.raises(ValueError, match=message):
        ParallelRollout([policy])(y.copy())
    with pytest.raises(ValueError, match=message):
        PolicyCost(model, GreedyRepair(model))(y.copy())
    with pytest.raises(ValueError, match=message):
        discounted_costs(model, GreedyRepair(model), start, num_states=3)
    if leaves == "control" and robots == 1:
        with pytest.raises(ValueError, match=message):
            MultistepLookahead(policy, 2, branches=1)(y.copy())


def test_large_costs_that_fit_are_compared_as_small_ones():
    """Costs that are multiplied by a power of two decide the same, up to the largest numbers."""
    decisions = []
    for scale in (1.0, 2.0**100):
        model = RepairModel(line(5), damage_chain((0.0, 0.3)), (0.0, scale, 5 * scale), 0.9)
        y = UniformStart(model)(torch.arange(20))
        out = RolloutPolicy(model, GreedyRepair(model), trajectories=4)(y)
        assert out["q_factors"].isinf().equal(~model.action_mask(y))
        decisions.append((out["action"], out["q_factors"] / scale))
    assert torch.equal(decisions[0][0], decisions[1][0])
    torch.testing.assert_close(decisions[0][1], decisions[1][1])


class NothingAllowed(TabularModel):
    """A model that forgets to allow a control in states where the first hidden state is certain."""

    def action_mask(self, y):
        return super().action_mask(y) & (y["belief"][..., :1] < 1.0)


def test_a_state_without_a_legal_control_is_refused():
    known = tiger().model
    model = NothingAllowed(known.transition, known.observation, known.cost, known.discount)
    y = TensorDict({"belief": torch.tensor([[0.5, 0.5], [1.0, 0.0]])}, [2])

    def listen(y):
        return y.set("action", torch.zeros(y.batch_size, dtype=torch.int64))

    policy = RolloutPolicy(model, listen, trajectories=2, max_steps=80)
    assert policy(y[:1].clone())["action"].shape == (1,)
    for user in (policy, MultistepLookahead(policy, 2), ParallelRollout([policy])):
        with pytest.raises(ValueError, match="action_mask must allow at least one control in every state"):
            user(y.clone())
    with pytest.raises(ValueError, match=r"^logits of a network must be finite"):
        PolicyNetwork(FlatEncoder(model), 3, (4,), generator=torch.Generator().manual_seed(0))(model.with_features(y))


def test_beliefs_that_are_no_numbers_are_refused(linear20):
    model = linear20.model
    y = model.with_features(linear20.start(torch.arange(3)))
    y["belief"] = y["belief"].clone()
    y["belief"][1, 7] = torch.nan
    for user in users(model, {}).values():
        with pytest.raises(ValueError, match="'belief' of y"):
            user(y.clone())
    with pytest.raises(ValueError, match="belief"):
        discounted_costs(tiger().model, lambda y: y, FixedBelief(torch.tensor([math.nan, 1.0])), num_states=1)


def test_the_chosen_control_is_the_cheapest_legal_one():
    """For Q-factors of any sign: also where illegal ones would be smaller were they not infinite."""
    model = small_model(line(3), dtype=torch.float32)
    y = model.with_features(random_states(model, 50, 0))
    for offset in (-1e6, 0.0, 1e6):
        out = RolloutPolicy(
            model,
            GreedyRepair(model),
            trajectories=3,
            truncation=AfterSteps(0),
            terminal_cost=lambda y, offset=offset: NeverRepairCost(model).costs(y) + offset,
        )(y.copy())
        q, mask = out["q_factors"], y["action_mask"]
        assert torch.equal(torch.isfinite(q), mask)
        for row in range(50):
            legal = [(float(q[row, u]), u) for u in range(3) if mask[row, u]]
            assert int(out["action"][row]) == min(legal)[1]
