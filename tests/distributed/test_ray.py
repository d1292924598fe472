"""Policy iteration on a Ray cluster gives what one process gives, whatever dies meanwhile."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from _tiger import CONFIG, TWICE, assert_same, carried_out, tiger
from torchrl.collectors.distributed import RayCollector
from torchrl.record import CSVLogger

from torchrl_pomdp import evaluation
from torchrl_pomdp.collectors import PartSampler, RolloutImprovement, StateMemory, labels, memory
from torchrl_pomdp.distributed import RayWorkers, ray_workers
from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.modules import RolloutPolicy
from torchrl_pomdp.trainers import AsynchronousIteration, papi_nt, papi_t
from torchrl_pomdp.workers import LOCAL, WorkerError

DRIVER = os.getpid()


@pytest.fixture(scope="module")
def cluster():
    """A cluster of three CPUs, which the tests' workers share."""
    with RayWorkers(num_workers=3) as workers:
        yield workers


@pytest.fixture
def small(monkeypatch):
    """Blocks so small that each worker has several."""
    monkeypatch.setattr(labels, "_BLOCK", 512)
    monkeypatch.setattr(memory, "_BLOCK", 1024)


@pytest.fixture(scope="module")
def expected():
    return carried_out(LOCAL)


@pytest.fixture(scope="module")
def with_values():
    return carried_out(LOCAL, papi_t, config=TWICE)


def test_synchronous_is_local_to_the_last_bit(cluster, small, tmp_path, with_values):
    assert cluster.num_workers == 3
    assert_same(carried_out(cluster, papi_t, config=TWICE, folder=tmp_path / "run"), with_values)
    restored = carried_out(LOCAL, papi_t, config=TWICE, folder=tmp_path / "run")
    assert_same(restored, with_values)


def test_labels_do_not_depend_on_who_is_done_first(cluster, small, expected):
    myopic = tiger().base_policies["myopic"]

    def slow(y):
        """Takes longer for some blocks than for others."""
        if os.getpid() != DRIVER:
            time.sleep(0.002 * (y["belief"].square().sum().item() * 1000 % 7))
        return myopic(y)

    slow.in_keys, slow.out_keys = myopic.in_keys, myopic.out_keys
    assert_same(carried_out(cluster, base=slow), expected)


def test_visits_and_evaluations_are_shared_out(cluster, small):
    problem, keys = tiger(), torch.arange(300)
    myopic = problem.base_policies["myopic"]
    own, other = StateMemory(problem.model), StateMemory(problem.model)
    own.visit(myopic, problem.start, keys)
    other.visit(myopic, problem.start, keys, workers=cluster)
    assert own.count(0) == other.count(0) > 0
    draws = [each.generator(0)(torch.arange(50)) for each in (own, other)]
    assert torch.equal(draws[0]["belief"], draws[1]["belief"])
    options = {"num_states": 200, "first": 7, "seed": 3}
    costs = [evaluation.discounted_costs(problem.model, myopic, problem.start, workers=w, **options) for w in (LOCAL, cluster)]
    assert torch.equal(*costs)


# ---- what dies -------------------------------------------------------------------------------------------------------


def test_a_killed_worker_changes_nothing(cluster, small, expected, tmp_path):
    myopic, marker = tiger().base_policies["myopic"], tmp_path / "killed"

    def mortal(y):
        """Kills its process once, in the middle of a task."""
        if os.getpid() != DRIVER and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return myopic(y)

    mortal.in_keys, mortal.out_keys = myopic.in_keys, myopic.out_keys
    found = carried_out(cluster, base=mortal)
    assert marker.exists()
    assert_same(found, expected)


def processes(name):
    """Numbers of the processes whose command line starts so."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if path.read_bytes().startswith(name.encode()):
                found.append(int(path.parent.name))
        except OSError:
            continue
    return found


def test_a_killed_actor_changes_nothing(cluster, small, expected):
    killed = []

    def kill():
        while not killed:
            own = set(descendants(os.getpid())) & set(processes("ray::PartActor.train"))
            for process in sorted(own)[:1]:
                os.kill(process, signal.SIGKILL)
                killed.append(process)
            time.sleep(0.01)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    found = carried_out(cluster)
    assert killed
    assert_same(found, expected)


SCRIPT = "import sys, test_ray; test_ray.on_a_cluster_of_its_own(sys.argv[1])"
COMMAND = ("-m", "torchrl_pomdp.cli", "train", "line3", "--algorithm", "API", "--states", "4", "--backend", "ray")
SIZE = ("--samples-per-part", "3000", "--iterations", "2", "--validation-states", "4", "--visits-per-label", "0.01")


def on_a_cluster_of_its_own(folder):
    with RayWorkers(num_workers=1) as workers:
        assert workers.num_workers == 1
        carried_out(workers, papi_t, config=TWICE, folder=Path(folder))


def wait_for(condition, seconds=300):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it takes too long"
        time.sleep(0.05)


def descendants(process):
    """All processes that a process has started, directly or not."""
    children = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            number, parent = int(path.parent.name), int(path.read_text().rsplit(")", 1)[1].split()[1])
        except OSError:
            continue
        children.setdefault(parent, []).append(number)
    found, waiting = [], [process]
    while waiting:
        own = children.get(waiting.pop(), [])
        found += own
        waiting += own
    return found


def alive(processes):
    """Those that are there and no zombies; Ray's agents look once a minute whether their raylet is."""
    found = []
    for number in processes:
        try:
            dead = Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
            agent = b"Agent" in Path(f"/proc/{number}/cmdline").read_bytes()
        except OSError:
            continue
        if not dead and not agent:
            found.append(number)
    return found


def interrupted(arguments, iteration, how):
    """Start Python, end it in the middle of a step of an iteration, and see that nothing is left of its cluster."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parent)}
    driver = subprocess.Popen(
        [sys.executable, *arguments],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        # A shell's background processes ignore it, and so do their children.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    wait_for(lambda: list(iteration.glob("*.labels/*/*.pt")) or list(iteration.glob("*.pt")))
    everything = descendants(driver.pid)
    assert len(everything) > 3
    driver.send_signal(how)
    assert driver.wait(timeout=200) != 0
    wait_for(lambda: not alive(everything), 60)


def test_a_killed_driver_goes_on(cluster, tmp_path, with_values):
    """The first iteration is one worker's, and the second one partly, which three others finish."""
    folder = tmp_path / "run"
    interrupted(("-c", SCRIPT, str(folder)), folder / "iteration-2", signal.SIGKILL)
    assert (folder / "iteration-1/3-improve.pt").exists()
    assert not (folder / "iteration-2/3-improve.pt").exists()
    assert_same(carried_out(cluster, papi_t, config=TWICE, folder=folder), with_values)


def test_an_interrupt_of_the_command_releases_ray(tmp_path):
    folder = tmp_path / "run"
    interrupted((*COMMAND, *SIZE, "--workers", "1", "--out", str(folder)), folder / "iteration-1", signal.SIGINT)


# ---- what fails ------------------------------------------------------------------------------------------------------


def test_errors_say_which_work_has_failed(cluster, small, monkeypatch):
    myopic = tiger().base_policies["myopic"]

    def broken(y):
        if os.getpid() != DRIVER and y.batch_size.numel() > 1:
            raise ArithmeticError("no idea")
        return myopic(y)

    config = replace(CONFIG, visited_share=0.0)
    monkeypatch.setattr("torchrl_pomdp.trainers.policy_iteration.PolicyIteration._visit", lambda self, *args: None)
    monkeypatch.setattr("torchrl_pomdp.trainers.policy_iteration.PolicyIteration._validate", lambda *args: torch.zeros(2))
    with pytest.raises(WorkerError, match=r"label iteration-1/1-improve, part 1, states 0 … 63: ArithmeticError: no idea"):
        carried_out(cluster, base=broken, config=config)


class Sleeps:
    """A training that would not end."""

    part, name = 3, "iteration-1/1-improve, part 3"

    def open(self):
        time.sleep(100)


def out_of_memory():
    """On a machine that lacks memory from the beginning."""
    ray_workers._RETRIES = 1
    with RayWorkers(num_workers=1) as workers:
        for work in (
            lambda: list(workers.tasks(lambda shared, item: time.sleep(100), None, [7], lambda item: f"number {item}")),
            lambda: workers.trained({3: workers.training(Sleeps(), None, False)}),
        ):
            with pytest.raises(WorkerError, match="OutOfMemoryError") as error:
                work()
            sys.stdout.write(f"failed: {str(error.value)[:60]}\n")


def test_memory_that_runs_out_is_named(tmp_path):
    """Ray would begin such tasks again without end."""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent), "RAY_memory_usage_threshold": "0.01"}
    # What this process's own cluster has set.
    environment.pop("RAY_task_oom_retries", None)
    program = [sys.executable, "-c", "import test_ray; test_ray.out_of_memory()"]
    # Processes of Ray's would hold a pipe open for up to a minute after the program's end.
    with (tmp_path / "told").open("w") as told:
        subprocess.run(program, env=environment, stdout=told, stderr=subprocess.STDOUT, timeout=300)
    text = (tmp_path / "told").read_text()
    assert re.findall(r"failed: (.*): OutOfMemoryError", text) == ["number 7", f"train {Sleeps.name}"], text


def test_a_worker_that_dies_again_and_again_is_given_up(cluster, monkeypatch):
    def dies(shared, item):
        os.kill(os.getpid(), signal.SIGKILL)

    monkeypatch.setattr(ray_workers, "_RETRIES", 1)
    with RayWorkers() as workers, pytest.raises(WorkerError, match="number 7: WorkerCrashedError"):
        list(workers.tasks(dies, None, [7], lambda item: f"number {item}"))


def test_logs_of_a_trained_part_are_closed(tmp_path):
    """Else a long run ends at the system's limit of open files."""
    logger = CSVLogger("log", log_dir=str(tmp_path))
    rows = [("part/loss", 1.0, 50), ("part/loss", 0.5, 100)]
    job = SimpleNamespace(part=0, name="part")
    training = ray_workers.RayTraining(None, job, logger, lambda reference, name: ("trained", rows))
    assert training.result() == "trained"
    assert (tmp_path / "log/scalars/part/loss.csv").read_text().splitlines() == ["50,1.0", "100,0.5"]
    assert not logger.experiment.files


def test_rays_handler_of_sigterm_replaces_none_of_ours():
    """It exits at once; the command's says that it goes on, and releases Ray."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with ray_workers._kept_sigterm():
            signal.signal(signal.SIGTERM, lambda *args: sys.exit(15))
        assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGTERM, before)


def test_what_was_released_does_nothing_more(cluster):
    """A call of Ray's would start a cluster again."""
    workers = RayWorkers()
    results = workers.tasks(lambda shared, item: (item, item), None, list(range(50)), str)
    next(results)
    workers.close()
    workers.close()
    for use in (lambda: next(results), lambda: workers.put(1), lambda: workers.tasks(None, None, [], str)):
        with pytest.raises(WorkerError, match="the workers were released: make new ones"):
            use()
    assert list(cluster.tasks(lambda shared, item: (item, item), None, [1], str)), "the cluster is not theirs"


def test_a_running_cluster_has_the_workers_that_it_has(cluster):
    with RayWorkers() as same:
        assert same.num_workers == 3
    with pytest.raises(ValueError, match="num_workers is for a cluster that is started here, got 2 for one that is running"):
        RayWorkers(num_workers=2)
    assert list(cluster.tasks(lambda shared, item: (item, item), None, [1], str)), "the cluster is still there"


def test_a_cluster_that_is_not_there_is_named_at_once():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(ConnectionError, match=f"nothing answers at {address}: "):
            ray_workers._connect(address)


def test_models_elsewhere_are_refused(cluster):
    with pytest.raises(ValueError, match="workers of a Ray cluster compute on CPUs, got a model on meta"):
        cluster.check_device(torch.device("meta"))


# ---- parts at their own pace -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("staleness", [0, 1])
def test_versions_keep_to_the_bound(cluster, small, staleness):
    problem = tiger()
    config = replace(CONFIG, iterations=staleness + 2)
    run = AsynchronousIteration(papi_nt(problem, config, problem.base_policies["myopic"], workers=cluster), staleness)
    iterations = list(run)
    numbers = list(range(1, config.iterations + 1))
    assert [iteration.number for iteration in iterations] == numbers
    made = sorted((version.part, version.number) for version in run.published)
    assert made == [(part, number) for part in range(2) for number in numbers]
    assert all(version.number - 1 - min(version.used) <= staleness for version in run.published)


def test_torchrls_own_collector_takes_rollout_improvement(cluster):
    """Two remote collectors share the work; what they give is what one gives."""
    problem = tiger()
    policy, make = problem.base_policies["myopic"], partial(BeliefEnv, problem.model, problem.start)
    options = {
        "states": PartSampler(dict(enumerate(problem.training)), seed=0),
        "label": partial(RolloutPolicy, trajectories=2),
    }
    sizes = {"frames_per_batch": 32, "total_frames": 64}
    alone = list(RolloutImprovement(make(), policy, **options, **sizes))
    collector = RayCollector(
        [make, make],
        policy,
        collector_class=RolloutImprovement,
        collector_kwargs=[{**options, "num_workers": 2} for _ in range(2)],
        num_collectors=2,
        sync=True,
        remote_configs={"num_cpus": 0.5},
        **sizes,
    )
    collector.update_policy_weights_(policy)
    for one, other in zip(alone, collector, strict=True):
        assert torch.equal(one["collector", "traj_ids"], other.reshape(-1)["collector", "traj_ids"])
        assert torch.equal(one["q_factors"], other.reshape(-1)["q_factors"])
    collector.shutdown(shutdown_ray=False)


def test_it_is_an_extra_that_costs_nothing_otherwise():
    text = "import sys, torchrl_pomdp; print('ray' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", text], capture_output=True, text=True).stdout.strip() == "False"
