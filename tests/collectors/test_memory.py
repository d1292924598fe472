"""The memory of visited states: what it holds, how it is bounded, that it does not depend on the order of visits."""

from __future__ import annotations

import pytest
import torch

from torchrl_pomdp.collectors import StateMemory, training_states
from torchrl_pomdp.envs import BeliefEnv, FixedBelief
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.problems import make_problem, tiger


def visit(problem, keys, **options):
    memory = StateMemory(problem.model, **options)
    memory.visit(GreedyRepair(problem.model), problem.start, keys)
    return memory


def held(memory, part):
    """Fingerprints of the states of a part that are held."""
    y = memory.generator(part)(torch.arange(20 * memory.count(part)))
    return set(memory.model.fingerprint(y).tolist())


def test_it_holds_the_states_of_the_policys_trajectories(line3):
    model, greedy = line3.model, GreedyRepair(line3.model)
    memory = visit(line3, torch.arange(400), retain=1.0)
    seen = set()
    env = BeliefEnv(model, line3.start, batch_size=(1600,), seed=0)
    with torch.no_grad():
        steps = env.rollout(12, greedy, break_when_any_done=False)
    steps = steps[~steps["terminated"].squeeze(-1)]
    seen |= set(model.fingerprint(steps).tolist())
    parts = [part for part in range(6) if memory.count(part)]
    assert len(parts) >= 3
    for part in parts:
        states = memory.generator(part)(torch.arange(300))
        assert (model.partition(states) == part).all()
        assert not model.is_terminal(states).any()
    # From an enumerable start both ways of playing meet nearly the same early states.
    first = {f for part in parts for f in held(memory, part)}
    assert len(first & seen) > 0.5 * len(seen)


def test_the_sample_is_bounded_and_about_a_tenth(linear20):
    everything, tenth = (visit(linear20, torch.arange(300), retain=share) for share in (1.0, 0.1))
    for part in (1, 4):
        share = tenth.count(part) / everything.count(part)
        assert abs(share - 0.1) < 4 * (0.09 / everything.count(part)) ** 0.5
        assert held(tenth, part) <= held(everything, part)
    small = visit(linear20, torch.arange(300), retain=1.0, capacity=50)
    assert [small.count(part) for part in range(6)] == [min(50, everything.count(part)) for part in range(6)]
    assert held(small, 1) <= held(everything, 1)


def test_the_order_of_visits_does_not_matter(linear20):
    whole = visit(linear20, torch.arange(200), capacity=100)
    parts = StateMemory(linear20.model, capacity=100)
    greedy = GreedyRepair(linear20.model)
    for keys in reversed(torch.arange(200).split(30)):
        parts.visit(greedy, linear20.start, keys)
    parts.visit(greedy, linear20.start, torch.arange(50))
    assert all(held(whole, part) == held(parts, part) for part in range(6) if whole.count(part) or parts.count(part))


@pytest.mark.parametrize("seed", range(5))
def test_states_that_are_often_visited_are_kept(line3, seed):
    """Each visit may retain its state; a state that nobody else visits has a single chance."""
    everything, tenth = (visit(line3.unpartitioned(), torch.arange(300), retain=share, seed=seed) for share in (1.0, 0.1))
    start = set(everything.model.fingerprint(line3.start(torch.arange(300))).tolist())
    assert start <= held(tenth, 0) <= held(everything, 0)


def test_exploration_leaves_the_policys_trajectories(linear20):
    model, greedy = linear20.model, GreedyRepair(linear20.model)
    memories = [StateMemory(model, retain=1.0) for _ in range(2)]
    for memory, exploration in zip(memories, (0.0, 0.5), strict=True):
        memory.visit(greedy, linear20.start, torch.arange(50), exploration=exploration)
    assert held(memories[0], 1) != held(memories[1], 1)


def test_models_without_a_partition_have_one_part():
    memory = StateMemory(tiger().model, retain=1.0)
    memory.visit(lambda y: y.set("action", torch.zeros(y.batch_size, dtype=torch.int64)), FixedBelief(torch.tensor([0.5, 0.5])),
                 torch.arange(4), max_steps=5)  # fmt: skip
    assert 1 < memory.count(0) <= 2 * 5 + 1


def test_training_states_of_a_single_part_are_of_all_six_and_of_the_memory():
    problem, six = make_problem("linear20", partitioned=False), make_problem("linear20").model.partition
    memory = visit(problem, torch.arange(200))
    visited = held(memory, 0)
    y = training_states(problem, memory, 0, visited_share=0.7)(torch.arange(4000))
    random = torch.tensor([f not in visited for f in problem.model.fingerprint(y).tolist()])
    assert abs(random.float().mean() - 0.3) < 4 * (0.21 / 4000) ** 0.5
    assert (six(y[random]).bincount(minlength=6) / int(random.sum()) - 1 / 6).abs().max() < 0.05


def test_parts_that_nobody_visits_are_filled_with_random_states(linear20):
    memory = StateMemory(linear20.model)
    assert training_states(linear20, memory, 2) is linear20.training[2]
    with pytest.raises(ValueError, match="holds no state of part 2"):
        memory.generator(2)


def test_bad_arguments_are_refused(linear20):
    memory, greedy = StateMemory(linear20.model), GreedyRepair(linear20.model)
    with pytest.raises(ValueError, match="capacity must be at least 1, got 0"):
        StateMemory(linear20.model, capacity=0)
    with pytest.raises(ValueError, match=r"retain must be in \(0, 1\], got 0"):
        StateMemory(linear20.model, retain=0)
    with pytest.raises(ValueError, match="exploration must be in"):
        memory.visit(greedy, linear20.start, torch.arange(2), exploration=1.5)
    with pytest.raises(ValueError, match="max_steps must be at least 1"):
        memory.visit(greedy, linear20.start, torch.arange(2), max_steps=0)
    with pytest.raises(ValueError, match="visited_share must be in"):
        training_states(linear20, memory, 2, visited_share=2.0)
