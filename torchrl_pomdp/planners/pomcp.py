r"""POMCP: Monte-Carlo tree search over histories (Silver & Veness, 2010), one of the paper's peers (Section VI-D)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_pomdp.checks import check_number
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.modules.policies import Policy
from torchrl_pomdp.modules.scalar import Roots
from torchrl_pomdp.planners.tree_search import TreeSearch, grown

__all__ = ["POMCP"]

# Nodes that a tree starts with.
_NODES = 1024


class POMCP(TreeSearch):
    r"""POMCP: simulations that grow a tree of histories, guided by UCB1; rollouts of a base policy from its leaves.

    The belief at the root is exact, and so is every stage cost: :math:`\hat g` under the belief of the simulated history, not
    the cost of a hidden state. Observations have the law that they have given hidden states. A simulation adds one node. At a
    node it takes the control that minimises

    .. math:: Q(h,u)-c\,\sqrt{\log N(h)/N(h,u)},

    where c is ``exploration`` times the range of the simulations' costs so far; controls that were never taken come first.

    ``"q_factors"`` are means over all simulations, those that explored among them: they fall towards the best policy's cost as
    the tree grows. With random play for a base policy that takes very long.

    Args:
        model: the belief model; it needs a scalar twin, as repair and tabular models have unless their
            tables are very large.
        base_policy: rollout policy with a scalar twin; None: any legal control, all equally likely.

    Keyword Args:
        simulations: how many a decision makes; or
        seconds: how long it takes; it answers with what it has.
        exploration: constant of UCB1 as a fraction of the range, not negative; 1 is the choice of Silver & Veness.
        max_steps: stages after which simulations end; None: :attr:`BeliefModel.horizon`.
        seed: seed of the simulations. They depend on it and on the feature state alone.

    Raises:
        ImportError: if numba, which the extra ``fast`` installs, is missing.
        TypeError: if an argument is of the wrong kind.
        ValueError: if a number is out of range, not exactly one of ``simulations`` and ``seconds`` is given, or model or
            policy have no scalar twin.

    Examples:
        >>> import torch
        >>> from torchrl_pomdp.modules.repair import UrgencyRepair
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> planner = POMCP(problem.model, UrgencyRepair(problem.model), simulations=100)
        >>> y = planner(problem.start(torch.arange(2)))
        >>> y["action"].shape, y["q_factors"].shape
        (torch.Size([2]), torch.Size([2, 3]))
    """

    def __init__(
        self,
        model: BeliefModel,
        base_policy: Policy | None = None,
        *,
        simulations: int | None = None,
        seconds: float | None = None,
        exploration: float = 0.2,
        max_steps: int | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(model, base_policy, simulations=simulations, seconds=seconds, max_steps=max_steps, seed=seed)
        self.exploration = check_number("exploration", exploration, "[0, inf)")

    def _decide(self, roots: Roots, number: int, found: NDArray[np.float64]) -> int:
        from torchrl_pomdp.planners.pomcp_loop import Path, search

        state, tree, done, steps = roots.state(number), self._tree(), 0, 0
        path = Path(np.empty(self.max_steps + 1, np.int64), np.empty(self.max_steps + 1, np.int64))
        for more in self.budget.stretches():
            last = done + more
            while done < last:
                args = (
                    roots.model, roots.policy, state, tree, path, roots.keys[number], done, last, self.exploration,
                    self.model.discount, self.model.num_observations,
                )  # fmt: skip
                done, made, well = self.call(search, *args)
                self.check_legal(well)
                steps += made
                if done < last:
                    tree = self._grown(tree)
        found[:] = np.where(tree.legal[0] & (tree.counts[0] > 0), tree.means[0], np.inf)
        return steps

    def _grown(self, tree: Any) -> Any:
        """The same tree with room for twice as many nodes."""
        from torchrl_pomdp.planners.pomcp_loop import put_edges

        size, spread, *nodes, names, children = tree
        table = np.zeros(2 * len(names), np.uint64), np.full(2 * len(names), -1)
        result = type(tree)(size, spread, *(grown(each) for each in nodes), *table)
        self.call(put_edges, result, names, children)
        return result

    def _tree(self) -> Any:
        from torchrl_pomdp.planners.pomcp_loop import Tree

        shape = _NODES, self.model.num_controls
        return Tree(
            size=np.zeros(1, np.int64),
            spread=np.array([np.inf, -np.inf]),
            counts=np.zeros(shape, np.int64),
            means=np.zeros(shape),
            costs=np.zeros(shape),
            legal=np.zeros(shape, np.bool_),
            ended=np.zeros(_NODES, np.bool_),
            names=np.zeros(2 * _NODES, np.uint64),
            children=np.full(2 * _NODES, -1),
        )
