"""Parts that improve at their own pace, here in threads of one process."""

from __future__ import annotations

import json
import shutil
import threading
import time
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from torchrl_pomdp.collectors import StateMemory
from torchrl_pomdp.collectors.labels import Block
from torchrl_pomdp.config import EVALUATION_SEED
from torchrl_pomdp.evaluation import discounted_costs
from torchrl_pomdp.files import load_tensors
from torchrl_pomdp.kept import keep
from torchrl_pomdp.modules.networks import LocalNetwork
from torchrl_pomdp.modules.repair import GreedyRepair, UrgencyRepair
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.trainers import (
    AsynchronousIteration,
    PolicyIteration,
    PolicyIterationConfig,
    asynchronous,
    load_checkpoint,
    make_networks,
    papi_nt,
    papi_t,
    parts,
)
from torchrl_pomdp.trainers.run import TrainingRun
from torchrl_pomdp.workers import LocalWorkers

CONFIG = PolicyIterationConfig(
    iterations=2,
    samples_per_part=60,
    value_samples=40,
    validation_states=60,
    epochs=1,
    least_steps=10,
    hidden=(16, 8),
    value_hidden=(16,),
    max_steps=40,
)


@pytest.fixture(scope="module")
def line3():
    return make_problem("line3")


def asynchronously(problem, recipe=papi_nt, staleness=1, base=GreedyRepair, config=CONFIG, **options):
    return AsynchronousIteration(recipe(problem, config, base(problem.model), **options), staleness)


def weights(policy):
    return [p.tolist() for p in policy.parameters()]


def within(run):
    return all(version.number - 1 - min(version.used) <= run.staleness for version in run.published)


@pytest.mark.parametrize("recipe", [papi_nt, papi_t])
def test_every_part_publishes_every_version(line3, recipe):
    run = asynchronously(line3, recipe)
    iterations = list(run)
    assert [iteration.number for iteration in iterations] == [1, 2]
    assert sorted((version.part, version.number) for version in run.published) == [(p, n) for p in range(6) for n in (1, 2)]
    assert within(run)
    for iteration in iterations:
        assert all(isinstance(network, LocalNetwork) for network in iteration.policy.policies)
        trained = [isinstance(value, LocalNetwork) for value in iteration.value.values]
        assert trained == [recipe is papi_t and part in (3, 4, 5) for part in range(6)]
    names = [name for iteration in iterations for name in iteration.records]
    assert len(names) == len(set(names)) == 2 * (9 if recipe is papi_t else 6)
    with torch.no_grad():
        y = line3.model.with_features(line3.start(torch.arange(5)))
        assert iterations[-1].policy(y)["action"].shape == (5,)


def test_parts_go_on_from_the_networks_of_a_base_policy_that_has_some(line3, tmp_path, monkeypatch):
    """As where they wait for each other. Networks of other sizes than the configuration's tell these from new ones."""
    base = make_networks(line3, replace(CONFIG, hidden=(5, 3)), 7).eval()
    begun, training = {}, PolicyIteration._training

    def seen(run, index, part, network, number):
        begun[number, part] = weights(network)
        return training(run, index, part, network, number)

    monkeypatch.setattr(PolicyIteration, "_training", seen)

    def carried_out():
        run = asynchronously(line3, base=lambda model: base, config=replace(CONFIG, iterations=1), folder=tmp_path)
        (iteration,) = run
        return [weights(network) for network in iteration.policy.policies]

    trained, given = carried_out(), [weights(network) for network in base.policies]
    assert [begun[1, part] for part in range(6)] == given
    assert not any(own == before for own, before in zip(trained, given, strict=True))
    # What is kept is of those networks as well: nothing is trained again.
    begun.clear()
    assert carried_out() == trained
    assert begun == {}


def test_the_best_policy_is_one_that_was_accepted(line3):
    """Hardly any training makes networks that are worse than a near-optimal base policy."""
    run = asynchronously(line3, base=UrgencyRepair)
    assert [iteration.accepted for iteration in run] == [False, False]
    assert run.best is run.run.base_policy


def test_without_staleness_parts_wait_and_visit_with_the_freshest_networks(line3, monkeypatch):
    """Each part makes its share of the visits before it labels for a version after the first."""
    run, visits = asynchronously(line3, staleness=0), []
    visit = run.run.memory.visit.__func__

    def seen(memory, policy, start, keys, **options):
        visits.append((policy, keys))
        visit(memory, policy, start, keys, **options)

    monkeypatch.setattr(StateMemory, "visit", seen)
    first, _ = run
    assert all(min(version.used) >= version.number - 1 for version in run.published)
    assert visits[0][0] is run.run.base_policy
    assert len(visits) == 7
    assert all(isinstance(network, LocalNetwork) for policy, _ in visits[1:] for network in policy.policies)
    shares = torch.cat([keys for _, keys in visits[1:]]).tolist()
    assert len(shares) == len(set(shares)) == len(visits[0][1])
    assert not set(shares) & set(visits[0][1].tolist())
    fresh = [weights(network) for network in first.policy.policies]
    assert any([weights(network) for network in policy.policies] == fresh for policy, _ in visits[1:])


def test_no_part_learns_from_images_of_older_labels():
    blocks = [Block("a", (1, 1, 0)), Block("b", (1, 0, 1))]
    labels = [
        asynchronous._Labels(2, [(0, blocks[0]), (1, blocks[1])]),
        asynchronous._Labels(1, [(0, blocks[0])]),
        asynchronous._Labels(3, [(0, blocks[0]), (0, blocks[1]), (0, blocks[0])]),
    ]
    state = asynchronous._Progress([[], [], []], labels)
    assert state.images(1, 1, 0) == [(0, blocks[0]), (2, blocks[0]), (2, blocks[0])]
    assert state.images(0, 2, 0) == [(2, blocks[0]), (2, blocks[1]), (2, blocks[0])]
    assert state.images(0, 2, 1) == []
    assert state.images(2, 2, 1) == [(0, blocks[1])]


class Killed(BaseException):
    """Stands for SIGKILL: nothing catches it."""


def test_an_interrupted_run_goes_on_from_the_last_versions(line3, tmp_path, monkeypatch):
    run, keep, count = asynchronously(line3, folder=tmp_path / "run"), asynchronous.keep, []

    def dies(*args):
        count.append(args)
        if len(count) > 8:
            raise Killed
        keep(*args)

    monkeypatch.setattr(asynchronous, "keep", dies)
    with pytest.raises(Killed):
        list(run)
    monkeypatch.undo()
    before = {path: path.read_bytes() for path in (tmp_path / "run").glob("part-*/version-*.pt")}
    assert len(before) == 8
    again = asynchronously(line3, folder=tmp_path / "run")
    found = list(again)
    assert all(path.read_bytes() == content for path, content in before.items())
    assert len(again.published) == 12
    assert within(again)
    once_more = asynchronously(line3, folder=tmp_path / "run")
    for one, other in zip(once_more, found, strict=True):
        assert weights(one.policy) == weights(other.policy)
        assert (one.accepted, one.comparison) == (other.accepted, other.comparison)
    assert len(json.loads((tmp_path / "run/versions.json").read_text())) == 2
    with pytest.raises(ValueError, match="staleness"):
        list(asynchronously(line3, staleness=2, folder=tmp_path / "run"))


@pytest.mark.parametrize("lost", ["notes", "networks"])
def test_what_is_lost_of_a_run_is_made_again(line3, tmp_path, lost):
    """Without notes networks of the same version meet; where versions are lost, those that used to meet them are there."""
    config, folder = replace(CONFIG, iterations=3), tmp_path / "run"
    list(asynchronously(line3, config=config, folder=folder))
    notes = folder / "versions.json"
    if lost == "notes":
        notes.unlink()
    else:
        # As if parts 1 to 5 had been slow.
        notes.write_text(json.dumps([[2, 1, 1, 1, 1, 1], [3, 2, 2, 2, 2, 2], [3, 3, 3, 3, 3, 3]]))
        for number in (2, 3):
            path = folder / f"part-2/version-{number}.pt"
            path.write_bytes(path.read_bytes()[:-20])
    again = asynchronously(line3, config=config, folder=folder)
    assert [iteration.number for iteration in again] == [1, 2, 3]
    assert len(again.published) == 18
    met = json.loads(notes.read_text())
    assert met[-1] == [3] * 6
    assert met[0] == ([1] * 6 if lost == "notes" else [2, 1, 1, 1, 1, 1])
    assert all(one <= other for before, after in pairwise(met) for one, other in zip(before, after, strict=True))


def test_iterations_whose_versions_are_not_known_have_those_of_their_number():
    state = asynchronous._Progress([[None] * 6, [None] * 3], [], met=[[2, 1]])
    assert state.meet()
    assert state.met == [[2, 1], [5, 2]]
    assert not state.meet()
    state = asynchronous._Progress([[None] * 6, [None] * 5], [], met=[[3, 1]])
    assert state.meet()
    assert state.met == [[3, 1], [3, 2], [3, 3], [5, 4]]


def test_what_stops_a_part_stops_all(line3, monkeypatch):
    run = asynchronously(line3)
    collector = run.run._collector

    def broken(index, policy, value, number, cache, part):
        if part == 4:
            raise ArithmeticError("no idea")
        return collector(index, policy, value, number, cache, part)

    monkeypatch.setattr(run.run, "_collector", broken)
    with pytest.raises(ArithmeticError, match="no idea"):
        list(run)


def test_parts_that_are_stopped_stop_in_the_middle_of_their_training(line3, monkeypatch):
    """Nobody waits for a million steps."""
    # What starts once in a process, such as the monitor of progress bars, is there before.
    list(asynchronously(line3, config=replace(CONFIG, iterations=1)))
    run = asynchronously(line3, config=replace(CONFIG, least_steps=1_000_000))
    before = set(threading.enumerate())
    stepping = threading.Event()
    step = parts._Stepper.step
    monkeypatch.setattr(parts._Stepper, "step", lambda *args: (stepping.set(), step(*args))[1])

    def interrupted():
        assert stepping.wait(60)
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "_meet", lambda *_: interrupted())
    with pytest.raises(KeyboardInterrupt):
        list(run)
    assert set(threading.enumerate()) <= before


def test_who_looks_no_further_stops_the_parts(line3):
    def parts():
        return [thread for thread in threading.enumerate() if "_improve" in thread.name]

    for _ in asynchronously(line3, config=replace(CONFIG, iterations=30)):
        assert parts()
        break
    assert not parts()


def test_a_training_run(line3, tmp_path):
    run = TrainingRun(line3, "pAPI-NT", config=CONFIG, states=20, online_states=0, staleness=1)
    first = run.carry_out(tmp_path / "run")
    assert list(first) == ["greedy", "urgency", "R-NT of greedy", "pAPI-NT 1", "pAPI-NT 2"]
    assert run.carry_out(tmp_path / "run") == first
    # What the effort of parts at their own pace is computed by.
    assert [each["staleness"] for each in json.loads((tmp_path / "run/iterations.json").read_text())] == [1, 1]
    with pytest.raises(ValueError, match="staleness"):
        replace(run, staleness=None).carry_out(tmp_path / "run")


def test_costs_are_those_of_the_networks_that_met_last(line3, tmp_path):
    """What is made again has the old name, but is another policy."""
    run, folder, name = (
        TrainingRun(line3, config=CONFIG, states=20, online_states=10, staleness=1),
        tmp_path / "run",
        "pAPI-NT 2",
    )
    run.carry_out(folder)
    first = load_checkpoint(folder / "iteration-2.pt", problem=line3)
    # Costs that nobody would compute: whoever finds them again has looked at the name alone.
    stored = load_tensors(folder / f"costs/{name}.pt")
    keep(folder / f"costs/{name}.pt", stored["owner"], stored["content"] | {"costs": torch.full((20,), 7.0)})
    assert run.costs(folder, [name])[name].tolist() == [7.0] * 20
    shutil.copy(folder / "part-2/version-1.pt", folder / "part-2/version-2.pt")
    run.carry_out(folder)
    second = load_checkpoint(folder / "iteration-2.pt", problem=line3)
    assert weights(first.policy) != weights(second.policy)
    options = {"num_states": 20, "seed": EVALUATION_SEED, "terminal_cost": line3.evaluation_cost}
    expected = discounted_costs(line3.model, second.policy, line3.start, **options)
    assert torch.equal(run.costs(folder, [name])[name], expected)


@pytest.mark.parametrize("count", [1, 2])
def test_no_more_parts_train_at_once_than_there_are_workers(line3, count):
    running, most = [], []

    class Counting(LocalWorkers):
        num_workers = count

        def trained(self, trainings):
            running.append(trainings)
            most.append(len(running))
            time.sleep(0.05)
            try:
                return super().trained(trainings)
            finally:
                running.remove(trainings)

    list(asynchronously(line3, workers=Counting()))
    assert max(most) == count


def test_no_part_reads_values_that_are_not_there(line3):
    """Startgame parts end their simulations with value networks of the endgame's, never with the cost of doing nothing."""
    run, read = asynchronously(line3, papi_t, staleness=2), []
    collector = run.run._collector

    def noted(index, policy, value, number, cache, part):
        if run.run.plan[index].truncation is not None:
            read.extend(value.values[3:])
        return collector(index, policy, value, number, cache, part)

    run.run._collector = noted
    list(run)
    assert len(read) == 3 * 3 * CONFIG.iterations
    assert all(isinstance(value, LocalNetwork) for value in read)


def test_a_run_that_goes_on_remembers_what_was_visited_before(line3, tmp_path, monkeypatch):
    def visited(config):
        run = asynchronously(line3, staleness=0, config=config, folder=tmp_path / "run")
        found, visit = [], run.run._visit

        def noted(policy, number, *part):
            found.append((number, *part))
            visit(policy, number, *part)

        monkeypatch.setattr(run.run, "_visit", noted)
        return run, found

    three = replace(CONFIG, iterations=3)
    run, first = visited(three)
    for iteration in run:
        if iteration.number == 2:
            break
    again, found = visited(three)
    list(again)
    assert sorted(found) == sorted([(0,), *((number, part) for number in (1, 2) for part in range(6))])
    assert set(first) <= set(found)


def test_labels_without_images_in_other_parts_are_not_kept(line3, monkeypatch):
    states = []
    start = AsynchronousIteration._start
    monkeypatch.setattr(AsynchronousIteration, "_start", lambda self: states.append(start(self)) or states[-1])
    list(asynchronously(line3, config=replace(CONFIG, iterations=1, symmetries=False)))
    assert not any(own.blocks for own in states[0].labels)
