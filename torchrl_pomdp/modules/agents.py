r"""One policy network for many agents: it is called once for each, which sees what the earlier ones have chosen.

A network over joint controls would have :math:`A^R` outputs. This one has A: the agents, such as robots, decide in turn, as in
:class:`~torchrl_pomdp.modules.MultiagentRollout`, whose labels it learns.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchrl_pomdp.checks import check_instance, check_sizes
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.rows import flat_rows
from torchrl_pomdp.modules.encoders import Encoder, FlatEncoder
from torchrl_pomdp.modules.networks import LocalNetwork, check_finite_output
from torchrl_pomdp.modules.rowwise import RowLinear, product, rowwise
from torchrl_pomdp.modules.scalar import Limited, SearchEngine
from torchrl_pomdp.tensor_checks import check_entries, device_of

__all__ = ["AgentEncoder", "AgentNetwork", "FlatAgentEncoder"]


class AgentEncoder(Encoder):
    """What one agent of many sees: the features of the feature state, features and marks of its own, marks of earlier choices.

    A mark is a feature that is 0 or 1, given by its number: a network adds up the weights of those that are 1.

    Attributes:
        model: the belief model.
        num_own: number of an agent's own features.
        num_marks: number of different marks.
    """

    model: BeliefModel
    num_own: int
    num_marks: int

    @abstractmethod
    def own_features(self, y: TensorDictBase) -> Tensor:
        """Features of every agent's own, ``[N, R, num_own]``, for feature states ``[N]``; a row depends on its state alone."""

    @abstractmethod
    def own_marks(self, y: TensorDictBase) -> Tensor:
        """Marks of every agent, int64 ``[N, R, P]``, for feature states ``[N]``."""

    @abstractmethod
    def choice_marks(self, y: TensorDictBase, agents: slice, controls: Tensor) -> Tensor:
        """Marks of controls ``[N, n]`` that some agents have chosen, int64 ``[N, n, Q]``, seen by all later ones."""


class FlatAgentEncoder(AgentEncoder):
    """For any model: the flattened feature state, which agent it is, and which agent has chosen which control.

    Args:
        model: the belief model.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> encoder = FlatAgentEncoder(make_problem("two_robots20").model)
        >>> encoder.num_features, encoder.num_marks
        (140, 8)
    """

    def __init__(self, model: BeliefModel) -> None:
        super().__init__()
        self.model, self._flat = check_instance("model", model, BeliefModel), FlatEncoder(model)
        self.keys, self.num_features, self.dtype = self._flat.keys, self._flat.num_features, model.dtype
        self.num_own, self.num_marks = 0, model.num_agents * (1 + model.num_agent_controls)

    def encode_rows(self, y: TensorDictBase, rows: Tensor | None) -> Tensor:
        """See :class:`Encoder`."""
        return self._flat.encode_rows(y, rows)

    def own_features(self, y: TensorDictBase) -> Tensor:
        """None."""
        return torch.empty(y.batch_size[0], self.model.num_agents, 0, dtype=self.dtype, device=device_of(y))

    def own_marks(self, y: TensorDictBase) -> Tensor:
        """The number of the agent."""
        return torch.arange(self.model.num_agents, device=device_of(y)).view(1, -1, 1).expand(y.batch_size[0], -1, -1)

    def choice_marks(self, y: TensorDictBase, agents: slice, controls: Tensor) -> Tensor:
        """The agent together with its control."""
        which = torch.arange(self.model.num_agents, device=device_of(y))[agents]
        return (self.model.num_agents + which * self.model.num_agent_controls + controls).unsqueeze(-1)


class AgentNetwork(LocalNetwork):
    r"""Policy network that all agents share; writes ``"logits"`` ``[*B, R, A]`` and ``"action"`` ``[*B, *S]``.

    The agents decide in turn. Logits are ``-inf`` where a control is illegal for the agent, and an agent takes the most
    probable one. Where the entry ``"told"``, int64 ``[*B, R]``, is there, agents see these controls of the earlier ones instead
    of what the network has chosen for them: the network is taught with those of the labels.

    Args:
        encoder: encoder of what an agent sees.
        hidden: sizes of the hidden layers, at least one.
        generator: generator of the initial weights; the global one is left alone.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if there is no hidden layer.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> model = make_problem("two_robots20").model
        >>> network = AgentNetwork(FlatAgentEncoder(model), generator=torch.Generator().manual_seed(0))
        >>> y = network(model.with_features(make_problem("two_robots20").start(torch.arange(6))))
        >>> y["logits"].shape, y["action"].shape
        (torch.Size([6, 2, 3]), torch.Size([6]))
    """

    out_keys = ["logits", "action"]
    own: nn.Parameter
    marks: nn.Parameter

    def __init__(self, encoder: AgentEncoder, hidden: Sequence[int] = (256, 64), *, generator: torch.Generator) -> None:
        model = check_instance("encoder", encoder, AgentEncoder).model
        sizes = check_sizes("hidden", hidden)
        if not sizes:
            raise ValueError("hidden must hold at least one size, got none")
        super().__init__(encoder, [*sizes, model.num_agent_controls], generator)
        # Legal controls are told by the core.
        self.in_keys = [*dict.fromkeys((*encoder.keys, *model.state_keys))]
        bound = (encoder.num_features + encoder.num_own + encoder.num_marks) ** -0.5
        for name, count in (("own", encoder.num_own), ("marks", encoder.num_marks)):
            weight = torch.empty(count, sizes[0], dtype=encoder.dtype, device=generator.device)
            self.register_parameter(name, nn.Parameter(nn.init.uniform_(weight, -bound, bound, generator=generator)))

    @property
    def model(self) -> BeliefModel:
        """The belief model."""
        return cast(AgentEncoder, self.encoder).model

    @property
    def kind(self) -> None:
        """It is evaluated alone."""
        return None

    def scalar_engine(self, model: BeliefModel, limits: Limited) -> SearchEngine | None:
        """None: tensors simulate."""
        return None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"logits"`` and ``"action"`` for feature states ``[*B]``."""
        told = check_instance("tensordict", tensordict, TensorDictBase).get("told", None)
        keys = self.in_keys if told is None else [*self.in_keys, "told"]
        flat = flat_rows(check_entries("tensordict", tensordict, keys).select(*keys))
        logits, controls = self._decide(flat) if told is None else self._taught(flat)
        action = self.model.join_controls(controls)
        entries = TensorDict({"logits": logits, "action": action}, batch_size=flat.batch_size)
        return tensordict.update(entries.reshape(tensordict.batch_size))

    def _first(self, y: TensorDictBase) -> tuple[Tensor, Tensor]:
        """What the first layer makes of the state and of each agent's own ``[N, R, H]``, and legal controls ``[N, R, A]``."""
        encoder = cast(AgentEncoder, self.encoder)
        hidden = rowwise(cast(RowLinear, self.network[0]), encoder.encode_rows(y, None)).unsqueeze(1)
        hidden = hidden + self._weights(encoder.own_marks(y))
        if encoder.num_own:
            own = encoder.own_features(y)
            hidden = hidden + product(own.flatten(0, 1), self.own).view(hidden.shape)
        return hidden, self.model.agent_mask(y)

    def _rest(self, hidden: Tensor, mask: Tensor) -> Tensor:
        """Logits ``[M, A]`` of what the first layer gives, ``[M, H]``."""
        logits = rowwise(self.network[1:], hidden).masked_fill(~mask, -torch.inf)
        check_finite_output("logits", logits.amax(-1))
        return logits

    def _weights(self, marks: Tensor) -> Tensor:
        """Sums ``[..., H]`` of the weights of marks ``[..., P]``."""
        total = self.marks.index_select(0, marks[..., 0].reshape(-1))
        for place in range(1, marks.shape[-1]):
            total = total + self.marks.index_select(0, marks[..., place].reshape(-1))
        return total.view(*marks.shape[:-1], total.shape[-1])

    def _decide(self, y: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Logits ``[N, R, A]`` and controls ``[N, R]``, one agent after the other."""
        encoder = cast(AgentEncoder, self.encoder)
        hidden, mask = self._first(y)
        earlier = torch.zeros_like(hidden[:, 0])
        logits: list[Tensor] = []
        controls: list[Tensor] = []
        for agent in range(self.model.num_agents):
            logits.append(self._rest(hidden[:, agent] + earlier, mask[:, agent]))
            controls.append(logits[-1].argmax(-1))
            choice = encoder.choice_marks(y, slice(agent, agent + 1), controls[-1].unsqueeze(-1))
            earlier = earlier + self._weights(choice.squeeze(1))
        return torch.stack(logits, 1), torch.stack(controls, 1)

    def _taught(self, y: TensorDictBase) -> tuple[Tensor, Tensor]:
        """The same where the earlier agents' controls are told: all agents at once."""
        encoder, told = cast(AgentEncoder, self.encoder), y.get("told")
        hidden, mask = self._first(y)
        choices = self._weights(encoder.choice_marks(y, slice(None), told))
        earlier = choices.cumsum(1) - choices
        logits = self._rest((hidden + earlier).flatten(0, 1), mask.flatten(0, 1)).view(mask.shape)
        return logits, logits.argmax(-1)
