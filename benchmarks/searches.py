"""Tree searches: simulated steps per second on one core."""

from __future__ import annotations

import torch

from benchmarks.harness import Table, seconds, threads
from torchrl_pomdp.modules.repair import UrgencyRepair
from torchrl_pomdp.planners import DESPOT, POMCP
from torchrl_pomdp.problems import make_problem


def searches(table: Table) -> None:
    """POMCP and DESPOT on linear20, decisions in start states one after the other, on one core."""
    problem = make_problem("linear20")
    y = problem.start(torch.arange(4))
    for base in (UrgencyRepair(problem.model), None):
        for search in (
            POMCP(problem.model, base, simulations=2000),
            DESPOT(problem.model, base, simulations=20, scenarios=100),
        ):
            with threads(1):
                (time,) = seconds(lambda search=search: search(y.clone()), repeats=7)
                before = search.simulated_steps
                search(y.clone())
            rate = (search.simulated_steps - before) / time / 1e6
            name = f"{type(search).__name__}, {'random play' if base is None else 'urgency'}"
            table.add(f"{name}: simulated steps", rate, "M steps/s", ">= 5")
            table.add(f"{name}: a decision", 1000 * time / len(y), "ms")
