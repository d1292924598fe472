"""Any finite POMDP as a belief model, from explicit arrays (paper, Section II)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite

from torchrl_pomdp.envs.belief import BeliefModel, inverse_cdf
from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.tensor_checks import check_device, check_distributions, check_dtype, check_tensor

__all__ = ["TabularModel", "tiger"]

# States that are summed over at once: temporary tensors hold so many distributions for each row.
_BLOCK = 16


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
        TypeError: if an argument is of the wrong kind.
        ValueError: if an array has the wrong shape or rows that are no distributions, or a cost is not finite in ``dtype``.

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
        dtype, device = check_dtype("dtype", dtype), check_device("device", device)
        transition = check_tensor("transition", transition, finite=False)
        observation = check_tensor("observation", observation, finite=False)
        cost = check_tensor("cost", cost, finite=False)
        if transition.ndim != 3 or transition.shape[1] != transition.shape[2] or not transition.numel():
            raise ValueError(f"transition must have shape [U, n, n], at least one of each, got {tuple(transition.shape)}")
        self.num_controls, self.num_states, _ = transition.shape
        if observation.ndim != 3 or observation.shape[:2] != transition.shape[:2] or not observation.numel():
            raise ValueError(
                f"observation must have shape [{self.num_controls}, {self.num_states}, Z], got {tuple(observation.shape)}"
            )
        self.num_observations = observation.shape[-1]
        cost = cost.to(dtype)
        if cost.shape != (self.num_states, self.num_controls) or not bool(torch.isfinite(cost).all()):
            shape = f"[{self.num_states}, {self.num_controls}]"
            raise ValueError(f"cost must be finite of shape {shape} as {dtype}, got {tuple(cost.shape)}")
        tables = {"transition": _rows("transition", transition), "observation": _rows("observation", observation), "cost": cost}
        for name, array in tables.items():
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

    def check_state(self, y: TensorDictBase) -> None:
        """Raise unless ``y`` is a feature state; see :meth:`BeliefModel.check_state`. Beliefs must sum to one."""
        super().check_state(y)
        check_distributions("entry 'belief' of y", y.get("belief"))

    def action_mask(self, y: TensorDictBase) -> Tensor:
        """All True, ``[*B, U]``."""
        return torch.ones(*y.batch_size, self.num_controls, dtype=torch.bool, device=self.device)

    def expected_cost(self, y: TensorDictBase, u: Tensor) -> Tensor:
        r""":math:`\sum_i b(i)\,g(i,u)`, ``[*B]``."""
        return sum_first(self.cost[:, u].mul_(y.get("belief").movedim(-1, 0)))

    def observation_probs(self, y: TensorDictBase, u: Tensor) -> Tensor:
        r""":math:`\hat p(z\mid b,u)`, ``[*B, Z]``."""
        return self._observed(self._predicted(y, u), u.reshape(-1)).view(*y.batch_size, -1)

    def estimator(self, y: TensorDictBase, u: Tensor, z: Tensor) -> TensorDictBase:
        """F(y, u, z) by Bayes' rule.

        Raises:
            ValueError: if a control is illegal or an observation impossible.
        """
        self.check_controls(y, u)
        self.check_observations(y, z)
        predicted = self._predicted(y, u)
        weight, total = self._weigh(predicted, u.reshape(-1), z.reshape(-1))
        self._refuse_impossible(z, (total > 0).view(y.batch_size))
        return self._successor(y, weight, total)

    def advance(self, y: TensorDictBase, u: Tensor, noise: Tensor) -> tuple[Tensor, TensorDictBase]:
        """One sampled step, see :meth:`BeliefModel.advance`."""
        predicted, control = self._predicted(y, u), u.reshape(-1)
        z = inverse_cdf(self._observed(predicted, control), noise[..., 0].reshape(-1))
        return self.expected_cost(y, u), self._successor(y, *self._weigh(predicted, control, z))

    # ---- kernels on N rows -----------------------------------------------------------------------------------------

    def _predicted(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """P(next state j), ``[N, n]``."""
        return _mixed(y.get("belief").reshape(-1, self.num_states), self.transition, u.reshape(-1))

    def _observed(self, predicted: Tensor, u: Tensor) -> Tensor:
        """P(observation z), ``[N, Z]``."""
        return _mixed(predicted, self.observation, u)

    def _weigh(self, predicted: Tensor, u: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """P(next state j, observation ``z``), ``[N, n]``, and its sum ``[N]``."""
        weight = predicted * self.observation.transpose(1, 2)[u, z]
        return weight, sum_first(weight.T.clone())

    def _successor(self, y: TensorDictBase, weight: Tensor, total: Tensor) -> TensorDictBase:
        return self.successor(y, belief=(weight / total.unsqueeze(-1)).view(*y.batch_size, self.num_states))


def _mixed(weight: Tensor, rows: Tensor, u: Tensor) -> Tensor:
    """Mixtures ``[N, M]`` of the rows ``[U, n, M]`` that belong to controls ``u`` ``[N]``, with weights ``[N, n]``.

    Multiplied and added number by number in an order that n alone decides: a product of matrices would round by N.
    """
    source, by_source = weight.T, rows.transpose(0, 1)
    total: Tensor | None = None
    for first in range(0, len(source), _BLOCK):
        block = slice(first, first + _BLOCK)
        part = sum_first(by_source[block].index_select(1, u).mul_(source[block].unsqueeze(-1)))
        total = part if total is None else total.add_(part)
    assert total is not None
    return total


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


def _rows(name: str, array: Tensor) -> Tensor:
    """The distributions of ``array`` in float64, scaled to sum to one; raises unless they do up to rounding."""
    rows = array.double()
    sums = rows.sum(-1, keepdim=True)
    if not bool((rows >= 0).all()) or not bool(((sums - 1.0).abs() <= 1e-5).all()):
        worst = int((sums.squeeze(-1) - 1.0).abs().nan_to_num(torch.inf).argmax())
        where = tuple(int(i) for i in torch.unravel_index(torch.tensor(worst), sums.shape[:-1]))
        raise ValueError(f"rows of {name} must be nonnegative and sum to 1; row {where} sums to {float(sums[where]):.7g}")
    return rows / sums
