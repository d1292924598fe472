from __future__ import annotations

import ast
import inspect
import io
import json
import os
import signal
import subprocess
import sys
import time

import pytest
import torch

from torchrl_pomdp import cli, commands, config, files
from torchrl_pomdp.cli import main
from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.envs.repair import trajectory_figure
from torchrl_pomdp.evaluation import compare, discounted_costs, estimate
from torchrl_pomdp.modules import PartitionedValue
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.report.tables import Result, table
from torchrl_pomdp.trainers import Checkpoint, PolicyIterationConfig, load_checkpoint, save_checkpoint

TINY = (
    "--iterations 1 --samples-per-part 30 --trajectories 1 --epochs 1 --least-steps 1 --batch-size 30 --max-steps 30 "
    "--states 20 --validation-states 30 --visits-per-label 0.2 --value-samples 30 --hidden 8 4 --value-hidden 8"
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
    assert (config["problem"], config["config"]["samples_per_part"]) == ("line3", 30)
    metrics = json.loads((out / "metrics.json").read_text())
    truncated = ["R-T of greedy"] if algorithm == "pAPI-T" else []
    best = load_checkpoint(out / "best.pt")
    # On top of the base policy it is R-NT of greedy.
    on_top = [f"{best.name} + R-NT"] if best.iteration else []
    assert list(metrics) == ["greedy", "urgency", "R-NT of greedy", *truncated, f"{algorithm} 1", *on_top]
    last = "no iteration was accepted: best.pt" if best.iteration == 0 else f"best policy: {best.name}, {out / 'best.pt'}. "
    assert text.splitlines()[-1].startswith(last)
    assert metrics["greedy"]["ratio"]["mean"] == 1.0
    (iteration,) = json.loads((out / "iterations.json").read_text())
    assert iteration["accepted"] in (True, False)
    assert "validation states" in iteration["reason"]
    for name in ("costs.png", "trajectory.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    assert f"report: {out / 'report.html'}" in text.splitlines()
    assert "player-data" in (out / "report.html").read_text()
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
    assert "holds other files" in capsys.readouterr().err


@pytest.mark.parametrize("policy", ["greedy", "urgency"])
def test_evaluate_by_name_and_online(policy, capsys):
    assert main(["evaluate", policy, "--problem", "line3", "--states", "10", "--online"]) == 0
    text = capsys.readouterr().out
    for name in ("greedy", "urgency", f"{policy} + R-NT"):
        assert f"| {name} |" in text


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("train nosuch", "a file .toml or .POMDP, or module:function, got 'nosuch'"),
        ("train line3 --states 0", "states must be at least 2, got 0"),
        ("train line3 --rollout-states -5", "rollout_states must be at least 0, got -5"),
        ("train line3 --online-states -5", "online_states must be at least 0, got -5"),
        ("train line3 --iterations 0", "iterations must be at least 1, got 0"),
        ("train line3 --max-steps 100000000000", "max_steps must be"),
        ("train line3 --visits-per-label inf", "visits_per_label must be in (0, 1000], got inf"),
        ("train line3 --exploration nan", "exploration must be"),
        ("train line3 --hidden 8 0", "hidden[1] must be"),
        ("train line3 --seed -1", "seed must be"),
        ("train line3 --device nonsense", "device must be a device of this machine such as cpu or cuda:0, got 'nonsense'"),
        ("train line3 --device cuda:99", "device must be"),
        ("train line3 --out FILE/run", "out must be a folder that can be written"),
        ("train line3 --out FILE", "out must be a folder that can be written"),
        ("train line3 --out /proc/run", "out must be a folder that can be written"),
        (
            "evaluate nowhere.pt",
            "policy must be the path of a checkpoint, or with --problem the name of a base policy, got 'nowhere.pt'",
        ),
        (
            "evaluate nobody --problem line3",
            "policy must be the path of a checkpoint, or one of greedy, urgency, got 'nobody'",
        ),
        ("evaluate FILE", "is damaged or no"),
        ("evaluate greedy --problem nosuch", "problem must be a preset"),
        ("evaluate greedy --states 0", "states must be"),
        ("train line3 --base=", "base must be one of"),
        ("evaluate greedy --trajectories 0", "trajectories must be"),
        ("evaluate greedy --seed -1", "seed must be"),
        ("evaluate greedy --device nonsense", "device must be"),
        ("reproduce table1 --scale 0", "scale must be in (0, 100], got 0"),
        ("reproduce table1 --scale inf", "scale must be"),
        ("reproduce table1 --scale nan", "scale must be"),
        ("reproduce table1 --scale 1e9", "scale must be"),
        ("reproduce table1 --seed -1", "seed must be"),
        ("reproduce table1 --device nonsense", "device must be"),
        ("reproduce table1 --out FILE/results", "out must be a folder that can be written"),
        ("reproduce table1 --runs FILE/runs", "runs must be a folder that can be written"),
        ("reproduce ablation --problems grid5x4", "problems must be among ('linear20',) for ablation"),
    ],
)
def test_bad_input_is_one_line_status_2_and_leaves_nothing(args, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "FILE").write_text("no folder")
    assert main(args.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("torchrl-pomdp: ")
    assert message in line
    assert [path.name for path in tmp_path.iterdir()] == ["FILE"], "the corrected command finds nothing in its way"


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), TypeError("of the wrong kind"), ValueError("a\nb")])
def test_errors_while_it_runs_are_one_line(error, tmp_path, monkeypatch, capsys):
    def fail(*args, **options):
        raise error

    monkeypatch.setattr(files, "write_bytes", fail)
    assert main(["train", "line3", *TINY.split(), "--out", str(tmp_path / "run")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"torchrl-pomdp: {' '.join(str(error).split())}"


def test_ctrl_c_is_one_line(monkeypatch, capsys):
    def interrupt(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "train", interrupt)
    assert main(["train", "line3"]) == 130
    assert capsys.readouterr().err.split("\n") == ["", "torchrl-pomdp: interrupted; the same command goes on", ""]


def test_sigterm_does_what_ctrl_c_does(monkeypatch, capsys):
    """Batch systems send it; without a handler nothing would be cleaned up."""
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(commands, "train", lambda *args: signal.raise_signal(signal.SIGTERM))
    assert main(["train", "line3"]) == 130
    assert capsys.readouterr().err.split("\n") == ["", "torchrl-pomdp: interrupted; the same command goes on", ""]
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_reader_that_has_gone_ends_it_quietly():
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write) as output:
        done = subprocess.run([sys.executable, "-m", "torchrl_pomdp.cli", "problems"], stdout=output, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (141, b"")


@pytest.mark.parametrize("content", ["", "[1]", '[{"parts": {"a": {}}}]', "[" * 100_000])
def test_damaged_iterations_are_named(content, tmp_path, capsys):
    """Where a comparison reads how long PPO shall be trained."""
    problem = make_problem("line3")
    value = PartitionedValue([problem.pessimistic_cost] * problem.partition.num_parts)
    best = Checkpoint(problem, PolicyIterationConfig(), "API", 0, problem.base_policies["greedy"], value)
    save_checkpoint(tmp_path / "best.pt", best)
    (tmp_path / "iterations.json").write_text(content)
    assert main(["compare", "line3", "--checkpoint", str(tmp_path / "best.pt"), "--methods", "PPO"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{tmp_path / 'iterations.json'} is damaged" in line


def test_help_imports_nothing_heavy():
    program = (
        "import sys, time; from torchrl_pomdp.cli import main\ntry: main(['train', '--help'])\nexcept SystemExit: pass\n"
        "print({'torch', 'torchrl', 'tensordict', 'matplotlib'} & set(sys.modules), time.process_time() < 1.0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "--samples-per-part" in done.stdout
    assert done.stdout.splitlines()[-1] == "set() True"


def test_a_terminal_that_cannot_show_everything_gets_what_it_can(monkeypatch):
    """And what is no terminal gets no progress bars."""
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="ascii") for _ in range(2))
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", err)
    assert main(["evaluate", "greedy", "--problem", "line3", "--states", "5"]) == 0
    for stream in (out, err):
        stream.flush()
    assert b"| greedy | " in out.buffer.getvalue()
    assert b" ? " in out.buffer.getvalue()
    assert err.buffer.getvalue() == b""


def test_without_matplotlib_the_table_is_printed(tmp_path, monkeypatch, capsys):
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"] + ["matplotlib", "matplotlib.figure"]:
        monkeypatch.setitem(sys.modules, name, None)
    assert main(["train", "line3", "--algorithm", "API", *TINY.split(), "--out", str(tmp_path / "run")]) == 0
    text = capsys.readouterr().out
    assert "| API 1 |" in text
    assert "no pictures: pictures need matplotlib: pip install '.[plot]' in the library's folder" in text.splitlines()
    assert not list(tmp_path.rglob("*.png"))


def test_a_failed_picture_does_not_lose_the_table(tmp_path, monkeypatch, capsys):
    def fail(*args):
        raise RuntimeError("no font")

    monkeypatch.setattr(commands, "cost_figure", fail)
    assert main(["train", "line3", "--algorithm", "API", *TINY.split(), "--out", str(tmp_path / "run")]) == 0
    text = capsys.readouterr().out
    assert text.index("| API 1 |") < text.index("no pictures: no font")


def test_a_failed_report_does_not_lose_the_results(tmp_path, monkeypatch, capsys):
    def fail(*args, **options):
        raise RuntimeError("no\nworld")

    monkeypatch.setattr(commands, "write_report", fail)
    assert main(["train", "line3", "--algorithm", "API", *TINY.split(), "--out", str(tmp_path / "run")]) == 0
    assert "no report: no world" in capsys.readouterr().out.splitlines()


def test_a_run_without_an_accepted_iteration_says_so_and_what_helps(tmp_path, capsys):
    out = str(tmp_path / "run")
    assert main(["train", "line3", "--base", "urgency", "--algorithm", "API", *TINY.split(), "--out", out]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("no iteration was accepted: best.pt is the base policy, urgency. What usually helps: more --samples")
    assert main(["evaluate", f"{out}/best.pt", "--states", "10", "--online"]) == 0
    assert "| urgency + R-NT |" in capsys.readouterr().out


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
    stages = trajectory.batch_size[0]
    figure = trajectory_figure(linear20.model, trajectory)
    axes = figure.axes[0]
    assert axes.images[0].get_array().shape == (20, stages)
    assert len(axes.collections[0].get_offsets()) == int((trajectory["action"] == 0).sum())
    assert axes.lines[0].get_ydata().tolist() == trajectory["location"][:, 0].tolist()


@pytest.mark.parametrize("module", [cli, config])
def test_the_help_has_no_line_that_is_broken_in_the_middle(module):
    """An option's text goes on in the help as it does here: a further line is an item of a list, or there is none."""
    for own in ast.parse(inspect.getsource(module)).body:
        for entry in own.body if isinstance(own, ast.ClassDef) else []:
            if isinstance(entry, ast.Expr) and entry is not own.body[0]:
                _, *lines = ast.literal_eval(entry.value).splitlines()
                assert all(line.strip().startswith("- ") for line in lines), lines


def test_a_picture_is_of_one_trajectory_of_the_model(linear20):
    greedy = GreedyRepair(linear20.model)
    several = BeliefEnv(linear20.model, linear20.start, batch_size=(4,)).rollout(5, greedy)
    with pytest.raises(ValueError, match=r"trajectory must be one trajectory of at least one stage, got batch \(4, 5\)"):
        trajectory_figure(linear20.model, several)
    with pytest.raises(ValueError, match="action of trajectory must be in"):
        trajectory_figure(linear20.model, several[0].set("action", several[0]["action"] + 7))


def test_a_measurement_of_more_states_is_not_overwritten(tmp_path):
    path = tmp_path / "changes" / "model-changes.md"
    path.parent.mkdir()
    path.write_text("damage three times as fast, 2100 start states, 10 trajectories of each control, ratios\n")
    command = cli.Changes(states=100, trajectories=10, out=tmp_path)
    with pytest.raises(ValueError, match="holds another measurement, not of 100 start states"):
        commands.changes(command)


def test_a_table_says_where_start_states_are_fewer():
    cost = torch.tensor([10.0, 20.0, 30.0])
    lines = table([Result("greedy", compare(cost, cost)), Result("R-NT", compare(cost[:2], cost[:2]))]).splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| greedy", "| R-NT (2 start states)"]
