r"""Damage levels: their Markov chain and costs (paper, Section VI-A), and what a belief step needs to know of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_pomdp.checks import check_number, shown
from torchrl_pomdp.tensor_checks import check_tensor

__all__ = ["MAX_LEVELS", "checked_chain", "checked_costs", "damage_chain", "drifts", "off_diagonals", "overflowing_levels"]

MAX_LEVELS = 256
"""Largest number of damage levels."""

# Rounding errors of float32 steps add up over as many steps as the chain remembers. With this memory, 500 steps, sums stay a
# fifth of what the check of a state allows away from one.
_LONGEST_MEMORY = 0.998


def damage_chain(degradation: Sequence[float]) -> Tensor:
    r"""The paper's damage chain: level k rises to k+1 with probability :math:`\gamma_k`, the last level is absorbing.

    Args:
        degradation: :math:`\gamma_0,\dots,\gamma_{\zeta-1}`, each in [0, 1].

    Returns:
        row-stochastic matrix ``[K, K]``, K = len(degradation) + 1.

    Raises:
        TypeError: if ``degradation`` is no sequence of numbers.
        ValueError: if a probability is outside [0, 1] or there is none.

    Examples:
        >>> damage_chain((0.0, 0.25)).tolist()
        [[1.0, 0.0, 0.0], [0.0, 0.75, 0.25], [0.0, 0.0, 1.0]]
    """
    if isinstance(degradation, (str, bytes)) or not isinstance(degradation, Sequence):
        raise TypeError(f"degradation must be a sequence of probabilities, got {shown(degradation)}")
    if not 1 <= len(degradation) < MAX_LEVELS:
        raise ValueError(f"degradation must hold 1 to {MAX_LEVELS - 1} probabilities, got {len(degradation)}")
    probs = [check_number(f"degradation[{level}]", p, "[0, 1]") for level, p in enumerate(degradation)]
    rise = torch.tensor(probs, dtype=torch.float64)
    return torch.diag(torch.cat([1.0 - rise, rise.new_ones(1)])) + torch.diag(rise, 1)


def checked_chain(chain: Any) -> Tensor:
    """The matrix ``chain`` in float64, rows scaled to sum to one; raises unless it is row-stochastic up to rounding."""
    chain = check_tensor("chain", chain).double()
    if chain.ndim != 2 or chain.shape[0] != chain.shape[1] or not 2 <= chain.shape[0] <= MAX_LEVELS:
        raise ValueError(f"chain must be a square matrix of 2 to {MAX_LEVELS} levels, got shape {tuple(chain.shape)}")
    if not bool((chain >= 0).all()):
        raise ValueError(f"chain must hold nonnegative probabilities, got {float(chain.min()):.6g} among them")
    sums = chain.sum(-1, keepdim=True)
    wrong = ((sums - 1.0).abs() > 1e-6).nonzero()[:, 0].tolist()
    if wrong:
        raise ValueError(f"rows of chain must sum to 1, row {wrong[0]} sums to {float(sums[wrong[0]]):.7g}")
    return chain / sums


def checked_costs(costs: Any, num_levels: int, dtype: torch.dtype) -> Tensor:
    """Costs of the levels in ``dtype``; a cost that is finite in another type may be none in this one."""
    costs = check_tensor("costs", costs, finite=False)
    if costs.shape != (num_levels,):
        raise ValueError(f"costs must have shape ({num_levels},), one for each level of chain, got {tuple(costs.shape)}")
    result = costs.to(dtype)
    if not bool((torch.isfinite(result) & (result >= 0)).all()):
        raise ValueError(f"costs must be finite and nonnegative as {dtype}, got {costs.tolist()}")
    return result


def off_diagonals(chain: Tensor) -> Iterator[tuple[slice, slice, Tensor]]:
    """Source levels, target levels and probabilities ``[., 1]`` of the chain's nonzero off-diagonals."""
    size = chain.shape[0]
    for offset in range(1 - size, size):
        probs = chain.diagonal(offset)
        if offset != 0 and bool((probs != 0).any()):
            low, high = slice(0, size - abs(offset)), slice(abs(offset), size)
            source, target = (low, high) if offset > 0 else (high, low)
            yield source, target, probs.view(-1, 1)


def overflowing_levels(chain: Tensor) -> list[int]:
    """Levels whose probability rounding can lift above one: several lead there, one of them (nearly) surely."""
    several = (chain > 0).sum(0) > 1
    return (several & (chain.amax(0) > 0.999)).nonzero().flatten().tolist()


def drifts(chain: Tensor, dtype: torch.dtype) -> bool:
    """Whether sums of beliefs of type ``dtype`` would drift from one in long runs.

    They do not where probability soon ends in absorbing levels, which are kept as they are: rounding adds up while it moves.
    """
    if dtype == torch.float64:
        return False
    lasting = torch.linalg.eigvals(chain.cpu()).abs() > _LONGEST_MEMORY
    return int(lasting.sum()) > int((chain.diagonal() == 1).sum())
