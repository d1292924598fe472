"""RockSample: belief updates per second and core, and what the base policy earns."""

from __future__ import annotations

from functools import partial

import torch

from benchmarks.harness import Table, seconds, threads
from torchrl_pomdp.evaluation import discounted_costs, estimate
from torchrl_pomdp.modules import TruncatedRollout, ZeroCost
from torchrl_pomdp.noise import uniform
from torchrl_pomdp.problems.rocksample import NearestRock, RandomRocks, rocksample

ROWS, STEPS = 16_384, 20


def rocksample_updates(table: Table) -> None:
    """Belief updates with random legal controls, and rollouts of the base policy, per second on one core."""
    for n, k in ((7, 8), (11, 11), (15, 15)):
        problem = rocksample(n, k)
        model, keys = problem.model, torch.arange(ROWS)
        y = RandomRocks(model)(keys)
        u = torch.multinomial(model.action_mask(y).float(), 1, generator=torch.Generator().manual_seed(0)).squeeze(-1)
        noise = uniform(keys, 0).unsqueeze(-1)
        make = partial(TruncatedRollout, model, NearestRock(model), max_steps=STEPS, terminal_cost=ZeroCost(), chunk_rows=ROWS)
        rollout, fused = make(), make(compile=True)
        with threads(1), torch.inference_mode():
            runs = partial(model.advance, y, u, noise), partial(rollout, y, keys), partial(fused, y, keys)
            update, whole, quick = seconds(*runs, repeats=21)
            before = rollout.simulated_steps
            rollout(y, keys)
        target = ">= 1" if n == 11 else ""
        table.add(f"RockSample({n}, {k}): belief updates, {ROWS} rows", ROWS / update / 1e6, "M updates/s", target)
        table.add(f"RockSample({n}, {k}): compile=True over without", whole / quick)
        table.add(f"RockSample({n}, {k}): steps of base policy", (rollout.simulated_steps - before) / whole / 1e6, "M steps/s")


def rocksample_rewards(table: Table) -> None:
    """Mean discounted reward of the base policy from the usual start, and its standard error; several layouts of (15, 15)."""
    for n, k, seed in ((7, 8, 0), (11, 11, 0), *((15, 15, seed) for seed in range(10))):
        problem = rocksample(n, k, seed=seed)
        policy = problem.base_policies[problem.baseline]
        run = partial(discounted_costs, num_states=10_000, max_steps=100, terminal_cost=ZeroCost())
        reward = estimate(-run(problem.model, policy, problem.start))
        table.add(f"RockSample({n}, {k}), layout {seed}: {problem.baseline}", reward.mean, "reward")
        table.add(f"RockSample({n}, {k}), layout {seed}: standard error", reward.standard_error, "reward")
