r"""Random small problems of which everything can be computed, to try statements on (paper, Section III)."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_pomdp.checks import check_seed
from torchrl_pomdp.envs.tabular import TabularModel

__all__ = ["random_model"]

# Share of probabilities that are zero, and of controls that are illegal in a state.
_ZERO, _ILLEGAL = 1 / 3, 0.1


def random_model(seed: int) -> TabularModel:
    r"""A random problem with hidden states whose reachable beliefs are finitely many.

    Its states lie in 2 or 3 layers that follow one another in a circle. In the first layer the state is seen; in the others
    observations are noise. A belief thus remembers at most two controls and observations, while what is done has
    consequences for ever. All else is random: 2 or 3 controls and observations, as many states in the first layer as there
    are observations, 2 to 4 in the others, probabilities, costs of both signs, legality, and :math:`\alpha` between 0.5
    and 0.98. State 0 is in the first layer.

    Args:
        seed: its seed.

    Raises:
        TypeError: if ``seed`` is no integer.
        ValueError: if it is no seed.

    Examples:
        >>> model = random_model(3)
        >>> model.num_states, model.num_controls, model.num_observations
        (7, 2, 2)
    """
    rng = torch.Generator().manual_seed(check_seed("seed", seed))
    num_controls, num_observations, layers = (_integer(rng, 2, 3) for _ in range(3))
    sizes = [num_observations, *(_integer(rng, 2, 4) for _ in range(layers - 1))]
    ends = torch.tensor([0, *sizes]).cumsum(0).tolist()
    num_states = ends[-1]
    transition = torch.zeros(num_controls, num_states, num_states, dtype=torch.float64)
    for layer, size in enumerate(sizes):
        following = (layer + 1) % layers
        goal = slice(ends[following], ends[following + 1])
        transition[:, ends[layer] : ends[layer + 1], goal] = _rows(rng, num_controls, size, sizes[following])
    observation = _rows(rng, num_controls, num_states, num_observations)
    observation[:, :num_observations] = torch.eye(num_observations, dtype=torch.float64)
    legal = torch.rand(num_states, num_controls, generator=rng) > _ILLEGAL
    legal[:, 0] = True  # so that every support leaves a control
    cost = torch.randn(num_controls, num_states, generator=rng, dtype=torch.float64)
    discount = 0.5 + 0.48 * float(torch.rand((), generator=rng))
    return TabularModel(transition, observation, cost, discount, legal=legal, dtype=torch.float64)


def _integer(rng: torch.Generator, low: int, high: int) -> int:
    return int(torch.randint(low, high + 1, (), generator=rng))


def _rows(rng: torch.Generator, *shape: int) -> Tensor:
    """Random distributions along the last dimension, some probabilities zero."""
    kept = torch.rand(shape, generator=rng) > _ZERO
    kept[..., _integer(rng, 0, shape[-1] - 1)] = True
    weights = kept * (1e-3 + torch.rand(shape, generator=rng, dtype=torch.float64))
    return weights / weights.sum(-1, keepdim=True)
