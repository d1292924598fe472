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
# # Tutorial 7: policy iteration on many computers, with Ray
#
# **What you will learn**
#
# 1. to carry out policy iteration on a Ray cluster, and that the result is the same to the last bit;
# 2. to let the parts of a partition go on at their own pace, and what *staleness* means;
# 3. how far more computers help, and whom you must trust.
#
# Ray is the extra *ray*: `pip install '.[ray]'`. Everything here runs on one machine; a cluster differs by an address.
#
# | word | in the library | meaning |
# |---|---|---|
# | part | `problem.partition` | one of N regions of the feature space, each with a policy network of its own |
# | worker | a process of Ray's | labels states, visits states, evaluates: stateless tasks |
# | actor | one for each part | trains that part's network, and keeps its data |
# | version | `Version` | what a part has published: its networks after so many trainings |
# | staleness | `AsynchronousIteration(..., staleness=1)` | how many versions a part may be ahead of the last one |

# %% tags=["parameters"]
WORKERS = 2
ITERATIONS = 2
SAMPLES_PER_PART = 300
STAGES = 200
OPTIMIZATION_STEPS = 200
EVALUATION_STATES = 500

# %%
# %matplotlib inline
import time

import matplotlib.pyplot as plt
import ray
import torch
from torchrl import logger

from torchrl_pomdp.distributed import RayWorkers
from torchrl_pomdp.envs import FunctionPartition
from torchrl_pomdp.evaluation import discounted_costs
from torchrl_pomdp.problems import Problem, tiger
from torchrl_pomdp.trainers import AsynchronousIteration, PolicyIterationConfig, papi_nt

logger.setLevel("WARNING")
plt.rcParams["figure.constrained_layout.use"] = True

# %% [markdown]
# ## A problem of four parts
#
# Behind one of two doors is a tiger. Listening costs 1 and tells the side, right in 85 of 100 cases; the tiger's door costs
# 100, the other one pays 10. The belief is the probability that the tiger is on the left. We cut it into four parts, by a
# function of the feature state; each will have a network of its own.


# %%
def part_of(y):
    left = y["belief"][..., 0]
    return torch.where(
        (left - 0.5).abs() < 0.1, 0, torch.where(left.clamp(0.04, 0.96) != left, 3, torch.where(left > 0.5, 1, 2))
    )


parts = FunctionPartition(("unsure", "left", "right", "sure"), part_of)
model = tiger().model.with_partition(parts)
base = tiger().base_policies["listen"]  # listen for ever: a poor base policy
problem = Problem(model, tiger().start, name="tiger", base_policies={"listen": base})
config = PolicyIterationConfig(
    iterations=ITERATIONS,
    samples_per_part=SAMPLES_PER_PART,
    trajectories=4,
    max_steps=STAGES,
    least_steps=OPTIMIZATION_STEPS,
    epochs=1,
    hidden=(64, 32),
    validation_states=EVALUATION_STATES,
)
print(model.describe())

# %% [markdown]
# ## In one process
#
# First as in the other tutorials.

# %%
begin = time.perf_counter()
alone = list(papi_nt(problem, config, base))
seconds = {"one process": time.perf_counter() - begin}
for iteration in alone:
    print(f"iteration {iteration.number}: {iteration.reason}")

# %% [markdown]
# ## The same on Ray
#
# `RayWorkers()` without an address starts a cluster on this machine. It can be reached from this machine alone, and has no
# dashboard. With `RayWorkers("10.0.0.1:6379")` it would be a cluster that is running already. In a script write
# `with RayWorkers() as workers:`, which stops Ray at the end, whatever happens inside; here it serves several cells, and
# `workers.close()` stops it.
#
# The recipe is the same, with one more argument.

# %%
workers = RayWorkers(num_workers=WORKERS)
begin = time.perf_counter()
together = list(papi_nt(problem, config, base, workers=workers))
seconds["Ray"] = time.perf_counter() - begin
for iteration in together:
    print(f"iteration {iteration.number}: {iteration.reason}")

# %% [markdown]
# Is it the same? Labels, visited states and batches are functions of seeds and numbers, never of who computes them, or when.
# So the networks must be equal, not almost equal. Each dot is a weight of the last networks.


# %%
def weights(iteration):
    return torch.cat([parameter.detach().flatten() for parameter in iteration.policy.parameters()])


first, second = weights(alone[-1]), weights(together[-1])
figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.4))
some = torch.linspace(0, len(first) - 1, min(3000, len(first))).long()
left.plot(first[some].numpy(), second[some].numpy(), ".", markersize=3, color="#0072b2")
left.set(xlabel="weight, one process", ylabel="weight, Ray", title=f"{len(first):,} weights")
right.barh(list(seconds), list(seconds.values()), color=["#999999", "#0072b2"])
right.set(xlabel=f"time of {ITERATIONS} iterations, s")
plt.show()
print("equal to the last bit:", all(torch.equal(weights(a), weights(b)) for a, b in zip(alone, together, strict=True)))

# %% [markdown]
# On a problem this small, and on two cores, Ray may well be slower: processes must start, and data must be sent. It pays where
# labels take minutes.
#
# That results do not depend on the workers has a use: a run can be begun on a laptop and gone on with on a cluster, and a
# worker that dies costs time but changes nothing: its task is done again, with the same seeds.
#
# ## Parts that do not wait for each other
#
# Above, a part that is done waits until all are. On a cluster of unequal machines that wastes time. `AsynchronousIteration`
# lets every part go on: it labels with whatever networks the others have published by then. The only rule is the bound on
# staleness: a part may be at most so many versions ahead of the last one. With a bound, the theory of asynchronous policy
# iteration applies (Bertsekas and Yu, 2010).

# %%
run = AsynchronousIteration(papi_nt(problem, config, base, workers=workers), staleness=1)
asynchronous = list(run)
workers.close()
print("Ray is running:", ray.is_initialized())
for iteration in asynchronous:
    print(f"iteration {iteration.number}: {iteration.reason}")

# %% [markdown]
# Who published when? On the left a line for each part goes up by one with each version. On the right, by how many versions the
# slowest part was behind when a version was begun.

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6))
colours = ("#000000", "#e69f00", "#56b4e9", "#009e73", "#0072b2", "#d55e00")
for part, name in enumerate(problem.partition.names):
    at = [place + 1 for place, version in enumerate(run.published) if version.part == part]
    numbers = [version.number for version in run.published if version.part == part]
    lift = 0.05 * part  # so that lines do not hide each other
    left.step([0, *at, len(run.published)], [lift, *(n + lift for n in numbers), numbers[-1] + lift], where="post",
              color=colours[part % 6], label=name)  # fmt: skip
left.set(xlabel="publications of all parts so far", ylabel="version", yticks=range(ITERATIONS + 1))
left.legend(fontsize="x-small", title="part")
behind = [version.number - 1 - min(version.used) for version in run.published]
right.bar(range(1, len(behind) + 1), behind, color="#0072b2")
right.axhline(run.staleness, color="#d55e00", linestyle="--", label="the bound")
right.set(xlabel="publication", ylabel="versions ahead of the last part", yticks=range(run.staleness + 1))
right.legend()
plt.show()
print("the bound was kept:", max(behind) <= run.staleness)

# %% [markdown]
# Which networks meet depends on time. So this result is *not* the same when it is made again, and it is the one place in the
# library where that is so. How good is it? The best possible policy gains 19.37 (`planners.solve` shows it).

# %%
ends = {
    "listen": base,
    "one process,\nor Ray": alone[-1].policy,
    "asynchronous": asynchronous[-1].policy,
}
figure, axes = plt.subplots(figsize=(5.5, 3.2))
for number, (name, policy) in enumerate(ends.items()):
    costs = discounted_costs(model, policy, problem.start, num_states=EVALUATION_STATES)
    axes.bar(
        name,
        costs.mean(),
        yerr=1.96 * costs.std() / len(costs) ** 0.5,
        capsize=5,
        color=("#999999", "#0072b2", "#56b4e9")[number],
    )
axes.set(ylabel="discounted cost (below 0: reward)")
axes.set_title(f"{EVALUATION_STATES} trajectories, with 95 % intervals", fontsize="medium")
axes.axhline(0, color="black", linewidth=0.8)
plt.show()

# %% [markdown]
# ## What a cluster gives
#
# This figure was made by `python -m benchmarks scaling`: the costs of labelling, sending and training were measured on two
# cores, and a simulation played a step of policy iteration on larger clusters. It is a prediction, not a measurement.
#
# ![speed-up against workers](../benchmarks/scaling.png)
#
# Labelling scales as far as there are states. Training does not: a part trains on one core. So the number of parts limits the
# speed-up, which is what partitions are for: six parts are done with some 32 workers, a thousand parts use a thousand.
#
# ## Whom you must trust
#
# - Whoever reaches Ray's ports can run code on every machine of the cluster. A cluster that `RayWorkers` starts listens on the
#   loopback address, without a dashboard. A cluster of several machines belongs into a network of its own.
# - What goes between the machines is pickled. What is kept in files never is: run folders and checkpoints are tensors and JSON.
# - All machines need the same versions of this library, torch and numba, and of your own code, and be alike; otherwise
#   "to the last bit" does not hold.
#
# # Where to go on
#
# - `torchrl-pomdp train linear20 --backend ray --workers 8`, or `--address` for a running cluster; add `--out` to be able to
#   go on.
# - More parts: a `FunctionPartition` of your own.
# - Many robots, whose labels take long: tutorial 6. A problem of your own: tutorial 8.
