r"""The sequential repair problem with its exact factored belief (paper, Section VI-A), for any graph and any robots.

One stage, in this order: (1) the cost of all locations, on the state before the control; (2) every robot repairs its own
location or moves to a neighbour; (3) every location that is not just repaired takes one step of its damage chain;
(4) every robot observes exactly the level of the location where it now stands.

Locations stay independent given the history, so the belief is a product of marginals, ``belief[..., l, k]`` = P(level of
location l is k), updated in closed form. Inside, beliefs are planes ``[L, K, N]`` with the batch innermost: a step is a few
elementwise passes over contiguous memory. What callers see is a ``[*B, L, K]`` view of these planes.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite

from torchrl_pomdp.checks import check_instance, check_integer, check_number
from torchrl_pomdp.envs.controls import MAX_ENUMERATED
from torchrl_pomdp.envs.digits import digits
from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.envs.repair.chains import (
    checked_chain,
    checked_costs,
    drifts,
    location_costs,
    off_diagonals,
    overflowing_levels,
    prices,
)
from torchrl_pomdp.envs.repair.graphs import Graph
from torchrl_pomdp.envs.repair.partition import RepairPartition
from torchrl_pomdp.envs.repair.robots import Robots
from torchrl_pomdp.envs.rows import inverse_cdf
from torchrl_pomdp.envs.scene import Scene
from torchrl_pomdp.envs.sums import multiply_first, sum_first
from torchrl_pomdp.envs.world import World
from torchrl_pomdp.tensor_checks import check_device, check_distributions, check_dtype

__all__ = ["REPAIR", "RepairModel"]

REPAIR = 0
"""A robot's control *repair*; control ``1 + s`` moves along slot ``s`` of the graph."""

# Joint observations are numbered.
_MAX_OBSERVATIONS = 1 << 62


class RepairModel(Robots):
    r"""Belief model of the repair problem: L locations with K damage levels, R robots.

    Core entries: ``"belief"`` float ``[*B, L, K]`` and ``"location"`` int64 ``[*B, R]``. The robots are agents, see
    :mod:`~torchrl_pomdp.envs.controls` for their joint controls; the joint observation is the number whose base-K digits are
    the levels that the robots see, robot 0 first.

    A robot may not leave the graph; it may repair a location known to be at level 0 only where no move is possible. States
    with P(any damage) <= ``terminal_probability`` are terminal if level 0 is absorbing and costs nothing everywhere.

    A repair may fail: with probability :math:`1-\rho` the location takes a step of its chain as if nobody had been there. The
    robot sees the level and with it whether the repair has worked. Robots that repair one location together make one attempt.

    Args:
        graph: where the robots move.
        chain: row-stochastic matrix ``[K, K]`` of the damage levels, see :func:`damage_chain`; or ``[L, K, K]``, one for each
            location.
        costs: cost of a location per stage at each level, ``[K]`` or ``[L, K]``, finite and nonnegative.
        discount: :math:`\alpha`.

    Keyword Args:
        num_robots: R, 1 to 16.
        repair_probability: :math:`\rho`, that a repair works, in (0, 1].
        terminal_probability: :math:`\epsilon`, in [0, 1).
        partition: partition whose index becomes a feature.
        dtype: float32 or float64.
        device: where the model computes.

    Attributes:
        ends: whether there are terminal states: level 0 is absorbing and costs nothing at every location.

    Raises:
        TypeError: if an argument is of the wrong kind; the message names it.
        ValueError: if an argument is out of range, or the partition is of another graph or other levels.

    Examples:
        >>> from torchrl_pomdp.envs.repair import damage_chain, line
        >>> model = RepairModel(line(20), damage_chain((0, 0.02, 0.03, 0.05)), (0, 0.1, 1, 10, 100), 0.99)
        >>> model.describe()
        'line of 20, 1 robot: 1.9e+15 states, 3 controls, 5 observations, discount 0.99'
    """

    state_keys = ("belief", "location")
    chain: Tensor
    costs: Tensor
    destinations: Tensor
    _legal_when_intact: Tensor
    first_controls: Tensor
    _levels: Tensor

    def __init__(
        self,
        graph: Graph,
        chain: Tensor,
        costs: Tensor | Sequence[float],
        discount: float,
        *,
        num_robots: int = 1,
        repair_probability: float = 1.0,
        terminal_probability: float = 1e-6,
        partition: Partition | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(discount)
        self.graph = check_instance("graph", graph, Graph)
        dtype, device = check_dtype("dtype", dtype), check_device("device", device)
        chain = checked_chain(chain, graph.num_locations)
        self.num_locations, self.num_levels = graph.num_locations, chain.shape[-1]
        costs = checked_costs(costs, self.num_locations, self.num_levels, dtype)
        self.repair_probability = check_number("repair_probability", repair_probability, "(0, 1]")
        self.num_robots = check_integer("num_robots", num_robots, 1, 16)
        self.num_robot_controls = len(graph.control_names)
        self.num_agents = self.num_robots
        self.num_controls = self.num_robot_controls**self.num_robots
        self.num_observations = self.num_levels**self.num_robots
        if self.num_observations > _MAX_OBSERVATIONS:
            raise ValueError(
                f"num_robots must leave at most {_MAX_OBSERVATIONS} joint observations, got {num_robots} robots with "
                f"{self.num_observations}"
            )
        self.noise_dim = self.num_robots
        self.terminal_probability = check_number("terminal_probability", terminal_probability, "[0, 1)")
        self.ends = bool((chain[..., 0, 0] == 1).all() and (costs[..., 0] == 0).all())
        self._normalise = drifts(chain, dtype)
        self._register_tables(chain.to(dtype), costs, device)
        if partition is not None:
            self.check_partition(partition)
        self.partition = partition

    def _register_tables(self, chain: Tensor, costs: Tensor, device: torch.device) -> None:
        nodes = torch.arange(self.num_locations).unsqueeze(-1)
        destinations = torch.cat([nodes, self.graph.neighbours], -1)
        moves = self.graph.neighbours >= 0
        tables = {
            "chain": chain,
            "costs": costs,
            # [L, A]: location after a robot's control, -1 where the move leaves the graph.
            "destinations": destinations,
            # [L, A]: legal controls of a robot whose location is known to be intact.
            "_legal_when_intact": torch.cat([~moves.any(-1, keepdim=True), moves], -1),
            "first_controls": self.graph.first_controls,
            "_levels": torch.arange(self.num_levels).unsqueeze(-1),
        }
        for name, value in tables.items():
            self.register_buffer(name, value.to(device), persistent=False)
        self._prices = prices(self.costs)
        self._stay = self.chain.diagonal(dim1=-2, dim2=-1).unsqueeze(-1).contiguous()
        self._diagonals = list(off_diagonals(self.chain))
        self._overflowing = overflowing_levels(chain)

    # ---- specs and descriptions ----------------------------------------------------------------------------------

    @property
    def device(self) -> torch.device:
        """Device of the model's tensors."""
        return self.chain.device

    @property
    def dtype(self) -> torch.dtype:
        """Floating type of beliefs and costs."""
        return self.chain.dtype

    @property
    def num_states(self) -> int:
        """Size of the underlying state space, L^R K^L."""
        return self.num_locations**self.num_robots * self.num_levels**self.num_locations

    def state_spec(self, batch_size: torch.Size | tuple[int, ...] = ()) -> Composite:
        """``belief`` ``[*B, L, K]`` in [0, 1] and ``location`` ``[*B, R]``."""
        shape = torch.Size(batch_size)
        belief = (*shape, self.num_locations, self.num_levels)
        return Composite(
            belief=Bounded(0.0, 1.0, shape=belief, dtype=self.dtype, device=self.device),
            location=Categorical(self.num_locations, shape=(*shape, self.num_robots), dtype=torch.int64, device=self.device),
            shape=shape,
            device=self.device,
        )

    def check_state(self, y: TensorDictBase) -> None:
        """Raise unless ``y`` is a feature state; see :meth:`BeliefModel.check_state`. Marginals must sum to one."""
        super().check_state(y)
        check_distributions("entry 'belief' of y", y.get("belief"))

    def check_partition(self, partition: Partition) -> None:
        """Raise unless a partition is one, and one for this graph and these levels; see :meth:`BeliefModel.check_partition`."""
        super().check_partition(partition)
        if isinstance(partition, RepairPartition):
            partition.check_fits(self.num_locations, self.num_levels, self.device)

    def describe(self) -> str:
        """Graph, robots, and the numbers of states, controls and observations."""
        mantissa, exponent = _scientific(self.num_states)
        robots = "1 robot" if self.num_robots == 1 else f"{self.num_robots} robots"
        return (
            f"{self.graph.name}, {robots}: {mantissa:.1f}e+{exponent:02d} states, {self.num_controls} controls, "
            f"{self.num_observations} observations, discount {self.discount:g}"
        )

    # ---- controls ------------------------------------------------------------------------------------------------

    def action_mask(self, y: TensorDictBase) -> Tensor:
        """Legal joint controls, see :mod:`~torchrl_pomdp.envs.controls`: every robot's control is legal for it."""
        robots = self.agent_mask(y)
        if not self.enumerable:
            return robots
        mask = robots[..., 0, :]
        for robot in range(1, self.num_robots):
            mask = (mask.unsqueeze(-1) & robots[..., robot, :].unsqueeze(-2)).flatten(-2)
        return mask

    def agent_mask(self, y: TensorDictBase) -> Tensor:
        """Legal controls of every robot, bool ``[*B, R, A]``."""
        belief, location = y.get("belief"), y.get("location")
        robots = self._legal_when_intact.index_select(0, location.flatten()).unflatten(0, location.shape)
        robots[..., REPAIR] |= belief[..., 0].gather(-1, location) < 1.0
        return robots

    def legal_when_intact(self) -> Tensor:
        """Controls that a robot may take where its location is known to be intact, bool ``[L, A]``."""
        return self._legal_when_intact.clone()

    def unrestricted(self) -> RepairModel:
        """The same model where intact locations may be repaired, as the paper's peers took it (Section VI-D).

        Examples:
            >>> from torchrl_pomdp.problems import make_problem
            >>> problem = make_problem("line3")
            >>> y = problem.start(torch.arange(1)).set("belief", torch.eye(5)[:1].expand(1, 3, 5))
            >>> problem.model.action_mask(y).tolist(), problem.model.unrestricted().action_mask(y).tolist()
            ([[False, False, True]], [[True, False, True]])
        """
        other = copy.copy(self)
        other._buffers = {**self._buffers, "_legal_when_intact": self.destinations >= 0}
        return other

    # ---- the model -----------------------------------------------------------------------------------------------

    def expected_cost(self, y: TensorDictBase, u: Tensor | None = None) -> Tensor:
        """Sum over locations of belief times cost, ``[*B]``; it does not depend on the control."""
        return self._stage_cost(self._planes(y)).view(y.batch_size)

    def is_terminal(self, y: TensorDictBase) -> Tensor:
        """Bool ``[*B]``: P(any damage) <= ``terminal_probability``; never unless the model :attr:`ends`."""
        if not self.ends:
            return torch.zeros(y.batch_size, dtype=torch.bool, device=self.device)
        intact = multiply_first(self._planes(y)[:, 0].clone())
        return (1.0 - intact <= self.terminal_probability).view(y.batch_size)

    def observation_probs(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """Joint distribution of the robots' observed levels, ``[*B, K^R]``.

        Raises:
            TypeError: by :meth:`check_control_shape`.
            ValueError: by :meth:`check_control_shape`, or if there are more than 4096 joint observations of several robots,
                too many for tables.
        """
        self.check_control_shape(y, u)
        self.check_observations_enumerable()
        location, repaired = self._move(y, u)
        columns = self._columns(self._planes(y), location, repaired)
        every = digits(torch.arange(self.num_observations, device=self.device), self.num_levels, self.num_robots)
        joint = torch.ones(self.num_observations, location.shape[-1], dtype=self.dtype, device=self.device)
        for robot, column in enumerate(columns):
            factor = column[every[:, robot]]
            for other in range(robot):
                # Robots that stand together see the same level: the later one's observation is certain.
                together = location[robot] == location[other]
                same = (every[:, robot] == every[:, other]).unsqueeze(-1).to(self.dtype)
                factor = torch.where(together, same, factor)
            joint = joint * factor
        return joint.movedim(0, -1).reshape(*y.batch_size, self.num_observations)

    def check_observations_enumerable(self) -> None:
        """Raise ``ValueError`` where robots have more joint observations, 4096, than can be gone through one by one."""
        if self.num_robots > 1 and self.num_observations > MAX_ENUMERATED:
            raise ValueError(
                f"num_observations must be at most {MAX_ENUMERATED} for their probabilities, got {self.num_levels}^"
                f"{self.num_robots} = {self.num_observations}: draw them by advance(), in rollout with leaves='control'"
            )

    def estimator(self, y: TensorDictBase, u: Tensor, z: Tensor) -> TensorDictBase:
        """F(y, u, z): degrade, then set the levels observed where the robots now stand (0 after a repair).

        Raises:
            ValueError: if a control is illegal or an observation impossible.
        """
        self.check_controls(y, u)
        self.check_observations(y, z)
        location, repaired = self._move(y, u)
        levels = digits(z.reshape(-1), self.num_levels, self.num_robots).T
        planes = self._degrade_planes(self._planes(y))
        self.refuse_impossible(z, self._possible(planes, location, repaired, levels).view(y.batch_size))
        return self._successor(y, self._set_levels(planes, location, levels), location)

    def advance(self, y: TensorDictBase, u: Tensor, noise: Tensor) -> tuple[Tensor, TensorDictBase]:
        """One sampled step; robot r observes with ``noise[..., r]``. See :meth:`BeliefModel.advance`."""
        planes = self._planes(y)
        location, repaired = self._move(y, u)
        levels = self._draw_levels(self._columns(planes, location, repaired), location, noise)
        cost = self._stage_cost(planes).view(y.batch_size)
        return cost, self._successor(y, self._set_levels(self._degrade_planes(planes), location, levels), location)

    def observed(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """The locations where the robots will stand, ``[*B, R]``."""
        location, _ = self._move(y, u)
        return location.T.reshape(*y.batch_size, self.num_robots)

    def observe(self, y: TensorDictBase, noise: Tensor) -> TensorDictBase:
        """Observe the levels where the robots stand, without a control: for start states.

        Args:
            y: feature states ``[*B]``.
            noise: uniforms ``[*B, R]``.
        """
        planes, location = self._planes(y).clone(), y.get("location").reshape(-1, self.num_robots).T
        levels = self._draw_levels([self._levels_at(planes, place) for place in location], location, noise)
        return self._successor(y, self._set_levels(planes, location, levels), location)

    def world(self) -> World:
        """The true damage levels."""
        # Not at the top: the world knows the model.
        from torchrl_pomdp.envs.repair.world import RepairWorld

        return RepairWorld(self)

    def scene(self) -> Scene:
        """The network with the robots on it."""
        # Not at the top: the scene knows the model.
        from torchrl_pomdp.envs.repair.scene import NetworkScene

        return NetworkScene(self)

    # ---- kernels on planes [L, K, N] and locations [R, N] ----------------------------------------------------------

    def _planes(self, y: TensorDictBase) -> Tensor:
        """Belief of ``y`` as contiguous planes ``[L, K, N]``; free for states that the model made."""
        belief = y.get("belief").reshape(-1, self.num_locations, self.num_levels)
        return belief.permute(1, 2, 0).contiguous()

    def _stage_cost(self, planes: Tensor) -> Tensor:
        return sum_first(location_costs(planes, self._prices))

    def _move(self, y: TensorDictBase, u: Tensor) -> tuple[Tensor, Tensor]:
        """For each robot ``[R, N]`` its new location and whether it repairs there."""
        origin = y.get("location").reshape(-1, self.num_robots).T
        controls = self.split_controls(u).reshape(-1, self.num_robots).T
        return self.destinations.flatten()[origin * self.num_robot_controls + controls], controls == REPAIR

    def _columns(self, planes: Tensor, location: Tensor, repaired: Tensor) -> list[Tensor]:
        """For each robot the marginal ``[K, N]`` of its new location at the next stage, before it observes."""
        columns = []
        for robot, place in enumerate(location):
            column = self._degrade_planes(self._levels_at(planes, place).unsqueeze(0), place).squeeze(0)
            columns.append(torch.where(self._fixed(robot, location, repaired), self._repaired(column), column))
        return columns

    def _repaired(self, column: Tensor) -> Tensor:
        """Marginal ``[K, N]`` after an attempt to repair, of one that is ``column`` where it fails."""
        intact = torch.eq(self._levels, 0).to(self.dtype)
        if self.repair_probability == 1.0:
            return intact
        return self.repair_probability * intact + (1.0 - self.repair_probability) * column

    def _possible(self, planes: Tensor, location: Tensor, repaired: Tensor, levels: Tensor) -> Tensor:
        """Whether the robots can see ``levels`` ``[R, N]``, bool ``[N]``, given the degraded ``planes``."""
        possible = torch.ones_like(repaired[0])
        for robot, (place, level) in enumerate(zip(location, levels, strict=True)):
            cell = (place * self.num_levels + level).unsqueeze(0)
            seen = planes.flatten(0, 1).gather(0, cell).squeeze(0) > 0
            intact = level == 0
            after = intact if self.repair_probability == 1.0 else intact | seen
            possible &= torch.where(self._fixed(robot, location, repaired), after, seen)
            for other in range(robot):
                # Robots that stand together see the same level.
                possible &= (place != location[other]) | (level == levels[other])
        return possible

    def _fixed(self, robot: int, location: Tensor, repaired: Tensor) -> Tensor:
        """Whether the place of a robot is repaired, bool ``[N]``: for every robot there, as one that repairs has not moved."""
        fixed = repaired[robot]
        for other in range(self.num_robots):
            if other != robot:
                fixed = fixed | (repaired[other] & (location[other] == location[robot]))
        return fixed

    def _draw_levels(self, columns: list[Tensor], location: Tensor, noise: Tensor) -> Tensor:
        """Levels ``[R, N]`` that the robots see; those that stand together see the same."""
        uniforms = noise.reshape(-1, self.num_robots)
        levels: list[Tensor] = []
        for robot, column in enumerate(columns):
            level = inverse_cdf(column, uniforms[:, robot], dim=0)
            for other in range(robot):
                level = torch.where(location[robot] == location[other], levels[other], level)
            levels.append(level)
        return torch.stack(levels)

    def _degrade_planes(self, planes: Tensor, place: Tensor | None = None) -> Tensor:
        """One step of the chains: a pass over the planes ``[L, K, N]`` for each nonzero diagonal.

        Args:
            planes: beliefs.
            place: the location of each row ``[N]``, where ``planes`` ``[1, K, N]`` are of these.
        """
        several = place is not None and self._stay.ndim == 3

        def own(table: Tensor) -> Tensor:
            return table[place].permute(2, 1, 0) if several else table

        result = planes * own(self._stay)
        for source, target, probs in self._diagonals:
            result[:, target].addcmul_(planes[:, source], own(probs))
        for level in self._overflowing:
            result[:, level].clamp_(max=1.0)
        if self._normalise:
            result /= sum_first(result.transpose(0, 1).clone()).unsqueeze(1)
        return result

    def _set_levels(self, planes: Tensor, location: Tensor, levels: Tensor) -> Tensor:
        """Make ``levels`` ``[R, N]`` certain at ``location`` ``[R, N]``, in place."""
        for place, level in zip(location, levels, strict=True):
            certain = torch.eq(self._levels, level).to(self.dtype)
            planes.scatter_(0, place.expand(1, *planes.shape[1:]), certain.unsqueeze(0))
        return planes

    def _levels_at(self, planes: Tensor, place: Tensor) -> Tensor:
        """Marginal ``[K, N]`` of each row's location ``place`` ``[N]``."""
        return planes.gather(0, place.expand(1, *planes.shape[1:])).squeeze(0)

    def _successor(self, y: TensorDictBase, planes: Tensor, location: Tensor) -> TensorDictBase:
        shape = y.batch_size
        belief = planes.permute(2, 0, 1).reshape(*shape, self.num_locations, self.num_levels)
        return self.successor(y, belief=belief, location=location.T.reshape(*shape, self.num_robots))


def _scientific(number: int) -> tuple[float, int]:
    """Mantissa and decimal exponent of an integer that may exceed the floats."""
    exponent = math.floor(math.log10(number))
    mantissa = round(number / 10**exponent, 1)
    return (mantissa, exponent) if mantissa < 10 else (1.0, exponent + 1)
