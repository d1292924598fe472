"""What a belief model promises, checked: for tests of one's own models (paper, Section II)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from torchrl_pomdp.checks import check_callable, check_instance, check_integer, shown
from torchrl_pomdp.envs.belief_model import BeliefModel, StateGenerator
from torchrl_pomdp.envs.entries import RESERVED
from torchrl_pomdp.envs.rows import random_control
from torchrl_pomdp.noise import fold, seed_keys
from torchrl_pomdp.problems.check_laws import (
    MOST_ROWS,
    CostSize,
    Outcomes,
    Pairs,
    check_advance,
    check_bayes,
    check_terminal,
    entries_of,
    legal_pairs,
    noise_of,
)
from torchrl_pomdp.problems.check_runs import check_engine, check_environment
from torchrl_pomdp.problems.probe import Probe, distributions, refuse, require, same, tolerance
from torchrl_pomdp.tensor_checks import device_of

__all__ = ["check_belief_model"]

# Start states, stages of random play from them, and the states of these that are looked at.
_STARTS, _STAGES, _STATES = 32, 30, 48
# Observations that are enumerated at most.
_MOST_OBSERVATIONS = 4096


def check_belief_model(model: BeliefModel, generator: StateGenerator, *, seed: int = 0) -> None:
    r"""Raise unless a belief model keeps what :class:`~torchrl_pomdp.envs.BeliefModel` promises; for tests of one's own.

    States are what the generator gives and what random play reaches from there. Looked at are: specs; that every method is
    pure, gives the right shapes for any batch, and for a state alone the same as in a batch, to the last bit; legal controls;
    rows of :math:`\hat p(z\mid b_y,u)`; that ``advance`` leads to the states F(y, u, z) as often as :math:`\hat p` says; that
    terminal states cost nothing and stay so; fingerprints; and that simulations and
    :class:`~torchrl_pomdp.envs.BeliefEnv` agree. Bayes' rule itself is checked where it can be: for a
    :class:`~torchrl_pomdp.envs.TabularModel` against its arrays; where the one floating core entry is a distribution
    ``[*B, n]``, by the linearity in it of :math:`\hat g(y,u)` and of :math:`\hat p(z\mid b_y,u)F(y,u,z)`. With more than 4096
    observations what would enumerate them is left out.

    Args:
        model: the belief model.
        generator: generator of start states.

    Keyword Args:
        seed: seed of the states and of the noise.

    Raises:
        TypeError: if an argument is of the wrong kind.
        AssertionError: if the model breaks a rule; the message names the method, the rule, what was found, and how to mend it.
        ValueError: if the generator gives no states of the model, see :meth:`~torchrl_pomdp.envs.BeliefModel.drawn`.

    Examples:
        >>> from torchrl_pomdp.problems import tiger
        >>> problem = tiger()
        >>> check_belief_model(problem.model, problem.start)
    """
    check_instance("model", model, BeliefModel).check_enumerable("check_belief_model", "the same model with fewer agents")
    check_callable("generator", generator)
    seed = check_integer("seed", seed)
    with torch.no_grad():
        _check_attributes(model)
        starts = _starts(model, generator, seed)
        probe = Probe(model, distributions(starts, model.state_keys))
        y, terminal = _visited(probe, starts, seed)
        pairs = legal_pairs(probe, y, seed)
        _check_agents(model, pairs)
        _check_costs(probe, pairs)
        outcomes = _enumerated(probe, pairs)
        _check_batches(probe, pairs, outcomes)
        size = CostSize(model, probe.cost(pairs.y, pairs.u))
        check_advance(probe, pairs, outcomes, size, seed)
        check_terminal(probe, terminal, size, seed)
        if outcomes is not None:
            check_bayes(probe, pairs, outcomes, size)
        check_engine(model, starts, size, seed)
        check_environment(model, generator, starts, size, seed)


def _check_attributes(model: BeliefModel) -> None:
    mend = "Call super().__init__(discount) first."
    require(hasattr(model, "discount"), "__init__", "it calls that of BeliefModel", "a model without a discount", mend)
    for name in ("num_controls", "num_observations", "noise_dim"):
        value = getattr(model, name, None)
        right = isinstance(value, int) and value >= 1
        require(right, name, "it is an integer of at least 1", shown(value), f"Set self.{name} in __init__.")
    if model.num_agents > 1:
        joint = f"{model.num_agent_controls}^{model.num_agents} joint controls"
        right = model.num_agent_controls**model.num_agents == model.num_controls
        require(right, "num_agent_controls", f"there are {model.num_controls} controls", joint, "Set it, and agent_mask.")
    keys: Any = getattr(model, "state_keys", None)
    named = isinstance(keys, tuple) and len(keys) > 0 and all(isinstance(key, str) for key in keys)
    require(named, "state_keys", "it is a tuple of the names of core entries", shown(keys), "Set it in the class.")
    taken = sorted(RESERVED.intersection(keys))
    require(not taken, "state_keys", "none is the name of what stands beside a state", str(taken), "Name them otherwise.")
    for name, count in (("control_names", model.num_controls), ("observation_names", model.num_observations)):
        names = getattr(model, name)
        right = names is None or (isinstance(names, tuple) and len(names) == len(set(names)) == count)
        require(right, name, f"it is None or a tuple of {count} different names", shown(names), "Name all, or none.")
    _check_spec(model, keys)


def _check_agents(model: BeliefModel, pairs: Pairs) -> None:
    if model.num_agents == 1:
        return
    mask, size = model.agent_mask(pairs.y), (*pairs.y.batch_size, model.num_agents, model.num_agent_controls)
    right = isinstance(mask, Tensor) and mask.dtype == torch.bool and tuple(mask.shape) == size
    found = f"{mask.dtype} of shape {tuple(mask.shape)}" if isinstance(mask, Tensor) else shown(mask)
    require(right, "agent_mask", f"it gives bool {list(size)}, for every agent and its controls", found, "Define it.")
    legal = mask.gather(-1, model.split_controls(pairs.u).unsqueeze(-1)).all()
    found = "a legal joint control with an illegal one of an agent"
    require(bool(legal), "agent_mask", "what is legal jointly is legal for each agent", found, "Make both from one rule.")


def _check_spec(model: BeliefModel, keys: tuple[str, ...]) -> None:
    for shape in ((), (7,), (3, 2)):
        spec = model.state_spec(shape)
        require(isinstance(spec, Composite), "state_spec", "it gives a Composite", shown(spec), "See torchrl.data.")
        own = sorted(spec.keys())
        require(own == sorted(keys), "state_spec", f"its entries are state_keys, {sorted(keys)}", str(own), "Name them alike.")
        for key, leaf in spec.items():
            rule = f"the shape of {key!r} is the batch {shape} followed by the entry's own"
            alone = tuple(model.state_spec()[key].shape)
            mend = "Make it from (*batch_size, ...)."
            require(tuple(leaf.shape) == (*shape, *alone), "state_spec", rule, str(tuple(leaf.shape)), mend)
            floating = leaf.dtype == model.dtype or not leaf.dtype.is_floating_point
            rule = f"floating entries have the model's type {model.dtype}"
            require(floating, "state_spec", rule, f"{leaf.dtype} of {key!r}", "Pass dtype= to the entry's spec.")


def _starts(model: BeliefModel, generator: StateGenerator, seed: int) -> TensorDictBase:
    """Start states ``[N]``, core entries alone; raises unless the generator is a pure function of single keys."""
    keys = fold(seed_keys(seed, torch.arange(_STARTS, device=model.device)), 0)
    y = model.drawn(generator, keys).select(*model.state_keys)
    for shape in ((), (1,), (2, 3), (0,)):
        count = torch.Size(shape).numel()
        part = model.drawn(generator, keys[:count].view(shape)).select(*model.state_keys)
        rule = "a key has the same state in every batch and at every call"
        mend = "Make states from the keys alone, as torchrl_pomdp.noise.uniform(keys, i) does; use no other random numbers."
        require(
            same(part.reshape(count), y[:count]), "generator of start states", rule, f"another state in batch {shape}", mend
        )
    return y


def _visited(probe: Probe, starts: TensorDictBase, seed: int) -> tuple[TensorDictBase, TensorDictBase]:
    """Different states of random play, those that are not terminal and those that are, both flat."""
    model, y, seen = probe.model, starts, [starts]
    keys = seed_keys(seed, torch.arange(starts.batch_size[0], device=model.device))
    for stage in range(_STAGES):
        noise = noise_of(model, fold(keys, stage + 1), model.noise_dim + 1)
        u = random_control(probe.mask(y), noise[:, -1])
        _call_parts(probe, y, u)
        y = probe.advance(y, u, noise[:, :-1])[1].select(*model.state_keys)
        seen.append(y)
    every = torch.cat([each.clone() for each in seen])
    _check_fingerprint(probe, every)
    _, number = model.fingerprint(every).unique(return_inverse=True)
    first = torch.full_like(number, len(number)).scatter_reduce(
        0, number, torch.arange(len(number), device=device_of(y)), "amin"
    )
    every = every[first[first < len(number)].sort().values]
    ended = probe.terminal(every)
    return _spread(every[~ended], _STATES), _spread(every[ended], _STATES)


def _call_parts(probe: Probe, y: TensorDictBase, u: Tensor) -> None:
    """Call what ``advance`` may be made of, so that a fault in it is found there and not blamed on ``advance``."""
    probe.terminal(y)
    probe.cost(y, u)
    probe.observed(y, u)
    if probe.model.num_observations <= _MOST_OBSERVATIONS:
        probe.estimator(y, u, probe.probs(y, u).argmax(-1))


def _spread(y: TensorDictBase, count: int) -> TensorDictBase:
    """At most ``count`` states of a flat batch, the first and the last among them."""
    size = y.batch_size[0]
    return y if size <= count else y[torch.linspace(0, size - 1, count, device=device_of(y)).long()]


def _check_fingerprint(probe: Probe, every: TensorDictBase) -> None:
    """Raise unless states are equal where fingerprints are: each state is compared with the next ones in hash order."""
    key = probe.fingerprint(every)
    order = key.argsort(stable=True)
    flat = entries_of(every, probe.model.state_keys)[order]
    equal, alike = (flat[1:] == flat[:-1]).all(-1), key[order].diff() == 0
    mend = "Hash all core entries, as torchrl_pomdp.noise.fingerprint does."
    found = "two different states with one fingerprint"
    refuse(alike & ~equal, "fingerprint", "different states have different fingerprints", lambda i: found, mend)
    twice = probe.fingerprint(torch.cat([every.clone(), every.flip(0)]))
    rule = "equal states have equal fingerprints, in any batch"
    require(same(twice, torch.cat([key, key.flip(0)])), "fingerprint", rule, "another one in a larger batch", mend)


def _check_costs(probe: Probe, pairs: Pairs) -> None:
    model, cost = probe.model, probe.cost(pairs.y, pairs.u)
    if model.max_cost is not None:
        bound = model.max_cost * (1 + tolerance(model.dtype))
        refuse(
            cost.abs() > bound,
            "max_cost",
            f"no stage cost is larger than max_cost, {model.max_cost:g}",
            lambda i: f"expected_cost {float(cost[i]):g} for control {int(pairs.u[i])}",
            "Give a bound of all stage costs, or None.",
        )


def _enumerated(probe: Probe, pairs: Pairs) -> Outcomes | None:
    """All outcomes of as many pairs as can be afforded; None where there are too many observations."""
    model = probe.model
    if model.num_observations > _MOST_OBSERVATIONS:
        return None
    count = max(1, min(len(pairs.u), MOST_ROWS // model.num_observations))
    y, u = pairs.y[:count], pairs.u[:count]
    probs = probe.probs(y, u)
    pair, z = (probs > 0).nonzero(as_tuple=True)
    nxt = probe.estimator(y[pair], u[pair], z)
    probe.mask(nxt)
    # With features they come along, and are checked.
    few = pair[:32]
    probe.estimator(model.derive(y[few]), u[few], z[:32])
    return Outcomes(pair, z, probs[pair, z], nxt)


def _check_batches(probe: Probe, pairs: Pairs, outcomes: Outcomes | None) -> None:
    """Raise unless each method gives for states alone, in other orders and in other shapes, what it gives in a batch."""
    model = probe.model
    noise = noise_of(model, torch.arange(len(pairs.u), device=pairs.u.device), model.noise_dim)
    calls: list[tuple[str, Callable[..., Any], tuple[Any, ...]]] = [
        ("action_mask", probe.mask, (pairs.y,)),
        ("is_terminal", probe.terminal, (pairs.y,)),
        ("fingerprint", probe.fingerprint, (pairs.y,)),
        ("expected_cost", probe.cost, (pairs.y, pairs.u)),
        ("observed", probe.observed, (pairs.y, pairs.u)),
    ]
    if outcomes is not None:
        calls.append(("observation_probs", probe.probs, (pairs.y, pairs.u)))
        calls.append(("estimator", probe.estimator, (pairs.y[outcomes.pair], pairs.u[outcomes.pair], outcomes.z)))
    # Last what may be made of the others.
    calls += [("advance", probe.advance, (y, pairs.u, noise)) for y in (pairs.y, model.derive(pairs.y))]
    for name, method, given in calls:
        _check_batch(name, method, given)


def _check_batch(name: str, method: Callable[..., Any], given: tuple[Any, ...]) -> None:
    size, device = len(given[-1]), given[0].device
    whole = method(*given)
    every = torch.arange(size, device=device)
    six = torch.arange(6, device=device) * 7 % size
    for index in (every.flip(0), every[: size // 2 + 1], six.view(3, 2), six.view(6, 1), six[0], every[:0]):
        part = method(*(each[index] for each in given))
        require(
            same(part, _taken(whole, index)),
            name,
            "a state gives in a batch what it gives alone, to the last bit",
            f"other numbers in batch {tuple(index.shape)} than among {size}",
            "Use elementwise operations and torchrl_pomdp.envs.sums.sum_first; products of matrices and sums over the first "
            "dimension round by the batch, and statistics of the batch have no place here.",
        )


def _taken(result: Any, index: Tensor) -> Any:
    return tuple(each[index] for each in result) if isinstance(result, tuple) else result[index]
