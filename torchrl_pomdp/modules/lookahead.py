r"""One-step lookahead with rollout at its leaves: the policy :math:`\tilde\mu` (paper, Section III and equation (1))."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_pomdp.checks import check_instance, check_number
from torchrl_pomdp.modules.qfactors import SimulatedQFactors, cheapest
from torchrl_pomdp.tensor_checks import check_keys

__all__ = ["RolloutPolicy"]


class RolloutPolicy(SimulatedQFactors):
    r"""The rollout policy: minimise the Q-factors of a base policy over all legal controls.

    See :class:`~torchrl_pomdp.modules.qfactors.SimulatedQFactors` for the Q-factors and their scenarios, and for what else may
    be given; :class:`~torchrl_pomdp.modules.MultiagentRollout` for many agents.

    Args:
        model: the belief model; at most 4096 joint controls of several agents.
        base_policy: :math:`\mu`, writes ``"action"``.

    Keyword Args:
        trajectories: simulated trajectories for each control, 10 by default.
        allocation: ``"uniform"``, or ``"adaptive"``, which gives no more of them to a control that is clearly beaten.
        seconds: time for the decision of a state.
        truncation: where simulations are cut, and ``max_steps``: when.
        terminal_cost: :math:`\hat J`, added at the cut.
        seed: seed of the simulations.
        leaves, chunk_rows, compile: these, and more on the others: :class:`~torchrl_pomdp.modules.qfactors.SimulatedQFactors`.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if there are too many joint controls; by :class:`~torchrl_pomdp.modules.qfactors.SimulatedQFactors`.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> problem = make_problem("linear20")
        >>> policy = RolloutPolicy(problem.model, GreedyRepair(problem.model), trajectories=10)
        >>> y = policy(problem.start(torch.arange(4)))
        >>> y["q_factors"].shape, bool((y["q_factors"].argmin(-1) == y["action"]).all())
        (torch.Size([4, 3]), True)
    """

    def _check_model(self) -> None:
        self.model.check_enumerable("RolloutPolicy", "MultiagentRollout")

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"q_factors"`` ``[*B, U]`` (costs, ``+inf`` where illegal) and ``"action"`` ``[*B]`` (ties to the lower)."""
        q = self.q_factors(tensordict)
        return tensordict.set("action", cheapest(q)).set("q_factors", q)

    @torch.no_grad()
    def q_factors(self, y: TensorDictBase, keys: Tensor | None = None, seconds: float | None = None) -> Tensor:
        r""":math:`\tilde Q(y,u)` ``[*B, U]``, ``+inf`` where the control is illegal.

        Args:
            y: feature states ``[*B]``.
            keys: keys of their scenarios ``[*B]``, for states that shall share them; by default those of :meth:`keys`.
            seconds: time for each state; by default that of the policy.
        """
        check_instance("y", y, TensorDictBase)
        seconds = self.seconds if seconds is None else check_number("seconds", seconds, "(0, inf)")
        if keys is not None:
            keys = _checked_keys(keys, y).reshape(-1)
        return self._factors(y, None, None, keys, seconds).view(*y.batch_size, self.model.num_controls)


def simulated_steps(policy: Callable[..., Any]) -> int | None:
    """Belief steps that a policy, or the rollouts and searches in it, have simulated; None where it simulates nothing."""
    if not isinstance(policy, TensorDictModuleBase):
        return None
    found = {part: part.simulated_steps for part in _simulating(policy)}
    return sum(found.values()) if found else None


def _simulating(module: nn.Module) -> Iterator[Any]:
    """The outermost modules that count what they simulate."""
    if hasattr(module, "simulated_steps"):
        yield module
        return
    for part in module.children():
        yield from _simulating(part)


def _checked_keys(keys: Tensor, y: TensorDictBase) -> Tensor:
    if check_keys("keys", keys).shape != y.batch_size:
        raise ValueError(f"keys must be one for each state, {tuple(y.batch_size)}, got {tuple(keys.shape)}")
    return keys
