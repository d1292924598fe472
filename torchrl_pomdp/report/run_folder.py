"""What a training run has left in its folder, as far as it is there."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_pomdp.evaluation import Comparison, Estimate
from torchrl_pomdp.files import DamagedFileError, read_json, read_text
from torchrl_pomdp.report.effort import check_iterations
from torchrl_pomdp.report.tables import Result

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModuleBase

    from torchrl_pomdp.problems.problem import Problem
    from torchrl_pomdp.trainers.checkpoint import Checkpoint

__all__ = ["RunFolder", "read_iterations", "read_run_folder"]


@dataclass(frozen=True)
class RunFolder:
    """What a training run has left.

    Attributes:
        config: what decides the run's results.
        results: the policies that are evaluated so far, the baseline first.
        iterations: the iterations that are finished so far, as ``iterations.json`` has them.
        policy: the best policy or, where that is still the base policy, the last one that was trained; None where there is
            none that can be read.
        missing: why there is no policy.
    """

    config: Mapping[str, Any]
    results: list[Result]
    iterations: list[Mapping[str, Any]]
    policy: Checkpoint | None
    missing: str

    @property
    def policies(self) -> dict[str, TensorDictModuleBase]:
        """The base policy and the trained one by name; one alone where nothing is trained yet, none where none can be read."""
        if self.policy is None:
            return {}
        base = str(self.config["base"])
        return {base: self.policy.problem.base_policies[base], self.policy.name: self.policy.policy}


def read_run_folder(folder: Path, problem: Problem | None) -> RunFolder:
    """Read a folder of a run, which may still go on.

    Raises:
        DamagedFileError: if a record is damaged.
        ValueError: if it is no folder of a run, or ``problem`` is not the run's, or is needed to read its policy.
    """
    if not (folder / "config.json").is_file():
        raise ValueError(f"folder must be that of a training run, {folder} holds no config.json")
    config = read_json(folder / "config.json")
    lacking = {"problem", "algorithm", "base", "config"} - set(config)
    if lacking or not isinstance(config["config"], dict):
        raise DamagedFileError(f"{folder / 'config.json'} is damaged, it is not what a training run writes: restore it")
    policy, missing = _policy(folder, problem)
    if policy is not None and config["base"] not in policy.problem.base_policies:
        raise DamagedFileError(
            f"{folder / 'config.json'} is damaged, its problem has no base policy {config['base']!r}: restore it"
        )
    return RunFolder(config, _results(folder / "metrics.json"), read_iterations(folder / "iterations.json"), policy, missing)


def _results(path: Path) -> list[Result]:
    if not path.is_file():
        return []
    try:
        return [Result(name, Comparison(**_estimates(entry))) for name, entry in read_json(path).items()]
    except (TypeError, AttributeError) as error:
        raise DamagedFileError(f"{path} is damaged, it holds no comparisons of policies ({error}): restore it") from error


def _estimates(entry: Any) -> dict[str, Any]:
    """The estimates of a comparison; JSON has null for numbers that are not finite."""
    found: dict[str, Any] = {}
    for name, numbers in entry.items():
        if numbers is None and name == "ratio":
            found[name] = None
            continue
        values: dict[str, Any] = {key: math.nan if value is None else value for key, value in numbers.items()}
        if not all(isinstance(value, (int, float)) for value in values.values()):
            raise TypeError(f"{name} holds what is no number")
        found[name] = Estimate(**values)
    return found


def read_iterations(path: Path) -> list[Mapping[str, Any]]:
    """The iterations of a run as its file ``iterations.json`` tells them; none where there is no file.

    Raises:
        DamagedFileError: if the file holds anything else.
    """
    if not path.is_file():
        return []
    try:
        iterations = json.loads(read_text(path))
        check_iterations("iterations", iterations)
        for iteration in iterations:
            if not isinstance(iteration["number"], int) or not isinstance(iteration["reason"], str):
                raise TypeError("an iteration has no number or no reason")
            if not all(isinstance(record["losses"], dict) for record in iteration["parts"].values()):
                raise TypeError("a part has no losses")
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise DamagedFileError(f"{path} is damaged, it holds no iterations ({error}): restore it") from error
    return iterations


def _policy(folder: Path, problem: Problem | None) -> tuple[Checkpoint | None, str]:
    """The policy to show, and why there is none."""
    # Not at the top: the trainers know the reports of peers.
    from torchrl_pomdp.trainers.checkpoint import load_checkpoint

    numbered = {path: re.fullmatch(r"iteration-(\d+)\.pt", path.name) for path in folder.glob("iteration-*.pt")}
    last = sorted((int(match[1]), path) for path, match in numbered.items() if match)
    path = folder / "best.pt"
    if not path.is_file():
        return None, "The run has not kept a policy yet."
    try:
        best = load_checkpoint(path, problem=problem)
        return (load_checkpoint(last[-1][1], problem=problem) if best.iteration == 0 and last else best), ""
    except DamagedFileError as error:
        return None, f"No policy can be read: {error}."
