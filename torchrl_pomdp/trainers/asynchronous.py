r"""Asynchronous policy iteration: every part at its own pace (paper, Section V; Bertsekas and Yu, 2010).

A part labels states with the rollout of the freshest published networks of all parts, trains its own on them, publishes them as
its next version, and goes on. No part waits for another one but for a bound: it may be at most so many versions ahead.
"""

from __future__ import annotations

import copy
import json
import shutil
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch

from torchrl_pomdp.checks import check_instance, check_integer
from torchrl_pomdp.evaluation import compare
from torchrl_pomdp.files import check_claimed, claim, read_text, write_json
from torchrl_pomdp.identity import digest
from torchrl_pomdp.kept import keep, kept
from torchrl_pomdp.modules import PartitionedPolicy, PartitionedValue
from torchrl_pomdp.modules.networks import LocalNetwork
from torchrl_pomdp.trainers.parts import PartRecord
from torchrl_pomdp.trainers.plan import Improve
from torchrl_pomdp.trainers.policy_iteration import Iteration, PolicyIteration, judge

__all__ = ["AsynchronousIteration", "Version"]

# The record of whose folder it is, and which versions are each iteration.
_RECORD, _MET = "asynchronous-iteration.json", "versions.json"
# Seconds that a part which is told to stop is waited for.
_PATIENCE = 5.0


@dataclass(frozen=True)
class Version:
    """Networks that a part has published.

    Attributes:
        part: the part.
        number: of the version, from 1.
        used: versions of all parts with which its states were labelled.
    """

    part: int
    number: int
    used: tuple[int, ...]


@dataclass(frozen=True)
class _Networks:
    """What a part has published; before it has, its base policy and the problem's pessimistic cost."""

    policy: Any
    value: Any
    records: dict[str, PartRecord] = field(default_factory=dict)


class AsynchronousIteration:
    r"""Policy iteration whose parts do not wait for each other.

    The networks of every part have a version, 0 for the base policy. To make version :math:`v+1` a part labels with the
    versions :math:`v_q` of the others that are there when it begins, each at least :math:`v` less ``staleness``. Whenever the
    last part has published its version k, the freshest networks of all parts together are iteration k: they are compared with
    the best policy so far, and kept if they are better with confidence, as in :class:`PolicyIteration`. Which networks meet
    depends on time: a seed does not give the same result again.

    With a folder every version is kept there, and a run that was interrupted goes on from the last ones.

    Args:
        iteration: the problem, numbers, plan, folder and workers; steps of the plan that are for several parts are carried out
            for each by itself.
        staleness: how many versions a part may be ahead of the last one, 0 for none.

    Attributes:
        best: the best policy so far.
        published: what the parts have published, in the order in which they did; first, by part, what an interrupted run has.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``staleness`` is negative; when iterated, as by :class:`PolicyIteration`.

    Examples:
        >>> from torchrl_pomdp.config import PolicyIterationConfig
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.trainers import papi_nt
        >>> problem = make_problem("line3")
        >>> config = PolicyIterationConfig(iterations=2, samples_per_part=40, least_steps=1, validation_states=50)
        >>> run = AsynchronousIteration(papi_nt(problem, config, problem.base_policies["greedy"]), staleness=1)
        >>> [iteration.number for iteration in run], len(run.published)
        ([1, 2], 12)
        >>> all(version.number - 1 - min(version.used) <= 1 for version in run.published)
        True
    """

    def __init__(self, iteration: PolicyIteration, staleness: int = 1) -> None:
        self.run = check_instance("iteration", iteration, PolicyIteration)
        self.staleness = check_integer("staleness", staleness, 0, 10**6)
        self.plan, self.best = iteration.plan, iteration.best
        self.published: list[Version] = []
        self._changed = threading.Condition()
        self._start()

    def _start(self) -> None:
        run = self.run
        run._start()
        self.best, self.published = run.best, []
        # All versions of every part, and those of each iteration.
        self._networks = [[_Networks(run.base_policy, run._scale)] for _ in range(run.partition.num_parts)]
        self._met: list[list[int]] = []
        self._failure: BaseException | None = None
        self._stopped = False

    def __iter__(self) -> Iterator[Iteration]:
        """Carry out the iterations: yields one whenever all parts have a next version."""
        run = self.run
        self._start()
        if run.folder is not None:
            self._restore(run.folder)
        best_costs = run._validate(run.base_policy, "base policy")
        run._visit(run.base_policy, 0)
        run._make_encoders()
        threads = [threading.Thread(target=self._improve, args=(part,), daemon=True) for part in range(len(self._networks))]
        for thread in threads:
            thread.start()
        try:
            for number in range(1, run.config.iterations + 1):
                met = self._meet(number)
                networks = [own[version] for own, version in zip(self._networks, met, strict=True)]
                policy = PartitionedPolicy([own.policy for own in networks]).eval()
                value = PartitionedValue([own.value for own in networks]).eval()
                costs = run._validate(policy, f"iteration {number}")
                comparison = compare(costs, best_costs)
                accepted, reason = judge(comparison)
                if accepted:
                    self.best, best_costs = policy, costs
                if number < run.config.iterations:
                    run._visit(policy, number)
                records = {name: record for own in networks for name, record in own.records.items()}
                yield Iteration(number, policy, value, accepted, reason, comparison, records)
        finally:
            with self._changed:
                self._stopped = True
                self._changed.notify_all()
            for thread in threads:
                thread.join(_PATIENCE)

    def _versions(self) -> list[int]:
        """The last version of each part."""
        return [len(own) - 1 for own in self._networks]

    def _meet(self, number: int) -> list[int]:
        """The versions that are an iteration, once all parts have come that far."""
        if number > len(self._met):
            with self._changed:
                self._changed.wait_for(lambda: self._failure is not None or min(self._versions()) >= number)
                if self._failure is not None:
                    raise self._failure
                self._met.append(self._versions())
            self._note()
        return self._met[number - 1]

    def _may_begin(self, number: int) -> bool:
        """Whether a part may begin to make a version, or is to stop."""
        return self._stopped or number - 1 - min(self._versions()) <= self.staleness

    # ---- a part ------------------------------------------------------------------------------------------------------

    def _improve(self, part: int) -> None:
        """Make the versions of a part, in a thread of its own."""
        try:
            for number in range(len(self._networks[part]), self.run.config.iterations + 1):
                with self._changed:
                    self._changed.wait_for(partial(self._may_begin, number))
                    used = self._versions()
                    freshest = [own[-1] for own in self._networks]
                networks = None if self._stopped else self._version(part, number, freshest)
                if networks is None:
                    return
                version = Version(part, number, tuple(used))
                self._keep(version, networks)
                with self._changed:
                    self._networks[part].append(networks)
                    self.published.append(version)
                    self._changed.notify_all()
        except BaseException as error:
            with self._changed:
                self._failure = error
                self._changed.notify_all()

    def _version(self, part: int, number: int, freshest: list[_Networks]) -> _Networks | None:
        """Networks that a part learns from the freshest of all parts; None if it has been stopped."""
        run, records = self.run, {}
        local, values = [own.policy for own in freshest], [own.value for own in freshest]
        for index, step in enumerate(run.plan):
            if part not in step.parts:
                continue
            name, path = f"{run._name(number, index)}-part-{part}", self._path(part, number)
            network = run._initial(index, part, local, values, number)
            cache = None if path is None else path.with_name(f"version-{number}-{index + 1}.labels")
            collector = run._collector(index, PartitionedPolicy(local), PartitionedValue(values), number, cache, part)
            # A copy, encoder and all: a training takes modules apart that other parts read.
            training = run._training(index, part, copy.deepcopy(network), number)
            for block in collector.blocks(run.workers, run._images.counts):
                if self._stopped:
                    return None
                if block.summary[part]:
                    training.add(part, block.handle)
            trained = run.workers.trained({part: training})[part]
            network.load_state_dict(trained.weights)
            (local if isinstance(step, Improve) else values)[part] = network.eval()
            records[name] = PartRecord.of(collector, trained)
            if cache is not None:
                shutil.rmtree(cache, ignore_errors=True)
        return _Networks(local[part], values[part], records)

    # ---- the folder --------------------------------------------------------------------------------------------------

    def _path(self, part: int, number: int) -> Path | None:
        return None if self.run.folder is None else self.run.folder / f"part-{part}" / f"version-{number}.pt"

    def _note(self) -> None:
        """Note which versions are an iteration."""
        if self.run.folder is not None:
            check_claimed(self.run.folder / _RECORD)
            write_json(self.run.folder / _MET, self._met)

    def _keep(self, version: Version, networks: _Networks) -> None:
        path = self._path(version.part, version.number)
        if path is None:
            return
        check_claimed(path.parents[1] / _RECORD)
        content = {
            "policy": networks.policy.state_dict() if isinstance(networks.policy, LocalNetwork) else {},
            "value": networks.value.state_dict() if isinstance(networks.value, LocalNetwork) else {},
            "records": json.dumps({name: record.to_dict() for name, record in networks.records.items()}),
            "used": torch.tensor(version.used),
        }
        keep(path, f"{self._owner} {version.part} {version.number}", content)

    def _restore(self, folder: Path) -> None:
        """Take the folder, and what an interrupted run has kept there."""
        record = {**self.run._identity(), "staleness": self.staleness}
        claim(folder / _RECORD, record)
        self._owner = digest(record)
        for part, own in enumerate(self._networks):
            while (networks := self._kept(part, len(own), own[-1])) is not None:
                own.append(networks)
        met = folder / _MET
        for versions in json.loads(read_text(met)) if met.is_file() else []:
            if all(version < len(own) for version, own in zip(versions, self._networks, strict=True)):
                self._met.append(versions)

    def _kept(self, part: int, number: int, before: _Networks) -> _Networks | None:
        """A version of a part that was kept, given the one before."""
        path = self._path(part, number)
        content = None if path is None else kept(path, f"{self._owner} {part} {number}", self.run.problem.model.device)
        if content is None:
            return None
        # Networks begin as those before, or as new ones.
        parts = range(self.run.partition.num_parts)
        local, values = [before.policy for _ in parts], [before.value for _ in parts]
        for index, step in enumerate(self.run.plan):
            if part in step.parts:
                mine, key = (local, "policy") if isinstance(step, Improve) else (values, "value")
                mine[part] = self.run._initial(index, part, local, values, number).eval()
                mine[part].load_state_dict(content[key])
        records = {name: PartRecord(**record) for name, record in json.loads(content["records"]).items()}
        self.published.append(Version(part, number, tuple(content["used"].tolist())))
        return _Networks(local[part], values[part], records)
