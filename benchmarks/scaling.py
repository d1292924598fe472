"""Policy iteration on Ray: what it costs here, and by discrete events what a cluster would make of it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import astuple, dataclass, replace
from functools import partial
from pathlib import Path
from threading import Event, Thread

import torch

from benchmarks.cluster import Costs, simulate
from benchmarks.harness import Table, seconds, threads
from benchmarks.setting import linear20, networks
from torchrl_pomdp.collectors import PartSampler, RolloutImprovement, labels
from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.modules import RolloutPolicy
from torchrl_pomdp.objectives import ClassificationLoss
from torchrl_pomdp.trainers import make_networks
from torchrl_pomdp.trainers.parts import PartImages, PartJob
from torchrl_pomdp.workers import LOCAL, Workers

# A step of the startgame of linear20: its parts, the labelled states of each, and those of a task.
PARTS, STATES, BLOCK = 3, 16_384, 2048
CONFIG = PolicyIterationConfig(samples_per_part=STATES, epochs=1, least_steps=600)
# Of a cluster: 10 Gbit/s into each machine.
BANDWIDTH = 1.25e9


def scaling(table: Table) -> None:
    """Labels of a network's rollout (2 trajectories) and training of three parts on Ray, one thread a worker."""
    from torchrl_pomdp.distributed import RayWorkers

    runs: dict[int, list[_Run]] = {0: [], 1: [], 2: []}
    measured: list[Costs] = []
    with threads(1):
        for repeat, count in enumerate((1, 2, 1, 2)):
            with RayWorkers(num_workers=count) as workers:
                # Processes start, and compiled loops are read.
                _step(workers, BLOCK)
                runs[count].append(_step(workers))
                measured.append(_measure(workers, table if repeat == 3 else Table()))
            if count == 1:
                runs[0].append(_step(LOCAL))
        # The least counts: what others do on the machine only slows it down.
        least = {count: min(own, key=lambda run: run.whole) for count, own in runs.items()}
        costs = Costs(*(min(values) for values in zip(*map(astuple, measured), strict=True)))
        costs = _compare(least, costs, table)
    _extrapolate(costs, table)


@dataclass(frozen=True)
class _Run:
    """Seconds of a real step: until its labels are there, in all, of a block of labels, and of an optimisation step."""

    labelled: float
    whole: float
    compute: float
    step: float


def _collectors(states: int = STATES) -> dict[int, RolloutImprovement]:
    problem, policy = linear20(), networks()
    return {
        part: RolloutImprovement(
            BeliefEnv(problem.model, problem.start),
            policy,
            states=PartSampler({part: problem.training[part]}, seed=part),
            label=partial(RolloutPolicy, trajectories=2),
            frames_per_batch=states,
        )
        for part in range(PARTS)
    }


def _step(workers: Workers, states: int = STATES) -> _Run:
    """Carry out a step."""
    images = PartImages(linear20().partition, linear20().symmetries)
    begin = time.perf_counter()
    trainings = {}
    for part in range(PARTS):
        job = PartJob(part, f"part {part}", part, networks().policies[part], ClassificationLoss, images, CONFIG)
        trainings[part] = workers.training(job, None, False)
    collectors = _collectors(states)
    blocks = {part: collector.blocks(workers, images.counts) for part, collector in collectors.items()}
    for part, own in blocks.items():
        for block in own:
            for other, training in trainings.items():
                if block.summary[other]:
                    training.add(part, block.handle)
    labelled = time.perf_counter() - begin
    trained = workers.trained(trainings)
    whole = time.perf_counter() - begin
    compute = sum(collector.seconds for collector in collectors.values()) * BLOCK / (PARTS * states)
    return _Run(labelled, whole, compute, sum(own.seconds for own in trained.values()) / (PARTS * CONFIG.least_steps))


def _nothing(shared: object, item: object) -> tuple[None, None]:
    return None, None


def _measure(workers: Workers, table: Table) -> Costs:
    """Costs of the parts of a step."""
    import ray

    problem, images = linear20(), PartImages(linear20().partition, linear20().symmetries)
    collector = _collectors()[0]
    shared = problem.model, collector.labeller, collector.states, images.counts
    block, _ = labels.label_states(shared, torch.arange(BLOCK))
    compute = seconds(lambda: labels.label_states(shared, torch.arange(BLOCK)))[0]
    list(workers.tasks(_nothing, None, range(20), str))
    begin, count = time.perf_counter(), 500
    results = workers.tasks(_nothing, None, range(count), str)
    list(results)
    each = (time.perf_counter() - begin) / count
    job = PartJob(0, "part", 0, networks().policies[0], ClassificationLoss, images, replace(CONFIG, least_steps=100, epochs=1))
    data = job.open()
    begin = time.perf_counter()
    for _ in range(4):
        data.add(0, block)
    add = (time.perf_counter() - begin) / 4
    trained = job.train(data, None, False)
    steps = 100
    reference = ray.put(block)
    fetch = seconds(lambda: ray.get(reference))[0]
    weights = ray.put(networks())
    reach = seconds(lambda: ray.get(_reach(ray).remote([weights])), repeats=9)[0]
    nothing = seconds(lambda: ray.get(_reach(ray).remote([])), repeats=9)[0]
    table.add(f"label a block of {BLOCK} states, one core", compute, "s")
    table.add("a task that does nothing, driver and two workers", 1e3 * each, "ms")
    table.add("a block of labels", block.bytes() / 1e6, "MB")
    table.add("fetch a block from another process", 1e3 * fetch, "ms")
    table.add("take a block in, with its mirror images", 1e3 * add, "ms")
    table.add("an optimisation step of 256 states", 1e3 * trained.seconds / steps, "ms")
    table.add("weights of six networks reach a worker", 1e3 * (reach - nothing), "ms", "<= 50")
    return Costs(each / 2, each / 2, compute, add + fetch, trained.seconds / steps, float(block.bytes()))


def _reach(ray):
    def read(references: list) -> int:
        return sum(1 for reference in references if ray.get(reference) is not None)

    return ray.remote(read)


def _compare(runs: dict[int, _Run], costs: Costs, table: Table) -> Costs:
    """Real steps beside simulated ones, and beside those of one process; the costs when both cores are busy.

    A machine's speed changes from minute to minute, so the workers' own costs are those of the step itself.
    """
    blocks = -(-STATES // BLOCK)
    for count, run in runs.items():
        name = f"{count} worker{'s' if count > 1 else ''}" if count else "one process"
        table.add(f"a step, {name}", run.whole, "s")
        table.add(f"a block of labels in it, {name}", run.compute, "s")
        table.add(f"an optimisation step in it, {name}", 1e3 * run.step, "ms")
        if count:
            costs = replace(costs, compute=run.compute, step=run.step)
            found = simulate(costs, count, PARTS, blocks, CONFIG.least_steps)
            table.add(f"a step, simulated over measured, {name}", found.seconds / run.whole, "ratio", "0.85 … 1.15")
    table.add("labelling throughput, two workers over one", runs[1].labelled / runs[2].labelled, "ratio", ">= 1.7")
    table.add("time of a step, one worker over one process with one thread", runs[1].whole / runs[0].whole, "ratio", "<= 1.10")
    return costs


def _extrapolate(costs: Costs, table: Table) -> None:
    """Steps of the paper's size on clusters: 200 000 labelled states for each part, six epochs; half the parts in a step."""
    blocks, steps = -(-200_000 // BLOCK), 6 * 2 * 200_000 // 256
    wide = replace(costs, bandwidth=BANDWIDTH)
    curves = {}
    for parts in (6, 60, 1000):
        one = simulate(wide, 1, parts // 2, blocks, steps)
        curves[parts] = {}
        for workers in (2**i for i in range(11)):
            found = simulate(wide, workers, parts // 2, blocks, steps)
            curves[parts][workers] = one.seconds / found.seconds
            if workers in (16, 196, 1024) or workers == 128:
                table.add(f"simulated speed-up, {parts} parts, {workers} workers", curves[parts][workers], "ratio")
        last = simulate(wide, 1024, parts // 2, blocks, steps)
        table.add(f"labels through the driver if they are kept, {parts} parts", last.driver_bytes / 1e9, "GB")
        table.add(f"labels that an actor receives, {parts} parts", last.actor_bytes / 1e9, "GB")
    _draw(curves)


def disk(table: Table) -> None:
    """Training on labelled states of linear20 beyond memory: what is not mapped to disk, from 10^5 to 10^7 states."""
    problem = linear20()
    images = PartImages(problem.partition, problem.symmetries[:1])
    policy = RolloutPolicy(problem.model, problem.base_policies["greedy"], trajectories=2)
    block = policy(problem.model.derive(problem.training[1](torch.arange(16_000))))
    config = PolicyIterationConfig(samples_per_part=1, epochs=1, least_steps=1, batch_size=10_000)
    for count in (10**5, 10**6, 10**7):
        network = make_networks(problem, config, seed=0).policies[1]
        job = PartJob(1, "part 1", 0, network, ClassificationLoss, images, config)
        before, data = _private(), job.open()
        with _peak() as peak:
            for _ in range(count // len(block)):
                data.add(1, block)
            data.add(1, block[: count % len(block)])
            size = data._bytes
            job.train(data, None, False)
        table.add(f"memory for {count:,} labelled states of {size / count:.0f} bytes", (peak[0] - before) / 2**30, "GiB")


def _private() -> int:
    """Bytes of this process that are no mapped files."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("RssAnon"))


@contextmanager
def _peak() -> Iterator[list[int]]:
    """The largest that it has been, looked at ten times a second."""
    found, done = [_private()], Event()

    def look() -> None:
        while not done.wait(0.1):
            found[0] = max(found[0], _private())

    thread = Thread(target=look, daemon=True)
    thread.start()
    try:
        yield found
    finally:
        done.set()
        thread.join()


def _draw(curves: dict[int, dict[int, float]]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 3.4), layout="constrained", dpi=120)
    axes = figure.add_subplot()
    for (parts, curve), color, marker in zip(curves.items(), ("#3572a5", "#c2571a", "#2f7d4f"), "os^", strict=True):
        axes.loglog(list(curve), list(curve.values()), marker=marker, color=color, label=f"{parts} parts", base=2)
    ideal = next(iter(curves.values()))
    axes.loglog(list(ideal), list(ideal), "--", color="#9aa5b1", label="ideal", base=2)
    axes.set(xlabel="workers", ylabel="speed-up of a step", title="simulated from costs measured on two cores")
    ticks = list(ideal)[::2]
    axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
    axes.set_yticks(ticks, [f"{tick:,}" for tick in ticks])
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(Path(__file__).parent / "scaling.png")
