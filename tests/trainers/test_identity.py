"""A run folder belongs to one run: whatever decides its results is told apart, whatever it is called."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from torchrl_pomdp.envs import InPart, Mixture
from torchrl_pomdp.envs.repair import (
    CalibratedStart,
    RandomState,
    RepairModel,
    RepairPartition,
    UniformStart,
    damage_chain,
    grid,
    line,
)
from torchrl_pomdp.modules import AfterSteps, ConstantCost, OnEntering, OnLeaving
from torchrl_pomdp.modules.repair import GreedyRepair, RelativeEncoder, RobotEncoder, UrgencyRepair
from torchrl_pomdp.problems import Problem, make_problem
from torchrl_pomdp.problems.problem import identity_symmetry
from torchrl_pomdp.trainers import Evaluate, Improve, PolicyIteration, PolicyIterationConfig
from torchrl_pomdp.trainers import policy_iteration as module

CONFIG = PolicyIterationConfig(
    iterations=1,
    samples_per_part=8,
    value_samples=8,
    trajectories=1,
    least_steps=1,
    epochs=1,
    hidden=(4, 3),
    value_hidden=(4,),
    max_steps=10,
    visits_per_label=0.1,
    validation_states=6,
)
COSTS = (0.0, 1.0, 5.0)


def problem(**change):
    """A problem named "mine" that differs in one thing."""
    given = {
        "graph": line(3), "degradation": (0.0, 0.3), "costs": COSTS, "discount": 0.9, "threshold": 0.0, "ends": 0.05,
        "robots": 1, "dtype": torch.float32, "start": UniformStart, "fractions": (0.0, 1.0), "order": 1,
    } | change  # fmt: skip
    partition = RepairPartition(given["graph"], torch.tensor(COSTS), damage_threshold=given["threshold"])
    model = RepairModel(
        given["graph"],
        damage_chain(given["degradation"]),
        given["costs"],
        given["discount"],
        num_robots=given["robots"],
        terminal_probability=given["ends"],
        partition=partition,
        dtype=given["dtype"],
    )
    random = RandomState(model, given["fractions"])
    training = tuple(InPart(model, random, part) for part in range(6))
    return Problem(model, given["start"](model), name="mine", training=training)


PLAN = [Evaluate((4,)), Improve((0, 4), OnEntering((3, 5)))]


def iteration(folder, mine=None, config=CONFIG, base=None, plan=None):
    mine = problem() if mine is None else mine
    base = GreedyRepair(mine.model) if base is None else base(mine.model)
    return PolicyIteration(mine, config, base, PLAN if plan is None else plan, folder=folder)


def weights(iterations):
    (only,) = iterations
    return torch.cat([p.detach().flatten() for p in (*only.policy.parameters(), *only.value.parameters())])


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    folder = tmp_path_factory.mktemp("done")
    return folder, weights(iteration(folder))


def test_the_same_run_resumes(done):
    folder, expected = done
    labelled = []
    again = iteration(folder)
    again.on_labels = lambda count, cached: labelled.append(cached)
    assert torch.equal(weights(again), expected)
    assert labelled == [True, True]


SLOWER = replace(CONFIG, learning_rate=2e-3)
OTHERS = {
    "chain": ({"mine": lambda: problem(degradation=(0.0, 0.31))}, "model"),
    "damage comes back": ({"mine": lambda: problem(degradation=(0.01, 0.3))}, "model"),
    "costs": ({"mine": lambda: problem(costs=(0.0, 1.0, 6.0))}, "model"),
    "discount": ({"mine": lambda: problem(discount=0.91)}, "model"),
    "graph": ({"mine": lambda: problem(graph=line(4))}, "model"),
    "other graph of the size": ({"mine": lambda: problem(graph=grid(3, 1))}, "model"),
    "robots": ({"mine": lambda: problem(robots=2, start=lambda model: UniformStart(model, (0, 1)))}, "model"),
    "terminal probability": ({"mine": lambda: problem(ends=0.06)}, "model"),
    "precision": ({"mine": lambda: problem(dtype=torch.float64)}, "model"),
    "threshold": ({"mine": lambda: problem(threshold=0.1)}, "model"),
    "start": ({"mine": lambda: problem(start=CalibratedStart)}, "start"),
    "start's number": ({"mine": lambda: problem(start=lambda model: CalibratedStart(model, 0.6))}, "start"),
    "start's robot": ({"mine": lambda: problem(start=lambda model: UniformStart(model, (1,)))}, "start"),
    "start of a function": ({"mine": lambda: problem(start=lambda model: lambda keys: RandomState(model)(keys))}, "start"),
    "training": ({"mine": lambda: problem(fractions=(0.5, 1.0))}, "training"),
    "training's kind": ({"mine": lambda: _mixed(problem())}, "training"),
    "symmetries": ({"mine": lambda: replace(problem(), symmetries=(identity_symmetry, lambda y: y))}, "symmetries"),
    "pessimistic cost": ({"mine": lambda: replace(problem(), pessimistic_cost=ConstantCost(problem().model, 9.0))},
                         "pessimistic_cost"),
    "encoder": ({"mine": lambda: replace(problem(), encoder=RelativeEncoder)}, "encoders"),
    "encoder of many agents": ({"mine": lambda: replace(problem(), agent_encoder=RobotEncoder)}, "encoders"),
    "base policy": ({"base": UrgencyRepair}, "base_policy"),
    "base policy's threshold": ({"base": lambda model: GreedyRepair(model, 0.3)}, "base_policy"),
    "seed": ({"config": replace(CONFIG, seed=1)}, "config"),
    "step size": ({"config": SLOWER}, "config"),
    "hidden layers": ({"config": replace(CONFIG, hidden=(5, 3))}, "config"),
    "plan's order": ({"plan": PLAN[::-1]}, "plan"),
    "plan's kind": ({"plan": [Improve((4,)), PLAN[1]]}, "plan"),
    "plan's parts": ({"plan": [Evaluate((3,)), PLAN[1]]}, "plan"),
    "other parts that cut": ({"plan": [PLAN[0], Improve((0, 4), OnEntering((3,)))]}, "plan"),
    "another rule": ({"plan": [PLAN[0], Improve((0, 4), OnLeaving())]}, "plan"),
    "no rule": ({"plan": [PLAN[0], Improve((0, 4))]}, "plan"),
    "a joint rule": ({"plan": [PLAN[0], Improve((0, 4), OnEntering((3, 5)) | AfterSteps(9))]}, "plan"),
}  # fmt: skip


def _mixed(mine):
    return replace(mine, training=tuple(Mixture([generator], [1.0]) for generator in mine.training))


@pytest.mark.parametrize("name", OTHERS)
def test_another_run_is_refused_by_what_differs(done, name):
    folder, _ = done
    change, differs = OTHERS[name]
    change = dict(change)
    if "mine" in change:
        change["mine"] = change["mine"]()
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=rf"holds another run, which differs in .*\b{differs}\b"):
        next(iter(iteration(folder, **change)))
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def after(rule, other=None):
    """Identities of runs with one rule or another."""
    return iteration(None, plan=[Improve((0,), rule)])._identity()["plan"]


def in_endgame(steps):
    return lambda y: torch.where(y["partition"] < 3, steps, 1)


def first_rule(y):
    return torch.where(y["partition"] < 3, 40, 10)


def second_rule(y):
    return torch.where(y["partition"] < 2, 40, 10)


def test_rules_are_told_by_their_numbers_and_functions():
    rules = [
        AfterSteps(2), AfterSteps(50), AfterSteps(in_endgame(3)), AfterSteps(in_endgame(4)), AfterSteps(first_rule),
        AfterSteps(second_rule), OnEntering((3, 4, 5)), OnEntering((0, 1, 2)), OnEntering((3,)), OnLeaving(),
        AfterSteps(2) | OnLeaving(), AfterSteps(50) | OnLeaving(), OnLeaving() | AfterSteps(2),
    ]  # fmt: skip
    found = [json.dumps(after(rule)) for rule in rules]
    assert len(set(found)) == len(rules)
    assert after(AfterSteps(2)) == after(AfterSteps(2))
    assert after(AfterSteps(in_endgame(3))) == after(AfterSteps(in_endgame(3)))
    assert after(OnEntering((5, 3, 4))) == after(OnEntering([3, 4, 5, 5]))


def test_base_policies_are_told_by_their_numbers():
    bases = [
        GreedyRepair, lambda model: GreedyRepair(model, 0.3), UrgencyRepair, lambda model: UrgencyRepair(model, 2.0),
        lambda model: UrgencyRepair(model, 0.5),
    ]  # fmt: skip
    found = [iteration(None, base=base)._identity()["base_policy"] for base in bases]
    assert len(set(found)) == len(bases)
    assert found == [iteration(None, base=base)._identity()["base_policy"] for base in bases]


def test_another_version_of_the_library_is_refused(done, monkeypatch):
    monkeypatch.setattr(module, "__version__", "0.0.0")
    with pytest.raises(ValueError, match="holds another run, which differs in version"):
        next(iter(iteration(done[0])))


def test_playing_and_training_change_no_identity():
    """What an object remembers of being used is nothing that decides a result."""
    run = iteration(None)
    before = run._identity()
    run.problem.model.with_features(run.problem.start(torch.arange(9)))
    run.base_policy(run.problem.model.with_features(run.problem.start(torch.arange(9))))
    list(run)
    assert run._identity() == before
    assert iteration(None, mine=problem())._identity() == before


SCRIPT = """
import json, sys
sys.path[:0] = [{tests!r}, {here!r}]
from test_identity import AfterSteps, Improve, OnEntering, in_endgame, iteration, make_problem
from torchrl_pomdp.modules.repair import UrgencyRepair
plan = [Improve((0,), AfterSteps(in_endgame(3))), Improve((1,), OnEntering((3, 4, 5)))]
runs = [iteration(None, plan=plan), iteration(None, make_problem("line3"), base=UrgencyRepair)]
print(json.dumps([run._identity() for run in runs]))
"""


def test_identities_do_not_depend_on_the_process():
    here = os.path.dirname(__file__)
    script = SCRIPT.format(tests=os.path.dirname(here), here=here)
    env = os.environ | {"PYTHONHASHSEED": "123", "OMP_NUM_THREADS": "1"}
    out = subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, text=True, check=True).stdout
    plan = [Improve((0,), AfterSteps(in_endgame(3))), Improve((1,), OnEntering((3, 4, 5)))]
    mine = [iteration(None, plan=plan), iteration(None, make_problem("line3"), base=UrgencyRepair)]
    assert json.dumps([run._identity() for run in mine]) == out.splitlines()[-1]
