from __future__ import annotations

import itertools

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.evaluation import discounted_costs, estimate
from torchrl_pomdp.modules import ZeroCost
from torchrl_pomdp.problems.check import check_belief_model
from torchrl_pomdp.problems.rocksample import NearestRock, RandomRocks, RockEncoder, RockSample, random_rocks, rocksample

NORTH, SOUTH, EAST, WEST, SAMPLE, CHECK = range(6)
NONE, GOOD, BAD = range(3)
ROCKS = [(0, 2), (1, 0)]


@pytest.fixture(scope="module")
def tiny():
    return RockSample(3, ROCKS, dtype=torch.float64)


def state(belief, cell, dtype=torch.float64):
    return TensorDict({"belief": torch.tensor([belief], dtype=dtype), "location": torch.tensor([[cell]])}, [1])


class Written:
    """RockSample(3, 2) as states (which rocks are good, cell or None), written out."""

    def moved(self, cell, u):
        x, y = cell % 3, cell // 3
        x, y = {NORTH: (x, y + 1), SOUTH: (x, y - 1), EAST: (x + 1, y), WEST: (x - 1, y)}.get(u, (x, y))
        return None if x == 3 else x + 3 * y

    def step(self, good, cell, u):
        """Reward, next state, and probabilities of the observations."""
        reward, after, seen = 0.0, list(good), {NONE: 1.0}
        goal = self.moved(cell, u)
        if u == SAMPLE:
            rock = ROCKS.index((cell % 3, cell // 3))
            reward, after[rock] = (10.0 if good[rock] else -10.0), False
        elif u >= CHECK:
            x, y = ROCKS[u - CHECK]
            right = 0.5 + 0.5 * 0.5 ** (((x - cell % 3) ** 2 + (y - cell // 3) ** 2) ** 0.5 / 20)
            seen = {GOOD: right, BAD: 1 - right} if good[u - CHECK] else {GOOD: 1 - right, BAD: right}
        return (10.0 if goal is None else reward), tuple(after), goal, seen


def test_equals_bayes_over_all_states(tiny):
    """Beliefs over the joint states, over every sequence of three legal controls and their observations."""
    written, start = Written(), 3
    joint = dict.fromkeys(itertools.product((False, True), repeat=2), 0.25)
    waiting, met = [(joint, start, state([0.5, 0.5], start), 3)], 0
    while waiting:
        joint, cell, y, depth = waiting.pop()
        if cell is None or depth == 0:
            assert bool(tiny.is_terminal(y)) == (cell is None)
            continue
        for u in tiny.action_mask(y)[0].nonzero().flatten().tolist():
            control, reward, posterior, goal = torch.tensor([u]), 0.0, {}, None
            for good, prob in joint.items():
                gain, after, goal, seen = written.step(good, cell, u)
                reward += prob * gain
                for z, chance in seen.items():
                    row = posterior.setdefault(z, {})
                    row[after] = row.get(after, 0.0) + prob * chance
            assert tiny.expected_cost(y, control).item() == pytest.approx(-reward)
            for z in range(3):
                total = sum(posterior.get(z, {}).values())
                assert tiny.observation_probs(y, control)[0, z].item() == pytest.approx(total)
                if total > 1e-12:
                    nxt = tiny.estimator(y, control, torch.tensor([z]))
                    normalised = {good: prob / total for good, prob in posterior[z].items()}
                    marginals = [sum(prob for good, prob in normalised.items() if good[rock]) for rock in range(2)]
                    assert nxt["belief"][0].tolist() == pytest.approx(marginals)
                    waiting.append((normalised, goal, nxt, depth - 1))
                    met += 1
    assert met > 200


def test_advance_draws_what_the_estimator_computes():
    model = rocksample(7, 8).model
    y = RandomRocks(model)(torch.arange(2000))
    generator = torch.Generator().manual_seed(0)
    u = torch.multinomial(model.action_mask(y).float(), 1, generator=generator).squeeze(-1)
    noise = torch.rand(2000, 1, generator=generator)
    cost, drawn = model.advance(y, u, noise)
    seen = (noise[:, 0] >= model.observation_probs(y, u)[:, GOOD]) + 1
    expected = model.estimator(y, u, torch.where(u >= CHECK, seen, NONE))
    assert all(torch.equal(drawn[key], expected[key]) for key in model.state_keys)
    assert torch.equal(cost, model.expected_cost(y, u))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rows_do_not_depend_on_the_batch(dtype):
    model = RockSample(7, random_rocks(7, 5, 1), dtype=dtype)
    y = model.drawn(RandomRocks(model), torch.arange(131))
    u = model.action_mask(y).to(torch.int8).argmax(-1)
    u[::2] = CHECK + torch.arange(131)[::2] % 5
    noise = torch.linspace(0, 0.999, 131, dtype=dtype).unsqueeze(-1)
    whole = model.advance(y, u, noise)
    for rows in (slice(0, 1), slice(3, 50), slice(64, 131)):
        cost, nxt = model.advance(y[rows], u[rows], noise[rows])
        assert torch.equal(cost, whole[0][rows])
        assert all(torch.equal(nxt[key], whole[1][rows][key]) for key in model.state_keys)
    assert model.advance(y[:0], u[:0], noise[:0])[1].batch_size == (0,)
    cost, nxt = model.advance(y[7], u[7], noise[7])
    assert cost == whole[0][7]
    assert torch.equal(nxt["belief"], whole[1][7]["belief"])


def test_obeys_the_contract():
    problem = rocksample(7, 8)
    check_belief_model(problem.model, problem.training[0])
    check_env_specs(BeliefEnv(problem.model, problem.start, batch_size=(3,), seed=0))
    check_env_specs(BeliefEnv(problem.model, problem.start, seed=0))


def test_legal_controls(tiny):
    def legal(cell):
        return [tiny.control_names[u] for u in tiny.action_mask(state([0.5, 0.5], cell))[0].nonzero().flatten()]

    checks = ["check rock 0", "check rock 1"]
    assert legal(6) == ["south", "east", "sample", *checks]
    assert legal(2) == ["north", "east", "west", *checks]
    assert legal(4) == ["north", "south", "east", "west", *checks]
    assert legal(9) == ["east"]
    left = state([0.5, 0.5], 9)
    east = torch.tensor([EAST])
    assert tiny.expected_cost(left, east).item() == 0.0
    assert tiny.estimator(left, east, torch.tensor([NONE]))["location"].item() == 9
    with pytest.raises(ValueError, match="illegal"):
        tiny.estimator(state([0.5, 0.5], 4), torch.tensor([SAMPLE]), torch.tensor([NONE]))
    with pytest.raises(ValueError, match="impossible"):
        tiny.estimator(state([0.5, 0.5], 4), east, torch.tensor([GOOD]))


def test_a_check_on_the_spot_is_certain(tiny):
    y, check = state([0.3, 0.5], 6), torch.tensor([CHECK])
    for z, good in ((GOOD, 1.0), (BAD, 0.0)):
        sure = tiny.estimator(y, check, torch.tensor([z]))
        assert sure["belief"][0].tolist() == [good, 0.5]
        assert tiny.observation_probs(sure, check)[0].tolist() == [0.0, good, 1.0 - good]


def test_names_of_hidden_variables(tiny):
    y = torch.cat([state([0.5, 0.5], 4)] * 4)
    assert tiny.observed(y, torch.tensor([EAST, SAMPLE, CHECK, CHECK + 1])).flatten().tolist() == [0, 0, 1, 2]


def test_layouts():
    assert rocksample(7, 8).model.describe().startswith("RockSample(7, 8): 12545 states")
    assert rocksample(11, 11, seed=5).model.describe().startswith("RockSample(11, 11): 247809 states")
    assert rocksample(11, 11, seed=5).model.rocks == rocksample(11, 11).model.rocks
    first, second = rocksample(15, 15).model, rocksample(15, 15, seed=1).model
    assert len(set(first.rocks)) == 15
    assert first.rocks == rocksample(15, 15).model.rocks != second.rocks


def test_wrong_rocks_are_named():
    with pytest.raises(ValueError, match=r"rocks\[1\]\[0\] must be at most 2, got 3"):
        RockSample(3, [(0, 0), (3, 0)])
    with pytest.raises(ValueError, match="distinct cells"):
        RockSample(3, [(0, 0), (0, 0)])
    with pytest.raises(ValueError, match=r"rocks\[0\] must be a cell"):
        RockSample(3, [(0, 0, 1)])
    with pytest.raises(ValueError, match="k must be at most 9, got 10"):
        rocksample(3, 10)
    with pytest.raises(ValueError, match=r"at most 16777216, got a size of 1000 and 1000 rocks"):
        rocksample(1000, 1000)


def test_the_nearest_rock_by_hand():
    """Check from within reach, go when it looks good, sample it there, leave when none is left."""
    model = RockSample(7, [(3, 3), (6, 0)])
    policy = NearestRock(model, look=2.0)
    cases = [
        ([0.5, 0.5], (0, 3), "east"),
        ([0.5, 0.5], (1, 3), "check rock 0"),
        ([0.9, 0.5], (3, 1), "north"),
        ([0.9, 0.5], (3, 3), "sample"),
        ([0.2, 0.5], (3, 3), "east"),
        ([0.2, 0.5], (4, 0), "check rock 1"),
        ([0.2, 0.9], (6, 2), "south"),
        ([0.2, 0.1], (6, 2), "east"),
    ]
    for belief, (x, y), name in cases:
        u = policy(state(belief, x + 7 * y, torch.float32))["action"]
        assert model.control_names[u] == name, (belief, x, y)
    assert policy(state([0.9, 0.9], 49, torch.float32))["action"].item() == EAST


def test_rewards_of_the_base_policy():
    """Means as of 200 000 independent simulations with hidden states; papers: SARSOP 21.4, DESPOT 21.8."""
    for n, k, low, high in ((7, 8, 20.6, 21.7), (11, 11, 21.8, 23.0)):
        problem = rocksample(n, k)
        policy = problem.base_policies["nearest"]
        costs = discounted_costs(problem.model, policy, problem.start, num_states=2000, max_steps=100, terminal_cost=ZeroCost())
        assert low < -estimate(costs).mean < high


def test_encoder_shows_rocks_from_where_the_rover_is():
    model = RockSample(5, [(2, 1), (4, 4)])
    y = state([0.25, 1.0], 2, torch.float32)
    features = RockEncoder(model)(y)[0]
    decay = [0.95, 0.95**6]
    told = [2 ** (-1 / 20), 2 ** (-(20**0.5) / 20)]
    known, places = [0.25, 1.0, 0.75, 0.0], [*decay, *told, 0.0, 0.4, 0.2, 0.8, 0.0, 0.0]
    near = [0.25 * decay[0], decay[1], 0.75 * decay[0], 0.0]
    north = [1, 0, 0, 0, 0, 0, 0]
    assert features.tolist() == pytest.approx([*known, *near, *places, 0, 0, 1, 0, 0, 1, 0, 0, 0, 0, *north])
    assert RockEncoder(model)(state([0.25, 1.0], 25, torch.float32))[0].nonzero().tolist() == [[28 + EAST]]
    rows = torch.tensor([2, 0])
    y = RandomRocks(model)(torch.arange(4))
    assert torch.equal(RockEncoder(model).encode_rows(y, rows), RockEncoder(model)(y[rows]))
