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
TIGER = {0.95: -19.371368, 0.75: -1.933439}
CHEESE = -3.486207
# The crying baby of Kochenderfer (2015): optimum from full, and policies from full and from hungry.
BABY_OPTIMUM, BABY_AFTER_CRYING = 16.3, 0.470588
BABY_POLICIES = {"ignore": (47.37, 100.0, 0.005), "feed": (50.0, 60.0, 0.005), "feed when crying": (17.14, 32.11, 0.1)}


class Reachable(NamedTuple):
    """Beliefs ``[M, n]``, costs ``[M, U]``, probabilities of observations and numbers of next beliefs ``[M, U, Z]``."""

    belief: torch.Tensor
    cost: torch.Tensor
    probs: torch.Tensor
    after: torch.Tensor


def reachable(model, start, digits):
    """All beliefs that any controls lead to; those that agree to some digits are one."""
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
        shape = (len(belief), model.num_controls)
        first = len(beliefs)
        y = TensorDict({"belief": belief.unsqueeze(1).expand(*shape, -1)}, shape)
        u = torch.arange(model.num_controls).expand(shape)
        probs = model.observation_probs(y, u)
        row, control, z = (probs > 1e-12).nonzero(as_tuple=True)
        following = model.estimator(TensorDict({"belief": belief[row]}, [len(row)]), control, z)
        after = torch.zeros(probs.shape, dtype=torch.int64)
        after[row, control, z] = torch.tensor(list(numbers(following["belief"])))
        layers.append((model.expected_cost(y, u), probs, after))
    return Reachable(torch.stack(beliefs), *(torch.cat(parts) for parts in zip(*layers, strict=True)))


def q_factors(found, discount):
    """Optimal Q-factors ``[M, U]`` by value iteration."""
    values, change = torch.zeros(len(found.belief), dtype=torch.float64), 1.0
    while change > 1e-9:
        q = found.cost + discount * (found.probs * values[found.after]).sum(-1)
        change, values = float((q.amin(-1) - values).abs().max()), q.amin(-1)
    return q


def policy_cost(found, discount, u):
    """Costs ``[M]`` of the policy that chooses ``u`` ``[M]``."""
    row = torch.arange(len(u))
    matrix = torch.eye(len(u), dtype=torch.float64)
    matrix.index_put_((row.unsqueeze(1).expand_as(found.after[row, u]), found.after[row, u]), -discount * found.probs[row, u], True)
    return torch.linalg.solve(matrix, found.cost[row, u])


def nearest(found, u):
    """The policy that does in a belief what ``u`` ``[M]`` says of the nearest one."""

    def policy(y):
        return y.set("action", u[torch.cdist(y["belief"].double(), found.belief).argmin(-1)])

    return policy


def assert_simulated(model, start, policy, value):
    """The mean cost of trajectories of the policy is the value within three standard errors, cut where 1e-6 is left."""
    steps = {"max_steps": int(14 / (1 - model.discount)), "terminal_cost": ZeroCost()}
    costs = discounted_costs(model, policy, start, num_states=2000, **steps)
    keys = seed_keys(1, torch.arange(2000))
    for sample in (costs, TruncatedRollout(model, policy, **steps)(model.drawn(start, keys), keys)):
        found = estimate(sample)
        assert abs(found.mean - value) < 3 * found.standard_error + 1e-4


@pytest.mark.parametrize(("name", "discount", "value"), [*(("tiger", *known) for known in TIGER.items()), ("cheese", 0.95, CHEESE)])
def test_optima_of_files(name, discount, value):
    model, start = read_pomdp(DATA / f"{name}.POMDP", dtype=torch.float64)
    model = TabularModel(model.transition, model.observation, model.cost, discount, dtype=torch.float64)
    found = reachable(model, start.belief, digits=9)
    q = q_factors(found, discount)
    assert float(q[0].min()) == pytest.approx(value, abs=1e-5)
    u = q.argmin(-1)
    assert float(policy_cost(found, discount, u)[0]) == pytest.approx(value, abs=1e-5)
    assert_simulated(model, start, nearest(found, u), value)


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
    assert_simulated(model, FixedBelief(full), nearest(found, q.argmin(-1)), float(q[0].min()))


@pytest.mark.parametrize("name", BABY_POLICIES)
def test_policies_of_the_crying_baby(name):
    """A policy of the last observation is one of the belief where states remember it: state 2 i + z."""
    baby = crying_baby()
    seen = baby.observation[0].repeat(2, 1)  # by state and remembered observation alike
    transition = (baby.transition.repeat_interleave(2, 1).unsqueeze(-1) * seen[:2]).flatten(2)
    observation = torch.eye(2).repeat(2, 1).expand(2, 4, 2)
    model = TabularModel(transition, observation, baby.cost.repeat_interleave(2, 1), 0.9, dtype=torch.float64)

    def chosen(belief):
        crying = belief[..., 1::2].sum(-1) > 0.5
        return {"feed": torch.zeros_like(crying), "ignore": torch.ones_like(crying), "feed when crying": ~crying}[name].long()

    *values, tolerance = BABY_POLICIES[name]
    for state, value in enumerate(values):
        # The first observation is that of the state.
        shares = baby.observation[0, state]
        exact, starts = 0.0, []
        for z, share in enumerate(shares):
            start = torch.zeros(4, dtype=torch.float64)
            start[2 * state + z] = 1.0
            found = reachable(model, start, digits=4)
            exact += float(share) * float(policy_cost(found, 0.9, chosen(found.belief))[0])
            starts.append(FixedBelief(start))
        assert exact == pytest.approx(value, abs=tolerance)
        for start, z in zip(starts, range(2), strict=True):
            found = reachable(model, start.belief, digits=4)
            one = float(policy_cost(found, 0.9, chosen(found.belief))[0])
            assert_simulated(model, start, lambda y: y.set("action", chosen(y["belief"])), one)
            assert z in (0, 1)
