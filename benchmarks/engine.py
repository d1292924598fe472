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
from benchmarks.setting import Counting, by_tensors, line_problem, linear20, network_flops, networks
from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.modules import TruncatedRollout, ZeroCost
from torchrl_pomdp.modules.repair import GreedyRepair, UrgencyRepair


def trajectories(table: Table) -> None:
    """Trajectories per second on one core: compiled loop, tensors, and for greedy a loop that carries the whole belief."""
    from benchmarks.numba_reference import greedy_rollout

    model, start = linear20().model, linear20().start
    # No power of two, which planes of beliefs are read slowly by.
    keys = torch.arange(65_000)
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

    for name, base, target in (("greedy", GreedyRepair(model), ">= 30"), ("urgency", UrgencyRepair(model), ">= 20")):
        compiled, tensors = TruncatedRollout(model, base), by_tensors(TruncatedRollout(model, base))
        runs = [partial(compiled, y, keys), partial(tensors, y, keys)]
        with threads(1):
            error = float(((compiled(y, keys) - tensors(y, keys)).abs() / tensors(y, keys)).max())
            steps, compiled.simulated_steps = compiled.simulated_steps, 0
            fast, slow, *reference = seconds(*runs, *([loop] if name == "greedy" else []), repeats=repeats)
        table.add(f"{name}: a trajectory of {steps / len(keys):.0f} steps, compiled loop", fast / len(keys) * 1e6, "us")
        table.add(f"{name}: the same, tensors", slow / len(keys) * 1e6, "us")
        table.add(f"{name}: compiled loop over tensors", slow / fast, target=target)
        table.add(f"{name}: largest relative difference of a cost", error)
        if reference:
            table.add(f"{name}: compiled loop over the loop that carries beliefs", reference[0] / fast, target=">= 3")
            table.add(f"{name}: tensors over that loop", reference[0] / slow, target=">= 0.20")


def looks(table: Table) -> None:
    """Time of a look of a greedy trajectory in the compiled loop, on one core, against the number of locations."""
    base = 0.0
    for size in (20, 50, 100, 200, 500):
        model, start = line_problem(size)
        keys = torch.arange(4000)
        y = start(keys)
        rollout = TruncatedRollout(model, GreedyRepair(model))
        with threads(1):
            rollout(y, keys)
            steps, rollout.simulated_steps = rollout.simulated_steps, 0
            look = seconds(partial(rollout, y, keys), repeats=5)[0] / steps
        table.add(f"a look, L = {size}, {steps / len(keys):.0f} in a trajectory", look * 1e9, "ns")
        base = base or look
        table.add(f"a look, L = {size}, over L = 20", look / base, target="<= 1.5")


def batch(table: Table) -> None:
    """Greedy steps by tensors per second on one core, against the number of trajectories that are simulated at once."""
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
        rollout = TruncatedRollout(model, policy)
        rollout(y[:20_000], keys[:20_000])
        policy.rows, spent[0], done[0] = 0, 0.0, 0
        begin = time.perf_counter()
        rollout(y, keys)
        total, dense = time.perf_counter() - begin, policy.rows * network_flops()
        table.add("network rollout, tensors", policy.rows / total / 1e6, "M steps/s")
        table.add("its rate of products while they run, over the large product", done[0] / spent[0] / peak)
        table.add("its dense products over all of its time, over the large product", dense / total / peak, target=">= 0.50")
        table.add("share of the dense products that is done", done[0] / dense)
    compiled = TruncatedRollout(model, networks())
    with threads(1):
        compiled(y[:100], keys[:100])
        compiled.simulated_steps = 0
        begin = time.perf_counter()
        compiled(y, keys)
        rate = compiled.simulated_steps / (time.perf_counter() - begin)
    table.add("network rollout, compiled loop", rate / 1e6, "M steps/s")
    table.add("network rollout, compiled loop over tensors", rate / (policy.rows / total))


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
    """Time of a greedy step by tensors against the number of locations, on one core."""
    base = 0.0
    with threads(1):
        for size in (20, 50, 100, 200, 500):
            model, start = line_problem(size)
            keys = torch.arange(16_384 * 20 // size)
            y = start(keys)
            # The same number of bytes at once, whatever the size.
            cut = partial(TruncatedRollout, model, max_steps=40, terminal_cost=ZeroCost(), chunk_rows=len(keys))
            rollout = by_tensors(cut(GreedyRepair(model)))
            rollout(y, keys)
            steps, rollout.simulated_steps = rollout.simulated_steps, 0
            step = seconds(partial(rollout, y, keys))[0] / steps
            table.add(f"greedy step, L = {size}", step * 1e9, "ns")
            base = base or step
            table.add(f"growth over linear from L = 20 to {size}", step / base / (size / 20), target="<= 1.2")


_MEMORY = """
import sys, torch
from pathlib import Path
from benchmarks.setting import by_tensors, line_problem
from torchrl_pomdp.modules import TruncatedRollout, ZeroCost
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.problems import make_problem
torch.set_num_threads(1)
# The peak of this program alone; what `resource` tells includes that of the one which has started it.
peak = lambda: int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
rows, steps = int(sys.argv[1]), int(sys.argv[2])
if sys.argv[3] == "line":
    model, start = line_problem(20, drift=0.01)
else:
    problem = make_problem(sys.argv[3])
    model, start = problem.model, problem.start
keys = torch.arange(rows)
# Few different states, so that making them takes no memory to speak of.
y = start(torch.arange(1024))[keys % 1024]
options = {"terminal_cost": ZeroCost(), "chunk_rows": rows}
by_tensors(TruncatedRollout(model, GreedyRepair(model), max_steps=2, **options))(y[:64], keys[:64])
before = peak()
by_tensors(TruncatedRollout(model, GreedyRepair(model), max_steps=steps, **options))(y, keys)
print((peak() - before) * 1024)
"""


def memory(table: Table) -> None:
    """Peak memory of a rollout for each live row, in processes of their own; it must not grow with the length."""
    for steps in (20, 80):
        table.add(f"memory for each live row, {steps} steps", row_memory("line", 131_072, steps), "bytes", "<= 4096")


def row_memory(problem: str, rows: int, steps: int) -> float:
    """Bytes of peak memory for each live row of a rollout by tensors: what twice as many rows take more."""

    def peak(rows: int) -> int:
        command = [sys.executable, "-c", _MEMORY, str(rows), str(steps), problem]
        return int(subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[1]).stdout)

    return (peak(2 * rows) - peak(rows)) / rows


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
