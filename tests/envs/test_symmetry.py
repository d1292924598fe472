"""Symmetries against the model itself: images of costs, masks, distributions and successors are those of the images."""

from __future__ import annotations

import pytest
import torch
from _oracles import random_states, small_model

from torchrl_pomdp.envs import Graph, RepairPartition, grid, line, symmetries
from torchrl_pomdp.modules import GreedyRepair, NeverRepairCost, RolloutPolicy

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
        for u in range(model.num_controls):
            rows = y["action_mask"][:, u].nonzero().squeeze(-1)
            control = torch.full((len(rows),), u)
            probs = model.observation_probs(y[rows], control)
            renamed = symmetry.controls[control]
            # The joint observation's digits are the robots' levels.
            levels = torch.arange(model.num_observations)
            digits = torch.stack([levels // model.num_levels ** (robots - 1 - r) % model.num_levels for r in range(robots)], -1)
            z = sum(digits[:, symmetry.robots[r]] * model.num_levels ** (robots - 1 - r) for r in range(robots))
            of_image = model.observation_probs(image[rows], renamed)
            torch.testing.assert_close(of_image[:, z], probs)
            seen = probs.argmax(-1)
            successor = symmetry(model.estimator(y[rows], control, seen))
            torch.testing.assert_close(model.estimator(image[rows], renamed, z[seen])["belief"], successor["belief"])


def test_no_two_are_the_same_and_the_identity_comes_first():
    model = small_model(grid(2, 2))
    found = symmetries(model)
    assert found[0].locations.tolist() == [0, 1, 2, 3]
    assert found[0].controls.tolist() == [0, 1, 2, 3, 4]
    assert len({tuple(s.locations.tolist()) for s in found}) == 8


def test_graphs_without_a_plan_have_only_what_their_edges_allow():
    fork = Graph.from_edges("fork", 4, [(0, 1), (1, 2), (1, 3)])
    assert len(symmetries(small_model(fork))) == 1


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
    assert (labelled["action"] == mirror.controls[policy(y)["action"]]).all()
