"""Compiled searches of tabular models."""

from __future__ import annotations

from typing import Any

import numpy as np
from tensordict import TensorDictBase

from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.tabular import TabularModel
from torchrl_pomdp.modules.scalar import MOST_NUMBERS, Limited, Roots, SearchEngine
from torchrl_pomdp.modules.tabular.searches import TabularHistory, TabularTables, tabular_model
from torchrl_pomdp.noise import fold
from torchrl_pomdp.scalar.twins import ScalarTwin

__all__ = ["TabularEngine", "tabular_engine"]


def tabular_engine(twin: ScalarTwin, data: tuple[Any, ...], model: BeliefModel, limits: Limited) -> TabularEngine | None:
    """The engine for a policy with a twin; None where the tables are too large, or simulations shall be cut by rules.

    Args:
        twin: the policy; it sees a :class:`TabularView`.
        data: what the twin reads.
        model: the model that is searched.
        limits: when simulations end.

    Examples:
        >>> from torchrl_pomdp.modules import Myopic
        >>> from torchrl_pomdp.modules.scalar import scalar_engine
        >>> from torchrl_pomdp.problems import tiger
        >>> model = tiger().model
        >>> type(scalar_engine(Myopic(model), model, Limited(100, None, None))).__name__
        'TabularEngine'
    """
    if type(model) is not TabularModel or limits.truncation is not None or limits.terminal_cost is not None:
        return None
    size = model.num_controls * model.num_states * max(model.num_states, model.num_observations)
    return TabularEngine((twin, data), model, limits) if size <= MOST_NUMBERS else None


class TabularEngine(SearchEngine):
    """Searches one history at a time, in double precision."""

    def __init__(self, policy: tuple[ScalarTwin, tuple[Any, ...]], model: TabularModel, limits: Limited) -> None:
        self.policy, self.model = policy, model
        transition, observation = (
            np.ascontiguousarray(each.to_dense().double().numpy()) for each in (model.transition, model.observation)
        )
        costs = np.ascontiguousarray(model.cost.double().numpy())
        least = float(np.where(model.legal.numpy().T, costs, np.inf).min())
        self.tables = TabularTables(
            transition=transition,
            observation=observation,
            costs=costs,
            illegal=np.ascontiguousarray(~model.legal.numpy()),
            going=np.ascontiguousarray(~model.terminal.numpy()),
            discount=model.discount,
            max_steps=limits.max_steps,
            least=min(0.0, least) / (1.0 - model.discount),
        )

    def roots(self, y: TensorDictBase, seed: int) -> Roots:
        """See :class:`SearchEngine`."""
        model = self.model
        beliefs = np.ascontiguousarray(y.get("belief").reshape(-1, model.num_states).double().numpy())
        # Bounds of costs hold for distributions in double precision; in a copy, as the caller's may be of that type.
        beliefs = beliefs / beliefs.sum(-1, keepdims=True)
        keys = fold(model.fingerprint(y).reshape(-1), seed)

        def state(number: int) -> TabularHistory:
            return TabularHistory(
                root=beliefs[number],
                belief=np.empty(model.num_states),
                predicted=np.empty(model.num_states),
                probs=np.empty(model.num_observations),
                numbers=np.zeros(2, np.int64),
                controls=np.zeros(1, np.int64),
                legal=np.empty(model.num_controls, np.bool_),
            )

        streams = np.ascontiguousarray(keys.numpy()).view(np.uint64)
        return Roots((tabular_model, (self.tables,)), self.policy, streams, state, 1 + model.num_states, self.tables.least)
