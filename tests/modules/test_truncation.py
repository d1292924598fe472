"""Truncation rules against one-row-at-a-time simulation, known stop times, and the invariance of exact terminal costs."""

from __future__ import annotations

import math

import pytest
import torch
from _oracles import exact_cost, random_states, small_model
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_pomdp.envs import TabularModel
from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.envs.repair import RepairModel, RepairPartition, damage_chain, line
from torchrl_pomdp.envs.rows import take_rows
from torchrl_pomdp.modules import AfterSteps, OnEntering, OnLeaving, RolloutPolicy, TruncatedRollout
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.problems import tiger


class MostLikely(Partition):
    """The most likely state is the part."""

    names, stages = ("0", "1", "2", "3"), ((0, 1, 2, 3),)

    def forward(self, y):
        return y["belief"].argmax(-1)


class Countdown(Partition):
    """Locations that may be damaged, 0 to 3, are the part."""

    names, stages = ("0", "1", "2", "3"), ((0,), (1,), (2,), (3,))

    def forward(self, y):
        return (y["belief"][..., 0] < 1).sum(-1)


def ring() -> TabularModel:
    """States 0, 1, 2, 3, 0, ... one after the other, seen exactly; state i costs i + 1, the discount is a half."""
    transition = torch.eye(4).roll(1, 1).unsqueeze(0)
    return TabularModel(transition, torch.eye(4).unsqueeze(0), torch.arange(1.0, 5.0).unsqueeze(0), 0.5, partition=MostLikely())


def only(y):
    return y.set("action", torch.zeros(y.batch_size, dtype=torch.int64))


def hundred(y):
    return torch.full(y.batch_size, 100.0)


RING_RULES = {
    # What the rule is, and the steps that it allows from the states 0, 1, 2, 3.
    "after 0": (AfterSteps(0), (0, 0, 0, 0)),
    "after 3": (AfterSteps(3), (3, 3, 3, 3)),
    "by state": (AfterSteps(lambda y: 2 * y["partition"]), (0, 2, 4, 6)),
    "entering 2": (OnEntering((2,)), (2, 1, 0, 3)),
    "entering 0 or 2": (OnEntering([2, 0]), (0, 1, 0, 1)),
    "leaving": (OnLeaving(), (1, 1, 1, 1)),
    "after 2 or entering 3": (AfterSteps(2) | OnEntering((3,)), (2, 2, 1, 0)),
    "by state or entering 3": (AfterSteps(lambda y: 2 * y["partition"]) | OnEntering((3,)), (0, 2, 1, 0)),
    "entering 3, by state, or never": (
        OnEntering((3,)) | AfterSteps(lambda y: 2 * y["partition"]) | AfterSteps(50),
        (0, 2, 1, 0),
    ),
    "leaving or by state": (OnLeaving() | AfterSteps(lambda y: (y["partition"] - 1).clamp_min(0)), (0, 0, 1, 1)),
    "none": (None, (7, 7, 7, 7)),
}


@pytest.mark.parametrize("name", RING_RULES)
@pytest.mark.parametrize("chunk_rows", [1, 3, 100])
def test_stop_times_that_are_known(name, chunk_rows):
    rule, stops = RING_RULES[name]
    y = TensorDict({"belief": torch.eye(4)}, [4])
    cost = TruncatedRollout(ring(), only, max_steps=7, truncation=rule, terminal_cost=hundred, chunk_rows=chunk_rows)
    expected = [
        sum(0.5**k * ((start + k) % 4 + 1) for k in range(steps)) + 0.5**steps * 100 for start, steps in enumerate(stops)
    ]
    torch.testing.assert_close(cost(y, torch.arange(4)), torch.tensor(expected), rtol=1e-6, atol=0)


def test_a_trajectory_that_waits_long_after_its_end_adds_nothing():
    """One in ten ends by max_steps between two renewals of the chunk and stays in place beyond it."""
    start = torch.tensor([0] + [1] * 9 + [0] * 9)
    rule = AfterSteps(lambda y: torch.where(y["partition"] == 1, 5, 20))
    cost = TruncatedRollout(ring(), only, max_steps=10, truncation=rule, terminal_cost=hundred, chunk_rows=10)
    by_start = [sum(0.5**k * ((i + k) % 4 + 1) for k in range(steps)) + 0.5**steps * 100 for i, steps in ((0, 10), (1, 5))]
    y = TensorDict({"belief": torch.eye(4)[start]}, [19])
    torch.testing.assert_close(cost(y, torch.arange(19)), torch.tensor(by_start)[start], rtol=1e-6, atol=0)


def naive_cost(model, policy, y, key, stop, terminal_cost, max_steps):
    """Cost and steps of one trajectory, written down as the paper says it; ``stop(y, age, start)`` is the rule."""
    y = start = model.with_features(y.reshape(1))
    total, age, scenario = 0.0, 0, Scenarios.single(key)
    while not model.is_terminal(y):
        if age == max_steps or stop(y, age, start):
            return total + model.discount**age * float(terminal_cost(y)), age
        u = policy(y.copy())["action"]
        noise, scenario = scenario.draw(torch.tensor([age]), model.observed(y, u), 1)
        cost, y = model.advance(y, u, noise)
        total, age = total + model.discount**age * float(cost), age + 1
    return total, age


def damage(y):
    """A terminal cost that tells states apart."""
    return 3 + y["belief"][..., 1:].sum((-1, -2))


def twice_the_part(y):
    return 2 * y["partition"]


REPAIR_RULES = {
    "by part": (AfterSteps(twice_the_part), lambda y, age, start: age >= 2 * int(start["partition"])),
    "entering 1": (OnEntering((1,)), lambda y, age, start: int(y["partition"]) == 1),
    "leaving": (OnLeaving(), lambda y, age, start: int(y["partition"]) != int(start["partition"])),
    "entering 1 or by part": (
        OnEntering((1,)) | AfterSteps(twice_the_part),
        lambda y, age, start: int(y["partition"]) == 1 or age >= 2 * int(start["partition"]),
    ),
    "none": (None, lambda y, age, start: False),
}


@pytest.mark.parametrize("name", REPAIR_RULES)
def test_costs_are_those_of_a_simulation_row_by_row(name):
    rule, stop = REPAIR_RULES[name]
    model = small_model(partition=Countdown())
    y, keys, greedy = random_states(model, 60, seed=1), torch.arange(60) * 7, GreedyRepair(model)
    cost = TruncatedRollout(model, greedy, max_steps=9, truncation=rule, terminal_cost=damage, chunk_rows=13)(y, keys)
    naive = [naive_cost(model, greedy, y[i : i + 1], keys[i : i + 1], stop, damage, 9) for i in range(60)]
    torch.testing.assert_close(cost, torch.tensor([total for total, _ in naive], dtype=torch.float64), rtol=1e-12, atol=0)
    assert len({steps for _, steps in naive}) > 1


@pytest.mark.parametrize("rows", [1, 3, 16, 1000])
def test_results_are_the_same_for_any_chunk_size_with_rules(linear20, rows):
    keys = torch.arange(70)
    y, greedy = linear20.start(keys), GreedyRepair(linear20.model)
    rules = {
        "state": AfterSteps(lambda y: y["location"][:, 0]),
        "endgame": OnEntering((3, 4, 5)),
        "both": OnLeaving() | AfterSteps(30),
    }
    sizes = {}
    for name, rule in rules.items():
        options = {"truncation": rule, "terminal_cost": lambda y: y["belief"][..., 4].sum(-1)}
        whole = TruncatedRollout(linear20.model, greedy, **options)(y, keys)
        assert torch.equal(TruncatedRollout(linear20.model, greedy, chunk_rows=rows, **options)(y, keys), whole)
        sizes[name] = whole.sum()
    assert len(set(sizes.values())) == len(rules)


def test_no_trajectory_gets_the_terminal_cost_twice_and_terminal_ones_never(linear20):
    y, keys = linear20.start(torch.arange(200)), torch.arange(200)
    y["belief"][:20] = torch.eye(5)[0]
    cut = []

    class Recording(TruncatedRollout):
        def _add_terminal_costs(self, terminal_cost, live, index, total):
            cut.extend(live.number[index].tolist())
            super()._add_terminal_costs(terminal_cost, live, index, total)

    # Trajectories that go on in place pass through several parts and would be cut again.
    rule = OnEntering((3, 5)) | AfterSteps(30)
    recording = Recording(linear20.model, GreedyRepair(linear20.model), truncation=rule, terminal_cost=damage, chunk_rows=64)
    recording.scalar = None
    recording(y, keys)
    assert sorted(cut) == list(range(20, 200))


class Memoised:
    """Exact cost of a policy as terminal cost, computed once for every state."""

    def __init__(self, model, policy):
        self.model, self.policy, self.known = model, policy, {}

    def __call__(self, y):
        keys = self.model.fingerprint(y).tolist()
        for i, key in enumerate(keys):
            if key not in self.known:
                self.known[key] = exact_cost(self.model, self.policy, y[i : i + 1].select(*self.model.state_keys))
        return torch.tensor([self.known[key] for key in keys], dtype=self.model.dtype)


@pytest.fixture(scope="module")
def tiny():
    model = small_model(line(3), partition=Countdown())
    return model, GreedyRepair(model), Memoised(model, GreedyRepair(model))


TINY_RULES = [AfterSteps(0), AfterSteps(1), AfterSteps(2), AfterSteps(5), None, OnLeaving(), OnEntering((1,)) | AfterSteps(4)]


@pytest.mark.parametrize("rule", TINY_RULES, ids=["0", "1", "2", "5", "none", "leaving", "entering"])
def test_with_the_base_policys_own_cost_the_mean_does_not_depend_on_m(tiny, rule):
    model, greedy, exact = tiny
    belief = torch.rand(3, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    belief[:, 1] = torch.eye(3, dtype=torch.float64)[0]
    # The robot stands where nothing is to be repaired, so that its first step already observes something.
    y = TensorDict({"belief": belief / belief.sum(-1, keepdim=True), "location": torch.ones(3, 1, dtype=torch.int64)}, [3])
    many = take_rows(y, torch.arange(3).repeat_interleave(2000))
    rollout = TruncatedRollout(model, greedy, truncation=rule, terminal_cost=exact, chunk_rows=1000)
    cost = rollout(many, torch.arange(6000)).view(3, 2000)
    error = cost.std(1) / math.sqrt(2000)
    assert bool(((cost.mean(1) - exact(y)).abs() < 4 * error + 1e-5).all())
    assert bool((error > 1e-3).all()) != (rule is TINY_RULES[0])


@pytest.mark.parametrize("rule", TINY_RULES, ids=["0", "1", "2", "5", "none", "leaving", "entering"])
def test_without_randomness_it_does_not_depend_on_m_at_all(rule):
    model = small_model(line(3), degradation=(0.0, 1.0), partition=Countdown())
    y = random_states(model, 40, seed=2)
    y["belief"] = torch.nn.functional.one_hot(y["belief"].argmax(-1), 3).double()
    exact = Memoised(model, GreedyRepair(model))
    cost = TruncatedRollout(model, GreedyRepair(model), truncation=rule, terminal_cost=exact)(y, torch.arange(40))
    torch.testing.assert_close(cost, exact(y), rtol=1e-9, atol=1e-9)
    assert float(cost.max()) > 0


class Value(nn.Module):
    def forward(self, belief: Tensor, part: Tensor) -> Tensor:
        return belief[..., 1].sum(-1) + 10 * part


def test_a_module_that_writes_state_value_is_a_terminal_cost_and_gets_its_features(linear20):
    y, keys, greedy = linear20.start(torch.arange(50)), torch.arange(50), GreedyRepair(linear20.model)
    module = TensorDictModule(Value(), in_keys=["belief", "partition"], out_keys=["state_value"])
    seen = set()

    def function(y):
        seen.update(y.keys())
        return Value()(y["belief"], y["partition"])

    costs = [
        TruncatedRollout(linear20.model, greedy, truncation=AfterSteps(5), terminal_cost=terminal_cost)(y, keys)
        for terminal_cost in (module, function)
    ]
    assert torch.equal(*costs)
    assert seen == {"belief", "location", "action_mask", "partition"}


@pytest.mark.parametrize("rule", [None, AfterSteps(4), OnEntering((3, 4, 5))], ids=["none", "after", "entering"])
def test_every_step_computes_the_features_that_are_read_and_no_more(linear20, rule):
    seen = set()

    class Watching(GreedyRepair):
        def forward(self, tensordict):
            seen.update(tensordict.keys())
            return super().forward(tensordict)

    rollout = TruncatedRollout(
        linear20.model, Watching(linear20.model), max_steps=5, truncation=rule, terminal_cost=lambda y: y["partition"] + 1.0
    )
    rollout(linear20.start(torch.arange(9)), torch.arange(9))
    assert seen - {"action"} == {"belief", "location", *(rule.in_keys if rule else ())}


def test_the_rollout_policy_passes_the_rule_on(line3):
    y, greedy = line3.start(torch.arange(5)), GreedyRepair(line3.model)
    rule, rest = AfterSteps(0), lambda y: 7 + 0 * y["belief"][..., 0].sum(-1)
    q = RolloutPolicy(line3.model, greedy, trajectories=2, truncation=rule, terminal_cost=rest).q_factors(y)
    stage = line3.model.expected_cost(y).unsqueeze(-1)
    legal = torch.isfinite(q)
    torch.testing.assert_close(q[legal], (stage + line3.model.discount * 7).expand_as(q)[legal])


def test_rules_of_several_robots_and_of_the_papers_partition():
    graph, costs = line(6), (0.0, 1.0, 5.0)
    model = RepairModel(
        graph,
        damage_chain((0.0, 0.3)),
        costs,
        0.9,
        num_robots=2,
        partition=RepairPartition(graph, torch.tensor(costs)),
        dtype=torch.float64,
    )
    y, keys, greedy = random_states(model, 40, seed=3), torch.arange(40), GreedyRepair(model)
    cost = TruncatedRollout(model, greedy, truncation=OnEntering((3, 4, 5)), terminal_cost=damage, chunk_rows=7)(y, keys)
    naive = [
        naive_cost(model, greedy, y[i : i + 1], keys[i : i + 1], lambda y, age, start: int(y["partition"]) >= 3, damage, 400)
        for i in range(40)
    ]
    torch.testing.assert_close(cost, torch.tensor([total for total, _ in naive], dtype=torch.float64), rtol=1e-12, atol=0)
    assert {steps for _, steps in naive} > {0, 1, 2}


def test_bad_rules_are_refused(linear20):
    model, greedy = linear20.model, GreedyRepair(linear20.model)
    with pytest.raises(ValueError, match="m must be at least 0, got -1"):
        AfterSteps(-1)
    with pytest.raises(ValueError, match="parts must hold at least one part"):
        OnEntering(())
    with pytest.raises(ValueError, match=r"none below 0, got \(-1, 2\)"):
        OnEntering((2, -1))
    with pytest.raises(ValueError, match="truncation needs a terminal_cost"):
        TruncatedRollout(model, greedy, truncation=AfterSteps(3))
    with pytest.raises(ValueError, match=r"parts must be in 0\.\.5, got \(3, 6\)"):
        TruncatedRollout(model, greedy, truncation=AfterSteps(3) | OnEntering((3, 6)), terminal_cost=damage)
    known = tiger().model
    bare = TabularModel(known.transition, known.observation, known.cost, 0.9)
    with pytest.raises(ValueError, match=r"OnLeaving reads \['partition'\]"):
        TruncatedRollout(bare, only, truncation=OnLeaving() | AfterSteps(3), terminal_cost=hundred)
    with pytest.raises(TypeError):
        AfterSteps(3) | 4


@pytest.mark.parametrize(
    ("m", "message"),
    [
        (lambda y: y["location"][:, 0] - 20, "m must give at least 0 for every state, got -"),
        (lambda y: y["location"], r"m must give int64 \(6,\), got torch.int64 \(6, 1\)"),
        (lambda y: y["belief"][:, 0, 0], r"m must give int64 \(6,\), got torch.float32"),
    ],
)
def test_bad_state_dependent_numbers_of_steps_are_refused(linear20, m, message):
    rollout = TruncatedRollout(linear20.model, GreedyRepair(linear20.model), truncation=AfterSteps(m), terminal_cost=damage)
    with pytest.raises(ValueError, match=message):
        rollout(linear20.start(torch.arange(6)), torch.arange(6))


def test_terminal_costs_of_the_wrong_shape_are_refused(linear20):
    rollout = TruncatedRollout(
        linear20.model, GreedyRepair(linear20.model), max_steps=2, terminal_cost=lambda y: y["belief"].sum(-1)
    )
    with pytest.raises(ValueError, match=r"terminal_cost must give costs of shape \(6,\), got \(6, 20\)"):
        rollout(linear20.start(torch.arange(6)), torch.arange(6))
