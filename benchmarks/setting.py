"""The problem and the policies that are measured."""

from __future__ import annotations

from functools import cache

import torch
from tensordict import TensorDictBase

from torchrl_pomdp.collectors import PartSampler, StateMemory, training_states
from torchrl_pomdp.envs.repair import CalibratedStart, RepairModel, RepairPartition, damage_chain, line
from torchrl_pomdp.modules import PartitionedPolicy, TruncatedRollout
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.objectives import ClassificationLoss
from torchrl_pomdp.problems import Problem, make_problem
from torchrl_pomdp.trainers import PolicyIterationConfig, make_networks


@cache
def linear20() -> Problem:
    return make_problem("linear20")


def line_problem(size: int, drift: float = 0.0) -> tuple[RepairModel, CalibratedStart]:
    graph, costs = line(size), torch.tensor([0, 0.1, 1, 10, 100])
    chain = damage_chain((drift, 0.02, 0.03, 0.05))
    model = RepairModel(graph, chain, costs, 0.99, partition=RepairPartition(graph, costs))
    return model, CalibratedStart(model)


def states(count: int, seed: int) -> TensorDictBase:
    """Training states of all six parts, as policy iteration draws them."""
    problem, memory = linear20(), StateMemory(linear20().model)
    memory.visit(GreedyRepair(problem.model), problem.start, torch.arange(5000), exploration=0.15)
    parts = {part: training_states(problem, memory, part) for part in range(6)}
    return problem.model.with_features(PartSampler(parts, seed=seed)(torch.arange(count)))


@cache
def networks() -> PartitionedPolicy:
    """Six 256-64 networks that imitate the greedy policy, so that their rollouts have the usual lengths."""
    problem = linear20()
    greedy = GreedyRepair(problem.model)
    policy = make_networks(problem, PolicyIterationConfig(), seed=0)
    y = states(60_000, seed=0)
    y.set("action", greedy(y.copy())["action"])
    y.set("q_factors", torch.nn.functional.one_hot(y["action"], 3) * -1.0)
    loss = ClassificationLoss(policy, "cross_entropy")
    steps = 1500
    optimizer = torch.optim.RMSprop(loss.parameters(), 1e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total_iters=steps)
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        optimizer.zero_grad()
        loss(y[torch.randint(len(y), (2048,), generator=generator)])["loss_policy"].backward()
        optimizer.step()
        schedule.step()
    return policy.eval()


def network_flops() -> int:
    """Floating-point operations of one network for one row."""
    layers = [layer for layer in networks().policies[0].network if isinstance(layer, torch.nn.Linear)]
    return sum(2 * layer.in_features * layer.out_features for layer in layers)


def by_tensors(rollout):
    """The same rollout, or rollout policy, without its compiled loop."""
    for part in rollout.modules():
        if isinstance(part, TruncatedRollout):
            part.scalar = None
    return rollout


class Counting(torch.nn.Module):
    """A policy that counts the rows it decides."""

    def __init__(self, policy) -> None:
        super().__init__()
        self.policy, self.in_keys, self.rows = policy, policy.in_keys, 0

    def forward(self, y):
        self.rows += y.batch_size.numel()
        return self.policy(y)
