"""The page about a training run, without a browser: what is in it, and what is refused."""

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import replace
from html import unescape

import pytest
import torch
from _runs import small_run

from torchrl_pomdp.cli import main
from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.envs import FixedBelief, TabularModel
from torchrl_pomdp.evaluation import Estimate
from torchrl_pomdp.files import DamagedFileError, write_json
from torchrl_pomdp.modules import PartitionedValue
from torchrl_pomdp.noise import seed_keys
from torchrl_pomdp.problems import Problem, make_problem
from torchrl_pomdp.report import page, player
from torchrl_pomdp.report.disagreements import disagreements
from torchrl_pomdp.report.iteration_chart import iteration_chart
from torchrl_pomdp.report.page import write_report
from torchrl_pomdp.report.run_folder import read_run_folder
from torchrl_pomdp.trainers import Checkpoint, save_checkpoint
from torchrl_pomdp.trajectories import play

TITLES = ["Cost per iteration", "Policies", "Parts", "Where the policies disagree", "Trajectories"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return small_run(tmp_path_factory.mktemp("runs") / "line3", algorithm="pAPI-T")


@pytest.fixture
def copied(run, tmp_path):
    return shutil.copytree(run, tmp_path / "run")


def data_of(text):
    return json.loads(re.search(r'id="player-data">(.*?)</script>', text)[1])


def test_the_page_holds_what_the_run_found(copied):
    before = set(copied.rglob("*"))
    assert write_report(copied) == copied / "report.html"
    assert set(copied.rglob("*")) - before == {copied / "report.html"}
    text = (copied / "report.html").read_text()
    assert re.findall("<h2>(.*?)</h2>", text) == TITLES
    assert "line of 3, 1 robot: 3.8e+02 states" in text
    metrics = json.loads((copied / "metrics.json").read_text())
    for name, entry in metrics.items():
        assert re.search(rf'<td class="text">{name}</td><td>{entry["cost"]["mean"]:.1f} ± ', text)
    for iteration in json.loads((copied / "iterations.json").read_text()):
        assert iteration["reason"] in unescape(text)
        for key, record in iteration["parts"].items():
            losses = record["losses"]
            shown = f"{losses['accuracy']:.1%}" if "improve" in key else f"{losses['relative_error']:.1%}"
            assert f"<td>{shown}</td>" in text
    assert text.count("<circle") == 3, "the base policy and two iterations"
    accepted = [each["number"] for each in json.loads((copied / "iterations.json").read_text()) if each["accepted"]]
    best = [f"pAPI-T {accepted[-1]}"] if accepted else []
    assert re.findall(r'class="best"><td class="text">(.*?)</td>', text) == best
    outside = re.findall(r"(?:src|href)=\"(?!#|data:)[^\"]*", text) + re.findall(r"https?://(?!www\.w3\.org/2000/svg)\S*", text)
    assert outside == [], "nothing is loaded from elsewhere"


def test_the_player_has_what_the_policies_play(copied):
    write_report(copied)
    found = read_run_folder(copied, None)
    data = data_of((copied / "report.html").read_text())
    assert data["policies"] == ["greedy", found.policy.name]
    assert data["scene"]["edges"] == [[0, 1], [1, 2]]
    problem = found.policy.problem
    y, keys = player.starts(problem, 3)
    for i, start in enumerate(data["starts"]):
        assert start[0][0]["truth"] == start[1][0]["truth"], "the same hidden state"
        for frames, policy in zip(start, found.policies.values(), strict=True):
            played = play(problem.model, policy, y[i], keys[i], max_steps=100)
            assert len(frames) == len(played) + 1
            costs = (played["cost"] * problem.model.discount ** torch.arange(len(played))).cumsum(0)
            assert [frame["cost"] for frame in frames] == pytest.approx([0.0, *costs.tolist()], rel=1e-3)
            assert [frame["robots"] for frame in frames[:-1]] == played["location"].tolist()
            assert [frame["truth"] for frame in frames[1:]] == played["next", "hidden", "level"].tolist()
            damage = played["belief"] @ torch.arange(5.0)
            assert torch.allclose(torch.tensor([frame["damage"] for frame in frames[:-1]]), damage, atol=1e-3)
            assert frames[-1]["does"] == "the end"
            for frame, u in zip(frames[:-1], played["action"].tolist(), strict=True):
                (chosen,) = [name for name, _, is_chosen in frame["q"] if is_chosen]
                assert chosen == problem.model.graph.control_names[u]


def test_an_unfinished_run_has_a_page_of_what_is_there(copied):
    for name in ("iterations.json", "metrics.json", "best.pt"):
        (copied / name).unlink()
        text = write_report(copied).read_text()
        assert re.findall("<h2>(.*?)</h2>", text) == TITLES
    for missing in ("No iteration is finished yet.", "No policy is evaluated yet.", "The run has not kept a policy yet."):
        assert missing in text
    assert "player-data" not in text


def test_where_no_iteration_was_accepted_the_last_one_is_shown(copied):
    untrained = read_run_folder(copied, None).policy
    shutil.copy(copied / "iteration-2.pt", copied / "best.pt")
    assert list(read_run_folder(copied, None).policies) == ["greedy", "pAPI-T 2"]
    iterations = json.loads((copied / "iterations.json").read_text())
    refused = [{**iteration, "accepted": False} for iteration in iterations]
    (copied / "iterations.json").write_text(json.dumps(refused))
    greedy = replace(untrained, iteration=0, policy=untrained.problem.base_policies["greedy"])
    save_checkpoint(copied / "best.pt", greedy)
    assert list(read_run_folder(copied, None).policies) == ["greedy", "pAPI-T 2"]
    text = write_report(copied).read_text()
    assert "No iteration was accepted, so the base policy is the best one; what is played below is pAPI-T 2." in text
    assert 'class="best"' not in text
    assert text.count('<circle class="hollow"') == 2
    for path in copied.glob("iteration-*.pt"):
        path.unlink()
    assert list(read_run_folder(copied, None).policies) == ["greedy"]
    text = write_report(copied).read_text()
    assert "No policy is trained yet." in text
    assert data_of(text)["policies"] == ["greedy"]


def test_damage_is_named(copied, tmp_path):
    with pytest.raises(ValueError, match=r"folder must be that of a training run, .* holds no config\.json"):
        write_report(tmp_path)
    wrong = {
        "config.json": ["{", "[]", '{"problem": "line3"}', '{"problem":"x","algorithm":"API","base":"none","config":{}}'],
        "metrics.json": ["nonsense", "[]", '{"greedy": 3}', '{"greedy": {"cost": {"mean": "<b>"}}}'],
        "iterations.json": ["{}", "[3]", '[{"parts": {"a": {}}}]', "\x00"],
    }
    for name, contents in wrong.items():
        whole = (copied / name).read_bytes()
        for content in contents:
            (copied / name).write_text(content)
            with pytest.raises(DamagedFileError, match=rf"{re.escape(name)} is damaged"):
                write_report(copied)
            assert not (copied / "report.html").exists()
        (copied / name).write_bytes(whole)
    (copied / "best.pt").write_bytes((copied / "best.pt").read_bytes()[:-9])
    text = write_report(copied).read_text()
    assert "No policy can be read" in text
    assert "best.pt is damaged" in text
    assert "<circle" in text, "what is there is shown"


def own_problem(name="machine", parts=None):
    tables = torch.tensor([[[0.9, 0.1], [0.0, 1.0]], [[1.0, 0.0], [1.0, 0.0]]]), torch.full((2, 2, 1), 1.0)
    controls = {"control_names": ("</script><b>run</b>", "replace & go")}
    model = TabularModel(*tables, torch.tensor([[0.0, 5.0], [2.0, 5.0]]), 0.5, **controls)
    return Problem(model, FixedBelief(torch.tensor([1.0, 0.0])), name=name)


def test_a_problem_of_ones_own_code_is_given(tmp_path):
    problem = own_problem()
    folder = small_run(tmp_path / "run", problem)
    text = write_report(folder, problem=problem).read_text()
    assert data_of(text)["scene"] == {"kind": "bars", "bars": ["belief 0", "belief 1"], "more": 0}
    with pytest.raises(ValueError, match="problem must be machine"):
        write_report(folder, problem=make_problem("tiger"))
    with pytest.raises(ValueError, match="build it and give it as problem="):
        write_report(folder)
    assert (folder / "report.html").read_text() == text, "a page that lacks its policies would be in its place"


def test_texts_from_files_are_escaped(tmp_path):
    problem = own_problem()
    folder = small_run(tmp_path / "run", problem)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "problem": "</title></script><script>alert(1)</script>"}))
    text = write_report(folder, problem=problem).read_text()
    assert len(re.findall(r"<script", text)) == 2
    assert len(re.findall(r"</script", text)) == 2
    assert "&lt;script&gt;alert(1)" in text
    assert "<b>run" not in text
    assert data_of(text)["starts"][0][0][0]["does"] in problem.model.control_names


@pytest.mark.parametrize("name", ["tiger", "rocksample7x8", "maintenance1", "two_robots20"])
def test_any_problem_can_be_played(name):
    problem = make_problem(name)
    base = problem.base_policies[problem.baseline]
    data = player.player_data(problem, player.side_by_side(problem, {problem.baseline: base}, 1, 3))
    frames = data["starts"][0][0]
    assert len(frames) == 4
    many = problem.model.num_controls > 32
    assert all(bool(frame["q"]) == (not many) for frame in frames[:-1])
    assert (player.lookahead(problem, base) is None) == many
    if name == "two_robots20":
        assert len(frames[0]["robots"]) == len(frames[0]["to"]) == 2
    else:
        assert len(data["scene"]["bars"]) == len(frames[0]["bars"]) > 1
        assert frames[0]["truth"]
        assert all(0 <= bar <= 1 for bar in frames[0]["bars"])
    assert bool(frames[0].get("text")) == (name in ("rocksample7x8", "maintenance1"))


def test_a_large_player_is_cut_and_says_so(monkeypatch, line3):
    trajectories = player.side_by_side(line3, {"greedy": line3.base_policies["greedy"]}, 2, 50)
    whole = player.player_data(line3, trajectories)
    assert whole["cut"] is None
    longest = max(len(frames) for start in whole["starts"] for frames in start)
    monkeypatch.setattr(player, "_MOST_BYTES", len(json.dumps(whole)) // 2)
    cut = player.player_data(line3, trajectories)
    assert 2 <= cut["cut"] < longest
    assert max(len(frames) for start in cut["starts"] for frames in start) == cut["cut"]
    assert f"Only the first {cut['cut']} stages are shown" in page._player(line3, cut)


def test_disagreements_are_counted_at_the_visited_states(linear20):
    keys = seed_keys(3, torch.arange(30))
    y, bases = linear20.start(keys), linear20.base_policies
    found = disagreements(linear20, bases["greedy"], bases["urgency"], y, keys, max_steps=10)
    played = play(linear20.model, bases["urgency"], y, keys, max_steps=10)
    greedy = bases["greedy"](played.select("belief", "location", "action_mask").reshape(-1))["action"]
    differ = greedy != played["action"].reshape(-1)
    assert sum(decisions for decisions, _ in found.parts.values()) == 300
    assert sum(differing for _, differing in found.parts.values()) == int(differ.sum()) > 0
    assert sum(count for *_, count in found.pairs) == int(differ.sum())
    counts = [count for *_, count in found.pairs]
    assert counts == sorted(counts, reverse=True)
    one, other, count = found.pairs[0]
    names = linear20.model.graph.control_names
    both = (greedy == names.index(one)) & (played["action"].reshape(-1) == names.index(other))
    assert int(both.sum()) == count


@pytest.mark.parametrize(
    ("costs", "ticks"),
    [
        ((1_234_560.0, 1_234_566.0), [f"123456{last}" for last in range(7)]),
        ((1e-12, 3e-12), ["1e-12", "1.5e-12", "2e-12", "2.5e-12", "3e-12"]),
        ((10_000.0, 70_000.0), [f"{first}0000" for first in range(1, 8)]),
        ((0.0, 1.0), ["0", "0.2", "0.4", "0.6", "0.8", "1"]),
    ],
)
def test_ticks_tell_costs_apart(costs, ticks):
    chart = iteration_chart([(name, Estimate(cost, 0.0, 9)) for name, cost in zip(("greedy", "API 1"), costs, strict=True)], {})
    assert re.findall(r'text-anchor="end">(.*?)<', chart) == ticks


def test_the_chart_has_intervals_and_hollow_circles():
    costs = [("greedy", Estimate(10.0, 0.5, 9)), ("API 1", Estimate(8.0, float("nan"), 1)), ("API 2", Estimate(-3.0, 1.0, 9))]
    chart = iteration_chart(costs, {"API 2": "cost <higher>"})
    heights = [float(y) for y in re.findall(r'cy="([\d.]+)"', chart)]
    assert heights == sorted(heights), "lower costs are lower"
    assert re.findall('<circle( class="hollow")?', chart) == ["", "", ' class="hollow"']
    assert "API 2: -3.0 ± 2.0, not accepted: cost &lt;higher&gt;" in chart
    scale = (heights[2] - heights[0]) / 13
    top, bottom = map(float, re.search(r'd="M[\d.]+ ([\d.]+)V([\d.]+)', chart).groups())
    assert (bottom - top) / scale == pytest.approx(2 * 1.96 * 0.5, rel=0.05)


def test_the_command_writes_the_page_and_an_animation(copied, tmp_path, capsys):
    assert main(["report", str(copied), "--animation", str(tmp_path / "a.gif"), "--stages", "2"]) == 0
    assert capsys.readouterr().out.splitlines() == [f"report: {copied / 'report.html'}", f"animation: {tmp_path / 'a.gif'}"]
    assert (tmp_path / "a.gif").read_bytes().startswith(b"GIF89a")


def begun_run(folder, name):
    """A run that has kept its base policy and no more."""
    problem, config = make_problem(name), PolicyIterationConfig()
    value = PartitionedValue([problem.pessimistic_cost] * problem.partition.num_parts)
    base = problem.base_policies[problem.baseline]
    save_checkpoint(folder / "best.pt", Checkpoint(problem, config, "API", 0, base, value))
    write_json(folder / "config.json", {"problem": name, "algorithm": "API", "base": problem.baseline, "config": {}})
    return folder


def test_the_command_refuses_what_it_cannot_do(copied, tmp_path, capsys):
    tiger = begun_run(tmp_path / "tiger", "tiger")
    for arguments, message in {
        (str(tmp_path),): "folder must be that of a training run",
        (str(copied), "--animation", "a.png"): "animation must end in .gif or .mp4, got 'a.png'",
        (str(copied), "--animation", "a.gif", "--stages", "0"): "stages must be at least 1, got 0",
        (str(tiger), "--animation", "a.gif"): "animation is of repair problems, got tiger",
        (str(copied), "--problem", "nosuch"): "got 'nosuch'",
    }.items():
        assert main(["report", *arguments]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert message in line
    assert not list(tmp_path.rglob("report.html"))


def test_costs_that_differ_by_rounding_are_drawn():
    costs = [("greedy", Estimate(19.3, 0.0, 9)), ("API 1", Estimate(math.nextafter(19.3, 20.0), 0.0, 9))]
    assert iteration_chart(costs, {}).count("<circle") == 2
