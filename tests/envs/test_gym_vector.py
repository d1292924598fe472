"""Gymnasium's vector environments: one batch, the same episodes as single environments, Gymnasium's autoreset."""

from __future__ import annotations

import warnings
from unittest import mock

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from torchrl_pomdp.problems import make_problem

BELIEFS, OBSERVATIONS = "torchrl_pomdp/PipelineRepair-v0", "torchrl_pomdp/PipelineRepairObservations-v0"
IDS = (BELIEFS, OBSERVATIONS)


def make(id=BELIEFS, problem="line3", num_envs=5, **options):
    return gymnasium.make_vec(id, num_envs=num_envs, problem=problem, **options)


def assert_close(one, other):
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_close(one[key], other[key])
        return
    assert one.dtype == other.dtype
    np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("id", IDS)
@pytest.mark.parametrize("name", ["line3", "network32x8", "maintenance1"])
def test_episodes_are_those_of_single_environments(id, name):
    """Two episodes after the first one included: Gymnasium's own loop of single environments says what is right."""
    problem = make_problem(name)
    batch, loop = (make(id, problem, max_episode_steps=6, vectorization_mode=mode) for mode in (None, "sync"))
    assert batch.observation_space == loop.observation_space
    assert batch.single_action_space == loop.single_action_space
    results = batch.reset(seed=3), loop.reset(seed=3)
    ends = 0
    for _ in range(20):
        for one, other in zip(*results, strict=True):
            assert_close(one, other)
        assert results[0][0] in batch.observation_space
        u = batch.action_space.sample(mask=results[0][-1]["action_mask"])
        results = batch.step(u), loop.step(u)
        ends += int((results[0][2] | results[0][3]).sum())
    assert ends >= 10


def test_makes_without_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        envs = make(max_episode_steps=2)
        envs.reset(seed=0)
        envs.step(envs.action_space.sample())
    assert envs.spec.id == BELIEFS
    assert envs.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.NEXT_STEP
    assert make().unwrapped.max_episode_steps == 400


def test_is_one_batch_of_the_model():
    envs = make(num_envs=64)
    envs.reset(seed=0)
    model = envs.unwrapped.model
    with mock.patch.object(model, "advance", wraps=model.advance) as advance:
        envs.step(envs.action_space.sample())
    assert advance.call_count == 1
    assert advance.call_args.args[1].shape == (64,)


def test_ended_rows_start_anew_in_the_next_step_whatever_their_control():
    envs = make(num_envs=3, max_episode_steps=2)
    _, info = envs.reset(seed=0, options={})
    # The rows end at different stages: one is started anew alone.
    envs.step(envs.action_space.sample())
    _, info = envs.reset(seed=[None, 7, None], options={"reset_mask": np.array([False, True, False])})
    _, reward, _, truncated, info = envs.step(envs.action_space.sample())
    assert truncated.tolist() == [True, False, True]
    assert (reward < 0).all()
    controls = np.where([True, False, True], info["action_mask"].argmin(-1), info["action_mask"].argmax(-1))
    observation, reward, _, truncated, _ = envs.step(controls)
    assert (reward < 0).tolist() == [False, True, False]
    assert truncated.tolist() == [False, True, False]
    first = gymnasium.make(BELIEFS, problem="line3")
    first.reset(seed=2)
    expected, _ = first.reset()
    np.testing.assert_allclose(observation["belief"][2], expected["belief"], atol=1e-6)
    # The row that runs on must obey its mask.
    with pytest.raises(ValueError, match=r"action 9 at batch index \(0,\) is illegal"):
        envs.step(np.array([9, 0, 0]))


def test_an_illegal_control_changes_nothing():
    envs, same = make(), make()
    _, info = envs.reset(seed=0)
    same.reset(seed=0)
    with pytest.raises(ValueError, match="is illegal; legal there"):
        envs.step(info["action_mask"].argmin(-1))
    for one, other in zip(envs.step(info["action_mask"].argmax(-1)), same.step(info["action_mask"].argmax(-1)), strict=True):
        assert_close(one, other)


@pytest.mark.parametrize("id", IDS)
@pytest.mark.parametrize("name", ["grid5x4", "network32x8"])
def test_random_controls_are_legal(id, name):
    envs = make(id, name)
    _, info = envs.reset(seed=0)
    for _ in range(10):
        for u in (envs.action_space.sample(), envs.action_space.sample(mask=info["action_mask"])):
            assert np.take_along_axis(info["action_mask"], u[..., None], -1).all()
        assert np.array_equal(envs.unwrapped.action_masks(), info["action_mask"] == 1)
        *_, info = envs.step(u)


def test_episode_statistics_are_sums_of_rewards():
    envs = RecordEpisodeStatistics(make(num_envs=4, max_episode_steps=5))
    envs.reset(seed=0)
    returns, lengths, ended, found = np.zeros(4), np.zeros(4, int), np.zeros(4, bool), 0
    for _ in range(17):
        _, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
        returns, lengths = np.where(ended, 0.0, returns + reward), np.where(ended, 0, lengths + 1)
        ended = terminated | truncated
        if ended.any():
            np.testing.assert_allclose(info["episode"]["r"][ended], returns[ended])
            assert (info["episode"]["l"][ended] == lengths[ended]).all()
            found += ended.sum()
    assert found >= 8


def test_seeds():
    envs, other = make(num_envs=3), make(num_envs=3)
    assert_close(envs.reset(seed=4)[0], other.reset(seed=[4, 5, 6])[0])
    assert_close(envs.reset()[0], other.reset()[0])
    one, two = make(num_envs=100), make(num_envs=100)
    assert not np.array_equal(one.reset()[0]["belief"], two.reset()[0]["belief"])
    with pytest.raises(ValueError, match="seed must be one number, or 3 of them"):
        envs.reset(seed=[1, 2])


def test_start_and_steps_have_noise_of_their_own():
    """The first observation has the model's law, whatever the hidden state was drawn from."""
    envs = make(OBSERVATIONS, "tiger", num_envs=4000)
    envs.reset(seed=0)
    heard, *_ = envs.step(np.zeros(4000, int))
    state = envs.unwrapped._state["state"].numpy()
    for each in (0, 1):
        right = (heard == each)[state == each]
        assert right.mean() == pytest.approx(0.85, abs=4 * np.sqrt(0.85 * 0.15 / right.size))


def test_realised_costs_have_the_mean_of_expected_costs():
    """The two ids are two doors to one problem: under controls that do not look, costs agree on average."""
    sums = []
    for id in IDS:
        envs = make(id, "line3", num_envs=2000)
        envs.reset(seed=0)
        total = np.zeros(2000)
        # Repair twice where one stands is legal in the belief as well only if it may be broken; to move is always.
        for stage in range(4):
            masks = envs.unwrapped.action_masks()
            controls = np.where(masks[:, 1 + stage % 2], 1 + stage % 2, 2 - stage % 2)
            total += envs.step(controls)[1]
        sums.append(total)
    error = np.sqrt(sum(each.var() / 2000 for each in sums))
    assert abs(sums[0].mean() - sums[1].mean()) < 4 * error
    # The belief's expectation varies less.
    assert sums[0].std() < sums[1].std()


@pytest.mark.parametrize(
    "mask", [[True, False, False], np.ones(2, bool), np.ones(3), np.zeros(3, bool)], ids=["list", "two", "float", "none"]
)
def test_refuses_wrong_reset_masks(mask):
    envs = make(num_envs=3)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="reset_mask of options must be a bool array of shape"):
        envs.reset(options={"reset_mask": mask})


def test_must_be_reset_first():
    envs = make(num_envs=2)
    for call in (lambda: envs.step(np.zeros(2, int)), lambda: envs.reset(options={"reset_mask": np.ones(2, bool)})):
        with pytest.raises(ResetNeeded):
            call()


def test_renders_each_episode():
    envs = make(num_envs=2, render_mode="rgb_array")
    envs.reset(seed=0)
    frames = envs.render()
    assert len(frames) == 2
    assert (frames[0] != frames[1]).any()
    with pytest.raises(ValueError, match="render_mode must be one of rgb_array"):
        make(render_mode="ansi")
