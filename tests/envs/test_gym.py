"""Gymnasium's single environments: conformance, rewards, masks, seeds, bounds and pictures."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict

from torchrl_pomdp.envs.gym import BeliefSimulation, PomdpEnv, WorldSimulation
from torchrl_pomdp.envs.gym.spaces import entry_array
from torchrl_pomdp.envs.repair import RepairModel, damage_chain, line
from torchrl_pomdp.problems import Problem, make_problem

BELIEFS, OBSERVATIONS = "torchrl_pomdp/PipelineRepair-v0", "torchrl_pomdp/PipelineRepairObservations-v0"
IDS = (BELIEFS, OBSERVATIONS)
# Random start locations, many robots, one without a drawing, a time in the state.
NAMES = ("line3", "grid5x4", "network32x8", "tiger", "maintenance1", "rocksample7x8")


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


def make(id=BELIEFS, problem="line3", **options):
    return gymnasium.make(id, problem=problem, **options)


def played(env, steps=12, seed=0):
    """What an agent that plays random legal controls gets to see."""
    results = [env.reset(seed=seed)]
    env.action_space.seed(seed)
    results += [env.step(env.action_space.sample()) for _ in range(steps)]
    return results


def equal(one, other):
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[key], other[key]) for key in one)
    if isinstance(one, (tuple, list)):
        return len(one) == len(other) and all(map(equal, one, other))
    return np.array_equal(one, other)


def test_conforms_without_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for id in IDS:
            for name in NAMES:
                check_env(make(id, name).unwrapped)


def test_checker_passes_wherever_episodes_start():
    # The checker plays what it drew before its last reset: see LegalDiscrete.
    problem = make_problem("grid5x4")
    for key in range(15):
        check_env(
            PomdpEnv(BeliefSimulation(problem.model, lambda keys, key=key: problem.start(keys + key))), skip_render_check=True
        )


def test_sees_the_exact_belief_after_some_observation_and_pays_its_expected_cost():
    for name in ("tiger", "line3"):
        model = make_problem(name).model
        env = make(problem=name)
        before, info = env.reset(seed=0)
        env.action_space.seed(0)
        for _ in range(20):
            u = torch.as_tensor(env.action_space.sample(mask=info["action_mask"]))
            y = TensorDict({key: torch.as_tensor(entry) for key, entry in before.items()}, [])
            before, reward, _, _, info = env.step(u.numpy())
            assert reward == pytest.approx(-float(model.expected_cost(y, u)), rel=1e-5)
            possible = (model.observation_probs(y, u) > 0).nonzero().flatten()
            after = [model.estimator(y, u, z) for z in possible]
            assert any(all(np.allclose(each[key], before[key], atol=1e-5) for key in before) for each in after)


def test_observations_are_those_of_the_world():
    problem = make_problem("two_robots20")
    env = make(OBSERVATIONS, problem)
    world, levels = problem.model.world(), problem.model.num_levels
    seen, info = env.reset(seed=0)
    # Nothing is seen yet.
    assert seen.tolist() == [levels, levels]
    for _ in range(20):
        before = env.unwrapped._state
        seen, reward, _, _, info = env.step(env.action_space.sample(mask=info["action_mask"]))
        after = env.unwrapped._state
        where = after["location"]
        assert seen.tolist() == after["level"].gather(-1, where).tolist()
        assert reward == pytest.approx(-float(problem.model.costs[before["level"]].sum()), rel=1e-5)
        assert np.array_equal(info["action_mask"], world.action_mask(after).numpy())


@pytest.mark.parametrize("id", IDS)
@pytest.mark.parametrize("name", ["grid5x4", "network32x8"])
def test_masks_are_obeyed(id, name):
    env = make(id, name)
    model = env.unwrapped.model
    _, info = env.reset(seed=1)
    shape = (8, 5) if name == "network32x8" else (5,)
    for _ in range(30):
        mask = info["action_mask"]
        assert mask.dtype == np.int8
        assert mask.shape == shape
        assert np.array_equal(env.get_wrapper_attr("action_masks")(), mask == 1)
        for u in (env.action_space.sample(), env.action_space.sample(mask=mask)):
            assert np.take_along_axis(mask, np.expand_dims(u, -1), -1).all()
        illegal = mask.argmin(-1)
        if not np.take_along_axis(mask, np.expand_dims(illegal, -1), -1).all():
            with pytest.raises(ValueError, match=r"action .* is illegal; legal there: \["):
                env.step(illegal)
        _, _, _, _, info = env.step(u)
    assert env.action_space.shape == model.control_shape


def test_an_illegal_control_changes_nothing():
    env, same = make(), make()
    assert equal(env.reset(seed=0), same.reset(seed=0))
    illegal = int(env.unwrapped.action_masks().argmin())
    with pytest.raises(ValueError, match=f"action {illegal}"):
        env.step(illegal)
    assert equal(env.step(0), same.step(0))


@pytest.mark.parametrize("wrong", [None, 1.0, "0", [0], True, -1, 99, np.array([0]), object()])
def test_refuses_what_is_no_control(wrong):
    env = make()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        env.step(wrong)


@pytest.mark.parametrize("id", IDS)
def test_seeds_repeat_episodes(id):
    env, other = make(id, "linear20"), make(id, "linear20")
    first = played(env)
    assert equal(first, played(other))
    # The episode that follows without a seed, too.
    assert equal(env.reset(), other.reset())
    assert equal(first, played(env))
    assert not equal(first, played(other, seed=1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bounds_hold_where_rounding_passes_them(dtype):
    """Feature states may pass an upper bound by the rounding of sums; what an agent sees may not."""
    model = RepairModel(line(3), damage_chain((0.1,)), (0, 1), 0.9, dtype=dtype)

    def start(keys):
        belief = torch.tensor([0.0, 1.0 + torch.finfo(dtype).eps], dtype=dtype).expand(*keys.shape, 3, 2)
        return TensorDict({"belief": belief, "location": torch.zeros(*keys.shape, 1, dtype=torch.int64)}, keys.shape)

    env = make(problem=Problem(model, start))
    observation, _ = env.reset(seed=0)
    assert env.unwrapped._state["belief"].max() > 1.0
    assert observation["belief"].dtype == np.float32
    assert observation["belief"].max() == 1.0
    assert observation in env.observation_space


def test_entries_without_a_shape_of_their_own_lie_in_the_space():
    box, bits, count = spaces.Box(0.0, 1.0, (), np.float32), spaces.MultiBinary(()), spaces.Discrete(3)
    for space, leaf in ((box, torch.tensor(0.5)), (bits, torch.tensor(True)), (count, torch.tensor(2))):
        assert space.contains(entry_array(space, leaf))


def test_what_is_seen_is_the_agents_own():
    env, same = make(), make()
    observation, info = env.reset(seed=0)
    same.reset(seed=0)
    observation["belief"][:] = 7.0
    info["action_mask"][:] = 0
    assert equal(env.step(0), same.step(0))
    assert env.action_space.sample() is not None


def test_ends_where_no_cost_follows():
    env = make(problem="line3")
    observation, _ = env.reset(seed=0)
    terminated, stages = False, 0
    while not terminated:
        # Repair, or go on to the right and back again.
        legal = env.get_wrapper_attr("action_masks")()
        right = stages // 4 % 2
        u = 0 if legal[0] else next(move for move in ((2, 1) if right else (1, 2)) if legal[move])
        observation, _, terminated, _, _ = env.step(u)
        stages += 1
        assert stages < 200
    assert observation["belief"][:, 0].min() > 1 - 1e-6
    assert env.step(int(env.get_wrapper_attr("action_masks")().argmax()))[1] == 0.0


def test_time_limit_is_gymnasiums():
    env = make(max_episode_steps=3)
    assert [result[3] for result in played(env, 3)[1:]] == [False, False, True]
    assert make().spec.max_episode_steps == 400


def test_takes_presets_files_and_problems(tmp_path):
    path = tmp_path / "pipes.toml"
    path.write_text(
        "repair = {graph.edges = [[0, 1], [1, 2], [1,3]], degradation = [0, 0.1], costs = [0, 1, 5], discount = 0.9}"
    )
    for given in (str(path), path, make_problem("line3"), "line3"):
        assert sorted(make(problem=given).reset(seed=0)[0]) == ["belief", "location"]
    assert make(problem=str(path)).unwrapped.model.num_locations == 4
    with pytest.raises(ValueError, match="problem must be a preset"):
        make(problem="no such problem")
    with pytest.raises(TypeError, match="problem must be a str"):
        make(problem=3)
    with pytest.raises(ValueError, match="options must be among"):
        make().reset(options={"state": 0})


def test_must_be_reset_first():
    problem = make_problem("line3")
    env = PomdpEnv(BeliefSimulation(problem.model, problem.start), "rgb_array")
    for call in (lambda: env.step(0), env.render, env.action_masks):
        with pytest.raises(ResetNeeded):
            call()


def test_copies_go_on_by_themselves():
    problem = make_problem("line3")
    env = PomdpEnv(WorldSimulation(problem.model, problem.start))
    env.reset(seed=0)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    ahead = [env.step(0) for _ in range(3)]
    for each in copies:
        assert equal([each.step(0) for _ in range(3)], ahead)
        assert equal(each.reset(seed=5), env.reset(seed=5))
    # What an agent stores of the space does not hold the problem.
    assert len(pickle.dumps(env.action_space)) < 10_000


# ---- pictures ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("id", IDS)
def test_renders_pixels(id):
    env = make(id, "grid5x4", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    env.step(env.action_space.sample())
    second = env.render()
    assert first.dtype == np.uint8
    assert first.shape == second.shape
    assert first.shape[2] == 3
    assert not any(size % 2 for size in first.shape[:2])
    assert (first != second).any()


def test_says_where_nothing_can_be_drawn():
    with pytest.raises(ValueError, match=r"render_mode must be None for this problem, .* no drawing of a TabularModel"):
        make(problem="tiger", render_mode="rgb_array")
    with pytest.raises(ValueError, match="there is no display here for a window"):
        make(render_mode="human")
    assert make(problem="tiger").unwrapped.metadata["render_modes"] == []
    env = make().unwrapped
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="draws nothing"):
        assert env.render() is None


def test_shows_every_stage_in_a_window(monkeypatch):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    import _window

    monkeypatch.setenv("DISPLAY", ":none")
    before = pyplot.get_backend()
    pyplot.switch_backend("module://_window")
    try:
        check_env(make().unwrapped)
        assert _window.shown
        _window.shown.clear()
        env = make(render_mode="human")
        played(env, 3)
        assert len(_window.shown) == 4
        assert len(set(_window.shown)) == 4
        assert pyplot.get_fignums()
        env.close()
        env.close()
        assert not pyplot.get_fignums()
    finally:
        pyplot.switch_backend(before)


# ---- ids ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("program", ["import torchrl_pomdp, gymnasium", "import gymnasium, torchrl_pomdp"])
def test_the_library_registers_its_ids_in_either_order_and_stays_light(program):
    check = "import sys; print(all(id in gymnasium.registry for id in sys.argv[1:]), 'torch' in sys.modules)"
    command = [sys.executable, "-W", "error", "-c", f"{program}; {check}", *IDS]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.split() == ["True", "False"]
