"""What a problem says of itself."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from torchrl_pomdp.cli import main
from torchrl_pomdp.envs import FixedBelief, TabularModel
from torchrl_pomdp.envs.repair import RepairModel, UniformStart, damage_chain, line
from torchrl_pomdp.evaluation import discounted_costs
from torchrl_pomdp.modules import ConstantCost
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.problems import Problem, make_problem, tiger


def test_what_an_evaluation_cuts_does_not_outweigh_small_costs(capsys):
    """Listening for ever costs 1 a stage: 20 in all. The largest cost of a stage, for ever, would be 2000."""
    assert main(["evaluate", "listen", "--problem", "tiger", "--states", "5"]) == 0
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| listen |")]
    assert float(row.split("|")[2].split("±")[0]) == pytest.approx(20.0, abs=0.05)
    line3 = make_problem("line3")
    assert line3.evaluation_cost is line3.pessimistic_cost


@pytest.mark.parametrize(("discount", "stages", "left"), [(0.95, 135, 0.001), (0.99, 400, 0.018)])
def test_what_an_evaluation_leaves_out(discount, stages, left):
    """Of a cost of 1 a stage for ever: a thousandth, or what 400 stages leave where more would be needed."""
    change, see = torch.ones(1, 1, 1), torch.ones(1, 1, 1)
    problem = Problem(TabularModel(change, see, torch.ones(1, 1), discount), FixedBelief(torch.ones(1)))
    assert problem.model.horizon == stages
    policy = problem.base_policies["myopic"]
    costs = discounted_costs(problem.model, policy, problem.start, num_states=2, terminal_cost=problem.evaluation_cost)
    torch.testing.assert_close(costs, torch.full((2,), (1 - discount**stages) / (1 - discount)))
    assert 0.9 * left < 1 - float(costs[0]) * (1 - discount) <= left


def test_the_first_symmetry_is_the_identity(line3):
    identity, mirror = line3.symmetries
    for sound in ((identity, mirror), (lambda y: y, mirror), (lambda y: y.copy(),)):
        assert len(replace(line3, symmetries=sound, spec=None).symmetries) == len(sound)
    with pytest.raises(ValueError, match="symmetries must hold the identity first, got one that changes 'belief'"):
        replace(line3, symmetries=(mirror, identity), spec=None)
    with pytest.raises(TypeError, match=r"symmetries\[0\]\(y\)"):
        replace(line3, symmetries=(lambda y: None,), spec=None)


@pytest.mark.parametrize("robots", [1, 8])
def test_a_problem_without_a_known_bound_finds_one(robots):
    """Whatever eight robots do, of whose 6561 joint controls not all are tried: a stage costs up to 4 times 5."""
    model = RepairModel(line(4), damage_chain((0.0, 0.5)), (0.0, 1.0, 5.0), 0.9, num_robots=robots)
    problem = Problem(model, UniformStart(model, robots=(0,) * robots), base_policies={"greedy": GreedyRepair(model)})
    assert 100.0 < problem.pessimistic_cost.cost < 200.1


def test_pessimistic_costs_are_positive():
    problem = tiger()
    with pytest.raises(ValueError, match=r"pessimistic_cost must be positive, .* got -5\.0 in a start state"):
        replace(problem, pessimistic_cost=ConstantCost(problem.model, -5.0), spec=None)
    assert replace(problem, pessimistic_cost=ConstantCost(problem.model, 5.0), spec=None).pessimistic_cost.cost == 5.0


@pytest.mark.parametrize("name", ["action", "cost", "next", "hidden", "q_factors"])
def test_entries_have_no_names_of_what_stands_beside_them(name):
    class Named(TabularModel):
        state_keys = ("belief", name)

    with pytest.raises(ValueError, match=f"state_keys must not hold names of what stands beside a state, got {name}"):
        Named(torch.ones(1, 1, 1), torch.ones(1, 1, 1), torch.ones(1, 1), 0.9)


def test_start_states_must_be_states_of_the_model():
    with pytest.raises(ValueError, match=r"entry .belief. of y has shape \(1, 3\), expected \(1, 2\)"):
        Problem(tiger().model, FixedBelief(torch.tensor([1.0, 0.0, 0.0])))
