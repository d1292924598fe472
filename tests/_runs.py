"""A small training run, whose folder the tests of reports read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.problems import Problem, make_problem
from torchrl_pomdp.trainers.run import TrainingRun

__all__ = ["small_run"]


def small_run(folder: Path, problem: str | Problem = "line3", **options: Any) -> Path:
    numbers: dict[str, Any] = {
        "samples_per_part": 40,
        "value_samples": 30,
        "trajectories": 1,
        "least_steps": 1,
        "max_steps": 20,
    }
    numbers |= {"validation_states": 50, "visits_per_label": 0.2, "hidden": (8, 4), "value_hidden": (8,)}
    config = PolicyIterationConfig(2, **numbers)
    given = make_problem(problem) if isinstance(problem, str) else problem
    TrainingRun(given, config=config, states=20, online_states=0, **options).carry_out(folder)
    return folder
