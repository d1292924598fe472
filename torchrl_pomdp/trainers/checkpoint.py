"""Files of a run: whole or absent, loaded without unpickling, never overwritten by another run."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from torchrl_pomdp.envs.presets import PRESETS, Problem, make_problem
from torchrl_pomdp.files import claim, load_tensors, save_tensors
from torchrl_pomdp.modules import NeverRepairCost, PartitionedPolicy, PartitionedValue, PolicyNetwork, ValueNetwork
from torchrl_pomdp.trainers.architecture import make_networks, make_values
from torchrl_pomdp.trainers.config import PolicyIterationConfig

__all__ = ["Checkpoint", "load_checkpoint", "open_run_folder", "save_checkpoint"]

_FORMAT = "torchrl_pomdp policy 2"


@dataclass(frozen=True)
class Checkpoint:
    """A trained policy with all that is needed to use it.

    Attributes:
        problem: the problem it was trained on, with its partition.
        config: how it was trained.
        algorithm: name of the algorithm, such as pAPI-NT.
        iteration: number of the policy iteration that made it, from 1.
        policy: the partitioned policy.
        value: the partitioned terminal cost; never repairing in the parts without a value network.
    """

    problem: Problem
    config: PolicyIterationConfig
    algorithm: str
    iteration: int
    policy: PartitionedPolicy
    value: PartitionedValue


def open_run_folder(path: Path, identity: dict[str, Any]) -> Path:
    """Make the folder of a run, or open it again to go on with the same run.

    Args:
        path: the folder.
        identity: all that decides the run's results, as JSON; kept in ``config.json``.

    Raises:
        ValueError: if the folder is in use and not by this very run; nothing in it is touched.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = open_run_folder(Path(folder) / "run", {"seed": 0})
        ...     open_run_folder(path, {"seed": 0}) == path
        True
    """
    record = path / "config.json"
    # What a kill in the middle of writing the record leaves has its name after a dot.
    in_use = path.exists() and (not path.is_dir() or any(not file.name.startswith(".config.") for file in path.iterdir()))
    if in_use and not record.is_file():
        raise ValueError(f"run folder {path} is in use: name a folder that is empty, does not exist, or holds this run")
    claim(record, identity)
    return path


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint: one file of tensors and a JSON text.

    Args:
        path: file to make or replace, atomically.
        checkpoint: the policy and its provenance; the problem must be a preset.

    Raises:
        ValueError: if the problem is no preset, or a part's policy is not a network.
    """
    if checkpoint.problem.name not in PRESETS:
        raise ValueError(f"checkpoint.problem must be one of {', '.join(sorted(PRESETS))}, got {checkpoint.problem.name!r}")
    others = [type(p).__name__ for p in checkpoint.policy.policies if not isinstance(p, PolicyNetwork)]
    if others:
        raise ValueError(f"checkpoint.policy must have a PolicyNetwork in every part, got {others[0]}")
    about = {
        "format": _FORMAT,
        "problem": checkpoint.problem.name,
        "partitioned": checkpoint.problem.partitioned,
        "config": asdict(checkpoint.config),
        "algorithm": checkpoint.algorithm,
        "iteration": checkpoint.iteration,
        "value_parts": [part for part, value in enumerate(checkpoint.value.values) if isinstance(value, ValueNetwork)],
    }
    policy, value = checkpoint.policy.state_dict(), checkpoint.value.state_dict()
    save_tensors(path, {"about": json.dumps(about), "policy": policy, "value": value})


def load_checkpoint(path: Path, *, device: torch.device | str = "cpu") -> Checkpoint:
    """Read a checkpoint back; tensors and JSON only, nothing is unpickled.

    Args:
        path: file written by :func:`save_checkpoint`.
        device: where the policy and its problem are put.

    Raises:
        ValueError: if there is no such file, or it is damaged or of another kind.

    Examples:
        >>> import tempfile
        >>> problem, config = make_problem("line3"), PolicyIterationConfig()
        >>> policy, value = make_networks(problem, config, seed=0), make_values(problem, config, seed=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "policy.pt"
        ...     save_checkpoint(path, Checkpoint(problem, config, "pAPI-NT", 1, policy, value))
        ...     load_checkpoint(path).problem.name
        'line3'
    """
    if not path.is_file():
        raise ValueError(f"there is no checkpoint {path}")
    try:
        content = load_tensors(path, device)
        about = json.loads(content["about"])
        if about["format"] != _FORMAT:
            raise ValueError(f"its format is {about['format']!r}, expected {_FORMAT!r}")
        for name in ("hidden", "value_hidden"):
            about["config"][name] = tuple(about["config"][name])
        config = PolicyIterationConfig(**about["config"])
        problem = make_problem(about["problem"], partitioned=about["partitioned"], device=device)
        policy = make_networks(problem, config, seed=0)
        policy.load_state_dict(content["policy"])
        networks = make_values(problem, config, seed=0).values
        closed_form = NeverRepairCost(problem.model)
        trained = about["value_parts"]
        value = PartitionedValue([v if part in trained else closed_form for part, v in enumerate(networks)])
        value.load_state_dict(content["value"])
    except Exception as error:  # torch.load raises whatever a foreign file happens to trigger
        raise ValueError(f"{path} is damaged or no checkpoint of this library: {error}") from error
    return Checkpoint(problem, config, about["algorithm"], about["iteration"], policy.eval(), value.eval())
