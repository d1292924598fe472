"""A problem of the user's own code: trained, killed, resumed, saved, and loaded in another process."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from dataclasses import replace
from functools import partial

import pytest
import torch

from torchrl_pomdp.cli import main
from torchrl_pomdp.envs import FixedBelief, Partition, TabularModel
from torchrl_pomdp.envs.repair import damage_chain, grid, line
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.files import DamagedFileError
from torchrl_pomdp.modules import PolicyNetwork, RolloutPolicy
from torchrl_pomdp.planners import POMCP
from torchrl_pomdp.problems import Problem, make_problem, repair_problem, tiger
from torchrl_pomdp.trainers import (
    Checkpoint,
    PolicyIterationConfig,
    api,
    load_checkpoint,
    papi_nt,
    papi_t,
    parts,
    r_t,
    save_checkpoint,
)
from torchrl_pomdp.trainers.run import TrainingRun

# A machine with ten levels of wear that is run, looked at, serviced or replaced.
OWN = '''
import torch
from torchrl_pomdp.envs import FixedBelief, Partition, TabularModel
from torchrl_pomdp.problems import Problem

LEVELS = 10


class Worn(Partition):
    names = ("worn", "fresh")
    stages = ((1,), (0,))

    def forward(self, y):
        return (y["belief"][..., :5].sum(-1) > 0.5).long()


def model(partition=None):
    wear = 0.7 * torch.eye(LEVELS) + 0.3 * torch.eye(LEVELS).roll(1, 1)
    wear[-1] = torch.eye(LEVELS)[-1]
    serviced = torch.eye(LEVELS)[(torch.arange(LEVELS) - 3).clamp_min(0)]
    new = torch.eye(LEVELS)[torch.zeros(LEVELS, dtype=torch.int64)]
    transition = torch.stack([wear, wear, serviced, new])
    blind = torch.tensor([1.0, 0.0, 0.0]).expand(LEVELS, 3)
    look = torch.stack([torch.tensor([0.9 - 0.08 * i, 0.1, 0.08 * i]) for i in range(LEVELS)])
    level = torch.arange(LEVELS) ** 2 / 8.0
    cost = torch.stack([level, level + 0.2, level + 3.0, level + 12.0])
    return TabularModel(transition, torch.stack([blind, look, blind, blind]), cost, 0.8, partition=partition)


def start(keys):
    return FixedBelief(torch.eye(LEVELS)[5])(keys)


def threshold(y):
    """Replace where the mean level is 6."""
    mean = (y["belief"] * torch.arange(LEVELS)).sum(-1)
    return y.set("action", torch.where(mean > 6.0, 3, 0))


def problem():
    return Problem(model(Worn()), start, name="machine", base_policies={"threshold": threshold})


def single():
    return Problem(model(), start, name="machine", base_policies={"threshold": threshold})
'''
own = {"__name__": "own_machine"}
exec(compile(OWN, "own_machine.py", "exec"), own)
CONFIG = PolicyIterationConfig(
    iterations=1, samples_per_part=300, value_samples=100, least_steps=200, epochs=1, hidden=(32,), value_hidden=(16,),
    batch_size=64, validation_states=200, max_steps=25,
)  # fmt: skip
SMALL = replace(CONFIG, iterations=2, samples_per_part=40, value_samples=20, least_steps=10, validation_states=20, max_steps=15)


def weights(iteration):
    return torch.cat([p.detach().flatten() for p in (*iteration.policy.parameters(), *iteration.value.parameters())])


@pytest.fixture(scope="module")
def trained():
    """Its iterations, one of which at least improves on the base policy."""
    return list(papi_t(own["problem"](), CONFIG, own["threshold"]))


def test_policy_iteration_improves_a_plain_function(trained):
    problem = own["problem"]()
    best = [iteration for iteration in trained if iteration.accepted][-1]
    costs = [discounted_costs(problem.model, p, problem.start, num_states=500) for p in (best.policy, own["threshold"])]
    assert compare(*costs).ratio.interval[1] < 0.95


def test_a_single_part_and_no_more_than_model_and_start():
    iterations = list(api(own["single"](), CONFIG, own["threshold"]))
    assert any(iteration.accepted for iteration in iterations)
    bare = Problem(own["model"](), own["start"])
    assert list(bare.base_policies) == ["myopic"]
    (iteration, _) = papi_nt(bare, SMALL, bare.base_policies["myopic"])
    assert isinstance(iteration.policy.policies[0], PolicyNetwork)


def test_truncated_rollout_with_its_values_is_online_play(trained):
    problem = own["problem"]()
    policy = r_t(problem, own["threshold"], trained[0].value, trajectories=2)
    costs = [discounted_costs(problem.model, p, problem.start, num_states=60) for p in (policy, own["threshold"])]
    assert costs[0].mean() < costs[1].mean()


class Killed(BaseException):
    """Stands for SIGKILL: nothing catches it."""


@pytest.fixture(scope="module")
def uninterrupted():
    return list(papi_t(own["problem"](), SMALL, own["threshold"]))


@pytest.mark.parametrize("after", [0, 1, 4])
def test_killed_and_resumed_equals_uninterrupted(uninterrupted, tmp_path, monkeypatch, after):
    calls, train_part = [], parts.train_part

    def killed(*args, **options):
        if len(calls) == after:
            raise Killed
        calls.append(options["name"])
        return train_part(*args, **options)

    monkeypatch.setattr(parts, "train_part", killed)
    with pytest.raises(Killed):
        list(papi_t(own["problem"](), SMALL, own["threshold"], folder=tmp_path))
    monkeypatch.undo()
    resumed = list(papi_t(own["problem"](), SMALL, own["threshold"], folder=tmp_path))
    assert [torch.equal(weights(a), weights(b)) for a, b in zip(resumed, uninterrupted, strict=True)] == [True, True]


def test_a_checkpoint_needs_the_problem_back(trained, tmp_path):
    problem, path = own["problem"](), tmp_path / "own.pt"
    save_checkpoint(path, Checkpoint(problem, CONFIG, "pAPI-T", 1, trained[0].policy, trained[0].value))
    loaded = load_checkpoint(path, problem=own["problem"]())
    assert torch.equal(weights(loaded), weights(trained[0]))
    with pytest.raises(ValueError, match=r"own\.pt: the policy was trained on machine, .*: build it and give it as problem="):
        load_checkpoint(path)
    with pytest.raises(ValueError, match=r"own\.pt: problem must be machine, as it was when .*, got another one"):
        load_checkpoint(path, problem=make_problem("tiger"))
    cheaper = TabularModel(
        own["model"]().transition, own["model"]().observation, own["model"]().cost - 1, 0.8, partition=own["Worn"]()
    )
    with pytest.raises(ValueError, match="got another one"):
        load_checkpoint(path, problem=Problem(cheaper, own["start"], base_policies=problem.base_policies))
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(DamagedFileError):
        load_checkpoint(path, problem=own["problem"]())


NUMBERS = ["--iterations", "1", "--samples-per-part", "40", "--least-steps", "10", "--hidden", "16", "--max-steps", "8"]
NUMBERS += ["--states", "8", "--validation-states", "8", "--online-states", "0"]


def test_what_the_command_names_to_go_on_with_is_a_command(tmp_path, monkeypatch, capsys):
    (tmp_path / "own_machine.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("torchrl_pomdp.trainers.policy_iteration.judge", lambda comparison: (True, "accepted"))
    assert main(["train", "own_machine:problem", "--out", "a run", "--rollout-states", "2", *NUMBERS]) == 0
    (named,) = re.findall(r"torchrl-pomdp (evaluate .* --online)", capsys.readouterr().out)
    assert main([*shlex.split(named), "--states", "2", "--trajectories", "1"]) == 0
    assert "| pAPI-NT 1 + R-NT |" in capsys.readouterr().out
    del sys.modules["own_machine"]


def test_the_command_trains_it_in_a_fresh_process_and_evaluates_it_in_another(tmp_path, monkeypatch, capsys):
    (tmp_path / "own_machine.py").write_text(OWN)
    command = [sys.executable, "-m", "torchrl_pomdp.cli", "train", "own_machine:problem", "--out", "run", *NUMBERS]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "threshold: 1.000 of threshold" in done.stdout + done.stderr
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["evaluate", "run/best.pt", "--problem", "own_machine:problem", "--states", "8"]) == 0
    del sys.modules["own_machine"]
    evaluated = "machine: TabularModel: 10 states, 4 controls, 3 observations, discount 0.8; 8 start states"
    assert evaluated in capsys.readouterr().out


def test_a_run_of_it_has_a_folder_of_its_own(tmp_path):
    config = PolicyIterationConfig(1, samples_per_part=20, least_steps=1, validation_states=20, max_steps=10)
    run = TrainingRun(own["problem"](), config=config, states=8, online_states=0)
    assert list(run.carry_out(tmp_path / "run")) == ["threshold", "R-NT of threshold", "pAPI-NT 1"]
    best = load_checkpoint(tmp_path / "run" / "best.pt", problem=own["problem"]())
    assert best.problem.name == "machine"
    with pytest.raises(ValueError, match=r"differs in .*problem"):
        TrainingRun(make_problem("tiger"), "API", config=config, states=8, online_states=0).carry_out(tmp_path / "run")


def test_what_a_problem_must_be():
    model, start = own["model"](), FixedBelief(torch.eye(10)[0])
    assert issubclass(own["Worn"], Partition)
    for wrong, message in [
        ({"training": ()}, "training must hold 1 generators, one for each part, got 0"),
        ({"base_policies": {}}, "base_policies is empty"),
        ({"symmetries": ()}, "symmetries is empty"),
        ({"pessimistic_cost": 3.0}, "pessimistic_cost must be a ClosedFormCost"),
    ]:
        with pytest.raises((TypeError, ValueError), match=message):
            Problem(model, start, **wrong)


@pytest.mark.parametrize("graph", [line(1), line(2), grid(1, 6)])
def test_where_there_is_no_left_and_right_there_is_a_single_part(graph):
    problem = repair_problem(graph, damage_chain((0.0, 0.1)), (0.0, 1.0, 10.0), 0.5)
    assert problem.partition.num_parts == 1
    assert problem.training[0](torch.arange(4)).batch_size == (4,)
    assert repair_problem(grid(2, 2), damage_chain((0.0, 0.1)), (0.0, 1.0, 10.0), 0.5).partition.num_parts == 6


def test_a_discount_that_asks_for_too_many_stages_says_so():
    problem = tiger(0.999999)
    for make in (RolloutPolicy, partial(POMCP, simulations=3)):
        with pytest.raises(ValueError, match=r"max_steps must be given for a discount of 0\.999999: 4017382 stages matter"):
            make(problem.model, problem.base_policies["listen"])
