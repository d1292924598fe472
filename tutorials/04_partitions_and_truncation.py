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
# # Tutorial 4: partitions and truncation
#
# One network for all states has to know everything at once. A *partition* divides the states into parts, and each part gets a
# network of its own, which has less to learn. *Truncation* cuts simulations short, which saves time; what is cut off is replaced
# by a *terminal cost*. The two belong together: where one part leads into another, the value network of that part is the
# terminal cost.
#
# You will learn
#
# - how to write a partition of your own, and how to check it;
# - which rules cut simulations: `AfterSteps`, `OnEntering`, `OnLeaving`;
# - what cuts buy in time and what they cost, measured;
# - policy iteration with parts, without truncation (pAPI-NT) and with it (pAPI-T).
#
# | word | object | meaning |
# |---|---|---|
# | part | `y["partition"]` | the number of the set of states in which y lies |
# | stage | `partition.stages` | parts that are trained together; a stage leads only to itself and to earlier ones |
# | startgame, endgame | parts 0 and 1 here | much may be damaged; little may be damaged |
# | m | `truncation=…` | steps after which a simulation is cut; it may depend on the state |
# | terminal cost Ĵ | `terminal_cost=…` | what is added at the cut, discounted: α^m Ĵ |
#
# In the paper: Sections III, V and VI-B.

# %% tags=["parameters"]
LOCATIONS = 8
PLAYED = 150  # start states for each evaluation
CHECKED = 500  # start states for the check of a partition
SAMPLES = 1500  # labelled states for each part and network
OPTIMIZATION_STEPS = 800  # for each network
CUTS = (1, 3, 8, 20)  # steps after which simulations are cut

# %%
# %matplotlib inline
import time

import matplotlib.pyplot as plt
import torch
from torchrl import logger

from torchrl_pomdp.envs import BeliefEnv, FunctionPartition
from torchrl_pomdp.envs.repair import damage_chain, line
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import AfterSteps, OnEntering, OnLeaving, PartitionedPolicy, RolloutPolicy
from torchrl_pomdp.modules.repair import GreedyRepair, SteadyStateCost
from torchrl_pomdp.problems import check_partition, repair_problem
from torchrl_pomdp.trainers import Evaluate, PolicyIteration, PolicyIterationConfig, papi_nt, papi_t, r_t

logger.setLevel("WARNING")
GREY, BLUE, ORANGE, GREEN = "#6b7280", "#0072b2", "#d55e00", "#009e73"  # told apart by the colour-blind, too


def pipeline(partition):
    """A pipeline with the paper's damage and costs, and a partition."""
    return repair_problem(
        line(LOCATIONS), damage_chain((0.0, 0.02, 0.03, 0.05)), (0.0, 0.1, 1.0, 10.0, 100.0), 0.99, partition=partition
    )


# %% [markdown]
# ## A partition of your own
#
# A function of feature states is enough. Here: may half of the locations or more be damaged, or fewer? What was repaired stays
# intact, so the number of doubtful locations never grows: startgame states lead to endgame states, but never back. So the
# endgame is trained first. That is what `stages` says: part 1, then part 0.


# %%
def phase(y):
    doubtful = (y["belief"][..., 0] < 1).sum(-1)
    return (doubtful < y["belief"].shape[-2] / 2).long()


partition = FunctionPartition(("startgame", "endgame"), phase, stages=((1,), (0,)))
problem = pipeline(partition)
model, greedy = problem.model, GreedyRepair(problem.model)
print(check_partition(model, problem.start, num_states=CHECKED))

# %% [markdown]
# `check_partition` plays and counts. Every part must occur, and no transition may lead to a later stage. Now one that looks
# just as good, but is not: is the robot in the left or in the right half? Robots walk back.

# %%
sides = FunctionPartition(("left", "right"), lambda y: (y["location"][..., 0] >= LOCATIONS // 2).long(), stages=((1,), (0,)))
wrong = pipeline(sides)
reports = {
    "phase": check_partition(model, problem.start, num_states=CHECKED),
    "sides": check_partition(wrong.model, wrong.start, num_states=CHECKED),
}
print(reports["sides"])

figure, axes = plt.subplots(1, 2, figsize=(8, 3.4), layout="constrained")
for axis, (name, report) in zip(axes, reports.items(), strict=True):
    moves = torch.tensor(report.transitions, dtype=torch.float)
    axis.imshow(moves / moves.sum(), cmap="Blues", vmin=0, vmax=0.8)
    for i, row in enumerate((100 * moves / moves.sum()).tolist()):
        for j, percent in enumerate(row):
            bad = (report.names[i], report.names[j]) in report.violations
            text = f"{percent:.1f} %" + ("\nto a later stage" if bad else "")
            axis.text(j, i, text, ha="center", va="center", color=ORANGE if bad else "white" if percent > 40 else "black")
    axis.set_xticks(range(2), report.names)
    axis.set_yticks(range(2), report.names)
    axis.set(title=f"partition by {name}", xlabel="part after the step", ylabel="part before the step")
plt.show()

# %% [markdown]
# Share of the steps that lead from one part to another. A partition with steps to a later stage can still be used: put all its
# parts into one stage (the default), where they are trained together.
#
# What the parts look like on a trajectory of greedy:

# %%
with torch.no_grad():
    trajectory = BeliefEnv(model, problem.start, seed=1).rollout(60, greedy)
cost = -trajectory["next", "reward"][:, 0]
stages = torch.arange(len(cost))
figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
for part, (name, colour) in enumerate(zip(partition.names, (ORANGE, BLUE), strict=True)):
    mine = trajectory["partition"] == part
    axis.bar(stages[mine], cost[mine], 1.0, color=colour, label=name)
axis.set(xlabel="stage", ylabel="expected cost of the stage")
axis.legend(frameon=False)
plt.show()

# %% [markdown]
# ## A terminal cost
#
# Each cut needs a terminal cost. A simple one is the present stage cost for ever, `SteadyStateCost`. A better one is the cost of
# the base policy itself, learnt by value networks, one for each part. The plan of an iteration may be a single `Evaluate` step:
# nothing is improved, the networks learn what greedy costs.

# %%
config = PolicyIterationConfig(
    iterations=1,
    samples_per_part=SAMPLES,
    value_samples=SAMPLES,
    least_steps=OPTIMIZATION_STEPS,
    epochs=1,
    validation_states=PLAYED,
)
(evaluated,) = PolicyIteration(problem, config, greedy, [Evaluate((0, 1))])
learnt = evaluated.value
for name, record in evaluated.records.items():
    print(f"{name}: relative error {record.losses['relative_error']:.1%}")

# %% [markdown]
# ## What a cut buys and what it costs
#
# Rollout of greedy with simulations that are cut in different ways. To the left is cheap, down is good.
#
# | rule | cuts |
# |---|---|
# | `AfterSteps(m)` | after m steps, wherever the robot is |
# | `OnEntering((1,))` | as soon as the simulation is in the endgame, also at once where it starts there |
# | `OnLeaving()` | as soon as it is in another part than where it started |
#
# `r_t`, the paper's R-T, cuts on entering the endgame as well, but not the simulations that start there.
#
# Rules are joined by `|`: `OnLeaving() | AfterSteps(20)` cuts at what comes first.

# %%
greedy_costs = discounted_costs(model, greedy, problem.start, num_states=PLAYED)


def play(policy):
    """Ratio of a rollout policy's cost to greedy's, half of its 95 % interval, and simulated steps for each decision."""
    decisions, begin = 0, time.perf_counter()

    def counted(y):
        nonlocal decisions
        decisions += len(y)
        return policy(y)

    ratio = compare(discounted_costs(model, counted, problem.start, num_states=PLAYED), greedy_costs).ratio
    milliseconds = 1000 * (time.perf_counter() - begin) / decisions
    local = set(policy.policies) if isinstance(policy, PartitionedPolicy) else {policy}
    steps = sum(each.simulated_steps for each in local) / decisions
    return ratio.mean, 1.96 * ratio.standard_error, steps, milliseconds


def rollout(**cut):
    return RolloutPolicy(model, greedy, trajectories=4, **cut)


figure, axis = plt.subplots(figsize=(8, 4.2), layout="constrained")
ends = {"steady state": (SteadyStateCost(model), ORANGE, "s"), "value networks": (learnt, BLUE, "o")}
for name, (terminal_cost, colour, marker) in ends.items():
    found = [play(rollout(truncation=AfterSteps(m), terminal_cost=terminal_cost)) for m in CUTS]
    ratio, half, steps, _ = zip(*found, strict=True)
    axis.errorbar(steps, ratio, half, marker=marker, capsize=3, color=colour, label=f"after m steps, Ĵ: {name}")
    for m, x, height in zip(CUTS, steps, ratio, strict=True):
        axis.annotate(f"m={m}", (x, height), (4, 5), textcoords="offset points", fontsize="small", color=colour)
others = {
    "to the end": rollout(),
    "on entering the endgame": rollout(truncation=OnEntering((1,)), terminal_cost=learnt),
    "on leaving the part": rollout(truncation=OnLeaving(), terminal_cost=learnt),
    "R-T": r_t(problem, greedy, learnt, trajectories=4),
}
for (name, policy), marker, colour in zip(others.items(), "D^vP", ("black", GREEN, GREEN, GREEN), strict=True):
    ratio, half, steps, milliseconds = play(policy)
    axis.errorbar([steps], [ratio], [half], fmt=marker, markersize=8, capsize=3, color=colour, label=name)
    print(f"{name}: {ratio:.3f} of greedy's cost, {steps:.0f} simulated steps and {milliseconds:.2f} ms for each decision")
axis.axhline(1.0, color=GREY, linestyle="--", label="greedy")
axis.set(xscale="log", yscale="log", xlabel="simulated steps for each decision", ylabel="cost, ratio to greedy")
axis.set_xticks((5, 10, 20, 50, 100), ("5", "10", "20", "50", "100"))
axis.set_yticks((0.8, 1, 1.2, 1.5, 2, 3, 5, 8), ("0.8", "1", "1.2", "1.5", "2", "3", "5", "8"))
axis.minorticks_off()
axis.legend(frameon=False, fontsize="small")
plt.show()

# %% [markdown]
# What the terminal cost is matters more than where the cut is. With value networks, three steps are enough to beat greedy; with the
# steady-state cost, eight are not.
#
# Cutting on entering the endgame is the cheapest rule, and a bad one: a decision in the endgame is then cut at once and rests on Ĵ
# alone, whose small errors let the robot walk back and forth. R-T leaves the endgame uncut. It needs half of the simulated steps,
# and its cost is within the intervals of simulations to the end.
#
# Steps are not time. Here, simulations to the end run in a compiled loop, while cut ones stop to ask networks, and rules that read a
# partition of your own are not compiled: see the milliseconds above. Cuts pay where the simulated steps are what is dear, as in
# simulations with large networks as base policy. So measure on your problem.
#
# ## Policy iteration with parts
#
# Both algorithms train the endgame first. pAPI-NT simulates to the end. pAPI-T cuts the simulations of the startgame where they
# enter the endgame, and adds what the value network of the endgame says. Their plans:

# %%
runs = {"pAPI-NT": papi_nt(problem, config, greedy), "pAPI-T": papi_t(problem, config, greedy)}
for name, run in runs.items():
    print(name, [(type(step).__name__, [partition.names[part] for part in step.parts]) for step in run.plan])

ratios, label_steps = {}, {}
for name, run in runs.items():
    (iteration,) = run
    ratios[name] = compare(discounted_costs(model, iteration.policy, problem.start, num_states=PLAYED), greedy_costs).ratio
    startgame = next(record for key, record in iteration.records.items() if "improve-part-0" in key)
    label_steps[name] = startgame.simulated_steps / startgame.samples
    print(f"{name}: {label_steps[name]:.0f} simulated steps for a startgame label, cost {ratios[name].mean:.3f} of greedy's")

figure, axes = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
axes[0].bar(list(label_steps), list(label_steps.values()), color=[BLUE, GREEN], width=0.6)
axes[0].set_ylabel("simulated steps\nfor a startgame label")
for x, ratio in enumerate(ratios.values()):
    axes[1].errorbar([x], [ratio.mean], [1.96 * ratio.standard_error], fmt="o", capsize=5, color=(BLUE, GREEN)[x])
axes[1].axhline(1.0, color=GREY, linestyle="--")
axes[1].set_xticks(range(2), list(ratios))
axes[1].set(ylabel="cost, ratio to greedy", xlim=(-0.6, 1.6))
plt.show()

# %% [markdown]
# pAPI-T simulates a third of the steps for a startgame label. Its policy costs a little more here, by less than the intervals
# can tell. The longer the endgame, the more there is to save.
#
# ## Where to go on
#
# - The paper's six parts, startgame and endgame with the damage left, right or balanced, come with the problem:
#   `make_problem("linear20").partition`.
# - m that depends on the state: `AfterSteps(lambda y: torch.where(y["partition"] == 0, 20, 5))`.
# - A plan of your own: `PolicyIteration(problem, config, base, [Evaluate((1,)), Improve((0,), OnEntering((1,)))])`.
# - `AsynchronousIteration`: parts that improve at their own pace.
# - A partition is saved in no file: give the problem to `load_checkpoint(…, problem=problem)`.
