"""Any finite POMDP as a belief model, from explicit arrays (paper, Section II)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite

from torchrl_pomdp.envs.belief import BeliefModel
from torchrl_pomdp.envs.partition import Partition

__all__ = ["TabularModel", "tiger"]


class TabularModel(BeliefModel):
    r"""Belief model of a POMDP with n states, given by its arrays; all controls are legal everywhere.

    The core entry is ``"belief"`` ``[*B, n]``.

    Args:
        transition: :math:`p_{ij}(u)`, ``[U, n, n]``, rows sum to one.
        observation: :math:`p(z\mid j,u)`, ``[U, n, Z]`` by next state j, rows sum to one.
        cost: expected stage cost :math:`\sum_j p_{ij}(u)g(i,u,j)`, ``[n, U]``; negative costs are rewards.
        discount: :math:`\alpha`.

    Keyword Args:
        partition: partition whose index becomes a feature.
        dtype: float32 or float64.
        device: where the model computes.

    Raises:
        ValueError: if an array has the wrong shape or rows that are no distributions.

    Examples:
        >>> model = tiger()
        >>> model.describe()
        'TabularModel: 3 controls, 2 observations, discount 0.95'
    """

    state_keys = ("belief",)
    transition: Tensor
    observation: Tensor
    cost: Tensor

    def __init__(
        self,
        transition: Tensor,
        observation: Tensor,
        cost: Tensor,
        discount: float,
        *,
        partition: Partition | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(discount, partition)
        if transition.ndim != 3 or transition.shape[1] != transition.shape[2]:
            raise ValueError(f"transition must have shape [U, n, n], got {tuple(transition.shape)}")
        self.num_controls, self.num_states, _ = transition.shape
        if observation.ndim != 3 or observation.shape[:2] != transition.shape[:2]:
            raise ValueError(
                f"observation must have shape [{self.num_controls}, {self.num_states}, Z], got {tuple(observation.shape)}"
            )
        if cost.shape != (self.num_states, self.num_controls) or not bool(torch.isfinite(cost).all()):
            raise ValueError(f"cost must be finite of shape [{self.num_states}, {self.num_controls}], got {tuple(cost.shape)}")
        self.num_observations = observation.shape[-1]
        for name, array in (("transition", transition), ("observation", observation)):
            _check_rows(name, array)
        for name, array in (("transition", transition), ("observation", observation), ("cost", cost)):
            self.register_buffer(name, array.to(device, dtype), persistent=False)

    @property
    def device(self) -> torch.device:
        """Device of the model's tensors."""
        return self.transition.device

    @property
    def dtype(self) -> torch.dtype:
        """Type of beliefs and costs."""
        return self.transition.dtype

    def state_spec(self, batch_size: torch.Size | tuple[int, ...] = ()) -> Composite:
        """``belief`` ``[*B, n]`` in [0, 1]."""
        shape = torch.Size(batch_size)
        belief = Bounded(0.0, 1.0, shape=(*shape, self.num_states), dtype=self.cost.dtype, device=self.device)
        return Composite(belief=belief, shape=shape, device=self.device)

    def action_mask(self, y: TensorDictBase) -> Tensor:
        """All True, ``[*B, U]``."""
        return torch.ones(*y.batch_size, self.num_controls, dtype=torch.bool, device=self.device)

    def expected_cost(self, y: TensorDictBase, u: Tensor) -> Tensor:
        r""":math:`\sum_i b(i)\,g(i,u)`, ``[*B]``."""
        return (y.get("belief") * self.cost.T[u]).sum(-1)

    def observation_probs(self, y: TensorDictBase, u: Tensor) -> Tensor:
        r""":math:`\hat p(z\mid b,u)`, ``[*B, Z]``."""
        return self._joint(y, u).sum(-2)

    def estimator(self, y: TensorDictBase, u: Tensor, z: Tensor) -> TensorDictBase:
        """F(y, u, z) by Bayes' rule."""
        index = z[..., None, None].expand(*z.shape, self.num_states, 1)
        weight = self._joint(y, u).gather(-1, index).squeeze(-1)
        return self.successor(y, belief=weight / weight.sum(-1, keepdim=True))

    def _joint(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """P(next state j, observation z), ``[*B, n, Z]``."""
        predicted = (y.get("belief").unsqueeze(-2) @ self.transition[u]).squeeze(-2)
        return predicted.unsqueeze(-1) * self.observation[u]


def tiger(discount: float = 0.95, *, device: torch.device | str = "cpu") -> TabularModel:
    r"""Tiger (Kaelbling, Littman and Cassandra 1998): controls listen, open left, open right; observations hear left, right.

    Listening costs 1 and is right with probability 0.85; the door of the tiger costs 100, the other pays 10. After a door
    is opened the tiger is placed anew.

    Args:
        discount: :math:`\alpha`.
        device: where the model computes.

    Examples:
        >>> tiger().cost.tolist()
        [[1.0, 100.0, -10.0], [1.0, -10.0, 100.0]]
    """
    half = torch.full((2, 2), 0.5)
    transition = torch.stack([torch.eye(2), half, half])
    hear = torch.tensor([[0.85, 0.15], [0.15, 0.85]])
    observation = torch.stack([hear, half, half])
    cost = torch.tensor([[1.0, 100.0, -10.0], [1.0, -10.0, 100.0]])
    return TabularModel(transition, observation, cost, discount, device=device)


def _check_rows(name: str, array: Tensor) -> None:
    sums = array.double().sum(-1)
    if not bool((array >= 0).all()) or not bool(((sums - 1.0).abs() <= 1e-5).all()):
        worst = int((sums - 1.0).abs().argmax())
        where = tuple(int(i) for i in torch.unravel_index(torch.tensor(worst), sums.shape))
        raise ValueError(f"rows of {name} must be nonnegative and sum to 1; row {where} sums to {float(sums[where]):.6g}")
