from __future__ import annotations

import pytest
import torch

from torchrl_pomdp.envs.repair import Graph, grid, line


@pytest.mark.parametrize("graph", [line(7), grid(4, 3), Graph.from_edges("ring", 5, [(i, (i + 1) % 5) for i in range(5)])])
def test_distances_and_first_controls_agree(graph):
    size = graph.num_locations
    assert torch.equal(graph.distances, graph.distances.T)
    for origin in range(size):
        for target in range(size):
            control = int(graph.first_controls[origin, target])
            if origin == target:
                assert control == 0
                continue
            after = int(graph.neighbours[origin, control - 1])
            assert graph.distances[after, target] == graph.distances[origin, target] - 1
            lower = [n for n in graph.neighbours[origin, : control - 1].tolist() if n >= 0]
            assert all(graph.distances[n, target] >= graph.distances[origin, target] for n in lower), "ties go low"


def test_grid_is_the_manhattan_metric():
    graph = grid(4, 3)
    distance = (graph.columns[:, None] - graph.columns).abs() + (graph.rows[:, None] - graph.rows).abs()
    assert torch.equal(graph.distances, distance.long())
    assert graph.control_names == ("repair", "left", "right", "up", "down")


def test_bad_graphs_are_refused():
    with pytest.raises(ValueError, match="location 2 is unreachable from location 0"):
        Graph.from_edges("broken", 4, [(0, 1), (2, 3)])
    with pytest.raises(ValueError, match="allowed are pairs"):
        Graph.from_edges("broken", 2, [(0, 2)])
    with pytest.raises(ValueError, match="num_locations must be at least 1, got 0"):
        line(0)
    with pytest.raises(ValueError, match="height"):
        grid(2, 0)
    with pytest.raises(ValueError, match="neighbours must hold"):
        Graph.from_slots("broken", [[5]], ("on",), [0], [0])
