"""Symmetries against the model itself: images of costs, masks, distributions and successors are those of the images."""

from __future__ import annotations

import dataclasses
import time
from itertools import permutations

import pytest
import torch
from _oracles import random_states, small_model

from torchrl_pomdp.envs.repair import Graph, RepairModel, RepairPartition, damage_chain, grid, line, symmetries
from torchrl_pomdp.modules import RolloutPolicy
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost
from torchrl_pomdp.problems import make_problem

CASES = [(line(4), 1, 2), (grid(3, 2), 1, 4), (grid(2, 2), 1, 8), (line(3), 2, 4), (grid(2, 1), 3, 12)]


@pytest.mark.parametrize(("graph", "robots", "count"), CASES)
def test_the_model_does_not_see_the_difference(graph, robots, count):
    model = small_model(graph, num_robots=robots, partition=RepairPartition(graph, torch.tensor([0.0, 1.0, 5.0])))
    found = symmetries(model)
    assert len(found) == count
    y = model.with_features(random_states(model, 60, 0))
    for symmetry in found:
        image = symmetry(y)
        assert torch.equal(image["action_mask"], model.action_mask(image))
        torch.testing.assert_close(model.expected_cost(image), model.expected_cost(y))
        rows, control = y["action_mask"].nonzero(as_tuple=True)
        probs = model.observation_probs(y[rows], control)
        renamed = symmetry.joint_controls[control]
        # The joint observation's digits are the robots' levels.
        levels = torch.arange(model.num_observations)
        digits = torch.stack([levels // model.num_levels ** (robots - 1 - r) % model.num_levels for r in range(robots)], -1)
        z = sum(digits[:, symmetry.robots[r]] * model.num_levels ** (robots - 1 - r) for r in range(robots))
        of_image = model.observation_probs(image[rows], renamed)
        torch.testing.assert_close(of_image[:, z], probs)
        seen = probs.argmax(-1)
        successor = symmetry(model.estimator(y[rows], control, seen))
        torch.testing.assert_close(model.estimator(image[rows], renamed, z[seen])["belief"], successor["belief"])


def test_an_image_says_nothing_of_the_part():
    """That is a partition's, also of a problem that has been given another one."""
    problem = make_problem("linear20").unpartitioned()
    y = problem.model.with_features(problem.start(torch.arange(8)))
    for symmetry in problem.symmetries:
        image = symmetry(y)
        assert image.get("partition", None) is None
        assert problem.model.with_features(image)["partition"].tolist() == [0] * 8


def test_no_two_are_the_same_and_the_identity_comes_first():
    model = small_model(grid(2, 2))
    found = symmetries(model)
    assert found[0].locations.tolist() == [0, 1, 2, 3]
    assert found[0].controls.tolist() == [0, 1, 2, 3, 4]
    assert len({tuple(s.locations.tolist()) for s in found}) == 8


@pytest.mark.parametrize("table", ["chain", "costs", "both"])
def test_chains_and_costs_of_locations_are_kept(table):
    """A line whose tables are those of its mirror image has a reflection; one of whose locations differs has none."""
    chains = torch.stack([damage_chain(rise) for rise in ((0.0, 0.3), (0.1, 0.2))])
    costs = torch.tensor([[0.0, 1.0, 5.0], [0.5, 2.0, 3.0]])
    for ends, count in (((0, 1, 1, 0), 2), ((0, 1, 0, 1), 1), ((0, 0, 0, 1), 1), ((0, 0, 0, 0), 2)):
        own = torch.tensor(ends)
        chain = chains[0] if table == "costs" else chains[own]
        price = costs[0] if table == "chain" else costs[own]
        found = symmetries(RepairModel(line(4), chain, price, 0.9))
        assert [s.locations.tolist() for s in found] == [[0, 1, 2, 3], [3, 2, 1, 0]][:count]


def test_graphs_without_a_plan_have_only_what_their_edges_allow():
    fork = Graph.from_edges("fork", 4, [(0, 1), (1, 2), (1, 3)])
    # Its two short arms may be exchanged; places from distances show it.
    assert [s.locations.tolist() for s in symmetries(small_model(fork))] == [[0, 1, 2, 3], [0, 1, 3, 2]]


def by_trying(graph):
    """Slot maps by trying all permutations: the first one that keeps the graph, for every map of locations."""
    table, size = graph.neighbours.tolist(), graph.num_locations
    found = set()
    for renamed in permutations(range(size)):
        for slots in permutations(range(len(graph.slot_names))):
            kept = (
                table[renamed[n]][slots[s]] == (renamed[t] if t >= 0 else -1)
                for n in range(size)
                for s, t in enumerate(table[n])
            )
            if all(kept):
                found.add((renamed, slots))
                break
    return found


RING = Graph.from_slots("ring", [[1, 3], [2, 0], [3, 1], [0, 2]], ("on", "back"), [0, 1, 1, 0], [0, 0, 1, 1])


@pytest.mark.parametrize("graph", [line(1), line(4), grid(2, 2), grid(3, 2), grid(1, 3), RING])
def test_slot_maps_are_those_found_by_trying(graph):
    tried = by_trying(graph)
    found = [(tuple(s.locations.tolist()), tuple((s.controls[1:] - 1).tolist())) for s in symmetries(small_model(graph))]
    assert set(found) <= tried
    assert found[0] == (tuple(range(graph.num_locations)), tuple(range(len(graph.slot_names))))


@pytest.mark.parametrize(("scale", "shift"), [(0.4, 0.0), (0.1, 7.3), (210.7, 1000.9)])
@pytest.mark.parametrize(("graph", "count"), [(line(5), 2), (grid(3, 2), 4), (grid(4, 4), 8)])
def test_coordinates_may_be_in_metres(graph, count, scale, shift):
    moved = dataclasses.replace(graph, columns=graph.columns * scale + shift, rows=graph.rows * scale - shift)
    found, expected = symmetries(small_model(moved)), symmetries(small_model(graph))
    assert len(found) == count
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one.locations, other.locations)
        assert torch.equal(one.controls, other.controls)


def test_any_degree_and_number_of_robots_is_quick():
    hub = Graph.from_edges("hub", 13, [(0, arm) for arm in range(1, 13)])
    plus = Graph.from_slots(
        "plus",
        [[1, 2, 3, 4], [-1, 0, -1, -1], [0, -1, -1, -1], [-1, -1, -1, 0], [-1, -1, 0, -1]],
        ("left", "right", "up", "down"),
        [0, -1, 1, 0, 0],
        [0, 0, 0, -1, 1],
    )
    began = time.perf_counter()
    assert len(symmetries(small_model(hub))) == 1
    assert len(symmetries(small_model(plus))) == 8
    assert len(symmetries(small_model(line(2), num_robots=6))) == 240
    assert time.perf_counter() - began < 5


def test_images_of_labels_are_labels_of_images():
    """Q-factors of many trajectories of the image agree with the image of the Q-factors."""
    model = small_model(line(4), dtype=torch.float64)
    y = model.with_features(random_states(model, 20, 1))
    mirror = symmetries(model)[1]
    policy = RolloutPolicy(
        model, GreedyRepair(model), trajectories=4000, leaves="observation", max_steps=40, terminal_cost=NeverRepairCost(model)
    )
    labelled = mirror(policy(y))
    again = policy(mirror(y))
    ties = (labelled["q_factors"] - again["q_factors"]).nan_to_num(0.0).abs()
    # Greedy itself breaks ties to the left, so that its own cost is not quite symmetric.
    assert float(ties.mean() / again["q_factors"][torch.isfinite(again["q_factors"])].mean()) < 0.05
    assert (labelled["action"] == mirror.joint_controls[policy(y)["action"]]).all()
