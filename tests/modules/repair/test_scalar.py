"""Compiled simulations of the repair problem mean what the tensors' way means."""

from __future__ import annotations

import copy
import math
import pickle
import threading
import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import networkx as nx
import numpy as np
import pytest
import torch
from _oracles import Memo, line3_cost, random_states, varied_model
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torch.nn import functional as F

from benchmarks.setting import by_tensors
from torchrl_pomdp.envs import FunctionPartition, SinglePart
from torchrl_pomdp.envs.repair import (
    CalibratedStart,
    Graph,
    RandomState,
    RepairModel,
    RepairPartition,
    damage_chain,
    grid,
    line,
)
from torchrl_pomdp.modules import (
    AfterSteps,
    ConstantCost,
    FlatEncoder,
    MultiagentRollout,
    MultistepLookahead,
    OnEntering,
    OnLeaving,
    ParallelRollout,
    PartitionedPolicy,
    PartitionedValue,
    PolicyCost,
    PolicyNetwork,
    RolloutPolicy,
    TruncatedRollout,
    ZeroCost,
    rollout,
)
from torchrl_pomdp.modules.repair import (
    GreedyRepair,
    NeverRepairCost,
    OldPolicy,
    RelativeEncoder,
    SteadyStateCost,
    UrgencyRepair,
)
from torchrl_pomdp.modules.repair.scalar import expected_cost, repair_engine
from torchrl_pomdp.modules.scalar import Allocation
from torchrl_pomdp.noise import seed_keys
from torchrl_pomdp.planners import POMCP
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.scalar import scalar_twin

COSTS = (0, 0.1, 1, 10, 100)


def without(make):
    """What ``make`` makes, with the compiled loop taken out."""
    return by_tensors(make())


def assert_close(compiled, tensors, share=0.001):
    """To 1e-4, but for one number in a thousand, where rounding moves an observation."""
    assert torch.equal(torch.isfinite(compiled), torch.isfinite(tensors))
    finite = torch.isfinite(tensors)
    error = ((compiled - tensors).abs() / tensors.abs().clamp_min(1e-6))[finite]
    assert int((error > 1e-4).sum()) <= max(1, int(error.numel() * share))
    assert float(error.median()) < 2e-6


@st.composite
def models(draw):
    """Random graphs, chains, costs and numbers of robots."""
    size, robots, levels = draw(st.integers(2, 6)), draw(st.integers(1, 2)), draw(st.integers(2, 5))
    seed = draw(st.integers(0, 10_000))
    tree = nx.random_labeled_tree(size, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    if draw(st.booleans()):
        chain = damage_chain(tuple(torch.rand(levels - 1, generator=generator).mul(0.3).tolist()))
    else:
        chain = torch.rand(levels, levels, generator=generator, dtype=torch.float64).square()
        chain = chain / chain.sum(-1, keepdim=True)
    if draw(st.booleans()):
        chain[0] = torch.eye(levels, dtype=torch.float64)[0]
    costs = torch.rand(levels, generator=generator).cumsum(0) * 10 - (0 if draw(st.booleans()) else 1)
    graph = Graph.from_edges("tree", size, list(tree.edges))
    model = RepairModel(graph, chain, costs.clamp_min(0), 0.9, num_robots=robots)
    return model.with_partition(RepairPartition(graph, model.costs))


def some_states(model, seed, count=40):
    """Random beliefs, among them certain ones and intact locations."""
    generator = torch.Generator().manual_seed(seed)
    shape = (count, model.num_locations, model.num_levels)
    belief = torch.rand(shape, generator=generator).pow(3)
    kind = torch.rand(shape[:2], generator=generator)
    level = torch.randint(model.num_levels, shape[:2], generator=generator)
    belief = torch.where((kind < 0.3).unsqueeze(-1), torch.eye(model.num_levels)[level], belief)
    belief = torch.where((kind > 0.8).unsqueeze(-1), torch.eye(model.num_levels)[0], belief)
    location = torch.randint(model.num_locations, (count, model.num_robots), generator=generator)
    return TensorDict({"belief": belief / belief.sum(-1, keepdim=True), "location": location}, [count])


RULES = {
    "horizon": lambda model: {},
    "steps": lambda model: {"max_steps": 7, "terminal_cost": NeverRepairCost(model)},
    "rule": lambda model: {"truncation": AfterSteps(3), "terminal_cost": SteadyStateCost(model)},
    "entering": lambda model: {"truncation": OnEntering((1, 3, 4, 5)), "terminal_cost": ConstantCost(model, 7.0)},
    "leaving": lambda model: {"truncation": OnLeaving() | AfterSteps(12), "terminal_cost": ZeroCost()},
    "own": lambda model: {
        "truncation": AfterSteps(lambda y: 1 + y["location"][:, 0]) | OnLeaving(),
        "terminal_cost": lambda y: y["belief"][..., -1].sum(-1) + y["partition"],
    },
}


@st.composite
def varied_models(draw):
    """Random graphs whose locations have chains and costs of their own, with 1 to 3 robots whose repairs may fail."""
    size, robots, seed = draw(st.integers(2, 6)), draw(st.integers(1, 3)), draw(st.integers(0, 10_000))
    graph = Graph.from_edges("tree", size, list(nx.random_labeled_tree(size, seed=seed).edges))
    dtype, works = draw(st.sampled_from([torch.float32, torch.float64])), draw(st.sampled_from([0.4, 1.0]))
    model = varied_model(graph, robots, seed=seed, repair_probability=works, dtype=dtype)
    if draw(st.booleans()):
        # Level 0 lasts, is free and is reached by repair alone, in places.
        chain, costs = model.chain.double().clone(), model.costs.clone()
        kept = slice(None) if draw(st.booleans()) else slice(1)
        chain[kept, 0], costs[kept, 0] = torch.eye(3, dtype=torch.float64)[0], 0.0
        chain[kept, 1:, 0] = 0.0
        options = {"num_robots": robots, "repair_probability": works, "dtype": dtype}
        model = RepairModel(graph, chain / chain.sum(-1, keepdim=True), costs, 0.9, **options)
    return model.with_partition(RepairPartition(graph, model.costs))


@settings(max_examples=20, deadline=None, derandomize=True)
@given(models(), st.sampled_from(sorted(RULES)), st.sampled_from([GreedyRepair, UrgencyRepair]), st.integers(0, 1000))
def test_trajectories_and_q_factors_are_those_of_the_tensors(model, rule, kind, seed):
    # Where beliefs have mixed, locations at one distance are equally urgent but for rounding.
    share = 0.1 if kind is UrgencyRepair and not bool((model.chain.tril(-1) == 0).all()) else 0.001
    means_the_same(model, kind(model), some_states(model, seed), RULES[rule](model), seed, share)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(varied_models(), st.sampled_from(sorted(RULES)), st.sampled_from([GreedyRepair, UrgencyRepair]), st.integers(0, 1000))
def test_locations_of_their_own_and_repairs_that_fail(model, rule, kind, seed):
    means_the_same(model, kind(model), random_states(model, 200, seed), RULES[rule](model), seed)


def means_the_same(model, base, y, options, seed, share=0.001):
    """Trajectories and Q-factors by both kinds of leaves, compiled and by tensors."""
    keys = seed_keys(seed, torch.arange(len(y)))

    def trajectories():
        return TruncatedRollout(model, base, **options)

    assert trajectories().scalar is not None
    assert_close(trajectories()(y, keys), without(trajectories)(y, keys), share)
    y = y[:40]
    for leaves, count in (("control", 4), ("observation", 1)):

        def policy(leaves=leaves, count=count):
            return RolloutPolicy(model, base, trajectories=count, leaves=leaves, seed=seed, **options)

        compiled, tensors = policy(), without(policy)
        assert_close(compiled.q_factors(y), tensors.q_factors(y), share)
        assert abs(compiled.simulated_steps / tensors.simulated_steps - 1) < 0.01


# ---- given candidates ------------------------------------------------------------------------------------------------


def candidates_of(model, count, each, seed):
    """Random controls of robots ``[N, C, R]``, also of what is no control, and their numbers; -1 where there is none."""
    generator, base = np.random.default_rng(seed), model.num_robot_controls
    controls = generator.integers(-1, base + 1, (count, each, model.num_robots))
    # The first one moves or stays, so that it is a control.
    controls[:, 0] = generator.integers(0, base, (count, model.num_robots))
    numbers = (controls * base ** np.arange(model.num_robots - 1, -1, -1)).sum(-1)
    return controls, torch.from_numpy(np.where(((controls >= 0) & (controls < base)).all(-1), numbers, -1))


@settings(max_examples=12, deadline=None, derandomize=True)
@given(st.one_of(models(), varied_models()), st.sampled_from(["control", "observation"]), st.integers(0, 1000))
def test_given_candidates_have_the_q_factors_of_all_controls(model, leaves, seed):
    y = some_states(model, seed, 15) if model.dtype == torch.float32 else random_states(model, 15, seed)

    def policy():
        return RolloutPolicy(model, GreedyRepair(model), trajectories=2, leaves=leaves, seed=seed)

    compiled = policy()
    engine, allocation = compiled.cost_to_go.engine(), compiled._allocation(None)
    controls, numbers = candidates_of(model, 15, 7, seed)
    q, steps = engine.q_factors(y, None, seed, allocation, controls)
    whole, _ = engine.q_factors(y, None, seed, allocation)
    found = torch.from_numpy(whole).gather(1, numbers.clamp_min(0)).masked_fill(numbers < 0, torch.inf)
    assert torch.equal(torch.from_numpy(q), found), "to the last bit, whichever others there are"
    assert_close(
        torch.from_numpy(q).to(model.dtype)[numbers >= 0],
        without(policy).q_factors(y).gather(1, numbers.clamp_min(0))[numbers >= 0],
    )
    # Those of one state alone, in another order, and of other blocks.
    alone, fewer = engine.q_factors(y[3:4], None, seed, allocation, controls[3:4, ::-1])
    assert np.array_equal(alone[:, ::-1], q[3:4])
    assert fewer <= steps


def test_candidates_are_checked(linear20):
    model, y = linear20.model, linear20.start(torch.arange(3))
    policy = RolloutPolicy(model, GreedyRepair(model))
    engine, allocation = policy.cost_to_go.engine(), policy._allocation(None)
    for wrong in (
        np.zeros((2, 1, 1), np.int64),
        np.zeros((3, 1, 2), np.int64),
        np.zeros((3, 0, 1), np.int64),
        np.zeros((3, 1), np.int64),
        np.zeros((3, 1, 1), np.int32),
    ):
        with pytest.raises(ValueError, match=r"controls must be int64 of shape \(3, C, 1\) with C at least 1, got int"):
            engine.q_factors(y, None, 0, allocation, wrong)


def test_nothing_is_as_large_as_the_number_of_joint_controls():
    """Ten robots with five controls each have ten million joint controls."""
    model = RepairModel(grid(4, 4), damage_chain((0.0, 0.1, 0.2)), (0, 1, 5, 20), 0.9, num_robots=10, repair_probability=0.8)
    y, keys, base = CalibratedStart(model)(torch.arange(6)), torch.arange(6), UrgencyRepair(model)
    controls = model.split_controls(base(y.clone())["action"]).unsqueeze(1).repeat(1, 3, 1).numpy()
    # The first robot may do something else, too.
    controls[:, 1:, 0] = 0, 1

    def costs():
        return TruncatedRollout(model, base)

    compiled = costs()
    engine, allocation = compiled.engine(), Allocation(np.arange(4), np.array([4]), False, np.inf, None)
    for _ in range(2):
        # What is compiled in the first turn is not counted.
        tracemalloc.start()
        found = compiled(y, keys), engine.q_factors(y, None, 0, allocation, controls)[0]
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert most < 1 << 20
    assert_close(found[0], without(costs)(y, keys))
    legal = model.agent_mask(y).gather(-1, torch.from_numpy(controls).movedim(1, -1)).all(1)
    assert np.array_equal(np.isfinite(found[1]), legal.numpy())


@pytest.mark.parametrize(("kind", "trajectories"), [(GreedyRepair, 40), (UrgencyRepair, 12)])
def test_adaptive_allocation_spends_the_same(linear20, kind, trajectories):
    model, y = linear20.model, linear20.start(torch.arange(25))
    options = {"trajectories": trajectories, "allocation": "adaptive"}
    compiled = RolloutPolicy(model, kind(model), **options)
    tensors = without(lambda: RolloutPolicy(model, kind(model), **options))
    assert_close(compiled.q_factors(y), tensors.q_factors(y))
    assert abs(compiled.simulated_steps / tensors.simulated_steps - 1) < 0.02


def test_whatever_is_made_of_rollouts_agrees(linear20):
    model, y = linear20.model, linear20.start(torch.arange(6))
    greedy, urgency = GreedyRepair(model), UrgencyRepair(model)
    for make in (
        lambda: MultistepLookahead(RolloutPolicy(model, urgency, trajectories=3), depth=2),
        lambda: ParallelRollout([RolloutPolicy(model, base, trajectories=5) for base in (greedy, urgency)]),
    ):
        assert_close(make().q_factors(y), without(make).q_factors(y))

    def cost():
        return PolicyCost(
            model, urgency, trajectories=3, truncation=OnEntering((3, 4, 5)), terminal_cost=NeverRepairCost(model)
        )

    assert_close(cost().costs(y), without(cost).costs(y))


def test_double_precision_agrees(linear20):
    model = RepairModel(grid(3, 3), damage_chain((0.001, 0.02, 0.03, 0.05)), COSTS, 0.99, dtype=torch.float64)
    y, keys = CalibratedStart(model)(torch.arange(20)), torch.arange(20)

    def make():
        return TruncatedRollout(model, GreedyRepair(model))

    torch.testing.assert_close(make()(y, keys), without(make)(y, keys), rtol=1e-12, atol=0)
    q, own = RolloutPolicy(model, GreedyRepair(model)).q_factors(y), without(lambda: RolloutPolicy(model, GreedyRepair(model)))
    assert q.dtype == torch.float64
    torch.testing.assert_close(q, own.q_factors(y), rtol=1e-12, atol=0)


@pytest.mark.parametrize("policy", [GreedyRepair, UrgencyRepair])
def test_in_double_precision_a_billionth_of_damage_is_damage(policy):
    chain = damage_chain((0.0, 0.02, 0.03, 0.05))
    model = RepairModel(line(3), chain, COSTS, 0.99, terminal_probability=0.0, dtype=torch.float64)
    belief = torch.tensor([[1 - 1e-9, 0, 0, 0, 1e-9], [1.0, 0, 0, 0, 0], [0.5, 0.5, 0, 0, 0]], dtype=torch.float64)
    y = model.derive(TensorDict({"belief": belief[None], "location": torch.zeros(1, 1, dtype=torch.int64)}, [1]))
    assert y["action_mask"].tolist() == [[True, False, True]]

    def make():
        return RolloutPolicy(model, policy(model))

    q = make().q_factors(y)
    assert torch.equal(q.isfinite(), y["action_mask"])
    torch.testing.assert_close(q, without(make).q_factors(y), rtol=1e-12, atol=0)


# ---- closed forms --------------------------------------------------------------------------------------------------------


@scalar_twin
def scripted(data, view, controls):
    """As ``data[0]`` says: the first move; the way to where it costs most now; a control that may be illegal."""
    mode, control = data
    for robot in range(len(controls)):
        origin, best, target = view.location[robot], 0.0, -1
        for place in range(len(view.level) if mode == 1 else 0):
            cost = expected_cost(view, place)
            if cost > best:
                best, target = cost, place
        controls[robot] = view.tables.first_moves[origin] if target < 0 else view.tables.first_controls[origin, target]
        if mode == 2:
            controls[robot] = control


class Wanderer(TensorDictModuleBase):
    """Goes back and forth, and never repairs."""

    in_keys, out_keys = ["belief", "location"], ["action"]

    def __init__(self, model):
        super().__init__()
        self.model, self.moves = model, GreedyRepair(model).first_moves

    def scalar_engine(self, model, limits):
        return repair_engine(scripted, (0, 0), self.model, model, limits)

    def forward(self, y):
        return y.set("action", self.model.join_controls(self.moves[y["location"]]))


@pytest.mark.parametrize("drift", [0.0, 0.01])
def test_never_repairing_costs_what_the_closed_form_says(drift):
    """Whatever is seen on the way: on average, and to the last digit where beliefs are certain and damage is."""
    model = RepairModel(line(5), damage_chain((drift, 0.02, 0.03, 0.05)), COSTS, 0.99, dtype=torch.float64)
    y = CalibratedStart(model)(torch.zeros(20_000, dtype=torch.int64))
    cost = TruncatedRollout(model, Wanderer(model), terminal_cost=NeverRepairCost(model))
    assert cost.scalar is not None
    costs = cost(y, torch.arange(20_000))
    exact = NeverRepairCost(model).costs(y)
    assert float((costs.mean() - exact[0]).abs()) < 4 * float(costs.std()) / 20_000**0.5
    certain = RepairModel(line(5), damage_chain((0.0, 1.0, 1.0, 1.0)), COSTS, 0.99, dtype=torch.float64)
    y = some_states(certain, 3).double()
    y["location"] = y["location"].long()
    level = torch.randint(5, (40, 5), generator=torch.Generator().manual_seed(1))
    y["belief"] = torch.eye(5, dtype=torch.float64)[level]
    costs = TruncatedRollout(certain, Wanderer(certain), terminal_cost=NeverRepairCost(certain))(y, torch.arange(40))
    torch.testing.assert_close(costs, NeverRepairCost(certain).costs(y), rtol=1e-12, atol=0)


def test_greedy_on_the_line_of_3_by_enumeration(line3):
    model = line3.model
    exact, _ = line3_cost(model, Memo(model, GreedyRepair(model)))
    cost = TruncatedRollout(model, GreedyRepair(model))
    assert cost.scalar is not None
    costs = cost(line3.start(torch.arange(100_000)), torch.arange(100_000))
    assert abs(float(costs.mean()) - exact) < 4 * float(costs.std()) / 100_000**0.5


# ---- networks ------------------------------------------------------------------------------------------------------------


def networks(model, others=(), hidden=(24, 12), kind=RelativeEncoder):
    encoder, generator = kind(model), torch.Generator().manual_seed(1)
    made = [PolicyNetwork(encoder, model.num_controls, hidden, generator=generator) for _ in range(6)]
    return PartitionedPolicy([others.get(part, made[part]) for part in range(6)] if others else made)


@pytest.mark.parametrize(
    ("robots", "mixed", "kind"),
    [(1, False, RelativeEncoder), (2, True, RelativeEncoder), (1, True, FlatEncoder), (2, False, FlatEncoder)],
)
def test_networks_choose_as_in_batches(robots, mixed, kind):
    graph = grid(3, 3)
    model = RepairModel(graph, damage_chain((0.0, 0.02, 0.03, 0.05)), COSTS, 0.99, num_robots=robots)
    model = model.with_partition(RepairPartition(graph, model.costs))
    urgency = UrgencyRepair(model)
    policy, y = networks(model, {3: urgency, 4: urgency} if mixed else (), kind=kind), CalibratedStart(model)(torch.arange(20))

    def make():
        return RolloutPolicy(model, policy, trajectories=2, max_steps=60, terminal_cost=NeverRepairCost(model))

    compiled = make()
    assert compiled.cost_to_go.scalar is not None
    assert_close(compiled.q_factors(y), without(make).q_factors(y))


@pytest.mark.parametrize(
    ("kind", "lost"), [(UrgencyRepair, None), (UrgencyRepair, 0), (UrgencyRepair, 2), ("networks", None), ("networks", 1)]
)
def test_old_policies_in_a_changed_model(kind, lost):
    """Another chain, other parts, two blocked edges, against which the old policies walk, and maybe a robot that is lost."""
    graphs, costs = (grid(3, 3), grid(3, 3).without_edge(1, 4).without_edge(3, 4)), (0, 0.1, 1, 10)
    robots = (2, 2) if lost is None else (3, 2)
    parts = [RepairPartition(graph, costs, damage_threshold=p) for graph, p in zip(graphs, (0.1, 0.0), strict=True)]
    old, new = (
        RepairModel(graph, damage_chain(rates), costs, 0.95, num_robots=n).with_partition(part)
        for graph, rates, n, part in zip(graphs, [(0.0, 0.02, 0.03), (0.01, 0.1, 0.2)], robots, parts, strict=True)
    )
    policy = networks(old, {0: UrgencyRepair(old)}) if kind == "networks" else kind(old)
    changed, y = OldPolicy(policy, old, new, lost, 0 if lost is None else 5), some_states(new, 3, 100)
    if lost is None:
        walls = old.split_controls(policy(old.derive(y))["action"]), new.agent_mask(y)
        assert not walls[1].gather(-1, walls[0].unsqueeze(-1)).all()
    means_the_same(new, changed, y, {"max_steps": 30, "terminal_cost": SteadyStateCost(new)}, 3)


def test_old_policies_that_are_left_to_tensors(linear20):
    old = linear20.model
    dear = RepairModel(old.graph, old.chain, 2 * old.costs, 0.95)
    assert RolloutPolicy(dear, OldPolicy(UrgencyRepair(old), old, dear)).cost_to_go.scalar is None
    assert RolloutPolicy(old, OldPolicy(lambda y: y, old, old)).cost_to_go.scalar is None


@pytest.mark.parametrize("written", [lambda p: p, lambda p: p.data], ids=["as such", "through data"])
def test_networks_that_are_trained_further_are_read_again(linear20, written):
    """Also where PyTorch counts no new version, as where TorchRL sends weights to a collector."""
    model = linear20.model
    policy = networks(model)
    cost, y, keys = TruncatedRollout(model, policy), linear20.start(torch.arange(8)), torch.arange(8)
    before = cost(y, keys)
    with torch.no_grad():
        for parameter in policy.parameters():
            written(parameter).mul_(-1.0)
    after = cost(y, keys)
    assert not torch.equal(before, after)
    assert_close(after, without(lambda: TruncatedRollout(model, policy))(y, keys))


def test_weights_that_were_good_before_are_read_again(line3):
    """After some that are no numbers; and where rows change places, or a layer lies in memory in another way meanwhile."""
    model, y = line3.model, line3.start(torch.arange(16))
    network = PolicyNetwork(FlatEncoder(model), 3, (16, 16), generator=torch.Generator().manual_seed(0))
    policy = RolloutPolicy(model, network, trajectories=5)
    first, good = policy.q_factors(y), copy.deepcopy(network.state_dict())

    def anew():
        return RolloutPolicy(model, network, trajectories=5).q_factors(y)

    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(-3.0)
        network.network[0].weight[0, 0] = math.nan
    with pytest.raises(ValueError, match="logits of a network must be finite"):
        policy.q_factors(y)
    network.load_state_dict(good)
    assert torch.equal(policy.q_factors(y), first)
    square = network.network[2].weight
    usual = square.data
    for content in (usual.T, usual, torch.eye(16), torch.eye(16).flip(0), torch.eye(16)[[0, 2, 1, *range(3, 16)]]):
        square.data = content
        assert torch.equal(policy.q_factors(y), anew())


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_logits_that_overflow_choose_nothing(linear20, sign):
    model, y = linear20.model, linear20.start(torch.arange(5))
    policy = networks(model)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.fill_(3e38)
        for local in policy.policies:
            local.network[-1].weight.fill_(sign * 3e38)
    with pytest.raises(ValueError, match="base_policy chose an illegal control"):
        TruncatedRollout(model, policy)(y, torch.arange(5))


def test_a_local_network_that_is_replaced_is_another_policy(linear20):
    model, y, keys = linear20.model, linear20.start(torch.arange(8)), torch.arange(8)
    policy, other = networks(model), networks(model)
    cost, q = TruncatedRollout(model, policy), RolloutPolicy(model, policy, trajectories=2)
    before = cost(y, keys), q.q_factors(y)
    for part in range(6):
        policy.policies[part] = other.policies[5 - part]
    assert not torch.equal(cost(y, keys), before[0])
    assert not torch.equal(q.q_factors(y), before[1])
    assert_close(cost(y, keys), without(lambda: TruncatedRollout(model, policy))(y, keys))


def test_networks_of_ones_own_are_left_to_tensors(linear20):
    class Mine(PolicyNetwork):
        pass

    model, y, keys = linear20.model, linear20.start(torch.arange(8)), torch.arange(8)
    mine = [Mine(RelativeEncoder(model), 3, (8,), generator=torch.Generator().manual_seed(0)) for _ in range(6)]
    for policy in (mine[0], PartitionedPolicy(mine), PartitionedPolicy([mine[0]] * 6)):
        rollout_of = TruncatedRollout(model, policy, max_steps=20, terminal_cost=ZeroCost())
        assert rollout_of.engine() is None
        assert rollout_of(y, keys).shape == (8,)


def test_a_policy_whose_helper_is_overridden_is_left_to_tensors(linear20):
    class Stays(GreedyRepair):
        def _robot_control(self, *args):
            return super()._robot_control(*args) * 0

    class Named(GreedyRepair):
        def __init__(self, model):
            super().__init__(model, 0.1)

        def extra_repr(self):
            return "mine"

    assert TruncatedRollout(linear20.model, Stays(linear20.model)).engine() is None
    assert TruncatedRollout(linear20.model, Named(linear20.model)).engine() is not None


@pytest.mark.parametrize("kind", [GreedyRepair, UrgencyRepair])
def test_a_policy_for_another_number_of_robots_is_left_to_tensors(linear20, kind):
    """Whose loop would write beyond its memory."""
    several = make_problem("two_robots20").model
    for policy in (kind(linear20.model), PartitionedPolicy([kind(linear20.model)] * 6)):
        assert TruncatedRollout(several, policy).engine() is None


def test_terminal_costs_that_are_replaced_or_hooked_are_noticed(linear20):
    model, y, keys = linear20.model, linear20.start(torch.arange(8)), torch.arange(8)
    never, steady = NeverRepairCost(model), SteadyStateCost(model)
    value = PartitionedValue([never] * 6)
    cut = {"truncation": AfterSteps(3), "max_steps": 3}
    cost = TruncatedRollout(model, GreedyRepair(model), terminal_cost=value, **cut)
    fresh = [TruncatedRollout(model, GreedyRepair(model), terminal_cost=each, **cut)(y, keys) for each in (never, steady)]
    assert torch.equal(cost(y, keys), fresh[0])
    for part in range(6):
        value.values[part] = steady
    assert torch.equal(cost(y, keys), fresh[1])
    assert not torch.equal(*fresh)
    cost.terminal_cost = never
    assert torch.equal(cost(y, keys), fresh[0])
    hook = never.register_forward_hook(lambda module, given, y: y.set("state_value", torch.zeros(y.batch_size)))
    nothing = TruncatedRollout(model, GreedyRepair(model), terminal_cost=ZeroCost(), **cut)(y, keys)
    assert_close(cost(y, keys), nothing)
    hook.remove()
    assert torch.equal(cost(y, keys), fresh[0])


def test_what_forward_refuses_the_loop_does_not_carry_out(linear20):
    model, y = linear20.model, linear20.start(torch.arange(4))
    network = PolicyNetwork(RelativeEncoder(model), 5, (8,), generator=torch.Generator().manual_seed(0))
    with pytest.raises((ValueError, RuntimeError)):
        TruncatedRollout(model, network)(y, torch.arange(4))
    with pytest.raises(ValueError, match="base_policy must have a local module for each of the model's 6 parts, got 3"):
        TruncatedRollout(model, PartitionedPolicy([GreedyRepair(model)] * 3))
    with pytest.raises(ValueError, match="terminal_cost must have a local module for each of the model's 6 parts, got 2"):
        TruncatedRollout(model, GreedyRepair(model), terminal_cost=PartitionedValue([NeverRepairCost(model)] * 2))
    with pytest.raises(ValueError, match="the model's 1 parts, got 6"):
        TruncatedRollout(linear20.unpartitioned().model, PartitionedPolicy([GreedyRepair(model)] * 6))


def test_threads_that_share_a_rollout_read_whole_weights(linear20):
    """Also where the first of them has only begun to look for the layers."""
    model, y, keys = linear20.model, linear20.start(torch.arange(4)), torch.arange(4)
    policy = networks(model)
    expected = TruncatedRollout(model, policy)(y, keys)
    for _ in range(20):
        cost = TruncatedRollout(model, policy)
        begin = threading.Barrier(4)

        def simulate(_, cost=cost, begin=begin):
            begin.wait()
            return cost(y, keys)

        with ThreadPoolExecutor(4) as pool:
            assert all(torch.equal(found, expected) for found in pool.map(simulate, range(4)))


def test_hooks_and_replaced_forwards_are_left_to_tensors(linear20):
    """Of a network's layers, too, and whenever they come and go."""
    model, y, keys = linear20.model, linear20.start(torch.arange(8)), torch.arange(8)
    policy = networks(model)
    cost, search = TruncatedRollout(model, policy), POMCP(model, policy, simulations=5)
    before = cost(y, keys)
    search(y)
    reverse = [local.network[-1].register_forward_hook(lambda module, given, logits: -logits) for local in policy.policies]
    changed = cost(y, keys)
    assert cost.engine() is None
    assert not torch.equal(changed, before)
    assert_close(changed, without(lambda: TruncatedRollout(model, policy))(y, keys))
    assert TruncatedRollout(model, policy).engine() is None
    with pytest.raises(ValueError, match="base_policy must have a scalar twin"):
        search(y)
    for hook in reverse:
        hook.remove()
    assert torch.equal(cost(y, keys), before)
    search(y)
    layer = policy.policies[0].network[0]
    layer.forward = lambda x: -F.linear(x, layer.weight, layer.bias)
    assert cost.engine() is None
    assert not torch.equal(cost(y, keys), before)
    del layer.forward
    torch.nn.utils.weight_norm(layer)
    assert cost.engine() is None
    with torch.no_grad():
        layer.weight_g.mul_(-1.0)
    assert not torch.equal(cost(y, keys), before)


def test_what_the_loop_does_not_know_is_left_to_tensors(linear20):
    model = linear20.model

    class Other(AfterSteps):
        pass

    own = model.with_partition(FunctionPartition(["even", "odd"], lambda y: y["location"][..., 0] % 2))
    single = PolicyNetwork(RelativeEncoder(model), 3, (8,), generator=torch.Generator().manual_seed(0))
    smooth = copy.deepcopy(single)
    smooth.network[1] = nn.Tanh()
    greedy = GreedyRepair(model)
    zero = {"terminal_cost": ZeroCost()}
    for rollout_of in (
        lambda: TruncatedRollout(model, greedy, truncation=Other(3), **zero),
        lambda: TruncatedRollout(own, greedy, truncation=OnLeaving(), **zero),
        lambda: TruncatedRollout(model, PartitionedPolicy([greedy, UrgencyRepair(model)] * 3)),
        lambda: TruncatedRollout(own, PartitionedPolicy(networks(model).policies[:2])),
        lambda: TruncatedRollout(model, smooth),
        lambda: TruncatedRollout(model, greedy, max_steps=1_000_000, **zero),
        lambda: TruncatedRollout(RepairModel(line(20), damage_chain((0.0, 0.1, 0.1, 0.1)), (0, 1, 1, 1, 1), 0.9), greedy),
        lambda: TruncatedRollout(model, lambda y: greedy(y)),
    ):
        assert rollout_of().scalar is None
    assert TruncatedRollout(own, greedy).scalar is not None
    assert TruncatedRollout(model.with_partition(SinglePart()), greedy, truncation=OnEntering((0,)), **zero).scalar is not None
    assert TruncatedRollout(model, single).scalar is not None


def test_without_numba_tensors_do_all(linear20, monkeypatch):
    model, y = linear20.model, linear20.start(torch.arange(3))
    compiled = RolloutPolicy(model, GreedyRepair(model)).q_factors(y)
    monkeypatch.setattr("torchrl_pomdp.modules.scalar.find_spec", lambda name: None)
    policy = RolloutPolicy(model, GreedyRepair(model))
    assert policy.cost_to_go.scalar is None
    assert_close(compiled, policy.q_factors(y))


# ---- a twin of one's own -------------------------------------------------------------------------------------------------


class Twinned(TensorDictModuleBase):
    in_keys, out_keys = ["belief", "location"], ["action"]

    def __init__(self, model, *data):
        super().__init__()
        self.model, self.data = model, data

    def scalar_engine(self, model, limits):
        return repair_engine(scripted, self.data, self.model, model, limits)

    def forward(self, y):
        costs = y["belief"] @ self.model.costs
        target = costs.argmax(-1)
        origin = y["location"][..., 0]
        control = self.model.first_controls[origin, target]
        return y.set("action", torch.where(costs.amax(-1) > 0, control, GreedyRepair(self.model).first_moves[origin]))


def test_a_twin_of_ones_own(linear20):
    model, y = linear20.model, linear20.start(torch.arange(50))

    def make():
        return RolloutPolicy(model, Twinned(model, 1, 0), trajectories=3)

    assert_close(make().q_factors(y), without(make).q_factors(y))


@pytest.mark.parametrize("control", [-1, 0, 1, 3])
def test_an_illegal_control_of_a_twin_is_refused(linear20, control):
    model, y = linear20.model, linear20.start(torch.arange(50))
    y["location"][:] = 0
    y["belief"][:, 0] = torch.eye(5)[0]
    policy = Twinned(model, 2, control)
    with pytest.raises(ValueError, match="base_policy chose an illegal control in a simulated trajectory"):
        TruncatedRollout(model, policy)(y, torch.arange(50))
    with pytest.raises(ValueError, match="base_policy chose an illegal control in a simulated trajectory"):
        RolloutPolicy(model, policy).q_factors(y)


def test_states_are_checked_as_ever(linear20):
    model, y = linear20.model, linear20.start(torch.arange(4))
    policy = RolloutPolicy(model, GreedyRepair(model))
    for change, kind, message in [
        (lambda y: y["belief"].mul_(0.5), ValueError, "entry 'belief' of y"),
        (lambda y: y["belief"][0].fill_(torch.nan), ValueError, "entry 'belief' of y"),
        (lambda y: y["location"].fill_(20), ValueError, "entry 'location' of y"),
        (lambda y: y.set("belief", y["belief"].double()), TypeError, "entry 'belief' of y has dtype"),
        (lambda y: y.pop("location"), ValueError, "y lacks the entry 'location'"),
    ]:
        wrong = y.clone()
        change(wrong)
        with pytest.raises(kind, match=message):
            policy.q_factors(wrong)
    with pytest.raises(TypeError, match="y must be a TensorDict"):
        policy.q_factors({"belief": 1})
    learning = y.clone()
    learning["belief"].requires_grad_()
    assert torch.equal(policy.q_factors(learning), policy.q_factors(y))
    assert policy.q_factors(y[:0]).shape == (0, 3)
    assert policy.q_factors(y.reshape(2, 2)).shape == (2, 2, 3)
    assert policy.q_factors(y[0]).shape == (3,)


# ---- what does not change anything ---------------------------------------------------------------------------------------


def test_labels_depend_on_the_state_alone(linear20):
    model, y = linear20.model, linear20.start(torch.arange(90))
    for options in ({}, {"allocation": "adaptive", "trajectories": 30}, {"leaves": "observation", "trajectories": 2}):
        policy = RolloutPolicy(model, UrgencyRepair(model), **options)
        whole, order = policy.q_factors(y), torch.randperm(90, generator=torch.Generator().manual_seed(0))
        assert torch.equal(torch.cat([policy.q_factors(part) for part in y.split(7)]), whole)
        assert torch.equal(policy.q_factors(y[order]), whole[order])
        threads = torch.get_num_threads()
        try:
            torch.set_num_threads(3)
            assert torch.equal(policy.q_factors(y), whole)
        finally:
            torch.set_num_threads(threads)


def test_states_may_lie_in_memory_in_any_way(linear20):
    y = linear20.start(torch.arange(12))
    assert not y["belief"].is_contiguous()
    rows = y.apply(torch.Tensor.contiguous)
    apart = TensorDict({key: torch.stack([value, value], -1)[..., 0] for key, value in y.items()}, [12])
    policy = RolloutPolicy(linear20.model, GreedyRepair(linear20.model), trajectories=3)
    q, costs = policy.q_factors(y), policy.cost_to_go(y, torch.arange(12))
    for each in (rows, apart):
        assert torch.equal(policy.q_factors(each), q)
        assert torch.equal(policy.cost_to_go(each, torch.arange(12)), costs)
    assert torch.equal(policy.q_factors(y.view(3, 4)), q.view(3, 4, -1))


def test_copies_have_a_loop_of_their_own(linear20):
    policy = RolloutPolicy(linear20.model, GreedyRepair(linear20.model))
    y = linear20.start(torch.arange(5))
    for other in (copy.deepcopy(policy), pickle.loads(pickle.dumps(policy))):
        assert other.cost_to_go.scalar is not None
        assert other.cost_to_go.scalar is not policy.cost_to_go.scalar
        assert torch.equal(other.q_factors(y), policy.q_factors(y))


# ---- a time for each decision --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("allocation", ["uniform", "adaptive"])
def test_enough_time_is_as_good_as_no_limit(linear20, monkeypatch, compiled, allocation):
    if not compiled:
        monkeypatch.setattr(rollout, "scalar_engine", lambda *_: None)
    model, y = linear20.model, linear20.start(torch.arange(2))
    greedy, options = GreedyRepair(model), {"trajectories": 40, "allocation": allocation}
    limited, free = RolloutPolicy(model, greedy, seconds=1000.0, **options), RolloutPolicy(model, greedy, **options)
    torch.testing.assert_close(limited.q_factors(y), free.q_factors(y), rtol=1e-5, atol=0)
    assert limited.simulated_steps == free.simulated_steps


@pytest.mark.parametrize("compiled", [True, False])
def test_no_time_is_enough_for_the_first_round(linear20, monkeypatch, compiled):
    if not compiled:
        monkeypatch.setattr(rollout, "scalar_engine", lambda *_: None)
    model, y = linear20.model, linear20.start(torch.arange(2))
    policy = RolloutPolicy(model, GreedyRepair(model), trajectories=1000, seconds=1e-9)
    mask = model.action_mask(y)
    assert torch.equal(torch.isfinite(policy.q_factors(y)), mask)
    whole = RolloutPolicy(model, GreedyRepair(model), trajectories=1000)
    whole.q_factors(y)
    assert policy.simulated_steps < 0.01 * whole.simulated_steps
    for depth in (2, 3):
        q = MultistepLookahead(policy, depth=depth).q_factors(y)
        assert torch.equal(torch.isfinite(q), mask)


def test_seconds_must_be_positive(linear20):
    for seconds in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="seconds must be in"):
            RolloutPolicy(linear20.model, GreedyRepair(linear20.model), seconds=seconds)


def test_as_many_trajectories_as_the_time_allows():
    allocation = Allocation(np.arange(100), np.full(25, 4), False, np.inf, 1e-12)
    assert [rounds.tolist() for rounds in allocation.stretches()] == [[4]]
    plenty = list(allocation._replace(seconds=1e6).stretches())
    assert np.concatenate(plenty).tolist() == [4] * 25
    assert len(plenty) < 8


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_where_no_level_costs_more_nothing_is_urgent(dtype):
    """Damage at locations whose levels all cost the same is no target, to the last bit."""
    chain = torch.tensor([[0.7948, 0.2052, 0.0], [0.0, 0.8731, 0.1269], [0.0723, 0.018, 0.9097]], dtype=torch.float64)
    dear, same = [0.0, 1.0, 10.0], [0.7, 0.7, 0.7]
    costs = torch.tensor([*[same] * 4, dear, *[same] * 3, dear])
    model = RepairModel(grid(3, 3), chain / chain.sum(-1, keepdim=True), costs, 0.9, num_robots=3, dtype=dtype)
    y, keys = RandomState(model)(torch.arange(1000)), torch.arange(1000)
    rollout = TruncatedRollout(model, UrgencyRepair(model))
    assert_close(rollout(y, keys), by_tensors(rollout)(y, keys))


@pytest.mark.parametrize("compiled", [True, False])
def test_more_observations_than_can_be_gone_through_are_refused(compiled):
    problem = make_problem("network32x8")
    policy = MultiagentRollout(
        problem.model, GreedyRepair(problem.model), trajectories=1, max_steps=1, terminal_cost=ZeroCost(), leaves="observation"
    )
    policy = policy if compiled else by_tensors(policy)
    assert (policy.cost_to_go.scalar is not None) == compiled
    with pytest.raises(ValueError, match=r"num_observations must be at most 4096 .*, got 5\^8 = 390625"):
        policy(problem.start(torch.arange(1)))


def test_local_modules_need_a_partition():
    own = make_problem("line3").model
    model = RepairModel(own.graph, own.chain.double(), own.costs, own.discount)
    rule = "must have no local modules, as the model has no partition, got 1"
    with pytest.raises(ValueError, match="base_policy " + rule):
        RolloutPolicy(model, PartitionedPolicy([GreedyRepair(model)]))
    with pytest.raises(ValueError, match="terminal_cost " + rule):
        RolloutPolicy(model, GreedyRepair(model), max_steps=2, terminal_cost=PartitionedValue([NeverRepairCost(model)]))
