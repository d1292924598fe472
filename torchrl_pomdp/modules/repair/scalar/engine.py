"""Compiled simulations of the repair problem, for policies with a scalar twin."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.digits import digits
from torchrl_pomdp.envs.partition import SinglePart
from torchrl_pomdp.envs.repair.model import RepairModel
from torchrl_pomdp.envs.repair.partition import RepairPartition
from torchrl_pomdp.modules.partitioned import PartitionedValue
from torchrl_pomdp.modules.qfactors import check_q_factors
from torchrl_pomdp.modules.repair.scalar.decisions import Decisions, decide
from torchrl_pomdp.modules.repair.scalar.searches import History, repair_model
from torchrl_pomdp.modules.repair.scalar.states import fingerprints, valid
from torchrl_pomdp.modules.repair.scalar.tables import by_location, kinds, make_tables
from torchrl_pomdp.modules.repair.scalar.trajectories import NEVER, Limits, Trajectories, Work, simulate
from torchrl_pomdp.modules.repair.terminal_costs import NeverRepairCost, SteadyStateCost
from torchrl_pomdp.modules.scalar import MOST_NUMBERS, Allocation, Cut, Limited, Roots, ScalarEngine, makeup
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.modules.terminal_costs import ConstantCost, ZeroCost
from torchrl_pomdp.modules.threads import map_threads
from torchrl_pomdp.modules.truncation import AfterSteps, OnEntering, OnLeaving, Truncation
from torchrl_pomdp.scalar.compiling import Loops
from torchrl_pomdp.scalar.twins import ScalarTwin
from torchrl_pomdp.tensor_checks import SUM_TOLERANCE

__all__ = ["RepairEngine", "repair_engine"]

# Rows and states of a call of a compiled loop, which nothing can interrupt.
_ROWS, _STATES = 4096, 256


def repair_engine(
    twin: ScalarTwin,
    data: tuple[Any, ...],
    own: RepairModel,
    model: BeliefModel,
    limits: Limited,
    numbers: int = 1,
    refresh: Callable[[], None] | None = None,
) -> RepairEngine | None:
    """The engine for a policy with a twin; None where the loop does not know what is asked for, and tensors simulate.

    Args:
        twin: the policy.
        data: what the twin reads.
        own: the policy's model.
        model: the model that is simulated; its graph and costs must be the policy's.
        limits: when trajectories end.
        numbers: how many numbers of its own, ``view.work``, the twin needs.
        refresh: called before every simulation, to bring the data up to date.

    Examples:
        A policy of one's own, which goes where it costs most now; ``forward`` and twin choose the same:

        >>> from tensordict.nn import TensorDictModuleBase
        >>> from torchrl_pomdp.modules import TruncatedRollout
        >>> from torchrl_pomdp.modules.repair.scalar import expected_cost
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.scalar import scalar_twin
        >>> @scalar_twin
        ... def costliest(data, view, controls):
        ...     for robot in range(len(controls)):
        ...         origin, best, target = view.location[robot], 0.0, -1
        ...         for place in range(len(view.level)):
        ...             cost = expected_cost(view, place)
        ...             if cost > best:
        ...                 best, target = cost, place
        ...         tables = view.tables
        ...         controls[robot] = tables.first_moves[origin] if target < 0 else tables.first_controls[origin, target]
        >>> class Costliest(TensorDictModuleBase):
        ...     in_keys, out_keys = ["belief", "location"], ["action"]
        ...     def __init__(self, model):
        ...         super().__init__()
        ...         self.model = model
        ...     def scalar_engine(self, model, limits):
        ...         return repair_engine(costliest, (), self.model, model, limits)
        ...     def forward(self, y):
        ...         target = (y["belief"] @ self.model.costs).argmax(-1)
        ...         return y.set("action", self.model.first_controls[y["location"][..., 0], target])
        >>> model = make_problem("linear20").model
        >>> type(TruncatedRollout(model, Costliest(model)).scalar).__name__
        'RepairEngine'
    """
    # By content: a copy of a policy, such as a collector's, has a model of its own.
    if type(model) is not RepairModel or own.num_robots != model.num_robots:
        return None
    if not torch.equal(own.graph.neighbours, model.graph.neighbours) or not _has_costs_of(own, model):
        return None
    rules = () if limits.truncation is None else limits.truncation.rules
    known = all(type(rule) in (AfterSteps, OnEntering, OnLeaving) for rule in rules)
    parted = all(isinstance(rule, AfterSteps) for rule in rules) or type(model.partition) in (RepairPartition, SinglePart)
    table_size = len(kinds(model)[0]) * (limits.max_steps + 2) * model.num_levels**2
    small = table_size <= MOST_NUMBERS and model.num_locations**2 <= MOST_NUMBERS
    if not (known and parted and small):
        return None
    return RepairEngine((twin, data), model, limits, rules, numbers, refresh)


class RepairEngine(ScalarEngine):
    """Simulates trajectories one at a time, on as many threads as there are for PyTorch.

    Attributes:
        closed: whether a cut's terminal cost is known in closed form.
    """

    def __init__(
        self,
        policy: tuple[ScalarTwin, tuple[Any, ...]],
        model: RepairModel,
        limits: Limited,
        rules: Sequence[Truncation],
        numbers: int,
        refresh: Callable[[], None] | None,
    ) -> None:
        self.policy, self.model, self.numbers, self.refresh = policy, model, numbers, refresh
        self._loops = Loops()
        self._spare: list[Work] = []
        # Kept, as to look them up in the model takes time that a single decision feels.
        self._belief_shape, self._location_shape = (model.num_locations, model.num_levels), (model.num_robots,)
        self._dtype, self._largest = model.dtype, float(torch.finfo(model.dtype).max)
        self.tables = make_tables(model, limits.max_steps + 2)
        after = [rule.m for rule in rules if isinstance(rule, AfterSteps)]
        self._varying = [m for m in after if not isinstance(m, int)]
        entering = {part for rule in rules if isinstance(rule, OnEntering) for part in rule.parts}
        parted = isinstance(model.partition, RepairPartition)
        # A single part is entered at once, and never left.
        at_once = [0] if entering and not parted else []
        closed = _closed_form(model, limits.terminal_cost)
        self.closed = closed is not None and not self._varying
        constant, level_costs = closed or (0.0, np.zeros((model.num_locations, 0)))
        self.limits = Limits(
            max_steps=min([limits.max_steps, *at_once, *(m for m in after if isinstance(m, int))]),
            entering=sum(1 << part for part in entering) if parted else 0,
            leaving=parted and any(isinstance(rule, OnLeaving) for rule in rules),
            closed=closed is not None,
            constant=constant,
            level_costs=level_costs,
        )

    # ---- trajectories ------------------------------------------------------------------------------------------------

    def simulate(self, y: TensorDictBase, scenarios: Scenarios, count: int) -> tuple[Tensor, int, Cut | None]:
        """See :class:`ScalarEngine`."""
        self._bring_up_to_date()
        belief, location = self._checked(y)
        # Copies, which the loop overwrites.
        beliefs, locations = belief.astype(np.float64), location.copy()
        after = np.full(len(beliefs), NEVER)
        for m in self._varying:
            after = np.minimum(after, AfterSteps(m).start(self.model.derive(y))[:, 0].numpy())
        keys, groups, members, seen = (np.ascontiguousarray(numbers.numpy()) for numbers in scenarios)
        every = Trajectories(
            beliefs, locations, keys.view(np.uint64), groups.view(np.uint64), members, seen.view(np.uint64), after,
            np.empty(len(beliefs)), np.empty(len(beliefs), np.int64),
        )  # fmt: skip

        def run(rows: slice) -> int:
            steps, wrong = self._call_with_memory(simulate, Trajectories._make(numbers[rows] for numbers in every), count)
            if wrong >= 0:
                self._refuse()
            return int(steps)

        steps = sum(self._threads(run, len(beliefs), _ROWS))
        left = (every.cut >= 0).nonzero()[0]
        return torch.from_numpy(every.total), steps, self._cut(left, every) if len(left) else None

    def _cut(self, rows: NDArray[np.int64], every: Trajectories) -> Cut:
        belief, location, ages = (torch.from_numpy(values[rows]) for values in (every.beliefs, every.locations, every.cut))
        y = TensorDict({"belief": belief.to(self.model.dtype), "location": location}, batch_size=[len(rows)])
        return Cut(torch.from_numpy(rows), ages, y)

    # ---- decisions ---------------------------------------------------------------------------------------------------

    def q_factors(
        self,
        y: TensorDictBase,
        keys: Tensor | None,
        seed: int,
        allocation: Allocation,
        controls: NDArray[np.int64] | None = None,
    ) -> tuple[NDArray[np.float64], int]:
        """See :class:`ScalarEngine`."""
        if allocation.observations:
            self.model.check_observations_enumerable()
        self._bring_up_to_date()
        belief, location = self._checked(y)
        beliefs = belief.astype(np.float64)
        if not self._call(valid, beliefs, location, SUM_TOLERANCE):
            self.model.check_state(y)
        streams = self._keys(belief, location, seed) if keys is None else np.ascontiguousarray(keys.numpy()).view(np.uint64)
        candidates = self._every if controls is None else self._checked_candidates(controls, len(beliefs))
        shape = len(beliefs), candidates.shape[1]
        q = np.empty(shape)

        def run(rows: slice) -> int:
            own, steps = q[rows], 0
            costs, made = np.zeros((len(own), len(allocation.order), shape[1])), np.zeros(own.shape, np.int64)
            legal, rivals = np.zeros((2, *own.shape), np.bool_)
            # A copy: compiled loops take arrays of one layout, and candidates that all states share are laid out here alone.
            tried = candidates.repeat(len(own), 0) if controls is None else np.array(candidates[rows], order="C")
            states = Decisions(beliefs[rows], location[rows], streams[rows], tried, legal, costs, made, rivals, own)
            for i, rounds in enumerate(allocation.stretches()):
                if i and not rivals.any():
                    break
                more, wrong, finite = self._call_with_memory(
                    decide, states, allocation.order, rounds, allocation.observations, allocation.clearly, self._largest
                )
                if wrong >= 0:
                    self._refuse()
                if not finite:
                    check_q_factors(torch.from_numpy(own).to(self._dtype), torch.from_numpy(legal))
                steps += more
            return steps

        # Their trajectories' costs are kept until a state is decided. With a time for each, states are decided one by one.
        block = max(1, min(_STATES, MOST_NUMBERS // (len(allocation.order) * shape[1])))
        return q, sum(self._threads(run, shape[0], block if allocation.seconds is None else 1))

    @cached_property
    def _every(self) -> NDArray[np.int64]:
        """All joint controls, ``[1, U, R]``."""
        numbers = torch.arange(self.model.num_controls).unsqueeze(0)
        every: NDArray[np.int64] = digits(numbers, self.model.num_robot_controls, self.model.num_robots).numpy()
        return every

    def _checked_candidates(self, controls: NDArray[np.int64], count: int) -> NDArray[np.int64]:
        """Candidates ``[N, C, R]`` of so many states; raises unless they fit, which the loop does not check."""
        robots = self.model.num_robots
        if controls.dtype != np.int64 or controls.ndim != 3 or controls.shape[::2] != (count, robots) or not controls.shape[1]:
            raise ValueError(
                f"controls must be int64 of shape ({count}, C, {robots}) with C at least 1, got {controls.dtype} of shape "
                f"{controls.shape}"
            )
        return controls

    def _keys(self, belief: NDArray[Any], location: NDArray[np.int64], seed: int) -> NDArray[np.uint64]:
        # Adding zero turns -0.0, which compares equal to 0.0, into 0.0.
        flat = belief.reshape(len(belief), math.prod(self._belief_shape)) + 0.0
        bits = flat.view(np.int32 if belief.dtype == np.float32 else np.int64)
        keys = np.empty(len(belief), np.uint64)
        self._call(fingerprints, bits, location, np.uint64(seed % (1 << 64)), keys)
        return keys

    # ---- searches ----------------------------------------------------------------------------------------------------

    def roots(self, y: TensorDictBase, seed: int) -> Roots:
        """See :class:`ScalarEngine`."""
        self._bring_up_to_date()
        belief, location = self._checked(y)
        beliefs = belief.astype(np.float64)

        def state(number: int) -> History:
            return History(beliefs[number], location[number], np.zeros(1, np.int64), self._work())

        width = 1 + self.model.num_robots + 2 * self.model.num_locations
        model = repair_model, (self.tables, self.limits)
        least = self.model.num_locations * min(0.0, self.tables.least_cost) / (1.0 - self.model.discount)
        return Roots(model, self.policy, self._keys(belief, location, seed), state, width, least)

    # ---- helpers -----------------------------------------------------------------------------------------------------

    def _bring_up_to_date(self) -> None:
        if self.refresh is not None:
            self.refresh()

    def _checked(self, y: TensorDictBase) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Beliefs ``[N, L, K]`` and locations ``[N, R]`` of states ``[*B]``, state after state; raises unless they fit."""
        check_instance("y", y, TensorDictBase)
        belief, location, shape = y.get("belief", None), y.get("location", None), y.batch_size
        for numbers, dtype, size in ((belief, self._dtype, self._belief_shape), (location, torch.int64, self._location_shape)):
            if not isinstance(numbers, Tensor) or numbers.dtype != dtype or numbers.shape != (*shape, *size):
                self.model.check_state(y)
        # States may lie in planes. A matrix is transposed by tiles; entry by entry that takes half of the time at L = 500.
        beliefs = belief.detach().reshape(-1, math.prod(self._belief_shape)).contiguous().numpy()
        return beliefs.reshape(-1, *self._belief_shape), np.ascontiguousarray(
            location.numpy().reshape(-1, *self._location_shape)
        )

    def _call(self, function: Any, *args: Any) -> Any:
        return self._loops(function, *args)

    def _call_with_memory(self, function: Any, *args: Any) -> Any:
        """Call a compiled loop that simulates, with memory of its own for its time."""
        work = self._spare.pop() if self._spare else self._work()
        try:
            return self._call(function, self.policy, self.tables, self.limits, work, *args)
        finally:
            self._spare.append(work)

    def _work(self) -> Work:
        model = self.model
        size, robots = model.num_locations, model.num_robots
        return Work(
            location=np.empty(robots, np.int64),
            initial=np.empty(size, np.int64),
            level=np.empty(size, np.int64),
            since=np.empty(size, np.int64),
            intact=np.empty(size, np.float32 if self._dtype == torch.float32 else np.float64),
            controls=np.empty(robots, np.int64),
            seen=np.empty(robots, np.int64),
            numbers=np.empty(self.numbers, np.float32),
            row=np.empty(model.num_levels),
        )

    def _threads(self, run: Callable[[slice], int], count: int, block: int) -> list[int]:
        threads = torch.get_num_threads()
        size = max(1, min(block, -(-count // threads)))
        return map_threads(run, [slice(i, min(i + size, count)) for i in range(0, count, size)], threads)

    def _refuse(self) -> None:
        raise ValueError(
            "base_policy chose an illegal control in a simulated trajectory; its scalar twin must choose among the controls "
            "that are legal where the robots are"
        )


def _closed_form(model: RepairModel, terminal_cost: Any) -> tuple[float, NDArray[np.float64]] | None:
    """A terminal cost as a constant and a cost for each level of each location; None where it is none of these."""
    nothing = np.zeros((model.num_locations, 0))
    if makeup(terminal_cost)[1]:
        return None
    parts = 1 if model.partition is None else model.partition.num_parts
    values: Sequence[Any] = list(terminal_cost.values) if type(terminal_cost) is PartitionedValue else []
    if len(values) == parts and len(set(values)) == 1:
        terminal_cost = values[0]
    kind = type(terminal_cost)
    if terminal_cost is None or kind is ZeroCost:
        return 0.0, nothing
    if kind is ConstantCost:
        return terminal_cost.cost, nothing
    if kind is NeverRepairCost:
        costs = torch.as_tensor(terminal_cost.level_costs, dtype=torch.float64)
        # What does not fit, as it is of another model, is refused where tensors compute it.
        fits = costs.shape in ((model.num_levels,), (model.num_locations, model.num_levels))
        return (0.0, by_location(costs, model)) if fits else None
    if kind is SteadyStateCost and _has_costs_of(terminal_cost.model, model):
        return 0.0, by_location(model.costs, model) / (1.0 - model.discount)
    return None


def _has_costs_of(one: RepairModel, other: RepairModel) -> bool:
    return torch.equal(one.costs, other.costs) and one.discount == other.discount
