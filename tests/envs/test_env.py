from __future__ import annotations

import warnings

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_pomdp.envs import BeliefEnv, FixedBelief
from torchrl_pomdp.envs.repair import RandomState, RepairModel, damage_chain, line
from torchrl_pomdp.modules import TruncatedRollout, ZeroCost
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.problems import make_problem, tiger


def repair_env(batch_size=(), seed=0):
    problem = make_problem("linear20")
    return BeliefEnv(problem.model, problem.start, batch_size=batch_size, seed=seed)


def tiger_env(batch_size=(), seed=0):
    return BeliefEnv(tiger().model, FixedBelief(torch.tensor([0.5, 0.5])), batch_size=batch_size, seed=seed)


@pytest.mark.parametrize("make", [repair_env, tiger_env])
@pytest.mark.parametrize("batch", [(), (7,), (3, 2)])
def test_specs_hold_for_free_and_fixed_batches(make, batch):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env_specs(make(batch_size=batch), seed=0)
        free = make()
        check_env_specs(free, tensordict=free.reset(TensorDict(batch_size=batch)))
    rollout = make(batch_size=batch).rollout(5)
    assert rollout.batch_size[: len(batch)] == torch.Size(batch)
    assert rollout["next", "reward"].shape == (*rollout.batch_size, 1)


@pytest.mark.parametrize("batch", [(7,), (3, 2)])
def test_partial_resets_touch_only_their_rows(batch):
    env = repair_env(batch)
    y = env.rollout(4)[..., -1]["next"].exclude("reward")
    flags = torch.zeros(*batch, 1, dtype=torch.bool)
    flags.view(-1)[1] = True
    after = env.reset(y.clone().set("_reset", flags), set_state=False)
    changed = (after["belief"] != y["belief"]).flatten(-2).any(-1)
    assert changed.flatten().nonzero().flatten().tolist() == [1]


def test_nested_seeds_reproduce_and_differ():
    first, second = repair_env((5,)), repair_env((5,))
    assert first.set_seed(3) == second.set_seed(3), "the next seed follows from the seed"
    a, b = first.rollout(6), second.rollout(6)
    assert (a == b).all()
    first.set_seed(first.set_seed(3))
    assert not torch.equal(first.rollout(6)["belief"], a["belief"])


def test_random_actions_are_legal_and_use_the_environments_generator():
    env = repair_env((200,))
    state = torch.random.get_rng_state()
    rollout = env.rollout(50, break_when_any_done=False)
    assert rollout["action_mask"].gather(-1, rollout["action"].unsqueeze(-1)).all()
    assert len(rollout["action"].unique()) == 3
    assert torch.equal(torch.random.get_rng_state(), state), "the global generator is left alone"


def test_environment_and_engine_walk_the_same_trajectory(linear20, monkeypatch):
    model, greedy = linear20.model, GreedyRepair(linear20.model)
    env = repair_env((16,))
    y = env.reset(linear20.start(torch.arange(16)), set_state=True)
    env.set_seed(11)
    generator = torch.Generator().manual_seed(11)
    noise = [torch.rand((16, model.noise_dim), generator=generator) for _ in range(20)]
    rollout = env.rollout(20, greedy, tensordict=y.clone(), auto_reset=False, break_when_any_done=False)
    cost = -(rollout["next", "reward"].squeeze(-1) * model.discount ** torch.arange(20)).sum(1)

    monkeypatch.setattr(Scenarios, "draw", lambda self, age, names, count: (torch.stack(noise)[age, self.keys], self))
    rollout_of = TruncatedRollout(model, greedy, max_steps=20, terminal_cost=ZeroCost())
    # The noise is that of tensors here.
    rollout_of.scalar = None
    engine = rollout_of(y, torch.arange(16))
    torch.testing.assert_close(engine, cost, rtol=1e-5, atol=0)
    state = model.with_features(y)
    for step in range(20):
        for key in ("belief", "location", "action_mask", "partition"):
            assert torch.equal(state[key], rollout[key][:, step])
        _, state = model.advance(state, greedy(state.copy())["action"], noise[step])


def test_no_cost_after_termination(linear20):
    env = repair_env()
    y = linear20.start(torch.arange(8))
    y["belief"][:] = torch.eye(5)[0]
    y["belief"][4:, 3] = torch.tensor([1 - 1e-8, 0, 0, 0, 1e-8])
    y = env.reset(y, set_state=True)
    assert y["terminated"].all()
    nxt = env.step(env.rand_action(y))["next"]
    assert nxt["terminated"].all()
    assert (nxt["reward"] == 0).all()


def test_rollouts_stop_when_all_are_done(linear20):
    for env in (repair_env(), repair_env((8,))):
        y = env.reset(linear20.start(torch.arange(8)), set_state=True)
        done = env.rollout(200, GreedyRepair(linear20.model), tensordict=y, auto_reset=False, break_when_all_done=True)
        assert 20 < done.shape[1] < 150


def test_illegal_and_malformed_actions_are_refused():
    env = repair_env((3,))
    y = env.reset()
    y["location"][1] = 0
    y = env.reset(y, set_state=True)
    bad = y.clone().set("action", torch.tensor([0, 1, 0]))
    bad["action"][[0, 2]] = y["action_mask"][[0, 2]].long().argmax(-1)
    with pytest.raises(ValueError, match=r"action 1 at batch index \(1,\) is illegal; legal there: "):
        env.step(bad)
    with pytest.raises(ValueError, match="action must be int64 of shape"):
        env.step(y.clone().set("action", torch.zeros(3)))


def test_states_that_do_not_fit_are_refused_by_reset():
    env = repair_env()
    with pytest.raises(ValueError, match="'belief' of y has shape"):
        env.reset(TensorDict({"belief": torch.ones(2, 5), "location": torch.zeros(2, 1).long()}, [2]), set_state=True)


def test_moving_to_another_device_is_refused():
    env = repair_env()
    assert env.to("cpu") is env
    with pytest.raises(ValueError, match="build the model on meta"):
        env.to("meta")


def test_rewards_that_are_no_numbers_are_refused():
    model = RepairModel(line(20), damage_chain((0.0, 0.9)), (0.0, 1.0, 3e37), 0.95)
    env = BeliefEnv(model, RandomState(model), batch_size=(40,), seed=0)
    with pytest.raises(ValueError, match="expected_cost of the model must be finite, got inf"):
        env.rollout(5)


@pytest.mark.filterwarnings("ignore:A reset tensordict carrying state:FutureWarning")
@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: TransformedEnv(env, StepCounter())])
def test_flags_beside_states_are_refused(wrap):
    """TorchRL would set the states that are there, and rows that are over would stay so."""
    problem = make_problem("line3")
    env = wrap(BeliefEnv(problem.model, problem.start, batch_size=(2,), seed=0))
    y = env.reset().set("_reset", torch.tensor([[True], [False]]))
    for options in ({}, {"set_state": True}):
        with pytest.raises(ValueError, match="tensordict has states and the flags '_reset'"):
            env.reset(y.clone(), **options)
    after = env.reset(y.clone(), set_state=False)
    assert not torch.equal(after["belief"][0], y["belief"][0])
    assert torch.equal(after["belief"][1], y["belief"][1])
