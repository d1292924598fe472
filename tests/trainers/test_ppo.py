from __future__ import annotations

import io
import sys
import threading
from dataclasses import replace

import pytest
import torch
from _oracles import LINE3_OPTIMUM, line3_cost, random_states
from torch import nn
from tqdm import tqdm

from torchrl_pomdp.envs import FixedBelief, TabularModel
from torchrl_pomdp.evaluation import discounted_costs
from torchrl_pomdp.modules import PartitionedPolicy, PolicyNetwork
from torchrl_pomdp.problems import Problem
from torchrl_pomdp.trainers import ppo
from torchrl_pomdp.trainers.ppo import BATCH, Training

DISCOUNT = 0.9


@pytest.fixture(scope="module")
def treadmill():
    """A problem that never ends: two controls that do the same, each stage costs 1, so every state's cost is 1 / (1 - 0.9)."""
    tables = {"transition": torch.eye(2).expand(2, 2, 2), "observation": torch.ones(2, 2, 1), "cost": torch.ones(2, 2)}
    model = TabularModel(*tables.values(), DISCOUNT)
    return Problem(model, FixedBelief(torch.tensor([0.5, 0.5])), name="treadmill").unpartitioned()


@pytest.fixture(scope="module")
def trained(line3):
    return ppo(line3, steps=BATCH)


def first_batch(problem, ratio=None):
    """A training and its first batch; with ``ratio`` the value of every state is that multiple of the pessimistic cost."""
    training = Training(problem, 1, 0)
    if ratio is not None:
        last = list(training.value.network)[-1]
        nn.init.zeros_(last.weight)
        nn.init.constant_(last.bias, ratio)
    return training, next(iter(training.segment()))


def weights(policy):
    return torch.cat([parameter.detach().flatten() for parameter in policy.parameters()])


def test_it_learns_the_line_of_3(line3):
    policy = ppo(line3, steps=12 * BATCH)
    cost, _ = line3_cost(line3.model, policy)
    assert LINE3_OPTIMUM[0] - 0.01 < cost < 1.01 * LINE3_OPTIMUM[1]


def test_what_is_returned_is_a_policy_of_the_library(line3, trained):
    assert isinstance(trained, PolicyNetwork)
    assert not trained.training
    single = line3.unpartitioned().model
    costs = [
        discounted_costs(model, policy, line3.start, num_states=50)
        for model, policy in ((line3.model, trained), (single, trained), (single, PartitionedPolicy([trained])))
    ]
    assert torch.equal(costs[0], costs[1])
    assert torch.equal(costs[0], costs[2])


def test_controls_are_legal_and_the_most_probable(line3, trained):
    y = line3.model.with_features(random_states(line3.model, 500, seed=0))
    trained(y)
    assert y["action"].dtype == torch.int64
    assert y["action_mask"].gather(1, y["action"].unsqueeze(1)).all()
    assert torch.equal(y["action"], y["logits"].argmax(-1))


def test_controls_are_drawn_from_the_legal_ones(line3):
    _, batch = first_batch(line3.unpartitioned())
    mask = batch["action_mask"]
    assert mask.gather(-1, batch["action"].unsqueeze(-1)).all()
    # The untrained policy is nearly uniform: where two controls are legal, each is drawn about every other time.
    drawn = nn.functional.one_hot(batch["action"], 3)[mask.sum(-1) == 2].double()
    legal = mask[mask.sum(-1) == 2].double()
    assert torch.allclose(drawn.sum(0) / legal.sum(0), torch.full((3,), 0.5).double(), atol=0.05)


def test_a_seed_decides_the_weights_and_the_global_generator_is_untouched(line3, trained):
    torch.manual_seed(123)
    state = torch.random.get_rng_state()
    assert torch.equal(weights(ppo(line3, steps=BATCH)), weights(trained))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert not torch.equal(weights(ppo(line3, steps=BATCH, seed=1)), weights(trained))


def test_a_last_batch_that_is_not_full_is_left_out(line3, trained):
    assert torch.equal(weights(ppo(line3, steps=2 * BATCH - 1)), weights(trained))


def test_an_interrupted_training_goes_on_where_it_was(line3, monkeypatch, tmp_path):
    monkeypatch.setattr(sys.modules[Training.__module__], "SEGMENT", 2)
    options = {"steps": 7 * 16 * 64, "episodes": 64}
    whole, path = weights(ppo(line3, **options)), tmp_path / "ppo.pt"
    made, own = [], Training.update

    def update(training, batch):
        if len(made) == 3:
            raise KeyboardInterrupt
        made.append(training.done)
        own(training, batch)

    monkeypatch.setattr(Training, "update", update)
    with pytest.raises(KeyboardInterrupt):
        ppo(line3, path=path, **options)
    made.clear()
    with pytest.raises(KeyboardInterrupt):
        ppo(line3, path=path, **options)
    # The third batch, of a segment that was not over, is made again.
    assert made == [2, 3, 4]
    made.clear()
    assert torch.equal(weights(ppo(line3, path=path, **options)), whole)
    assert made == [4, 5, 6]
    made.clear()
    assert torch.equal(weights(ppo(line3, path=path, **options)), whole)
    assert made == []


def test_a_file_of_something_else_is_refused_and_left_alone(line3, tmp_path):
    path = tmp_path / "ppo.pt"
    ppo(line3, steps=16, episodes=1, path=path)
    for content, options in ((path.read_bytes(), {"seed": 1}), (path.read_bytes()[:-9], {}), (b"my thesis", {})):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"path must be a new file or that of this training: .*{path.name}"):
            ppo(line3, steps=16, episodes=1, path=path, **options)
        assert path.read_bytes() == content


@pytest.mark.parametrize("name", ["folder", ".", "..", "file/ppo.pt"])
def test_a_path_that_cannot_be_written_is_refused_at_once(line3, tmp_path, monkeypatch, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(Training, "__init__", None)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="path must be a"):
        ppo(line3, steps=16, episodes=1, path=name)


def test_a_problem_without_a_digest_can_be_trained(line3):
    lock = threading.Lock()

    def start(keys):
        with lock:
            return line3.start(keys)

    with torch.no_grad():
        policy = ppo(replace(line3, start=start), steps=16, episodes=1)
    assert torch.isfinite(weights(policy)).all()


def test_what_follows_a_cut_is_the_value_of_the_state_there(treadmill):
    # By Bellman's equation 10 = 1 + 0.9 * 10: of a right value no advantage is left, at a cut neither.
    training, batch = first_batch(treadmill, ratio=1.0)
    assert batch["next", "truncated"].any()
    assert not batch["next", "terminated"].any()
    rows = training.labelled(batch)
    assert torch.allclose(rows["advantage"], torch.zeros(()), atol=1e-5)
    # Costs of 10 in multiples of the pessimistic cost, which is 10.
    assert torch.allclose(rows["value_target"], torch.tensor(-1.0))


def test_what_a_cut_hides_is_not_counted(treadmill):
    # Values of 0: the advantage at a cut is minus the one stage cost, in multiples of 10.
    training, batch = first_batch(treadmill, ratio=0.0)
    cut = batch["next", "truncated"].reshape(-1)
    assert torch.allclose(training.labelled(batch)["advantage"][cut], torch.tensor(-0.1))


def test_nothing_follows_the_end():
    # Each stage costs 1 and is the last one with probability 0.5, which is seen.
    change = torch.tensor([[0.5, 0.5], [0.0, 1.0]]).expand(2, 2, 2)
    cost = torch.tensor([[1.0, 0.0], [1.0, 0.0]])
    model = TabularModel(change, torch.eye(2).expand(2, 2, 2), cost, DISCOUNT, terminal=torch.tensor([False, True]))
    problem = Problem(model, FixedBelief(torch.tensor([1.0, 0.0])), name="stairs").unpartitioned()
    # The value is 10 everywhere, at the end too: there it must not be looked at. The stage cost of 1 is all that came.
    training, batch = first_batch(problem, ratio=1.0)
    end = batch["next", "terminated"].reshape(-1)
    assert end.any()
    assert torch.allclose(training.labelled(batch)["advantage"][end], torch.tensor(0.9))


def test_a_start_state_may_be_terminal(line3):
    problem = line3.unpartitioned()

    def start(keys):
        y = line3.start(keys)
        repaired = torch.eye(problem.model.num_levels)[0].expand(len(keys), 3, -1)
        return y.set("belief", torch.where((keys % 2 == 0).view(-1, 1, 1), repaired, y["belief"]))

    training, batch = first_batch(replace(problem, start=start))
    ended = problem.model.is_terminal(batch)
    assert ended.any()
    assert not ended.all()
    rows = training.labelled(batch)
    assert (rows["advantage"][ended.reshape(-1)] == 0).all()
    assert torch.isfinite(weights(ppo(replace(problem, start=start), steps=BATCH))).all()


def test_first_episodes_are_cut_at_different_times(treadmill):
    _, batch = first_batch(treadmill)
    cuts = batch["next", "truncated"].sum(0).reshape(-1)
    # 256 episodes of 66 stages, 3 or 4 in each.
    assert treadmill.model.horizon == 66
    assert set(cuts.tolist()) <= {3, 4}


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"steps": BATCH - 1}, ValueError, f"steps must be at least {BATCH}, got {BATCH - 1}"),
        ({"steps": 1e6}, TypeError, "steps must be an integer, got 1000000.0"),
        ({"seed": -1}, ValueError, "seed must be at least 0, got -1"),
        ({"episodes": 0}, ValueError, "episodes must be at least 1, got 0"),
        ({"episodes": 257}, ValueError, "steps must be at least 4112, got 4096"),
        ({"path": 1}, TypeError, "path must be"),
        ({"progress": 1}, TypeError, "progress must be True or False, got 1"),
        ({"problem": "line3"}, TypeError, "problem must be a Problem, got 'line3'"),
    ],
)
def test_refusals(line3, wrong, error, message):
    arguments = {"problem": line3, "steps": BATCH} | wrong
    with pytest.raises(error, match=message):
        ppo(arguments.pop("problem"), **arguments)


def test_a_progress_bar_counts_the_steps(line3, monkeypatch, tmp_path):
    bars = []

    def bar(total, unit, desc, show, initial):
        bars.append(tqdm(total=total, unit=unit, desc=desc, initial=initial, file=io.StringIO()))
        return bars[0]

    monkeypatch.setattr(sys.modules[Training.__module__], "progress_bar", bar)
    for done in (0, 2 * BATCH):
        ppo(line3, steps=2 * BATCH, path=tmp_path / "ppo.pt", progress=True)
        assert (bars[-1].n, bars[-1].total, bars[-1].unit) == (2 * BATCH, 2 * BATCH, "step")
        assert bars[-1].initial == done
