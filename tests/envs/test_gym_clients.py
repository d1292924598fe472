"""Outside clients of Gymnasium's environments, where they are installed."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import torchrl_pomdp  # noqa: F401 (registers the ids)

BELIEFS, OBSERVATIONS = "torchrl_pomdp/PipelineRepair-v0", "torchrl_pomdp/PipelineRepairObservations-v0"
STAGES = 50


def costs(agent, seed=1000):
    """Discounted costs of 100 episodes."""
    envs = gymnasium.make_vec(BELIEFS, num_envs=100, problem="line3", max_episode_steps=STAGES)
    observation, info = envs.reset(seed=seed)
    total, live, discount = np.zeros(100), np.ones(100, bool), envs.unwrapped.model.discount
    for stage in range(STAGES):
        controls, _ = agent.predict(observation, action_masks=info["action_mask"], deterministic=True)
        observation, reward, terminated, truncated, info = envs.step(controls)
        total -= live * reward * discount**stage
        live &= ~(terminated | truncated)
    return total


def test_maskable_ppo_learns(tmp_path):
    sb3 = pytest.importorskip("sb3_contrib")
    env = gymnasium.make(BELIEFS, problem="line3", max_episode_steps=STAGES)
    numbers = {"n_steps": 256, "batch_size": 64, "n_epochs": 4, "gamma": env.unwrapped.model.discount, "learning_rate": 1e-3}
    agent = sb3.MaskablePPO("MultiInputPolicy", env, seed=0, device="cpu", **numbers)
    untrained = costs(agent)
    agent.learn(512)
    # What is saved can be played without the environment.
    agent.save(tmp_path / "agent")
    trained = costs(sb3.MaskablePPO.load(tmp_path / "agent"))
    assert trained.mean() < 0.5 * untrained.mean()


@pytest.mark.parametrize(("id", "problem"), [(OBSERVATIONS, "line3"), (BELIEFS, "network32x8"), (OBSERVATIONS, "network32x8")])
def test_maskable_ppo_plays(id, problem):
    """Observations alone, and many robots whose controls have a mask each."""
    sb3 = pytest.importorskip("sb3_contrib")
    env = gymnasium.make(id, problem=problem, max_episode_steps=STAGES)
    policy = "MlpPolicy" if id == OBSERVATIONS else "MultiInputPolicy"
    agent = sb3.MaskablePPO(policy, env, n_steps=32, batch_size=32, n_epochs=1, seed=0, device="cpu")
    # An illegal control would raise.
    assert agent.learn(64).num_timesteps == 64


def test_records_videos(tmp_path):
    pytest.importorskip("moviepy")
    env = gymnasium.make(BELIEFS, problem="line3", render_mode="rgb_array", max_episode_steps=3)
    env = gymnasium.wrappers.RecordVideo(env, str(tmp_path), episode_trigger=lambda episode: True, disable_logger=True)
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    env.close()
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000
