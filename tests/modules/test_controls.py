"""Controls of a policy that are none: refused by name wherever a policy is simulated."""

from __future__ import annotations

import pytest
import torch

from torchrl_pomdp.collectors import PartSampler, PolicyEvaluation, RolloutImprovement, StateMemory
from torchrl_pomdp.envs import BeliefEnv, FixedBelief
from torchrl_pomdp.evaluation import discounted_costs
from torchrl_pomdp.modules import (
    MultistepLookahead,
    ParallelRollout,
    PolicyCost,
    RolloutPolicy,
    TruncatedRollout,
    ZeroCost,
)
from torchrl_pomdp.problems import make_problem, tiger


def always(control):
    return lambda y: y.set("action", torch.full(y.batch_size, control))


def turned(change):
    """The first legal control, in another form."""
    return lambda y: y.set("action", change(y["action_mask"].to(torch.int64).argmax(-1)))


NONE = {
    "negative": always(-1),
    "far below": always(-(2**62)),
    "out of range": always(10**6),
    "float": turned(torch.Tensor.float),
    "int32": turned(torch.Tensor.int),
    "bool": turned(torch.Tensor.bool),
    "NaN": always(torch.nan),
    "column": lambda y: _loose(y, lambda u: u.unsqueeze(-1)),
    "one-hot": lambda y: _loose(y, lambda u: torch.nn.functional.one_hot(u, y["action_mask"].shape[-1])),
    "scalar": lambda y: _loose(y, lambda u: u[0]),
    "nothing written": lambda y: y,
    "None": lambda y: None,
    "controls alone": lambda y: y["action_mask"].to(torch.int64).argmax(-1),
}


def _loose(y, change):
    """A TensorDict without a batch, which takes an action of any shape."""
    u = change(y["action_mask"].to(torch.int64).argmax(-1))
    return type(y)({**dict(y.items()), "action": u}, [])


def users(model, start):
    """Everything that simulates a policy, as functions of the policy."""
    y, keys = model.with_features(start(torch.arange(4))), torch.arange(4)
    cut = {"max_steps": 20, "terminal_cost": ZeroCost()}
    options = {"trajectories": 2, **cut}
    return {
        "rollout": lambda policy: TruncatedRollout(model, policy, **cut)(y, keys),
        "rollout policy": lambda policy: RolloutPolicy(model, policy, **options)(y.copy()),
        "observation leaves": lambda policy: RolloutPolicy(model, policy, leaves="observation", **options)(y.copy()),
        "multistep": lambda policy: MultistepLookahead(RolloutPolicy(model, policy, **options))(y.copy()),
        "parallel": lambda policy: ParallelRollout([RolloutPolicy(model, policy, **options)])(y.copy()),
        "policy cost": lambda policy: PolicyCost(model, policy, **options)(y.copy()),
        "evaluation": lambda policy: discounted_costs(model, policy, start, num_states=4, **cut),
        "memory": lambda policy: StateMemory(model).visit(policy, start, keys, max_steps=20),
        "improvement": lambda policy: _collect(RolloutImprovement, model, start, policy),
        "evaluation labels": lambda policy: _collect(PolicyEvaluation, model, start, policy),
    }


def _collect(kind, model, start, policy):
    states = PartSampler({0: start}, seed=0)
    return next(iter(kind(BeliefEnv(model, start), policy, states=states, frames_per_batch=4, total_frames=4)))


MODELS = {
    "line3": (make_problem("line3").model, make_problem("line3").start),
    "two robots": (make_problem("two_robots20").model, make_problem("two_robots20").start),
    "tiger": (tiger().model, FixedBelief(torch.tensor([0.5, 0.5]))),
}


@pytest.mark.parametrize("user", users(*MODELS["tiger"]))
def test_what_is_no_control_is_refused_by_name(user):
    for model, start in MODELS.values():
        call = users(model, start)[user]
        cases = NONE | {"first unused number": always(model.num_controls)}
        for name, policy in cases.items():
            with pytest.raises((ValueError, TypeError)) as caught:
                call(policy)
            assert "action" in str(caught.value), (name, caught.value)
            assert name not in ("negative", "far below", "out of range", "first unused number") or "illegal" in str(
                caught.value
            )


@pytest.mark.parametrize("user", users(*MODELS["line3"]))
def test_controls_that_lead_nowhere_are_refused_by_name(user):
    """A control of the model that is illegal in the state, for one robot and for two."""
    for name, control in (("line3", "move"), ("line3", "repair"), ("two robots", "move"), ("two robots", "repair")):
        model, start = MODELS[name]

        def illegal(y, control=control):
            # The last illegal control is a move off the graph, the first a repair of what is not damaged.
            mask = y["action_mask"].to(torch.int64)
            u = mask.flip(-1).argmin(-1) if control == "move" else mask.argmin(-1)
            return y.set("action", mask.shape[-1] - 1 - u if control == "move" else u)

        def at_the_end(keys, start=start, control=control, model=model):
            y = start(keys)
            y["location"] = torch.full_like(y["location"], model.num_locations - 1)
            return y

        with pytest.raises(ValueError, match=r"action \d+ at batch index \(\d+,\) is illegal; legal there: \["):
            users(model, at_the_end)[user](illegal)


def test_legal_controls_are_simulated():
    for name in ("line3", "tiger"):
        for call in users(*MODELS[name]).values():
            call(turned(lambda u: u))


def test_a_single_illegal_control_among_many_is_found(line3):
    model = line3.model
    y = model.with_features(line3.start(torch.arange(100)))

    def wrong_at(row):
        def policy(y):
            u = y["action_mask"].to(torch.int64).argmax(-1)
            if len(u) == 100:
                u[row] = 7
            return y.set("action", u)

        return policy

    for row in (0, 50, 99):
        with pytest.raises(ValueError, match=rf"action 7 at batch index \({row},\) is illegal"):
            TruncatedRollout(model, wrong_at(row))(y, torch.arange(100))
