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
# # Tutorial 3: policy iteration with TorchRL's parts
#
# Rollout improves its base policy, but it has to simulate at every decision, and it improves only once. *Policy iteration* does
# two things about that: a network learns to imitate the rollout policy, and becomes the next base policy.
#
# ```
#  states ──▶ RolloutImprovement ──▶ replay buffer ──▶ ClassificationLoss ──▶ network
#                   ▲                                                            │
#                   └──────────────── the next base policy ◀─────────────────────┘
# ```
#
# You will learn
#
# - how collector, replay buffer, loss and `Trainer` fit together, and where to hook in;
# - how to see a training in TensorBoard, and how to read what it logged;
# - how a value network learns the cost of a policy;
# - how to get all this in three lines, and how a run that was interrupted goes on.
#
# | word | object | meaning |
# |---|---|---|
# | frame | a row of a batch | one labelled state, not a transition: there is no `"next"` |
# | label | `action`, `q_factors` | the rollout control of a state, and the costs that it compared |
# | cost-to-go | `cost_to_go` | simulated cost of a policy from a state on, what a value network learns |
# | base policy | `collector.policy` | the policy that is simulated |
# | iteration | a batch of the collector | label states, train, make the network the base policy |
#
# In the paper: Section IV. [Tutorial 1](01_policy_iteration.ipynb) is the same without a trainer.

# %% tags=["parameters"]
ITERATIONS = 3
SAMPLES = 5000  # labelled states in each iteration
TRAJECTORIES = 10  # simulated trajectories for each control
OPTIMIZATION_STEPS = 1200  # in each iteration
EVALUATION_STATES = 3000

# %%
# %matplotlib inline
import copy
import time
from functools import partial
from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensordict import TensorDict
from torchrl import logger
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.record import CSVLogger, TensorboardLogger
from torchrl.trainers import DefaultOptimizationStepper, Trainer

from torchrl_pomdp.collectors import PartSampler, PolicyEvaluation, RolloutImprovement, StateMemory, training_states
from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.envs.repair import joint_belief, tabular_model
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import PartitionedPolicy, PolicyCost, PolicyNetwork, RolloutPolicy, ValueNetwork
from torchrl_pomdp.modules.repair import GreedyRepair, RelativeEncoder
from torchrl_pomdp.objectives import ClassificationLoss, ValueLoss
from torchrl_pomdp.planners import solve
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.trainers import PolicyIterationConfig, papi_nt

logger.setLevel("WARNING")
GREY, BLUE, ORANGE, GREEN = "#6b7280", "#0072b2", "#d55e00", "#009e73"  # told apart by the colour-blind, too
runs = Path(mkdtemp(prefix="tutorial-3-"))

# One part, one network; parts are in tutorial 4.
problem = make_problem("line3", partitioned=False)
model, greedy = problem.model, GreedyRepair(problem.model)
encoder = RelativeEncoder(model)

# %% [markdown]
# ## Which states?
#
# A network can only learn what it is shown. Half of the training states are random, so that all is seen that might happen; half
# are states that policies have met, because there it counts. `StateMemory` keeps the latter: a random sample of the states that
# policies visit, bounded in size. A little random play (`exploration`) shows it what happens next to the path. The problem is so small
# that all different states can be kept (`retain=1.0`); in large ones a tenth is enough.

# %%
memory = StateMemory(model, retain=1.0)
memory.visit(greedy, problem.start, torch.arange(2000), exploration=0.15)
print(f"the memory keeps {memory.count(0)} states")

keys = torch.arange(4000)
figure, axis = plt.subplots(figsize=(7, 3.0), layout="constrained")
both = {"random": (problem.training[0], ORANGE, -0.2), "visited by greedy": (memory.generator(0), BLUE, 0.2)}
for name, (generator, colour, side) in both.items():
    damaged = (generator(keys)["belief"][..., 0] < 1).sum(-1)
    share = damaged.bincount(minlength=4) / len(keys)
    axis.bar(torch.arange(4) + side, share, 0.4, color=colour, label=name)
axis.set(xlabel="locations that may be damaged", ylabel="share of the states", xticks=range(4))
axis.legend(frameon=False)
plt.show()

# %% [markdown]
# ## The parts
#
# `RolloutImprovement` is a TorchRL collector: each batch holds labelled states. Its base policy sits in a `PartitionedPolicy`,
# so that it can be exchanged later. Numbers, not random generators, say which states and which noise: run it again, on any
# number of machines, and the labels are the same.


# %%
def states(numbers):
    """The numbered training states, from what the memory holds now."""
    return PartSampler({0: training_states(problem, memory, part=0)}, seed=0)(numbers)


collector = RolloutImprovement(
    BeliefEnv(model, problem.start),
    PartitionedPolicy([greedy]),
    states=states,
    frames_per_batch=SAMPLES,
    total_frames=ITERATIONS * SAMPLES,
    label=partial(RolloutPolicy, trajectories=TRAJECTORIES),
)
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(SAMPLES), batch_size=256, generator=torch.Generator().manual_seed(0))
network = PolicyNetwork(encoder, model.num_controls, generator=torch.Generator().manual_seed(0))
loss = ClassificationLoss(network)
optimizer = torch.optim.RMSprop(loss.parameters(), lr=1e-3)

# %% [markdown]
# ## The trainer
#
# One batch of the collector is one policy iteration. Hooks do the rest:
#
# | when | what |
# |---|---|
# | `batch_process` | the labels of the last iteration are forgotten, the new ones go into the buffer |
# | `process_optim_batch` | each optimisation step draws a batch from the buffer |
# | `post_steps` | a copy of the network becomes the base policy; the memory sees where it goes |
# | `post_steps_log` | the new policy is compared with greedy, from the same start states under the same noise |
#
# The trainer logs once for each batch. A loss curve wants more points, so the optimisation step logs by itself. It also lets the
# step size fall.


# %%
class LoggedStep(DefaultOptimizationStepper):
    """An optimisation step with a falling step size; every 25th one logs the outputs of the loss module."""

    def __init__(self, optimizer, steps):
        super().__init__()
        self.schedule, self.count = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total_iters=steps), 0

    def step(self, trainer, sub_batch):
        outputs = super().step(trainer, sub_batch).detach()
        self.schedule.step()
        self.count += 1
        if self.count % 25 == 0:
            for key in trainer.loss_module.out_keys:
                trainer.logger.log_scalar(f"train/{key}", outputs[key].item(), step=self.count)
        return outputs


def fill(batch):
    buffer.empty()
    buffer.extend(batch)
    return batch


def promote():
    collector.policy.policies[0] = copy.deepcopy(network)
    memory.visit(network, problem.start, torch.arange(2000), exploration=0.15)


greedy_costs = discounted_costs(model, greedy, problem.start, num_states=EVALUATION_STATES)
comparisons = []


def evaluate(batch):
    costs = discounted_costs(model, collector.policy, problem.start, num_states=EVALUATION_STATES)
    comparisons.append(compare(costs, greedy_costs))
    return {"eval/cost": comparisons[-1].cost.mean, "eval/ratio": comparisons[-1].ratio.mean}


board = TensorboardLogger("by_hand", log_dir=str(runs))
trainer = Trainer(
    collector=collector,
    total_frames=ITERATIONS * SAMPLES,
    frame_skip=1,
    optim_steps_per_batch=OPTIMIZATION_STEPS,
    loss_module=loss,
    optimizer=optimizer,
    optimization_stepper=LoggedStep(optimizer, ITERATIONS * OPTIMIZATION_STEPS),
    logger=board,
    log_interval=1,
    progress_bar=False,
)
trainer.register_op("batch_process", fill)
trainer.register_op("process_optim_batch", lambda batch: buffer.sample())
trainer.register_op("post_steps", promote)
trainer.register_op("post_steps_log", evaluate)
trainer.train()
for number, comparison in enumerate(comparisons, 1):
    print(f"iteration {number}: cost {comparison.ratio.mean:.3f} of greedy's")

# %% [markdown]
# ## TensorBoard
#
# `tensorboard --logdir FOLDER` shows the curves while a training runs. The same files can be read in Python:


# %%
def curve(name):
    """Steps and values of a scalar in TensorBoard's files."""
    events = EventAccumulator(str(runs / "by_hand")).Reload()
    return zip(*((event.step, event.value) for event in events.Scalars(name)), strict=True)


figure, axes = plt.subplots(1, 3, figsize=(10, 3), layout="constrained")
labels = {"train/loss_policy": "loss", "train/accuracy": "share of labels matched", "train/regret": "regret (cost)"}
for axis, (name, label) in zip(axes, labels.items(), strict=True):
    axis.plot(*curve(name), color=BLUE)
    for number in range(1, ITERATIONS):
        axis.axvline(number * OPTIMIZATION_STEPS, color=GREY, linestyle=":")
    axis.set(xlabel="optimisation step", ylabel=label)
plt.show()

# %% [markdown]
# Dotted lines: a new iteration begins, with new labels; there the loss jumps up, for the network has yet to learn them. *Regret* is what a wrong control costs more than the label. It says
# more than the share of labels matched: where two controls cost nearly the same, it does not matter which one is taken.
#
# ## Does it work?
#
# Rollout of greedy improves once, to the dotted line. Policy iteration goes on. The optimum is known, as in
# [tutorial 2](02_rollout_improves.ipynb): its policy plays the same start states.


# %%
def ratio_to_greedy(policy):
    return compare(discounted_costs(model, policy, problem.start, num_states=EVALUATION_STATES), greedy_costs).ratio.mean


solution = solve(tabular_model(model), joint_belief(model, problem.start(torch.arange(100))).unique(dim=0), relative_gap=0.001)


def optimal(y):
    joint = TensorDict({"belief": joint_belief(model, y)}, y.batch_size)
    return y.set("action", solution.policy(joint)["action"])


known = {"rollout of greedy": (ratio_to_greedy(RolloutPolicy(model, greedy, trajectories=TRAJECTORIES)), ORANGE, ":")}
known["optimum"] = (ratio_to_greedy(optimal), "black", "-")


def draw(axis, comparisons, label, colour, marker):
    """Ratio to greedy by iteration; iteration 0 is greedy."""
    means = [1.0, *(each.ratio.mean for each in comparisons)]
    halves = [0.0, *(1.96 * each.ratio.standard_error for each in comparisons)]
    axis.errorbar(range(len(means)), means, halves, marker=marker, capsize=4, color=colour, label=label)


def frame(axis):
    for name, (ratio, colour, style) in known.items():
        axis.axhline(ratio, color=colour, linestyle=style, label=name)
    axis.set(xlabel="policy iteration", ylabel="cost, ratio to greedy", xticks=range(ITERATIONS + 1))
    axis.legend(frameon=False)


figure, axis = plt.subplots(figsize=(7, 3.4), layout="constrained")
draw(axis, comparisons, "by hand", BLUE, "o")
frame(axis)
plt.show()

# %% [markdown]
# ## A value network
#
# A policy's cost can be learnt in the same way. `PolicyEvaluation` labels states with simulated costs, `ValueLoss` is the
# regression. Costs differ by orders of magnitude, so the network gives multiples of a known cost: that of never repairing.

# %%
evaluation = PolicyEvaluation(
    BeliefEnv(model, problem.start),
    collector.policy,
    states=states,
    frames_per_batch=SAMPLES,
    total_frames=SAMPLES,
)
scale = problem.pessimistic_cost
value = ValueNetwork(encoder, scale, generator=torch.Generator().manual_seed(1))
value_loss = ValueLoss(value, scale)
value_optimizer = torch.optim.RMSprop(value_loss.parameters(), lr=1e-3)
value_trainer = Trainer(
    collector=evaluation,
    total_frames=SAMPLES,
    frame_skip=1,
    optim_steps_per_batch=OPTIMIZATION_STEPS,
    loss_module=value_loss,
    optimizer=value_optimizer,
    optimization_stepper=LoggedStep(value_optimizer, OPTIMIZATION_STEPS),
    logger=TensorboardLogger("value", log_dir=str(runs)),
    progress_bar=False,
)
value_trainer.register_op("batch_process", fill)
value_trainer.register_op("process_optim_batch", lambda batch: buffer.sample())
value_trainer.train()

# %% [markdown]
# Does it know the costs of states that it has not seen? Each point is a fresh state; the simulated cost is the mean of 100
# trajectories.

# %%
fresh = model.with_features(states(SAMPLES + torch.arange(300)))
simulated = PolicyCost(model, collector.policy, trajectories=100).costs(fresh)
with torch.no_grad():
    predicted = value(fresh)["state_value"]
error = float((predicted - simulated).abs().sum() / simulated.sum())
print(f"mean error of the value network: {error:.1%} of the mean cost")

figure, axis = plt.subplots(figsize=(4.6, 4.2), layout="constrained")
axis.plot(simulated, predicted, ".", color=GREEN, alpha=0.6)
axis.axline((0, 0), slope=1, color="black", linewidth=1)
axis.set(xlabel="simulated cost (discounted)", ylabel="cost by the network (discounted)", aspect="equal")
plt.show()

# %% [markdown]
# Such a network is a *terminal cost*: simulations can be cut where it takes over, `RolloutPolicy(…, truncation=AfterSteps(5),
# terminal_cost=value)`. [Tutorial 4](04_partitions_and_truncation.ipynb) does that.
#
# ## The same in three lines
#
# `papi_nt` is policy iteration for any problem and any number of parts. It has all of the above, and three things more: the step
# size falls within each iteration; mirror images of labelled states are labelled states, too; and a policy is *accepted*
# only if it is better with 95 % confidence, so that a failed iteration cannot do harm.

# %%
config = PolicyIterationConfig(
    iterations=ITERATIONS,
    samples_per_part=SAMPLES,
    trajectories=TRAJECTORIES,
    least_steps=OPTIMIZATION_STEPS,
    epochs=1,
    validation_states=EVALUATION_STATES,
)
folder, log = runs / "papi_nt", CSVLogger("papi_nt", log_dir=str(runs / "csv"))

seconds, begin = [], time.perf_counter()
for iteration in papi_nt(problem, config, greedy, folder=folder, logger=log):
    seconds.append(time.perf_counter() - begin)
    print(f"iteration {iteration.number}: {iteration.reason}")
    break  # here somebody pulls the plug
print("kept:", *sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()))

# %% [markdown]
# ## Going on where it stopped
#
# With a `folder` every trained network and every block of labels is kept as soon as it is there. The same lines again go on
# from there, in a new process as well, and give what an uninterrupted run would have given.

# %%
run = papi_nt(problem, config, greedy, folder=folder, logger=log)
by_trainer, again = [], []
begin = time.perf_counter()
for iteration in run:
    again.append(time.perf_counter() - begin)
    costs = discounted_costs(model, iteration.policy, problem.start, num_states=EVALUATION_STATES)
    by_trainer.append(compare(costs, greedy_costs))
    print(f"iteration {iteration.number}: {'accepted' if iteration.accepted else 'rejected'}, {iteration.reason}")
    begin = time.perf_counter()
print(f"iteration 1 took {seconds[0]:.1f} s before and {again[0]:.1f} s now: it was read from the folder")

figure, axis = plt.subplots(figsize=(7, 3.4), layout="constrained")
draw(axis, comparisons, "by hand", BLUE, "o")
draw(axis, by_trainer, "papi_nt", GREEN, "^")
frame(axis)
plt.show()

# %% [markdown]
# The second run has read iteration 1 and carried out the others. Both ways end at the optimum, within their intervals.
#
# The logs of `papi_nt` are written by TorchRL's `CSVLogger`, a file for each part and output; any logger of TorchRL will do.

# %%
for path in sorted((runs / "csv").rglob("accuracy.csv")):
    rows = [line.split(",") for line in path.read_text().splitlines()]
    print(path.relative_to(runs / "csv").parent, "- last accuracy", f"{float(rows[-1][1]):.2f}" if rows else "-")

# %% [markdown]
# ## Where to go on
#
# - Any other problem works the same way; `make_problem("linear20", partitioned=False)` takes some minutes.
# - [Tutorial 4](04_partitions_and_truncation.ipynb): one network for each part of the states, and simulations that are cut.
# - `papi_nt(…, workers=RayWorkers())` labels and trains on a cluster, with the same result.
# - `save_checkpoint` writes a trained policy with its problem into one file; `Controller` plays it on a robot.
# - `torchrl-pomdp train line3` does all this from the command line.
