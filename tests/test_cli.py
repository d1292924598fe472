from __future__ import annotations

import json
import signal
import subprocess
import sys
import time

import pytest
import torch

from torchrl_pomdp.cli import main
from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.evaluation import compare, discounted_costs, estimate
from torchrl_pomdp.files import write_atomically
from torchrl_pomdp.modules import GreedyRepair
from torchrl_pomdp.report import trajectory_figure
from torchrl_pomdp.trainers.checkpoint import load_checkpoint

TINY = (
    "--iterations 1 --samples-per-part 60 --trajectories 2 --epochs 1 --least-steps 1 --batch-size 30 --max-steps 60 "
    "--states 20 --validation-states 30 --visits-per-label 0.2 --value-samples 50"
)


def snapshot(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("algorithm", ["pAPI-NT", "pAPI-T", "API"])
def test_train_evaluate_and_resume(tmp_path, capsys, algorithm):
    out = tmp_path / "run"
    command = ["train", "line3", "--algorithm", algorithm, *TINY.split(), "--online-states", "10", "--out", str(out)]
    assert main(command) == 0
    text = capsys.readouterr().out
    assert "line of 3, 1 robot: 3.8e+02 states" in text
    assert f"| {algorithm} 1 |" in text
    config = json.loads((out / "config.json").read_text())
    assert (config["problem"], config["config"]["samples_per_part"]) == ("line3", 60)
    metrics = json.loads((out / "metrics.json").read_text())
    truncated = ["R-T of greedy"] if algorithm == "pAPI-T" else []
    online = [] if not (out / "best.pt").is_file() else [f"{algorithm} 1 + R-NT"]
    assert list(metrics)[:-1] == ["greedy", "urgency", "R-NT of greedy", *truncated, f"{algorithm} 1"]
    assert list(metrics)[-1:] == (online or ["greedy + R-NT"])
    assert metrics["greedy"]["ratio"]["mean"] == 1.0
    (iteration,) = json.loads((out / "iterations.json").read_text())
    assert iteration["accepted"] in (True, False)
    assert "validation states" in iteration["reason"]
    for name in ("costs.png", "trajectory.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    assert not [path for path in out.iterdir() if path.name.startswith(".")]
    assert main(["evaluate", str(out / "iteration-1.pt"), "--states", "20"]) == 0
    expected = metrics[f"{algorithm} 1"]["ratio"]["mean"]
    assert f"| {expected:.3f} |" in capsys.readouterr().out, "a checkpoint evaluates to what the run reported"
    tensors = {path: content for path, content in snapshot(out).items() if path.suffix in (".pt", ".json")}
    assert main(command) == 0
    assert {path: content for path, content in snapshot(out).items() if path.suffix in (".pt", ".json")} == tensors


def test_a_run_that_is_killed_by_the_system_goes_on(tmp_path, capsys):
    """SIGKILL as soon as a trained step, or a block of labels, is there; then the same command, once more."""
    arguments = ["train", "line3", "--algorithm", "pAPI-T", *TINY.split(), "--iterations", "2", "--out"]
    assert main([*arguments, str(tmp_path / "whole")]) == 0
    broken = tmp_path / "broken"
    for sign in ("iteration-1/*.pt", "iteration-2/*.labels/*/*.pt"):
        process = subprocess.Popen(
            [sys.executable, "-m", "torchrl_pomdp.cli", *arguments, str(broken)], stderr=subprocess.DEVNULL
        )
        deadline = time.monotonic() + 120
        while process.poll() is None and not list(broken.glob(sign)) and time.monotonic() < deadline:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL, "it was killed before it had finished"
    assert main([*arguments, str(broken)]) == 0
    capsys.readouterr()
    for name in ("iteration-1.pt", "iteration-2.pt"):
        one, other = (load_checkpoint(tmp_path / folder / name) for folder in ("whole", "broken"))
        for mine, theirs in zip(
            [*one.policy.parameters(), *one.value.parameters()],
            [*other.policy.parameters(), *other.value.parameters()],
            strict=True,
        ):
            assert torch.equal(mine, theirs)
    metrics = [json.loads((tmp_path / folder / "metrics.json").read_text()) for folder in ("whole", "broken")]
    assert metrics[0] == metrics[1]


def test_a_run_folder_of_another_run_is_left_alone(tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["train", "line3", *TINY.split(), "--out", str(out)]) == 0
    before = snapshot(out)
    assert main(["train", "line3", "--out", str(out)]) == 2
    assert "holds another run, which differs in config, states" in capsys.readouterr().err
    assert snapshot(out) == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("precious")
    assert main(["train", "line3", "--out", str(tmp_path / "mine")]) == 2
    assert "is in use" in capsys.readouterr().err


@pytest.mark.parametrize("policy", ["greedy", "urgency"])
def test_evaluate_by_name_and_online(policy, capsys):
    assert main(["evaluate", policy, "--problem", "line3", "--states", "10", "--online"]) == 0
    text = capsys.readouterr().out
    for name in ("greedy", "urgency", f"{policy} + R-NT"):
        assert f"| {name} |" in text


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["train", "linear21"], "unknown preset 'linear21'; known presets: grid5x4"),
        (["evaluate", "nowhere.pt"], "there is no checkpoint nowhere.pt"),
        (["evaluate", "greedy", "--states", "0"], "num_states must be at least 1"),
        (["reproduce", "table1", "--scale", "0"], "scale must be positive, got 0"),
        (["reproduce", "ablation", "--problems", "grid5x4"], "problems must be among ('linear20',) for ablation"),
    ],
)
def test_bad_input_is_one_line_and_status_2(args, message, capsys):
    assert main(args) == 2
    assert message in capsys.readouterr().err


def test_estimates_by_hand():
    values = torch.tensor([1.0, 2.0, 3.0, 6.0])
    assert estimate(values).mean == 3.0
    assert estimate(values).standard_error == pytest.approx((14 / 3) ** 0.5 / 2)
    comparison = compare(torch.tensor([8.0, 12.0]), torch.tensor([10.0, 10.0]))
    assert comparison.difference.mean == 0.0
    assert comparison.ratio.mean == 1.0
    assert comparison.ratio.standard_error == pytest.approx(0.2)
    with pytest.raises(ValueError, match="paired"):
        compare(torch.ones(2), torch.ones(3))


def test_evaluation_is_paired_by_state(linear20):
    greedy = GreedyRepair(linear20.model)
    few = discounted_costs(linear20.model, greedy, linear20.start, num_states=10)
    many = discounted_costs(linear20.model, greedy, linear20.start, num_states=300)
    assert torch.equal(few, many[:10])


def test_trajectory_picture_has_every_stage_and_repair(linear20):
    env = BeliefEnv(linear20.model, linear20.start)
    trajectory = env.rollout(30, GreedyRepair(linear20.model))
    figure = trajectory_figure(linear20.model, trajectory)
    axes = figure.axes[0]
    assert axes.images[0].get_array().shape == (20, 30)
    assert len(axes.collections[0].get_offsets()) == int((trajectory["action"] == 0).sum())
    assert axes.lines[0].get_ydata().tolist() == trajectory["location"][:, 0].tolist()


def test_failed_writes_leave_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail(temporary):
        temporary.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, fail)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
