"""The experiments at toy size: what they plan, write and resume, and the published numbers beside ours."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from dataclasses import replace

import pytest
import torch
from tqdm import tqdm

from torchrl_pomdp import provenance as provenance_module
from torchrl_pomdp import reproduce as module
from torchrl_pomdp.evaluation import Comparison, Estimate, compare
from torchrl_pomdp.provenance import provenance
from torchrl_pomdp.report import (
    Result,
    cost_figure,
    draw,
    effort,
    interval_text,
    is_iteration,
    iteration_figure,
    paired_ratios,
    paired_table,
    table,
)
from torchrl_pomdp.reproduce import EXPERIMENTS, OPTIMA, Experiment, comparison_table, plan, reproduce, settings_config

TOY = Experiment("toy", ("line3",), ("pAPI-NT", "pAPI-T"))


def test_the_papers_settings_are_the_papers():
    config = settings_config("paper", "linear20", 1.0, seed=0)
    assert (config.samples_per_part, config.trajectories, config.hidden) == (200_000, 10, (256, 64))
    assert (config.value_hidden, config.loss, config.encoder) == ((256, 128, 64), "l2", "flat")
    assert (config.learning_rate, config.visited_share, config.symmetries, config.iterations) == (1e-3, 0.5, False, 2)
    assert settings_config("paper", "grid6x6", 1.0, seed=0).samples_per_part == 500_000
    runs = plan(EXPERIMENTS["architectures"], "paper", "greedy", 1.0, 0)
    assert {run.algorithm: run.config.samples_per_part for run in runs.values()} == {
        "API": 1_200_000, "pAPI-NT": 200_000, "pAPI-T": 200_000,
    }  # fmt: skip


def test_all_policies_of_a_run_are_evaluated_on_the_experiments_states():
    for name, states in (("optimum", 100_000), ("table1", 1000)):
        for run in plan(EXPERIMENTS[name], "tuned", "greedy", 0.05, 0).values():
            assert run.states == run.rollout_states == run.online_states == states


def test_published_numbers_stand_beside_ours():
    cost = torch.tensor([5000.0, 6000.0])
    found = {"greedy": compare(cost, cost), "pAPI-NT 2": compare(0.9 * cost, cost)}
    text = comparison_table({"run": ("grid5x4", found)})
    assert text.splitlines()[-1].endswith("| 0.900 | 0.900 … 0.900 | 4952.26 | 0.904 |")


def test_a_known_optimum_stands_beside_the_costs():
    cost = torch.full((4,), 1.02 * OPTIMA["line3"])
    text = comparison_table({"run": ("line3", {"greedy": compare(cost, cost)})})
    assert text.splitlines()[0].endswith(" over the optimum |")
    assert text.splitlines()[-1].endswith("| 2.00 % ± 0.00 |")


def test_an_experiment_writes_its_results_and_goes_on(tmp_path, monkeypatch):
    bars = []

    class Bar(tqdm):
        def __exit__(self, *exc):
            bars.append(None if self.disable else (self.total, self.n, self.initial))
            super().__exit__(*exc)

    monkeypatch.setattr(
        module, "progress_bar", lambda total, unit, desc, show, **options: Bar(total=total, unit=unit, disable=not show)
    )

    def tiny(settings, problem, scale, seed):
        small = {
            "samples_per_part": 40,
            "value_samples": 40,
            "trajectories": 2,
            "epochs": 1,
            "least_steps": 1,
            "visits_per_label": 0.1,
            "max_steps": 60,
            "hidden": (8, 4),
            "value_hidden": (8,),
        }
        return replace(settings_config(settings, problem, scale, seed), iterations=1, validation_states=20, **small)

    original = plan
    monkeypatch.setattr(module, "settings_config", tiny)
    monkeypatch.setattr(
        module, "plan", lambda *args: {k: replace(r, states=10, online_states=5) for k, r in original(*args).items()}
    )
    folders = {"runs": tmp_path / "runs", "out": tmp_path / "results"}
    told = []
    text = reproduce(TOY, scale=0.001, progress=True, tell=told.append, **folders)
    assert told[0] == text
    assert told[1].startswith("pictures: ")
    stem = "toy-tuned-greedy-scale0.001-seed0"
    content = json.loads((tmp_path / "results" / "toy" / f"{stem}.json").read_text())
    assert content["provenance"] == {name: [provenance()] for name in content["runs"]}
    assert provenance()["versions"]["torch"] == torch.__version__
    assert {run["algorithm"] for run in content["runs"].values()} == {"pAPI-NT", "pAPI-T"}
    for name, found in content["results"].items():
        assert {"greedy", "urgency"} <= set(found)
        assert len(content["iterations"][name]) == 1
    assert (tmp_path / "results" / "toy" / f"{stem}.md").read_text().strip() == text
    pictures = {path.name.removeprefix(stem) for path in (tmp_path / "results" / "toy").glob("*.png")}
    assert pictures == {"-iterations.png", "-time.png", "-line3-pAPI-NT.png", "-line3-pAPI-T.png"}
    before = (tmp_path / "results" / "toy" / f"{stem}.json").read_bytes()
    assert reproduce(TOY, scale=0.001, progress=True, **folders) == text
    assert (tmp_path / "results" / "toy" / f"{stem}.json").read_bytes() == before
    reproduce(TOY, scale=0.001, **folders)
    labels = 40 * (6 + 9)
    # Labels of an earlier run say nothing about the time that is left.
    assert bars == [(labels, labels, 0), (labels, labels, labels), None]


def test_a_ratio_that_means_nothing_is_a_dash(tmp_path):
    cost = torch.tensor([-1.0, 1.0])
    found = replace(compare(cost + 5, cost + 5), ratio=None)
    dash = ["–", "–"]
    for text in (table([Result("greedy", found)]), comparison_table({"a": ("grid5x4", {"greedy": found})})):
        assert [cell.strip() for cell in text.splitlines()[-1].split("|")].count("–") == len(dash)
    assert paired_table("line3", {"API 1": {"R-NT of greedy": None}}).splitlines()[-1] == "| API 1 | – |"
    labels = cost_figure([Result("a", found)]).axes[0].get_xticklabels()
    assert [label.get_text().split("\n")[-1] for label in labels] == ["+0"]  # the difference, where there is no ratio
    figures = {tmp_path / "lines.png": lambda: iteration_figure({"a": [found, compare(cost + 5, cost + 5)]})}
    assert draw(figures) == f"pictures: {tmp_path / 'lines.png'}"


def test_runs_of_several_robots_have_paired_ratios():
    """To all online rollouts of the base policy: costs are multiples of the first one's, and so are their ratios."""
    factors = {
        "greedy": 2.0, "rule 2": 1.5, "one-at-a-time of greedy": 1.0, "order-optimised of greedy": 0.9, "R-NT of greedy": 0.8,
        "API 1": 0.75, "API 2": 0.6, "API 2 + one-at-a-time": 0.5,
    }  # fmt: skip
    cost = torch.tensor([10.0, 20.0, 60.0])
    ratios = paired_ratios({name: factor * cost for name, factor in factors.items()})
    online = ["one-at-a-time of greedy", "order-optimised of greedy", "R-NT of greedy"]
    assert list(ratios) == [*online[1:], "API 1", "API 2", "API 2 + one-at-a-time"]
    for name, row in ratios.items():
        assert list(row) == [other for other in (*online, "API 1", "API 2") if other != name]
        for other, ratio in row.items():
            assert ratio.mean == pytest.approx(factors[name] / factors[other])
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in paired_table("network", ratios).splitlines()]
    assert rows[0] == ["network: ratio to", online[0], online[2], online[1], "API 2"]
    assert rows[-1][0] == "API 2 + one-at-a-time"
    assert [cell.split()[0] for cell in rows[-1][1:]] == ["0.5000", "0.6250", "0.5556", "0.8333"]


def effort_record(samples, steps, seconds):
    return {"samples": samples, "simulated_steps": steps, "label_seconds": seconds, "train_seconds": 0.0}


def test_the_effort_of_parts_at_their_own_pace():
    """Their records come part by part, the startgame's first; a part waits for none that is as far as it must be."""
    start, end = ["iteration-{}/2-improve-part-0", "iteration-{}/1-improve-part-1"]
    seconds = {0: (1.0, 1.0, 5.0), 1: (2.0, 6.0, 1.0)}
    parts = {start.format(number): effort_record(10, 1000 * number, seconds[0][number - 1]) for number in (1, 2, 3)}
    parts |= {end.format(number): effort_record(20, 60, seconds[1][number - 1]) for number in (1, 2, 3)}
    expected = {
        # Beginnings and ends of the versions of part 0: 0-1, 2-3, 8-13; of part 1: 0-2, 2-8, 8-9.
        0: 13.0,
        # Part 0: 0-1, 1-2, 2-7; part 1: 0-2, 2-8, 8-9.
        1: 9.0,
        5: 9.0,
        # Where they wait after every step: 2 + 1 + 6 + 1 + 1 + 5.
        None: 16.0,
    }
    for staleness, taken in expected.items():
        found = effort([{"parts": parts, "staleness": staleness}])
        assert found.steps_per_label == (1000 + 2000 + 3000) / 30
        assert found.parallel_seconds == taken
        assert (found.labels, found.label_seconds) == (90, 16.0)


@pytest.mark.parametrize(
    ("mean", "half", "text"),
    [
        (193.9, 0.47, "193.90 ± 0.47"), (7.25, 7.4, "7.2 ± 7.4"), (6962.4, 89.0, "6962.4 ± 89.0"), (0.0, 0.0, "0.00 ± 0.00"),
        (0.00431, 0.000196, "0.00431 ± 0.00020"), (-0.0371, 0.006, "-0.0371 ± 0.0060"), (0.00431, 0.0, "0.00431 ± 0.00000"),
        (1e-12, 2e-14, "0.000000000001000 ± 0.000000000000020"), (5.0, math.nan, "5.0 ± nan"),
    ],
)  # fmt: skip
def test_digits_follow_the_interval(mean, half, text):
    assert interval_text(Estimate(mean, half / 1.96, 100)) == text


def test_digits_of_a_difference_are_its_own():
    """Paired differences may be far smaller than costs vary; of equal policies they are those of the cost."""
    cost = Estimate(15.0, 5.0, 100)
    lines = [
        table([Result("a", Comparison(cost, Estimate(mean, half / 1.96, 100), None))]).splitlines()[-1].split("|")[3].strip()
        for mean, half in ((-0.0371, 0.006), (0.0, 0.0), (-375.5, 39.8), (0.5, 0.35))
    ]
    assert lines == ["-0.0371 ± 0.0060", "+0.0 ± 0.0", "-375.5 ± 39.8", "+0.50 ± 0.35"]


@pytest.mark.parametrize("name", ["rule 2", "pAPI 2", "API two", "my API 2", "API 2 + one-at-a-time", "R-NT of API 2"])
def test_only_what_an_iteration_has_trained_is_one(name):
    assert not is_iteration(name)
    assert is_iteration("API 12")


def test_the_commit_is_that_of_this_librarys_checkout(tmp_path, monkeypatch):
    """And none where the library lies in the folder of another checkout, or git is not there."""
    git = shutil.which("git")
    if git is None:
        pytest.skip("git is not there")
    package = tmp_path / "checkout" / "package"
    package.mkdir(parents=True)
    file = package / "provenance.py"
    file.write_text("")
    monkeypatch.setattr(provenance_module, "__file__", str(file))

    def run(*arguments):
        settings = ["-c", "user.name=a", "-c", "user.email=a@b"]
        done = subprocess.run(
            [git, "-C", str(package.parent), *settings, *arguments], capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    assert provenance()["commit"] is None
    run("init")
    assert provenance()["commit"] is None
    run("add", ".")
    run("commit", "-m", "first", "--no-gpg-sign")
    commit = run("rev-parse", "HEAD")
    assert provenance()["commit"] == commit
    (package / "untracked").write_text("")
    monkeypatch.setenv("GIT_DIR", "/nowhere")
    assert provenance()["commit"] == commit
    file.write_text("changed")
    assert provenance()["commit"] == f"{commit}-dirty"
    monkeypatch.setenv("PATH", "")
    assert provenance()["commit"] is None


def test_only_the_experiments_own_problems_can_be_chosen():
    assert list(plan(EXPERIMENTS["table1"], "tuned", "greedy", 0.1, 3, ("grid6x6",))) == [
        "grid6x6-pAPI-NT-tuned-greedy-scale0.1-seed3"
    ]
    with pytest.raises(ValueError, match="problems must be among"):
        plan(EXPERIMENTS["table1"], "tuned", "greedy", 0.1, 0, ("linear20",))


def test_many_robots_are_taught_one_after_the_other():
    runs = plan(EXPERIMENTS["multirobot"], "tuned", "greedy", 0.01, 0)
    assert [run.problem.model.num_robots for run in runs.values()] == [4, 8, 10]
    for run, steps in zip(runs.values(), (25, 5, 5), strict=True):
        assert run.config.multiagent
        assert (run.algorithm, run.config.label_steps) == ("API", steps)
    published = settings_config("paper", "network32x8", 0.01, 0)
    assert (published.label_steps, published.iterations, published.trajectories) == (10, 4, 10)


def test_extensions_are_run_like_the_papers_problems():
    runs = plan(EXPERIMENTS["extensions"], "tuned", "urgency", 0.01, 0)
    assert [run.problem.name for run in runs.values()] == list(EXPERIMENTS["extensions"].problems)
    assert all((run.algorithm, run.base, run.config.multiagent) == ("pAPI-NT", "urgency", False) for run in runs.values())


def test_a_folder_in_use_is_refused_before_anything_is_computed(tmp_path):
    *_, last = plan(TOY, "tuned", "greedy", 0.001, 0)
    (tmp_path / "runs" / last).mkdir(parents=True)
    (tmp_path / "runs" / last / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match=f"run folder .*{last} holds other files"):
        reproduce(TOY, scale=0.001, runs=tmp_path / "runs", out=tmp_path / "results")
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["mine.txt"]


def test_bars_of_fewer_start_states_say_so():
    pytest.importorskip("matplotlib")
    cost = torch.tensor([1.0, 2.0, 300.0])
    results = [Result("greedy", compare(cost, cost)), Result("R-NT", compare(1.5 * cost[:2], cost[:2]))]
    axes = cost_figure(results).axes[0]
    names = [text.get_text() for text in axes.get_xticklabels()]
    assert names == ["greedy\n1.000", "R-NT\n1.500\nfrom 2 states"]
    assert [bar.get_hatch() for bar in axes.patches] == [None, "//"]
