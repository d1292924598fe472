r"""Base policies :math:`\mu` of any problem (paper, Section III)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_pomdp.checks import check_callable, check_instance, check_text
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.tabular import TabularModel
from torchrl_pomdp.modules.policies import Policy, controls_of
from torchrl_pomdp.modules.scalar import Limited, SearchEngine, offer_engines
from torchrl_pomdp.tensor_checks import check_entries, device_of

__all__ = ["Myopic", "as_policy"]


class Myopic(TensorDictModuleBase):
    r"""The legal control of least stage cost :math:`\hat g(y,u)`; of equal ones the first. A base policy for any model.

    Args:
        model: the belief model.

    Raises:
        TypeError: if it is none.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("tiger")
        >>> Myopic(problem.model)(problem.start(torch.arange(2)))["action"].tolist()
        [0, 0]
    """

    out_keys = ["action"]

    def __init__(self, model: BeliefModel) -> None:
        super().__init__()
        self.model = check_instance("model", model, BeliefModel)
        model.check_enumerable("Myopic", "a policy that chooses for each agent")
        self.in_keys = list(model.state_keys)

    def scalar_engine(self, model: BeliefModel, limits: Limited) -> SearchEngine | None:
        """Compiled searches of tabular models, see :class:`~torchrl_pomdp.modules.scalar.SearchEngine`."""
        from torchrl_pomdp.modules.tabular import searches, tabular_engine

        # The same model with another partition has the same tables.
        same = isinstance(self.model, TabularModel) and isinstance(model, TabularModel) and self.model.cost is model.cost
        return tabular_engine(searches.myopic, (), model, limits) if same else None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"``, int64 ``[*B]``."""
        y = check_entries("tensordict", tensordict, self.in_keys)
        every = range(self.model.num_controls)
        costs = torch.stack([self.model.expected_cost(y, torch.full(y.batch_size, u, device=device_of(y))) for u in every], -1)
        # argmin may give any of equal ones; the first is asked for.
        costs = costs.masked_fill(~self.model.action_mask(y), torch.inf)
        least = costs == costs.amin(-1, keepdim=True)
        return tensordict.set("action", least.to(torch.int8).argmax(-1))


class _CallablePolicy(TensorDictModuleBase):
    """A callable as a module that reads all features of a model."""

    out_keys = ["action"]

    def __init__(self, policy: Policy, model: BeliefModel) -> None:
        super().__init__()
        self.policy = policy
        self.in_keys = [str(key) for key in model.feature_spec()]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", controls_of("policy", self.policy, tensordict.copy()))


def as_policy(policy: Any, model: BeliefModel, name: str = "policy") -> TensorDictModuleBase:
    """A policy as a TensorDictModule: itself if it is one, else any callable from feature states to ``"action"``, wrapped.

    Args:
        policy: the policy.
        model: the model whose features the callable may read.
        name: what messages call it.

    Raises:
        TypeError: if it cannot be called, or is a class.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("tiger")
        >>> policy = as_policy(lambda y: y.set("action", y["belief"].argmax(-1)), problem.model)
        >>> policy(problem.model.with_features(problem.start(torch.arange(2))))["action"].shape
        torch.Size([2])
    """
    check_instance("model", model, BeliefModel)
    if isinstance(policy, TensorDictModuleBase):
        return policy
    if isinstance(policy, type):
        raise TypeError(f"{check_text('name', name)} must be a policy, got the class {policy.__name__}: make one of it")
    return _CallablePolicy(check_callable(check_text("name", name), policy), model)


def _tabular_engine(policies: Sequence[Any], model: BeliefModel, limits: Limited) -> SearchEngine | None:
    from torchrl_pomdp.modules.tabular import searches, tabular_engine

    if not policies:
        return tabular_engine(searches.random, (), model, limits)
    return policies[0].scalar_engine(model, limits) if len(policies) == 1 and type(policies[0]) is Myopic else None


offer_engines(TabularModel, _tabular_engine)
