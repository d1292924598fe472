r"""The rollout engine: Monte-Carlo estimates of :math:`(T_\mu^m\hat J)(y)` (paper, Section III)."""

from __future__ import annotations

from threading import Lock
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_flag, check_instance, check_integer
from torchrl_pomdp.envs.belief_model import INSIGNIFICANT, BeliefModel
from torchrl_pomdp.envs.rows import put_rows, take_rows
from torchrl_pomdp.modules.compiling import compiled
from torchrl_pomdp.modules.own import MakesItsOwn
from torchrl_pomdp.modules.policies import (
    Policy,
    TerminalCost,
    check_finite,
    check_policy,
    controls_of,
    read_by,
    terminal_costs,
)
from torchrl_pomdp.modules.scalar import Limited, ScalarEngine, makeup, scalar_engine
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.modules.threads import rows_at_once
from torchrl_pomdp.modules.truncation import Truncation
from torchrl_pomdp.stopping import check_stopped
from torchrl_pomdp.tensor_checks import check_keys

__all__ = ["MAX_STEPS", "MAX_TRAJECTORIES", "TruncatedRollout", "check_max_steps"]

# Default of `chunk_rows` on a CPU. No power of two: planes that lie so far apart compete for cache lines.
_CHUNK_ROWS = 16_000
# Longest simulation and most trajectories of an estimate: there are tables of the one, and numbers of 24 bits for the other.
MAX_STEPS, MAX_TRAJECTORIES = 1_000_000, 1 << 24
# States at which the first controls of a policy are checked.
_CHECKED = 256
# Finished rows give way to waiting ones when they are this fraction of the live rows; doing it more often costs more copies.
_RENEW_FRACTION = 0.15


class _Live(NamedTuple):
    """The trajectories that are simulated now.

    Features, noise, number in the batch, steps made, whether it has ended, and what the truncation rule remembers.
    """

    y: TensorDictBase
    scenarios: Scenarios
    number: Tensor
    age: Tensor
    ended: Tensor
    memory: Tensor

    def rows(self, chosen: Tensor) -> _Live:
        index = chosen.nonzero().squeeze(-1)
        return _Live(take_rows(self.y, index), self.scenarios.rows(index), *(mine[index] for mine in self[2:]))

    def replace_rows(self, index: Tensor, other: _Live) -> _Live:
        rest = (mine.index_copy(0, index, theirs) for mine, theirs in zip(self[2:], other[2:], strict=True))
        return _Live(put_rows(self.y, index, other.y), self.scenarios.replace_rows(index, other.scenarios), *rest)


class TruncatedRollout(MakesItsOwn):
    r"""Discounted cost of following a base policy from given feature states, one trajectory each.

    :math:`\sum_{k<m}\alpha^k\hat g(y_k,\mu(y_k))+\alpha^m\hat J(y_m)`; a trajectory that reaches a terminal state ends
    there without further cost. The stage cost is the belief's expectation, not a realised cost. m is ``max_steps``, or less
    where a truncation rule says so: it may depend on the state.

    At most ``chunk_rows`` trajectories are simulated at a time. As they finish, waiting ones take their place, so that
    every step works on a full chunk whatever the trajectories' lengths. Where model and policy offer it, on a CPU with numba,
    a compiled loop simulates them one by one instead: far faster, with the same noise, and the same costs up to rounding.

    Args:
        model: the belief model.
        base_policy: :math:`\mu`.

    Keyword Args:
        max_steps: the largest m; None: as the discount asks for, see :attr:`BeliefModel.horizon`.
        truncation: rule that cuts trajectories earlier, see :mod:`~torchrl_pomdp.modules.truncation`; None: never.
        terminal_cost: :math:`\hat J`, added at the cut. None leaves the rest out, which is refused unless only
            ``max_steps`` cuts and discounting has made the rest insignificant by then, :math:`\alpha^m\le 0.018`.
        chunk_rows: largest number of trajectories simulated at once; bounds the memory, never changes the result. None:
            16 000 on a CPU, 256 000 on an accelerator. On a CPU powers of two are slower: planes that lie so far apart
            compete for the same lines of the cache.
        compile: whether to fuse policy and belief step by ``torch.compile``, see :func:`~.compiling.compiled`; worth its
            time for long runs with simple base policies, such as RockSample's. Not used where the compiled loop simulates.

    Attributes:
        simulated_steps: belief steps made so far.
        scalar: the compiled loop that simulates; None: tensors do.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``max_steps`` or ``chunk_rows`` is not positive, if a cut needs a terminal cost and there is none, or if
            the truncation rule does not fit the model; when called, if a state does not fit the model, if the policy's first
            controls are illegal, or if a cost is not finite.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> problem = make_problem("line3")
        >>> cost = TruncatedRollout(problem.model, GreedyRepair(problem.model))
        >>> keys = torch.arange(2000)
        >>> bool((cost(problem.start(keys), keys).mean() - 195).abs() < 10)
        True

        The same cost on average, cut at the endgame where the rest is simulated as terminal cost:

        >>> from torchrl_pomdp.modules import OnEntering
        >>> problem = make_problem("linear20")
        >>> greedy, keys = GreedyRepair(problem.model), torch.arange(4000)
        >>> cost = TruncatedRollout(problem.model, greedy)
        >>> rest = lambda y: cost(y, problem.model.fingerprint(y))
        >>> cut = TruncatedRollout(problem.model, greedy, truncation=OnEntering((3, 4, 5)), terminal_cost=rest)
        >>> y = problem.start(keys)
        >>> bool((cut(y, keys).mean() / cost(y, keys).mean() - 1).abs() < 0.01)
        True
    """

    _OWN = frozenset({"_lock", "_makeup", "_transition", "scalar", "simulated_steps"})

    _discounts: Tensor

    def __init__(
        self,
        model: BeliefModel,
        base_policy: Policy,
        *,
        max_steps: int | None = None,
        truncation: Truncation | None = None,
        terminal_cost: TerminalCost | None = None,
        chunk_rows: int | None = None,
        compile: bool = False,
    ) -> None:
        super().__init__()
        check_instance("model", model, BeliefModel)
        check_policy("base_policy", base_policy, model)
        max_steps = check_max_steps(max_steps, model)
        chunk_rows = rows_at_once(_CHUNK_ROWS, model.device) if chunk_rows is None else chunk_rows
        chunk_rows = check_integer("chunk_rows", chunk_rows, 1)
        if truncation is not None:
            check_instance("truncation", truncation, Truncation).check_model(model)
        if terminal_cost is None:
            _check_rest(model, max_steps, truncation)
        else:
            check_policy("terminal_cost", terminal_cost, model)
        self.model, self.base_policy, self.truncation = model, base_policy, truncation
        self._max_steps, self.terminal_cost, self.chunk_rows = max_steps, terminal_cost, chunk_rows
        self._compile = check_flag("compile", compile)
        powers = model.discount ** torch.arange(max_steps + 1, dtype=torch.float64)
        self.register_buffer("_discounts", powers.to(model.device, model.dtype), persistent=False)
        self._prepare()

    def _prepare(self) -> None:
        self.simulated_steps = 0
        # Several threads may share a rollout.
        self._lock = Lock()
        self._make_engine()
        self._transition = compiled(self._policy_and_step) if self._compile else self._policy_and_step

    def _make_engine(self) -> None:
        limits = Limited(self.max_steps, self.truncation, self.terminal_cost)
        engine = scalar_engine(self.base_policy, self.model, limits)
        self.scalar = engine if isinstance(engine, ScalarEngine) else None
        self._makeup = self._made_of()

    def _made_of(self) -> tuple[Any, ...]:
        """What the compiled loop is made of."""
        return self.truncation, self.terminal_cost, makeup(self.base_policy), makeup(self.terminal_cost)

    @property
    def max_steps(self) -> int:
        """Largest number of steps; fixed, as discounts and compiled simulations are made for it."""
        return self._max_steps

    def engine(self) -> ScalarEngine | None:
        """The compiled loop, made anew where modules, such as local networks and values, were replaced or got hooks."""
        if self._made_of() != self._makeup:
            self._make_engine()
        return self.scalar

    def forward(self, y: TensorDictBase, keys: Tensor | Scenarios, count: int = 1) -> Tensor:
        """Cost of one trajectory from every row.

        Args:
            y: feature states ``[N]``.
            keys: streams of the trajectories, int64 ``[N]``; or scenarios, to go on with.
            count: with scenarios, the number of trajectories of an estimate.

        Returns:
            costs ``[N]``.
        """
        self.model.check_state(y)
        scenarios = keys if isinstance(keys, Scenarios) else Scenarios.single(check_keys("keys", keys))
        if y.ndim != 1 or scenarios.keys.shape != y.batch_size:
            raise ValueError(
                f"keys must be one for each state of a flat batch, got shape {tuple(scenarios.keys.shape)} for states "
                f"of batch {tuple(y.batch_size)}"
            )
        check_integer("count", count, 1, MAX_TRAJECTORIES)
        total = torch.zeros(y.batch_size, dtype=self.model.dtype, device=self.model.device)
        with torch.inference_mode():
            engine = self.engine()
            if engine is None:
                steps = self._simulate(y, scenarios, count, total)
            else:
                steps = self._by_loop(engine, y, scenarios, count, total)
        check_finite("simulated costs must be finite", total)
        self.count(steps)
        return total

    def count(self, steps: int) -> None:
        """Add to the number of simulated steps."""
        with self._lock:
            self.simulated_steps += steps

    def _by_loop(self, engine: ScalarEngine, y: TensorDictBase, scenarios: Scenarios, count: int, total: Tensor) -> int:
        """:meth:`_simulate` by the compiled loop, chunk by chunk."""
        steps = 0
        for begin in range(0, len(total), self.chunk_rows):
            first = slice(begin, begin + self.chunk_rows)
            rows = torch.arange(len(total))[first]
            costs, made, cut = engine.simulate(y[first], scenarios.rows(rows), count)
            total[first], steps = costs.to(total.dtype), steps + made
            if cut is not None:
                rest = self.model.derive(cut.y, read_by(cast(TerminalCost, self.terminal_cost)))
                weight = self._discounts[cut.ages]
                total[rows[cut.rows]] += terminal_costs(cast(TerminalCost, self.terminal_cost), rest).to(total.dtype) * weight
        return steps

    def _simulate(self, y: TensorDictBase, scenarios: Scenarios, count: int, total: Tensor) -> int:
        """Add the cost of every trajectory to ``total`` ``[N]``; returns the number of belief steps."""
        steps = 0
        size, waiting = y.batch_size[0], self.chunk_rows
        live = self._admit(y, scenarios, 0, waiting, total)
        self._check_policy(live.y)
        while live.number.numel():
            check_stopped()
            ended = int(live.ended.sum())
            if ended <= _RENEW_FRACTION * live.ended.numel():
                live = self._checked_step(live, count, total)
                steps += live.ended.numel() - ended
                continue
            free = live.ended.nonzero().squeeze(-1)[: max(0, size - waiting)]
            if free.numel():
                live = live.replace_rows(free, self._admit(y, scenarios, waiting, waiting + free.numel(), total))
                waiting += free.numel()
            if waiting >= size:
                live = live.rows(~live.ended)
        return steps

    def _read_keys(self) -> tuple[str, ...] | None:
        """Features read at every step, no others are computed; None, all of them. Local policies may have been replaced."""
        keys = read_by(self.base_policy)
        return keys and (*keys, *(() if self.truncation is None else self.truncation.in_keys))

    def _check_policy(self, y: TensorDictBase) -> None:
        """Raise unless the policy's controls at some of the first states are legal; later ones are not looked at."""
        rows = y[:_CHECKED].clone()
        if rows.batch_size[0]:
            self.model.check_controls(rows, controls_of("base_policy", self.base_policy, rows.copy()))

    def _admit(self, y: TensorDictBase, scenarios: Scenarios, first: int, last: int, total: Tensor) -> _Live:
        """The trajectories number ``first`` to ``last``, at their start."""
        number = torch.arange(first, min(last, total.numel()), device=total.device)
        start = self.model.derive(y[first:last].clone(), self._read_keys())
        age, memory = torch.zeros_like(number), number.new_zeros(number.numel(), 0)
        if self.truncation is not None:
            memory = self.truncation.start(self.model.derive(start))
        ended = torch.zeros_like(number, dtype=torch.bool)
        return self._end(_Live(start, scenarios.rows(number), number, age, ended, memory), total)

    def _checked_step(self, live: _Live, count: int, total: Tensor) -> _Live:
        """:meth:`_step`; what fails in it for an illegal control says so, at no cost where nothing fails."""
        try:
            return self._step(live, count, total)
        except (IndexError, RuntimeError):
            y = live.y.copy()
            self.model.check_controls(y, controls_of("base_policy", self.base_policy, y.copy()))
            raise

    def _step(self, live: _Live, count: int, total: Tensor) -> _Live:
        """One step of all live trajectories; those that have ended add no cost and grow no older."""
        cost, y, scenarios = self._transition(live.y, live.scenarios, live.age, count)
        total.index_add_(0, live.number, cost.masked_fill(live.ended, 0.0).to(total.dtype))
        return self._end(live._replace(y=y, scenarios=scenarios, age=live.age + ~live.ended), total)

    def _policy_and_step(
        self, y: TensorDictBase, scenarios: Scenarios, age: Tensor, count: int
    ) -> tuple[Tensor, TensorDictBase, Scenarios]:
        """Discounted stage cost ``[N]``, next feature states and scenarios of rows that have made ``age`` ``[N]`` steps."""
        # A copy: what a policy writes is its own affair.
        u = controls_of("base_policy", self.base_policy, y.copy())
        if not torch.compiler.is_compiling():
            _check_range(u, self.model)
        noise, scenarios = scenarios.draw(age, self.model.observed(y, u), count)
        cost, nxt = self.model.advance(y, u, noise)
        return cost * self._discounts[age], nxt, scenarios

    def _end(self, live: _Live, total: Tensor) -> _Live:
        """End the trajectories that are in a terminal state or cut; the cut ones get the terminal cost, once."""
        terminal, cut = self.model.is_terminal(live.y), live.age == self.max_steps
        if self.truncation is not None:
            cut = cut | self.truncation.stop(live.y, live.age, live.memory)
        ended = live.ended | terminal
        if self.terminal_cost is not None:
            self._add_terminal_costs(self.terminal_cost, live, (cut & ~ended).nonzero().squeeze(-1), total)
        return live._replace(ended=ended | cut)

    def _add_terminal_costs(self, terminal_cost: TerminalCost, live: _Live, index: Tensor, total: Tensor) -> None:
        """The terminal cost of the rows ``index`` of ``live``, with features that are made for it here alone."""
        if index.numel():
            y = self.model.derive(take_rows(live.y, index), read_by(terminal_cost))
            cost = terminal_costs(terminal_cost, y).to(total.dtype) * self._discounts[live.age[index]]
            total.index_add_(0, live.number[index], cost)


def check_max_steps(max_steps: int | None, model: BeliefModel) -> int:
    """A number of stages; None stands for :attr:`BeliefModel.horizon`.

    Raises:
        TypeError: if it is no integer.
        ValueError: if it is not positive or too large, or None where the discount asks for too many.
    """
    if max_steps is None and model.horizon > MAX_STEPS:
        raise ValueError(
            f"max_steps must be given for a discount of {model.discount}: {model.horizon} stages matter, at most {MAX_STEPS} "
            "are simulated"
        )
    return check_integer("max_steps", model.horizon if max_steps is None else max_steps, 1, MAX_STEPS)


def _check_rest(model: BeliefModel, max_steps: int, truncation: Truncation | None) -> None:
    """Raise if what a cut leaves out, without a terminal cost, may matter."""
    if truncation is not None:
        raise ValueError("truncation needs a terminal_cost, got None: a cut adds it; pass ZeroCost() to add nothing")
    weight = model.discount**max_steps
    if weight > INSIGNIFICANT:
        raise ValueError(
            f"max_steps={max_steps} needs a terminal_cost, got None: the first stage cut weighs {weight:.2g}, more than "
            f"{INSIGNIFICANT}; pass ZeroCost() to add nothing"
        )


def _check_range(u: Tensor, model: BeliefModel) -> None:
    """Raise unless ``u`` are controls of the model: others would be taken for some of these."""
    low, high = u.aminmax() if u.numel() else (0, 0)
    if u.dtype != torch.int64 or not 0 <= int(low) <= int(high) < model.control_range:
        allowed = f"0..{model.control_range - 1}"
        raise ValueError(f"base_policy must write int64 actions {allowed}, got {u.dtype} from {low} to {high}")
