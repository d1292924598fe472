from __future__ import annotations

import pytest
import torch
from _oracles import LINE3_OPTIMUM, Memo, line3_cost

from torchrl_pomdp.modules import ParallelRollout, RolloutPolicy
from torchrl_pomdp.modules.repair import GreedyRepair, UrgencyRepair
from torchrl_pomdp.problems import make_problem


def test_q_factors_are_the_smallest_over_the_bases(linear20):
    model = linear20.model
    rollouts = [RolloutPolicy(model, base(model), trajectories=4) for base in (GreedyRepair, UrgencyRepair)]
    parallel = ParallelRollout(rollouts)
    y = linear20.start(torch.arange(60))
    q = parallel(y.copy())["q_factors"]
    each = [rollout(y.copy())["q_factors"] for rollout in rollouts]
    assert torch.equal(q, torch.minimum(*each))
    assert (each[0].argmin(-1) != q.argmin(-1)).any()
    assert (each[1].argmin(-1) != q.argmin(-1)).any()
    assert parallel.simulated_steps == sum(rollout.simulated_steps for rollout in rollouts)


def test_it_is_no_worse_than_its_bases_on_the_line_of_3(line3):
    model = line3.model
    bases = [base(model) for base in (GreedyRepair, UrgencyRepair)]
    policy = ParallelRollout([RolloutPolicy(model, base, trajectories=60) for base in bases])
    cost = line3_cost(model, Memo(model, policy))[0]
    assert LINE3_OPTIMUM[0] - 0.05 <= cost <= min(line3_cost(model, base)[0] for base in bases) + 0.2


def test_bad_arguments_are_refused(linear20):
    with pytest.raises(ValueError, match="policies is empty"):
        ParallelRollout([])
    other = make_problem("linear20").model
    with pytest.raises(ValueError, match="of one model"):
        ParallelRollout([RolloutPolicy(model, GreedyRepair(model)) for model in (linear20.model, other)])


def test_steps_of_one_policy_count_once():
    model = make_problem("line3").model
    once, twice = (RolloutPolicy(model, GreedyRepair(model), trajectories=2) for _ in range(2))
    both, y = ParallelRollout([twice, twice]), make_problem("line3").start(torch.arange(3))
    once(y)
    both(y)
    assert both.simulated_steps == 2 * once.simulated_steps
