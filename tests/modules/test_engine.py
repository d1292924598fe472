"""The rollout engine: compiled and eager, small and large chunks, threads, long runs."""

from __future__ import annotations

import math
import threading
import time
import warnings

import pytest
import torch
from tensordict import TensorDict
from torch._dynamo import config as dynamo_config
from torch._dynamo.utils import counters
from torch._inductor import config as inductor_config

from torchrl_pomdp import noise
from torchrl_pomdp.envs.repair import CalibratedStart, RepairModel, damage_chain, line
from torchrl_pomdp.modules import (
    AfterSteps,
    PartitionedPolicy,
    PolicyNetwork,
    RolloutPolicy,
    TruncatedRollout,
    ZeroCost,
)
from torchrl_pomdp.modules.compiling import compiled
from torchrl_pomdp.modules.qfactors import spread
from torchrl_pomdp.modules.repair import GreedyRepair, RelativeEncoder
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.modules.threads import map_threads
from torchrl_pomdp.problems import tiger
from torchrl_pomdp.stopping import check_stopped


def chain_model(size, drift=0.0, dtype=torch.float32):
    return RepairModel(line(size), damage_chain((drift, 0.02, 0.03, 0.05)), (0, 0.1, 1, 10, 100), 0.99, dtype=dtype)


@pytest.mark.parametrize("rows", [1, 3, 16, 50, 1000])
def test_results_are_the_same_for_any_chunk_size(linear20, rows):
    keys = torch.arange(90)
    y = linear20.start(keys)
    for options in ({}, {"max_steps": 17, "terminal_cost": lambda y: y["belief"][..., 4].sum(-1)}):
        whole = TruncatedRollout(linear20.model, GreedyRepair(linear20.model), **options)(y, keys)
        small = TruncatedRollout(linear20.model, GreedyRepair(linear20.model), chunk_rows=rows, **options)(y, keys)
        assert torch.equal(small, whole)


def test_the_number_of_threads_changes_nothing(linear20):
    y = linear20.start(torch.arange(30))
    policy = RolloutPolicy(linear20.model, GreedyRepair(linear20.model), trajectories=4)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = policy.q_factors(y)
        torch.set_num_threads(3)
        three = policy.q_factors(y)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert torch.equal(one, three)


def test_what_fails_in_one_thread_stops_the_others():
    """As Ctrl-C does, which reaches the main thread alone: searches look again and again whether to go on."""
    both = threading.Barrier(2)

    def work(number):
        both.wait(60)
        if number == 0:
            raise KeyboardInterrupt
        for _ in range(60_000):
            check_stopped()
            time.sleep(0.001)
        pytest.fail("was not stopped")

    with pytest.raises(KeyboardInterrupt):
        map_threads(work, [0, 1], threads=2)
    check_stopped()


def test_map_threads_passes_errors_on():
    def fail(x):
        raise ValueError(f"no {x}")

    with pytest.raises(ValueError, match="no 1"):
        map_threads(fail, [1, 2], threads=2)


def test_labels_can_be_trained_on(linear20):
    """Simulations run in inference mode; what they return must be ordinary tensors."""
    q = RolloutPolicy(linear20.model, GreedyRepair(linear20.model), trajectories=2).q_factors(linear20.start(torch.arange(3)))
    weight = torch.ones(3, requires_grad=True)
    (q.nan_to_num(posinf=0.0) @ weight).sum().backward()
    assert weight.grad is not None


def open_when_sure(y):
    """A policy for the tiger of few operations and without a twin, which would be compiled instead."""
    sure, right = y["belief"].amax(-1) > 0.9, y["belief"][..., 0] > 0.5
    return y.set("action", torch.where(sure, torch.where(right, 2, 1), 0))


def test_fused_and_eager_agree(monkeypatch):
    """All that a step may hold: the stratified observations of several trajectories, and a rule that cuts them."""
    # Few operations, since to compile them takes most of the time.
    monkeypatch.setattr(noise, "ROUNDS", 2)
    model, left = tiger().model, torch.linspace(0.1, 0.9, 30)
    y = TensorDict({"belief": torch.stack([left, 1 - left], -1)}, [30])
    options = {"trajectories": 3, "truncation": AfterSteps(12), "terminal_cost": ZeroCost()}
    # Nothing is observed yet, as in a leaf something is.
    number = torch.arange(30)
    scenarios = Scenarios(number, number // 3, number % 3, torch.zeros_like(number))
    found = []
    for fused in (True, False):
        policy = RolloutPolicy(model, open_when_sure, compile=fused, **options)
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message="compile=True")
            found.append((policy.q_factors(y), policy.cost_to_go(y, scenarios, 3)))
    torch.testing.assert_close(*found, rtol=1e-5, atol=1e-3)


def test_without_a_compiler_it_runs_as_it_is():
    problem, keys = tiger(), torch.arange(20)
    y = problem.start(keys)
    with (
        inductor_config.patch({"cpp.cxx": ("/no/such/compiler",), "force_disable_caches": True}),
        pytest.warns(UserWarning, match="compile=True has no effect"),
    ):
        cost = TruncatedRollout(problem.model, open_when_sure, compile=True)(y, keys)
    assert torch.equal(cost, TruncatedRollout(problem.model, open_when_sure)(y, keys))


def test_each_compiled_function_has_its_own_limit_of_compilations():
    """Rollouts of several problems have the same step; none may use up what another one is allowed."""

    class Multiple:
        def __init__(self, twice):
            self.twice = twice

        def of(self, x):
            return x * 2 if self.twice else x * 3

    x, before = torch.arange(4.0), counters["stats"]["unique_graphs"]
    with dynamo_config.patch(recompile_limit=1):
        for twice in (True, False):
            assert torch.equal(compiled(Multiple(twice).of)(x), x * (2 if twice else 3))
    assert counters["stats"]["unique_graphs"] == before + 2


def test_float32_agrees_with_float64_over_long_runs_on_long_lines():
    def sweep(y):
        """Repair wherever that is allowed, else go right, at the end left."""
        return y.set("action", torch.where(y["action_mask"][..., 0], 0, torch.where(y["action_mask"][..., 2], 2, 1)))

    costs = []
    for dtype in (torch.float32, torch.float64):
        model = chain_model(500, dtype=dtype)
        y = CalibratedStart(model)(torch.arange(64))
        costs.append(TruncatedRollout(model, sweep, max_steps=400)(y, torch.arange(64)).double())
    torch.testing.assert_close(costs[0], costs[1], rtol=1e-4, atol=0)


def test_beliefs_stay_normalised(linear20):
    model, greedy = chain_model(20, drift=0.01), GreedyRepair(chain_model(20, drift=0.01))
    y = model.with_features(linear20.start(torch.arange(64)), ("belief", "location"))
    for step in range(400):
        _, y = model.advance(y, greedy(y.copy())["action"], torch.full((64, 1), (step * 0.618) % 1))
    assert float((y["belief"].sum(-1) - 1).abs().max()) < 2e-5


def test_the_router_equals_its_networks(linear20):
    model = linear20.model
    generator = torch.Generator().manual_seed(0)
    encoder = RelativeEncoder(model)
    networks = [PolicyNetwork(encoder, 3, (16,), generator=generator) for _ in range(6)]
    y = model.with_features(torch.cat([training(torch.arange(40)) for training in linear20.training]))
    mixed = [GreedyRepair(model), *networks[1:4], networks[4], networks[4]]
    for policies in (networks, mixed):
        routed = PartitionedPolicy(policies)(y.copy())
        for part, policy in enumerate(policies):
            rows = (y["partition"] == part).nonzero().squeeze(-1)
            assert torch.equal(routed["action"][rows], policy(y[rows])["action"])


def test_adaptive_allocation_settles_clear_decisions_and_agrees_with_uniform(linear20):
    y = linear20.start(torch.arange(60))
    q, steps = [], []
    for allocation in ("uniform", "adaptive"):
        policy = RolloutPolicy(linear20.model, GreedyRepair(linear20.model), trajectories=40, allocation=allocation)
        q.append(policy.q_factors(y))
        steps.append(policy.simulated_steps)
    assert steps[1] < 0.5 * steps[0]
    assert torch.equal(torch.isfinite(q[0]), torch.isfinite(q[1]))
    regret = q[0].gather(1, q[1].argmin(1, keepdim=True)).squeeze(1) - q[0].amin(1)
    assert float(regret.mean()) < 0.01 * float(q[0].amin(1).mean())
    few = RolloutPolicy(linear20.model, GreedyRepair(linear20.model), trajectories=1, allocation="adaptive").q_factors(y)
    assert torch.equal(few, RolloutPolicy(linear20.model, GreedyRepair(linear20.model), trajectories=1).q_factors(y))


def test_adaptive_labels_do_not_depend_on_the_batch(linear20):
    y = linear20.start(torch.arange(40))
    policy = RolloutPolicy(linear20.model, GreedyRepair(linear20.model), trajectories=8, allocation="adaptive")
    assert torch.equal(torch.cat([policy.q_factors(part) for part in y.split(7)]), policy.q_factors(y))


def test_adaptive_allocation_with_exact_first_observations():
    y = {"belief": torch.tensor([[0.5, 0.5], [0.97, 0.03]])}

    def listen(y):
        return y.set("action", torch.zeros(y.batch_size, dtype=torch.int64))

    policy = RolloutPolicy(tiger().model, listen, trajectories=6, allocation="adaptive", leaves="observation", max_steps=80)
    assert policy(TensorDict(y, [2]))["action"].tolist() == [0, 2]


@pytest.mark.parametrize("count", [1, 2, 3, 10, 64])
def test_spread_is_a_permutation_with_even_beginnings(count):
    order = spread(count)
    assert sorted(order.tolist()) == list(range(count))
    for k in range(2, count + 1):
        gaps = order[:k].sort().values.diff()
        assert int(gaps.max()) <= 2 * math.ceil(count / k) + 1
