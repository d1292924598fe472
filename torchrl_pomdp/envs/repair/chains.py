r"""Damage levels: their Markov chain and costs (paper, Section VI-A), and what a belief step needs to know of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_pomdp.checks import check_number, shown
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.tensor_checks import check_tensor

__all__ = [
    "MAX_LEVELS",
    "chain_powers",
    "checked_chain",
    "checked_costs",
    "damage_chain",
    "drifts",
    "location_costs",
    "off_diagonals",
    "overflowing_levels",
    "prices",
]

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


def chain_powers(chain: Tensor, count: int) -> Tensor:
    """The powers 0 … ``count`` of matrices ``[., K, K]``, to the same bit on every machine, ``[count + 1, ., K, K]``.

    A library's product of matrices rounds by processor, device and threads, and a generator's states are to be the same.
    """
    own = chain.cpu().double()
    powers = [torch.eye(own.shape[-1], dtype=own.dtype).expand_as(own)]
    for _ in range(count):
        # [K, ., K, K]: level by level.
        terms = powers[-1].movedim(-1, 0).unsqueeze(-1) * own.movedim(-2, 0).unsqueeze(-2)
        powers.append(sum_first(terms))
    return torch.stack(powers).to(chain)


def checked_chain(chain: Any, num_locations: int) -> Tensor:
    """The matrices ``chain`` in float64, rows scaled to sum to one; raises unless they are row-stochastic up to rounding.

    ``[K, K]`` where all locations have the same, else ``[L, K, K]``.
    """
    chain = check_tensor("chain", chain).detach().double()
    wrong = chain.ndim not in (2, 3) or chain.shape[-1] != chain.shape[-2] or not 2 <= chain.shape[-1] <= MAX_LEVELS
    if wrong or (chain.ndim == 3 and len(chain) != num_locations):
        raise ValueError(
            f"chain must be a square matrix of 2 to {MAX_LEVELS} levels, or one for each of the {num_locations} locations, "
            f"got shape {tuple(chain.shape)}"
        )
    if not bool((chain >= 0).all()):
        raise ValueError(f"chain must hold nonnegative probabilities, got {float(chain.min()):.6g} among them")
    sums = chain.sum(-1, keepdim=True)
    off = ((sums - 1.0).abs() > 1e-6).nonzero()[:, :-1].tolist()
    if off:
        row = ", ".join(map(str, off[0]))
        raise ValueError(f"rows of chain must sum to 1, row {row} sums to {float(sums[tuple(off[0])]):.7g}")
    return _same_everywhere(chain / sums, 2)


def checked_costs(costs: Any, num_locations: int, num_levels: int, dtype: torch.dtype) -> Tensor:
    """Costs of the levels in ``dtype``; a cost that is finite in another type may be none in this one.

    ``[K]`` where all locations have the same, else ``[L, K]``.
    """
    # A copy: what the caller does with the tensor does not concern the model.
    costs = check_tensor("costs", costs, finite=False).detach().clone()
    if costs.shape not in ((num_levels,), (num_locations, num_levels)):
        raise ValueError(
            f"costs must have shape ({num_levels},), one for each level of chain, or ({num_locations}, {num_levels}) for every "
            f"location, got {tuple(costs.shape)}"
        )
    result = _same_everywhere(costs.to(dtype), 1)
    if not bool((torch.isfinite(result) & (result >= 0)).all()):
        raise ValueError(f"costs must be finite and nonnegative as {dtype}, got {costs.tolist()}")
    return result


def _same_everywhere(table: Tensor, dims: int) -> Tensor:
    """One table of ``dims`` dimensions if those of all locations are equal, else one for each location."""
    several = table.ndim > dims
    return table[0].clone() if several and bool((table == table[:1]).all()) else table


def location_costs(planes: Tensor, costs: Tensor | Sequence[float]) -> Tensor:
    """Expected cost of every location, ``[L, *B]``.

    Args:
        planes: beliefs ``[L, K, *B]``.
        costs: a cost for each level; or a tensor ``[L, K]``, different by location.
    """
    if isinstance(costs, Tensor):
        own = costs.view(*costs.shape, *([1] * (planes.ndim - 2)))
        total = planes[:, 0] * own[:, 0]
        for level in range(1, costs.shape[1]):
            total.addcmul_(planes[:, level], own[:, level])
        return total
    paid = [level for level, cost in enumerate(costs) if cost != 0]
    if not paid:
        return torch.zeros_like(planes[:, 0])
    total = planes[:, paid[0]] * costs[paid[0]]
    for level in paid[1:]:
        total.add_(planes[:, level], alpha=costs[level])
    return total


def prices(costs: Tensor) -> Tensor | tuple[float, ...]:
    """Costs ``[K]`` or ``[L, K]`` as :func:`location_costs` takes them."""
    return costs if costs.ndim == 2 else tuple(costs.tolist())


def off_diagonals(chain: Tensor) -> Iterator[tuple[slice, slice, Tensor]]:
    """Source levels, target levels and probabilities ``[., 1]``, or ``[L, ., 1]``, of the chains' nonzero off-diagonals."""
    size = chain.shape[-1]
    for offset in range(1 - size, size):
        probs = chain.diagonal(offset, dim1=-2, dim2=-1)
        if offset != 0 and bool((probs != 0).any()):
            low, high = slice(0, size - abs(offset)), slice(abs(offset), size)
            source, target = (low, high) if offset > 0 else (high, low)
            yield source, target, probs.unsqueeze(-1).contiguous()


def overflowing_levels(chain: Tensor) -> list[int]:
    """Levels whose probability rounding can lift above one: several lead there, one of them (nearly) surely."""
    several = (chain > 0).sum(-2) > 1
    return (several & (chain.amax(-2) > 0.999)).reshape(-1, chain.shape[-1]).any(0).nonzero().flatten().tolist()


def drifts(chain: Tensor, dtype: torch.dtype) -> bool:
    """Whether sums of beliefs of type ``dtype`` would drift from one in long runs.

    They do not where probability soon ends in absorbing levels, which are kept as they are: rounding adds up while it moves.
    """
    if dtype == torch.float64:
        return False
    lasting = (torch.linalg.eigvals(chain.cpu()).abs() > _LONGEST_MEMORY).sum(-1)
    return bool((lasting > (chain.diagonal(dim1=-2, dim2=-1) == 1).sum(-1).cpu()).any())
