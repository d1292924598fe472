r"""Multiagent rollout: one agent decides after the other, so that a decision takes R·A Q-factors instead of :math:`A^R`.

After Bhattacharya, Badyal, Wheeler, Gil and Bertsekas, "Reinforcement learning for POMDP: partitioned rollout and policy
iteration with application to autonomous sequential repair problems", Section II, and its follow-up arXiv:2011.04222.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_callable, check_choice, check_instance
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.rows import flat_rows
from torchrl_pomdp.modules.own import MakesItsOwn
from torchrl_pomdp.modules.policies import Policy, TerminalCost, controls_of
from torchrl_pomdp.modules.qfactors import SimulatedQFactors, cheapest
from torchrl_pomdp.modules.truncation import Truncation

__all__ = ["SCHEMES", "MultiagentRollout"]

Scheme = Literal["one_at_a_time", "order_optimised", "autonomous"]
SCHEMES: tuple[Scheme, ...] = get_args(Scheme)
"""The schemes by name."""


class MultiagentRollout(MakesItsOwn, SimulatedQFactors):
    r"""Rollout policies for many agents, such as robots; each minimises Q-factors over its own controls alone.

    The Q-factor of agent r's control :math:`u_r` is that of the joint control in which the other agents do what the scheme
    says; thereafter all follow the base policy.

    ==================== ========================================================================================
    scheme               the others
    ==================== ========================================================================================
    ``one_at_a_time``    earlier agents do what they have decided, later ones what the base policy says
    ``order_optimised``  the same, but the agent whose best Q-factor is smallest decides next:
                         R(R+1)/2·A Q-factors
    ``autonomous``       earlier agents do what the signalling policy says they will, later ones what the base
                         policy says: no agent waits for another
    ==================== ========================================================================================

    With exact Q-factors the first two cost no more than the base policy. Of a single agent all are
    :class:`~torchrl_pomdp.modules.RolloutPolicy`. All Q-factors of a state are compared in the same scenarios.

    Args:
        model: the belief model.
        base_policy: :math:`\mu`, writes ``"action"``.

    Keyword Args:
        scheme: see above.
        signalling: policy that predicts the other agents' controls, for ``autonomous``, such as a trained network; None: the
            base policy.
        trajectories: see :class:`~torchrl_pomdp.modules.qfactors.SimulatedQFactors`, also for what follows.
        leaves: what a leaf is.
        allocation: how trajectories are spent.
        seconds: time for the decision of a state; agents have equal shares.
        max_steps: largest m.
        truncation: state-dependent m.
        terminal_cost: :math:`\hat J`.
        seed: seed of the simulations.
        chunk_rows: largest number of trajectories simulated at once.
        compile: whether to fuse policy and belief step.

    Attributes:
        evaluated: Q-factors evaluated so far.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if the scheme is unknown, or there is a signalling policy for another one than ``autonomous``; by
            :class:`~torchrl_pomdp.modules.qfactors.SimulatedQFactors`.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> problem = make_problem("two_robots20")
        >>> policy = MultiagentRollout(problem.model, GreedyRepair(problem.model), trajectories=10)
        >>> y = policy(problem.start(torch.arange(4)))
        >>> y["q_factors"].shape, y["action"].shape
        (torch.Size([4, 2, 3]), torch.Size([4]))
    """

    _OWN = frozenset({"evaluated"})

    def __init__(
        self,
        model: BeliefModel,
        base_policy: Policy,
        *,
        scheme: Scheme = "one_at_a_time",
        signalling: Policy | None = None,
        trajectories: int = 10,
        leaves: Literal["control", "observation"] = "control",
        allocation: Literal["uniform", "adaptive"] = "uniform",
        seconds: float | None = None,
        max_steps: int | None = None,
        truncation: Truncation | None = None,
        terminal_cost: TerminalCost | None = None,
        seed: int = 0,
        chunk_rows: int | None = None,
        compile: bool = False,
    ) -> None:
        super().__init__(
            model,
            base_policy,
            trajectories=trajectories,
            leaves=leaves,
            allocation=allocation,
            seconds=seconds,
            max_steps=max_steps,
            truncation=truncation,
            terminal_cost=terminal_cost,
            seed=seed,
            chunk_rows=chunk_rows,
            compile=compile,
        )
        self.scheme = check_choice("scheme", scheme, SCHEMES)
        if signalling is not None:
            check_callable("signalling", signalling)
            if scheme != "autonomous":
                raise ValueError(f"signalling is for scheme='autonomous', got it for {scheme!r}")
        self.signalling = signalling
        self._prepare()

    def _prepare(self) -> None:
        self.evaluated = 0

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"q_factors"`` ``[*B, R, A]`` (costs, ``+inf`` where illegal) and ``"action"`` ``[*B, *S]``.

        The Q-factors are those that the agents have compared. Ties go to the lower control.
        """
        self.model.check_state(check_instance("tensordict", tensordict, TensorDictBase))
        shape, model = tensordict.batch_size, self.model
        y = model.derive(flat_rows(tensordict.select(*model.state_keys)))
        base = self._controls("base_policy", self.cost_to_go.base_policy, y)
        decide = {"one_at_a_time": self._in_turn, "order_optimised": self._best_first, "autonomous": self._at_once}
        controls, q = decide[self.scheme](y, base, model.agent_mask(y))
        action = model.join_controls(controls).reshape((*shape, *model.control_shape))
        return tensordict.set("action", action).set("q_factors", q.view(*shape, *q.shape[1:]))

    def _controls(self, name: str, policy: Policy, y: TensorDictBase) -> Tensor:
        """Agents' controls ``[N, R]`` of a policy."""
        u = controls_of(name, policy, y.copy())
        self.model.check_controls(y, u)
        return self.model.split_controls(u)

    def _in_turn(self, y: TensorDictBase, base: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Controls ``[N, R]`` and Q-factors ``[N, R, A]``: one agent after the other, in their order."""
        controls, q = base.clone(), []
        for agent in range(self.model.num_agents):
            q.append(self._agent_factors(y, controls, mask, torch.full_like(base[:, :1], agent)).squeeze(1))
            controls[:, agent] = cheapest(q[-1])
        return controls, torch.stack(q, 1)

    def _best_first(self, y: TensorDictBase, base: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """The same, but of the agents that are left the one with the smallest Q-factor decides next."""
        controls, result = base.clone(), torch.full(mask.shape, torch.inf, dtype=self.model.dtype, device=mask.device)
        left = torch.arange(self.model.num_agents, device=base.device).repeat(len(base), 1)
        rows = torch.arange(len(base), device=base.device)
        while left.shape[1]:
            q = self._agent_factors(y, controls, mask, left)
            place = cheapest(q.amin(-1))
            agent = left[rows, place]
            result[rows, agent] = q[rows, place]
            controls[rows, agent] = cheapest(q[rows, place])
            left = left[left != agent.unsqueeze(-1)].view(len(base), left.shape[1] - 1)
        return controls, result

    def _at_once(self, y: TensorDictBase, base: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """The same, each agent for itself: it is told what the earlier ones will do."""
        told = base if self.signalling is None else self._controls("signalling", self.signalling, y)
        q = []
        for agent in range(self.model.num_agents):
            others = torch.cat([told[:, :agent], base[:, agent:]], -1)
            q.append(self._agent_factors(y, others, mask, torch.full_like(base[:, :1], agent)).squeeze(1))
        return torch.stack([cheapest(each) for each in q], -1), torch.stack(q, 1)

    def _agent_factors(self, y: TensorDictBase, others: Tensor, mask: Tensor, agents: Tensor) -> Tensor:
        """Q-factors ``[N, n, A]`` of all controls of ``agents`` ``[N, n]``, each with the others' controls ``[N, R]``."""
        count, device = self.model.num_agent_controls, others.device
        candidates = others[:, None, None].repeat(1, agents.shape[1], count, 1)
        place = agents[:, :, None, None].expand(-1, -1, count, 1)
        own = torch.arange(count, device=device).view(1, 1, -1, 1).expand_as(place)
        candidates = candidates.scatter(-1, place, own)
        legal = mask.gather(1, agents.unsqueeze(-1).expand(-1, -1, count))
        self.evaluated += int(legal.sum())
        seconds = None if self.seconds is None else self.seconds / self.model.num_agents
        return self._factors(y, candidates.flatten(1, 2), legal.flatten(1), None, seconds).view(legal.shape)
