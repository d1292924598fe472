"""Files of a run: whole or absent, loaded without unpickling, never overwritten by another run."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from torchrl_pomdp.envs.presets import Problem, make_problem
from torchrl_pomdp.modules import PartitionedPolicy
from torchrl_pomdp.trainers.config import PolicyIterationConfig
from torchrl_pomdp.trainers.policy_iteration import make_networks

__all__ = ["Checkpoint", "create_run_folder", "load_checkpoint", "save_checkpoint"]

_FORMAT = "torchrl_pomdp policy 1"


@dataclass(frozen=True)
class Checkpoint:
    """A trained policy with all that is needed to use it.

    Attributes:
        problem: the problem it was trained on.
        config: how it was trained.
        iteration: number of the policy iteration that made it, from 1.
        policy: the partitioned policy.
    """

    problem: Problem
    config: PolicyIterationConfig
    iteration: int
    policy: PartitionedPolicy


def create_run_folder(path: Path) -> Path:
    """Make the folder of a new run.

    Raises:
        ValueError: if it exists and is not an empty folder; nothing in it is touched.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     create_run_folder(Path(folder) / "run").name
        'run'
    """
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ValueError(f"run folder {path} is in use: name a folder that is empty or does not exist")
    path.mkdir(parents=True, exist_ok=True)
    return path


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint: one file of tensors and a JSON text.

    Args:
        path: file to make or replace, atomically.
        checkpoint: the policy and its provenance; the problem must be a preset.
    """
    about = {
        "format": _FORMAT,
        "problem": checkpoint.problem.name,
        "config": asdict(checkpoint.config),
        "iteration": checkpoint.iteration,
    }
    content = {"about": json.dumps(about), "policy": checkpoint.policy.state_dict()}
    write_atomically(path, lambda temporary: torch.save(content, temporary))


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
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "policy.pt"
        ...     save_checkpoint(path, Checkpoint(problem, config, 1, make_networks(problem, config, seed=0)))
        ...     load_checkpoint(path).problem.name
        'line3'
    """
    if not path.is_file():
        raise ValueError(f"there is no checkpoint {path}")
    try:
        content = torch.load(path, map_location=device, weights_only=True)
        about = json.loads(content["about"])
        if about["format"] != _FORMAT:
            raise ValueError(f"its format is {about['format']!r}, expected {_FORMAT!r}")
        about["config"]["hidden"] = tuple(about["config"]["hidden"])
        config = PolicyIterationConfig(**about["config"])
        problem = make_problem(about["problem"], device=device)
        policy = make_networks(problem, config, seed=0)
        policy.load_state_dict(content["policy"])
    except Exception as error:  # torch.load raises whatever a foreign file happens to trigger
        raise ValueError(f"{path} is damaged or no checkpoint of this library: {error}") from error
    return Checkpoint(problem, config, about["iteration"], policy.eval())
