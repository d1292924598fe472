"""Compiled histories, from which the searches grow their trees, are what the models say."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_pomdp.envs import TabularModel
from torchrl_pomdp.envs.repair import Graph, RepairModel, damage_chain, line
from torchrl_pomdp.modules import Myopic, TruncatedRollout
from torchrl_pomdp.modules.repair import UrgencyRepair
from torchrl_pomdp.modules.repair.scalar import View
from torchrl_pomdp.modules.scalar import Limited, local_engine, scalar_engine
from torchrl_pomdp.noise import fold, seed_keys
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.scalar.compiling import Loops, outer
from torchrl_pomdp.scalar.models import (
    costs,
    keep,
    mask,
    move,
    over,
    preferred,
    recall,
    relaxed,
    remaining,
    see,
    seen_after,
    settle,
    start,
)
from torchrl_pomdp.scalar.noise import Noise
from torchrl_pomdp.scalar.noise import fold as fold_key
from torchrl_pomdp.scalar.twins import choose

STEPS = 6


def call(function, *args):
    """Call a loop, of whatever model."""
    return Loops()(function, *args)


@outer
def follow(model, state, controls, observations, legal, stage_costs, ended, row):
    """A history step by step: what each of its states shows; the state is kept and another one taken in between."""
    start(model, state)
    for i in range(len(controls)):
        mask(model, state, legal[i])
        costs(model, state, stage_costs[i])
        ended[i] = over(model, state)
        keep(model, state, row)
        start(model, state)
        recall(model, state, row)
        move(model, state, controls[i])
        settle(model, state, observations[i])


@outer
def watch(model, policy, state, key, count, controls, found, lowest, chosen):
    """Down a history of the scenario ``key`` by ``controls``: bounds and costs of many scenarios that go on from there."""
    start(model, state)
    seen = np.uint64(0)
    for u in controls:
        move(model, state, u)
        z = see(model, state, Noise(key, key, 0, 1, seen))
        seen = seen_after(model, state, seen)
        settle(model, state, z)
    row = found[0]
    keep(model, state, row)
    for i in range(count):
        recall(model, state, row)
        noise = Noise(fold_key(key, np.uint64(i)), key, i, count, seen)
        lowest[i, 0] = relaxed(model, state, noise)
        cost, _, well = remaining(model, policy, state, noise)
        lowest[i, 1] = cost if well else np.nan
    recall(model, state, row)
    chosen[0] = preferred(model, policy, state)


def histories(model, count, steps, generator):
    """Random feature states, legal controls, possible observations, and the states that follow, by the model's tensors."""
    states = make_states(model, count, generator)
    y = model.with_features(states)
    trail, controls, observations = [y], [], []
    for _ in range(steps):
        u = torch.multinomial(y["action_mask"].float(), 1, generator=generator).squeeze(-1)
        z = torch.multinomial(model.observation_probs(y, u).float(), 1, generator=generator).squeeze(-1)
        y = model.with_features(model.estimator(y, u, z))
        controls.append(u)
        observations.append(z)
        trail.append(y)
    return trail, torch.stack(controls, -1), torch.stack(observations, -1)


def make_states(model, count, generator):
    if isinstance(model, TabularModel):
        belief = torch.rand(count, model.num_states, generator=generator, dtype=model.dtype)
        belief = belief * (torch.rand(count, model.num_states, generator=generator) < 0.6) + 1e-3
        return TensorDict({"belief": belief / belief.sum(-1, keepdim=True)}, [count])
    shape = count, model.num_locations, model.num_levels
    belief = torch.rand(shape, generator=generator, dtype=model.dtype).square()
    certain = torch.eye(model.num_levels, dtype=model.dtype)[torch.randint(model.num_levels, shape[:2], generator=generator)]
    belief = torch.where(torch.rand(shape[:2], generator=generator).unsqueeze(-1) < 0.4, certain, belief)
    location = torch.randint(model.num_locations, (count, model.num_robots), generator=generator)
    return TensorDict({"belief": belief / belief.sum(-1, keepdim=True), "location": location}, [count])


def repair_models():
    """Lines and a tree, with drift and without, one robot and two, also with repairs of what is intact."""
    tree = Graph.from_edges("tree", 5, [(0, 1), (1, 2), (1, 3), (3, 4)])
    chains = (
        damage_chain((0.0, 0.3)),
        damage_chain((0.1, 0.2, 0.4)),
        torch.tensor([[0.8, 0.1, 0.1], [0.3, 0.5, 0.2], [0.1, 0, 0.9]]),
    )
    for number, (graph, chain) in enumerate(((line(3), chains[0]), (tree, chains[1]), (tree, chains[0]), (line(4), chains[2]))):
        for robots in (1, 2):
            prices = torch.tensor([0.0, 1.0, 5.0, 20.0][: len(chain)]) + (number == 1)
            model = RepairModel(graph, chain, prices, 0.9, num_robots=robots, dtype=torch.float64)
            yield pytest.param(model, id=f"{number}-{robots}")
    yield pytest.param(
        RepairModel(line(3), chains[0], [0.0, 1.0, 5.0], 0.9, dtype=torch.float64).unrestricted(), id="unrestricted"
    )
    # Locations of many kinds, intact ones that cost something, repairs that may fail.
    own = torch.stack([damage_chain((0.0, rate)) for rate in (0.1, 0.3, 0.5, 0.7)])
    prices = torch.tensor([[0.5, 1.0, 5.0]]) * torch.tensor([[1.0], [2.0], [1.0], [0.5]])
    yield pytest.param(
        RepairModel(line(4), own, prices, 0.9, repair_probability=0.4, dtype=torch.float64), id="many kinds, failing repairs"
    )


def tabular_models():
    generator = torch.Generator().manual_seed(3)
    tables = [torch.rand(shape, generator=generator).square() for shape in ((3, 6, 6), (3, 6, 4))]
    legal = torch.rand(6, 3, generator=generator) < 0.7
    legal[:, 1] = True
    tables = [table / table.sum(-1, keepdim=True) for table in tables]
    yield pytest.param(
        TabularModel(*tables, torch.randn(3, 6, generator=generator), 0.9, legal=legal, dtype=torch.float64), id="random"
    )
    yield pytest.param(make_problem("tiger").model, id="tiger")


@pytest.mark.parametrize("model", [*repair_models(), *tabular_models()])
def test_histories_are_those_of_the_model(model):
    generator = torch.Generator().manual_seed(0)
    trail, controls, observations = histories(model, 30, STEPS, generator)
    roots = local_engine((), model, Limited(50, None, None)).roots(trail[0], 0)
    for i in range(30):
        shape = STEPS, model.num_controls
        legal, stage_costs, ended = np.zeros(shape, np.bool_), np.zeros(shape), np.zeros(STEPS, np.bool_)
        moves, seen = (np.ascontiguousarray(each[i].numpy()) for each in (controls, observations))
        call(follow, roots.model, roots.state(i), moves, seen, legal, stage_costs, ended, np.empty(roots.width))
        for step, y in enumerate(trail[:-1]):
            assert legal[step].tolist() == y["action_mask"][i].tolist()
            assert ended[step] == bool(model.is_terminal(y)[i])
            for u in range(model.num_controls):
                expected = float(model.expected_cost(y[i : i + 1], torch.tensor([u])))
                assert stage_costs[step, u] == pytest.approx(expected, rel=1e-5, abs=1e-6)


def engines(model):
    limits = Limited(60, None, None)
    policies = [Myopic(model) if isinstance(model, TabularModel) else UrgencyRepair(model)]
    return [local_engine((), model, limits), *(scalar_engine(policy, model, limits) for policy in policies)], policies


def watched(engine, y, number, controls, count):
    roots = engine.roots(y, 5)
    found, lowest, chosen = np.zeros((1, roots.width)), np.zeros((count, 2)), np.zeros(1, np.int64)
    key = roots.keys[number]
    call(watch, roots.model, roots.policy, roots.state(number), key, count, controls, found, lowest, chosen)
    return lowest, int(chosen[0])


@pytest.mark.parametrize("model", [*repair_models(), *tabular_models()])
def test_no_policy_costs_less_than_the_relaxation_in_any_scenario(model):
    generator = torch.Generator().manual_seed(1)
    y = make_states(model, 12, generator)
    if isinstance(model, RepairModel):
        # Damage where the first robot stands, and nowhere else: what follows its repair costs what intact locations do.
        y["belief"][0] = torch.eye(model.num_levels, dtype=model.dtype)[0]
        y["belief"][0, y["location"][0, 0]] = torch.eye(model.num_levels, dtype=model.dtype)[1]
    every, _ = engines(model)
    nontrivial = 0
    for engine in every:
        for number in range(12):
            for depth in (0, 1, 3):
                controls = random_controls(model, y[number : number + 1], depth, generator)
                lowest, _ = watched(engine, y, number, controls, 40)
                assert np.isfinite(lowest).all()
                assert (lowest[:, 0] <= lowest[:, 1] + 1e-9 * (1 + np.abs(lowest[:, 1]))).all()
                nontrivial += int((lowest[:, 0] > 0.0).sum())
    assert nontrivial or isinstance(model, TabularModel) or not engine.tables.upward


def random_controls(model, y, depth, generator):
    """Controls that are legal whatever is seen: moves alone, in a repair model."""
    if isinstance(model, TabularModel):
        always = model.legal.all(0).nonzero().flatten()
        return always[torch.randint(len(always), (depth,), generator=generator)].numpy().astype(np.int64)
    digits, place, found = model.num_robot_controls, y["location"][0].clone(), []
    for _ in range(depth):
        joint = 0
        for robot in range(model.num_robots):
            moves = (model.destinations[place[robot], 1:] >= 0).nonzero().flatten() + 1
            u = int(moves[torch.randint(len(moves), (1,), generator=generator)])
            place[robot], joint = model.destinations[place[robot], u], joint * digits + u
        found.append(joint)
    return np.array(found, np.int64)


@pytest.mark.parametrize("name", ["line3", "linear20", "two_robots20", "tiger"])
def test_what_remains_is_what_rollout_simulates(name):
    problem = make_problem(name)
    model = problem.model
    every, policies = engines(model)
    y = problem.start(seed_keys(1, torch.arange(3)))
    for engine, policy in zip(every[1:], policies, strict=True):
        for number in range(3):
            lowest, chosen = watched(engine, y, number, np.zeros(0, np.int64), 4000)
            assert chosen == int(policy(y[number : number + 1].clone())["action"])
            rows = y[number : number + 1].expand(4000).clone()
            exact = TruncatedRollout(model, policy, max_steps=60, terminal_cost=nothing)(
                rows, fold(seed_keys(2, torch.arange(4000)), 0)
            )
            error = float((exact.var() / 4000 + lowest[:, 1].var() / 4000) ** 0.5)
            assert abs(float(exact.mean()) - lowest[:, 1].mean()) < 4 * error + 1e-6


def nothing(y):
    return torch.zeros(y.batch_size, dtype=y["belief"].dtype)


@pytest.mark.parametrize("seed", range(5))
def test_random_controls_are_legal_and_equally_likely(seed):
    model = make_problem("two_robots20").model
    y = model.with_features(make_states(model, 1, torch.Generator().manual_seed(seed)))
    roots = local_engine((), model, Limited(60, None, None)).roots(y, seed)
    state, counts = roots.state(0), np.zeros(model.num_controls, np.int64)
    call(count_choices, roots.model, roots.policy, state, 9000, counts)
    legal = y["action_mask"][0].numpy()
    assert counts.sum() == 9000
    assert (counts[~legal] == 0).all()
    expected = 9000 / legal.sum()
    # A chi-square number with as many degrees of freedom as there are controls, less one.
    assert ((counts[legal] - expected) ** 2 / expected).sum() < 27


@outer
def count_choices(model, policy, state, count, counts):
    start(model, state)
    tables, work = model[1][0], state.work
    for number in range(count):
        key = fold_key(np.uint64(7), np.uint64(number))
        view = View(0, work.location, work.level, work.since, work.intact, state.belief, tables, work.numbers, key)
        choose(policy, view, work.controls)
        u = 0
        for control in work.controls:
            u = u * tables.destinations.shape[1] + control
        counts[u] += 1
