r"""How controls are written down, of one agent and of many.

Each of R agents, such as robots, has A controls of its own. What they do together is a *joint control*, one of :math:`U=A^R`.
A joint control is legal where every agent's control is legal for that agent.

==================== ============================ =================================================
joint controls       ``"action"``                 ``"action_mask"``
==================== ============================ =================================================
up to 4096           their numbers, int64 [\*B]   bool ``[*B, U]``
more                 of each agent, [\*B, R]      bool ``[*B, R, A]``
==================== ============================ =================================================

Numbers have the agents' controls as base-A digits, agent 0 first. What goes through all joint controls, such as
:class:`~torchrl_pomdp.modules.RolloutPolicy`, refuses models of the second kind and says what to use instead; all else is
written for ``[*B, *S]`` controls below n, where ``S`` is :attr:`JointControls.control_shape` and n
:attr:`JointControls.control_range`. A model of one agent is always of the first kind.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.envs.digits import digits, joined
from torchrl_pomdp.noise import fold, uniform
from torchrl_pomdp.tensor_checks import place

__all__ = ["MAX_ENUMERATED", "JointControls", "check_index"]

MAX_ENUMERATED = 4096
"""Largest number of joint controls that are numbered, and of joint observations that tables hold, where there are agents."""


class JointControls(nn.Module):
    """The controls of a model, see the module.

    Attributes:
        num_controls: U.
        num_agents: R; 1 where nobody says otherwise.
        num_agent_controls: A.
    """

    num_controls: int
    num_agents: int = 1

    @property
    def num_agent_controls(self) -> int:
        """A; of a single agent all controls."""
        return self.num_controls

    @property
    def enumerable(self) -> bool:
        """Whether joint controls are numbers."""
        return self.num_agents == 1 or self.num_controls <= MAX_ENUMERATED

    @property
    def control_shape(self) -> tuple[int, ...]:
        """Shape of a control: ``()`` for numbers of joint controls, else ``(R,)``."""
        return () if self.enumerable else (self.num_agents,)

    @property
    def control_range(self) -> int:
        """What controls are below: U for numbers of joint controls, else A."""
        return self.num_controls if self.enumerable else self.num_agent_controls

    def action_mask(self, y: TensorDictBase) -> Tensor:
        """Legal controls, bool ``[*B, *S, n]``; see the module."""
        raise NotImplementedError

    def agent_mask(self, y: TensorDictBase) -> Tensor:
        """Legal controls of every agent, bool ``[*B, R, A]``."""
        return self.action_mask(y).unsqueeze(-2)

    def split_controls(self, u: Tensor) -> Tensor:
        """Agents' controls ``[*B, R]`` of joint controls ``[*B, *S]``."""
        return digits(u, self.num_agent_controls, self.num_agents) if self.enumerable else u

    def join_controls(self, controls: Tensor) -> Tensor:
        """Joint controls ``[*B, *S]`` of agents' controls ``[*B, R]``."""
        return joined(controls, self.num_agent_controls) if self.enumerable else controls

    def control_noise(self, keys: Tensor, name: int) -> Tensor:
        """Uniforms ``[*B, *S]`` for random controls from keys ``[*B]``: many agents draw each for itself."""
        if self.enumerable:
            return uniform(keys, name)
        return uniform(fold(keys, name).unsqueeze(-1), torch.arange(self.num_agents, device=keys.device))

    def check_enumerable(self, component: str, instead: str) -> None:
        """Raise, for a component that goes through all joint controls, where these are too many.

        Args:
            component: what it is called.
            instead: what to use.

        Raises:
            ValueError: if joint controls are no numbers.
        """
        if not self.enumerable:
            raise ValueError(
                f"model must have at most {MAX_ENUMERATED} joint controls for {component}, which goes through them all, got "
                f"{self.num_agent_controls}^{self.num_agents} = {self.num_controls}: use {instead}"
            )

    def check_control_shape(self, y: TensorDictBase, u: Tensor) -> None:
        """Raise unless ``u`` is an int64 tensor ``[*B, *S]`` for feature states ``y`` ``[*B]``; its numbers are not looked at.

        Raises:
            TypeError: if ``u`` is no tensor.
            ValueError: if its type or shape is another.
        """
        check_index("action", u, torch.Size([*y.batch_size, *self.control_shape]))

    def check_controls(self, y: TensorDictBase, u: Tensor) -> None:
        """Raise unless ``u`` are legal controls in ``y``; its ``"action_mask"`` is believed if it has one.

        Args:
            y: feature states ``[*B]``.
            u: controls, int64 ``[*B, *S]``.

        Raises:
            TypeError: if ``u`` is no tensor.
            ValueError: if its type or shape is another, or a control is illegal; the message lists the legal ones.
        """
        self.check_control_shape(y, u)
        mask = y.get("action_mask", None)
        mask = self.action_mask(y) if mask is None else mask
        low, high = u.aminmax() if u.numel() else (0, 0)
        if low >= 0 and high < self.control_range and mask.gather(-1, u.unsqueeze(-1)).all():
            return
        known = (u >= 0) & (u < self.control_range)
        index = u.clamp(0, self.control_range - 1).unsqueeze(-1)
        where = tuple((~(known & mask.gather(-1, index).squeeze(-1))).nonzero()[0].tolist())
        batch = where[: y.ndim]
        whose = f"action {int(u[where])}{place(batch)}"
        if not self.enumerable:
            whose = f"action {u[batch].tolist()}{place(batch)}, of agent {where[-1]},"
        raise ValueError(f"{whose} is illegal; legal there: {mask[where].nonzero().flatten().tolist()}")


def check_index(name: str, value: Any, shape: torch.Size) -> None:
    """Raise unless a value is an int64 tensor of a shape."""
    check_instance(name, value, Tensor)
    if value.shape != shape or value.dtype != torch.int64:
        raise ValueError(f"{name} must be int64 of shape {tuple(shape)}, got {value.dtype} of shape {tuple(value.shape)}")
