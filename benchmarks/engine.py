"""Belief steps per second: against a scalar loop, against matrix products, over batch sizes and lengths of the line."""

from __future__ import annotations

import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch

from benchmarks.harness import Table, seconds, threads
from benchmarks.setting import Counting, line_problem, linear20, network_flops, networks
from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.modules import TruncatedRollout, ZeroCost
from torchrl_pomdp.modules.repair import GreedyRepair


def greedy(table: Table) -> None:
    """Greedy rollouts on one core, eager and compiled, against the numba loop."""
    from benchmarks.numba_reference import greedy_rollout

    model, start = linear20().model, linear20().start
    keys = torch.arange(65_536)
    y = start(keys)
    rise = np.array([0, 0.02, 0.03, 0.05, 0], np.float32)
    repeats = 5
    # The loop overwrites what it is given.
    belief, place = y["belief"].transpose(1, 2).contiguous().numpy(), y["location"][:, 0].numpy()
    inputs = iter([(belief.copy(), place.copy()) for _ in range(repeats + 2)])

    def loop():
        return greedy_rollout(
            *next(inputs), keys.numpy().astype(np.uint64), rise, model.costs.numpy(), np.float32(0.99), 400, np.float32(1e-6)
        )

    names = ("eager", "compiled")
    rollouts = [TruncatedRollout(model, GreedyRepair(model), compile=name == "compiled") for name in names]
    with threads(1):
        costs, steps = loop()
        errors = [np.abs(rollout(y, keys).numpy() - costs).max() for rollout in rollouts]
        reference, *times = seconds(loop, *(partial(rollout, y, keys) for rollout in rollouts), repeats=repeats)
    table.add("numba loop, one core", steps / reference / 1e6, "M steps/s")
    for name, time_, error, target in zip(names, times, errors, (">= 0.20", ">= 0.40"), strict=True):
        table.add(f"greedy rollout, {name}", steps / time_ / 1e6, "M steps/s")
        table.add(f"greedy rollout, {name}, over the numba loop", reference / time_, target=target)
        table.add(f"greedy rollout, {name}: largest difference of a cost from the loop's", float(error), "cost")


def batch(table: Table) -> None:
    """Greedy steps per second on one core against the number of trajectories that are simulated at once."""
    model, start = linear20().model, linear20().start
    with threads(1):
        for rows in (16, 64, 256, 1024, 4096, 16_384, 65_536):
            keys = torch.arange(max(2 * rows, 2048) if rows >= 256 else 4 * rows)
            y = start(keys)
            policy = Counting(GreedyRepair(model))
            rollout = TruncatedRollout(model, policy, chunk_rows=rows)
            rollout(y, keys)
            steps, policy.rows = policy.rows, 0
            (time_,) = seconds(partial(rollout, y, keys))
            table.add(f"greedy steps with {rows} rows at once", steps / time_ / 1e6, "M steps/s")


def network(table: Table) -> None:
    """Rollouts with the 256-64 networks: their matrix products against one large product on the same threads.

    Products by zeros outside a robot's window are skipped; "dense" counts them, as a network on whole windows would do them.
    """
    model, start = linear20().model, linear20().start
    keys = torch.arange(100_000)
    y, policy, spent, done = start(keys), Counting(networks()), [0.0], [0]

    def timed(product, size):
        def call(*args, **kwargs):
            begin = time.perf_counter()
            result = product(*args, **kwargs)
            spent[0] += time.perf_counter() - begin
            done[0] += size(*args)
            return result

        return call

    linear = timed(torch.nn.Linear.forward, lambda layer, x: 2 * x.numel() * layer.out_features)
    addmm = timed(torch.addmm, lambda bias, x, weight: 2 * x.numel() * weight.shape[1])
    with threads(1), patch.object(torch.nn.Linear, "forward", linear), patch.object(torch, "addmm", addmm):
        matrix = torch.rand(4096, 4096)
        peak = 2 * 4096**3 / seconds(lambda: matrix @ matrix)[0]
        table.add("large matrix product, one core", peak / 1e9, "GFlop/s")
        for compile, targets in ((False, ">= 0.50"), (True, ">= 0.60")):
            rollout = TruncatedRollout(model, policy, compile=compile)
            rollout(y[:20_000], keys[:20_000])
            policy.rows, spent[0], done[0] = 0, 0.0, 0
            begin = time.perf_counter()
            rollout(y, keys)
            total, dense = time.perf_counter() - begin, policy.rows * network_flops()
            name = "network rollout, " + ("compiled" if compile else "eager")
            table.add(name, policy.rows / total / 1e6, "M steps/s")
            table.add(f"{name}: rate of its products while they run, over the large product", done[0] / spent[0] / peak)
            table.add(
                f"{name}: dense products over all of its time, over the large product", dense / total / peak, target=targets
            )
            table.add(f"{name}: share of the dense products that is done", done[0] / dense)


def router(table: Table) -> None:
    """Six networks behind the router against one network on the same rows."""
    problem = linear20()
    for rows in (8192, 16_384):
        y = problem.model.with_features(problem.start(torch.arange(rows // 2)))
        y = torch.cat([y, *(problem.model.with_features(g(torch.arange(rows // 12 + 1))) for g in problem.training)])[:rows]
        one, six = networks().policies[0], networks()
        with threads(1), torch.inference_mode():
            both = seconds(*(lambda policy=policy, y=y: policy(y.copy()) for policy in (six, one)), repeats=31)
        table.add(f"six-part router over one network, {rows} rows", both[0] / both[1], target="<= 1.3")


def locations(table: Table) -> None:
    """Time of a greedy step against the number of locations, on one core."""
    base = 0.0
    with threads(1):
        for size in (20, 50, 100, 200, 500):
            model, start = line_problem(size)
            keys = torch.arange(16_384 * 20 // size)
            y = start(keys)
            # The same number of bytes at once, whatever the size.
            cut = partial(TruncatedRollout, model, max_steps=40, terminal_cost=ZeroCost(), chunk_rows=len(keys))
            rollout = cut(GreedyRepair(model))
            policy = Counting(GreedyRepair(model))
            cut(policy)(y, keys)
            step = seconds(partial(rollout, y, keys))[0] / policy.rows
            table.add(f"greedy step, L = {size}", step * 1e9, "ns")
            base = base or step
            table.add(f"growth over linear from L = 20 to {size}", step / base / (size / 20), target="<= 1.2")


_MEMORY = """
import sys, torch
from pathlib import Path
from benchmarks.setting import line_problem
from torchrl_pomdp.modules import TruncatedRollout, ZeroCost
from torchrl_pomdp.modules.repair import GreedyRepair
torch.set_num_threads(1)
# The peak of this program alone; what `resource` tells includes that of the one which has started it.
peak = lambda: int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
rows, steps = int(sys.argv[1]), int(sys.argv[2])
model, start = line_problem(20, drift=0.01)
keys = torch.arange(rows)
# Few different states, so that making them takes no memory to speak of.
y = start(torch.arange(1024))[keys % 1024]
TruncatedRollout(model, GreedyRepair(model), max_steps=2, terminal_cost=ZeroCost(), chunk_rows=64)(y[:64], keys[:64])
before = peak()
TruncatedRollout(model, GreedyRepair(model), max_steps=steps, terminal_cost=ZeroCost(), chunk_rows=rows)(y, keys)
print((peak() - before) * 1024)
"""


def memory(table: Table) -> None:
    """Peak memory of a rollout for each live row, in processes of their own; it must not grow with the length."""

    def peak(rows: int, steps: int) -> int:
        command = [sys.executable, "-c", _MEMORY, str(rows), str(steps)]
        return int(subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[1]).stdout)

    few, many = 131_072, 262_144
    for steps in (20, 80):
        per_row = (peak(many, steps) - peak(few, steps)) / (many - few)
        table.add(f"memory for each live row, {steps} steps", per_row, "bytes", "<= 4096")


def env_step(table: Table) -> None:
    """``env.step`` on 16 384 rows against the bare model step with the same features."""
    problem = linear20()
    env = BeliefEnv(problem.model, problem.start, batch_size=(16_384,))
    y = env.reset()
    y = env.rand_action(y)
    core = y.select(*env.observation_spec.keys())
    noise = torch.rand(16_384, 1)
    with threads(1):
        # Both leave their result where the last one was.
        bare, step = seconds(
            lambda: y.set("bare", problem.model.advance(core, y["action"], noise)[1]), partial(env.step, y), repeats=61
        )
    table.add("env.step over the bare model step, 16 384 rows", step / bare, target="<= 1.15")
