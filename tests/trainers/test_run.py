"""Run folders: whose they are, what damage does to them, and what is always in them."""

from __future__ import annotations

import json
import math
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from torchrl_pomdp import kept as kept_results
from torchrl_pomdp import provenance
from torchrl_pomdp.files import load_tensors, save_tensors
from torchrl_pomdp.modules import PartitionedPolicy
from torchrl_pomdp.modules.repair import UrgencyRepair
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.trainers import Checkpoint, PolicyIterationConfig, load_checkpoint, parts, policy_iteration
from torchrl_pomdp.trainers import run as module
from torchrl_pomdp.trainers.architecture import make_networks, make_values
from torchrl_pomdp.trainers.checkpoint import open_run_folder
from torchrl_pomdp.trainers.run import TrainingRun

TINY = PolicyIterationConfig(
    iterations=1,
    samples_per_part=20,
    value_samples=10,
    trajectories=1,
    epochs=1,
    least_steps=1,
    batch_size=20,
    hidden=(4, 3),
    value_hidden=(4,),
    max_steps=20,
    visits_per_label=0.2,
    validation_states=10,
)
RUN = TrainingRun(make_problem("line3"), "API", config=TINY, states=8, online_states=4, online_trajectories=1)


class CountedUrgency(UrgencyRepair):
    """A base policy of one's own."""

    calls = 0

    def forward(self, tensordict):
        CountedUrgency.calls += 1
        return super().forward(tensordict)


class Killed(BaseException):
    """Stands for SIGKILL: nothing catches it."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Folder and results of a run."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    return folder, RUN.carry_out(folder)


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """Folder of the same run, killed when its states were labelled."""
    folder = tmp_path_factory.mktemp("labelled") / "run"

    def killed(*args, **options):
        raise Killed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parts, "train_part", killed)
        with pytest.raises(Killed):
            RUN.carry_out(folder)
    assert list(folder.glob("**/*.labels/**/*.pt"))
    return folder


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """Folders of a run that differs in its seed: carried out, and killed when its states were labelled."""
    run = replace(RUN, config=replace(TINY, seed=1))
    done, killed = tmp_path_factory.mktemp("foreign") / "run", tmp_path_factory.mktemp("killed") / "run"
    run.carry_out(done)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parts, "train_part", lambda *args, **options: (_ for _ in ()).throw(Killed()))
        with pytest.raises(Killed):
            run.carry_out(killed)
    return done, killed


def results(folder):
    """What must not change: policies and costs, to the last bit."""
    costs = {path.name: load_tensors(path)["content"]["costs"].tolist() for path in folder.glob("costs/*.pt")}
    return costs, {path.name: path.read_bytes() for path in folder.glob("*.pt")}


def not_a_number(path):
    def spoil(value):
        if isinstance(value, dict):
            return {key: spoil(entry) for key, entry in value.items()}
        if isinstance(value, list):
            return [spoil(entry) for entry in value]
        if isinstance(value, torch.Tensor) and value.is_floating_point():
            return torch.full_like(value, torch.nan)
        return math.nan if isinstance(value, float) else value

    if path.suffix == ".json":
        path.write_text(json.dumps(spoil(json.loads(path.read_text()))))
    else:
        save_tensors(path, spoil(load_tensors(path)))


def damage(folder, names, kind, other):
    """Damage files of a folder; ``other`` is that of another run."""
    contents = [(folder / name).read_bytes() for name in names]
    for number, name in enumerate(names):
        path, content = folder / name, contents[number]
        if kind == "flipped":
            middle = len(content) // 2
            path.write_bytes(content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :])
        elif kind == "short":
            path.write_bytes(content[: len(content) // 2])
        elif kind == "empty":
            path.write_bytes(b"")
        elif kind == "another run's":
            path.write_bytes((other / name).read_bytes())
        elif kind == "another file":
            same_kind = [c for n, c in zip(names, contents, strict=True) if n.suffix == name.suffix and n != name]
            path.write_bytes(same_kind[number % len(same_kind)] if same_kind else (folder / "costs" / "greedy.pt").read_bytes())
        else:
            not_a_number(path)


KINDS = ["flipped", "short", "empty", "another run's", "another file", "not a number"]


def resume(folder, name, expected):
    """Go on with the run: refused by the file's name, or the same results."""
    refusal = ""
    try:
        found = RUN.carry_out(folder)
    except ValueError as error:
        refusal = str(error)
    if refusal:
        assert str(folder / name) in refusal or f"run folder {folder} holds another run" in refusal
    else:
        assert (found, results(folder)) == expected


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_never_give_another_result(whole, labelled, foreign, tmp_path, monkeypatch, kind):
    """Every file of a run: those that say whose it is one by one, all others, which are computed again, at once."""
    warnings = []
    monkeypatch.setattr(kept_results.logger, "warning", lambda text, *args: warnings.append(text))
    folder, found = whole
    expected = found, results(folder)
    names = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]
    kept = [name for name in names if name.parts[0].startswith("policy-iter") or name.name in ("config.json", "1-improve.pt")]
    assert len(kept) == 3
    again = [name for name in names if name not in kept]
    tries = [(whole[0], name, [name], foreign[0]) for name in kept] + [(whole[0], None, again, foreign[0])]
    blocks = [path.relative_to(labelled) for path in labelled.glob("**/*.labels/**/*.pt")]
    tries += [(labelled, name, [name], foreign[1]) for name in blocks]
    for number, (source, name, damaged, other) in enumerate(tries):
        copied = tmp_path / str(number)
        shutil.copytree(source, copied)
        damage(copied, damaged, kind, other)
        resume(copied, name, expected)
    costs = [warning for warning in warnings if "costs" in warning]
    # A flipped bit may be one that says nothing.
    assert len(costs) == 4 or kind == "flipped", "one line for each file of costs"
    assert all("made again" in warning for warning in costs)


def test_costs_of_fewer_states_are_computed_again(whole, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(whole[0], folder)
    path = folder / "costs" / "urgency.pt"
    content = load_tensors(path)
    save_tensors(path, content | {"content": {"costs": content["content"]["costs"][:7]}})
    with pytest.raises(ValueError, match="does not hold the costs"):
        replace(RUN, states=9).costs(folder, ["urgency"])
    assert RUN.carry_out(folder) == whole[1]
    assert torch.equal(RUN.costs(folder, ["urgency"])["urgency"], content["content"]["costs"])


def test_equal_runs_have_equal_files(whole, tmp_path):
    assert RUN.carry_out(str(tmp_path / "again")) == whole[1]
    assert results(tmp_path / "again") == results(whole[0])


def test_a_folder_belongs_to_a_version_a_problem_and_base_policies(whole, tmp_path, monkeypatch):
    record = json.loads((whole[0] / "config.json").read_text())
    assert record["version"] == module.__version__
    monkeypatch.setattr(module, "__version__", "0.0.0")
    with pytest.raises(ValueError, match="holds another run, which differs in version"):
        RUN.carry_out(whole[0])
    monkeypatch.undo()
    monkeypatch.setattr(module, "problem_digest", lambda problem: "another")
    with pytest.raises(ValueError, match="differs in problem_digest"):
        RUN.carry_out(whole[0])
    monkeypatch.undo()
    bases = RUN.problem.base_policies | {"urgency": UrgencyRepair(RUN.problem.model, 2.0)}
    with pytest.raises(ValueError, match="differs in base_policies"):
        replace(RUN, problem=replace(RUN.problem, base_policies=bases)).carry_out(whole[0])


def test_without_an_accepted_iteration_the_base_policy_is_best(tmp_path, line3):
    """Hardly any training makes networks that are worse than a near-optimal base policy."""
    config = replace(TINY, validation_states=200)
    run = replace(RUN, base="urgency", config=config, states=20, rollout_states=10, online_states=20)
    assert "urgency + R-NT" in run.carry_out(tmp_path / "run")
    (iteration,) = json.loads((tmp_path / "run" / "iterations.json").read_text())
    assert not iteration["accepted"]
    best = load_checkpoint(tmp_path / "run" / "best.pt")
    assert (best.name, best.iteration) == ("urgency", 0)
    assert load_checkpoint(tmp_path / "run" / "iteration-1.pt").iteration == 1


@pytest.mark.parametrize(("rollout", "online"), [(0, 0), (3, 0), (0, 9)])
def test_online_rollout_is_evaluated_on_as_many_states_as_are_wanted(tmp_path, rollout, online):
    found = replace(RUN, rollout_states=rollout, online_states=online).carry_out(tmp_path / "run")
    counts = {name: comparison.cost.count for name, comparison in found.items() if "R-NT" in name}
    assert {name.startswith("R-NT of"): count for name, count in counts.items()} == {
        base: min(count, RUN.states) for base, count in ((True, rollout), (False, online)) if count
    }


@pytest.mark.parametrize("when", ["report", "on_labels"])
def test_a_folder_deleted_in_the_middle_is_an_error_that_says_so(tmp_path, when):
    """While policies are evaluated, and while networks are trained."""
    with pytest.raises(FileNotFoundError, match=r"run folder .*run was deleted or moved while the run went on"):
        RUN.carry_out(tmp_path / "run", **{when: lambda *args: shutil.rmtree(tmp_path / "run", ignore_errors=True)})


def test_a_kill_in_training_leaves_no_row_twice(tmp_path, monkeypatch):
    run = replace(RUN, config=replace(TINY, least_steps=200))
    step = parts._Stepper.step

    def killed(self, *args):
        if self.count == 120:
            raise Killed
        return step(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(parts._Stepper, "step", killed)
        with pytest.raises(Killed):
            run.carry_out(tmp_path / "run")
    (log,) = (tmp_path / "run").rglob("loss_policy.csv")
    assert len(log.read_text().splitlines()) == 2
    run.carry_out(tmp_path / "run")
    assert [line.split(",")[0] for line in log.read_text().splitlines()] == ["50", "100", "150", "200"]


@pytest.mark.parametrize(
    "change",
    [
        {"problem": "nosuch"}, {"problem": 3}, {"algorithm": "papi"}, {"base": "lazy"}, {"config": None}, {"config": {}},
        {"states": 0}, {"states": 2.0}, {"states": math.nan}, {"states": True}, {"states": 10**30}, {"states": "9"},
        {"rollout_states": -5}, {"rollout_states": 2.5}, {"online_states": -5},
        {"online_states": math.inf}, {"online_states": None}, {"online_trajectories": 0},
        {"online_trajectories": 10**30}, {"online_trajectories": False},
    ],
)  # fmt: skip
def test_numbers_are_checked_when_they_are_given(change):
    with pytest.raises((TypeError, ValueError), match=f"^{next(iter(change))} must be"):
        replace(RUN, **change)


@pytest.mark.parametrize(
    ("options", "message"), [({"folder": 3}, "folder must be a path"), ({"progress": "x"}, "progress must be")]
)
def test_what_is_refused_leaves_nothing_behind(tmp_path, options, message):
    with pytest.raises((TypeError, ValueError), match=message):
        RUN.carry_out(**({"folder": tmp_path / "run"} | options))
    assert not list(tmp_path.iterdir())


def test_what_is_finished_stays_so_while_a_run_is_carried_out_again(tmp_path, monkeypatch):
    """Whenever that is interrupted: the best policy and the table are not those of an earlier time."""
    run = replace(RUN, base="greedy", config=replace(TINY, iterations=2))
    monkeypatch.setattr(policy_iteration, "judge", lambda comparison: (True, "accepted"))
    run.carry_out(tmp_path / "run")
    names = ("best.pt", "metrics.json", "iterations.json")
    before = [(tmp_path / "run" / name).read_bytes() for name in names]
    assert load_checkpoint(tmp_path / "run/best.pt").name == "API 2"
    for stop in ("greedy", "API 1"):

        def killed(name, comparison, stop=stop):
            if name == stop:
                raise Killed

        with pytest.raises(Killed):
            run.carry_out(tmp_path / "run", report=killed)
        assert [(tmp_path / "run" / name).read_bytes() for name in names] == before
    run.carry_out(tmp_path / "run")
    assert [(tmp_path / "run" / name).read_bytes() for name in names] == before


@pytest.mark.parametrize("name", ["API 1", "pAPI-NT 3", "R-NT of greedy", "greedy + R-NT", "one-at-a-time of greedy"])
def test_base_policies_are_not_named_like_what_a_run_makes(line3, name):
    problem = replace(line3, base_policies={**line3.base_policies, name: line3.base_policies["urgency"]}, spec=None)
    with pytest.raises(ValueError, match="base_policies must have names that no policy of a run has"):
        TrainingRun(problem)


@pytest.mark.parametrize("algorithm", ["API", "pAPI-NT"])
def test_what_could_not_be_kept_is_refused_before_anything_is_computed(line3, tmp_path, algorithm):
    def carried_out(base, **change):
        problem = replace(line3, base_policies={**line3.base_policies, "mine": base}, **change)
        run = replace(RUN, problem=problem, algorithm=algorithm, base="mine", rollout_states=0, online_states=0)
        return run.carry_out(tmp_path / "run")

    def networks(**change):
        problem = line3.unpartitioned() if algorithm == "API" else line3
        return make_networks(problem, replace(TINY, **change), seed=0)

    with pytest.raises(ValueError, match=r"must have the base policies that its spec describes.*'mine'.*with spec=None"):
        carried_out(CountedUrgency(line3.model))
    with pytest.raises(
        ValueError, match=r"config must have the sizes and the encoder of the networks of the base policy 'mine'"
    ):
        carried_out(networks(hidden=(5, 3)), spec=None)
    with pytest.raises(
        ValueError, match=r"config must have the sizes and the encoder of the networks of the base policy 'mine'"
    ):
        carried_out(networks(encoder="flat"), spec=None)
    with pytest.raises(ValueError, match=r"base_policy must have [16] local policies, one for each part, got 2"):
        carried_out(PartitionedPolicy(list(line3.base_policies.values())), spec=None)
    assert CountedUrgency.calls == 0
    assert not list(tmp_path.iterdir())
    assert list(carried_out(networks(), spec=None)) == ["greedy", "urgency", "mine", f"{algorithm} 1"]


def test_a_checkpoint_is_not_named_like_a_base_policy(line3):
    problem = replace(line3, base_policies={**line3.base_policies, "mine 1": line3.base_policies["urgency"]}, spec=None)
    policy, value = (make(problem, TINY, seed=0) for make in (make_networks, make_values))
    with pytest.raises(ValueError, match="no base policy named like the checkpoint, got 'mine 1'"):
        Checkpoint(problem, TINY, "mine", 1, policy, value)


def test_a_kill_while_a_run_folder_is_opened_does_not_spoil_it(tmp_path):
    program = (
        "import os, signal, sys\nfrom torchrl_pomdp.trainers.checkpoint import open_run_folder\n"
        "os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)\nopen_run_folder(sys.argv[1], {'seed': 0})"
    )
    assert subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=False).returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 1
    assert open_run_folder(str(tmp_path), {"seed": 0}) == tmp_path
    with pytest.raises(ValueError, match="differs in seed"):
        open_run_folder(tmp_path, {"seed": 1})


def test_provenance_is_of_what_was_computed(tmp_path, monkeypatch):
    """To look at a finished run with another commit computes nothing in it."""
    folder = tmp_path / "run"
    for commit in ("first", "second", "third"):
        monkeypatch.setattr(provenance, "provenance", lambda commit=commit: {"commit": commit})
        if commit == "third":
            (folder / "costs" / "greedy.pt").unlink()
        RUN.carry_out(folder)
    assert provenance.known_provenance(folder) == [{"commit": "first"}, {"commit": "third"}]


@pytest.mark.parametrize("text", ["{}", "[]", "no JSON", '{"computed_by": 3}', '{"computed_by": {"a": 1}}'])
def test_provenance_that_tells_nothing_is_none(tmp_path, text):
    (tmp_path / "provenance.json").write_text(text)
    assert provenance.known_provenance(tmp_path) == []
    provenance.note_provenance(tmp_path)
    assert provenance.known_provenance(tmp_path) == [provenance.provenance()]


def test_online_rollout_of_the_base_policy_is_evaluated_once(tmp_path):
    config = replace(TINY, validation_states=200)
    found = replace(RUN, base="urgency", config=config, states=20, rollout_states=20, online_states=20).carry_out(
        tmp_path / "run"
    )
    assert "R-NT of urgency" in found
    assert "urgency + R-NT" not in found


def test_truncated_rollout_is_cut_as_its_labels_are(tmp_path, monkeypatch):
    seen, own = [], module.r_t

    def noted(*args, **options):
        seen.append(options["max_steps"])
        return own(*args, **options)

    monkeypatch.setattr(module, "r_t", noted)
    config = replace(TINY, label_steps=10)
    replace(RUN, problem=make_problem("line3"), algorithm="pAPI-T", config=config).carry_out(tmp_path / "run")
    assert seen == [10]
