r"""Trajectories to look at: feature states, what a policy does in them, and the truth behind them (paper, Section II)."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.world import World
from torchrl_pomdp.modules.policies import Policy, check_policy, controls_of
from torchrl_pomdp.modules.rollout import check_max_steps
from torchrl_pomdp.noise import fold, uniform
from torchrl_pomdp.tensor_checks import check_keys

__all__ = ["has_world", "play"]

# The streams of a key: the hidden state at the start, and the noise of the stages.
_START, _STAGES = 0, 1


def has_world(model: BeliefModel) -> bool:
    """Whether a model has hidden states, so that the truth can be drawn beside the belief.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> has_world(make_problem("tiger").model)
        True
    """
    return type(check_instance("model", model, BeliefModel)).world is not BeliefModel.world


def play(
    model: BeliefModel, policy: Policy, y: TensorDictBase, keys: Tensor, *, max_steps: int | None = None
) -> TensorDictBase:
    r"""Trajectories of a policy, with the hidden states behind them where the model has a :class:`~torchrl_pomdp.envs.World`.

    The noise is a function of key and stage: policies that are given the same states and keys start in the same hidden state
    and meet the same noise. Without a world, observations are drawn from :math:`\hat p(z\mid b_y,u)`.

    ================ ============== ===================================================
    key              shape          meaning
    ================ ============== ===================================================
    core and derived ``[*B, T, …]`` the feature states :math:`y_k`
    action           ``[*B, T]``    the controls :math:`u_k`
    q_factors        ``[*B, T, U]`` if the policy writes them, as rollout does
    cost             ``[*B, T]``    :math:`\hat g(y_k,u_k)`, 0 from a terminal state on
    hidden           ``[*B, T, …]`` the hidden states, if the model has a world
    next             ``[*B, T, …]`` core entries, and hidden states, after the stage
    ================ ============== ===================================================

    Args:
        model: the belief model.
        policy: the policy.
        y: feature states ``[*B]`` to start in.
        keys: int64 ``[*B]``, one for each trajectory.

    Keyword Args:
        max_steps: the most stages; None: as the discount asks for, see :attr:`BeliefModel.horizon`.

    Returns:
        trajectories ``[*B, T]``; T is ``max_steps``, or less where all have reached a terminal state by then, and at least 1.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``y`` are no feature states of the model, there is not one key for each, ``max_steps`` is not positive,
            or a control is illegal.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem, keys = make_problem("linear20"), torch.arange(2)
        >>> greedy = problem.base_policies["greedy"]
        >>> played = play(problem.model, greedy, problem.start(keys), keys, max_steps=3)
        >>> played.batch_size, played["hidden", "level"].shape
        (torch.Size([2, 3]), torch.Size([2, 3, 20]))
    """
    world = model.world() if has_world(model) else None
    check_policy("policy", policy, model)
    max_steps = check_max_steps(max_steps, model)
    y = model.with_features(y)
    if check_keys("keys", keys).shape != y.batch_size:
        raise ValueError(f"keys must be one for each state, of shape {tuple(y.batch_size)}, got {tuple(keys.shape)}")
    hidden = None if world is None else world.sample(y, fold(keys, _START))
    over, stages = model.is_terminal(y), []
    for stage in range(max_steps):
        shown = _state(y, hidden)
        with torch.no_grad():
            decided = y.copy()
            u = controls_of("policy", policy, decided)
        model.check_controls(y, u)
        cost = model.expected_cost(y, u).masked_fill(over, 0.0)
        shown.update({"action": u, "cost": cost, **_factors(model, decided)})
        y, hidden = _follow(model, world, y, hidden, u, fold(fold(keys, _STAGES), stage))
        stages.append(shown.set("next", _state(y.select(*model.state_keys), hidden)))
        over = over | model.is_terminal(y)
        if bool(over.all()):
            break
    return torch.stack(stages, -1)


def _follow(
    model: BeliefModel, world: World | None, y: TensorDictBase, hidden: TensorDictBase | None, u: Tensor, keys: Tensor
) -> tuple[TensorDictBase, TensorDictBase | None]:
    """The next feature states, and hidden states if there are some."""
    if world is None or hidden is None:
        counters = torch.arange(model.noise_dim, device=keys.device)
        _, nxt = model.advance(y, u, uniform(keys.unsqueeze(-1), counters).to(model.dtype))
        return nxt, None
    _, hidden, z = world.step(hidden, u, keys)
    return model.estimator(y, u, z), hidden


def _state(y: TensorDictBase, hidden: TensorDictBase | None) -> TensorDictBase:
    """A feature state, with the hidden state under ``hidden``."""
    shown = TensorDict(dict(y.items()), batch_size=y.batch_size, device=y.device)
    return shown if hidden is None else shown.set("hidden", hidden)


def _factors(model: BeliefModel, decided: TensorDictBase) -> dict[str, Tensor]:
    """Q-factors of all controls, where the policy has written some."""
    q = decided.get("q_factors", None)
    every = (*decided.batch_size, model.num_controls)
    return {"q_factors": q} if isinstance(q, Tensor) and q.shape == every else {}
