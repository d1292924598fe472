"""What policy iteration needs to know of a problem beside its model (paper, Sections IV to VI)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_pomdp.checks import check_callable, check_instance, check_label, check_mapping
from torchrl_pomdp.envs.belief_model import BeliefModel, StateGenerator
from torchrl_pomdp.envs.generators import InPart, Mixture, RandomPlay
from torchrl_pomdp.envs.partition import Partition, SinglePart
from torchrl_pomdp.envs.rows import random_control
from torchrl_pomdp.modules.agents import AgentEncoder, FlatAgentEncoder
from torchrl_pomdp.modules.base_policies import Myopic, as_policy
from torchrl_pomdp.modules.encoders import Encoder, FlatEncoder
from torchrl_pomdp.modules.policies import Policy
from torchrl_pomdp.modules.terminal_costs import ClosedFormCost, ConstantCost, ZeroCost
from torchrl_pomdp.tensor_checks import check_representable

__all__ = ["Problem", "Symmetry"]

Symmetry = Callable[[TensorDictBase], TensorDictBase]
"""A renaming under which the model stays what it is: maps feature states and labels ``[*B]`` to their images."""

# So many states of random play show the stage costs of a model without a known bound.
_STATES = 2048
# And so many joint controls of each, where there are too many to try them all.
_DRAWS = 32
# Start states that show whether the first symmetry is the identity, and whether pessimistic costs are positive.
_IMAGES = 16
# Stands for what is made of the model.
_DEFAULT: Any = None


def identity_symmetry(y: TensorDictBase) -> TensorDictBase:
    """The symmetry that every problem has: each state is its own image."""
    return y.copy()


@dataclass(frozen=True, eq=False)
class Problem:
    r"""A belief model with all that goes with it; ``Problem(model, start)`` alone can be trained.

    Attributes:
        model: the belief model. One without a partition gets :class:`~torchrl_pomdp.envs.SinglePart`, N = 1.
        start: start states of play and evaluation.
        name: what logs, tables and files call it.
        training: one generator of random training states for each part of the partition. By default the states
            of the part that random play reaches, see :class:`~torchrl_pomdp.envs.RandomPlay`; states that policies visit
            come on top of them in any case.
        base_policies: policies that need no training, by name; the first is the baseline of tables. Any callable that
            writes ``"action"``. By default ``myopic``, the control of least stage cost.
        pessimistic_cost: a positive cost of every state: the scale of value networks, and what is added where a simulation
            is cut. By default :math:`\max|\hat g|/(1-\alpha)`, with the model's ``max_cost`` or, where it has none, the
            largest stage cost that random play meets.
        symmetries: renamings under which labels stay labels, the identity first. By default the identity alone. Where agents
            decide in turn, the others must say by a true attribute ``keeps_order`` that they rename no agents, or are not used.
        encoder: what makes the encoder of the networks from the model. By default
            :class:`~torchrl_pomdp.modules.FlatEncoder`.
        agent_encoder: what makes the encoder of networks that many agents share. By default
            :class:`~torchrl_pomdp.modules.FlatAgentEncoder`.
        spec: plain JSON from which the problem can be built again, see :func:`~torchrl_pomdp.problems.problem_from_spec`;
            None for a problem of the user's own code, which is given back when a checkpoint is loaded.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if there is not one training generator for each part, or no base policy, the first symmetry changes
            start states, or these are no states of the model.

    Examples:
        >>> from torchrl_pomdp.envs import FixedBelief, TabularModel
        >>> change = torch.tensor([[[0.9, 0.1], [0.0, 1.0]], [[1.0, 0.0], [1.0, 0.0]]])
        >>> see = torch.full((2, 2, 1), 1.0)
        >>> model = TabularModel(change, see, torch.tensor([[0.0, 5.0], [2.0, 5.0]]), 0.5)
        >>> problem = Problem(model, FixedBelief(torch.tensor([1.0, 0.0])), name="machine")
        >>> problem.model.partition.num_parts, list(problem.base_policies), problem.pessimistic_cost.cost
        (1, ['myopic'], 10.0)
    """

    model: BeliefModel
    start: StateGenerator
    name: str = "problem"
    training: Sequence[StateGenerator] = _DEFAULT
    base_policies: Mapping[str, Policy] = _DEFAULT
    pessimistic_cost: ClosedFormCost = _DEFAULT
    symmetries: Sequence[Symmetry] = (identity_symmetry,)
    encoder: Callable[[Any], Encoder] = FlatEncoder
    agent_encoder: Callable[[Any], AgentEncoder] = FlatAgentEncoder
    spec: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        check_label("name", self.name)
        check_callable("start", self.start)
        check_callable("encoder", self.encoder)
        check_callable("agent_encoder", self.agent_encoder)
        model = check_instance("model", self.model, BeliefModel)
        if model.partition is None:
            model = model.with_partition(SinglePart())
        model.drawn(self.start, torch.arange(1, device=model.device), "start")
        self._set(model=model)
        self._set(
            training=self._checked_training(),
            base_policies=_checked_policies(self.base_policies, model),
            symmetries=_checked_symmetries(self.symmetries),
        )
        _check_identity(self.symmetries[0], model, self.start)
        if self.spec is not None:
            object.__setattr__(self, "spec", copy.deepcopy(check_mapping("spec", self.spec, object)))
        if self.pessimistic_cost is None:
            bound = model.max_cost if model.max_cost is not None else _largest_cost(model, self.start)
            for_ever = (bound or 1.0) / (1.0 - model.discount)
            check_representable("cost of the model, paid for ever,", for_ever, model.dtype)
            self._set(pessimistic_cost=ConstantCost(model, for_ever))
        check_instance("pessimistic_cost", self.pessimistic_cost, ClosedFormCost)
        _check_positive(self.pessimistic_cost, self.start, model.device)

    @property
    def evaluation_cost(self) -> ClosedFormCost:
        """What an evaluation adds where a trajectory is cut: the pessimistic cost of the state; nothing if that is a constant.

        A constant bounds the costs of all states from far above, and would be most of a small cost. What an evaluation leaves
        out at the model's horizon weighs a thousandth, of costs that stay the same; where that takes more than 400 stages, as
        at discounts above 0.9828, up to eighteen thousandths: with 0.99 a cost of 1 a stage for ever, 100 in all, is 98.2.

        Policy iteration validates with the pessimistic cost even so.
        """
        return ZeroCost() if isinstance(self.pessimistic_cost, ConstantCost) else self.pessimistic_cost

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _checked_training(self) -> tuple[StateGenerator, ...]:
        parts = self.partition.num_parts
        if self.training is None:
            play = RandomPlay(self.model, self.start)
            return tuple(InPart(self.model, play, part) for part in range(parts))
        given = tuple(check_instance("training", self.training, (tuple, list)))
        for part, generator in enumerate(given):
            check_callable(f"training[{part}]", generator)
        if len(given) != parts:
            raise ValueError(f"training must hold {parts} generators, one for each part, got {len(given)}")
        return given

    @property
    def partition(self) -> Partition:
        """The partition of the model."""
        return cast(Partition, self.model.partition)

    @property
    def baseline(self) -> str:
        """Name of the base policy that others are compared with."""
        return next(iter(self.base_policies))

    def unpartitioned(self) -> Problem:
        """The same problem with a single part; its training states are those of all parts, in equal shares.

        Examples:
            >>> from torchrl_pomdp.problems import make_problem
            >>> make_problem("linear20").unpartitioned().model.partition.num_parts
            1
        """
        if isinstance(self.partition, SinglePart):
            return self
        spec = None if self.spec is None else {**self.spec, "partitioned": False}
        training = (Mixture(self.training, [1.0] * len(self.training)),)
        return replace(self, model=self.model.with_partition(SinglePart()), training=training, spec=spec)


def _check_positive(cost: ClosedFormCost, start: StateGenerator, device: torch.device) -> None:
    """Raise if some of the start states have negative pessimistic costs; terminal ones may have none."""
    costs = cost.costs(start(torch.arange(_IMAGES, device=device)))
    if bool((costs < 0).any()):
        raise ValueError(
            f"pessimistic_cost must be positive, as networks' values are multiples of it, got {float(costs.min())} in a start "
            "state; where costs are negative rewards, a bound of their size will do"
        )


def _checked_policies(policies: Any, model: BeliefModel) -> dict[str, TensorDictModuleBase]:
    if policies is None:
        return {"myopic": Myopic(model)}
    check_mapping("base_policies", policies, object)
    if not policies:
        raise ValueError("base_policies is empty: give at least one policy, or None for the myopic one")
    for name in policies:
        check_label("name in base_policies", name)
    return {name: as_policy(policy, model, f"base_policies[{name!r}]") for name, policy in policies.items()}


def _checked_symmetries(symmetries: Any) -> tuple[Symmetry, ...]:
    given = tuple(check_instance("symmetries", symmetries, (tuple, list)))
    if not given:
        raise ValueError("symmetries is empty: it holds at least the identity, which is the default")
    for i, symmetry in enumerate(given):
        check_callable(f"symmetries[{i}]", symmetry)
    return given


def _check_identity(symmetry: Symmetry, model: BeliefModel, start: StateGenerator) -> None:
    """Raise unless the first symmetry, the only one without mirror images, maps some start states to themselves."""
    if symmetry is identity_symmetry:
        return
    y = model.drawn(start, torch.arange(_IMAGES, device=model.device), "start")
    image = check_instance("symmetries[0](y)", symmetry(model.with_features(y)), TensorDictBase)
    moved = next((k for k in model.state_keys if image.get(k, None) is None or not torch.equal(image.get(k), y.get(k))), None)
    if moved is not None:
        raise ValueError(f"symmetries must hold the identity first, got one that changes {moved!r} in start states")


def _largest_cost(model: BeliefModel, start: StateGenerator) -> float:
    """The largest absolute stage cost in states of random play: of any legal control, or of random ones of many agents."""
    keys = torch.arange(_STATES, device=model.device)
    y = RandomPlay(model, start)(keys)
    mask, live = model.action_mask(y), ~model.is_terminal(y)
    largest = 0.0
    for number in range(model.num_controls if model.enumerable else _DRAWS):
        if model.enumerable:
            u, counts = torch.full_like(keys, number), mask[:, number] & live
        else:
            u, counts = random_control(mask, model.control_noise(keys, number)), live
        largest = max(largest, float(model.expected_cost(y, u).abs().masked_fill(~counts, 0.0).max()))
    return largest
