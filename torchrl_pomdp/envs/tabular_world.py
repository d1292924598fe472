"""The hidden states of a finite POMDP (paper, Section II)."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite

from torchrl_pomdp.envs.rows import inverse_cdf
from torchrl_pomdp.envs.tables import DenseTable, SparseTable
from torchrl_pomdp.envs.tabular import TabularModel
from torchrl_pomdp.envs.world import World

__all__ = ["TabularWorld"]


class TabularWorld(World):
    r"""The n states of a :class:`TabularModel`; entry ``"state"`` int64 ``[*B]``.

    A model keeps the expected cost of state and control. So the realised cost is :math:`g(i,u)`; a cost that was given by next
    state or by observation too is the mean over these.

    Args:
        model: the tabular model.

    Examples:
        >>> from torchrl_pomdp.problems import crying_baby
        >>> problem = crying_baby()
        >>> keys = torch.arange(3)
        >>> problem.model.world().sample(problem.start(keys), keys)["state"].tolist()
        [0, 0, 0]
    """

    model: TabularModel
    draw_dim, noise_dim = 1, 2

    def __init__(self, model: TabularModel) -> None:
        super().__init__(model)

    def hidden_spec(self, batch_size: torch.Size | tuple[int, ...] = ()) -> Composite:
        """``state`` ``[*B]``."""
        shape, model = torch.Size(batch_size), self.model
        state = Categorical(model.num_states, shape=shape, dtype=torch.int64, device=model.device)
        return Composite(state=state, shape=shape, device=model.device)

    def action_mask(self, hidden: TensorDictBase) -> Tensor:
        """Controls that are legal in the states, bool ``[*B, U]``."""
        return self.model.legal[hidden.get("state")]

    def is_terminal(self, hidden: TensorDictBase) -> Tensor:
        """Bool ``[*B]``: whether the states are terminal."""
        return self.model.terminal[hidden.get("state")]

    def draw(self, y: TensorDictBase, noise: Tensor) -> TensorDictBase:
        """States by their probabilities; see :meth:`World.draw`."""
        return self._hidden(inverse_cdf(y.get("belief"), noise[..., 0]))

    def advance(self, hidden: TensorDictBase, u: Tensor, noise: Tensor) -> tuple[Tensor, TensorDictBase, Tensor]:
        """A transition, then an observation of the next state; see :meth:`World.advance`."""
        state, model = hidden.get("state"), self.model
        nxt = inverse_cdf(_rows(model._moves, u, state), noise[..., 0])
        z = inverse_cdf(_rows(model._sees, u, nxt), noise[..., 1])
        return model.cost[u, state], self._hidden(nxt), z

    def _hidden(self, state: Tensor) -> TensorDict:
        return TensorDict({"state": state}, batch_size=state.shape, device=self.model.device)


def _rows(table: DenseTable | SparseTable, u: Tensor, state: Tensor) -> Tensor:
    """Distributions ``[*B, m]`` in the rows ``state`` of the tables of controls ``u``, both int64 ``[*B]``."""
    if isinstance(table, DenseTable):
        return table.rows[u, state]
    # A sparse table has no rows to look up: the mixture of one row alone is that row.
    alone = torch.nn.functional.one_hot(state.reshape(-1), table.shape[1]).to(table.values.dtype)
    return table.mix(alone, u.reshape(-1)).view(*u.shape, -1)
