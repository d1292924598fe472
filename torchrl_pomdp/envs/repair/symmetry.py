"""Symmetries of the repair problem: what a label says of one state it says of every mirror image of that state.

Reflections and rotations of a line or grid, and exchanges of robots, change neither costs nor probabilities. Every labelled
state therefore stands for several, which is the cheapest way to more training data. The image of a label is a label by the
image of the base policy: by the same policy if that is symmetric, as urgency of one robot is but for ties; by its mirror image,
which costs as much over all states, if it breaks ties by number, as greedy does, lets robots choose one after the other, or is
a network.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice, permutations, product

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.envs.repair.graphs import Graph
from torchrl_pomdp.envs.repair.model import RepairModel
from torchrl_pomdp.tensor_checks import check_entries

__all__ = ["Symmetry", "symmetries"]

# Orders of five robots; with more robots, only the last five change places.
_MOST_ORDERS = 120


@dataclass(frozen=True, eq=False)
class Symmetry:
    """A renaming of locations, controls and robots under which the model stays what it is.

    Attributes:
        model: the repair model.
        locations: int64 ``[L]``; the new name of every location.
        controls: int64 ``[A]``; the new name of every control of a robot.
        robots: int64 ``[R]``; which robot takes the place of the first, the second, ...
        joint_controls: int64 ``[U]``; the new name of every joint control; ``[0]`` where these are no numbers.
    """

    model: RepairModel
    locations: Tensor
    controls: Tensor
    robots: Tensor
    joint_controls: Tensor = field(init=False)

    def __post_init__(self) -> None:
        model = self.model
        every = torch.arange(model.num_controls if model.enumerable else 0, device=model.device)
        if len(every):
            every = model.join_controls(self.controls[model.split_controls(every)[:, self.robots]])
        object.__setattr__(self, "joint_controls", every)

    @property
    def keeps_order(self) -> bool:
        """Whether no robots change places: also where they decide in turn, the image of a label is one."""
        return self.robots.tolist() == list(range(len(self.robots)))

    def __call__(self, y: TensorDictBase) -> TensorDictBase:
        """The images of feature states and labels ``[*B]``; entries that it does not know are the same for the image.

        The part is left out: a partition gives it, which need not be the model's.

        Args:
            y: ``belief`` and ``location``, and any of ``action_mask``, ``action`` and ``q_factors``, the last
                by joint controls or by robots.
        """
        image, keys = check_entries("y", y, ("belief", "location")).copy(), set(y.keys())
        back = self.locations.argsort()
        image.set("belief", y.get("belief").index_select(-2, back))
        image.set("location", self.locations[y.get("location").index_select(-1, self.robots)])
        if "action" in keys:
            u = y.get("action")
            image.set("action", self.joint_controls[u] if self.model.enumerable else self.controls[u[..., self.robots]])
        for key in ("action_mask", "q_factors"):
            if key in keys:
                image.set(key, self._by_control(y.get(key), y.ndim))
        return image.exclude("partition")

    def _by_control(self, values: Tensor, batch_dims: int) -> Tensor:
        """Images of numbers of joint controls ``[*B, U]``, or of robots' controls ``[*B, R, A]``."""
        if values.ndim == batch_dims + 1:
            return values.index_select(-1, self.joint_controls.argsort())
        return values.index_select(-2, self.robots).index_select(-1, self.controls.argsort())


def symmetries(model: RepairModel) -> list[Symmetry]:
    """Symmetries of a repair model that its graph's columns and rows show, the identity first.

    These are all reflections and rotations of the plan by right angles that keep the graph, and the chains and costs of its
    locations, with all exchanges of the robots; of more than five robots the last five are exchanged. Where there are too many
    joint controls to be numbered, robots decide one after the other, and their order stays.

    Args:
        model: the repair model.

    Raises:
        TypeError: if it is no repair model.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> [len(symmetries(make_problem(name).model)) for name in ("linear20", "grid5x4", "grid6x6", "two_robots20")]
        [2, 4, 8, 4]
    """
    check_instance("model", model, RepairModel)
    found = []
    for locations, slots in _graph_symmetries(model.graph):
        if not _keeps(locations, model):
            continue
        controls = torch.tensor([0, *(1 + slot for slot in slots)])
        orders = islice(permutations(range(model.num_robots)), _MOST_ORDERS) if model.enumerable else [range(model.num_robots)]
        for order in orders:
            robots = torch.tensor(order, device=model.device)
            found.append(Symmetry(model, torch.tensor(locations, device=model.device), controls.to(model.device), robots))
    return found


def _keeps(locations: list[int], model: RepairModel) -> bool:
    """Whether every location has the chain and the costs of its image."""
    tables = (model.chain.expand(model.num_locations, -1, -1), model.costs.expand(model.num_locations, -1))
    return all(torch.equal(table, table[locations]) for table in tables)


def _graph_symmetries(graph: Graph) -> Iterator[tuple[list[int], list[int]]]:
    """New names of locations and of slots under the reflections and rotations that map the graph to itself."""
    places = torch.stack([graph.columns, graph.rows], -1).double()
    places = places - (places.amax(0) + places.amin(0)) / 2
    apart = torch.cdist(places, places, compute_mode="donot_use_mm_for_euclid_dist")
    # Coordinates are rounded, to float32 at least: an image is at a place if it is much nearer to it than two places are.
    tolerance = 1e-2 * float(apart.fill_diagonal_(torch.inf).amin())
    seen = set()
    for turn, across, down in product((False, True), repeat=3):
        image = places.flip(-1) if turn else places
        image = image * image.new_tensor([-1.0 if across else 1.0, -1.0 if down else 1.0])
        distance, nearest = torch.cdist(image, places, compute_mode="donot_use_mm_for_euclid_dist").min(-1)
        renamed = nearest.tolist()
        if tuple(renamed) in seen or bool((distance > tolerance).any()):
            continue
        slots = _slot_names(graph, renamed)
        if slots is not None:
            seen.add(tuple(renamed))
            yield renamed, slots


def _slot_names(graph: Graph, renamed: list[int]) -> list[int] | None:
    """New names of the slots if locations are renamed, or None where no renaming of slots keeps the graph.

    A slot must become one that leads from every image to the image of where it led; of several the lowest that is free.
    """
    names = torch.tensor([*renamed, -1])
    old = names[graph.neighbours].T.tolist()
    free: dict[tuple[int, ...], list[int]] = {}
    for slot, column in reversed(list(enumerate(graph.neighbours[names[:-1]].T.tolist()))):
        free.setdefault(tuple(column), []).append(slot)
    slots = []
    for column in old:
        same = free.get(tuple(column))
        if not same:
            return None
        slots.append(same.pop())
    return slots
