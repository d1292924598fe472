"""Cases of the test of refusals: Gymnasium's environments; see the cases of planning."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from _hostile import HUGE, NAN, Hostile, choices, integers, objects, seeds, values
from _valid import Argument, a_start, belief_model, case, model, problem, start

from torchrl_pomdp.envs import gym
from torchrl_pomdp.problems import gym as made

__all__ = ["GYM"]

# fmt: off

RENDER_MODE: Argument = (None, choices())
MASK = np.array([True, False])


def simulation() -> gym.Simulation:
    return gym.BeliefSimulation(model(), start())


def a_simulation() -> Argument:
    return simulation(), objects(model(), problem(), gym.BeliefSimulation)


def play(of: gym.Simulation) -> None:
    started(gym.PomdpVectorEnv(of, 2)).step([0, 0])


def started(env: Any) -> Any:
    env.reset(seed=0)
    return env


def options(*wrong: Any) -> Argument:
    return {}, [Hostile(hostile.label, hostile.value, names=("reset_mask",)) for hostile in
                values(3, True, NAN, "x", [], object(), {"state": 1}, {3: 1}, *wrong)]


def actions(valid: Any, *wrong: Any) -> Argument:
    kinds = values(None, NAN, 0.0, True, "0", b"0", {}, object(), torch.ones(2), 1j, [[0], [0, 1]])
    return valid, kinds + values(-1, 99, HUGE, 10**30, *wrong)


def a_problem() -> Argument:
    return "line3", values(None, 3, True, NAN, b"line3", [], {}, object(), "", "no such", "\x1b[31m", model())


GYM = {
    "envs.gym.BeliefSimulation": lambda _: case(gym.BeliefSimulation, play, model=belief_model(), generator=a_start()),
    "envs.gym.WorldSimulation": lambda _: case(gym.WorldSimulation, play, model=belief_model(), generator=a_start()),
    "envs.gym.PomdpEnv": lambda _: case(gym.PomdpEnv, simulation=a_simulation(), render_mode=RENDER_MODE),
    "envs.gym.PomdpEnv.reset": lambda _: case(gym.PomdpEnv(simulation()).reset, seed=(0, seeds()), options=options()),
    "envs.gym.PomdpEnv.step": lambda _: case(started(gym.PomdpEnv(simulation())).step, action=actions(0, [0])),
    "envs.gym.PomdpVectorEnv": lambda _: case(
        gym.PomdpVectorEnv,
        simulation=a_simulation(),
        num_envs=(2, integers(1, 10**6)),
        max_episode_steps=(3, integers(1, 2**62)),
        render_mode=RENDER_MODE,
    ),
    "envs.gym.PomdpVectorEnv.reset": lambda _: case(
        started(gym.PomdpVectorEnv(simulation(), 2)).reset,
        seed=(0, [*seeds(), *values([-1, 0], [0, 1.5], [0, "1"], "01", [0, 1, 2])]),
        options=options(*({"reset_mask": wrong} for wrong in (None, [True, False], MASK[:1], MASK.astype(int), MASK & False))),
    ),
    "envs.gym.PomdpVectorEnv.step": lambda _: case(
        started(gym.PomdpVectorEnv(simulation(), 2)).step,
        actions=(lambda valid, wrong: (valid, [Hostile(each.label, each.value, names=("action",)) for each in wrong]))(
            *actions([0, 0], 0, [0], [0, 0, 0], [0.0, 0.0], [0, -1], [0, 99], [[0, 0]])
        ),
    ),
    **{
        f"problems.gym.{name}": lambda _, name=name: case(getattr(made, name), problem=a_problem(), render_mode=RENDER_MODE)
        for name in made.__all__
    },
}
