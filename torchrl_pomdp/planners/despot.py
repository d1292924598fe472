r"""DESPOT: determinized sparse partially observable trees (Somani, Ye, Hsu & Lee 2013; Ye, Somani, Hsu & Lee 2017)."""

from __future__ import annotations

import math
from itertools import chain
from time import perf_counter
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_choice, check_instance, check_integer, check_number
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.modules.policies import Policy
from torchrl_pomdp.modules.rollout import MAX_STEPS, MAX_TRAJECTORIES
from torchrl_pomdp.modules.scalar import Roots
from torchrl_pomdp.planners.tree_search import TreeSearch, grown

__all__ = ["DESPOT"]

# Nodes that a tree starts with, beside those of the root's children; and entries of its lists of scenarios for each.
_NODES, _SHARES = 256, 8
# Bounds that are so close, relative to them, are one.
_CLOSED = 1e-9


class DESPOT(TreeSearch):
    r"""DESPOT: the tree of all controls and of the observations of K scenarios, searched best bound first.

    A scenario is a stream of random numbers that gives, with a history, the next observation; the controls share it. Costs
    are :math:`\hat g` under the belief of the history. At every node the base policy, simulated in the node's scenarios, bounds
    the cost of the best policy from above, and ``bound`` from below. Explorations follow the control of the lowest lower
    bound and the observation of the largest gap, and stop where the gap is a share ``gap`` of the root's. A policy tree is
    charged ``regularisation`` for each of its nodes, so that what few scenarios suggest is not overrated. Where no tree is
    better than the base policy, its control is chosen; of controls that cost the same, the lower one. With random play and
    trivial bounds an exploration goes down to depth D; a decision needs time for several, or what they explored is overrated.

    Args:
        model: the belief model; it needs a scalar twin, as repair and tabular models have unless their
            tables are very large.
        base_policy: default policy with a scalar twin; None: any legal control, all equally likely, drawn anew
            in every scenario and at every stage. It reads histories only.

    Keyword Args:
        simulations: explorations of a decision; fewer where the gap is closed; or
        seconds: how long it takes; it answers with what it has.
        scenarios: K.
        depth: largest depth D of the tree; None: ``max_steps``.
        regularisation: :math:`\lambda`, a cost, not negative.
        gap: :math:`\xi`, in [0, 1).
        bound: ``"relaxed"``: what is known of the model, for repair models that robots must travel (all damage is visible, and
            repaired when a robot can be there); ``"trivial"``: that costs are not below the least one.
        max_steps: stages after which simulations end; None: :attr:`BeliefModel.horizon`.
        seed: seed of the scenarios. They depend on it and on the feature state alone.

    Raises:
        ImportError: if numba, which the extra ``fast`` installs, is missing.
        TypeError: if an argument is of the wrong kind.
        ValueError: if a number is out of range, not exactly one of ``simulations`` and ``seconds`` is given, or model or
            policy have no scalar twin.
        RuntimeError: when called, if a lower bound exceeds an upper one: the model's bound is wrong.

    Examples:
        >>> import torch
        >>> from torchrl_pomdp.modules.repair import UrgencyRepair
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> planner = DESPOT(problem.model, UrgencyRepair(problem.model), simulations=20)
        >>> planner(problem.start(torch.arange(2)))["q_factors"].shape
        torch.Size([2, 3])
    """

    _extra = 2

    def __init__(
        self,
        model: BeliefModel,
        base_policy: Policy | None = None,
        *,
        simulations: int | None = None,
        seconds: float | None = None,
        scenarios: int = 100,
        depth: int | None = None,
        regularisation: float = 0.0,
        gap: float = 0.95,
        bound: Literal["relaxed", "trivial"] = "relaxed",
        max_steps: int | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(model, base_policy, simulations=simulations, seconds=seconds, max_steps=max_steps, seed=seed)
        self.scenarios = check_integer("scenarios", scenarios, 1, MAX_TRAJECTORIES)
        self.depth = check_integer("depth", self.max_steps if depth is None else depth, 1, MAX_STEPS)
        self.regularisation = check_number("regularisation", regularisation, "[0, inf)")
        self.gap = check_number("gap", gap, "[0, 1)")
        self.bound = check_choice("bound", bound, ("relaxed", "trivial"))

    def bounds(self, y: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Bounds of the cost of the best policy tree over the scenarios of states ``[*B]``, with its regularisation: ``[*B]``.

        Args:
            y: feature states.

        Returns:
            lower and upper bound; the latter is the cost of a policy that has been found. They differ from those of the best
            policy's expected cost as the mean over K scenarios does.
        """
        found = self._search(check_instance("y", y, TensorDictBase)).to(self.model.dtype)
        return found[..., -2], found[..., -1]

    def _decide(self, roots: Roots, number: int, found: NDArray[np.float64]) -> int:
        from torchrl_pomdp.planners.despot_loop import OVER, Options, answer, expand, walk

        tight = self.bound == "relaxed"
        random = self.base_policy is None
        options = Options(self.scenarios, self.depth, self.regularisation, self.gap, self.model.discount, tight, random)
        state, memory, key = roots.state(number), np.empty(self.scenarios, np.int64), roots.keys[number]
        tree, steps = self._tree(roots.width), 0
        until = perf_counter() + (self.budget.seconds or math.inf)

        def grow(node: int) -> int:
            made, how = self.call(expand, roots.model, roots.policy, state, tree, memory, key, node, options, roots.least)
            self._check(how)
            return int(made)

        def explore() -> int:
            nonlocal tree
            node, made = OVER, 0
            while True:
                node, crossed = self.call(walk, tree, node, options)
                self._check_bounds(crossed)
                if node == OVER:
                    return made
                tree = self._with_room(tree, node)
                made += grow(node)
                # An exploration may go down hundreds of nodes.
                if perf_counter() > until:
                    self._check_bounds(self.call(walk, tree, node, options)[1])
                    return made

        steps += grow(OVER)
        if not math.isfinite(tree.upper[0]):
            raise ValueError(f"bounds must be finite, got {tree.upper[0]}: the model's costs overflow")
        for _ in chain.from_iterable(map(range, self.budget.stretches())):
            if tree.upper[0] - tree.lower[0] <= _CLOSED * abs(tree.upper[0]) and not tree.open[0]:
                break
            steps += explore()
        if not tree.ended[0]:
            self.call(answer, tree, options, found[:-2])
        found[-2:] = tree.lower[0], tree.upper[0]
        return steps

    def _check(self, how: int) -> None:
        from torchrl_pomdp.planners.despot_loop import CROSSED, ILLEGAL

        self.check_legal(how != ILLEGAL)
        self._check_bounds(how == CROSSED)

    def _check_bounds(self, crossed: bool) -> None:
        if crossed:
            raise RuntimeError("a lower bound of the cost exceeds an upper one: the relaxation of the model is wrong")

    def _with_room(self, tree: Any, node: int) -> Any:
        """The tree with room for the children of a node, however many."""
        most = int(tree.counts[node]) * self.model.num_controls
        while tree.size[0] + most > len(tree.counts) or tree.size[1] + most > len(tree.members):
            size, chosen, *arrays = tree
            tree = type(tree)(size, chosen, *(grown(each) for each in arrays))
        return tree

    def _tree(self, width: int) -> Any:
        from torchrl_pomdp.planners.despot_loop import Despot

        controls = self.model.num_controls
        nodes = _NODES + self.scenarios * controls
        whole, real, flags = (_zeros(nodes, kind) for kind in (np.int64, np.float64, np.bool_))
        return Despot(
            size=np.zeros(2, np.int64),
            chosen=np.zeros(1, np.int64),
            rows=real(width),
            seen=np.zeros(nodes, np.uint64),
            parents=whole(),
            depths=whole(),
            first=whole(),
            counts=whole(),
            members=np.zeros(_SHARES * nodes, np.int64),
            lower=real(),
            upper=real(),
            base=real(),
            gaps=real(),
            ended=flags(),
            open=flags(),
            legal=flags(controls),
            costs=real(controls),
            children=whole(controls),
            branches=whole(controls),
        )


def _zeros(nodes: int, kind: Any) -> Any:
    """Makes arrays of zeros, one row for each node."""

    def make(*columns: int) -> NDArray[Any]:
        return np.zeros((nodes, *columns), kind)

    return make
