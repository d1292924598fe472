"""Any finite POMDP as a belief model, from explicit tables (paper, Section II)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite

from torchrl_pomdp.checks import check_sequence, check_text, shown
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.envs.rows import inverse_cdf
from torchrl_pomdp.envs.scene import Scene, StatesScene
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.envs.tables import table
from torchrl_pomdp.envs.world import World
from torchrl_pomdp.tensor_checks import check_device, check_distributions, check_dtype, check_tensor, place

__all__ = ["TabularModel"]


class TabularModel(BeliefModel):
    r"""Belief model of a POMDP with n states, given by its tables.

    The core entry is ``"belief"`` ``[*B, n]``. The *support* of a belief are the states of positive probability.

    Tables may be dense, or sparse where most probabilities are zero: thousands of states then take no array of
    ``[n, n]`` numbers. A control is legal at a belief if it is legal in every state of the support; the support of every belief
    that can be met must leave a control, so states that share none must be told apart by what is observed.

    Args:
        transition: :math:`p_{ij}(u)`, ``[U, n, n]``, rows sum to one; dense, or a sparse tensor in COO layout.
        observation: :math:`p(z\mid j,u)`, ``[U, n, Z]`` by next state j, rows sum to one; dense or sparse likewise.
        cost: stage costs; negative costs are rewards. By state :math:`g(i,u)`, ``[U, n]``, by next state too
            :math:`g(i,u,j)`, ``[U, n, n]``, or by observation too :math:`g(i,u,j,z)`, ``[U, n, n, Z]``; what is kept is the
            expected cost ``[U, n]``.
        discount: :math:`\alpha`.

    Keyword Args:
        legal: bool ``[n, U]``, the controls that are legal in each state, at least one; None: all. Tables hold
            distributions and finite costs at illegal ones too.
        terminal: bool ``[n]``, states that are never left, up to rounding, and from which no cost follows; None: none.
        state_names: names of the states.
        control_names: names of the controls.
        observation_names: names of the observations.
        partition: partition whose index becomes a feature.
        dtype: float32 or float64.
        device: where the model computes.

    Attributes:
        cost: expected stage cost :math:`\sum_j p_{ij}(u)\,g(i,u,j)`, ``[U, n]``.
        num_states: n.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if a table has the wrong shape or rows that are no distributions, a cost is not finite in ``dtype``, a state
            has no legal control, a terminal state can be left or costs something, or names are not one for each, all different.

    Examples:
        A machine that works or is broken, where only a broken one can be repaired:

        >>> from tensordict import TensorDict
        >>> wear, repair = [[0.9, 0.1], [0.0, 1.0]], [[1.0, 0.0], [1.0, 0.0]]
        >>> seen = torch.eye(2).expand(2, 2, 2)
        >>> legal = torch.tensor([[True, False], [True, True]])
        >>> model = TabularModel([wear, repair], seen, [[0.0, 5.0], [0.0, 8.0]], 0.9, legal=legal)
        >>> model.with_features(TensorDict({"belief": torch.tensor([[1.0, 0.0], [0.0, 1.0]])}, [2]))["action_mask"].tolist()
        [[True, False], [True, True]]
    """

    state_keys = ("belief",)
    state_names: tuple[str, ...] | None
    cost: Tensor
    illegal: Tensor | None
    going: Tensor | None

    def __init__(
        self,
        transition: Tensor,
        observation: Tensor,
        cost: Tensor,
        discount: float,
        *,
        legal: Tensor | None = None,
        terminal: Tensor | None = None,
        state_names: Sequence[str] | None = None,
        control_names: Sequence[str] | None = None,
        observation_names: Sequence[str] | None = None,
        partition: Partition | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(discount, partition)
        dtype, device = check_dtype("dtype", dtype), check_device("device", device)
        self._moves = table("transition", transition, dtype, device)
        self.num_controls, self.num_states, _ = self._moves.shape
        self._sees = table("observation", observation, dtype, device, self._moves.shape[:2])
        self.num_observations = self._sees.shape[-1]
        if terminal is not None:
            terminal = check_tensor("terminal", terminal, (self.num_states,), torch.bool, finite=False).to(device)
            self._moves = self._moves.kept(terminal)
        expected = self._expected(check_tensor("cost", cost, finite=False), dtype)
        self.register_buffer("cost", expected.to(device), persistent=False)
        self._register_legal(legal)
        self._register_terminal(terminal)
        self.state_names = _names("state_names", state_names, self.num_states)
        self.control_names = _names("control_names", control_names, self.num_controls)
        self.observation_names = _names("observation_names", observation_names, self.num_observations)
        self.max_cost = float(self.cost.masked_fill(~self.legal.T, 0.0).abs().max())

    def _expected(self, cost: Tensor, dtype: torch.dtype) -> Tensor:
        """The expected stage costs ``[U, n]`` on the CPU."""
        num_controls, n, num_observations = self.num_controls, self.num_states, self.num_observations
        shapes = [(num_controls, n, n, num_observations)[:dims] for dims in (2, 3, 4)]
        cost = cost.detach().cpu().to(dtype, copy=True)
        if tuple(cost.shape) not in shapes or not bool(torch.isfinite(cost).all()):
            allowed = ", ".join(str(list(shape)) for shape in shapes)
            raise ValueError(f"cost must be finite as {dtype}, of one of the shapes {allowed}, got {tuple(cost.shape)}")
        if cost.ndim == 2:
            return cost
        result = torch.zeros(num_controls, n, dtype=torch.float64)
        for u in range(num_controls):
            i, j, prob = (part.cpu() for part in self._moves.entries(u))
            by_next = cost[u].double()
            if cost.ndim == 4:
                state, z, seen = (part.cpu() for part in self._sees.entries(u))
                by_next = torch.zeros(n, n, dtype=torch.float64).index_add_(1, state, by_next[:, state, z] * seen)
            result[u].index_add_(0, i, by_next[i, j] * prob)
        return result.to(dtype)

    def _register_legal(self, legal: Any) -> None:
        illegal = None
        if legal is not None:
            legal = check_tensor("legal", legal, (self.num_states, self.num_controls), torch.bool, finite=False)
            stuck = (~legal.any(1)).nonzero()
            if len(stuck):
                raise ValueError(f"legal must allow at least one control in every state, got none in state {int(stuck[0])}")
            illegal = None if bool(legal.all()) else (~legal).to(self.device, torch.float32)
        self.register_buffer("illegal", illegal, persistent=False)

    def _register_terminal(self, terminal: Tensor | None) -> None:
        going = None
        if terminal is not None:
            wrong = (self.legal.T & terminal & ((self._moves.diagonal() < 1.0) | (self.cost != 0.0))).nonzero()
            if len(wrong):
                u, state = wrong[0].tolist()
                raise ValueError(
                    f"terminal states must stay what they are at no cost, got state {state} where control {u} does something"
                )
            going = (~terminal).to(self.dtype) if bool(terminal.any()) else None
        self.register_buffer("going", going, persistent=False)

    @property
    def transition(self) -> Tensor:
        r""":math:`p_{ij}(u)`, ``[U, n, n]``, dense or sparse as it was given."""
        return self._moves.given()

    @property
    def observation(self) -> Tensor:
        r""":math:`p(z\mid j,u)`, ``[U, n, Z]``, dense or sparse as it was given."""
        return self._sees.given()

    @property
    def legal(self) -> Tensor:
        """Controls that are legal in each state, bool ``[n, U]``."""
        return torch.ones_like(self.cost.T, dtype=torch.bool) if self.illegal is None else self.illegal == 0

    @property
    def terminal(self) -> Tensor:
        """States that are terminal, bool ``[n]``."""
        return torch.zeros_like(self.cost[0], dtype=torch.bool) if self.going is None else self.going == 0

    @property
    def device(self) -> torch.device:
        """Device of the model's tensors."""
        return self.cost.device

    @property
    def dtype(self) -> torch.dtype:
        """Type of beliefs and costs."""
        return self.cost.dtype

    def state_spec(self, batch_size: torch.Size | tuple[int, ...] = ()) -> Composite:
        """``belief`` ``[*B, n]`` in [0, 1]."""
        shape = torch.Size(batch_size)
        belief = Bounded(0.0, 1.0, shape=(*shape, self.num_states), dtype=self.dtype, device=self.device)
        return Composite(belief=belief, shape=shape, device=self.device)

    def scene(self) -> Scene:
        """How feature states are drawn: a bar for each state, by its name if it has one."""
        return super().scene() if self.state_names is None else StatesScene(self, self.state_names)

    def check_state(self, y: TensorDictBase) -> None:
        """Raise unless ``y`` is a feature state; see :meth:`BeliefModel.check_state`.

        Beliefs must sum to one, and their support must leave a legal control.
        """
        super().check_state(y)
        check_distributions("entry 'belief' of y", y.get("belief"))
        if self.illegal is not None:
            stuck = (~self.action_mask(y).any(-1)).nonzero()
            if len(stuck):
                where = tuple(stuck[0].tolist())
                raise ValueError(f"entry 'belief' of y{place(where)} has states that share no legal control")

    def action_mask(self, y: TensorDictBase) -> Tensor:
        """Controls that are legal in every state of the support, bool ``[*B, U]``."""
        if self.illegal is None:
            return torch.ones(*y.batch_size, self.num_controls, dtype=torch.bool, device=self.device)
        # Small whole numbers, which a product of matrices adds without rounding.
        return (y.get("belief") > 0).to(torch.float32) @ self.illegal == 0

    def is_terminal(self, y: TensorDictBase) -> Tensor:
        """Bool ``[*B]``: whether all states of the support are terminal."""
        return super().is_terminal(y) if self.going is None else ~(y.get("belief") * self.going > 0).any(-1)

    def expected_cost(self, y: TensorDictBase, u: Tensor) -> Tensor:
        r""":math:`\sum_i b(i)\,g(i,u)`, ``[*B]``."""
        # No product in place: of a single control the row is a view of the table.
        return sum_first((self.cost[u] * y.get("belief")).movedim(-1, 0))

    def observation_probs(self, y: TensorDictBase, u: Tensor) -> Tensor:
        r""":math:`\hat p(z\mid b,u)`, ``[*B, Z]``; raises as :meth:`check_control_shape` does."""
        self.check_control_shape(y, u)
        return self._sees.mix(self._predicted(y, u), u.reshape(-1)).view(*y.batch_size, self.num_observations)

    def estimator(self, y: TensorDictBase, u: Tensor, z: Tensor) -> TensorDictBase:
        """F(y, u, z) by Bayes' rule.

        Raises:
            ValueError: if a control is illegal or an observation impossible.
        """
        self.check_controls(y, u)
        self.check_observations(y, z)
        weight, total = self._weigh(self._predicted(y, u), u.reshape(-1), z.reshape(-1))
        self.refuse_impossible(z, (total > 0).view(y.batch_size))
        return self._successor(y, weight, total)

    def advance(self, y: TensorDictBase, u: Tensor, noise: Tensor) -> tuple[Tensor, TensorDictBase]:
        """One sampled step, see :meth:`BeliefModel.advance`."""
        predicted, control = self._predicted(y, u), u.reshape(-1)
        z = inverse_cdf(self._sees.mix(predicted, control), noise[..., 0].reshape(-1))
        return self.expected_cost(y, u), self._successor(y, *self._weigh(predicted, control, z))

    def world(self) -> World:
        """The states."""
        # Not at the top: the world knows the model.
        from torchrl_pomdp.envs.tabular_world import TabularWorld

        return TabularWorld(self)

    # ---- kernels on N rows -----------------------------------------------------------------------------------------

    def _predicted(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """P(next state j), ``[N, n]``."""
        return self._moves.mix(y.get("belief").reshape(-1, self.num_states), u.reshape(-1))

    def _weigh(self, predicted: Tensor, u: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """P(next state j, observation ``z``), ``[N, n]``, and its sum ``[N]``."""
        weight = self._sees.column(u, z).mul_(predicted)
        return weight, sum_first(weight.clone().T)

    def _successor(self, y: TensorDictBase, weight: Tensor, total: Tensor) -> TensorDictBase:
        return self.successor(y, belief=(weight / total.unsqueeze(-1)).view(*y.batch_size, self.num_states))


def _names(name: str, given: Any, count: int) -> tuple[str, ...] | None:
    if given is None:
        return None
    names = tuple(check_text(f"{name}[{i}]", member) for i, member in enumerate(check_sequence(name, given, str)))
    if len(names) != count or len(set(names)) != count:
        raise ValueError(f"{name} must hold {count} different names, got {shown(given)}")
    return names
