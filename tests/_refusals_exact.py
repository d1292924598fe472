"""Cases of the test of refusals: exact planning, small repair problems as tables, error bounds; see the cases of planning."""

from __future__ import annotations

import functools

import torch
from _hostile import (
    INF,
    NAN,
    flags,
    integers,
    no_states,
    numbers,
    objects,
    probabilities,
    seeds,
    sequences,
    states,
    tensors,
    values,
)
from _valid import case, model, on_tensordict, repair_model, state
from tensordict import TensorDict

from torchrl_pomdp import bounds, planners
from torchrl_pomdp.envs import repair
from torchrl_pomdp.problems import tiger

__all__ = ["EXACT"]

# fmt: off

HALF, LISTEN = torch.full((2,), 0.5), torch.tensor([0])
VECTOR = torch.full((1, 2), 20.0)
NO_RESULTS = sequences((), None, 3, "x", (1, 2))
Y = TensorDict({"belief": HALF.expand(2, 2).clone()}, [2])


@functools.cache
def table():
    return tiger(0.75).model


@functools.cache
def mdp():
    return planners.belief_mdp(table(), HALF)


def zeros():
    return torch.zeros(len(mdp()))


def results():
    return [bounds.error_bounds(mdp(), zeros().long(), zeros())]


def a_table():
    return table(), objects(model())


def wrong_controls():
    listen = zeros().long()
    return values(None, 3, "x", {}, object(), listen - 1, listen + 3, listen + 0.5, listen.int(), listen[1:], listen[None])


EXACT = {
    "planners.solve": lambda _: case(
        planners.solve,
        model=a_table(),
        belief=(HALF, [h for h in probabilities(HALF) if h.label != "one dimension more"]),
        relative_gap=(0.1, numbers("(0, 1)")),
        seconds=(1.0, numbers("(0, inf)")),
        progress=(False, flags()),
    ),
    "planners.AlphaVectorPolicy": lambda _: case(
        planners.AlphaVectorPolicy,
        model=a_table(),
        vectors=(VECTOR, [*values(None, "x", 3, {}, object(), [], [[1.0, NAN]], [[1.0, -INF]], [1.0, 2.0], [[1.0], [1.0, 2.0]]),
                          *values(torch.zeros(0, 2), torch.zeros(1, 3), torch.zeros(1, 2).bool())]),
        controls=(LISTEN, values(None, "x", 3, {}, object(), [], [3], [-2], [0.5], [NAN], [0, 0], [[0]], LISTEN.int())),
    ),
    "planners.AlphaVectorPolicy.forward": lambda _: on_tensordict(
        planners.AlphaVectorPolicy(table(), VECTOR, LISTEN), (Y, no_states(Y, "belief"))
    ),
    "planners.AlphaVectorPolicy.cost": lambda _: case(
        planners.AlphaVectorPolicy(table(), VECTOR, LISTEN).cost, y=(Y, no_states(Y, "belief"))
    ),
    "planners.belief_mdp": lambda _: case(
        planners.belief_mdp, model=a_table(), belief=(HALF, probabilities(HALF)), most=(2048, integers(1, 4096))
    ),
    "planners.BeliefMDP.q_factors": lambda _: case(mdp().q_factors, values=(zeros(), tensors(zeros()))),
    "planners.BeliefMDP.policy_cost": lambda _: case(mdp().policy_cost, controls=(zeros().long(), wrong_controls())),
    "bounds.error_bounds": lambda _: case(
        bounds.error_bounds,
        mdp=(mdp(), objects(table())),
        controls=(zeros().long(), wrong_controls()),
        terminal_cost=(zeros(), tensors(zeros())),
        lookahead=(1, integers(1, 1000)),
        truncation=(0, integers(0, 1000)),
    ),
    "bounds.random_bounds": lambda _: case(bounds.random_bounds, models=(1, integers(1, 1_000_000)), seed=(0, seeds())),
    "bounds.looseness": lambda _: case(bounds.looseness, results=(results(), NO_RESULTS)),
    "bounds.bounds_figure": lambda _: case(bounds.bounds_figure, results=(results(), NO_RESULTS)),
    "envs.repair.tabular_model": lambda _: case(
        repair.tabular_model, model=repair_model(), start_observed=(True, flags())
    ),
    "envs.repair.joint_belief": lambda _: case(
        repair.joint_belief, model=repair_model(), y=(state(), states(state())), start_observed=(True, flags())
    ),
}
