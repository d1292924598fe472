"""Calls that work, of small things: what the test of refusals changes one argument of."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import torch
from _hostile import (
    Hostile,
    flags,
    generators,
    integers,
    keys,
    no_states,
    not_callable,
    objects,
    paths,
    policies,
    terminal_costs,
    texts,
    values,
)
from tensordict import TensorDictBase

from torchrl_pomdp import collectors, envs, evaluation, files, modules, problems, reproduce, trainers
from torchrl_pomdp.envs import repair
from torchrl_pomdp.envs.repair import RepairModel
from torchrl_pomdp.modules import FlatEncoder, OnEntering, RolloutPolicy, ZeroCost
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost
from torchrl_pomdp.trainers import checkpoint, run
from torchrl_pomdp.workers import LOCAL, Workers

Argument = tuple[Any, list[Hostile]]
"""A valid value, and values that are refused."""


class Case(NamedTuple):
    """A call that works.

    Attributes:
        call: the public callable.
        use: what is done with its result, to see whether it can be used.
        arguments: valid value and hostile values of each argument.
    """

    call: Callable[..., Any]
    use: Callable[[Any], Any]
    arguments: dict[str, Argument]

    def hostile(self) -> Iterator[tuple[str, Hostile]]:
        """Arguments and what they must not be; None is skipped where the signature allows it."""
        known = _parameters(self.call)
        for name, (_, wrong) in self.arguments.items():
            allowed = name in known and (known[name].default is None or "None" in str(known[name].annotation))
            yield from ((name, value) for value in wrong if not (allowed and value.value is None))

    def given(self, **changed: Any) -> dict[str, Any]:
        """The valid arguments but for those that are changed; no call sees what another one has written."""
        arguments = {name: valid for name, (valid, _) in self.arguments.items()} | changed
        return {name: value.copy() if isinstance(value, TensorDictBase) else value for name, value in arguments.items()}


def _parameters(call: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Parameters of a callable; of a class with those of its bases, which it may pass on."""
    makers = (
        [call] if not isinstance(call, type) else [vars(c)["__init__"] for c in call.__mro__[::-1] if "__init__" in vars(c)]
    )
    return {name: p for make in makers for name, p in inspect.signature(make).parameters.items()}


def case(call: Callable[..., Any], use: Callable[[Any], Any] = lambda made: None, /, **arguments: Argument) -> Case:
    return Case(call, use, arguments)


# ---- small things that work -----------------------------------------------------------------------------------------

KEYS = torch.arange(2)
CHAIN, COSTS = torch.tensor([[1.0, 0.0], [0.2, 0.8]]), torch.tensor([0.0, 1.0])
ITERATIONS = [
    {
        "parts": {
            "iteration-1/1-improve-part-0": {"samples": 1, "simulated_steps": 1, "label_seconds": 1.0, "train_seconds": 1.0}
        }
    }
]


@functools.cache
def problem(*, partitioned: bool = True) -> problems.Problem:
    return problems.make_problem("line3", partitioned=partitioned)


@functools.cache
def two_robots() -> RepairModel:
    return RepairModel(repair.line(3), CHAIN, COSTS, 0.9, num_robots=2)


def model() -> RepairModel:
    return problem().model


def start() -> Callable[[torch.Tensor], TensorDictBase]:
    return problem().start


def state() -> TensorDictBase:
    return model().with_features(start()(KEYS))


def greedy() -> GreedyRepair:
    return GreedyRepair(model())


def rollout(of: RepairModel | None = None) -> RolloutPolicy:
    of = of or model()
    return RolloutPolicy(of, GreedyRepair(of), trajectories=1, max_steps=3, terminal_cost=ZeroCost())


def truncated() -> modules.TruncatedRollout:
    return modules.TruncatedRollout(model(), greedy(), max_steps=3, terminal_cost=ZeroCost())


def policy_cost() -> modules.PolicyCost:
    return modules.PolicyCost(model(), greedy(), max_steps=3, terminal_cost=ZeroCost())


def labelled() -> TensorDictBase:
    return policy_cost()(rollout()(state()))


def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def network() -> modules.PolicyNetwork:
    return modules.PolicyNetwork(FlatEncoder(model()), 3, (4,), generator=rng())


def value_network() -> modules.ValueNetwork:
    return modules.ValueNetwork(FlatEncoder(model()), NeverRepairCost(model()), (4,), generator=rng())


@functools.cache
def config() -> trainers.PolicyIterationConfig:
    sizes = {"hidden": (4,), "value_hidden": (4,), "value_samples": 8, "least_steps": 1, "epochs": 1, "validation_states": 8}
    return trainers.PolicyIterationConfig(iterations=1, samples_per_part=8, trajectories=1, **sizes)


def env() -> envs.BeliefEnv:
    return envs.BeliefEnv(model(), start(), batch_size=(2,))


def visited() -> collectors.StateMemory:
    memory = collectors.StateMemory(model(), retain=1.0)
    memory.visit(greedy(), start(), KEYS, max_steps=3)
    return memory


@functools.cache
def saved() -> checkpoint.Checkpoint:
    policy, value = trainers.make_networks(problem(), config(), seed=0), trainers.make_values(problem(), config(), seed=0)
    return checkpoint.Checkpoint(problem(), config(), "pAPI-NT", 1, policy, value)


def written(path: Path) -> Path:
    """A file that can be read."""
    if path.suffix == ".json":
        files.write_json(path, {})
    else:
        checkpoint.save_checkpoint(path, saved())
    return path


def comparison() -> evaluation.Comparison:
    return evaluation.compare(torch.tensor([1.0, 2.0]), torch.tensor([2.0, 3.0]))


@functools.wraps(reproduce.reproduce)
def quick_reproduce(*args: Any, **kwargs: Any) -> str:
    """The experiment with runs that are not carried out, without pictures."""

    def carry_out(self: Any, folder: Path, **_: Any) -> dict[str, evaluation.Comparison]:
        files.write_json(folder / "iterations.json", ITERATIONS)
        return {"greedy": comparison(), "pAPI-NT 1": comparison()}

    def costs(self: Any, folder: Path, policies: Any) -> dict[str, torch.Tensor]:
        return {"greedy": torch.ones(2), "pAPI-NT 1": torch.ones(2)}

    runs = mock.patch.multiple(run.TrainingRun, carry_out=carry_out, costs=costs)
    with runs, mock.patch.object(reproduce, "draw", return_value=""):
        return reproduce.reproduce(*args, **kwargs)


# ---- arguments that many callables have -----------------------------------------------------------------------------


def repair_model() -> Argument:
    return model(), objects(problems.tiger().model, RepairModel)


def belief_model() -> Argument:
    return model(), objects(RepairModel, problem())


def a_problem(*, partitioned: bool = True) -> Argument:
    return problem(partitioned=partitioned), objects(model(), problems.Problem)


def a_policy() -> Argument:
    return greedy(), policies()


def a_module() -> Argument:
    return greedy(), objects(GreedyRepair)


def a_start() -> Argument:
    return start(), generators(start())


def at_once(argument: Argument) -> Argument:
    """An argument that the call itself uses."""
    return argument[0], [w._replace(refused="at once") if w.refused == "in use" else w for w in argument[1]]


def a_config() -> Argument:
    return config(), objects(trainers.PolicyIterationConfig)


def callback() -> Argument:
    return (lambda *_: None), not_callable()


def some_workers() -> Argument:
    return LOCAL, objects(Workers)


def simulation() -> dict[str, Argument]:
    """What all simulations take."""
    no_part = Hostile("in part 99", OnEntering((99,)), names=("parts",))
    return {
        "max_steps": (3, integers(1)),
        "truncation": (modules.AfterSteps(1), [*objects(modules.AfterSteps), no_part]),
        "terminal_cost": (ZeroCost(), terminal_costs()),
        "chunk_rows": (64, integers(1)),
    }


def collector() -> dict[str, Argument]:
    """What all collectors take."""
    return {
        "create_env_fn": (env(), objects(envs.BeliefEnv)),
        "policy": a_policy(),
        "states": a_start(),
        "label": (lambda model, policy: RolloutPolicy(model, policy, trajectories=1), not_callable()),
        "frames_per_batch": (2, integers(1)),
        "total_frames": (2, [*integers(-1), *values(0)]),
        "num_workers": (1, integers(1)),
        "cache": (None, paths()),
        "progress": (False, flags()),
        "name": ("label", texts()),
        "on_labels": callback(),
    }


# ---- cases that many callables have ---------------------------------------------------------------------------------


def on_tensordict(module: Callable[[Any], Any], argument: Argument) -> Case:
    """A module called by position, since TorchRL takes keywords for entries."""
    return case(lambda tensordict: module(tensordict), tensordict=argument)


def on_keys(generator: Callable[[torch.Tensor], TensorDictBase]) -> Case:
    return case(lambda keys: generator(keys), keys=(KEYS, keys()))


def on_entries(module: Callable[[Any], Any], *read: str) -> Case:
    """A module that is run at every belief step: it can only look whether what it reads is there."""
    return on_tensordict(module, (state(), no_states(state(), *read)))


def a_check(check: Callable[..., Any], valid: Any, wrong: list[Hostile], **allowed: Any) -> Case:
    """A check's value; what it allows is written in the library."""
    return case(lambda value: check("value", value, **allowed), value=(valid, wrong))
