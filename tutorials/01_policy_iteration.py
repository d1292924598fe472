# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Tutorial 1: the whole method in one loop
#
# A robot walks along a pipeline. Every location has a damage level from 0 (intact) to 4, which rises at random; the robot
# sees the level only where it stands, and can repair that location or move to a neighbour. Each stage costs money for every
# damaged location. What should it do?
#
# We start from a simple *base policy*, look one step ahead with simulated trajectories of it (*rollout*), and teach networks
# to imitate the better controls that this finds (*policy iteration*). Then we do it again, with the networks as base policy.
# No trainer: the loop is written out, over parts that you can replace one by one.
#
# | word | entry or object | meaning |
# |---|---|---|
# | feature state y | TensorDict, any batch | what the robot knows: `belief` `[*B, L, K]`, `location` `[*B, R]`, and what follows from them |
# | control u | `action` `[*B]` | 0 repairs, the others move; the legal ones are in `action_mask` |
# | Q-factor | `q_factors` `[*B, U]` | expected cost of a control now and the base policy ever after; lower is better |
# | part | `partition` `[*B]` | which of the N parts of the feature space the state lies in; each has its own network |

# %% tags=["parameters"]
PROBLEM = "line3"  # three locations, so that the best possible cost is known; "linear20" has 10^15 states
ITERATIONS = 2
SAMPLES_PER_PART = 3000
TRAJECTORIES = 10
OPTIMIZATION_STEPS = 1500
EVALUATION_STATES = 4000

# %%
# %matplotlib inline
from functools import partial

import torch
from torchrl import logger
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_pomdp.collectors import PartSampler, RolloutImprovement, StateMemory, training_states
from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.envs.repair import trajectory_figure
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import PartitionedPolicy, PolicyNetwork, RolloutPolicy
from torchrl_pomdp.modules.repair import GreedyRepair, RelativeEncoder
from torchrl_pomdp.objectives import ClassificationLoss
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.report import Result, cost_figure, table

logger.setLevel("WARNING")

# %% [markdown]
# ## The problem and its feature states
#
# A *problem* is a belief model with distributions of start states and of training states. The model is a set of batched
# functions; `problem.start` makes any number of start states.

# %%
problem = make_problem(PROBLEM)
model, partition = problem.model, problem.model.partition
print(model.describe())
print("parts:", ", ".join(partition.names))

y = model.with_features(problem.start(torch.arange(4)))
y

# %% [markdown]
# ## One-step lookahead with rollout
#
# The greedy policy repairs where it stands, or walks to the nearest location that may be damaged. `RolloutPolicy` tries every
# legal control, lets greedy finish the job in simulation, and takes the control with the smallest Q-factor.

# %%
greedy = GreedyRepair(model)
RolloutPolicy(model, greedy, trajectories=TRAJECTORIES)(y)
for belief, q, u in zip(y["belief"], y["q_factors"], y["action"], strict=True):
    print("P(damaged) =", (1 - belief[:3, 0]).numpy().round(2), " Q =", q.numpy().round(1), " control", int(u))

# %% [markdown]
# ## Policy iteration, by hand
#
# `RolloutImprovement` labels states with their rollout control. The partition's *stages* tell in which order the parts are
# trained: endgame states never lead back to the startgame, so the endgame networks come first and finish the simulations of
# the startgame. Half of the states of a part are random, half come from a memory of states that the policies have met. In the
# end the networks are the next base policy.


# %%
def improve(base: list, iteration: int) -> list:
    """One policy iteration: networks that imitate the rollout of the local policies ``base``, one for each part."""
    generator = torch.Generator().manual_seed(iteration)
    encoder = RelativeEncoder(model)
    memory.visit(PartitionedPolicy(base), problem.start, torch.arange(2000) + 10_000 * iteration, exploration=0.15)
    networks = [PolicyNetwork(encoder, model.num_controls, generator=generator) for _ in partition.names]
    for number, stage in enumerate(partition.stages):
        policy = PartitionedPolicy(base)
        generators = {part: training_states(problem, memory, part) for part in stage}
        collector = RolloutImprovement(
            BeliefEnv(model, problem.start),
            policy,
            states=PartSampler(generators, seed=10 * iteration + number),
            frames_per_batch=SAMPLES_PER_PART * len(stage),
            total_frames=SAMPLES_PER_PART * len(stage),
            label=partial(RolloutPolicy, trajectories=TRAJECTORIES, seed=iteration),
        )
        storage = LazyTensorStorage(SAMPLES_PER_PART * len(stage))
        buffer = TensorDictReplayBuffer(storage=storage, batch_size=512, generator=generator)
        for batch in collector:
            buffer.extend(batch)
        loss = ClassificationLoss(PartitionedPolicy(networks))
        optimizer = torch.optim.RMSprop(loss.parameters(), lr=1e-3)
        schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total_iters=OPTIMIZATION_STEPS)
        for _ in range(OPTIMIZATION_STEPS):
            optimizer.zero_grad()
            loss(buffer.sample())["loss_policy"].backward()
            optimizer.step()
            schedule.step()
        base = [networks[part] if part in stage else local for part, local in enumerate(base)]
    return base


memory = StateMemory(model)
policies = [[greedy] * partition.num_parts]
for iteration in range(ITERATIONS):
    policies.append(improve(policies[-1], iteration))

# %% [markdown]
# ## Does it work?
#
# Every policy meets the same start states and the same noise, so that the ratio to greedy has a narrow interval.

# %%
candidates = {"greedy": greedy, "rollout": RolloutPolicy(model, greedy, trajectories=TRAJECTORIES)}
candidates |= {f"networks {i}": PartitionedPolicy(policies[i]) for i in range(1, ITERATIONS + 1)}
costs = {
    name: discounted_costs(model, policy, problem.start, num_states=EVALUATION_STATES) for name, policy in candidates.items()
}
results = [Result(name, compare(cost, costs["greedy"])) for name, cost in costs.items()]
print(table(results))
cost_figure(results, f"{PROBLEM}, {EVALUATION_STATES} start states")

# %% [markdown]
# On the line of three locations no policy can be below 168.97, so a ratio of 0.867 is the end of the road.
#
# ## What the robot does
#
# Locations by time: the colour is the expected damage, the line is the robot's path, crosses are repairs.

# %%
env = BeliefEnv(model, problem.start, seed=7)
with torch.no_grad():
    trajectory = env.rollout(80, candidates[f"networks {ITERATIONS}"])
trajectory_figure(model, trajectory, "one trajectory of the last policy")

# %% [markdown]
# ## Where to go from here
#
# - `PROBLEM = "linear20"` with `SAMPLES_PER_PART = 10_000` takes some minutes and works the same way.
# - `UrgencyRepair` is a better base policy than greedy, and `ParallelRollout` takes both.
# - `training_states` is built from `StateMemory`, `InPart` and `Mixture`, which you can combine in other ways.
# - `torchrl-pomdp train linear20` does all this under TorchRL's trainer, with values, checkpoints, metrics and pictures.
