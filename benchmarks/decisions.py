"""What decisions cost: one, millions of labels, adaptive allocation, realised costs in place of expected ones."""

from __future__ import annotations

import statistics
import time

import torch

from benchmarks.harness import Table, threads
from benchmarks.setting import by_tensors, linear20, networks, states
from torchrl_pomdp.modules import MultistepLookahead, RolloutPolicy, TruncatedRollout
from torchrl_pomdp.modules.repair import GreedyRepair, UrgencyRepair


def decision(table: Table) -> None:
    """One decision for one start state, on one core."""
    problem = linear20()
    greedy, urgency, network = GreedyRepair(problem.model), UrgencyRepair(problem.model), networks()
    ten = {"trajectories": 10}
    many = {"trajectories": 4096, "allocation": "adaptive"}
    for name, policy, target in (
        ("greedy base, 10 trajectories", RolloutPolicy(problem.model, greedy, **ten), "<= 0.2"),
        ("urgency base, 10 trajectories", RolloutPolicy(problem.model, urgency, **ten), "<= 0.4"),
        ("network base, 10 trajectories", RolloutPolicy(problem.model, network, **ten), "<= 15"),
        ("network base, 5 trajectories", RolloutPolicy(problem.model, network, trajectories=5), "<= 8"),
        ("greedy base, 10 trajectories, tensors", by_tensors(RolloutPolicy(problem.model, greedy, **ten)), ""),
        ("urgency base, 10 trajectories, tensors", by_tensors(RolloutPolicy(problem.model, urgency, **ten)), ""),
        ("network base, 10 trajectories, tensors", by_tensors(RolloutPolicy(problem.model, network, **ten)), ""),
        ("two steps, urgency base", MultistepLookahead(RolloutPolicy(problem.model, urgency, **ten), 2), ""),
        ("three steps, urgency base", MultistepLookahead(RolloutPolicy(problem.model, urgency, **ten), 3), ""),
        ("urgency base, 1 ms", RolloutPolicy(problem.model, urgency, seconds=0.001, **many), ""),
        ("urgency base, 10 ms", RolloutPolicy(problem.model, urgency, seconds=0.01, **many), ""),
    ):
        times = []
        with threads(1):
            # The first ones compile.
            for i in range(-5, 101):
                y = problem.start(torch.tensor([i % 101]))
                begin = time.perf_counter()
                policy(y)
                times.append(time.perf_counter() - begin)
        table.add(f"one decision, {name}, median", 1e3 * statistics.median(times[5:]), "ms", target)


def labels(table: Table) -> None:
    """Labelled training states per second on all cores; hours for 1.2 million states."""
    problem = linear20()
    cases = [
        ("greedy", GreedyRepair(problem.model), "control", 20_400, ">= 15"),
        ("greedy", GreedyRepair(problem.model), "observation", 4_800, ""),
        ("urgency", UrgencyRepair(problem.model), "control", 20_400, ""),
        ("network", networks(), "control", 6_000, ""),
    ]
    for name, base, leaves, count, target in cases:
        y, rates = states(count, seed=1), []
        for make in (lambda policy: policy, by_tensors):
            policy = make(RolloutPolicy(problem.model, base, trajectories=10, leaves=leaves))
            policy.q_factors(y[:600])
            begin = time.perf_counter()
            policy.q_factors(y)
            rates.append(count / (time.perf_counter() - begin))
        what = f"labels, {name} base, 10 trajectories per {leaves}, {count} states"
        table.add(what, rates[0], "states/s")
        table.add(f"{what}, over tensors", rates[0] / rates[1], target=target)
        table.add(f"{what}: 1.2 M states", 1.2e6 / rates[0] / 3600, "hours")


def adaptive(table: Table) -> None:
    """Regret of decisions by 10 uniform or 14 adaptive trajectories against a reference of 2000, on 2000 states."""
    problem = linear20()
    y = states(2000, seed=1)
    reference = RolloutPolicy(problem.model, GreedyRepair(problem.model), trajectories=2000, seed=99).q_factors(y)
    settings = [("uniform", 10), ("adaptive", 14), ("uniform", 5)]
    steps, regrets = {}, {}
    for allocation, trajectories in settings:
        counted, samples = 0, []
        for seed in range(5):
            base = GreedyRepair(problem.model)
            policy = RolloutPolicy(problem.model, base, trajectories=trajectories, allocation=allocation, seed=seed)
            with threads(1):
                u = policy.q_factors(y).argmin(-1, keepdim=True)
            counted += policy.simulated_steps
            samples.append((reference.gather(-1, u).squeeze(-1) - reference.amin(-1)).double())
        name = f"{allocation}, {trajectories} trajectories"
        steps[name], regrets[name] = counted, torch.stack(samples).mean(0)
        error = float(regrets[name].std()) / len(y) ** 0.5
        table.add(f"mean regret of a decision, {name}", float(regrets[name].mean()), "cost")
        table.add("standard error of that", error, "cost")
    first, second = (f"{a}, {n} trajectories" for a, n in settings[:2])
    difference = regrets[second] - regrets[first]
    table.add("regret, adaptive minus uniform", float(difference.mean()), "cost", "within 2 s.e. of 0")
    table.add("standard error of that, paired", float(difference.std()) / len(y) ** 0.5, "cost")
    table.add("belief steps, adaptive over uniform", steps[second] / steps[first], target="<= 0.50")


def expectation(table: Table) -> None:
    """Core time to estimate the greedy policy's cost from one state to 1 %, with expected and with realised stage costs."""
    problem, trajectories, count = linear20(), 200, 200
    model, greedy = problem.model, GreedyRepair(problem.model)
    y = problem.start(torch.arange(count)).select(*model.state_keys)
    rows = y[torch.arange(count).repeat_interleave(trajectories)]
    keys = torch.arange(count * trajectories)
    rollout = by_tensors(TruncatedRollout(model, greedy))
    with threads(1):
        needed = {}
        for name, simulate in (("expected", lambda: rollout(rows, keys)), ("realised", lambda: _realised(model, greedy, rows))):
            begin = time.perf_counter()
            costs = simulate().view(count, trajectories).double()
            each = (time.perf_counter() - begin) / costs.numel()
            needed[name] = float((each * costs.var(1) / (0.01 * costs.mean(1)).square()).mean())
            table.add(f"mean cost, {name} stage costs", float(costs.mean()), "cost")
            table.add(f"core time for a standard error of 1 %, {name} stage costs", 1e3 * needed[name], "ms")
        table.add("realised over expected", needed["realised"] / needed["expected"])


def _realised(model, policy, y):
    """Costs of trajectories whose hidden levels are drawn from the belief and whose stage costs are those levels'."""
    generator = torch.Generator().manual_seed(0)
    y = model.with_features(y, tuple(policy.in_keys))
    size, levels = model.num_locations, model.num_levels
    hidden = torch.multinomial(y["belief"].reshape(-1, levels), 1, generator=generator).view(-1, size)
    total, discount, here = torch.zeros(len(hidden)), 1.0, torch.arange(len(hidden))
    rise = torch.cat([model.chain.diagonal(1), torch.zeros(1)])
    for _ in range(400):
        ended = model.is_terminal(y)
        if bool(ended.all()):
            break
        total += discount * model.costs[hidden].sum(-1).masked_fill(ended, 0.0)
        discount *= model.discount
        u = policy(y)["action"]
        place = y["location"][:, 0]
        after = model.destinations[place, u]
        hidden = hidden + (torch.rand(hidden.shape, generator=generator) < rise[hidden]).long()
        hidden[here[u == 0], place[u == 0]] = 0
        y = model.estimator(y, u, hidden[here, after])
    return total
