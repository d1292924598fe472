"""Files of a run: a policy with all that is needed to use it, loaded without unpickling; the folder that belongs to one run."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_pomdp.checks import check_choice, check_instance, check_integer, check_label, check_path, check_text
from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.files import DamagedFileError, check_claim, claim, load_tensors, parse_tensors, tensor_bytes, write_bytes
from torchrl_pomdp.identity import digest
from torchrl_pomdp.modules import AgentNetwork, PartitionedPolicy, PartitionedValue, PolicyNetwork, ValueNetwork
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.problems.specs import problem_from_spec
from torchrl_pomdp.tensor_checks import check_device
from torchrl_pomdp.trainers.architecture import (
    is_multiagent,
    make_agent_encoder,
    make_encoder,
    make_networks,
    make_values,
)

__all__ = ["Checkpoint", "load_checkpoint", "open_run_folder", "problem_digest", "save_checkpoint"]

# Whose folder it is, and every number of the run.
_RECORD = "config.json"
_FORMAT = "torchrl_pomdp policy 4"
# What a checkpoint's JSON text holds.
_ABOUT = {
    "format", "problem", "spec", "problem_digest", "config", "algorithm", "iteration", "base", "value_parts",
}  # fmt: skip


@dataclass(frozen=True)
class Checkpoint:
    """A policy with all that is needed to use it.

    Attributes:
        problem: the problem it was trained on, with its partition.
        config: how it was trained.
        algorithm: name of the algorithm, such as pAPI-NT.
        iteration: number of the policy iteration that made it, from 1; 0 for a base policy, the best one where no iteration
            was accepted.
        policy: the partitioned policy, or the base policy.
        value: the partitioned terminal cost; the problem's pessimistic cost in the parts without a value network.

    Raises:
        TypeError: if something is of the wrong kind.
        ValueError: if no file can be called by ``algorithm``, ``iteration`` is negative, or a base policy has the name.
    """

    problem: Problem
    config: PolicyIterationConfig
    algorithm: str
    iteration: int
    policy: TensorDictModuleBase
    value: PartitionedValue

    def __post_init__(self) -> None:
        check_instance("checkpoint.problem", self.problem, Problem)
        check_instance("checkpoint.config", self.config, PolicyIterationConfig)
        check_label("checkpoint.algorithm", self.algorithm)
        check_integer("checkpoint.iteration", self.iteration, 0)
        check_instance("checkpoint.policy", self.policy, TensorDictModuleBase)
        check_instance("checkpoint.value", self.value, PartitionedValue)
        own = f"{self.algorithm} {self.iteration}"
        if self.iteration and own in self.problem.base_policies:
            raise ValueError(f"checkpoint.problem must have no base policy named like the checkpoint, got {own!r}")

    @property
    def name(self) -> str:
        """What tables call the policy: algorithm and iteration, or the name of the base policy."""
        return _base_name(self.policy, self.problem) or f"{self.algorithm} {self.iteration}"


def open_run_folder(path: str | PathLike[str], identity: dict[str, Any]) -> Path:
    """Make the folder of a run, or open it again to go on with the same run.

    Args:
        path: the folder.
        identity: all that decides the run's results, as JSON; kept in ``config.json``.

    Raises:
        TypeError: if ``path`` is no path.
        ValueError: if the folder is in use and not by this very run; nothing in it is touched.
        OSError: if it cannot be written.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = open_run_folder(Path(folder) / "run", {"seed": 0})
        ...     open_run_folder(path, {"seed": 0}) == path
        True
    """
    path = check_run_folder(path, identity)
    claim(path / _RECORD, identity)
    return path


def check_run_folder(path: str | PathLike[str], identity: dict[str, Any]) -> Path:
    """Raise as :func:`open_run_folder` would, but for a folder that cannot be written, and write nothing.

    Args:
        path: the folder.
        identity: all that decides the run's results, as JSON.

    Returns:
        the folder.
    """
    path = check_path("path", path)
    record = path / _RECORD
    # What a kill in the middle of writing the record leaves has its name after a dot.
    in_use = path.exists() and (not path.is_dir() or any(not file.name.startswith(".config.") for file in path.iterdir()))
    if in_use and not record.is_file():
        raise ValueError(f"run folder {path} holds other files: name a folder that is empty, does not exist, or holds this run")
    check_claim(record, identity)
    return path


def problem_digest(problem: Problem) -> str:
    """What a problem is, whatever it is called: all that decides what is learnt on it.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem_digest(make_problem("line3")) == problem_digest(make_problem("line3", partitioned=False))
        False
    """
    encoders = problem.encoder, problem.agent_encoder
    return digest((problem.model, problem.start, problem.training, problem.pessimistic_cost, problem.symmetries, *encoders))


def save_checkpoint(path: str | PathLike[str], checkpoint: Checkpoint) -> None:
    """Write a checkpoint: one file of tensors and a JSON text; equal checkpoints give equal bytes.

    Args:
        path: file to make or replace, atomically.
        checkpoint: the policy and its provenance. The policy must be a network in every part, as the configuration
            describes it, or one of the problem's base policies. A problem that has a spec must be what its spec describes;
            one without is kept by its digest alone, and is given back to :func:`load_checkpoint`.

    Raises:
        TypeError: if ``path`` is no path or ``checkpoint`` no checkpoint.
        ValueError: if what is given could not be loaded again; nothing is written.
        OSError: if the file cannot be written.
    """
    write_bytes(check_path("path", path), checkpoint_bytes(checkpoint))


def checkpoint_bytes(checkpoint: Checkpoint) -> bytes:
    """What :func:`save_checkpoint` writes; it can be loaded again."""
    check_instance("checkpoint", checkpoint, Checkpoint)
    described = _described(checkpoint.problem)
    base = _base_name(checkpoint.policy, checkpoint.problem)
    if base is not None and base != _base_name(checkpoint.policy, described):
        raise ValueError(
            f"checkpoint.problem must have the base policies that its spec describes, got another one, {base!r}: "
            "with spec=None it is kept by its content alone"
        )
    saved = tensor_bytes(_content(checkpoint))
    try:
        loaded = _parse(parse_tensors(saved, "checkpoint"), described, checkpoint.problem.model.device)
    except ValueError as error:
        raise ValueError(f"checkpoint could not be loaded again: {error}") from error
    for name in ("policy", "value"):
        given = getattr(checkpoint, name)
        if digest(_locals(getattr(loaded, name))) != digest(_locals(given)):
            raise ValueError(
                f"checkpoint.{name} must be what checkpoint.problem and checkpoint.config describe, "
                f"got another {type(given).__name__}: it could not be loaded"
            )
    return saved


def load_checkpoint(
    path: str | PathLike[str], *, problem: Problem | None = None, device: torch.device | str = "cpu"
) -> Checkpoint:
    """Read a checkpoint back; tensors and JSON only, nothing is unpickled and no code is imported.

    Args:
        path: file written by :func:`save_checkpoint`.

    Keyword Args:
        problem: the problem that the policy was trained on, which a problem without a spec needs; None: as the file says.
        device: where the policy and its problem are put, if the problem is not given.

    Raises:
        TypeError: if ``path`` is no path or ``problem`` no problem.
        DamagedFileError: a ``ValueError``, if the file is not as it was written, of another kind, or of a problem that has
            changed since.
        ValueError: if there is no such file or no such device, if the problem is needed and not given, or if it is another.

    Examples:
        >>> import tempfile
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem, config = make_problem("line3"), PolicyIterationConfig()
        >>> policy, value = make_networks(problem, config, seed=0), make_values(problem, config, seed=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "policy.pt"
        ...     save_checkpoint(path, Checkpoint(problem, config, "pAPI-NT", 1, policy, value))
        ...     load_checkpoint(path).problem.name
        'line3'
    """
    path, device = check_path("path", path), check_device("device", device)
    if problem is not None:
        check_instance("problem", problem, Problem)
    if not path.is_file():
        raise ValueError(f"there is no checkpoint {path}")
    try:
        return _parse(load_tensors(path), problem, device)
    except _OtherProblemError as error:
        raise ValueError(f"{path}: {error}") from error
    except DamagedFileError as error:
        raise DamagedFileError(f"{path} is damaged or no checkpoint of this library") from error
    except Exception as error:  # what a foreign file holds can be anything
        raise DamagedFileError(f"{path} is damaged or no checkpoint of this library: {error}") from error


def _described(problem: Problem) -> Problem:
    """What the problem's spec describes, which must be equal to it; the problem itself where it has none."""
    if problem.spec is None:
        return problem
    described = problem_from_spec(problem.spec, device=problem.model.device)
    if (described.name, problem_digest(described)) != (problem.name, problem_digest(problem)):
        raise ValueError(
            f"checkpoint.problem must be what its spec describes, got another problem {problem.name!r}: "
            "with spec=None it is kept by its content alone"
        )
    return described


class _OtherProblemError(ValueError):
    """The file is as it was written, but the problem that it needs is not given, or another one is."""


def _check_networks(policy: TensorDictModuleBase, problem: Problem) -> None:
    if not isinstance(policy, PartitionedPolicy):
        names = ", ".join(problem.base_policies)
        raise ValueError(
            f"checkpoint.policy must be a PartitionedPolicy of networks, or one of {names} as it is by name, "
            f"got another {type(policy).__name__}"
        )
    kinds = (PolicyNetwork, AgentNetwork)
    others = [type(local).__name__ for local in policy.policies if not isinstance(local, kinds)]
    if others:
        raise ValueError(f"checkpoint.policy must have a PolicyNetwork or an AgentNetwork in every part, got {others[0]}")


def _content(checkpoint: Checkpoint) -> dict[str, Any]:
    """A checkpoint as plain dictionaries of tensors and texts, with their digest."""
    base = _base_name(checkpoint.policy, checkpoint.problem)
    if base is None:
        _check_networks(checkpoint.policy, checkpoint.problem)
    parts = [part for part, value in enumerate(checkpoint.value.values) if isinstance(value, ValueNetwork)]
    about = {
        "format": _FORMAT,
        "problem": checkpoint.problem.name,
        "spec": checkpoint.problem.spec,
        "problem_digest": problem_digest(checkpoint.problem),
        "config": asdict(checkpoint.config),
        "algorithm": checkpoint.algorithm,
        "iteration": checkpoint.iteration,
        "base": base and {"name": base, "digest": digest(checkpoint.policy)},
        "value_parts": parts,
    }
    content = {
        "about": json.dumps(about),
        "policy": _tensors(checkpoint.policy) if base is None else {},
        "value": _tensors(checkpoint.value),
    }
    return {**content, "digest": digest(content)}


def _base_name(policy: TensorDictModuleBase, problem: Problem) -> str | None:
    """Name of a base policy; None for any other policy."""
    own = digest(policy)
    return next((name for name, policy in problem.base_policies.items() if digest(policy) == own), None)


def _locals(module: TensorDictModuleBase) -> list[Any]:
    """What a policy or value is made of; whether parts share an encoder or a scale changes nothing but speed."""
    if isinstance(module, PartitionedPolicy):
        return list(module.policies)
    return list(module.values) if isinstance(module, PartitionedValue) else [module]


def _tensors(module: nn.Module) -> dict[str, Tensor]:
    """Parameters as they are kept: none is a view of another, on no device in particular."""
    state = module.state_dict()
    return {name: state[name].detach().cpu().clone(memory_format=torch.contiguous_format) for name in sorted(state)}


def _parse(content: Any, problem: Problem | None, device: torch.device) -> Checkpoint:
    """The checkpoint that a file's content stands for; a ``ValueError`` or ``TypeError`` where it stands for none."""
    if not isinstance(content, dict) or not isinstance(content.get("about"), str):
        raise ValueError("it holds no description")
    about = json.loads(content["about"])
    if not isinstance(about, dict) or about.get("format") != _FORMAT:
        raise ValueError(f"its format is {about.get('format') if isinstance(about, dict) else None!r}, expected {_FORMAT!r}")
    if set(about) != _ABOUT or set(content) != {"about", "policy", "value", "digest"}:
        raise ValueError("its entries are not those of a checkpoint")
    # A tensor of many numbers can be a view of few: what is read must be as large as it says.
    for tensors in (content["policy"], content["value"]):
        if not isinstance(tensors, dict) or not all(isinstance(t, Tensor) and t.is_contiguous() for t in tensors.values()):
            raise ValueError("its weights are no plain tensors")
    if content["digest"] != digest({name: content[name] for name in ("about", "policy", "value")}):
        raise ValueError("its content does not agree with its digest")
    config = PolicyIterationConfig(**check_instance("config", about["config"], dict))
    problem = _problem(about, problem, device)
    policy = _parse_base(about["base"], problem, content) or _parse_policy(problem, config, content["policy"])
    value = _parse_value(problem, config, content["value"], about["value_parts"])
    return Checkpoint(problem, config, about["algorithm"], about["iteration"], policy.eval(), value.eval())


def _problem(about: dict[str, Any], given: Problem | None, device: torch.device) -> Problem:
    """The problem that was trained on: the given one, as it is or with a single part, or what the spec describes."""
    name, spec, own = check_text("problem", about["problem"]), about["spec"], about["problem_digest"]
    if given is not None:
        found = next((one for one in (given, given.unpartitioned()) if problem_digest(one) == own), None)
        if found is None:
            raise _OtherProblemError(f"problem must be {name}, as it was when the checkpoint was made, got another one")
        return found
    if spec is None:
        raise _OtherProblemError(
            f"the policy was trained on {name}, a problem that the file cannot describe: build it and give it as problem=, "
            "or name it by --problem on the command line"
        )
    problem = problem_from_spec(spec, device=device)
    if (problem.name, problem_digest(problem)) != (name, own):
        raise ValueError(f"problem {name} is not what it was when the checkpoint was made")
    return problem


def _parse_base(base: Any, problem: Problem, content: dict[str, Any]) -> TensorDictModuleBase | None:
    if base is None:
        return None
    check_instance("base", base, dict)
    name = check_choice("base", base.get("name"), problem.base_policies)
    policy = problem.base_policies[name]
    if base.get("digest") != digest(policy) or content["policy"] != {}:
        raise ValueError(f"base policy {name} is not what it was when the checkpoint was made")
    return policy


def _parse_policy(problem: Problem, config: PolicyIterationConfig, tensors: Any) -> PartitionedPolicy:
    model, parts = problem.model, range(problem.partition.num_parts)
    if is_multiagent(problem, config):
        encoder = make_agent_encoder(problem, config)
        sizes = [encoder.num_features, *config.hidden, model.num_agent_controls]
        more = {"own": (encoder.num_own, config.hidden[0]), "marks": (encoder.num_marks, config.hidden[0])}
    else:
        sizes, more = [make_encoder(problem, config).num_features, *config.hidden, model.num_controls], {}
    _check_tensors("policies", tensors, parts, sizes, model.dtype, more)
    policy = make_networks(problem, config, seed=0)
    policy.load_state_dict(tensors)
    return policy


def _parse_value(problem: Problem, config: PolicyIterationConfig, tensors: Any, trained: Any) -> PartitionedValue:
    parts = problem.partition.num_parts
    check_instance("value_parts", trained, list)
    if any(check_integer("value_parts", part, 0, parts - 1) != part for part in trained) or len(set(trained)) < len(trained):
        raise ValueError(f"value_parts must hold different parts, got {trained}")
    sizes = [make_encoder(problem, config).num_features, *config.value_hidden, 1]
    _check_tensors("values", tensors, trained, sizes, problem.model.dtype)
    networks = make_values(problem, config, seed=0).values if trained else ()
    value = PartitionedValue([networks[part] if part in trained else problem.pessimistic_cost for part in range(parts)])
    value.load_state_dict(tensors)
    return value


def _check_tensors(
    name: str,
    tensors: dict[str, Tensor],
    parts: Sequence[int],
    sizes: Sequence[int],
    dtype: torch.dtype,
    more: Mapping[str, tuple[int, ...]] | None = None,
) -> None:
    """Raise unless the tensors are the finite weights of networks of these sizes, before any network is made.

    ``more``: shapes of further weights of each network.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    for part in parts:
        shapes |= {f"{name}.{part}.{key}": shape for key, shape in (more or {}).items()}
        for layer, (fan_in, fan_out) in enumerate(pairwise(sizes)):
            shapes[f"{name}.{part}.network.{2 * layer}.weight"] = (fan_out, fan_in)
            shapes[f"{name}.{part}.network.{2 * layer}.bias"] = (fan_out,)
    if set(tensors) != set(shapes):
        raise ValueError(f"its {name} are not networks of sizes {sizes} in parts {list(parts)}")
    for key, shape in shapes.items():
        tensor = tensors[key]
        if tensor.shape != shape or tensor.dtype != dtype:
            raise ValueError(f"{key} must have shape {shape} and type {dtype}, got {tuple(tensor.shape)} and {tensor.dtype}")
        if not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{key} holds numbers that are not finite")
