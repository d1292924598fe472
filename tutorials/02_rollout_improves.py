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
# # Tutorial 2: rollout improves its base policy
#
# *Rollout* takes a simple policy, the *base policy*, and asks at every decision: "what would it cost to take another control
# now, and follow the base policy ever after?" It takes the cheapest control. The claim of the method is that the result is
# never worse than the base policy, and often much better. Here you see it on a pipeline of three locations, which is so small
# that the best possible cost is known.
#
# You will learn
#
# - how to find the optimum of a small problem, and to play its policy next to others;
# - what one-step and two-step lookahead gain, start by start, and how many simulated trajectories they need;
# - how to compare policies with few trajectories: *paired* differences;
# - what happens where simulations are cut early, and what a *terminal cost* is for.
#
# | word | symbol | meaning |
# |---|---|---|
# | base policy | μ | the simple policy that is improved; here greedy: repair where you stand, else walk to the nearest damage |
# | cost | J | expected discounted cost from a state on; lower is better |
# | Q-factor | Q̃(y, u) | cost of control u now and the base policy ever after, estimated by simulation |
# | rollout policy | μ̃ | takes the control with the smallest Q-factor |
# | lookahead | ℓ | number of controls that are chosen freely before the base policy takes over |
# | optimum | J* | no policy costs less |
# | truncation | m | steps of the base policy after which a simulation is cut |
# | terminal cost | Ĵ | what is added at the cut, in place of the rest |
#
# In the paper: Section III.

# %% tags=["parameters"]
PLAYED = 500  # trajectories from each of the five start beliefs, for each policy
SEEDS = 6  # of the simulations
SIMULATED = (1, 2, 3, 4, 8, 16)  # simulated trajectories for each control
CUTS = (1, 2, 3, 4, 6, 8)  # steps after which simulations are cut
RELATIVE_GAP = 0.0005  # how closely the optimum is bounded

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict
from torchrl import logger

from torchrl_pomdp.envs.repair import joint_belief, tabular_model
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import AfterSteps, MultistepLookahead, RolloutPolicy, ZeroCost
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, SteadyStateCost
from torchrl_pomdp.planners import solve
from torchrl_pomdp.problems import make_problem

logger.setLevel("WARNING")
GREY, BLUE, ORANGE, GREEN = "#6b7280", "#0072b2", "#d55e00", "#009e73"  # told apart by the colour-blind, too

problem = make_problem("line3")
model = problem.model
print(model.describe())

# %% [markdown]
# ## The optimum
#
# The robot starts at the left end and sees the damage level there, from 0 (intact) to 4. What lies to the right it does not
# know: all levels are equally likely. So there are five start beliefs, each as likely as another. `tabular_model` writes the
# problem as arrays, and `solve` searches until the optimal cost is known within a small interval.

# %%
some = problem.start(torch.arange(100))
seen = some["belief"][:, 0].argmax(-1)
starts = some[[int((seen == level).nonzero()[0]) for level in range(model.num_levels)]]
solution = solve(tabular_model(model), joint_belief(model, starts), relative_gap=RELATIVE_GAP)
print(f"the optimal cost is between {solution.lower:.2f} and {solution.upper:.2f}, found in {solution.seconds:.1f} s")

# %% [markdown]
# The solution has a policy, too. It reads beliefs over the 375 joint states of the arrays. Any function that writes `"action"`
# into feature states is a policy, so two lines let it play in the repair problem, under the same noise as all others.


# %%
def optimal(y):
    joint = TensorDict({"belief": joint_belief(model, y)}, y.batch_size)
    return y.set("action", solution.policy(joint)["action"])


greedy = GreedyRepair(model)
rollout = RolloutPolicy(model, greedy, trajectories=10)
two_steps = MultistepLookahead(rollout, depth=2)

# %% [markdown]
# ## One decision
#
# The five start beliefs, and what each control would cost: the Q-factors of one-step lookahead (left) and of two-step
# lookahead (right). The control with the lower bar is taken. At level 0 there is nothing to repair, and the robot must move.

# %%
levels = torch.arange(model.num_levels)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True, layout="constrained")
for axis, policy, title in zip(axes, (rollout, two_steps), ("one step, then greedy", "two steps, then greedy"), strict=True):
    q = policy(model.with_features(starts))["q_factors"]
    for control, name, colour, side in ((0, "repair", ORANGE, -0.2), (2, "move right", BLUE, 0.2)):
        legal = q[:, control].isfinite()
        axis.bar((levels + side)[legal], q[legal, control], 0.4, color=colour, label=name)
    axis.set(title=title, xlabel="damage level seen at the start", xticks=levels)
axes[0].set_ylabel("Q-factor (discounted cost)")
axes[0].legend(frameon=False)
plt.show()

# %% [markdown]
# With small damage (levels 1 and 2) it would be better to look at the other locations first, where the damage may be large.
# One-step lookahead does not find this: after one free move greedy takes over, repairs where it is, walks back to the damage that
# it knows, and comes to the right end late. Two-step lookahead may choose the second
# control as well, and then moving is the cheaper way.
#
# ## The proof, start by start
#
# What the policies cost more than the optimal one, at each start belief. All policies meet the same noise. If rollout never
# makes things worse, then no blue point lies above the grey one beside it.


# %%
def costs_of(policy):
    """Costs of played trajectories: a row for each start belief."""
    each = [lambda keys, y=y: y.expand(keys.shape).clone() for y in starts]
    return torch.stack([discounted_costs(model, policy, start, num_states=PLAYED) for start in each])


policies = {"greedy": greedy, "one-step rollout": rollout, "two-step lookahead": two_steps}
costs = {name: costs_of(policy) for name, policy in policies.items()}
best = costs_of(optimal)

figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
looks = {"greedy": (GREY, "s"), "one-step rollout": (BLUE, "o"), "two-step lookahead": (GREEN, "^")}
for shift, (name, (colour, marker)) in zip((-0.15, 0.0, 0.15), looks.items(), strict=True):
    more = [compare(mine, optimum).difference for mine, optimum in zip(costs[name], best, strict=True)]
    bars = [1.96 * each.standard_error for each in more]
    axis.errorbar(levels + shift, [each.mean for each in more], bars, fmt=marker, capsize=3, color=colour, label=name)
axis.axhline(0, color="black", linewidth=1)
axis.set(xlabel="damage level seen at the start", ylabel="cost above the optimum\n(discounted cost)", xticks=levels)
axis.legend(frameon=False)
plt.show()

# %% [markdown]
# The bars are 95 % intervals of paired differences; most are smaller than the markers.
#
# ## How many trajectories?
#
# The mean over the five start beliefs, with more and more simulated trajectories for each control. Few trajectories make noisy
# Q-factors, and the noise depends on the seed of the simulations: each point is the mean over several seeds. The optimum is the
# black line; no policy gets below it.


# %%
def above_optimum(make):
    """Cost of the policies `make(seed)` over the optimal one's, in %, and half of its 95 % interval."""
    mine = torch.stack([costs_of(make(seed)) for seed in range(SEEDS)]).mean(0)
    ratio = compare(mine.flatten(), best.flatten()).ratio
    return 100 * (ratio.mean - 1), 196 * ratio.standard_error


def lookahead(depth, count):
    """Makes lookahead policies with `count` simulated trajectories, from seeds."""
    return lambda seed: MultistepLookahead(RolloutPolicy(model, greedy, trajectories=count, seed=seed), depth)


base = above_optimum(lambda seed: greedy)[0]
print(f"greedy costs {base:.1f} % more than the optimum; with {SIMULATED[-1]} simulated trajectories:")
figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
for name, depth in (("one-step rollout", 1), ("two-step lookahead", 2)):
    mean, half = zip(*[above_optimum(lookahead(depth, count)) for count in SIMULATED], strict=True)
    colour, marker = looks[name]
    axis.errorbar(SIMULATED, mean, half, marker=marker, capsize=3, color=colour, label=name)
    print(f"{name}: {mean[-1]:.1f} % more")
axis.axhline(base, color=GREY, linestyle="--", label="greedy")
axis.axhline(0, color="black", linewidth=1, label="optimum")
axis.set(xscale="log", xlabel="simulated trajectories for each control", ylabel="cost above the optimum (%)")
axis.set_xticks(SIMULATED, [str(count) for count in SIMULATED])
axis.minorticks_off()
axis.legend(frameon=False, ncols=2)
plt.show()

# %% [markdown]
# One-step rollout hardly needs more than one trajectory: all controls of a state are simulated under the same noise, and stage
# costs are expectations under the belief, so that a single trajectory tells good controls from bad ones. Two-step lookahead
# compares costs that are closer together, and wants four. More trajectories do not help: what is left of the distance to the
# optimum is not noise. One-step rollout is *one* step of policy iteration. To go on, take the rollout policy as the next base
# policy; that is [tutorial 3](03_policy_iteration_torchrl.ipynb).
#
# ## Why paired?
#
# Costs differ much between trajectories, since the pipelines differ: some have little damage, some have much. But a bad pipeline
# is bad for every policy. If both policies meet the same pipelines and the same noise, then this part cancels in the difference.

# %%
counts = [count for count in (10, 20, 50, 100, 200, 500, 1000, 2000) if count <= best.numel()]
mixed = torch.randperm(best.numel(), generator=torch.Generator().manual_seed(0))
mine, greedys = (costs[name].flatten()[mixed] for name in ("one-step rollout", "greedy"))
paired = [1.96 * compare(mine[:count], greedys[:count]).difference.standard_error for count in counts]
apart = [1.96 * float((mine[:count].var() / count + greedys[:count].var() / count).sqrt()) for count in counts]
figure, axis = plt.subplots(figsize=(7, 3.4), layout="constrained")
axis.loglog(counts, apart, "s-", color=ORANGE, label="each policy has its own trajectories")
axis.loglog(counts, paired, "o-", color=BLUE, label="paired: the same start and noise")
axis.axhline(float((greedys - mine).mean()), color="black", linestyle=":", label="the gain that is to be seen")
axis.set(xlabel="trajectories of each policy", ylabel="half width of the 95 % interval\n(discounted cost)")
axis.legend(frameon=False)
plt.show()

# %% [markdown]
# An interval proves the gain as soon as its half width is below the dotted line. `compare` is always paired, and
# `discounted_costs` always gives trajectory *i* the same start state and the same noise.
#
# ## Truncation and terminal cost
#
# A simulation need not run to the end. Cut after *m* steps it is cheaper, but the rest is missing, and something must stand for
# it: the terminal cost Ĵ. Three simple ones: nothing at all, the present stage cost for ever (`SteadyStateCost`), or the cost of
# never repairing anything (`NeverRepairCost`).

# %%
figure, axis = plt.subplots(figsize=(7, 3.8), layout="constrained")
ends = {"zero": (ZeroCost(), ORANGE, "s"), "steady state": (SteadyStateCost(model), BLUE, "o")}
ends |= {"never repair": (NeverRepairCost(model), GREEN, "^")}
for name, (terminal_cost, colour, marker) in ends.items():
    found = []
    for m in CUTS:
        rules = {"truncation": AfterSteps(m), "terminal_cost": terminal_cost}
        found.append(above_optimum(lambda seed, rules=rules: RolloutPolicy(model, greedy, trajectories=10, seed=seed, **rules)))
    mean, half = zip(*found, strict=True)
    axis.errorbar(CUTS, mean, half, marker=marker, capsize=3, color=colour, label=f"Ĵ: {name}")
axis.axhline(base, color=GREY, linestyle="--", label="greedy")
axis.axhline(above_optimum(lookahead(1, 10))[0], color=BLUE, linestyle=":", label="rollout to the end")
axis.axhline(0, color="black", linewidth=1, label="optimum")
axis.set(xlabel="m, steps until the cut", ylabel="cost above the optimum (%)", xticks=CUTS)
axis.legend(frameon=False, ncols=2)
plt.show()

# %% [markdown]
# After six steps the robot has been everywhere, and the cut no longer matters: rollout then takes the same controls as with
# simulations to the end, for less work. With earlier cuts the terminal cost decides, and what it is matters more than *m*. Errors
# of Ĵ do not fall steadily with *m*: a policy may be worse than greedy at one *m* and better at the next. That Ĵ = 0 comes close
# to the optimum between 2 and 4 is luck. Only what is won soon counts then, and here that happens to be right.
#
# What helps in general is a better Ĵ: the cost of the base policy itself, which a network can learn from simulations. And cuts at
# the right place: where a part of the problem begins for which Ĵ is good. Both are in tutorial 4.
#
# ## Where to go on
#
# - [Tutorial 3](03_policy_iteration_torchrl.ipynb): rollout again and again, with networks that learn each step.
# - [Tutorial 4](04_partitions_and_truncation.ipynb): cuts that depend on the state, and terminal costs that are learnt.
# - Other base policies: `UrgencyRepair`, or several at once by `ParallelRollout`.
# - Other small problems with known optima: `make_problem("tiger")`, or a file in Cassandra's format by `read_pomdp`; `solve` does
#   the rest.
