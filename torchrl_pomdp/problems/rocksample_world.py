"""The hidden states of RockSample: which rocks are good."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite

from torchrl_pomdp.envs.world import World
from torchrl_pomdp.problems.rocksample_model import BAD, FIRST_CHECK, GOOD, NONE, REWARD, SAMPLE, RockSample

__all__ = ["RockWorld"]


class RockWorld(World):
    """The rocks of a :class:`RockSample`; entries ``"good"`` bool ``[*B, k]`` and ``"location"`` int64 ``[*B, 1]``.

    Args:
        model: the RockSample model.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("rocksample7x8")
        >>> world, keys = problem.model.world(), torch.arange(1)
        >>> hidden = world.sample(problem.start(keys), keys)
        >>> hidden["good"].int().tolist()
        [[0, 0, 0, 0, 1, 0, 0, 0]]
        >>> _, _, z = world.step(hidden, torch.tensor([FIRST_CHECK + 6]), keys)
        >>> problem.model.observation_names[z]
        'bad'
    """

    model: RockSample
    noise_dim = 1

    def __init__(self, model: RockSample) -> None:
        super().__init__(model)
        self.draw_dim = model.num_rocks

    def hidden_spec(self, batch_size: torch.Size | tuple[int, ...] = ()) -> Composite:
        """``good`` ``[*B, k]`` and ``location`` ``[*B, 1]``."""
        shape, model = torch.Size(batch_size), self.model
        return Composite(
            good=Binary(model.num_rocks, shape=(*shape, model.num_rocks), dtype=torch.bool, device=model.device),
            location=Categorical(model.exit + 1, shape=(*shape, 1), dtype=torch.int64, device=model.device),
            shape=shape,
            device=model.device,
        )

    def action_mask(self, hidden: TensorDictBase) -> Tensor:
        """The legal controls, bool ``[*B, U]``; they depend on the cell alone."""
        return self.model.action_mask(hidden)

    def is_terminal(self, hidden: TensorDictBase) -> Tensor:
        """Bool ``[*B]``: the rover has left."""
        return self.model.is_terminal(hidden)

    def draw(self, y: TensorDictBase, noise: Tensor) -> TensorDictBase:
        """Each rock good or bad by its probability; see :meth:`World.draw`."""
        return self._hidden(noise < y.get("belief"), y.get("location"))

    def advance(self, hidden: TensorDictBase, u: Tensor, noise: Tensor) -> tuple[Tensor, TensorDictBase, Tensor]:
        """What sampling or leaving pays, where the rover goes, what a check shows; see :meth:`World.advance`."""
        rocks, location, model = hidden.get("good"), hidden.get("location"), self.model
        pair = location.squeeze(-1) * model.num_controls + u
        rock = model.concerns[pair].unsqueeze(-1)
        good = rocks.gather(-1, rock).squeeze(-1)
        paid = REWARD - 2.0 * REWARD * good.to(model.dtype)
        cost = torch.where(u == SAMPLE, paid, model.exit_cost[pair])
        right = noise[..., 0] < model.accuracy[pair]
        z = torch.where(right == good, GOOD, BAD).masked_fill(u < FIRST_CHECK, NONE)
        rocks = rocks.scatter(-1, rock, (good & (u != SAMPLE)).unsqueeze(-1))
        return cost, self._hidden(rocks, model.destinations[pair].unsqueeze(-1)), z

    def _hidden(self, good: Tensor, location: Tensor) -> TensorDict:
        return TensorDict({"good": good, "location": location}, batch_size=good.shape[:-1], device=self.model.device)
