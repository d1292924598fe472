from __future__ import annotations

import networkx
import pytest
import torch
from tensordict import TensorDict

from torchrl_pomdp.envs.repair import Graph, RandomState, RepairModel, RepairPartition, damage_chain, grid, line
from torchrl_pomdp.modules.repair import RelativeEncoder

CHAIN, COSTS = damage_chain((0.0, 0.1)), torch.tensor([0.0, 1.0, 10.0])
# The numbers that the locations of a line of 7 get.
SHUFFLED = [4, 0, 6, 2, 5, 1, 3]


def shuffled_line():
    return Graph.from_edges("pipe", 7, [(SHUFFLED[i], SHUFFLED[i + 1]) for i in range(6)])


def shuffled(y):
    """States of the line as states of the line with shuffled numbers."""
    back = torch.tensor(SHUFFLED).argsort()
    location = torch.tensor(SHUFFLED)[y["location"]]
    return TensorDict({"belief": y["belief"].index_select(-2, back), "location": location}, y.batch_size)


def test_a_line_is_a_line_whatever_its_numbers():
    graph = shuffled_line()
    assert graph.columns[SHUFFLED].tolist() in ([0, 1, 2, 3, 4, 5, 6], [6, 5, 4, 3, 2, 1, 0])
    assert graph.rows.tolist() == [0.0] * 7


def test_left_and_right_go_by_distance_and_not_by_number():
    model, other = (RepairModel(graph, CHAIN, COSTS, 0.9) for graph in (line(7), shuffled_line()))
    y = RandomState(model)(torch.arange(500))
    parts = RepairPartition(model.graph, COSTS)(y)
    same = RepairPartition(other.graph, COSTS)(shuffled(y))
    if int(other.graph.columns[SHUFFLED[0]]) > 0:
        density = 2 - same % 3
        same = same // 3 * 3 + density
    assert torch.equal(parts, same)
    assert len(parts.unique()) == 6


def test_windows_go_by_distance_and_not_by_number():
    model, other = (RepairModel(graph, CHAIN, COSTS, 0.9) for graph in (line(7), shuffled_line()))
    y = RandomState(model)(torch.arange(40))
    windows = 13 * 3
    first, second = (RelativeEncoder(m)(s)[:, :windows] for m, s in ((model, y), (other, shuffled(y))))
    if int(other.graph.columns[SHUFFLED[0]]) > 0:
        second = second.view(-1, 13, 3).flip(1).flatten(1)
    assert torch.equal(first, second)


def test_a_grid_is_recognised():
    plain = grid(4, 3)
    edges = [(a, b) for a, row in enumerate(plain.neighbours.tolist()) for b in row if b > a]
    graph = Graph.from_edges("field", 12, edges)
    places = torch.stack([graph.columns, graph.rows], -1)
    # The grid turned by 45 degrees: distances in the maximum norm are those of the graph.
    assert torch.equal(torch.cdist(places, places, p=torch.inf).round().long(), graph.distances)


@pytest.mark.parametrize(
    "graph",
    [
        networkx.path_graph(1),
        networkx.path_graph(2),
        networkx.star_graph(9),
        networkx.complete_graph(8),
        networkx.cycle_graph(9),
        networkx.complete_bipartite_graph(3, 5),
        networkx.balanced_tree(3, 3),
        networkx.connected_watts_strogatz_graph(60, 4, 0.3, seed=1),
        networkx.petersen_graph(),
    ],
    ids=lambda graph: f"{len(graph)} nodes",
)
def test_every_location_has_a_place_of_its_own(graph):
    made = Graph.from_networkx(graph)
    places = torch.stack([made.columns, made.rows], -1)
    assert len(places.unique(dim=0)) == len(graph)
    # Columns are ways between two poles: neighbours are at most one apart, and the farthest locations as far as they are.
    for a, b in graph.edges:
        assert abs(float(made.columns[a] - made.columns[b])) <= 1
    assert float(made.columns.max() - made.columns.min()) == float(made.distances.max())
    assert RelativeEncoder(RepairModel(made, CHAIN, COSTS, 0.9)).num_features > 0


def test_coordinates_that_are_given_are_kept():
    assert line(4).columns.tolist() == [0, 1, 2, 3]
    assert line(4).rows.tolist() == [0, 0, 0, 0]
    assert grid(3, 2).columns.tolist() == [0, 1, 2, 0, 1, 2]
    edges = [(0, 1), (1, 2)]
    assert Graph.from_edges("pipe", 3, edges, columns=[5, 1, 3]).columns.tolist() == [5, 1, 3]
    both = Graph.from_edges("pipe", 3, edges, columns=[5, 1, 3], rows=[1, 2, 1])
    assert both.rows.tolist() == [1, 2, 1]
    upright = Graph.from_edges("pipe", 3, edges, rows=[1, 2, 4])
    assert (upright.columns.tolist(), upright.rows.tolist()) == ([0, 0, 0], [1, 2, 4])
    slots = Graph.from_slots("pipe", [[1], [0]], ["across"])
    assert slots.columns.tolist() == [0, 1]


def test_graphs_of_networkx():
    plant = networkx.Graph()
    plant.add_edges_from([("pump", "tank"), ("tank", ("valve", 1)), ("tank", 7)])
    graph = Graph.from_networkx(plant)
    assert graph.location_names == ("pump", "tank", "('valve', 1)", "7")
    assert graph.name == "graph of 4"
    assert graph.neighbours[1].tolist() == [0, 2, 3]
    positions = {"pump": (0, 0), "tank": [1.5, 0], ("valve", 1): torch.tensor([3.0, 1.0]), 7: (3, -1)}
    placed = Graph.from_networkx(plant, name="plant", positions=positions)
    assert (placed.name, placed.columns.tolist(), placed.rows.tolist()) == ("plant", [0, 1.5, 3, 3], [0, 0, 1, -1])
    doubled = networkx.MultiGraph([(0, 1), (0, 1), (1, 2)])
    assert torch.equal(Graph.from_networkx(doubled).neighbours, Graph.from_edges("x", 3, [(0, 1), (1, 2)]).neighbours)
    assert line(3).location_names == ("0", "1", "2")


class Directed:
    nodes, edges = (0, 1), ((0, 1),)

    def is_directed(self):
        return True


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: Graph.from_networkx(Directed()), ValueError, "graph must be undirected"),
        (lambda: Graph.from_networkx([(0, 1)]), TypeError, "graph must have nodes and edges"),
        (lambda: Graph.from_networkx(networkx.Graph([(1, "1")])), ValueError, "location_names must hold different names"),
        (lambda: Graph.from_networkx(networkx.Graph([(1, 1), (1, 2)])), ValueError, "pairs of different locations"),
        (lambda: Graph.from_networkx(networkx.Graph()), ValueError, "num_locations must be at least 1"),
        (lambda: Graph.from_networkx(networkx.Graph([(0, 1), (2, 3)])), ValueError, "unreachable"),
        (lambda: Graph.from_networkx(networkx.path_graph(2), positions={0: (0, 0)}), ValueError, "row of every node.* for 1"),
        (lambda: Graph.from_networkx(networkx.path_graph(2), positions=[(0, 0)]), TypeError, "positions must map"),
        (lambda: Graph.from_networkx(networkx.path_graph(1), positions={0: "ab"}), TypeError, r"\[0\] must be a sequence"),
        (lambda: Graph.from_networkx(networkx.path_graph(1), positions={0: (0, "b")}), TypeError, "position of 0"),
        (lambda: Graph.from_networkx(networkx.path_graph(2), positions={0: (1, 1), 1: (1, 1)}), ValueError, "place of its own"),
        (lambda: Graph.from_networkx(networkx.path_graph(2), name=""), ValueError, "name must be a text"),
        (lambda: Graph.from_edges("x", 2, [(0, 1)], location_names=("a",)), ValueError, "location_names must hold 2 names"),
        (lambda: Graph.from_edges("x", 2, [(0, 1)], location_names=3), TypeError, "location_names must be a sequence"),
        (lambda: Graph.from_edges("x", 2, [(0, 1)], location_names=("a", 3)), TypeError, r"location_names\[1\] must be a text"),
        (lambda: Graph.from_slots("x", [[1], [0]], ["repair"]), ValueError, "slot_names must not hold 'repair'"),
        (lambda: Graph.from_edges("x", 2, [(0, 1)], columns=[0]), ValueError, "columns must have shape"),
    ],
)
def test_what_is_no_graph_is_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()
