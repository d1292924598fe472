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
# # Tutorial 5: POMCP, DESPOT and PPO beside rollout
#
# **What you will learn**
#
# 1. to train TorchRL's own PPO on a belief environment, as on any other environment;
# 2. to plan with two tree searches, POMCP and DESPOT;
# 3. to compare methods fairly: same start states, same noise, and cost against the *time of a decision*.
#
# | word | in the library | meaning |
# |---|---|---|
# | rollout | `RolloutPolicy` | one step of lookahead, simulations of a base policy from there |
# | POMCP | `planners.POMCP` | simulations grow a tree of what may be done and seen (Silver and Veness, 2010) |
# | DESPOT | `planners.DESPOT` | a tree over a few fixed scenarios, searched by bounds (Somani and others, 2013) |
# | PPO | TorchRL's `ClipPPOLoss` | a policy gradient method; learns from trajectories, plans nothing |
# | paired interval | `compare` | interval of a difference or ratio, start state by start state: much narrower than a cost's |
#
# The tree searches and the fast rollout are compiled by numba: the extra *fast*.

# %% tags=["parameters"]
UPDATES = 30
EVALUATION_STATES = 2000
STATES = 100
BUDGETS = [2, 8, 32]
LARGE_STATES = 15
LARGE_BUDGETS = [5, 40]

# %%
# %matplotlib inline
import time
from statistics import median

import matplotlib.pyplot as plt
import torch
from matplotlib.ticker import LogLocator
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl import logger
from torchrl.collectors import Collector
from torchrl.envs import RewardScaling, TransformedEnv
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import FlatEncoder, PolicyNetwork, RolloutPolicy
from torchrl_pomdp.planners import DESPOT, POMCP
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.report import Result, table

logger.setLevel("WARNING")
plt.rcParams["figure.constrained_layout.use"] = True
STYLE = {  # colours that differ for the colour-blind too, and a marker for each
    "rollout": ("o", "#0072b2"),
    "POMCP": ("s", "#d55e00"),
    "POMCP, random play": ("D", "#e69f00"),
    "DESPOT": ("^", "#009e73"),
    "PPO": ("*", "#cc79a7"),
}

problem = make_problem("line3")
model, greedy = problem.model, problem.base_policies["greedy"]
OPTIMUM = 168.97  # by planners.solve of envs.repair.tabular_model: the best cost that any policy can have here
print(model.describe())

# %% [markdown]
# ## PPO
#
# `BeliefEnv` is a TorchRL environment like any other, so TorchRL's PPO runs on it. `PolicyNetwork.actor()` draws controls
# among those that `"action_mask"` says are legal. Nothing below is special to this library but the environment and the
# network; `trainers.ppo` does the same with more care, for large problems.

# %%
torch.manual_seed(0)  # of PPO's own draws
env = TransformedEnv(BeliefEnv(model, problem.start, batch_size=(64,), seed=0), RewardScaling(0.0, 0.01))
encoder = FlatEncoder(model)
ppo = PolicyNetwork(encoder, model.num_controls, (64, 64), generator=torch.Generator().manual_seed(0))
actor = ppo.actor()


class Critic(TensorDictModuleBase):
    in_keys, out_keys = list(encoder.keys), ["state_value"]

    def __init__(self):
        super().__init__()
        self.network = nn.Sequential(nn.Linear(encoder.num_features, 64), nn.ReLU(), nn.Linear(64, 1))

    def forward(self, tensordict):
        return tensordict.set("state_value", self.network(encoder(tensordict)))


critic = Critic()
loss = ClipPPOLoss(actor, critic, entropy_coeff=0.01)
advantage = GAE(gamma=model.discount, lmbda=0.95, value_network=critic)
optimizer = torch.optim.Adam(loss.parameters(), 1e-3)

# %% [markdown]
# Rewards are minus the expected stage costs. Policies are compared by *discounted* cost, which is not the return of an episode
# that PPO would log; so the curve is evaluated separately.


# %%
def costs_of(problem, policy, states):
    return discounted_costs(problem.model, policy, problem.start, num_states=states)


steps = 64 * 32  # of an update
learnt = {0: float(costs_of(problem, ppo, EVALUATION_STATES).mean())}
batches = Collector(env, actor, frames_per_batch=steps, total_frames=steps * UPDATES, auto_register_policy_transforms=False)
for number, batch in enumerate(batches, 1):
    for _ in range(4):
        with torch.no_grad():
            advantage(batch)
        rows = batch.reshape(-1)
        for part in torch.randperm(rows.shape[0]).split(256):
            losses = loss(rows[part])
            total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
            optimizer.zero_grad()
            total.backward()
            optimizer.step()
    if number % 5 == 0 or number == UPDATES:
        learnt[number * steps] = float(costs_of(problem, ppo, EVALUATION_STATES).mean())
batches.shutdown()

baseline = costs_of(problem, greedy, EVALUATION_STATES)
figure, axes = plt.subplots(figsize=(6, 3.2))
axes.semilogy(list(learnt), list(learnt.values()), marker="*", color=STYLE["PPO"][1], label="PPO")
axes.axhline(float(baseline.mean()), linestyle="--", color="black", label="greedy, which learns nothing")
axes.axhline(OPTIMUM, color="#999999", label="optimum")
axes.set(xlabel="belief steps that PPO has seen", ylabel="discounted cost")
axes.legend()
plt.show()

# %% [markdown]
# ## Planners
#
# All three planners simulate from the present belief, and differ in what they do with simulations. We give each a budget, from
# a few simulations to many, and the same base policy, greedy. For POMCP there is also a second line: with random play in place
# of the base policy, as it comes out of the box.


# %%
def planners(problem, budget):
    """The methods with a budget: trajectories of each control, simulations of the tree, scenarios."""
    model, base = problem.model, problem.base_policies["greedy"]
    return {
        "rollout": RolloutPolicy(model, base, trajectories=budget),
        "POMCP": POMCP(model, base, simulations=4 * budget),
        "POMCP, random play": POMCP(model, None, simulations=4 * budget),
        "DESPOT": DESPOT(model, base, scenarios=budget, simulations=budget),
    }


def milliseconds(problem, policy):
    """Median time of a decision for a single state, as the processor counts it."""
    y, times = problem.model.with_features(problem.start(torch.arange(16))), []
    with torch.no_grad():
        for number in range(16):
            begin = time.process_time()
            policy(y[number : number + 1].clone())
            times.append(1000 * (time.process_time() - begin))
    return median(times[1:])  # the first decision may compile


def measure(problem, budgets, states):
    """By method: for each budget the time of a decision and the costs."""
    found = {}
    for budget in budgets:
        for name, policy in planners(problem, budget).items():
            found.setdefault(name, []).append((milliseconds(problem, policy), costs_of(problem, policy, states)))
    return found


def draw(found, baseline, title):
    """Ratio to greedy, with paired 95 % intervals, against the time of a decision: down and to the left is better."""
    figure, axes = plt.subplots(figsize=(7.5, 4.2))
    for name, points in found.items():
        marker, colour = STYLE[name]
        ratios = [compare(costs, baseline).ratio for _, costs in points]
        axes.errorbar(
            [ms for ms, _ in points],
            [ratio.mean for ratio in ratios],
            yerr=[1.96 * ratio.standard_error for ratio in ratios],
            marker=marker,
            color=colour,
            capsize=3,
            label=name,
        )
    axes.axhline(1.0, linestyle="--", color="black", label="greedy")
    axes.set(xscale="log", xlabel="time of a decision, ms", ylabel="cost, ratio to greedy")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.set_title(title, fontsize="medium")
    return figure, axes


baseline = baseline[:STATES]  # start states are numbered, so these are the same ones
found = measure(problem, BUDGETS, STATES)
found["PPO"] = [(milliseconds(problem, ppo), costs_of(problem, ppo, STATES))]
figure, axes = draw(found, baseline, f"line of 3, {STATES} start states")
figure.legend(loc="outside right upper", fontsize="small")
plt.show()
last = {"greedy": baseline} | {name: points[-1][1] for name, points in found.items()}
print(f"PPO over {EVALUATION_STATES} start states: {list(learnt.values())[-1]:.1f}; the optimum: {OPTIMUM}")
print(table([Result(name, compare(costs, baseline)) for name, costs in last.items()]))

# %% [markdown]
# How to read it. Each point is a method with a budget; the table has the largest ones.
#
# - **DESPOT and PPO are better than rollout here**: they reach the optimum. Rollout looks one step ahead, and then greedy goes
#   on; so it is better than greedy, but more trajectories do not make it better still. Its way to the optimum is to do it
#   again, with the improved policy as base policy: that is policy iteration, and tutorial 1 reaches the optimum so.
# - **Rollout is the fastest planner**: less than a millisecond.
# - **PPO** decides by a single network evaluation. It had to see some forty thousand belief steps first, and would have to see
#   them again for another problem.
# - **POMCP** with greedy comes as far as rollout at these budgets. With random play it starts worse than greedy.
#
# ## A problem with 10¹⁵ states
#
# The same on a line of twenty locations. PPO is not here: it takes a million belief steps to cost 0.95 of what greedy does,
# and two million for 0.90 (`trainers.ppo` says so in its documentation), which is more than a tutorial has time for.

# %%
large = make_problem("linear20")
large_baseline = costs_of(large, large.base_policies["greedy"], LARGE_STATES)
large_found = measure(large, LARGE_BUDGETS, LARGE_STATES)
figure, axes = draw(large_found, large_baseline, f"line of 20, {LARGE_STATES} start states")
figure.legend(loc="outside right upper", fontsize="small")
plt.show()
last = {"greedy": large_baseline} | {name: points[-1][1] for name, points in large_found.items()}
print(table([Result(name, compare(costs, large_baseline)) for name, costs in last.items()]))

# %% [markdown]
# - **Random play is hopeless here**: it is so costly that the tree learns about random play. Most of what a planner is worth
#   is its base policy.
# - With greedy, all three are better than greedy. DESPOT has the lowest mean, and takes more than ten times as long as rollout.
# - Where intervals overlap nothing can be said about which of two methods is better. Take more start states before you choose:
#   intervals shrink with the square root of their number.
#
# # Where to go on
#
# - `torchrl-pomdp compare linear20 --states 100 --seconds 0.02` gives every method the same *time* for a decision, and keeps
#   what it has measured; `--checkpoint` adds a trained policy and PPO with as many belief steps as its labels took.
# - `trainers.ppo(problem, steps=2_000_000)` is PPO for large problems.
# - Networks that imitate rollout decide as fast as PPO's, and are trained with the model: tutorials 1 and 3.
# - Your own problem: tutorial 8. The tree searches need arrays (`TabularModel`) or a repair problem; rollout and PPO take any
#   belief model.
