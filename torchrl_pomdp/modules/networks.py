r"""Policy and value networks, :math:`\hat\mu(y,r)` and :math:`\hat J(y,r)` (paper, Sections IV and VI-C)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_pomdp.checks import check_instance, check_integer, check_sizes
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.rows import flat_rows, take_rows
from torchrl_pomdp.modules.encoders import Encoder, transformed
from torchrl_pomdp.modules.rowwise import RowLinear, rowwise
from torchrl_pomdp.modules.scalar import Limited, SearchEngine, local_engine
from torchrl_pomdp.modules.terminal_costs import ClosedFormCost
from torchrl_pomdp.tensor_checks import check_entries, device_of

if TYPE_CHECKING:
    from torchrl.modules import ProbabilisticActor

__all__ = ["LocalNetwork", "PolicyNetwork", "ValueNetwork", "check_finite_output", "evaluate_networks"]


class LocalNetwork(TensorDictModuleBase):
    """A ReLU network over an encoded feature state; base of policy and value networks.

    Args:
        encoder: encoder of feature states.
        sizes: sizes of the hidden layers and of the output.
        generator: generator of the initial weights; the global one is left alone.

    Attributes:
        entry_keys: what :meth:`entries` reads of a feature state.
    """

    entry_keys: Sequence[str]

    def __init__(self, encoder: Encoder, sizes: Sequence[int], generator: torch.Generator) -> None:
        super().__init__()
        check_instance("encoder", encoder, Encoder)
        check_instance("generator", generator, torch.Generator)
        self.encoder = encoder
        self.network = _relu_network([encoder.num_features, *sizes], encoder.dtype, generator)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> LocalNetwork:
        """Refuse another type than the encoder's, which is the model's: ``double``, ``half`` and the like."""
        dtype = fn(torch.ones(1, dtype=self.encoder.dtype)).dtype
        if dtype != self.encoder.dtype:
            raise ValueError(
                f"a network stays in the type {self.encoder.dtype} of its model; build the model with dtype={dtype}"
            )
        return super()._apply(fn, recurse)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the ``out_keys`` for feature states ``[*B]``."""
        flat = flat_rows(check_entries("tensordict", tensordict, self.in_keys).select(*self.in_keys))
        rows = torch.arange(flat.batch_size[0], device=device_of(flat))
        entries = evaluate_networks([self], flat, rows, [rows.numel()])
        return tensordict.update(entries.reshape(tensordict.batch_size))

    @property
    def kind(self) -> tuple[Any, ...] | None:
        """What networks have in common that can be evaluated together; None for one that is evaluated alone."""
        return type(self), self.encoder

    def entries(self, output: Tensor, y: TensorDictBase) -> TensorDictBase:
        """What the outputs ``[M, .]`` of the last layer mean at feature states ``y`` ``[M]``, for networks with a kind."""
        raise NotImplementedError


class PolicyNetwork(LocalNetwork):
    r"""Masked policy network :math:`\hat\mu(y,r)`, 256-64 in the paper; writes ``"logits"`` and ``"action"``.

    Logits ``[*B, U]`` are ``-inf`` where a control is illegal; the action int64 ``[*B]`` is the most probable one.

    Args:
        encoder: encoder of feature states.
        num_controls: U.
        hidden: sizes of the hidden layers.
        generator: generator of the initial weights; the global one is left alone.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules import FlatEncoder
        >>> problem = make_problem("linear20")
        >>> network = PolicyNetwork(FlatEncoder(problem.model), 3, generator=torch.Generator().manual_seed(0))
        >>> y = network(problem.model.with_features(problem.start(torch.arange(6))))
        >>> y["logits"].shape, bool(y["action_mask"].gather(1, y["action"][:, None]).all())
        (torch.Size([6, 3]), True)
    """

    out_keys = ["logits", "action"]

    def __init__(
        self, encoder: Encoder, num_controls: int, hidden: Sequence[int] = (256, 64), *, generator: torch.Generator
    ) -> None:
        num_controls = check_integer("num_controls", num_controls, 1, 1 << 20)
        super().__init__(encoder, [*check_sizes("hidden", hidden), num_controls], generator)
        self.entry_keys = ["action_mask"]
        self.in_keys = [*encoder.keys, *self.entry_keys]

    def scalar_engine(self, model: BeliefModel, limits: Limited) -> SearchEngine | None:
        """Compiled simulations, see :func:`~torchrl_pomdp.modules.scalar.scalar_engine`."""
        return local_engine([self], model, limits)

    def entries(self, output: Tensor, y: TensorDictBase) -> TensorDictBase:
        """``"logits"`` and ``"action"``; see the class."""
        logits = output.masked_fill(~y.get("action_mask"), -torch.inf)
        best, action = logits.max(-1)
        # One check for all: of NaN, of infinite logits, and of a state without a legal control.
        check_finite_output("logits", best)
        return TensorDict({"logits": logits, "action": action}, y.batch_size)

    def actor(self) -> ProbabilisticActor:
        """The policy as an actor of TorchRL, which draws legal controls by the softmax of the logits; weights are shared.

        The network itself takes the most probable control. Where a module writes an action, TorchRL's actors draw none: given
        the network they would not explore.

        Examples:
            >>> from torchrl_pomdp.modules import FlatEncoder
            >>> from torchrl_pomdp.problems import make_problem
            >>> problem = make_problem("tiger")
            >>> network = PolicyNetwork(FlatEncoder(problem.model), 3, (8,), generator=torch.Generator().manual_seed(0))
            >>> y = network.actor()(problem.model.with_features(problem.start(torch.arange(5))))
            >>> y["action_log_prob"].shape
            torch.Size([5])
        """
        from tensordict.nn import InteractionType
        from torchrl.modules import MaskedCategorical, ProbabilisticActor

        return ProbabilisticActor(
            _Logits(self),
            in_keys={"logits": "logits", "mask": "action_mask"},
            out_keys=["action"],
            distribution_class=MaskedCategorical,
            return_log_prob=True,
            default_interaction_type=InteractionType.RANDOM,
        )


class _Logits(TensorDictModuleBase):
    """A policy network without its control."""

    out_keys = ["logits"]

    def __init__(self, network: PolicyNetwork) -> None:
        super().__init__()
        self.network, self.in_keys = network, network.in_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"logits"``."""
        return tensordict.set("logits", self.network(tensordict.select(*self.in_keys)).get("logits"))


class ValueNetwork(LocalNetwork):
    r"""Value network :math:`\hat J(y,r)`, 256-128-64 in the paper; writes ``"state_value"`` ``[*B]``, a cost.

    Costs-to-go span many orders of magnitude. The network gives their ratio to a known positive cost of the state, such as
    that of never repairing, which lies in a narrow range.

    Args:
        encoder: encoder of feature states.
        scale: positive cost of a state.
        hidden: sizes of the hidden layers.
        generator: generator of the initial weights; the global one is left alone.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules import FlatEncoder
        >>> from torchrl_pomdp.modules.repair import NeverRepairCost
        >>> problem = make_problem("linear20")
        >>> scale = NeverRepairCost(problem.model)
        >>> network = ValueNetwork(FlatEncoder(problem.model), scale, generator=torch.Generator().manual_seed(0))
        >>> network(problem.start(torch.arange(6)))["state_value"].shape
        torch.Size([6])
    """

    out_keys = ["state_value"]

    def __init__(
        self,
        encoder: Encoder,
        scale: ClosedFormCost,
        hidden: Sequence[int] = (256, 128, 64),
        *,
        generator: torch.Generator,
    ) -> None:
        check_instance("scale", scale, ClosedFormCost)
        super().__init__(encoder, [*check_sizes("hidden", hidden), 1], generator)
        self.scale = scale
        self.entry_keys = list(scale.in_keys)
        self.in_keys = [*dict.fromkeys((*encoder.keys, *self.entry_keys))]

    @property
    def kind(self) -> tuple[Any, ...]:
        """What networks have in common that can be evaluated together: the scale, too."""
        return type(self), self.encoder, self.scale

    def entries(self, output: Tensor, y: TensorDictBase) -> TensorDictBase:
        """``"state_value"``; see the class."""
        value = output.squeeze(-1) * self.scale.costs(y)
        check_finite_output("state_value", value)
        return TensorDict({"state_value": value}, y.batch_size)


def evaluate_networks(
    networks: Sequence[LocalNetwork], y: TensorDictBase, rows: Tensor, counts: Sequence[int]
) -> TensorDictBase:
    """Entries ``[M]`` of networks of one kind, each at rows of its own.

    Args:
        networks: the networks, of the same :attr:`LocalNetwork.kind`.
        y: feature states ``[N]``.
        rows: int64 ``[M]``, numbers of rows of ``y``.
        counts: the first network is evaluated at the first ``counts[0]`` of ``rows``, the second at the next, ...
    """
    first = [cast(RowLinear, network.network[0]) for network in networks]
    hidden = networks[0].encoder.first_layers(y, rows, first, counts)
    outputs = []
    for network, (block, places) in zip(networks, hidden, strict=True):
        output = rowwise(network.network[1:], block)
        outputs.append(output if places is None else output.index_select(0, places))
    return networks[0].entries(torch.cat(outputs), take_rows(y.select(*networks[0].entry_keys), rows))


def check_finite_output(name: str, values: Tensor) -> None:
    """Raise unless what a network gives is finite; called ``name`` in messages."""
    if not transformed() and not bool(torch.isfinite(values).all()):
        wrong = values[~torch.isfinite(values)][0].item()
        raise ValueError(
            f"{name} of a network must be finite, got {wrong}: a weight is no number, or the state has no legal control"
        )


def _relu_network(sizes: Sequence[int], dtype: torch.dtype, generator: torch.Generator) -> nn.Sequential:
    """Linear layers of the given sizes with ReLU between them, PyTorch's default initialisation from ``generator``."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in pairwise(sizes):
        layer = nn.utils.skip_init(RowLinear, fan_in, fan_out, device=generator.device, dtype=dtype)
        for parameter in layer.parameters():
            nn.init.uniform_(parameter, -(fan_in**-0.5), fan_in**-0.5, generator=generator)
        layers += [layer, nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])
