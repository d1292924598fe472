"""The hidden states of maintenance: how far the components are worn."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite

from torchrl_pomdp.envs.digits import joined
from torchrl_pomdp.envs.rows import inverse_cdf
from torchrl_pomdp.envs.world import World
from torchrl_pomdp.problems.maintenance_model import INSPECT, REPLACE, MaintenanceModel

__all__ = ["MaintenanceWorld"]


class MaintenanceWorld(World):
    """The true levels of a :class:`MaintenanceModel`; entries ``"level"`` int64 ``[*B, n]`` and ``"time"`` int64 ``[*B]``.

    Args:
        model: the maintenance model.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("maintenance3")
        >>> model, keys = problem.model, torch.arange(1)
        >>> world = model.world()
        >>> hidden = world.sample(problem.start(keys), keys)
        >>> hidden["level"].tolist()
        [[0, 0, 0, 0, 0]]
        >>> cost, hidden, z = world.step(hidden, torch.tensor([model.control_names.index("inspect 1 2")]), keys)
        >>> cost.tolist(), hidden["level"].tolist(), model.observations[:, z].T.tolist()
        ([60.0], [[2, 0, 0, 0, 0]], [[2, 0, 0, 0, 0]])
    """

    model: MaintenanceModel

    def __init__(self, model: MaintenanceModel) -> None:
        super().__init__(model)
        # A step: whether each replacement succeeds, how far each component wears, what each one shows.
        self.draw_dim, self.noise_dim = model.num_components, 3 * model.num_components

    def hidden_spec(self, batch_size: torch.Size | tuple[int, ...] = ()) -> Composite:
        """``level`` ``[*B, n]`` and ``time`` ``[*B]``."""
        shape, model = torch.Size(batch_size), self.model
        levels = (*shape, model.num_components)
        return Composite(
            level=Categorical(model.num_levels, shape=levels, dtype=torch.int64, device=model.device),
            time=Categorical(model.num_stages + 1, shape=shape, dtype=torch.int64, device=model.device),
            shape=shape,
            device=model.device,
        )

    def action_mask(self, hidden: TensorDictBase) -> Tensor:
        """All True, ``[*B, U]``."""
        return self.model.action_mask(hidden)

    def is_terminal(self, hidden: TensorDictBase) -> Tensor:
        """Bool ``[*B]``: all stages are gone."""
        return self.model.is_terminal(hidden)

    def draw(self, y: TensorDictBase, noise: Tensor) -> TensorDictBase:
        """A level for each component by its marginal; see :meth:`World.draw`."""
        return self._hidden(inverse_cdf(y.get("belief"), noise), y.get("time"))

    def advance(self, hidden: TensorDictBase, u: Tensor, noise: Tensor) -> tuple[Tensor, TensorDictBase, Tensor]:
        """Costs, replacements, wear, observations, in this order; see :meth:`World.advance`."""
        level, time, model = hidden.get("level"), hidden.get("time"), self.model
        succeed, wear, show = noise.unflatten(-1, (3, model.num_components)).unbind(-2)
        working = (level < model.num_levels - 1).sum(-1)
        cost = model.control_cost[u] + model.penalty * (working < model.needed).to(model.dtype)
        controls, component = model.controls.T[u], torch.arange(model.num_components, device=model.device)
        level = level.masked_fill((controls == REPLACE) & (succeed < model.success.squeeze(-1)), 0)
        level = inverse_cdf(model.chain[component, level], wear)
        table = model.likelihood.view(model.num_levels, 2, model.num_components, model.num_levels)
        seen = inverse_cdf(table[level, (controls == INSPECT).to(torch.int64), component], show)
        hidden_after = self._hidden(level, (time + 1).clamp_max(model.num_stages))
        return cost.masked_fill(self.is_terminal(hidden), 0.0), hidden_after, joined(seen, model.num_levels)

    def _hidden(self, level: Tensor, time: Tensor) -> TensorDict:
        return TensorDict({"level": level, "time": time}, batch_size=time.shape, device=self.model.device)
