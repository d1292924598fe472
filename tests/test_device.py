"""The same answers on an accelerator."""

from __future__ import annotations

import pytest
import torch

from torchrl_pomdp.collectors import PartSampler, RolloutImprovement
from torchrl_pomdp.envs import BeliefEnv, make_problem
from torchrl_pomdp.evaluation import discounted_costs
from torchrl_pomdp.modules import GreedyRepair, PartitionedPolicy, PolicyNetwork, RelativeEncoder, RolloutPolicy
from torchrl_pomdp.objectives import ClassificationLoss

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def test_start_states_and_costs_agree_with_the_cpu(linear20):
    there = make_problem("linear20", device="cuda")
    costs = [discounted_costs(p.model, GreedyRepair(p.model), p.start, num_states=200) for p in (linear20, there)]
    assert costs[1].is_cuda
    torch.testing.assert_close(costs[1].cpu(), costs[0], rtol=1e-3, atol=1e-2)


def test_collecting_and_training_stay_on_the_device():
    problem = make_problem("linear20", device="cuda")
    generator = torch.Generator(device="cuda").manual_seed(0)
    encoder = RelativeEncoder(problem.model)
    policy = PartitionedPolicy([PolicyNetwork(encoder, 3, (16,), generator=generator) for _ in range(6)])
    collector = RolloutImprovement(
        BeliefEnv(problem.model, problem.start),
        policy,
        states=PartSampler(dict(enumerate(problem.training)), seed=0),
        frames_per_batch=60,
        total_frames=60,
        label=lambda model, base: RolloutPolicy(model, base, trajectories=2),
    )
    batch = next(iter(collector))
    assert all(leaf.is_cuda for leaf in batch.values(include_nested=True, leaves_only=True))
    loss = ClassificationLoss(policy)(batch)["loss_policy"]
    loss.backward()
    assert torch.isfinite(loss)
