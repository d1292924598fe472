"""Rollout policies copy, pickle and go to workers: a copy does what the original did, and is another one."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from functools import partial

import pytest
import torch
from torchrl.collectors import MultiSyncCollector

from torchrl_pomdp.collectors import PartSampler, PolicyEvaluation, RolloutImprovement
from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.modules import (
    AfterSteps,
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
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, RelativeEncoder, SteadyStateCost, UrgencyRepair
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.trainers import PolicyIterationConfig, papi_nt, r_nt, r_t

PROBLEM = make_problem("line3")
MODEL, GREEDY, NEVER = PROBLEM.model, GreedyRepair(PROBLEM.model), NeverRepairCost(PROBLEM.model)
STATES = MODEL.with_features(torch.cat([states(torch.arange(2)) for states in PROBLEM.training]))
CUT = {"trajectories": 2, "truncation": OnEntering((3, 4, 5)) | AfterSteps(15), "terminal_cost": NEVER}


def networks():
    encoder, generator = RelativeEncoder(MODEL), torch.Generator().manual_seed(0)
    policies = [PolicyNetwork(encoder, 3, (8, 5), generator=generator) for _ in range(6)]
    values = [ValueNetwork(encoder, NEVER, (8,), generator=generator) for _ in range(6)]
    return PartitionedPolicy(policies), PartitionedValue(values)


POLICY, VALUE = networks()

MAKE = {
    "TruncatedRollout": lambda: TruncatedRollout(MODEL, GREEDY),
    "TruncatedRollout, cut": lambda: TruncatedRollout(
        MODEL, POLICY, truncation=OnEntering((3, 4, 5)), terminal_cost=VALUE, max_steps=20
    ),
    "RolloutPolicy": lambda: RolloutPolicy(MODEL, GREEDY, trajectories=3),
    "RolloutPolicy, adaptive": lambda: RolloutPolicy(MODEL, GREEDY, leaves="observation", allocation="adaptive", seed=4, **CUT),
    "RolloutPolicy of one": lambda: RolloutPolicy(MODEL, RolloutPolicy(MODEL, GREEDY, **CUT), **CUT),
    "MultistepLookahead": lambda: MultistepLookahead(RolloutPolicy(MODEL, GREEDY, **CUT), 2, 2, 0.3),
    "ParallelRollout": lambda: ParallelRollout(
        [RolloutPolicy(MODEL, base(MODEL), **CUT) for base in (GreedyRepair, UrgencyRepair)]
    ),
    "PolicyCost": lambda: PolicyCost(MODEL, POLICY, seed=2, **CUT),
    "PolicyCost of a rollout": lambda: PolicyCost(MODEL, RolloutPolicy(MODEL, GREEDY, **CUT), **CUT),
    "PartitionedPolicy": lambda: PartitionedPolicy(
        [GREEDY] * 2 + [RolloutPolicy(MODEL, GREEDY, **CUT)] + list(POLICY.policies)[3:]
    ),
    "PartitionedValue": lambda: PartitionedValue([NEVER] * 3 + list(VALUE.values)[3:]),
    "r_nt": lambda: r_nt(PROBLEM, GREEDY, trajectories=3),
    "r_t": lambda: r_t(PROBLEM, GREEDY, SteadyStateCost(MODEL), trajectories=3, max_steps=20),
    "r_t with values": lambda: r_t(PROBLEM, POLICY, VALUE, trajectories=3, max_steps=20),
}
WAYS = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda module: pickle.loads(pickle.dumps(module)),
}


def results(module):
    y = STATES.clone()
    if isinstance(module, TruncatedRollout):
        return {"cost": module(y, torch.arange(len(y)))}
    out = module(y)
    return {key: out[key] for key in module.out_keys}


def tensors(module):
    return {t.data_ptr() for t in (*module.parameters(), *module.buffers()) if t.numel()}


@pytest.mark.parametrize("way", ["deepcopy", "pickle"])
@pytest.mark.parametrize("name", MAKE)
def test_a_copy_gives_the_same_results_and_is_another_one(name, way):
    original = MAKE[name]()
    expected = results(original)
    copied = WAYS[way](original)
    assert type(copied) is type(original)
    assert not tensors(original) & tensors(copied), "no tensor is shared"
    assert tensors(copied) or not tensors(original)
    before = getattr(original, "simulated_steps", 0)
    found = results(copied)
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[key], expected[key]) for key in expected)
    assert getattr(original, "simulated_steps", 0) == before
    again = results(original)
    assert all(torch.equal(again[key], expected[key]) for key in expected), "and leaves the original as it was"
    mine, others = ([m for m in module.modules() if isinstance(m, TruncatedRollout)] for module in (original, copied))
    assert len(mine) == len(others)
    for one, other in zip(mine, others, strict=True):
        assert one._lock is not other._lock
        assert one._transition.__self__ is one
        assert other._transition.__self__ is other, "it steps with its own policy"


@pytest.mark.parametrize("way", ["deepcopy", "pickle"])
def test_changing_the_weights_of_a_copy_changes_it_alone(way):
    original = RolloutPolicy(MODEL, networks()[0], trajectories=3, max_steps=20, terminal_cost=NEVER)
    copied, expected = WAYS[way](original), results(original)
    with torch.no_grad():
        for parameter in copied.parameters():
            parameter.neg_()
    assert not torch.equal(results(copied)["q_factors"], expected["q_factors"])
    assert torch.equal(results(original)["q_factors"], expected["q_factors"])
    with torch.no_grad():
        for parameter in original.parameters():
            parameter.neg_()
    assert torch.equal(results(original)["q_factors"], results(copied)["q_factors"])


@pytest.mark.parametrize("way", ["deepcopy", "pickle"])
def test_what_is_to_be_compiled_copies_too(way):
    """Without running it, which would take a compiler."""
    for make in (TruncatedRollout, RolloutPolicy):
        original = make(MODEL, GREEDY, compile=True)
        copied = WAYS[way](original)
        rollouts = [m for module in (original, copied) for m in module.modules() if isinstance(m, TruncatedRollout)]
        assert [rollout._compile for rollout in rollouts] == [True, True]
        assert rollouts[0]._transition is not rollouts[1]._transition


def test_shared_parts_stay_shared_within_a_copy():
    policy = copy.deepcopy(RolloutPolicy(MODEL, POLICY, truncation=AfterSteps(9), terminal_cost=VALUE, max_steps=20))
    encoders = {id(network.encoder) for network in policy.cost_to_go.base_policy.policies}
    assert len(encoders) == 1, "networks that share an encoder are evaluated together"
    assert policy.model is policy.cost_to_go.model
    policies = list(copy.deepcopy(r_t(PROBLEM, GREEDY, NEVER)).policies)
    assert len(set(policies)) == 2


@pytest.mark.parametrize("kind", [RolloutImprovement, PolicyEvaluation])
def test_rollout_policies_are_base_policies_of_the_label_collectors(kind):
    base = RolloutPolicy(MODEL, GREEDY, **CUT)
    label = {RolloutImprovement: RolloutPolicy, PolicyEvaluation: PolicyCost}[kind]
    states = PartSampler(dict(enumerate(PROBLEM.training)), seed=0)
    collector = kind(
        BeliefEnv(MODEL, PROBLEM.start),
        base,
        states=states,
        label=partial(label, **CUT),
        frames_per_batch=12,
        total_frames=12,
    )
    batch = next(iter(collector))
    labeller = label(MODEL, RolloutPolicy(MODEL, GREEDY, **CUT), **CUT)
    expected = labeller(MODEL.with_features(states(torch.arange(12))))
    for key in labeller.out_keys:
        assert torch.equal(batch[key], expected[key])
    assert base.simulated_steps > 0
    assert collector.labeller is not base


def test_copies_of_policies_are_simulated_by_compiled_loops_too():
    pytest.importorskip("numba")
    policy = PartitionedPolicy([GREEDY, *[UrgencyRepair(MODEL)] * 5])
    for each in (GREEDY, UrgencyRepair(MODEL), policy, pickle.loads(pickle.dumps(GREEDY))):
        assert (TruncatedRollout(MODEL, each).scalar is None) == (each is policy)
        assert (TruncatedRollout(MODEL, copy.deepcopy(each)).scalar is None) == (each is policy)
    options = {"states": PROBLEM.training[0], "frames_per_batch": 2, "total_frames": 2}
    collector = RolloutImprovement(BeliefEnv(MODEL, PROBLEM.start), GREEDY, **options)
    assert collector.labeller.cost_to_go.scalar is not None
    assert TruncatedRollout(make_problem("linear20").model, GREEDY).scalar is None, "another graph"


@pytest.mark.parametrize("cost", [NEVER, SteadyStateCost(MODEL), PartitionedValue([NEVER] * 6)])
def test_copies_of_closed_forms_are_closed_forms_too(cost):
    """So that a label is the same to the last bit, whether or not a collector or a partition stands around it."""
    pytest.importorskip("numba")
    own, copied = (TruncatedRollout(MODEL, GREEDY, terminal_cost=each, max_steps=5) for each in (cost, copy.deepcopy(cost)))
    assert own.scalar.closed
    assert copied.scalar.closed
    assert torch.equal(own(STATES, torch.arange(len(STATES))), copied(STATES, torch.arange(len(STATES))))
    other = PartitionedValue([NEVER, *[NeverRepairCost(MODEL)] * 5])
    assert not TruncatedRollout(MODEL, GREEDY, terminal_cost=other).scalar.closed


def test_local_policies_are_replaced_by_others_that_read_more():
    network = PolicyNetwork(RelativeEncoder(MODEL), 3, generator=torch.Generator().manual_seed(0))
    # Hooks are for tensors, to which the features that are read matter.
    network.register_forward_hook(lambda *_: None)
    policy, keys = PartitionedPolicy([GREEDY] * 6), torch.arange(4)
    cost, fresh = TruncatedRollout(MODEL, policy), TruncatedRollout(MODEL, PartitionedPolicy([network] * 6))
    y = PROBLEM.start(keys)
    before = cost(y, keys)
    for part in range(6):
        policy.policies[part] = network
    after = cost(y, keys)
    assert cost.scalar is None
    assert torch.equal(after, fresh(y, keys))
    assert not torch.equal(after, before)


def test_policy_iteration_starts_from_a_rollout_policy():
    config = PolicyIterationConfig(
        iterations=1,
        samples_per_part=6,
        trajectories=1,
        least_steps=1,
        epochs=1,
        hidden=(4, 3),
        max_steps=8,
        visits_per_label=0.1,
        validation_states=5,
    )
    base = RolloutPolicy(MODEL, GREEDY, **(CUT | {"trajectories": 1, "truncation": AfterSteps(2)}))
    iterations = [list(papi_nt(PROBLEM, replace(config), base)) for _ in range(2)]
    ((one,), (other,)) = iterations
    for mine, theirs in zip(one.policy.parameters(), other.policy.parameters(), strict=True):
        assert torch.equal(mine, theirs)


def test_a_rollout_policy_is_the_actor_of_several_workers():
    def make_env():
        problem = make_problem("line3")
        return BeliefEnv(problem.model, problem.start, seed=0)

    workers = MultiSyncCollector(
        [make_env],
        RolloutPolicy(MODEL, GREEDY, **CUT),
        frames_per_batch=12,
        total_frames=12,
        use_buffers=False,
        cat_results="stack",
    )
    try:
        batches = [batch.clone() for batch in workers]
    finally:
        workers.shutdown()
    data = torch.cat([batch.reshape(-1) for batch in batches])
    again = RolloutPolicy(MODEL, GREEDY, **CUT)(data.select("belief", "location").clone())
    assert torch.equal(data["action"], again["action"]), "its decisions are those of the states"
    assert data["action_mask"].gather(1, data["action"].unsqueeze(1)).all()
    assert len(data) == 12
