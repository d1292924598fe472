"""What online rollout gains where the model has changed: what has changed, and the numbers."""

from __future__ import annotations

import pytest
import torch

from torchrl_pomdp import changes, cli
from torchrl_pomdp.changes import Change, measure_changes, model_changes
from torchrl_pomdp.envs.repair import UniformStart, grid
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules.repair import OldPolicy, UrgencyRepair
from torchrl_pomdp.problems import repair_problem


@pytest.fixture
def wall(monkeypatch):
    """A wall across a small grid, as the only change."""
    chain, costs = torch.tensor([[1.0, 0.0], [0.0, 1.0]]), (0.0, 1.0)
    old, new = (
        repair_problem(graph, chain, costs, 0.9, start=lambda model: UniformStart(model, (0,)))
        for graph in (grid(4, 2), grid(4, 2).without_edge(1, 2))
    )
    change = Change(new, OldPolicy(UrgencyRepair(old.model), old.model, new.model))
    monkeypatch.setattr(changes, "model_changes", lambda: {"a wall": change})
    return change


def test_what_has_changed():
    found = model_changes()
    fast, blocked, two, ten = (change.policy for change in found.values())
    torch.testing.assert_close(fast.new.chain[1:4, 2:].diagonal(), 3 * fast.old.chain[1:4, 2:].diagonal())
    assert int((blocked.old.graph.neighbours >= 0).sum() - (blocked.new.graph.neighbours >= 0).sum()) == 4
    assert [(policy.old.num_robots, policy.new.num_robots) for policy in (two, ten)] == [(2, 1), (10, 9)]
    for change in found.values():
        y = change.problem.start(torch.arange(3))
        change.problem.model.check_controls(y, change.policy(y.clone())["action"])


def test_gains_are_paired_with_the_old_policy(wall):
    found = measure_changes(40, trajectories=5)["a wall"]
    assert list(found) == ["old policy", "rollout of it", "made anew"]
    model, start = wall.problem.model, wall.problem.start
    options = {"num_states": 40, "seed": 20200, "terminal_cost": wall.problem.pessimistic_cost}
    costs = [discounted_costs(model, p, start, **options) for p in (UrgencyRepair(model), wall.policy)]
    assert found["made anew"] == compare(*costs)
    assert found["old policy"].ratio.mean == 1.0
    assert found["rollout of it"].ratio.mean < 1.0


def test_the_command_writes_a_table(wall, tmp_path, capsys):
    assert cli.main(["changes", "--states", "4", "--trajectories", "2", "--out", str(tmp_path)]) == 0
    text = (tmp_path / "changes" / "model-changes.md").read_text()
    assert text.startswith("a wall, 4 start states, 2 trajectories of each control, ratios to the old policy")
    assert "| rollout of it |" in text
    assert text.strip() in capsys.readouterr().out
    assert cli.main(["changes", "--states", "4", "--trajectories", "2", "--out", str(tmp_path)]) == 0
    for more in (["--states", "4", "--trajectories", "3"], ["--states", "5", "--trajectories", "2"]):
        assert cli.main(["changes", *more, "--out", str(tmp_path)]) == 2
        assert "holds another measurement, not of" in capsys.readouterr().err
    assert (tmp_path / "changes" / "model-changes.md").read_text() == text
    assert cli.main(["changes", "--states", "1", "--out", str(tmp_path / "other")]) == 2
    assert "states must be at least 2, got 1" in capsys.readouterr().err
