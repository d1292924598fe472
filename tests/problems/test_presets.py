from __future__ import annotations

import pytest
import torch

from torchrl_pomdp.envs.repair import damage_chain
from torchrl_pomdp.problems import PRESETS, make_problem, problem_from_spec, repair_problem, rocksample

# States, controls, observations and the model's own description of them.
SIZES = {
    "line3": (3 * 5**3, 3, 5, "line of 3, 1 robot: 3.8e+02 states"),
    "linear20": (20 * 5**20, 3, 5, "line of 20, 1 robot: 1.9e+15 states"),
    "grid5x4": (20 * 5**20, 5, 5, "5 x 4 grid, 1 robot: 1.9e+15 states"),
    "grid6x6": (36 * 5**36, 5, 5, "6 x 6 grid, 1 robot: 5.2e+26 states"),
    "two_robots20": (20**2 * 5**20, 9, 25, "line of 20, 2 robots: 3.8e+16 states"),
    "linear20_slow_repair": (20 * 5**20, 3, 5, "line of 20, 1 robot: 1.9e+15 states"),
    "linear20_uneven": (20 * 5**20, 3, 5, "line of 20, 1 robot: 1.9e+15 states"),
    "grid6x6_obstacles": (30 * 5**30, 5, 5, "6 x 6 grid with 6 obstacles, 1 robot: 2.8e+22 states"),
}
# The others: controls, observations, and what their description says.
OTHERS = {
    "tiger": (3, 2, "2 states"),
    "crying_baby": (2, 2, "2 states"),
    "rocksample7x8": (13, 3, "12545 states"),
    "rocksample11x11": (16, 3, "247809 states"),
    "rocksample15x15": (20, 3, "7372801 states"),
    "network32x4": (5**4, 5**4, "network of 32, 4 robots: 2.4e+28 states"),
    "network32x8": (5**8, 5**8, "network of 32, 8 robots: 2.6e+34 states"),
    "network32x10": (5**10, 5**10, "network of 32, 10 robots: 2.6e+37 states"),
    **{f"maintenance{k}": (243, 1024, "MaintenanceModel") for k in range(1, 6)},
}


def test_the_sizes_of_all_presets():
    assert set(PRESETS) == {*SIZES, *OTHERS}
    for name, (states, controls, observations, text) in SIZES.items():
        model = make_problem(name).model
        assert (model.num_states, model.num_controls, model.num_observations) == (states, controls, observations)
        assert model.describe().startswith(text)
    for name, (controls, observations, text) in OTHERS.items():
        model = make_problem(name).model
        assert (model.num_controls, model.num_observations) == (controls, observations)
        assert text in model.describe()


@pytest.mark.parametrize("name", sorted(SIZES))
def test_training_states_lie_in_their_parts_and_starts_are_startgame(name):
    problem = make_problem(name)
    for part, generator in enumerate(problem.training):
        y = problem.model.with_features(generator(torch.arange(40)))
        problem.model.check_state(y)
        assert (y["partition"] == part).all()
    assert (problem.model.partition(problem.start(torch.arange(200))) < 3).all()


def test_unknown_presets_are_refused():
    with pytest.raises(ValueError, match="unknown preset 'line4'; do you mean line3\\?; known presets: crying_baby, grid5x4"):
        make_problem("line4")


@pytest.mark.parametrize(
    ("name", "option", "value"),
    [("rocksample7x8", "n", 3), ("rocksample11x11", "k", 2), ("maintenance3", "k", 1), ("linear20_uneven", "uneven", False)],
)
def test_options_that_a_name_says_are_refused(name, option, value):
    with pytest.raises(TypeError, match=f"{name} takes no option {option}, which its name says; got {value}"):
        make_problem(name, **{option: value})
    with pytest.raises(ValueError, match=option):
        problem_from_spec({"preset": name, option: value})
    assert make_problem("rocksample15x15", seed=3).model.rocks == rocksample(15, 15, seed=3).model.rocks


def test_extensions_are_described_by_plain_json():
    chains = [[[1.0, 0.0], [0.0, 1.0]], [[0.5, 0.5], [0.0, 1.0]], [[1.0, 0.0], [0.0, 1.0]]]
    table = {
        "graph": {"grid": [2, 2], "obstacles": [[1, 1]]},
        "chain": chains,
        "costs": [[0, 1], [0, 2], [0, 3]],
        "discount": 0.9,
        "repair_probability": 0.5,
    }
    model = problem_from_spec({"repair": table}).model
    assert (model.num_locations, model.repair_probability) == (3, 0.5)
    assert model.chain.tolist() == chains
    assert model.costs.tolist() == table["costs"]
    with pytest.raises(ValueError, match=r"repair\.repair_probability of spec: repair_probability must be in"):
        problem_from_spec({"repair": {**table, "repair_probability": 0}})


def test_a_graph_of_another_library_is_refused_by_name():
    with pytest.raises(TypeError, match="graph must be a Graph, got"):
        repair_problem({0: [1]}, chain=damage_chain([0.0, 0.1]), costs=[0.0, 1.0, 2.0], discount=0.9)
