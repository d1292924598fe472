"""Hidden states have the laws of the problems' statements, and both doors to a problem have the same law."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import product
from math import prod
from typing import NamedTuple

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from torchrl_pomdp.envs import BeliefEnv, BeliefModel, TabularModel, TrackBelief, WorldEnv
from torchrl_pomdp.envs.repair import RepairModel, damage_chain, line
from torchrl_pomdp.envs.rows import random_control
from torchrl_pomdp.noise import uniform
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.problems.maintenance_model import Component, MaintenanceModel
from torchrl_pomdp.problems.rocksample_model import RockSample

DOUBLE = {"dtype": torch.float64}
Outcomes = Iterator[tuple[float, float, tuple, int]]


class Tiny(NamedTuple):
    """A problem that can be enumerated: all its probabilities are multiples of 1 / parts.

    Attributes:
        model: the belief model.
        y: a feature state of batch ``()``.
        outcomes: probability, cost, next hidden state and observation of a hidden state and a control, by the statement.
        hidden: all hidden states, a tuple of tuples with one for each entry.
        chance: probability of a hidden state in a feature state.
        parts: see above.
    """

    model: BeliefModel
    y: TensorDict
    outcomes: Callable[[tuple, int], Outcomes]
    hidden: list[tuple]
    chance: Callable[[TensorDict, tuple], float]
    parts: int = 4


def marginals(belief, levels):
    return prod(float(row[level]) for row, level in zip(belief, levels, strict=True))


# ---- statements of the problems, of one hidden state each ------------------------------------------------------------


def repair(places, absorbing, size=2, costs=(0.0, 1.0, 10.0), chains=None, works=1.0):
    """``costs`` and ``chains`` of all locations, or one for each; attempts to repair work with probability ``works``."""
    chains = damage_chain((0.0 if absorbing else 0.25, 0.5)).tolist() if chains is None else chains
    options = {"num_robots": len(places), "repair_probability": works, **DOUBLE}
    model = RepairModel(line(size), torch.tensor(chains), costs, 0.9, **options)
    chain = chains if isinstance(chains[0][0], list) else [chains] * size
    price = costs if isinstance(costs[0], tuple) else [costs] * size
    belief = torch.tensor([[0.25, 0.25, 0.5], [0.5, 0.5, 0.0], [1.0, 0.0, 0.0]][:size], **DOUBLE)

    def outcomes(hidden, u):
        levels, now = hidden
        each = [u // 3 ** (len(now) - 1 - robot) % 3 for robot in range(len(now))]
        repaired = {place for place, c in zip(now, each, strict=True) if c == 0}
        then = tuple(place + (0, -1, 1)[c] for place, c in zip(now, each, strict=True))
        rows = [chain[i][level] for i, level in enumerate(levels)]
        for i in repaired:
            rows[i] = [(1.0 - works) * p + works * (k == 0) for k, p in enumerate(rows[i])]
        for nxt in product(range(3), repeat=size):
            z = sum(nxt[place] * 3 ** (len(then) - 1 - robot) for robot, place in enumerate(then))
            yield marginals(rows, nxt), sum(price[i][level] for i, level in enumerate(levels)), (nxt, then), z

    return Tiny(
        model,
        TensorDict({"belief": belief, "location": torch.tensor(places)}),
        outcomes,
        list(product(product(range(3), repeat=size), product(range(size), repeat=len(places)))),
        lambda y, hidden: marginals(y["belief"], hidden[0]) * (y["location"].tolist() == list(hidden[1])),
    )


# Halves, so that probabilities are multiples of 1/4 where every other attempt to repair works.
OWN_CHAINS = [
    [[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.0, 0.0, 1.0]],
    [[1.0, 0.0, 0.0], [0.5, 0.0, 0.5], [0.0, 0.5, 0.5]],
]
OWN_COSTS = ((0.0, 1.0, 10.0), (0.5, 4.0, 2.0))


def tabular(sparse):
    """Three states, the last one terminal and always seen, where one of the controls alone is legal."""
    transition = torch.tensor([
        [[0.5, 0.25, 0.25], [0.0, 0.75, 0.25], [0.0, 0.0, 1.0]],
        [[0.75, 0.25, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 1.0]],
    ])  # fmt: skip
    seen = torch.tensor([[[0.75, 0.25, 0.0], [0.25, 0.75, 0.0], [0.0, 0.0, 1.0]], [[0.5, 0.5, 0.0]] * 2 + [[0.0, 0.0, 1.0]]])
    cost = [[1.0, 3.0, 0.0], [2.0, 7.0, 0.0]]
    legal = torch.tensor([[True, True], [True, True], [True, False]])
    tables = [table.to_sparse() if sparse else table for table in (transition, seen)]
    terminal = torch.tensor([False, False, True])
    model = TabularModel(*tables, torch.tensor(cost), 0.9, legal=legal, terminal=terminal, **DOUBLE)

    def outcomes(hidden, u):
        ((i,),) = hidden
        for j, z in product(range(3), repeat=2):
            yield float(transition[u, i, j] * seen[u, j, z]), cost[u][i], ((j,),), z

    return Tiny(
        model,
        TensorDict({"belief": torch.tensor([0.25, 0.75, 0.0], **DOUBLE)}),
        outcomes,
        [((i,),) for i in range(3)],
        lambda y, hidden: float(y["belief"][hidden[0][0]]),
    )


def rocks():
    """Two cells with a rock each; the accuracy of looking across is made a multiple of 1/4."""
    model = RockSample(2, [(0, 0), (1, 0)], **DOUBLE)
    model.accuracy[model.accuracy < 1] = 0.75
    across = {0: (1,), 1: (0,), 2: (0, 1), 3: (0, 1)}

    def outcomes(hidden, u):
        good, (place,) = hidden
        x, y = place % 2, place // 2
        if place == 4 or u < 4:
            gone = place == 4 or (u == 2 and x == 1)
            then = 4 if gone else 2 * (y + (u == 0) - (u == 1)) + x + (u == 2) - (u == 3)
            yield 1.0, -10.0 * (gone and place < 4), (good, (then,)), 0
        elif u == 4:
            left = tuple(rock and i != place for i, rock in enumerate(good))
            yield 1.0, -10.0 if good[place] else 10.0, (left, (place,)), 0
        else:
            right = 0.75 if u - 5 in across[place] else 1.0
            for shown, p in ((good[u - 5], right), (not good[u - 5], 1.0 - right)):
                yield p, 0.0, (good, (place,)), 1 if shown else 2

    return Tiny(
        model,
        TensorDict({"belief": torch.tensor([0.5, 0.75], **DOUBLE), "location": torch.tensor([1])}),
        outcomes,
        list(product(product((False, True), repeat=2), ((i,) for i in range(5)))),
        lambda y, hidden: (
            prod(float(p) if rock else 1.0 - float(p) for p, rock in zip(y["belief"], hidden[0], strict=True))
            * (y["location"].tolist() == list(hidden[1]))
        ),
    )


def maintenance():
    """Two components, both needed, for two stages; replacements may fail, inspections err."""
    chains = [[[0.5, 0.25, 0.25], [0.0, 0.75, 0.25], [0.0, 0.0, 1.0]], [[0.75, 0.25, 0.0], [0.0, 0.5, 0.5], [0.0, 0.0, 1.0]]]
    prices, success, accuracy = [[0.0, 3.0, 1.0], [0.0, 5.0, 2.0]], (0.75, 0.5), (0.75, 0.5)
    parts = [Component(p[1], s, p[2], a, c) for p, s, a, c in zip(prices, success, accuracy, chains, strict=True)]
    model = MaintenanceModel(parts, 2, penalty=40.0, stages=2, **DOUBLE)

    def component(i, level, control):
        for succeeded, p in ((True, success[i]), (False, 1.0 - success[i])) if control == 1 else ((False, 1.0),):
            for nxt, q in enumerate(chains[i][0 if succeeded else level]):
                if control == 2 and nxt < 2:
                    yield from ((p * q * accuracy[i], nxt, nxt), (p * q * (1.0 - accuracy[i]), nxt, 1 - nxt))
                else:
                    yield p * q, nxt, 2 if nxt == 2 else 0

    def outcomes(hidden, u):
        levels, (time,) = hidden
        controls = (u // 3, u % 3)
        cost = sum(prices[i][c] for i, c in enumerate(controls)) + 40.0 * (2 in levels)
        for (p, a, seen_a), (q, b, seen_b) in product(*(component(i, levels[i], controls[i]) for i in range(2))):
            yield p * q, cost * (time < 2), ((a, b), (min(time + 1, 2),)), 3 * seen_a + seen_b

    belief = torch.tensor([[0.5, 0.25, 0.25], [0.25, 0.75, 0.0]], **DOUBLE)
    return Tiny(
        model,
        TensorDict({"belief": belief, "time": torch.tensor(0)}),
        outcomes,
        list(product(product(range(3), repeat=2), ((t,) for t in range(3)))),
        lambda y, hidden: marginals(y["belief"], hidden[0]) * (int(y["time"]) == hidden[1][0]),
    )


TINY = {
    "repair": lambda: repair((1,), True),
    "repair that never ends": lambda: repair((0,), False),
    "repair of three": lambda: repair((1,), True, size=3),
    "two robots": lambda: repair((0, 1), True),
    "two robots in one place": lambda: repair((1, 1), False),
    "costs of what is intact": lambda: repair((1,), True, costs=(0.5, 1.0, 10.0)),
    "repairs that fail": lambda: repair((0, 1), True, works=0.5),
    "own chains and costs": lambda: repair((1,), False, costs=OWN_COSTS, chains=OWN_CHAINS),
    "own chains and costs, repairs that fail": lambda: repair((0,), False, costs=OWN_COSTS, chains=OWN_CHAINS, works=0.5),
    "one attempt of two robots": lambda: repair((1, 1), False, costs=OWN_COSTS, chains=OWN_CHAINS, works=0.5),
    "tabular": lambda: tabular(False),
    "sparse tabular": lambda: tabular(True),
    "rocks": rocks,
    "maintenance": maintenance,
}

# Stages that are enumerated; 3 where nothing is said.
TWO_ROBOTS = ("two robots", "two robots in one place", "repairs that fail", "one attempt of two robots")
STAGES = {"repair of three": 2, **dict.fromkeys(TWO_ROBOTS, 2), "maintenance": 1}


# ---- by enumeration --------------------------------------------------------------------------------------------------


def lattice(parts, count):
    """All ``[parts^count, count]`` uniforms in the middles of ``parts`` equal intervals."""
    return torch.cartesian_prod(*[(torch.arange(parts) + 0.5) / parts] * count).reshape(-1, count)


def frequencies(*columns):
    """How often each row of columns ``[N, .]`` occurs, as a share: by tuples of numbers."""
    found, count = torch.cat([column.double() for column in columns], -1).unique(dim=0, return_counts=True)
    return dict(zip(map(tuple, found.tolist()), (count.double() / count.sum()).tolist(), strict=True))


def flat(hidden):
    """Hidden states ``[N]`` as columns ``[N, .]``, their entries in the order of the alphabet."""
    return torch.cat([hidden[key].reshape(hidden.batch_size[0], -1) for key in sorted(hidden.keys())], -1)


def numbers(*members):
    """What :func:`frequencies` calls a row of numbers and tuples."""
    return tuple(x for each in members for x in (numbers(*each) if isinstance(each, tuple) else (float(each),)))


def law(weighted):
    """Probability of each key, those of probability zero left out."""
    total = defaultdict(float)
    for p, key in weighted:
        if p > 0:
            total[key] += p
    return dict(total)


def repeated(td, count):
    return td.expand(count, *td.batch_size).clone()


def state_of(world, hidden):
    """The hidden state of a tuple, of batch ``()``."""
    leaves = zip(sorted(world.hidden_spec().items()), hidden, strict=True)
    entries = {key: torch.tensor(each).reshape(leaf.shape).to(leaf.dtype) for (key, leaf), each in leaves}
    return TensorDict(entries)


@pytest.mark.parametrize("name", TINY)
def test_a_step_has_the_law_of_the_statement(name):
    tiny = TINY[name]()
    world = tiny.model.world()
    noise = lattice(tiny.parts, world.noise_dim)
    for hidden in tiny.hidden:
        now = state_of(world, hidden)
        world.check_hidden(now)
        controls = world.action_mask(now).nonzero().flatten().tolist()
        assert controls
        for u in controls:
            many = repeated(now, len(noise))
            cost, nxt, z = world.advance(many, torch.full((len(noise),), u), noise)
            assert cost.dtype == torch.float64
            assert z.dtype == torch.int64
            found = frequencies(cost.unsqueeze(-1), flat(nxt), z.unsqueeze(-1))
            told = law((p, numbers(*rest)) for p, *rest in tiny.outcomes(hidden, u))
            assert found == pytest.approx(told, abs=1e-12)


@pytest.mark.parametrize("name", TINY)
def test_hidden_states_have_the_law_of_the_belief(name):
    tiny = TINY[name]()
    world = tiny.model.world()
    noise = lattice(tiny.parts, world.draw_dim)
    drawn = world.draw(repeated(tiny.y, len(noise)), noise)
    expected = law((tiny.chance(tiny.y, hidden), numbers(hidden)) for hidden in tiny.hidden)
    assert len(expected) > 1
    assert frequencies(flat(drawn)) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("name", TINY)
def test_beliefs_are_the_laws_of_hidden_states(name):
    tiny = TINY[name]()
    model, y = tiny.model, tiny.model.with_features(tiny.y)
    for u in y["action_mask"].nonzero().flatten():
        joint = [
            (tiny.chance(y, hidden) * p, cost, nxt, z)
            for hidden in tiny.hidden
            if tiny.chance(y, hidden) > 0
            for p, cost, nxt, z in tiny.outcomes(hidden, int(u))
        ]
        assert float(model.expected_cost(y, u)) == pytest.approx(sum(p * cost for p, cost, *_ in joint))
        seen = law((p, z) for p, _, _, z in joint)
        probs = model.observation_probs(y, u)
        assert law((float(p), z) for z, p in enumerate(probs)) == pytest.approx(seen, abs=1e-12)
        for z, p_seen in seen.items():
            nxt = model.estimator(y, u, torch.tensor(z))
            after = law((p / p_seen, hidden) for p, _, hidden, each in joint if each == z)
            assert law((tiny.chance(nxt, hidden), hidden) for hidden in tiny.hidden) == pytest.approx(after, abs=1e-12)


def by_hash(model):
    """A policy that uses all controls: which one is a function of the feature state."""
    return lambda y: y.set("action", random_control(y["action_mask"], uniform(model.fingerprint(y), 0)))


def belief_door(model, policy, y, stages):
    """Probability, feature states and expected costs of every course of play, by expanding all observations."""
    courses = [(1.0, (int(model.fingerprint(y)),), (), y)]
    for _ in range(stages):
        longer = []
        for p, states, costs, now in courses:
            u = policy(now.clone())["action"]
            cost = 0.0 if model.is_terminal(now) else float(model.expected_cost(now, u))
            for z, q in enumerate(model.observation_probs(now, u).tolist()):
                if q > 0:
                    nxt = model.derive(model.estimator(now, u, torch.tensor(z)))
                    longer.append((p * q, (*states, int(model.fingerprint(nxt))), (*costs, cost), nxt))
        courses = longer
    return courses


@pytest.mark.parametrize("name", TINY)
def test_both_doors_have_the_same_law_of_courses_of_play(name, monkeypatch):
    tiny, stages = TINY[name](), STAGES.get(name, 3)
    model, world = tiny.model, tiny.model.world()
    policy, y = by_hash(model), model.with_features(tiny.y)
    noise = lattice(tiny.parts, world.draw_dim + stages * world.noise_dim)
    streams = iter(noise.split([world.draw_dim, *[world.noise_dim] * stages], -1))
    monkeypatch.setattr("torchrl_pomdp.envs.world._uniforms", lambda keys, states, purpose, count: next(streams))
    env = TransformedEnv(
        WorldEnv(model, lambda keys: repeated(tiny.y, len(keys)), batch_size=(len(noise),)), TrackBelief(model)
    )
    td = env.reset()
    states, costs, ends = [model.fingerprint(td)], [], []
    for _ in range(stages):
        ends.append(td["terminated"].flatten())
        assert torch.equal(ends[-1], model.is_terminal(td))
        td = env.step(policy(td))["next"]
        costs.append(-td["reward"].flatten())
        td = td.exclude("reward")
        states.append(model.fingerprint(td))
    assert next(streams, None) is None
    courses = belief_door(model, policy, y, stages)
    played = list(zip(*(column.tolist() for column in states), strict=True))
    assert law((1.0 / len(noise), course) for course in played) == pytest.approx(law(c[:2] for c in courses), abs=1e-9)
    for stage in range(stages):
        past = [course[: stage + 1] for course in played]
        count, total = law((1.0, each) for each in past), defaultdict(float)
        for each, cost in zip(past, costs[stage].tolist(), strict=True):
            total[each] += cost
        expected = {states[: stage + 1]: course_costs[stage] for _, states, course_costs, _ in courses}
        assert {each: total[each] / n for each, n in count.items()} == pytest.approx(expected, abs=1e-9)


# ---- by two samples --------------------------------------------------------------------------------------------------


def samples(env, policy, stages):
    """What play shows at each stage, ``[N, F]``: moments of the feature state, whether it has ended, discounted cost so far."""
    model, td, total, found = env.model, env.reset(), 0.0, []
    for stage in range(stages):
        core = [td[key].double().reshape(len(td), -1) for key in model.state_keys]
        found += [moment for leaf in core for moment in (leaf, leaf.square())] + [td["terminated"].double()]
        td = env.step(policy(td))["next"]
        total = total - model.discount**stage * td["reward"].double()
        found.append(total)
        td = td.exclude("reward")
    return torch.cat(found, -1)


@pytest.mark.parametrize(
    ("name", "stages"), [("linear20", 40), ("two_robots20", 30), ("rocksample7x8", 25), ("maintenance3", 50)]
)
def test_both_doors_agree_on_large_problems(name, stages):
    """At most five standard errors apart in any of the thousands of moments, whose largest is about four by chance."""
    problem, size = make_problem(name), 3000
    model, policy = problem.model, problem.base_policies[problem.baseline]
    first = samples(BeliefEnv(model, problem.start, batch_size=(size,), seed=1), policy, stages)
    world = WorldEnv(model, problem.start, batch_size=(size,), seed=2)
    second = samples(TransformedEnv(world, TrackBelief(model)), policy, stages)
    error = ((first.var(0) + second.var(0)) / size).sqrt()
    apart = (first.mean(0) - second.mean(0)).abs()
    certain = error < 1e-9
    assert (apart[certain] < 1e-6).all()
    assert (~certain).sum() > 100
    assert float((apart / error)[~certain].max()) < 5.0
    if name != "maintenance3":
        assert float(second[:, -1].var()) > 0.0


def test_drawn_levels_have_the_frequencies_of_the_belief():
    """A hundred thousand hidden states of one belief, and of as many start states with the keys that made them."""
    problem, count = make_problem("linear20"), 100_000
    model, keys = problem.model, torch.arange(100_000)
    world, one = model.world(), problem.start(torch.tensor([7]))
    level = world.sample(one.expand(count), keys)["level"]
    found = torch.nn.functional.one_hot(level, model.num_levels).double()
    belief = one["belief"][0].double()
    assert (found.mean(0)[belief == 0] == 0).all()
    assert ((found.mean(0) - belief).abs() <= 4.5 * (belief * (1 - belief) / count).sqrt() + 1e-6).all()
    # Locations are independent.
    damage = level.double()
    moving = damage[:, damage.var(0) > 0]
    off = torch.corrcoef(moving.T) - torch.eye(moving.shape[1])
    assert float(off.abs().max()) < 5.0 / count**0.5
    starts = problem.start(keys)
    level = world.sample(starts, keys)["level"]
    surprise = torch.nn.functional.one_hot(level, model.num_levels) - starts["belief"].double()
    error = surprise.square().mean(0).sqrt() / count**0.5
    assert (surprise.mean(0).abs() <= 4.5 * error + 1e-6).all()
    assert torch.equal(level[50], world.sample(starts[50], keys[50])["level"]), "in any batch"
