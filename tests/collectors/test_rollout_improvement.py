from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import PendulumEnv

from torchrl_pomdp.collectors import PartSampler, RolloutImprovement
from torchrl_pomdp.envs import BeliefEnv, FixedBelief
from torchrl_pomdp.modules import FlatEncoder, MultistepLookahead, PolicyNetwork, RolloutPolicy, ZeroCost
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.problems import make_problem, tiger

LABEL = partial(RolloutPolicy, trajectories=2, max_steps=80, terminal_cost=ZeroCost())


def make_env():
    problem = make_problem("linear20")
    return BeliefEnv(problem.model, problem.start)


def make_policy():
    return GreedyRepair(make_problem("linear20").model)


def make_states():
    return PartSampler(dict(enumerate(make_problem("linear20").training)), seed=3)


def collector(frames_per_batch=30, total_frames=60, **kwargs):
    return RolloutImprovement(
        make_env(),
        make_policy(),
        states=make_states(),
        frames_per_batch=frames_per_batch,
        total_frames=total_frames,
        label=LABEL,
        **kwargs,
    )


@pytest.fixture(scope="module")
def reference():
    return torch.cat(list(collector()))


def test_batches_are_flat_and_complete(reference):
    batches = list(collector())
    assert [batch.batch_size for batch in batches] == [torch.Size([30])] * 2
    keys = set(batches[0].keys(include_nested=True, leaves_only=True))
    assert keys == {
        "belief", "location", "action_mask", "partition", "action", "q_factors",
        ("collector", "mask"), ("collector", "traj_ids"),
    }  # fmt: skip
    assert batches[0]["collector", "mask"].all()
    assert batches[0]["action_mask"].gather(1, batches[0]["action"].unsqueeze(1)).all()
    assert (torch.cat(batches) == reference).all()


@pytest.mark.parametrize("frames", [10, 20, 60])
def test_the_same_states_have_the_same_labels_in_any_batch_size(reference, frames):
    assert (torch.cat(list(collector(frames))) == reference).all()


def test_any_number_of_workers_makes_the_same_data(reference):
    workers = MultiSyncCollector(
        [make_env] * 2,
        make_policy(),
        collector_class=partial(RolloutImprovement, states=make_states(), label=LABEL, num_workers=2),
        frames_per_batch=30,
        total_frames=60,
        use_buffers=False,
        cat_results="stack",
    )
    try:
        data = torch.cat([batch.reshape(-1) for batch in workers])
    finally:
        workers.shutdown()
    for key in ("belief", "action", "q_factors", "partition"):
        assert torch.equal(data[key], reference[key])


def test_resumes_from_its_state():
    first = iter(source := collector(total_frames=-1))
    next(first)
    state = source.state_dict()
    expected = next(first)
    again = collector(total_frames=-1)
    again.load_state_dict(state)
    assert (next(iter(again)) == expected).all()


def test_keeps_its_own_copy_of_the_policy(linear20):
    network = PolicyNetwork(FlatEncoder(linear20.model), 3, (4, 3), generator=torch.Generator().manual_seed(0))
    data = [
        RolloutImprovement(make_env(), network, states=make_states(), frames_per_batch=6, total_frames=6, label=LABEL)
        for _ in range(2)
    ]
    before = next(iter(data[0]))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
    assert (next(iter(data[1])) == before).all()


@pytest.mark.parametrize("take", [lambda new: (), lambda new: (new,), lambda new: (TensorDict.from_module(new),)])
def test_the_policy_gets_the_weights_that_it_is_given(linear20, take):
    """By default those that the caller's policy has now."""

    def network(seed):
        return PolicyNetwork(FlatEncoder(linear20.model), 3, (4,), generator=torch.Generator().manual_seed(seed))

    given = network(0)
    source = RolloutImprovement(make_env(), given, states=make_states(), frames_per_batch=6, label=LABEL)
    next(iter(source))
    given.load_state_dict(network(1).state_dict())
    source.update_policy_weights_(*take(network(1)))
    y = linear20.model.with_features(linear20.start(torch.arange(50)))
    assert torch.equal(source.labeller.q_factors(y), LABEL(linear20.model, network(1)).q_factors(y))
    assert not torch.equal(source.labeller.q_factors(y), LABEL(linear20.model, network(0)).q_factors(y))


def test_tabular_models_are_labelled_by_the_same_collector():
    model = tiger().model
    start = FixedBelief(torch.tensor([0.5, 0.5]))

    def open_left(y):
        return y.set("action", torch.ones(y.batch_size, dtype=torch.int64))

    source = RolloutImprovement(
        BeliefEnv(model, start), open_left, states=start, frames_per_batch=4, total_frames=4, label=LABEL
    )
    batch = next(iter(source))
    assert batch["action"].tolist() == [0] * 4, "listening beats opening a door blindly"
    assert batch["q_factors"].shape == (4, 3)


@pytest.mark.parametrize("counts", [True, False])
def test_any_module_makes_labels(counts):
    """Lookahead of several steps; one that counts no simulated steps."""
    problem = tiger()

    def label(model, policy):
        if counts:
            return MultistepLookahead(RolloutPolicy(model, policy, trajectories=2))
        return TensorDictModule(lambda belief: (belief[..., 0].long(), belief), ["belief"], ["action", "q_factors"])

    listen, starts = problem.base_policies["listen"], problem.start
    source = RolloutImprovement(
        BeliefEnv(problem.model, starts), listen, states=starts, frames_per_batch=4, total_frames=4, label=label
    )
    assert next(iter(source))["action"].tolist() == [0] * 4
    assert (source.simulated_steps > 0) == counts


def test_other_environments_are_refused():
    with pytest.raises(TypeError, match="must give a BeliefEnv, got PendulumEnv"):
        RolloutImprovement(PendulumEnv(), make_policy(), states=make_states(), frames_per_batch=4)
    with pytest.raises(ValueError, match="num_workers"):
        collector(num_workers=0)
