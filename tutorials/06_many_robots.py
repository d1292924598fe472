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
# # Tutorial 6: many robots on a network, and a model that changes
#
# **What you will learn**
#
# 1. why many robots are hard, and how one robot deciding after the other makes it easy;
# 2. what that costs when the robots cannot wait for each other, and how a network that they share helps;
# 3. what to do on the day when a robot is lost or a way is blocked: rollout, with the old policy as its base.
#
# The method is that of the paper's Section II and of its follow-up, arXiv:2011.04222.
#
# | word | in the library | meaning |
# |---|---|---|
# | joint control *u* | `"action"` | what all robots do at a stage: repair, or move to a neighbour |
# | agent | one robot | chooses one of A controls of its own; R agents have A^R joint controls |
# | base policy | `GreedyRepair` | each robot repairs where it stands, or goes to the nearest location that may be damaged |
# | one at a time | `MultiagentRollout` | robot 1 decides by rollout, then robot 2 knowing what robot 1 will do, and so on |
# | autonomous | `scheme="autonomous"` | no robot waits: each *predicts* what the earlier ones will do |
# | signalling policy | `signalling=` | the policy that predicts |

# %% tags=["parameters"]
PROBLEM = "network32x8"  # 32 locations, 8 robots
TRAJECTORIES = 10
STAGES_AHEAD = 8
EVALUATION_STATES = 60
SAMPLES = 6000
OPTIMIZATION_STEPS = 1500
FRAMES = 18

# %%
# %matplotlib inline
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from IPython.display import Image
from torchrl import logger

from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.envs.repair import CalibratedStart, network_figure, save_animation
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import MultiagentRollout
from torchrl_pomdp.modules.repair import GreedyRepair, OldPolicy, SteadyStateCost
from torchrl_pomdp.problems import make_problem, repair_problem
from torchrl_pomdp.report import Result, cost_figure, table
from torchrl_pomdp.trainers import PolicyIterationConfig, api

logger.setLevel("WARNING")

# %% [markdown]
# ## The network
#
# Locations are coloured by the damage that is expected there; a robot sees the damage where it stands. The numbered discs are
# the robots, arrows and plus signs are what the greedy policy tells them to do.

# %%
problem = make_problem(PROBLEM)
model, greedy = problem.model, GreedyRepair(problem.model)
print(model.describe())

y = model.with_features(problem.start(torch.tensor(4)))
network_figure(model, y, control=greedy(y.clone())["action"], title="greedy: every robot for itself")

# %% [markdown]
# Look for robots that go to the same place: greedy robots know nothing of each other, and whoever comes second has walked for
# nothing.
#
# ## One robot after the other
#
# Rollout tries every control. With eight robots and five controls each that would be 5⁸ joint controls, 390 625. But there is
# a way around: let the robots decide in turn. Robot 1 tries its own five controls, while the others follow the base policy.
# Robot 2 does the same, but knows what robot 1 has decided, and so on. That takes R·A = 40 Q-factors instead of Aᴿ (fewer,
# where some are illegal), and the paper shows that, with exact Q-factors, it still is no worse than the base policy.
#
# Simulations are cut after a few stages, and a simple estimate of what is left, `problem.pessimistic_cost`, is added.

# %%
options = {"trajectories": TRAJECTORIES, "max_steps": STAGES_AHEAD, "terminal_cost": problem.pessimistic_cost}
in_turn = MultiagentRollout(model, greedy, **options)
decided = in_turn(y.clone())
print(f"{in_turn.evaluated} Q-factors for one decision of {model.num_robots} robots")
network_figure(model, y, control=decided["action"], title="one at a time: robots share the work")

# %% [markdown]
# ## Robots that cannot wait for each other
#
# When radio contact is poor, robot 2 cannot wait until robot 1 has decided. It has to guess. The simplest guess is that the
# others do what the base policy says. How bad is that? Every policy meets the same start states and the same noise.

# %%
autonomous = MultiagentRollout(model, greedy, scheme="autonomous", **options)
policies = {"greedy": greedy, "urgency": problem.base_policies["urgency"], "autonomous": autonomous, "one at a time": in_turn}


def evaluate(problem, policies):
    """Discounted costs of policies from the same start states; what is left at the end of the simulation is estimated."""
    rest = problem.pessimistic_cost
    return {
        name: discounted_costs(problem.model, policy, problem.start, num_states=EVALUATION_STATES, terminal_cost=rest)
        for name, policy in policies.items()
    }


def against(baseline, costs):
    """Costs beside those of a baseline, paired by start state."""
    return [Result(name, compare(each, costs[baseline])) for name, each in costs.items()]


costs = evaluate(problem, policies)
results = against("greedy", costs)
print(table(results))
cost_figure(results, f"{model.num_robots} robots")

# %% [markdown]
# *urgency*, which weighs damage against distance, is a better base policy, and free. Robots that guess wrongly are much worse
# than robots that take turns, and worse than urgency.
#
# ## A network that all robots share
#
# A better guess is a policy that imitates the robots that took turns. `trainers.api` labels states by rollout one at a time
# and trains an `AgentNetwork`: one network, called once for each robot, which is shown where that robot is and what the
# earlier ones have chosen. The same weights serve every robot.

# %%
config = PolicyIterationConfig(
    iterations=1,
    samples_per_part=SAMPLES,
    trajectories=2,
    label_steps=STAGES_AHEAD,
    multiagent=True,
    least_steps=OPTIMIZATION_STEPS,
    epochs=2,
    validation_states=EVALUATION_STATES,
)
(iteration,) = api(problem, config, greedy)
network = iteration.policy
print(iteration.reason)

# %%
signalled = MultiagentRollout(model, greedy, scheme="autonomous", signalling=network, **options)
costs |= evaluate(problem, {"signalled": signalled, "network": network})
results = against("greedy", {name: costs[name] for name in ("greedy", "autonomous", "signalled", "one at a time", "network")})
print(table(results))
cost_figure(results, f"{model.num_robots} robots")

# %% [markdown]
# With the network as signalling policy robots that do not wait are nearly as good as robots that do. The network alone, which
# simulates nothing when it decides, is about as good.
#
# ## See it
#
# Both animations start in the same state. Greedy robots end up in a pack, since what is nearest to one is nearest to all;
# robots that take turns spread over the network.

# %%
env = BeliefEnv(model, problem.start, seed=4)
with torch.no_grad():
    played = {
        name: env.rollout(FRAMES, policy, auto_reset=False, tensordict=env.reset(y.select(*model.state_keys), set_state=True))
        for name, policy in {"greedy": greedy, "one at a time": in_turn}.items()
    }
film = Path(tempfile.mkdtemp()) / "robots.gif"
save_animation(film, model, played)
Image(film.read_bytes())

# %% [markdown]
# ## The model changes
#
# A robot breaks down at location 13, and the way between 14 and 24 is blocked. The policy, here urgency, was made for another
# world. Training anew takes time; rollout does not. It takes the *new* model and the *old* policy as its base policy, and
# repairs the old policy's mistakes at once, because it sees in simulation what they lead to.
#
# `OldPolicy` lets the old policy go on as if nothing had happened: for it, the lost robot stands where it broke down.

# %%
lost, place, ways = 2, 12, (13, 23)  # numbers from 0; locations are called 13, 14 and 24
changed = repair_problem(
    model.graph.without_edge(*ways),
    model.chain,
    model.costs,
    model.discount,
    num_robots=model.num_robots - 1,
    start=lambda new: CalibratedStart(new, damaged_fraction=1.0),
    name="one robot lost, one way blocked",
)
changed = replace(changed, pessimistic_cost=SteadyStateCost(changed.model))
old = OldPolicy(problem.base_policies["urgency"], model, changed.model, lost=lost, place=place)
options["terminal_cost"] = changed.pessimistic_cost

policies = {
    "old policy": old,
    "rollout of it": MultiagentRollout(changed.model, old, **options),
    "urgency made anew": changed.base_policies["urgency"],
}
results = against("old policy", evaluate(changed, policies))
print(table(results))
cost_figure(results, "after the change")

# %%
y = changed.model.with_features(changed.start(torch.tensor(4)))
decided = policies["rollout of it"](y.clone())["action"]
network_figure(changed.model, y, control=decided, title="seven robots, and no way from 14 to 24")

# %% [markdown]
# # Where to go on
#
# - `scheme="order_optimised"` lets the robot with the most to gain decide first: a little better, and more work.
# - Your own network: `Graph.from_edges` or `Graph.from_networkx`, then `repair_problem(..., num_robots=...)`.
# - `torchrl-pomdp train network32x8 --algorithm API --label-steps 5` trains at full size.
# - The robots need not be robots: any `BeliefModel` may have agents, see `torchrl_pomdp.envs.controls`.
# - More computers for the labels: tutorial 7. A problem of your own: tutorial 8.
