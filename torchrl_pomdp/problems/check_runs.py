"""Simulations and environment over a belief model under the same noise."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.envs.belief_env import BeliefEnv
from torchrl_pomdp.envs.belief_model import BeliefModel, StateGenerator
from torchrl_pomdp.envs.rows import random_control
from torchrl_pomdp.modules.policies import Policy
from torchrl_pomdp.modules.rollout import TruncatedRollout
from torchrl_pomdp.modules.scenarios import Scenarios
from torchrl_pomdp.modules.terminal_costs import ZeroCost
from torchrl_pomdp.noise import fold, seed_keys, uniform
from torchrl_pomdp.problems.check_laws import CostSize
from torchrl_pomdp.problems.probe import refuse, tolerance

__all__ = ["check_engine", "check_environment"]

# Stages that engine and environment are compared on.
_COMPARED = 8


def _some_policy(model: BeliefModel, seed: int) -> Policy:
    """A policy of legal controls that are a function of the state, and differ between states."""

    def policy(y: TensorDictBase) -> TensorDictBase:
        noise = uniform(fold(model.fingerprint(y), seed), 0)
        return y.set("action", random_control(model.action_mask(y), noise))

    return policy


Draw = Callable[[int, TensorDictBase, Tensor], Tensor]


def _by_hand(model: BeliefModel, policy: Policy, y: TensorDictBase, draw: Draw, size: CostSize) -> tuple[Tensor, Tensor]:
    """Discounted costs ``[N]`` of some stages under given noise, and the size of what they are sums of."""
    total = torch.zeros(y.batch_size, dtype=model.dtype, device=model.device)
    sizes = torch.zeros_like(total)
    y = model.derive(y)
    ended = model.is_terminal(y)
    for stage in range(_COMPARED):
        u = policy(y.copy()).get("action")
        noise = draw(stage, y, u)
        sizes = sizes + size(y, u, model.expected_cost(y, u))
        cost, y = model.advance(y, u, noise)
        total = total + cost.masked_fill(ended, 0.0) * model.discount**stage
        ended = ended | model.is_terminal(y)
    return total, sizes


def check_engine(model: BeliefModel, y: TensorDictBase, size: CostSize, seed: int) -> None:
    """Raise unless simulations cost what the steps of the model do."""
    keys = seed_keys(seed, torch.arange(y.batch_size[0], device=model.device))
    policy, scenarios = _some_policy(model, seed), Scenarios.single(keys)

    def draw(stage: int, y: TensorDictBase, u: Tensor) -> Tensor:
        nonlocal scenarios
        noise, scenarios = scenarios.draw(torch.full_like(u, stage), model.observed(y, u), 1)
        return noise

    expected, sizes = _by_hand(model, policy, y, draw, size)
    cost = TruncatedRollout(model, policy, max_steps=_COMPARED, terminal_cost=ZeroCost())(y.clone(), keys)
    _compare("TruncatedRollout", cost, expected, sizes)


def check_environment(model: BeliefModel, generator: StateGenerator, y: TensorDictBase, size: CostSize, seed: int) -> None:
    """Raise unless the environment gives as reward what the steps of the model cost."""
    policy, batch = _some_policy(model, seed), y.batch_size
    env = BeliefEnv(model, generator, seed=seed % 2**62)
    now = env.reset(y.clone(), set_state=True)
    rng = torch.Generator(device=model.device)
    rng.set_state(env.rng.get_state())

    def draw(stage: int, y: TensorDictBase, u: Tensor) -> Tensor:
        return torch.rand(*batch, model.noise_dim, generator=rng, dtype=model.dtype, device=model.device)

    expected, sizes = _by_hand(model, policy, y, draw, size)
    cost = torch.zeros_like(expected)
    for stage in range(_COMPARED):
        after = env.step(policy(now)).get("next")
        ended = now.get("terminated").squeeze(-1)
        cost = cost - after.get("reward").squeeze(-1).masked_fill(ended, 0.0) * model.discount**stage
        now = after.exclude("reward").set("terminated", after.get("terminated") | now.get("terminated"))
    _compare("BeliefEnv", cost, expected, sizes)


def _compare(name: str, cost: Tensor, expected: Tensor, sizes: Tensor) -> None:
    limit = tolerance(cost.dtype) * sizes
    refuse(
        (cost - expected).abs() > limit,
        name,
        "it gives the cost of the same policy under the same noise that advance gives",
        lambda i: f"{float(cost[i]):g} instead of {float(expected[i]):g} from start state {i}",
        "A method must not depend on earlier calls, nor on entries of y that are not in state_keys.",
    )
