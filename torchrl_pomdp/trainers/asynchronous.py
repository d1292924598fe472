r"""Asynchronous policy iteration: every part at its own pace (paper, Section V; Bertsekas and Yu, 2010).

A part follows the freshest published networks of all parts, labels states with their rollout, and trains its own network on
them and on mirror images of what other parts have labelled for the same version or a later one. It publishes it as its next
version, and goes on. No part waits for another one but for a bound: it may be at most so many versions ahead.
"""

from __future__ import annotations

import copy
import json
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch

from torchrl_pomdp.checks import check_instance, check_integer
from torchrl_pomdp.collectors.labels import Block
from torchrl_pomdp.evaluation import compare
from torchrl_pomdp.files import check_claimed, claim, read_text, write_json
from torchrl_pomdp.identity import digest
from torchrl_pomdp.kept import keep, kept
from torchrl_pomdp.modules import PartitionedPolicy, PartitionedValue
from torchrl_pomdp.modules.networks import LocalNetwork
from torchrl_pomdp.stopping import Stopped, check_stopped, watching
from torchrl_pomdp.trainers.parts import PartRecord, records_text, text_records
from torchrl_pomdp.trainers.plan import Evaluate, Improve
from torchrl_pomdp.trainers.policy_iteration import Iteration, PolicyIteration, judge

__all__ = ["AsynchronousIteration", "Version"]

# The record of whose folder it is, and which versions are each iteration.
_RECORD, _MET = "asynchronous-iteration.json", "versions.json"
# Seconds that parts which are told to stop are waited for.
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
    """What a part has published; before it has, its own of the base policy and the problem's pessimistic cost."""

    policy: Any
    value: Any
    records: dict[str, PartRecord] = field(default_factory=dict)


@dataclass(frozen=True)
class _Labels:
    """What a part has labelled for its version ``number``, by the step of the plan."""

    number: int = 0
    blocks: list[tuple[int, Block]] = field(default_factory=list)


@dataclass
class _Progress:
    """What the threads of an iteration share, under one lock.

    Attributes:
        networks: all versions of every part.
        labels: the last ones of every part: mirror images of them lie in other parts.
        published: see :class:`AsynchronousIteration`.
        met: the versions that each iteration has, of all parts.
        failure: what has stopped a part.
        stop: tells all to stop.
    """

    networks: list[list[_Networks]]
    labels: list[_Labels]
    published: list[Version] = field(default_factory=list)
    met: list[list[int]] = field(default_factory=list)
    failure: BaseException | None = None
    stop: threading.Event = field(default_factory=threading.Event)

    def versions(self) -> list[int]:
        """The last version of each part."""
        return [len(own) - 1 for own in self.networks]

    def images(self, part: int, number: int, index: int) -> list[tuple[int, Block]]:
        """What other parts have labelled for a step of the plan with mirror images in a part, and not for an older version."""
        others = [(other, own) for other, own in enumerate(self.labels) if other != part and own.number >= number]
        return [(p, block) for p, own in others for at, block in list(own.blocks) if at == index and block.summary[part]]

    def meet(self) -> bool:
        """Note the iterations that all parts have come to; whether there is another one."""
        last, before = self.versions(), len(self.met)
        while len(self.met) < min(last):
            number = len(self.met) + 1
            # What an interrupted run has noted may be lost: then it is not known which versions met, but that they could.
            earlier = self.met[-1] if self.met else [0] * len(last)
            self.met.append(last if number == min(last) else [max(number, own) for own in earlier])
        return len(self.met) > before


class AsynchronousIteration:
    r"""Policy iteration whose parts do not wait for each other.

    The networks of every part have a version, 0 for the base policy. To make version :math:`v+1` a part labels with the
    versions :math:`v_q` of the others that are there when it begins, each at least :math:`v` less ``staleness``, and at least 1
    where its simulations end with value networks of theirs. When the last
    part publishes its version k, the freshest networks of all parts together are iteration k: they are compared with
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
        self.best = iteration.best
        self.published: list[Version] = []
        self._changed = threading.Condition()
        # No more parts train at once than where they do not go at their own pace.
        self._trainers = threading.BoundedSemaphore(iteration.workers.num_workers)

    def _start(self) -> _Progress:
        run = self.run
        run._start()
        base = [_Networks(policy, run._scale) for policy in run._base]
        state = _Progress([[own] for own in base], [_Labels() for _ in base])
        self.best, self.published = run.best, state.published
        return state

    def __iter__(self) -> Iterator[Iteration]:
        """Carry out the iterations: yields one for each time that all parts have come further."""
        run, state = self.run, self._start()
        if run.folder is not None:
            self._restore(run.folder, state)
        best_costs = run._validate(run.base_policy, "base policy")
        run._visit(run.base_policy, 0)
        for version in list(state.published):
            self._visit_again(version, state)
        threads = [
            threading.Thread(target=self._improve, args=(part, state), daemon=True) for part in range(len(state.networks))
        ]
        for thread in threads:
            thread.start()
        before = [0] * len(threads)
        try:
            for number in range(1, run.config.iterations + 1):
                met = self._meet(number, state)
                networks = [own[version] for own, version in zip(state.networks, met, strict=True)]
                policy = PartitionedPolicy([own.policy for own in networks]).eval()
                value = PartitionedValue([own.value for own in networks]).eval()
                costs = run._validate(policy, f"iteration {number}")
                comparison = compare(costs, best_costs)
                accepted, reason = judge(comparison)
                if accepted:
                    self.best, best_costs = policy, costs
                since = [own[first + 1 : last + 1] for own, first, last in zip(state.networks, before, met, strict=True)]
                records = {name: record for own in since for made in own for name, record in made.records.items()}
                before = met
                yield Iteration(number, policy, value, accepted, reason, comparison, records)
        finally:
            with self._changed:
                state.stop.set()
                self._changed.notify_all()
            until = time.monotonic() + _PATIENCE
            for thread in threads:
                thread.join(max(0.0, until - time.monotonic()))

    def _visit_again(self, version: Version, state: _Progress) -> None:
        """Remember the states that a part has visited for a version that an interrupted run has kept."""
        if version.number > 1:
            # Versions of other parts that are lost are made again: then the last ones there are.
            used = [own[min(number, len(own) - 1)].policy for own, number in zip(state.networks, version.used, strict=True)]
            self.run._visit(PartitionedPolicy(used), version.number - 1, version.part)

    def _meet(self, number: int, state: _Progress) -> list[int]:
        """The versions that are an iteration, once all parts have come that far."""
        with self._changed:
            self._changed.wait_for(lambda: state.failure is not None or len(state.met) >= number)
            if len(state.met) < number and state.failure is not None:
                raise state.failure
            return state.met[number - 1]

    def _may_begin(self, part: int, number: int, state: _Progress) -> bool:
        """Whether a part may begin to make a version, or is to stop."""
        if state.stop.is_set():
            return True
        versions = state.versions()
        return number - 1 - min(versions) <= self.staleness and all(versions[other] for other in self._read_by(part))

    def _read_by(self, part: int) -> set[int]:
        """Parts where simulations from a part end with value networks of theirs: there must be some."""
        found: set[int] = set()
        valued: set[int] = set()
        for step in self.run.plan:
            if part in step.parts and step.truncation is not None:
                found |= valued
            if isinstance(step, Evaluate):
                valued |= set(step.parts)
        return found - {part}

    # ---- a part ------------------------------------------------------------------------------------------------------

    def _improve(self, part: int, state: _Progress) -> None:
        """Make the versions of a part, in a thread of its own."""
        try:
            for number in range(len(state.networks[part]), self.run.config.iterations + 1):
                with self._changed:
                    self._changed.wait_for(partial(self._may_begin, part, number, state))
                    used = state.versions()
                    freshest, state.labels[part] = [own[-1] for own in state.networks], _Labels(number)
                with watching(state.stop):
                    networks = self._version(part, number, freshest, state)
                with self._changed:
                    # Who was told to stop meanwhile leaves the folder to others.
                    if state.stop.is_set():
                        return
                    version = Version(part, number, tuple(used))
                    self._keep(version, networks)
                    state.networks[part].append(networks)
                    state.published.append(version)
                    if state.meet():
                        self._note(state)
                    self._changed.notify_all()
        except Stopped:
            return
        except BaseException as error:
            with self._changed:
                state.failure = error
                self._changed.notify_all()

    def _version(self, part: int, number: int, freshest: list[_Networks], state: _Progress) -> _Networks:
        """Networks that a part learns from the freshest of all parts."""
        check_stopped()
        run, records = self.run, {}
        local, values = [own.policy for own in freshest], [own.value for own in freshest]
        if number > 1:
            # Where the policy goes now. The base policy's states are there from the beginning.
            run._visit(PartitionedPolicy(local), number - 1, part)
        for index, step in enumerate(run.plan):
            if part not in step.parts:
                continue
            name = f"{run._name(number, index)}-part-{part}"
            network = run._initial(index, part, local, values, number)
            # What an interrupted run has labelled it has labelled with other networks: nothing is kept of it.
            collector = run._collector(index, PartitionedPolicy(local), PartitionedValue(values), number, None, part)
            # A copy, encoder and all: a training takes modules apart that other parts read.
            training = run._training(index, part, copy.deepcopy(network), number)
            for block in collector.blocks(run.workers, run._images.counts):
                check_stopped()
                if sum(block.summary) > block.summary[part]:
                    state.labels[part].blocks.append((index, block))
                if block.summary[part]:
                    training.add(part, block.handle)
            for other, block in state.images(part, number, index):
                training.add(other, block.handle)
            with self._trainers:
                check_stopped()
                trained = run.workers.trained({part: training})[part]
            network.load_state_dict(trained.weights)
            (local if isinstance(step, Improve) else values)[part] = network.eval()
            records[name] = PartRecord.of(collector, trained)
        return _Networks(local[part], values[part], records)

    # ---- the folder --------------------------------------------------------------------------------------------------

    def _path(self, part: int, number: int) -> Path | None:
        return None if self.run.folder is None else self.run.folder / f"part-{part}" / f"version-{number}.pt"

    def _note(self, state: _Progress) -> None:
        """Note which versions are an iteration."""
        if self.run.folder is not None:
            check_claimed(self.run.folder / _RECORD)
            write_json(self.run.folder / _MET, state.met)

    def _keep(self, version: Version, networks: _Networks) -> None:
        path = self._path(version.part, version.number)
        if path is None:
            return
        check_claimed(path.parents[1] / _RECORD)
        content = {
            "policy": networks.policy.state_dict() if isinstance(networks.policy, LocalNetwork) else {},
            "value": networks.value.state_dict() if isinstance(networks.value, LocalNetwork) else {},
            "records": records_text(networks.records),
            "used": torch.tensor(version.used),
        }
        keep(path, f"{self._owner} {version.part} {version.number}", content)

    def _restore(self, folder: Path, state: _Progress) -> None:
        """Take the folder, and what an interrupted run has kept there."""
        record = {**self.run._identity(), "staleness": self.staleness}
        claim(folder / _RECORD, record)
        self._owner = digest(record)
        for part, own in enumerate(state.networks):
            while (found := self._kept(part, len(own), own[-1])) is not None:
                version, networks = found
                own.append(networks)
                state.published.append(version)
        last = state.versions()
        for number, versions in enumerate(_noted(folder / _MET), 1):
            # What is lost is made again.
            if len(versions) != len(last) or not all(number <= own <= there for own, there in zip(versions, last, strict=True)):
                break
            state.met.append(versions)
        if state.meet():
            self._note(state)

    def _kept(self, part: int, number: int, before: _Networks) -> tuple[Version, _Networks] | None:
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
        return Version(part, number, tuple(content["used"].tolist())), _Networks(
            local[part], values[part], text_records(content["records"])
        )


def _noted(path: Path) -> list[list[int]]:
    """The versions of each iteration as a file has them; none where it is damaged."""
    try:
        found = json.loads(read_text(path)) if path.is_file() else []
    except (ValueError, OSError):
        return []
    sound = isinstance(found, list) and all(isinstance(own, list) and all(type(v) is int for v in own) for own in found)
    return found if sound else []
