"""Online rollout with nothing learnt: what a decision costs in time, and what it gains."""

from __future__ import annotations

import statistics
import time
from functools import partial

import torch

from benchmarks.harness import Table, threads
from torchrl_pomdp.config import EVALUATION_SEED
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import MultistepLookahead, RolloutPolicy
from torchrl_pomdp.modules.repair import GreedyRepair, UrgencyRepair
from torchrl_pomdp.problems import make_problem

STATES, TIMED = 1000, 101


def online(table: Table) -> None:
    """Cost over greedy of rollout of urgency from 1000 start states, and the time of a decision by itself, on one core."""
    for name, steps, trajectories, seconds, target in (
        ("linear20", 1, 4096, 0.001, "<= 0.905"),
        ("linear20", 2, 10, None, "<= 0.902"),
        ("linear20", 3, 5, None, "<= 0.902"),
        ("grid5x4", 1, 4096, 0.001, ""),
        ("grid5x4", 2, 5, None, "<= 0.807"),
        ("grid6x6", 1, 4096, 0.001, ""),
        ("grid6x6", 2, 10, None, "<= 0.853"),
        ("two_robots20", 1, 4096, 0.001, ""),
    ):
        problem = make_problem(name)
        run = partial(discounted_costs, problem.model, start=problem.start, num_states=STATES, seed=EVALUATION_SEED)
        policy = RolloutPolicy(
            problem.model,
            UrgencyRepair(problem.model),
            trajectories=trajectories,
            allocation="uniform" if seconds is None else "adaptive",
            seconds=seconds,
            terminal_cost=problem.pessimistic_cost,
        )
        policy = MultistepLookahead(policy, steps) if steps > 1 else policy
        spent = "1 ms" if seconds else f"{trajectories} trajectories"
        what = f"{name}, {steps} step{'s' * (steps > 1)}, {spent}"
        with threads(1):
            costs = [run(policy=each, terminal_cost=problem.pessimistic_cost) for each in (policy, GreedyRepair(problem.model))]
            ratio = compare(*costs).ratio
            times = [_time(policy, problem.start(torch.tensor([i]))) for i in range(TIMED)]
        table.add(f"{what}: cost over greedy", ratio.mean, target=target)
        table.add(f"{what}: half of its 95 % interval", ratio.mean - ratio.interval[0])
        table.add(f"{what}: a decision, median", 1e3 * statistics.median(times), "ms", "<= 1" if seconds else "<= 10")


def _time(policy, y) -> float:
    begin = time.perf_counter()
    policy(y)
    return time.perf_counter() - begin
