"""The environment over hidden states, alone and behind the transform that tracks the belief."""

from __future__ import annotations

import copy
import pickle
import warnings
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import Composite
from torchrl.envs import Compose, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_pomdp.envs import BeliefEnv, FixedBelief, Mixture, SinglePart, TabularModel, TrackBelief, WorldEnv
from torchrl_pomdp.envs.gym.simulation import WorldSimulation
from torchrl_pomdp.envs.repair import CalibratedStart, RepairModel, damage_chain, line
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.noise import uniform
from torchrl_pomdp.problems import make_problem, tiger

NAMES = ("line3", "linear20", "two_robots20", "rocksample7x8", "maintenance3", "tiger")
NOT_SEEN_YET = 3


def small_model(costs=(0.0, 1.0, 5.0)):
    """Few locations: many controls are illegal, and states end and start anew."""
    return RepairModel(line(4), damage_chain((0.0, 0.3)), costs, 0.9)


def small(batch=(), seed=None):
    model = small_model()
    return WorldEnv(model, CalibratedStart(model), batch_size=batch, seed=seed)


def tracked(batch=(), seed=None):
    env = small(batch, seed)
    return TransformedEnv(env, TrackBelief(env.model))


def doors(name, batch):
    problem = make_problem(name)
    world = WorldEnv(problem.model, problem.start, batch_size=batch, seed=0)
    return world, TransformedEnv(world, TrackBelief(problem.model)), BeliefEnv(problem.model, problem.start, batch_size=batch)


@pytest.mark.parametrize(
    ("name", "batch"),
    [
        *(("line3", batch) for batch in ((), (4,), (2, 3))),
        *(("two_robots20", batch) for batch in ((), (2, 3))),
        ("linear20", (4,)),
        ("rocksample7x8", ()),
        ("maintenance3", (2, 3)),
        ("tiger", (4,)),
    ],
)
def test_specs_hold_at_both_ends_of_the_transform(name, batch):
    world, env, belief = doors(name, batch)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env_specs(world)
        check_env_specs(world, seed=0)
        check_env_specs(env)
        check_env_specs(env, seed=0)
    data, expected = env.rollout(20, break_when_any_done=False), belief.rollout(2)
    assert data.batch_size == torch.Size((*batch, 20))
    for found, known in ((data, expected), (data["next"], expected["next"])):
        assert set(found.keys()) == set(known.keys()) | {"observation"}
        assert all(found[key].dtype == known[key].dtype for key in known.keys() if key != "next")  # noqa: SIM118
    assert data["action_mask"].gather(-1, data["action"].unsqueeze(-1)).all()


def test_the_hidden_state_stays_inside():
    world, env, _ = doors("linear20", (5,))
    for data in (world.rollout(4), env.rollout(4)):
        assert not {"hidden", "level"} & {str(part) for key in data.keys(True) for part in (key, *key)}
    before = world.hidden
    before["level"].fill_(4)
    assert not torch.equal(world.hidden["level"], before["level"]), "what is handed out is a copy"


def test_priors_and_observations():
    env = small((50,), seed=0)
    td = env.reset()
    assert (td["observation"] == NOT_SEEN_YET).all()
    prior = td["prior"].clone()
    for _ in range(5):
        td = env.step(env.rand_action(td))["next"].exclude("reward")
        place = env.hidden["location"]
        assert torch.equal(td["observation"], env.hidden["level"].gather(-1, place).squeeze(-1))
        assert (td["prior"] == prior).all()


def test_rewards_are_the_costs_of_the_hidden_state_before_the_control():
    env = small((50,), seed=0)
    td = env.reset()
    for _ in range(5):
        level = env.hidden["level"]
        td = env.step(env.rand_action(td))["next"]
        assert torch.equal(-td["reward"].squeeze(-1), env.model.costs[level].sum(-1))
        td = td.exclude("reward")


@pytest.mark.parametrize("name", NAMES)
def test_the_hidden_state_is_always_possible_by_the_belief(name):
    """Also where some systems have started anew and others have not."""
    world, env, _ = doors(name, (40,))
    env.append_transform(StepCounter(9))
    td = env.reset()
    for stage in range(30):
        hidden = world.hidden
        if "state" in hidden:
            assert (td["belief"].gather(-1, hidden["state"].unsqueeze(-1)) > 0).all()
        elif "level" in hidden:
            assert (td["belief"].gather(-1, hidden["level"].unsqueeze(-1)) > 0).all()
        else:
            assert torch.where(hidden["good"], td["belief"] > 0, td["belief"] < 1).all()
        for key in {"location", "time"} & set(hidden.keys()):
            assert torch.equal(hidden[key], td[key])
        _, td = env.step_and_maybe_reset(env.rand_action(td))
        if stage == 4:
            flags = torch.arange(40).unsqueeze(-1) % 3 == 0
            td = env.reset(td.set("_reset", flags))


@pytest.mark.parametrize("make", [small, tracked])
@pytest.mark.parametrize("batch", [(7,), (3, 2)])
def test_partial_resets_touch_only_their_rows(make, batch):
    env = make(batch, seed=0)
    base = getattr(env, "base_env", env)
    td = env.rollout(3)[..., -1]["next"].exclude("reward")
    hidden, flags = base.hidden, torch.zeros(*batch, 1, dtype=torch.bool)
    flags.view(-1)[[1, 4]] = True
    after = env.reset(td.clone().set("_reset", flags))
    changed = (base.hidden["level"] != hidden["level"]).any(-1) | (base.hidden["location"] != hidden["location"]).any(-1)
    assert changed.flatten().nonzero().flatten().tolist() == [1, 4]
    kept = ~flags.squeeze(-1)
    assert (after[kept] == td[kept]).all()
    assert (after["observation"][flags.squeeze(-1)] == NOT_SEEN_YET).all()
    drawn = torch.stack([env.action_spec.rand() for _ in range(40)], -1)
    mask = after["action_mask"] if "action_mask" in after else base.world.action_mask(base.hidden)
    assert mask.gather(-1, drawn).all(), "random controls are legal in all rows"
    nxt = env.step(env.rand_action(after))["next"]
    assert (nxt["observation"] < NOT_SEEN_YET).all()


@pytest.mark.parametrize("make", [small, tracked])
def test_seeds(make):
    first, second = make((5,), 3), make((5,), 3)
    a, b = first.rollout(8, break_when_any_done=False), second.rollout(8, break_when_any_done=False)
    assert (a == b).all()
    assert first.set_seed(9) == second.set_seed(9)
    assert (first.rollout(8) == second.rollout(8)).all()
    first.set_seed(None)
    second.set_seed(None)
    assert not torch.equal(first.rollout(8)["action"], second.rollout(8)["action"])
    state = torch.random.get_rng_state()
    make((5,)).rollout(8)
    assert torch.equal(torch.random.get_rng_state(), state), "the global generator is left alone"


@pytest.mark.parametrize("make", [small, tracked])
def test_copies_go_on_as_the_environment_does(make):
    env = make((4,), 0)
    env.rollout(3)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected = env.rollout(10, break_when_any_done=False)
    for other in copies:
        assert (other.rollout(10, break_when_any_done=False) == expected).all()


def test_torchrls_tools_play_in_it():
    for env in (tracked((3,)), SerialEnv(2, partial(tracked, (3,))), SerialEnv(2, partial(small, (3,)))):
        if not isinstance(env, TransformedEnv) and "prior" in env.observation_spec.keys():  # noqa: SIM118
            env = TransformedEnv(env, Compose(StepCounter(30), TrackBelief(small_model())))
        check_env_specs(env)
        frames = 40 * env.batch_size.numel()
        for policy in (None, GreedyRepair(small_model())):
            options = {"frames_per_batch": frames, "total_frames": frames, "auto_register_policy_transforms": False}
            collector = Collector(env, policy, **options)
            (data,) = collector
            assert data["action_mask"].gather(-1, data["action"].unsqueeze(-1)).all()
            assert data["next", "done"].any()
            collector.shutdown(close_env=False)


# ---- ends ------------------------------------------------------------------------------------------------------------


def start_of(belief, place=0):
    def start(keys):
        y = TensorDict({"belief": torch.tensor(belief), "location": torch.tensor([place])})
        return y.expand(keys.shape).clone()

    return start


def test_an_episode_ends_when_it_is_known_that_nothing_is_damaged():
    """The hidden state is terminal all the time where the draw has it so: nobody knows before the robot has looked."""
    model = small_model()
    belief = [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [1.0, 0.0, 0.0]]
    world = WorldEnv(model, start_of(belief), batch_size=(64,), seed=0)
    env = TransformedEnv(world, TrackBelief(model))
    td = env.reset()
    intact = (world.hidden["level"] == 0).all(-1)
    assert 16 < intact.sum() < 48
    assert torch.equal(world.world.is_terminal(world.hidden), intact)
    assert not td["terminated"].any()
    right = torch.full((64,), 2)
    for stage in range(2):
        td = env.step(td.set("action", right))["next"].exclude("reward")
        ended = intact if stage == 1 else torch.zeros_like(intact)
        assert torch.equal(td["terminated"].squeeze(-1), ended), "two steps to the right the robot sees"
        assert torch.equal(td["done"], td["terminated"])


def test_the_world_alone_ends_with_its_hidden_state():
    model = small_model()
    belief = [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [1.0, 0.0, 0.0]]
    env = WorldEnv(model, start_of(belief), batch_size=(64,), seed=0)
    td = env.reset()
    assert torch.equal(td["terminated"].squeeze(-1), (env.hidden["level"] == 0).all(-1))
    assert torch.equal(td["done"], td["terminated"])


def test_no_cost_is_counted_after_the_end():
    """Where damage remains that is too improbable to go on for."""
    belief = [[1 - 2e-7, 2e-7, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    model = small_model((0.0, 1.0, 5.0))
    world = WorldEnv(model, start_of(belief), batch_size=(8,), seed=0)
    env = TransformedEnv(world, TrackBelief(model))
    td = env.reset()
    assert td["terminated"].all()
    world._inside["hidden", "level"][:, 0] = 1
    after = env.step(env.rand_action(td))["next"]
    assert (after["reward"] == 0).all()
    assert after["terminated"].all()


def test_costs_of_intact_locations_are_paid_for_ever_by_every_door():
    """Beliefs and hidden states pay the same on average, though all may be intact without anyone knowing."""
    model = small_model((0.5, 1.0, 5.0))
    start, expected = start_of([[0.5, 0.5, 0.0]] * 4), 4 * 0.75
    by_belief = BeliefEnv(model, start, batch_size=(8192,), seed=0).rollout(1)["next", "reward"]
    world = TransformedEnv(WorldEnv(model, start, batch_size=(8192,), seed=0), TrackBelief(model))
    by_world = world.rollout(1)["next", "reward"]
    assert float(by_belief.mean()) == pytest.approx(-expected)
    assert float(by_world.mean()) == pytest.approx(-expected, abs=0.03)
    hidden, keys = WorldSimulation(model, start), torch.arange(8192)
    cost, after = hidden.step(hidden.start(keys), torch.full((8192,), 2), keys)
    assert float(cost.mean()) == pytest.approx(expected, abs=0.03)
    assert not hidden.over(after).any()


def test_finished_rows_stay_as_they_are():
    data = tracked((16,), seed=0).rollout(200, GreedyRepair(small_model()), break_when_all_done=True)
    assert 5 < data.batch_size[1] < 200
    assert data["next", "terminated"].any(1).all()
    for env in (small((6,), seed=0), tracked((6,), seed=0)):
        base = getattr(env, "base_env", env)
        td = env.step(env.rand_action(env.reset()))["next"].exclude("reward")
        moved, hidden = torch.arange(6) < 2, base.hidden
        out = env.step(env.rand_action(td.clone()).set("_step", moved))["next"]
        assert (base.hidden[2:] == hidden[2:]).all()
        assert (out["reward"].squeeze(-1)[2:] == 0).all()
        assert (out.exclude("reward")[2:] == td[2:]).all()
        assert (out["reward"].squeeze(-1)[:2] < 0).any()


# ---- refusals --------------------------------------------------------------------------------------------------------


def test_a_model_without_hidden_states_is_refused():
    class Blind(TabularModel):
        def world(self):
            return super(TabularModel, self).world()

    known = tiger().model
    blind = Blind(known.transition, known.observation, known.cost, 0.9)
    with pytest.raises(TypeError, match=r"model has no hidden states: Blind must override world\(\)"):
        WorldEnv(blind, tiger().start)


def test_a_step_before_the_first_reset_is_refused():
    env = small((2,))
    with pytest.raises(ValueError, match=r"call reset\(\) first"):
        env.step(TensorDict({"action": torch.zeros(2, dtype=torch.int64)}, [2]))
    with pytest.raises(ValueError, match=r"call reset\(\) first"):
        _ = env.hidden


def test_controls_that_cannot_be_carried_out_are_refused_and_change_nothing():
    model = small_model()
    env = WorldEnv(model, start_of([[0.5, 0.5, 0.0]] * 4), batch_size=(3,), seed=0)
    td, hidden = env.reset(), env.hidden
    with pytest.raises(ValueError, match=r"action 1 at batch index \(2,\) is illegal; legal there: \[0, 2\]"):
        env.step(td.clone().set("action", torch.tensor([0, 2, 1])))
    assert (env.hidden == hidden).all()
    # A repair where nothing is broken can be carried out: only who knows that it is so may not.
    known = WorldEnv(model, start_of([[1.0, 0.0, 0.0]] + [[0.5, 0.5, 0.0]] * 3), batch_size=(3,), seed=0)
    repair = torch.zeros(3, dtype=torch.int64)
    known.step(known.reset().set("action", repair))
    env = TransformedEnv(known, TrackBelief(model))
    td, hidden = env.reset(), known.hidden
    with pytest.raises(ValueError, match=r"action 0 at batch index \(0,\) is illegal; legal there: \[2\]"):
        env.step(td.clone().set("action", repair))
    assert (known.hidden == hidden).all()
    with pytest.raises(TypeError, match="action must be"):
        env.step(td.clone())
    with pytest.raises(ValueError, match="y lacks the entry 'belief'"):
        env.step(td.exclude("belief").set("action", repair))
    assert (known.hidden == hidden).all()
    assert (env.step(td.set("action", repair + 2))["next", "location"] == 1).all()


def test_the_transform_needs_a_world_of_its_model():
    problem, model = make_problem("line3"), small_model()
    with pytest.raises(ValueError, match="TrackBelief needs a WorldEnv"):
        check_env_specs(TransformedEnv(BeliefEnv(model, CalibratedStart(model)), TrackBelief(model)))
    for other in (problem.model, tiger().model):
        with pytest.raises(
            ValueError, match=r"model must be of the environment's entries .*'belief': \(4, 3\).*3 observations"
        ):
            check_env_specs(TransformedEnv(small(), TrackBelief(other)))
    with pytest.raises(RuntimeError, match="TrackBelief works in an environment only"):
        TrackBelief(model)(small().reset())


def test_another_partition_and_other_probabilities_fit():
    problem = make_problem("linear20")
    single = problem.model.with_partition(SinglePart())
    env = TransformedEnv(WorldEnv(problem.model, problem.start, batch_size=(3,), seed=0), TrackBelief(single))
    assert (env.rollout(5)["partition"] == 0).all()
    wrong = RepairModel(line(4), damage_chain((0.0, 0.8)), (0.0, 1.0, 5.0), 0.9)
    env = TransformedEnv(small((30,), 0), TrackBelief(wrong))
    data = env.rollout(40, GreedyRepair(wrong), break_when_any_done=False)
    assert (data["next", "belief"] >= 0).all()


def test_an_observation_that_the_model_rules_out_is_refused():
    known = tiger().model
    sure = TabularModel(known.transition, torch.eye(2).expand(3, 2, 2), known.cost, 0.9)
    env = TransformedEnv(WorldEnv(known, FixedBelief(torch.tensor([1.0, 0.0])), batch_size=(99,), seed=0), TrackBelief(sure))
    with pytest.raises(ValueError, match=r"observation 1 at batch index \(\d+,\) is impossible after this control"):
        env.step(env.reset().set("action", torch.zeros(99, dtype=torch.int64)))


def test_moving_and_setting_states_are_refused():
    env = tracked((2,))
    assert env.to("cpu") is env
    with pytest.raises(ValueError, match="build the model on meta"):
        env.to("meta")
    with pytest.raises(NotImplementedError, match="does not support deterministic resets"):
        env.reset(env.reset(), set_state=True)


def test_costs_that_are_no_numbers_are_refused():
    model = RepairModel(line(20), damage_chain((0.0, 0.9)), (0.0, 1.0, 3e37), 0.95)
    env = WorldEnv(model, CalibratedStart(model), batch_size=(40,), seed=0)
    with pytest.raises(ValueError, match="cost of the world must be finite, got inf"):
        env.rollout(5, break_when_any_done=False)


def test_the_hidden_state_does_not_depend_on_how_the_start_was_drawn():
    """Of a mixture, whose generators draw from keys of their own."""
    problem, keys = make_problem("tiger"), torch.arange(8000)

    def start(keys):
        p = uniform(keys, 0)
        return TensorDict({"belief": torch.stack([1 - p, p], -1)}, keys.shape)

    for generator in (start, Mixture([start], [1.0])):
        y = generator(keys)
        hidden, p = problem.model.world().sample(y, keys)["state"], y["belief"][:, 1]
        for low in (0.0, 0.25, 0.5, 0.75):
            share = hidden[(p >= low) & (p < low + 0.25)].double().mean()
            assert share == pytest.approx(low + 0.125, abs=0.04)


def test_a_models_spec_need_not_name_a_device():
    class Plain(TabularModel):
        def state_spec(self, batch_size=()):
            return Composite(dict(super().state_spec(batch_size).items()), shape=batch_size)

    given = tiger().model
    model = Plain(given.transition, given.observation, given.cost, given.discount)
    assert model.state_spec().device is None
    env = TransformedEnv(WorldEnv(model, tiger().start, batch_size=(2,), seed=0), TrackBelief(model))
    assert env.rollout(3)["belief"].shape == (2, 3, 2)
