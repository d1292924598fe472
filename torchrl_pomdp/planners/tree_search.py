"""What searches of a tree of histories have in common: roots side by side on the cores, within a budget."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from importlib.util import find_spec
from threading import Lock
from time import perf_counter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance, check_integer, check_number
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.modules.own import MakesItsOwn
from torchrl_pomdp.modules.policies import Policy, check_policy
from torchrl_pomdp.modules.rollout import check_max_steps
from torchrl_pomdp.modules.scalar import MOST_NUMBERS, Limited, Roots, SearchEngine, local_engine, makeup, scalar_engine
from torchrl_pomdp.modules.threads import map_threads
from torchrl_pomdp.stopping import check_stopped

__all__ = ["Budget", "TreeSearch"]

# Most simulations of a decision, and of a stretch, which nothing can interrupt.
_MOST, _STRETCH = 10**9, 100_000


class Budget:
    """How long a decision may search: a number of simulations, or seconds.

    Args:
        simulations: their number, or None.
        seconds: the time, or None.

    Raises:
        TypeError: if one is of the wrong kind.
        ValueError: if not exactly one is given, or it is not positive.

    Examples:
        >>> list(Budget(100, None).stretches())
        [100]
        >>> Budget(None, None)
        Traceback (most recent call last):
        ValueError: simulations or seconds must be given, and not both; got None and None
    """

    def __init__(self, simulations: int | None, seconds: float | None) -> None:
        if (simulations is None) == (seconds is None):
            raise ValueError(f"simulations or seconds must be given, and not both; got {simulations} and {seconds}")
        self.simulations = None if simulations is None else check_integer("simulations", simulations, 1, _MOST)
        self.seconds = None if seconds is None else check_number("seconds", seconds, "(0, inf)")

    def stretches(self) -> Iterator[int]:
        """Numbers of simulations to go on with, as many at a time as the time allows; the first one always.

        None is so large that one could not stop in between.
        """
        if self.seconds is None:
            left = int(self.simulations or 0)
            while left:
                size = min(left, _STRETCH)
                yield size
                left -= size
            return
        begin, done, size = perf_counter(), 0, 1
        while done < _MOST:
            yield size
            done += size
            elapsed = perf_counter() - begin
            # Later ones may take longer than those so far.
            fitting = done * (self.seconds / elapsed - 1.0) / 2
            if fitting < 1.0 and elapsed >= self.seconds * (1.0 - 0.5 / done):
                return
            size = max(1, int(min(fitting, 4.0 * done, _STRETCH)))


class TreeSearch(MakesItsOwn, TensorDictModuleBase):
    """Base of the searches: feature states ``[*B]`` in, ``"action"`` and ``"q_factors"`` out, like ``RolloutPolicy``.

    Args:
        model: the belief model; it needs a scalar twin.
        base_policy: policy with a scalar twin; None: any legal control, all equally likely.

    Keyword Args:
        simulations: how many a decision makes; or
        seconds: how long it takes.
        max_steps: stages after which simulations end; None: :attr:`BeliefModel.horizon`.
        seed: seed of the simulations.

    Raises:
        ImportError: if numba is not installed.
        TypeError: if an argument is of the wrong kind.
        ValueError: if a number is out of range, or model or policy have no scalar twin.
    """

    out_keys = ["action", "q_factors"]
    _OWN = frozenset({"_lock", "_loops", "_makeup", "engine", "simulated_steps"})
    # Numbers that a search finds beside the Q-factors.
    _extra = 0

    def __init__(
        self,
        model: BeliefModel,
        base_policy: Policy | None,
        *,
        simulations: int | None,
        seconds: float | None,
        max_steps: int | None,
        seed: int,
    ) -> None:
        super().__init__()
        self.model = check_instance("model", model, BeliefModel)
        model.check_enumerable(type(self).__name__, "MultiagentRollout")
        self.in_keys = list(model.state_keys)
        self.base_policy = None if base_policy is None else check_policy("base_policy", base_policy, model)
        self.budget = Budget(simulations, seconds)
        self._max_steps = check_max_steps(max_steps, model)
        self.seed = check_integer("seed", seed)
        self._prepare()

    def _prepare(self) -> None:
        self.simulated_steps = 0
        self._lock = Lock()
        self._prepare_engine()

    def _prepare_engine(self) -> None:
        self.engine, self._makeup = self._engine(), makeup(self.base_policy)
        # They are compiled for the policy.
        self._loops: Any = None

    @property
    def max_steps(self) -> int:
        """Stages after which simulations end; fixed, as compiled simulations are made for it."""
        return self._max_steps

    def _engine(self) -> SearchEngine:
        if find_spec("numba") is None:
            raise ImportError(f"{type(self).__name__} needs numba: pip install '.[fast]' in the library's folder")
        limits = Limited(self.max_steps, None, None)
        if self.base_policy is None:
            engine = local_engine((), self.model, limits)
        else:
            engine = scalar_engine(self.base_policy, self.model, limits)
        if engine is not None:
            return engine
        of_model = type(self.model).__name__
        if self.base_policy is None or local_engine((), self.model, limits) is None:
            raise ValueError(
                f"model must have a scalar twin, as repair and tabular models on a CPU have whose tables hold at most "
                f"{MOST_NUMBERS:,} numbers, got {of_model}"
            )
        raise ValueError(
            f"base_policy must have a scalar twin for this very model, a {of_model}, got {type(self.base_policy).__name__}"
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"``, int64 ``[*B]``, and ``"q_factors"``, ``[*B, U]``, infinite where a control was not tried."""
        found = self._search(tensordict)[..., : self.model.num_controls]
        nothing, terminal = torch.isinf(found).all(-1), self.model.is_terminal(tensordict)
        if bool((nothing & ~terminal).any()):
            raise ValueError("q_factors must be finite, got inf for every control: the model's costs overflow")
        # Where nothing follows, whatever is legal is as good.
        q = found.masked_fill(terminal.unsqueeze(-1) & self.model.action_mask(tensordict), 0.0)
        # In the model's type large costs that differ may be equal.
        return tensordict.set("q_factors", q.to(self.model.dtype)).set("action", q.argmin(-1))

    @torch.no_grad()
    def _search(self, y: TensorDictBase) -> Tensor:
        """What the searches from states ``[*B]`` have found, float64 ``[*B, U + E]``, finite in the model's type, too."""
        self.model.check_state(y)
        if makeup(self.base_policy) != self._makeup:
            self._prepare_engine()
        roots = self.engine.roots(y, self.seed)
        found = np.full((y.batch_size.numel(), self.model.num_controls + self._extra), np.inf)
        numbers = range(len(found))
        if len(found):
            steps = map_threads(lambda i: self._decide(roots, i, found[i]), numbers, torch.get_num_threads())
            with self._lock:
                self.simulated_steps += sum(steps)
        if not bool((found > -np.inf).all()):
            raise ValueError("q_factors must be finite, got nan or -inf: the model's costs overflow")
        result = torch.from_numpy(found)
        if bool(result.to(self.model.dtype).isinf().logical_xor(result.isinf()).any()):
            largest = np.abs(found[np.isfinite(found)]).max()
            raise ValueError(
                f"q_factors must be finite as {self.model.dtype}, got {largest:g}: costs, or the regularisation, are too large"
            )
        return result.view(*y.batch_size, found.shape[1])

    @abstractmethod
    def _decide(self, roots: Roots, number: int, found: NDArray[np.float64]) -> int:
        """Search from a root; puts Q-factors, and E numbers more, into ``found``; returns the number of simulated steps."""

    def call(self, function: Any, *args: Any) -> Any:
        """Call a compiled loop; its arguments have the same types and memory layouts at every call."""
        check_stopped()
        if self._loops is None:
            from torchrl_pomdp.scalar.compiling import Loops

            self._loops = Loops()
        return self._loops(function, *args)

    def check_legal(self, well: bool) -> None:
        """Raise unless all was well with the controls of a simulation."""
        if not well and self.base_policy is None:
            raise ValueError("y must not lead to beliefs whose states share no legal control; a simulation came to one")
        if not well:
            raise ValueError("base_policy chose an illegal control in a simulation; its scalar twin must choose a legal one")


def grown(array: NDArray[Any]) -> NDArray[Any]:
    """Twice as many rows, the new ones zero."""
    return np.concatenate([array, np.zeros_like(array)])
