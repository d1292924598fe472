"""Known values of small problems, met by the belief model, exactly and by simulation.

All beliefs that can be reached from the start are found with the model's own functions; there are few, up to rounding. On them
the problem is a finite Markov decision problem, of which the optimum and the cost of a policy are computed.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from tensordict import TensorDict

from torchrl_pomdp.envs import FixedBelief, TabularModel
from torchrl_pomdp.envs.pomdp_file import read_pomdp
from torchrl_pomdp.evaluation import discounted_costs, estimate
from torchrl_pomdp.modules import TruncatedRollout, ZeroCost
from torchrl_pomdp.noise import seed_keys

DATA = Path(__file__).parents[1] / "data"

# Published optima; rewards are negative costs.
OPTIMA = [("tiger", 0.95, -19.371368), ("tiger", 0.75, -1.933439), ("cheese", 0.95, -3.486207)]
# The crying baby of Kochenderfer (2015): optimum from full, and policies from full and from hungry.
BABY_OPTIMUM, BABY_AFTER_CRYING = 16.3, 0.470588
BABY_POLICIES = {"ignore": (47.37, 100.0, 0.01), "feed": (50.0, 60.0, 1e-4), "feed when crying": (17.14, 32.11, 0.1)}


class Reachable(NamedTuple):
    """Beliefs ``[M, n]``, costs ``[M, C]`` of controls, probabilities of observations and next beliefs ``[M, C, Z]``."""

    belief: torch.Tensor
    cost: torch.Tensor
    probs: torch.Tensor
    after: torch.Tensor


def reachable(model, start, digits, policy=None):
    """All beliefs that the controls of a policy, or any controls, lead to; those that agree to some digits are one."""
    known, beliefs, layers, first = {}, [], [], 0

    def numbers(rows):
        for row, key in zip(rows, (rows * 10**digits).round().long().tolist(), strict=True):
            if tuple(key) not in known:
                known[tuple(key)] = len(beliefs)
                beliefs.append(row)
            yield known[tuple(key)]

    list(numbers(start.unsqueeze(0)))
    while first < len(beliefs):
        belief = torch.stack(beliefs[first:])
        first = len(beliefs)
        u = torch.arange(model.num_controls).expand(len(belief), -1) if policy is None else policy(belief).unsqueeze(1)
        y = TensorDict({"belief": belief.unsqueeze(1).expand(*u.shape, -1)}, u.shape)
        probs = model.observation_probs(y, u)
        row, choice, z = (probs > 1e-12).nonzero(as_tuple=True)
        following = model.estimator(TensorDict({"belief": belief[row]}, [len(row)]), u[row, choice], z)
        after = torch.zeros(probs.shape, dtype=torch.int64)
        after[row, choice, z] = torch.tensor(list(numbers(following["belief"])))
        layers.append((model.expected_cost(y, u), probs, after))
    return Reachable(torch.stack(beliefs), *(torch.cat(parts) for parts in zip(*layers, strict=True)))


def q_factors(found, discount):
    """Least cost ``[M, C]`` after each control, by value iteration."""
    values, change = torch.zeros(len(found.belief), dtype=torch.float64), 1.0
    while change > 1e-8:
        q = found.cost + discount * (found.probs * values[found.after]).sum(-1)
        change, values = float((q.amin(-1) - values).abs().max()), q.amin(-1)
    return q


def nearest(found, u):
    """The policy that does in a belief what ``u`` ``[M]`` says of the nearest one."""
    return lambda belief: u[torch.cdist(belief, found.belief).argmin(-1)]


def assert_simulated(model, start, policy, value):
    """The mean cost of trajectories of the policy is the value within three standard errors, cut where 1e-5 is left."""

    def decide(y):
        return y.set("action", policy(y["belief"]))

    cut = {"max_steps": int(12 / (1 - model.discount)), "terminal_cost": ZeroCost()}
    costs = discounted_costs(model, decide, FixedBelief(start), num_states=1000, **cut)
    keys = seed_keys(1, torch.arange(1000))
    for sample in (costs, TruncatedRollout(model, decide, **cut)(model.drawn(FixedBelief(start), keys), keys)):
        found = estimate(sample)
        assert abs(found.mean - value) < 3 * found.standard_error + 1e-3


@pytest.mark.parametrize(("name", "discount", "value"), OPTIMA)
def test_optima_of_files(name, discount, value):
    model, start = read_pomdp(DATA / f"{name}.POMDP", dtype=torch.float64)
    model = TabularModel(model.transition, model.observation, model.cost, discount, dtype=torch.float64)
    found = reachable(model, start.belief, digits=9)
    q = q_factors(found, discount)
    assert float(q[0].min()) == pytest.approx(value, abs=1e-5)
    policy = nearest(found, q.argmin(-1))
    assert float(q_factors(reachable(model, start.belief, 9, policy), discount)[0]) == pytest.approx(value, abs=1e-5)
    assert_simulated(model, start.belief, policy, value)


def crying_baby():
    """States full, hungry; controls feed, ignore; observations quiet, crying."""
    transition = torch.tensor([[[1.0, 0.0], [1.0, 0.0]], [[0.9, 0.1], [0.0, 1.0]]])
    observation = torch.tensor([[0.9, 0.1], [0.2, 0.8]]).expand(2, 2, 2)
    return TabularModel(transition, observation, torch.tensor([[5.0, 15.0], [0.0, 10.0]]), 0.9, dtype=torch.float64)


def test_optimum_of_the_crying_baby():
    model = crying_baby()
    full = torch.tensor([1.0, 0.0], dtype=torch.float64)
    found = reachable(model, full, digits=4)
    q = q_factors(found, 0.9)
    assert float(q[0].min()) == pytest.approx(BABY_OPTIMUM, abs=0.02)
    y = model.estimator(TensorDict({"belief": full}, []), torch.tensor(1), torch.tensor(1))
    assert float(y["belief"][1]) == pytest.approx(BABY_AFTER_CRYING, abs=1e-6)
    # It is fed when it is hungry with some probability or more.
    feed = q.argmin(-1) == 0
    threshold = found.belief[feed, 1].min()
    assert found.belief[~feed, 1].max() < threshold
    assert_simulated(model, full, lambda belief: (belief[..., 1] < threshold).long(), float(q[0].min()))


@pytest.mark.parametrize("name", BABY_POLICIES)
def test_policies_of_the_crying_baby(name):
    """A policy of the last observation is one of the belief where states remember it: state 2 i + z."""
    baby = crying_baby()
    sees = baby.observation[0]
    transition = (baby.transition.repeat_interleave(2, 1).unsqueeze(-1) * sees).flatten(2)
    observation = torch.eye(2).repeat(2, 1).expand(2, 4, 2)
    model = TabularModel(transition, observation, baby.cost.repeat_interleave(2, 1), 0.9, dtype=torch.float64)

    def policy(belief):
        crying = belief[..., 1::2].sum(-1) > 0.5
        return {"feed": 0 * crying, "ignore": 0 * crying + 1, "feed when crying": 1 - crying.long()}[name].long()

    *values, tolerance = BABY_POLICIES[name]
    for state, value in enumerate(values):
        total = 0.0
        for z in (0, 1):  # the first observation is that of the state
            start = torch.eye(4, dtype=torch.float64)[2 * state + z]
            cost = float(q_factors(reachable(model, start, 4, policy), 0.9)[0])
            if z == 0:
                assert_simulated(model, start, policy, cost)
            total += float(sees[state, z]) * cost
        assert total == pytest.approx(value, abs=tolerance)
