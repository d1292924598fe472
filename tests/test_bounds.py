"""Proposition 1 in numbers: it holds on random problems, is attained on a chain, and its policy is the library's."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_pomdp.bounds import ErrorBounds, bounds_figure, error_bounds, looseness, main, random_bounds
from torchrl_pomdp.envs import TabularModel
from torchrl_pomdp.modules import AfterSteps, MultistepLookahead, RolloutPolicy
from torchrl_pomdp.planners import belief_mdp
from torchrl_pomdp.problems import tiger
from torchrl_pomdp.problems.random_tabular import random_model

CASES = [(lookahead, truncation) for lookahead in (1, 2, 3) for truncation in (0, 1, 4)]


def test_it_holds_on_random_problems():
    results = random_bounds(30, seed=1000)
    assert [found for found in results if not found.hold] == []
    assert {(found.lookahead, found.truncation) for found in results} == set(CASES)
    # Enough of them say something: the policy is not optimal, or worse than its base.
    assert sum(found.loss > 1e-6 for found in results) > len(results) / 4
    assert sum(found.rise > 1e-6 for found in results) > 5


def chain(lookahead, truncation, error, discount):
    """A chain of states, seen, of which the last one lasts; in the first, control 0 stays there at a cost, a little below
    what error-ridden lookahead takes it for."""
    n = lookahead + truncation + 1
    ahead = torch.eye(n, dtype=torch.float64).roll(1, 1)
    ahead[-1] = torch.eye(n, dtype=torch.float64)[-1]
    stay = ahead.clone()
    stay[0] = torch.eye(n, dtype=torch.float64)[0]
    cost = torch.zeros(2, n, dtype=torch.float64)
    cost[0, 0] = 2 * discount ** (lookahead + truncation) * error * (1 - 1e-9)
    seen = torch.eye(n, dtype=torch.float64).expand(2, n, n)
    model = TabularModel(torch.stack([stay, ahead]), seen, cost, discount, dtype=torch.float64)
    mdp = belief_mdp(model, torch.eye(n)[0])
    place = mdp.belief.argmax(-1)
    assert sorted(place.tolist()) == list(range(n))
    return mdp, torch.where(place == n - 1, error, torch.where(place == n - 2, -error, 0.0))


@pytest.mark.parametrize(("lookahead", "truncation"), CASES)
def test_a_chain_attains_both_bounds(lookahead, truncation):
    mdp, terminal = chain(lookahead, truncation, error=3.0, discount=0.8)
    ahead = torch.ones(len(mdp), dtype=torch.int64)
    found = error_bounds(mdp, ahead, terminal, lookahead=lookahead, truncation=truncation)
    expected = 2 * 0.8 ** (lookahead + truncation) * 3.0 / (1 - 0.8)
    for side in (found.loss, found.loss_bound, found.rise, found.sharp_rise_bound):
        assert side == pytest.approx(expected, rel=1e-6)
    assert found.rise_bound == pytest.approx(30.0)
    assert found.hold


def test_without_error_the_policy_improves():
    mdp = belief_mdp(tiger(0.75).model, torch.tensor([0.5, 0.5]))
    listen = torch.zeros(len(mdp), dtype=torch.int64)
    found = error_bounds(mdp, listen, mdp.policy_cost(listen), lookahead=3)
    assert found.rise_bound == 0.0
    assert found.rise < -1.0
    assert found.hold


def test_the_optimal_cost_as_terminal_cost_leaves_no_loss():
    model = random_model(11)
    mdp = belief_mdp(model, torch.eye(model.num_states)[0])
    found = error_bounds(mdp, mdp.cost.argmin(-1), mdp.optimal_cost())
    assert found.loss_bound == pytest.approx(0.0, abs=1e-9)
    assert found.loss == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("lookahead", "truncation"), [(1, 0), (2, 0), (3, 0), (1, 2)])
def test_the_policy_is_that_of_the_library(lookahead, truncation):
    """Loss and rise of the library's rollout policy, its rollout cut by a terminal cost that misleads it."""
    model = random_model(8)
    mdp = belief_mdp(model, torch.eye(model.num_states)[0])
    weights = 20.0 * torch.randn(model.num_states, generator=torch.Generator().manual_seed(1)).double()
    y = mdp.states()

    def base(y):
        return y.set("action", torch.zeros(y.batch_size, dtype=torch.int64))

    def terminal(y):
        return y["belief"] @ weights

    cut = {"truncation": AfterSteps(truncation), "terminal_cost": terminal, "leaves": "observation"}
    policy = RolloutPolicy(model, base, trajectories=1 if truncation == 0 else 500, **cut)
    u = (policy if lookahead == 1 else MultistepLookahead(policy, lookahead))(y.clone())["action"]
    found = error_bounds(mdp, torch.zeros_like(u), terminal(y), lookahead=lookahead, truncation=truncation)
    cost = mdp.policy_cost(u)
    assert found.loss == pytest.approx(float((cost - mdp.optimal_cost()).abs().max()))
    assert found.rise == pytest.approx(float((cost - mdp.policy_cost(torch.zeros_like(u))).max()))
    assert found.loss > 0.1


def result(**changed):
    sides = {"loss": 1.0, "loss_bound": 2.0, "rise": -1.0, "rise_bound": 4.0, "sharp_rise_bound": 3.0, "rounding": 1e-8}
    return ErrorBounds(lookahead=1, truncation=0, **{**sides, **changed})


def test_what_does_not_hold_is_seen():
    assert result().hold
    assert not result(loss=2.1).hold
    assert not result(rise=3.5).hold
    assert not result(rise=5.0, sharp_rise_bound=9.0).hold
    assert result(loss=2.0 + 1e-9).hold


@pytest.mark.parametrize("discount", [1 - 1e-8, 1 - 1e-10])
def test_rounding_refutes_no_bound_near_a_discount_of_1(discount):
    moves = torch.rand(2, 4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    moves = moves / moves.sum(-1, keepdim=True)
    seen = torch.eye(4, dtype=torch.float64).expand(2, 4, 4)
    model = TabularModel(moves, seen, torch.ones(2, 4, dtype=torch.float64), discount, dtype=torch.float64)
    mdp = belief_mdp(model, torch.eye(4, dtype=torch.float64)[0])
    first = torch.zeros(len(mdp), dtype=torch.int64)
    assert error_bounds(mdp, first, mdp.policy_cost(first)).hold


def test_the_table_of_looseness():
    table = looseness([result(), result(loss=0.5), result(loss=0.0), result(rise=2.0)])
    assert table.splitlines()[2:] == [
        "| (a) | 1 | 3 | 4 | 2 | 2 |",
        "| (b) | 1 | 1 | 4 | 2 | 2 |",
        "| (b), sharper | 1 | 1 | 4 | 1.5 | 1.5 |",
    ]


def test_the_figure():
    pytest.importorskip("matplotlib")
    figure = bounds_figure([result(), result(rise=2.0)])
    assert [axes.get_title() for axes in figure.axes] == ["(a)", "(b)", "(b), sharper"]
    dots = figure.axes[1].lines[0]
    assert (dots.get_xdata().tolist(), dots.get_ydata().tolist()) == ([2.0], [4.0])


def test_a_figure_of_results_that_say_nothing():
    pytest.importorskip("matplotlib")
    figure = bounds_figure([result(loss=0.0)])
    assert all(len(axes.lines) == 1 for axes in figure.axes)


def test_the_command(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    assert main(["--models", "2", "--seed", "5", "--figure", str(tmp_path / "bounds.png")]) == 0
    assert "18 evaluations, 0 violations" in capsys.readouterr().out
    assert (tmp_path / "bounds.png").read_bytes()[:4] == b"\x89PNG"


def test_the_command_refuses_in_one_line(capsys):
    assert main(["--models", "0"]) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", "python -m torchrl_pomdp.bounds: models must be at least 1, got 0\n")


def test_the_beliefs_of_random_problems_are_hidden_states():
    sizes, hidden = [], 0
    for seed in range(20):
        model = random_model(seed)
        mdp = belief_mdp(model, torch.eye(model.num_states)[0])
        sizes.append(len(mdp))
        hidden += int(((mdp.belief > 0).sum(-1) > 1).sum())
    assert max(sizes) < 300
    assert hidden > sum(sizes) / 2


def test_random_problems_are_what_their_seed_says():
    first, again, other = random_model(3), random_model(3), random_model(4)
    assert torch.equal(first.transition, again.transition)
    assert first.transition.shape != other.transition.shape or not torch.equal(first.transition, other.transition)
    y = TensorDict({"belief": torch.eye(first.num_states, dtype=torch.float64)}, [first.num_states])
    assert bool(first.action_mask(y).any(-1).all())
