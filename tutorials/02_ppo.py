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
# # PPO on a belief environment
#
# `BeliefEnv` is a TorchRL environment like any other. This is TorchRL's own PPO on it, as a baseline that knows nothing of the
# model. `PolicyNetwork.actor()` is the actor: it draws among the controls that the environment's `"action_mask"` says are legal.
# `trainers.ppo` does the same with more care, for large problems.

# %% tags=["parameters"]
UPDATES = 60
EVALUATION_STATES = 1000

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import RewardScaling, TransformedEnv
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.evaluation import discounted_costs, estimate
from torchrl_pomdp.modules import FlatEncoder, PolicyNetwork
from torchrl_pomdp.problems import make_problem

# %%
torch.manual_seed(0)  # of PPO's own draws
problem = make_problem("line3")
env = TransformedEnv(BeliefEnv(problem.model, problem.start, batch_size=(64,), seed=0), RewardScaling(0.0, 0.01))
encoder, generator = FlatEncoder(problem.model), torch.Generator().manual_seed(0)
policy = PolicyNetwork(encoder, problem.model.num_controls, (64, 64), generator=generator)
actor = policy.actor()


class Critic(TensorDictModuleBase):
    in_keys, out_keys = list(encoder.keys), ["state_value"]

    def __init__(self):
        super().__init__()
        self.network = nn.Sequential(nn.Linear(encoder.num_features, 64), nn.ReLU(), nn.Linear(64, 1))

    def forward(self, tensordict):
        return tensordict.set("state_value", self.network(encoder(tensordict)))


critic = Critic()
loss = ClipPPOLoss(actor, critic, entropy_coeff=0.01)
advantage = GAE(gamma=problem.model.discount, lmbda=0.95, value_network=critic)
optimizer = torch.optim.Adam(loss.parameters(), 1e-3)

# %% [markdown]
# Rewards are minus the expected stage costs, so the undiscounted return of an episode is not what is compared below: policies
# are compared by discounted cost, from the same start states under the same noise.


# %%
def cost():
    return estimate(discounted_costs(problem.model, policy, problem.start, num_states=EVALUATION_STATES)).mean


learnt = [cost()]
frames = {"frames_per_batch": 64 * 32, "total_frames": 64 * 32 * UPDATES}
for batch in Collector(env, actor, auto_register_policy_transforms=False, **frames):
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
    learnt.append(cost())

# %%
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.semilogy(learnt, label="PPO")
for color, (name, base) in zip(("C1", "C2"), problem.base_policies.items(), strict=True):
    base_cost = estimate(discounted_costs(problem.model, base, problem.start, num_states=EVALUATION_STATES)).mean
    axes.axhline(base_cost, linestyle="--", color=color, label=name)
    print(f"{name}: {base_cost:.0f}")
axes.set(xlabel="update", ylabel="discounted cost")
axes.legend()
print(f"PPO: {learnt[-1]:.0f}, the optimum: 169")
