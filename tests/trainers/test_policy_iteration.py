from __future__ import annotations

import warnings

import pytest
import torch

from torchrl_pomdp.envs import Problem, RepairModel, SinglePart, UniformStart, damage_chain, line, make_problem
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import GreedyRepair
from torchrl_pomdp.trainers import PolicyIteration, PolicyIterationConfig, make_networks
from torchrl_pomdp.trainers.checkpoint import Checkpoint, load_checkpoint, save_checkpoint

TINY = PolicyIterationConfig(
    iterations=1, samples_per_part=200, trajectories=2, epochs=2, batch_size=50, hidden=(16,), max_steps=60
)


def run(problem, config=TINY):
    return list(PolicyIteration(problem, config, GreedyRepair(problem.model)))


def weights(policy):
    return torch.cat([parameter.detach().flatten() for parameter in policy.parameters()])


def test_policy_iteration_improves_greedy_on_the_line_of_3(line3):
    config = PolicyIterationConfig(iterations=1, samples_per_part=1500, trajectories=10, epochs=30, batch_size=64)
    policy = run(line3, config)[-1]
    greedy = discounted_costs(line3.model, GreedyRepair(line3.model), line3.start, num_states=4000)
    comparison = compare(discounted_costs(line3.model, policy, line3.start, num_states=4000), greedy)
    assert comparison.ratio.interval[1] < 1.0
    assert comparison.cost.mean + 3 * comparison.cost.standard_error > 168.96, "nothing is below the optimum"


def test_the_same_seed_gives_the_same_policy_and_the_global_generator_is_untouched(line3):
    state = torch.random.get_rng_state()
    with warnings.catch_warnings():
        warnings.filterwarnings("error", module="torchrl_pomdp")
        first = run(line3)[0]
    assert torch.equal(torch.random.get_rng_state(), state)
    torch.manual_seed(123)
    assert torch.equal(weights(run(line3)[0]), weights(first))
    other = PolicyIterationConfig(**{**TINY.__dict__, "seed": 1})
    assert not torch.equal(weights(run(line3, other)[0]), weights(first))


def test_stages_train_the_endgame_first_and_roll_the_startgame_out_with_it(line3, monkeypatch):
    seen = []

    def record(self, networks, base, stage, iteration):
        seen.append((stage, [type(policy).__name__ for policy in base.policies]))

    monkeypatch.setattr(PolicyIteration, "_train_stage", record)
    run(line3)
    greedy, network = "GreedyRepair", "PolicyNetwork"
    assert seen == [((3, 4, 5), [greedy] * 6), ((0, 1, 2), [greedy] * 3 + [network] * 3)]


def test_one_part_is_plain_policy_iteration():
    model = RepairModel(
        line(3), damage_chain((0.0, 0.02, 0.03, 0.05)), (0.0, 0.1, 1.0, 10.0, 100.0), 0.99, partition=SinglePart()
    )
    start = UniformStart(model)
    problem = Problem("line of 3, one part", model, start, (start,))
    assert len(run(problem)[0].policies) == 1


def test_models_without_a_partition_are_refused():
    model = RepairModel(line(3), damage_chain((0.0, 0.02)), (0.0, 1.0, 2.0), 0.99)
    with pytest.raises(ValueError, match="has no partition"):
        PolicyIteration(Problem("bare", model, UniformStart(model), ()), TINY, GreedyRepair(model))


@pytest.mark.parametrize(
    "change",
    [
        {"iterations": 0}, {"samples_per_part": 0}, {"trajectories": 0}, {"max_steps": 0}, {"batch_size": 0},
        {"epochs": 0}, {"visited_share": 1.5}, {"exploration": -0.1}, {"learning_rate": 0.0}, {"hidden": ()},
    ],
)  # fmt: skip
def test_bad_numbers_are_named(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        PolicyIterationConfig(**change)


def test_checkpoints_restore_the_policy(line3, tmp_path):
    policy = make_networks(line3, TINY, seed=5)
    path = tmp_path / "policy.pt"
    save_checkpoint(path, Checkpoint(line3, TINY, 3, policy))
    loaded = load_checkpoint(path)
    assert (loaded.problem.name, loaded.config, loaded.iteration) == ("line3", TINY, 3)
    assert torch.equal(weights(loaded.policy), weights(policy))
    y = line3.model.with_features(line3.start(torch.arange(20)))
    assert torch.equal(loaded.policy(y.copy())["action"], policy(y.copy())["action"])
    assert [p.name for p in tmp_path.iterdir()] == ["policy.pt"], "no temporary file is left"


def test_damaged_and_foreign_checkpoints_are_refused(tmp_path):
    problem = make_problem("line3")
    path = tmp_path / "policy.pt"
    with pytest.raises(ValueError, match="there is no checkpoint"):
        load_checkpoint(path)
    save_checkpoint(path, Checkpoint(problem, TINY, 1, make_networks(problem, TINY, seed=0)))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="damaged or no checkpoint"):
        load_checkpoint(path)
    path.write_text("hello")
    with pytest.raises(ValueError, match="damaged or no checkpoint"):
        load_checkpoint(path)
    torch.save({"weights": torch.ones(3)}, path)
    with pytest.raises(ValueError, match="damaged or no checkpoint"):
        load_checkpoint(path)
    torch.save(PolicyIterationConfig(), path)
    with pytest.raises(ValueError, match="damaged or no checkpoint"):
        load_checkpoint(path)
