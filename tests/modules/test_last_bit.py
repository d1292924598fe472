"""A network's output and a label are functions of the state and the seed, to the last bit."""

from __future__ import annotations

import pytest
import torch
from _oracles import random_states, small_model
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_pomdp.envs import TabularModel
from torchrl_pomdp.envs.repair import RepairPartition, grid, line
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
    ValueNetwork,
    ZeroCost,
)
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, RelativeEncoder, UrgencyRepair

COUNT = 60


def model_of(graph, robots, dtype):
    """Three levels and odd sizes, so that rows start at odd addresses."""
    partition = RepairPartition(graph, torch.tensor([0.0, 1.0, 5.0]))
    return small_model(graph, num_robots=robots, dtype=dtype, partition=partition)


def plane_states(y):
    """The same states, each entry with the batch innermost, as a simulation keeps them."""
    planes = {key: leaf.movedim(0, -1).contiguous().movedim(-1, 0) for key, leaf in y.items()}
    return TensorDict(planes, y.batch_size)


def values(function, y):
    result = function(y.copy())
    if isinstance(result, torch.Tensor):
        return result
    logits = result.get("logits", None)
    return result["state_value"] if logits is None else logits


@st.composite
def ways(draw):
    """How the states are computed: order, sizes of the pieces, layout, threads, gradients."""
    order = draw(st.permutations(range(COUNT)))
    # A single row is always among them; few pieces, since each costs a call.
    sizes = [1, *draw(st.lists(st.integers(7, 70), min_size=1, max_size=4))]
    return order, sizes, draw(st.booleans()), draw(st.integers(1, 3)), draw(st.booleans())


def another_way(function, y, way):
    """The values of ``function`` at ``y`` ``[COUNT]``, computed in the given way."""
    order, sizes, planes, threads, gradients = way
    before = torch.get_num_threads()
    found, start = [], 0
    shuffled = y[torch.tensor(order)]
    try:
        torch.set_num_threads(threads)
        with torch.set_grad_enabled(gradients):
            while start < COUNT:
                piece = shuffled[start : start + sizes[len(found) % len(sizes)]]
                start += piece.batch_size[0]
                found.append(values(function, plane_states(piece) if planes else piece.clone()).detach())
    finally:
        torch.set_num_threads(before)
    return torch.cat(found)[torch.tensor(order).argsort()]


def networks():
    """Every pair of a graph, a precision, an encoder and layers."""
    single, double, flat, relative = torch.float32, torch.float64, FlatEncoder, RelativeEncoder
    for graph, robots, dtype, encoder, hidden in (
        (line(7), 1, single, flat, (16, 8)),
        (line(7), 1, double, relative, (33, 1, 5)),
        (grid(3, 3), 1, single, relative, (33, 1, 5)),
        (grid(3, 3), 1, double, flat, (16, 8)),
        (line(5), 2, single, flat, (33, 1, 5)),
        (line(5), 2, double, relative, (16, 8)),
    ):
        yield pytest.param(graph, robots, dtype, encoder, hidden, id=f"{graph.name}-{dtype}-{encoder.__name__}-{hidden}")


@pytest.mark.parametrize(("graph", "robots", "dtype", "encoder", "hidden"), networks())
@settings(max_examples=3, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(way=ways())
def test_outputs_of_networks(graph, robots, dtype, encoder, hidden, way):
    model = model_of(graph, robots, dtype)
    y, shared = model.with_features(random_states(model, COUNT, 0)), encoder(model)
    generator, scale = torch.Generator().manual_seed(0), NeverRepairCost(model)
    policies = [PolicyNetwork(shared, model.num_controls, hidden, generator=generator) for _ in range(6)]
    costs = [ValueNetwork(shared, scale, hidden, generator=generator) for _ in range(6)]
    for function in (policies[0], costs[0], PartitionedPolicy(policies), PartitionedValue(costs)):
        assert torch.equal(another_way(function, y, way), values(function, y).detach())


@settings(max_examples=2, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(way=ways())
def test_networks_of_the_papers_size(linear20, way):
    y = linear20.model.with_features(linear20.start(torch.arange(COUNT)))
    for encoder in (FlatEncoder(linear20.model), RelativeEncoder(linear20.model)):
        generator = torch.Generator().manual_seed(0)
        for network in (
            PolicyNetwork(encoder, 3, generator=generator),
            ValueNetwork(encoder, NeverRepairCost(linear20.model), generator=generator),
        ):
            assert torch.equal(another_way(network, y, way), values(network, y).detach())


def labellers(model):
    """Everything that labels states, with a base policy and a terminal cost that are networks."""
    encoder, generator = RelativeEncoder(model), torch.Generator().manual_seed(0)
    policy = PartitionedPolicy([PolicyNetwork(encoder, model.num_controls, (9, 4), generator=generator) for _ in range(6)])
    cost = PartitionedValue([ValueNetwork(encoder, NeverRepairCost(model), (9,), generator=generator) for _ in range(6)])
    cut = {"truncation": OnEntering((3, 4, 5)) | AfterSteps(6), "terminal_cost": cost, "chunk_rows": 200}
    simple = RolloutPolicy(model, GreedyRepair(model), trajectories=2, **cut)
    return {
        "control": RolloutPolicy(model, policy, trajectories=3, **cut).q_factors,
        "observation": RolloutPolicy(model, policy, trajectories=2, leaves="observation", **cut).q_factors,
        "adaptive": RolloutPolicy(model, policy, trajectories=5, allocation="adaptive", **cut).q_factors,
        "parallel": ParallelRollout([simple, RolloutPolicy(model, UrgencyRepair(model), trajectories=2, **cut)]).q_factors,
        "two steps": MultistepLookahead(simple).q_factors,
        "cost": PolicyCost(model, policy, trajectories=3, **cut).costs,
    }


# Labels take longer: in pieces of odd sizes, shuffled, with the batch innermost, in two threads, with gradients.
SHUFFLED = torch.randperm(COUNT, generator=torch.Generator().manual_seed(0)).tolist()
A_WAY = SHUFFLED, [37, 1, 18], True, 2, True


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_labels_of_repair_problems(dtype):
    model = model_of(line(7), 1, dtype)
    y = random_states(model, COUNT, 1)
    for name, label in labellers(model).items():
        assert torch.equal(another_way(label, y, A_WAY), values(label, y)), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("states", [2, 33, 64])
def test_labels_of_tabular_problems(states, dtype):
    generator = torch.Generator().manual_seed(states)
    moves, sees = (torch.rand(3, states, n, generator=generator) for n in (states, 4))
    cost = torch.rand(states, 3, generator=generator).T
    model = TabularModel(moves / moves.sum(-1, keepdim=True), sees / sees.sum(-1, keepdim=True), cost, 0.9, dtype=dtype)
    belief = torch.rand(COUNT, states, generator=generator).to(dtype)
    y = TensorDict({"belief": belief / belief.sum(-1, keepdim=True)}, [COUNT])
    network = PolicyNetwork(FlatEncoder(model), 3, (8,), generator=generator)
    cut = {"max_steps": 4, "terminal_cost": ZeroCost()}
    for label in (
        RolloutPolicy(model, network, trajectories=3, **cut).q_factors,
        RolloutPolicy(model, network, trajectories=4, leaves="observation", allocation="adaptive", **cut).q_factors,
        PolicyCost(model, network, trajectories=2, **cut).costs,
    ):
        assert torch.equal(another_way(label, y, A_WAY), values(label, y))
