"""Calls of a belief model whose answers are looked at: kind, shape, purity. For :mod:`torchrl_pomdp.problems.check`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import shown
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.tensor_checks import SUM_TOLERANCE

__all__ = ["Probe", "distributions", "refuse", "require", "same", "tolerance"]


def require(holds: bool, method: str, rule: str, found: str, mend: str) -> None:
    """Raise an AssertionError that teaches, unless a rule holds."""
    if not holds:
        raise AssertionError(f"{method}: {rule}; found {found}. {mend}")


def refuse(bad: Tensor, method: str, rule: str, found: Callable[[int], str], mend: str) -> None:
    """Raise an AssertionError that teaches, with what was ``found`` in the first row of ``bad`` ``[N]`` that is True."""
    if bool(bad.any()):
        require(False, method, rule, found(int(bad.nonzero()[0, 0])), mend)


def same(a: Any, b: Any) -> bool:
    """Whether two answers are equal to the last bit."""
    if isinstance(a, TensorDictBase) and isinstance(b, TensorDictBase):
        return a.batch_size == b.batch_size and set(a.keys()) == set(b.keys()) and all(same(a[k], b[k]) for k in set(a.keys()))
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        # What is no number is equal to itself here.
        clean = [x.nan_to_num() if x.is_floating_point() else x for x in (a, b)]
        return a.dtype == b.dtype and torch.equal(*clean)
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    # Answers of another kind are refused for that, and not for what they hold.
    return type(a) is type(b)


def tolerance(dtype: torch.dtype) -> float:
    """By what two ways of rounding one number may differ."""
    return 512 * torch.finfo(dtype).eps


def distributions(y: TensorDictBase, keys: Sequence[str]) -> list[str]:
    """Those entries ``[N, ..., n]`` whose last dimension holds probabilities that sum to one in every state."""
    found = []
    for key in keys:
        value = y.get(key)
        if value.is_floating_point() and value.ndim > 1 and value.shape[-1] > 1:
            sums = value.sum(-1)
            if bool((value >= 0).all()) and bool(((sums - 1).abs() <= SUM_TOLERANCE).all()):
                found.append(key)
    return found


class Probe:
    """A model whose methods are called twice: same answer, of the right kind and shape, and what was given is left alone.

    Args:
        model: the belief model.
        conserved: core entries whose last dimension seems a distribution; what adds up to more than one somewhere is none.
    """

    def __init__(self, model: BeliefModel, conserved: Sequence[str] = ()) -> None:
        self.model, self.conserved = model, tuple(conserved)

    # ---- the methods of the model, ``y`` [*B] ------------------------------------------------------------------------

    def mask(self, y: TensorDictBase) -> Tensor:
        """``action_mask``: bool ``[*B, U]``, at least one True."""
        mask = self._tensor("action_mask", self.model.num_controls, torch.bool, y)
        shape = tuple(y.batch_size)
        require(
            bool(mask.any(-1).all()),
            "action_mask",
            "every state has at least one legal control",
            f"none in one of the states {shape}",
            "Let a control that waits be legal where nothing else is.",
        )
        return mask

    def cost(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """``expected_cost``: finite ``[*B]``."""
        return self._tensor("expected_cost", None, self.model.dtype, y, u)

    def probs(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """``observation_probs``: ``[*B, Z]``, rows sum to one."""
        probs = self._tensor("observation_probs", self.model.num_observations, self.model.dtype, y, u)
        sums = probs.sum(-1).reshape(-1)
        negative = (probs < 0).any(-1).reshape(-1)
        controls = u.reshape(-1)
        refuse(
            negative | ((sums - 1).abs() > SUM_TOLERANCE),
            "observation_probs",
            "every row holds probabilities, not negative, that sum to 1",
            lambda i: (
                f"row {i} (control {int(controls[i])}) with sum {float(sums[i]):.6g} and least number "
                f"{float(probs.reshape(len(sums), -1)[i].min()):.6g}"
            ),
            "Every observation that the control can be followed by needs its probability.",
        )
        return probs

    def terminal(self, y: TensorDictBase) -> Tensor:
        """``is_terminal``: bool ``[*B]``."""
        return self._tensor("is_terminal", None, torch.bool, y)

    def fingerprint(self, y: TensorDictBase) -> Tensor:
        """``fingerprint``: int64 ``[*B]``."""
        return self._tensor("fingerprint", None, torch.int64, y)

    def observed(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """``observed``: int64 ``[*B, noise_dim]``, not negative."""
        names = self._tensor("observed", self.model.noise_dim, torch.int64, y, u)
        least = int(names.min()) if names.numel() else 0
        require(least >= 0, "observed", "names of hidden variables are not negative", str(least), "Number them from 0.")
        return names

    def estimator(self, y: TensorDictBase, u: Tensor, z: Tensor) -> TensorDictBase:
        """``estimator``: the next feature states ``[*B]``."""
        return self._state("estimator", self.call("estimator", y, u, z), y)

    def advance(self, y: TensorDictBase, u: Tensor, noise: Tensor) -> tuple[Tensor, TensorDictBase]:
        """``advance``: stage costs ``[*B]`` and next feature states ``[*B]``."""
        result = self.call("advance", y, u, noise)
        pair = isinstance(result, tuple) and len(result) == 2
        require(pair, "advance", "it gives a pair of stage cost and next state", shown(result), "Return cost, state.")
        cost = self._expect("advance", "stage cost", result[0], tuple(y.batch_size), self.model.dtype)
        return cost, self._state("advance", result[1], y)

    # ---- how they are called -----------------------------------------------------------------------------------------

    def call(self, method: str, y: TensorDictBase, *given: Tensor) -> Any:
        """What a method gives, twice the same; raises if it fails, or writes into what it is given."""
        kept, others = y.clone(), [tensor.clone() for tensor in given]
        results = []
        for _ in range(2):
            # A copy: what the first call gave may be a table of the model, which the second one changes.
            results.append(_copied(self._called(method, y, *given)))
            changed = [str(key) for key in set(kept.keys()) | set(y.keys()) if not _kept(kept, y, str(key))]
            changed += [
                f"argument {i + 1}" for i, (a, b) in enumerate(zip(others, given, strict=True)) if not torch.equal(a, b)
            ]
            require(
                not changed,
                method,
                "a pure function leaves what it is given alone",
                f"{', '.join(sorted(changed))} changed by the call",
                "Work on a clone, and use no operation whose name ends in _ on an entry of y.",
            )
        require(
            same(*results),
            method,
            "the same state gives the same result",
            "another result in a second call",
            "Use no random numbers but the noise that is given, and write into no table of the model: table[u] of a single u "
            "is a view.",
        )
        return results[0]

    def _called(self, method: str, y: TensorDictBase, *given: Tensor) -> Any:
        try:
            return getattr(self.model, method)(y, *given)
        except AssertionError:
            raise
        except Exception as error:
            raise AssertionError(
                f"{method}: it works for legal controls and states of any batch shape [*B], () and (0,) included; found "
                f"{type(error).__name__} for the batch {tuple(y.batch_size)}: {error}. Write it with dimensions counted from "
                f"the last, such as sum(-1), or flatten the batch first."
            ) from error

    def _tensor(self, method: str, size: int | None, dtype: torch.dtype, y: TensorDictBase, *given: Tensor) -> Tensor:
        """What a method gives that gives one tensor: ``[*B]``, or ``[*B, size]``."""
        shape = tuple(y.batch_size) if size is None else (*y.batch_size, size)
        return self._expect(method, "result", self.call(method, y, *given), shape, dtype)

    def _expect(self, method: str, what: str, value: Any, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        rule = f"the {what} is a tensor of {dtype} and shape {shape} on {self.model.device}"
        mend = "The batch comes first, then what belongs to one state; types are those of the model."
        require(isinstance(value, Tensor), method, rule, shown(value), mend)
        right = value.shape == shape and value.dtype == dtype and value.device == self.model.device
        require(right, method, rule, f"{value.dtype} of shape {tuple(value.shape)} on {value.device}", mend)
        if dtype.is_floating_point:
            finite = bool(torch.isfinite(value).all())
            wrong = "" if finite else str(value[~torch.isfinite(value)][0].item())
            require(finite, method, f"the {what} holds finite numbers", wrong, "Look for a division by zero.")
        return value

    def _state(self, method: str, nxt: Any, y: TensorDictBase) -> TensorDictBase:
        """Raise unless ``nxt`` is a feature state with the derived entries of ``y``."""
        model, shape = self.model, tuple(y.batch_size)
        kind = isinstance(nxt, TensorDictBase) and nxt.batch_size == y.batch_size
        found = f"batch {tuple(nxt.batch_size)}" if isinstance(nxt, TensorDictBase) else shown(nxt)
        mend = "Return self.successor(y, entry=..., ...), which adds the derived entries."
        require(kind, method, f"the next state is a TensorDict of batch {shape}", found, mend)
        try:
            model.check_state(nxt)
        except (TypeError, ValueError) as error:
            raise AssertionError(f"{method}: the next state obeys state_spec; found a state that does not: {error}") from error
        keys = {*model.state_keys, *({"action_mask", "partition"} & set(y.keys()))}
        require(
            set(nxt.keys()) == keys, method, f"the next state has the entries {sorted(keys)}", str(sorted(nxt.keys())), mend
        )
        for key in self.conserved:
            sums = nxt.get(key).sum(-1).reshape(-1)
            if bool((sums > 1 + SUM_TOLERANCE).any()):
                # Probabilities of several things, which have added up to one by chance.
                self.conserved = tuple(each for each in self.conserved if each != key)
            else:
                self._check_sums(method, key, sums)
        derived = model.derive(nxt.select(*model.state_keys))
        for key in keys.difference(model.state_keys):
            mend = f"Compute {key} from the next state's core, as self.successor does."
            require(same(nxt.get(key), derived.get(key)), method, f"{key} is a function of the core", "another one", mend)
        return nxt

    def _check_sums(self, method: str, key: str, sums: Tensor) -> None:
        refuse(
            (sums - 1).abs() > SUM_TOLERANCE,
            method,
            f"entry {key!r} is a distribution in every start state and stays one",
            lambda i: f"a sum of {float(sums[i]):.6g}",
            "Divide the posterior by its sum, the probability of the observation.",
        )


def _copied(result: Any) -> Any:
    if isinstance(result, tuple):
        return tuple(map(_copied, result))
    return result.clone() if isinstance(result, (Tensor, TensorDictBase)) else result


def _kept(before: TensorDictBase, after: TensorDictBase, key: str) -> bool:
    return all(key in set(y.keys()) for y in (before, after)) and same(before.get(key), after.get(key))
