r"""A small repair problem as a tabular model, by enumeration of its joint states (paper, Sections II and VI-A).

A joint state says where the R robots are and at which level each of the L locations is. It is the number whose digits are the
locations of the robots, robot 0 first, then the levels of the locations, location 0 first. Controls and observations keep
their numbers.

**Legality.** In a :class:`~torchrl_pomdp.envs.RepairModel` a robot may repair unless its location is *known* to be at level 0;
in a tabular model a control is legal at a belief if it is in every state of the support. The two agree where each robot knows
whether its location is at level 0. After every control it does, as it observes the level where it stands. Before the first
control it may not: a belief with 0 < P(level 0) < 1 there has states in which repair is illegal. For such starts each robot
gets a digit more, in front of all others: 1 while it has not looked. A robot that has not looked may repair in any state, and
every control takes the digit to 0.

No state is terminal: where nothing is damaged the robots still move, and what is known of a state must tell where they are.
The repair model calls a state terminal up to a small probability of damage; the tabular one charges that, too.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_flag, check_instance
from torchrl_pomdp.envs.digits import digits, joined
from torchrl_pomdp.envs.repair.model import REPAIR, RepairModel
from torchrl_pomdp.envs.tabular import TabularModel

__all__ = ["joint_belief", "tabular_model"]

# Largest numbers of joint states and of transitions of positive probability.
_MOST_STATES, _MOST_ENTRIES = 1 << 17, 1 << 24


def tabular_model(model: RepairModel, *, start_observed: bool = True) -> TabularModel:
    r"""The tabular model of a repair problem: the same controls, observations, costs and beliefs.

    It has :math:`L^R K^L` states, see the module for their numbers; tables are sparse. The type is that of ``model``.

    Args:
        model: the repair model.

    Keyword Args:
        start_observed: whether each robot knows from the start if its location is at level 0. If not, there are
            :math:`2^R` times as many states.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if there are more than 131072 states, or more than 16777216 transitions.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> table = tabular_model(make_problem("line3").model)
        >>> table.num_states, table.num_controls, table.num_observations
        (375, 3, 5)
    """
    check_instance("model", model, RepairModel)
    flags = 1 if check_flag("start_observed", start_observed) else 2**model.num_robots
    _check_size(model, flags)
    places, levels = _places(model), _levels(model)
    controls = digits(torch.arange(model.num_controls), model.num_robot_controls, model.num_robots)
    looked = digits(torch.arange(flags), 2, model.num_robots) == 0
    paid = model.costs.cpu().expand(model.num_locations, -1)[torch.arange(model.num_locations), levels]
    cost = paid.sum(-1).repeat(flags * len(places)).expand(model.num_controls, -1)
    return TabularModel(
        _transition(model, controls, places, flags),
        _observation(model, places, levels, flags),
        cost,
        model.discount,
        legal=_legal(model, controls, places, levels, looked),
        dtype=model.dtype,
        device=model.device,
    )


def joint_belief(model: RepairModel, y: TensorDictBase, *, start_observed: bool = True) -> Tensor:
    r"""Beliefs ``[*B, n]`` of :func:`tabular_model` for feature states of the repair model.

    The probability of a joint state is :math:`\prod_l b(l,k_l)` where the robots are, and zero elsewhere.

    Args:
        model: the repair model.
        y: its feature states ``[*B]``.

    Keyword Args:
        start_observed: as for the tabular model.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``y`` is no feature state of the model, if there are too many states, or if ``start_observed`` and a
            robot does not know whether its location is at level 0.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("line3")
        >>> belief = joint_belief(problem.model, problem.start(torch.arange(4)))
        >>> belief.shape, int((belief[0] > 0).sum())
        (torch.Size([4, 375]), 25)
    """
    check_instance("model", model, RepairModel).check_state(y)
    flags = 1 if check_flag("start_observed", start_observed) else 2**model.num_robots
    _check_size(model, flags)
    belief, location = y.get("belief"), y.get("location")
    intact = belief[..., 0].gather(-1, location)
    unknown = (intact > 0) & (intact < 1)
    if start_observed and bool(unknown.any()):
        where = tuple(unknown.nonzero()[0].tolist())
        raise ValueError(
            "y must have robots that know whether their locations are at level 0, or start_observed be False; got "
            f"P(level 0) = {float(intact[where]):.6g} at index {where}"
        )
    joint = belief[..., 0, :]
    for place in range(1, model.num_locations):
        joint = (joint.unsqueeze(-1) * belief[..., place, None, :]).flatten(-2)
    block = joined(location, model.num_locations)
    block = block + (0 if start_observed else joined(unknown.long(), 2)) * model.num_locations**model.num_robots
    result = joint.new_zeros(*y.batch_size, flags * model.num_locations**model.num_robots, joint.shape[-1])
    index = block[..., None, None].expand(*y.batch_size, 1, joint.shape[-1])
    return result.scatter_(-2, index, joint.unsqueeze(-2)).flatten(-2)


def _check_size(model: RepairModel, flags: int) -> None:
    places = flags * model.num_locations**model.num_robots
    states = places * model.num_levels**model.num_locations
    steps = (model.chain > 0).sum((-2, -1)).expand(model.num_locations).tolist()
    entries = model.num_controls * places * math.prod(steps)
    if states > _MOST_STATES or entries > _MOST_ENTRIES:
        raise ValueError(
            f"model must have at most {_MOST_STATES} joint states with {_MOST_ENTRIES} transitions, got {states} with {entries}"
        )


def _places(model: RepairModel) -> Tensor:
    """Locations of the robots in every block of states, ``[L^R, R]``."""
    return digits(torch.arange(model.num_locations**model.num_robots), model.num_locations, model.num_robots)


def _levels(model: RepairModel) -> Tensor:
    """Levels of the locations in every state of a block, ``[K^L, L]``."""
    return digits(torch.arange(model.num_levels**model.num_locations), model.num_levels, model.num_locations)


def _legal(model: RepairModel, controls: Tensor, places: Tensor, levels: Tensor, looked: Tensor) -> Tensor:
    """Legal controls ``[n, U]``: every robot's control is legal for it."""
    moves = model.destinations.cpu()[places] >= 0
    moves[..., REPAIR] = model.legal_when_intact().cpu()[places][..., REPAIR]
    damaged = levels[:, places.T].permute(0, 2, 1) > 0
    # [flags, blocks, levels, robots]: whether the robot may repair.
    repair = moves[..., REPAIR].unsqueeze(1) | damaged.permute(1, 0, 2) | ~looked[:, None, None]
    robots = moves.unsqueeze(1).expand(*repair.shape, -1).clone()
    robots[..., REPAIR] = repair
    chosen = controls.T.expand(*robots.shape[:-1], -1)
    return robots.gather(-1, chosen).all(-2).flatten(0, -2)


def _transition(model: RepairModel, controls: Tensor, places: Tensor, flags: int) -> Tensor:
    """Transition table ``[U, n, n]``, sparse; from any flags to none. A robot that would leave the graph stays."""
    block = model.num_levels**model.num_locations
    destinations = model.destinations.cpu()
    known: dict[tuple[int, ...], tuple[Tensor, Tensor, Tensor]] = {}
    index, values = [], []
    for u, control in enumerate(controls):
        goal = destinations[places, control.expand_as(places)]
        goal = joined(torch.where(goal < 0, places, goal), model.num_locations) * block
        for origin, (place, target) in enumerate(zip(places, goal.tolist(), strict=True)):
            repaired = tuple(sorted(set(place[control == REPAIR].tolist())))
            if repaired not in known:
                known[repaired] = _levels_step(model, repaired)
            i, j, p = known[repaired]
            for flag in range(flags):
                first = (flag * len(places) + origin) * block
                index.append(torch.stack([torch.full_like(i, u), i + first, j + target]))
                values.append(p)
    n = flags * len(places) * block
    shape = (model.num_controls, n, n)
    return torch.sparse_coo_tensor(torch.cat(index, 1), torch.cat(values), shape, check_invariants=False)


def _levels_step(model: RepairModel, repaired: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """From, to and probability of every step of all levels; locations ``repaired`` come to level 0 if the repair works."""
    chains = model.chain.cpu().double().expand(model.num_locations, -1, -1)
    fix = torch.zeros_like(chains[0])
    fix[:, 0] = model.repair_probability
    i = j = torch.zeros(1, dtype=torch.int64)
    p = torch.ones(1, dtype=torch.float64)
    for place, chain in enumerate(chains):
        table = fix + (1.0 - model.repair_probability) * chain if place in repaired else chain
        source, target = table.nonzero(as_tuple=True)
        i = (i.unsqueeze(1) * len(chain) + source).flatten()
        j = (j.unsqueeze(1) * len(chain) + target).flatten()
        p = (p.unsqueeze(1) * table[source, target]).flatten()
    return i, j, p


def _observation(model: RepairModel, places: Tensor, levels: Tensor, flags: int) -> Tensor:
    """Observation table ``[U, n, Z]``, sparse: the levels where the robots stand, surely."""
    seen = joined(levels[:, places.T].movedim(1, -1), model.num_levels).T.flatten().repeat(flags)
    n, controls = len(seen), model.num_controls
    index = torch.stack(
        [
            torch.arange(controls).repeat_interleave(n),
            torch.arange(n).repeat(controls),
            seen.repeat(controls),
        ]
    )
    shape = (controls, n, model.num_observations)
    return torch.sparse_coo_tensor(index, torch.ones(controls * n, dtype=torch.float64), shape, check_invariants=False)
