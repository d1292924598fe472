"""Cases of the test of refusals: hidden states and their environment; see the cases of planning."""

from __future__ import annotations

import torch
from _hostile import Hostile, entries, keys, no_states, objects, seeds, sequences, states, wrong_actions
from _refusals_planning import SHAPES
from _valid import KEYS, a_start, belief_model, case, model, on_tensordict, problem, start, state, two_robots
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from torchrl_pomdp import envs

__all__ = ["WORLDS"]

# fmt: off

CONTROLS = torch.full((2,), 2)


def world_env() -> envs.WorldEnv:
    return envs.WorldEnv(model(), start(), batch_size=(2,), seed=0)


def hidden() -> TensorDictBase:
    return model().world().sample(state(), KEYS)


def hidden_states() -> list[Hostile]:
    valid = hidden()
    level = {
        "negative": -1 - valid["level"], "too large": valid["level"] + 99, "float": valid["level"].float(),
        "int32": valid["level"].to(torch.int32), "of shape [N]": KEYS, "complex": valid["level"].to(torch.complex64),
    }
    place = {"negative": -1 - valid["location"], "too large": valid["location"] + 99, "of shape [N]": KEYS}
    return [*no_states(valid, "level", "location"), *entries(valid, "level", level), *entries(valid, "location", place)]


def controls() -> list[Hostile]:
    wrong = [(h.label, h.value["action"]) for h in wrong_actions(state())]
    left = ("off the graph", torch.ones(2, dtype=torch.int64))
    none = [("None", None), ("a number", 2), ("a list", [2, 2])]
    return [Hostile(label, value, names=("action",)) for label, value in [*wrong, left, *none]]


def one_for_each() -> list[Hostile]:
    return [*keys(), Hostile("one key for two states", KEYS[:1]), Hostile("three keys", torch.arange(3))]


WORLDS = {
    "envs.World.sample": lambda _: case(model().world().sample, y=(state(), states(state())), keys=(KEYS, one_for_each())),
    "envs.World.step": lambda _: case(
        model().world().step, hidden=(hidden(), hidden_states()), u=(CONTROLS, controls()), keys=(KEYS, one_for_each()),
    ),
    "envs.World.check_hidden": lambda _: case(model().world().check_hidden, hidden=(hidden(), hidden_states())),
    "envs.WorldEnv": lambda _: case(
        envs.WorldEnv, lambda made: made.rollout(2),
        model=belief_model(),
        generator=a_start(),
        batch_size=((2,), sequences((2,), *SHAPES, empty=False)),
        seed=(0, seeds()),
    ),
    "envs.WorldEnv.step": lambda _: on_tensordict(
        lambda tensordict: stepped(world_env(), tensordict),
        (state().set("action", CONTROLS), [Hostile("no action", state(), names=("action",)), *wrong_actions(state())]),
    ),
    "envs.TrackBelief": lambda _: case(
        envs.TrackBelief, lambda made: TransformedEnv(world_env(), made).rollout(2),
        model=(model(), [*objects(problem()), Hostile("of two robots", two_robots(), "in use")]),
    ),
    "envs.TrackBelief.step": lambda _: on_tensordict(
        lambda tensordict: stepped(TransformedEnv(world_env(), envs.TrackBelief(model())), tensordict),
        (state().set("action", CONTROLS), [Hostile("no action", state(), names=("action",)), *wrong_actions(state())]),
    ),
}


def stepped(env, tensordict):
    """A step from a start, with what a TensorDict has of actions."""
    return env.step(env.reset().update(tensordict.select("action", strict=False)))
