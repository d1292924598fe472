"""Many robots: what a decision of ten costs beside one of one, and how much memory a simulated row takes."""

from __future__ import annotations

import torch

from benchmarks.engine import row_memory
from benchmarks.harness import Table, seconds, threads
from torchrl_pomdp.envs.repair import RepairModel
from torchrl_pomdp.modules import MultiagentRollout
from torchrl_pomdp.modules.repair import GreedyRepair, SteadyStateCost
from torchrl_pomdp.problems import make_problem


def robots(table: Table) -> None:
    """One decision of one-at-a-time rollout on the network of 32, 10 trajectories of 10 stages for each control, one core."""
    ten = make_problem("network32x10").model
    one = RepairModel(ten.graph, ten.chain, ten.costs, ten.discount)
    starts = make_problem("network32x10").start(torch.arange(20))
    decisions = []
    for model in (one, ten):
        policy = MultiagentRollout(
            model, GreedyRepair(model), trajectories=10, max_steps=10, terminal_cost=SteadyStateCost(model)
        )
        y = starts.clone().set("location", starts["location"][:, : model.num_robots])
        decisions.append(lambda policy=policy, y=y: [policy(y[i : i + 1].clone()) for i in range(20)])
    with threads(1):
        times = seconds(*decisions, repeats=9)
    for count, time in zip((1, 10), times, strict=True):
        table.add(f"one decision, {count} robot{'s' if count > 1 else ''}, median of 20 states", 1e3 * time / 20, "ms")
    table.add("one decision, 10 robots over 1 robot", times[1] / times[0], "ratio", "<= 12")
    table.add("memory for each live row, 10 robots on 32 locations", row_memory("network32x10", 65_536, 10), "bytes", "<= 6144")
