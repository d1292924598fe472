"""The hidden states of the repair problem (paper, Section VI-A): the damage levels that the robots do not see."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite

from torchrl_pomdp.envs.digits import joined
from torchrl_pomdp.envs.repair.model import REPAIR, RepairModel
from torchrl_pomdp.envs.rows import inverse_cdf
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.envs.world import World

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["RepairWorld"]


class RepairWorld(World):
    """The true levels of a :class:`RepairModel`.

    Entries: ``"level"`` int64 ``[*B, L]`` and ``"location"`` int64 ``[*B, R]``, where the robots stand. Every control that
    keeps the robots on the graph can be carried out. All levels at 0 are terminal if the model :attr:`ends`.

    Args:
        model: the repair model.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("line3")
        >>> world, repair, key = problem.model.world(), torch.tensor(REPAIR), torch.tensor(1)
        >>> hidden = world.sample(problem.start(key), key)
        >>> hidden["level"].tolist(), hidden["location"].tolist()
        ([1, 0, 1], [0])
        >>> cost, hidden, z = world.step(hidden, repair, key)
        >>> round(float(cost), 2), hidden["level"].tolist(), int(z)
        (0.2, [0, 0, 1], 0)
    """

    model: RepairModel

    def __init__(self, model: RepairModel) -> None:
        super().__init__(model)
        self.draw_dim = self.noise_dim = model.num_locations

    def hidden_spec(self, batch_size: torch.Size | tuple[int, ...] = ()) -> Composite:
        """``level`` ``[*B, L]`` and ``location`` ``[*B, R]``."""
        shape, model = torch.Size(batch_size), self.model
        levels, robots = (*shape, model.num_locations), (*shape, model.num_robots)
        return Composite(
            level=Categorical(model.num_levels, shape=levels, dtype=torch.int64, device=model.device),
            location=Categorical(model.num_locations, shape=robots, dtype=torch.int64, device=model.device),
            shape=shape,
            device=model.device,
        )

    def action_mask(self, hidden: TensorDictBase) -> Tensor:
        """Joint controls that keep the robots on the graph, bool ``[*B, U]``: those that are legal where no level is known."""
        location, model = hidden.get("location"), self.model
        unknown = torch.zeros((), dtype=model.dtype, device=model.device)
        unknown = unknown.expand(*hidden.batch_size, model.num_locations, model.num_levels)
        return model.action_mask(TensorDict({"belief": unknown, "location": location}, batch_size=hidden.batch_size))

    def is_terminal(self, hidden: TensorDictBase) -> Tensor:
        """Bool ``[*B]``: nothing is damaged; never unless the model :attr:`ends`."""
        intact = (hidden.get("level") == 0).all(-1)
        return intact if self.model.ends else torch.zeros_like(intact)

    def draw(self, y: TensorDictBase, noise: Tensor) -> TensorDictBase:
        """A level for each location by its marginal; see :meth:`World.draw`."""
        return self._hidden(inverse_cdf(y.get("belief"), noise), y.get("location"))

    def advance(self, hidden: TensorDictBase, u: Tensor, noise: Tensor) -> tuple[Tensor, TensorDictBase, Tensor]:
        """Costs, controls, repairs and the chains, observations, in this order; see :meth:`World.advance`."""
        level, location, model = hidden.get("level"), hidden.get("location"), self.model
        cost = sum_first(self._of_level(model.costs, level).movedim(-1, 0).clone())
        controls = model.split_controls(u)
        repairs = torch.zeros_like(level).scatter_add(-1, location, (controls == REPAIR).to(torch.int64))
        law = self._of_level(model.chain, level)
        works = model.repair_probability * torch.eye(model.num_levels, dtype=law.dtype, device=law.device)[0]
        after = works + (1.0 - model.repair_probability) * law
        level = inverse_cdf(torch.where((repairs > 0).unsqueeze(-1), after, law), noise)
        location = model.destinations[location, controls]
        return cost, self._hidden(level, location), joined(level.gather(-1, location), model.num_levels)

    def figure(self, hidden: TensorDictBase, title: str = "") -> Figure:
        """The true levels on the graph, drawn as the model draws a belief that knows them."""
        belief = torch.nn.functional.one_hot(hidden.get("level"), self.model.num_levels).to(self.model.dtype)
        known = {"belief": belief, "location": hidden.get("location")}
        return self.model.scene().figure(TensorDict(known, batch_size=hidden.batch_size, device=self.model.device), title)

    def _of_level(self, table: Tensor, level: Tensor) -> Tensor:
        """Entries of costs or chain for levels ``[*B, L]``."""
        own = table.ndim - (table is self.model.chain) == 2
        return table[torch.arange(self.model.num_locations, device=level.device), level] if own else table[level]

    def _hidden(self, level: Tensor, location: Tensor) -> TensorDict:
        return TensorDict({"level": level, "location": location}, batch_size=level.shape[:-1], device=self.model.device)
