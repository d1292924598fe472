"""What binds the methods of a belief model together: Bayes' rule, sampled steps, terminal states."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import shown
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.tabular import TabularModel
from torchrl_pomdp.noise import fold, seed_keys, uniform
from torchrl_pomdp.problems.probe import Probe, refuse, require, tolerance
from torchrl_pomdp.tensor_checks import device_of

__all__ = [
    "CostSize",
    "Outcomes",
    "Pairs",
    "check_advance",
    "check_bayes",
    "check_terminal",
    "entries_of",
    "legal_pairs",
    "noise_of",
]

# Pairs of state and control that are looked at, and rows over which observations are enumerated.
_PAIRS, MOST_ROWS = 96, 1 << 16
# Sampled steps of a pair, and how far frequencies may be off in standard errors.
_SAMPLES, _PAIRS_SAMPLED, _SIGMAS = 4096, 8, 6.0
# Stage cost of a terminal state as a fraction of the largest one, and the probability of leaving such states.
_SMALL_COST, _SMALL_PROBABILITY = 1e-4, 1e-3
# Steps from every terminal pair; and how many of them leave with that probability in less than one of a million pairs.
_STEPS, _TOO_OFTEN = 256, 6
# States up to which the arrays of a tabular model are multiplied out.
_MOST_STATES = 4096
_LARGEST = 1.0 - 2.0**-24


@dataclass(frozen=True)
class Pairs:
    """States ``[P]`` of core entries, and a legal control in each."""

    y: TensorDictBase
    u: Tensor

    def rows(self, index: Tensor) -> Pairs:
        """Some of the pairs."""
        return Pairs(self.y[index], self.u[index])


@dataclass(frozen=True)
class Outcomes:
    """All observations of positive probability after pairs: number of the pair, observation, probability, successor ``[M]``."""

    pair: Tensor
    z: Tensor
    probability: Tensor
    y: TensorDictBase


def legal_pairs(probe: Probe, y: TensorDictBase, seed: int) -> Pairs:
    """Pairs of states and legal controls, spread evenly; raises unless ``check_controls`` agrees with the mask."""
    require(
        y.batch_size[0] > 0,
        "is_terminal",
        "some states that the generator gives or random play reaches are not terminal",
        "terminal states alone",
        "Look at is_terminal, or give a generator of states where something is to be done.",
    )
    model, mask = probe.model, probe.mask(y)
    state, u = mask.nonzero(as_tuple=True)
    if len(state) > _PAIRS:
        order = uniform(fold(seed_keys(seed, torch.arange(len(state), device=device_of(y))), -1), 0).argsort()
        state, u = state[order[:_PAIRS]], u[order[:_PAIRS]]
    pairs = Pairs(y[state], u)
    model.check_controls(pairs.y, pairs.u)
    illegal = (~mask).nonzero()
    if len(illegal):
        row, control = illegal[0]
        try:
            model.check_controls(y[row], control.clone())
        except ValueError:
            return pairs
        found = f"control {int(control)} accepted where action_mask is False"
        require(False, "check_controls", "it refuses what action_mask does not allow", found, "Do not override it.")
    return pairs


def noise_of(model: BeliefModel, keys: Tensor, count: int) -> Tensor:
    """Uniforms ``[N, count]`` of the model's type for keys ``[N]``."""
    return uniform(keys.unsqueeze(-1), torch.arange(count, device=keys.device)).to(model.dtype)


def entries_of(y: TensorDictBase, keys: tuple[str, ...]) -> Tensor:
    """Core entries as numbers ``[N, D]`` of type float64."""
    return torch.cat([y.get(key).reshape(y.batch_size[0], -1).double() for key in keys], -1)


class CostSize:
    """Sizes of the numbers that expected costs are sums of, by which rounding of these is measured.

    A tabular model's are known. Of others an expected cost is taken to be as large as what it is a sum of, or as a cost that is
    not zero usually is.

    Args:
        model: the belief model.
        costs: expected costs of many states and controls.
    """

    def __init__(self, model: BeliefModel, costs: Tensor) -> None:
        self.model = model
        spent = costs[costs != 0.0].abs()
        self.usual = float(spent.median()) if len(spent) else model.max_cost or 1.0
        self.largest = max(self.usual, float(costs.abs().max()))

    def __call__(self, y: TensorDictBase, u: Tensor, cost: Tensor) -> Tensor:
        """Of expected costs ``[N]`` of controls ``u`` in states ``y``: ``[N]``."""
        if isinstance(self.model, TabularModel):
            return (y.get("belief") * self.model.cost[u].abs()).sum(-1)
        return cost.abs().clamp_min(self.usual)


def check_advance(probe: Probe, pairs: Pairs, outcomes: Outcomes | None, size: CostSize, seed: int) -> None:
    """Raise unless sampled steps cost what they should and lead to the outcomes as often as they should."""
    model = probe.model
    keys = fold(seed_keys(seed, torch.arange(_SAMPLES, device=model.device)), -2)
    noise = noise_of(model, keys, model.noise_dim)
    # The ends of the unit interval are where a wrong draw meets an impossible observation.
    noise = torch.cat([torch.zeros_like(noise[:1]), torch.full_like(noise[:1], _LARGEST), noise])
    available = len(pairs.u) if outcomes is None else int(outcomes.pair.max()) + 1
    for number in torch.linspace(0, available - 1, min(_PAIRS_SAMPLED, available)).long().unique().tolist():
        row = torch.full((len(noise),), number, device=model.device)
        cost, nxt = probe.advance(pairs.y[row], pairs.u[row], noise)
        where = f"control {int(pairs.u[number])} in {_shown_state(pairs.y[number], model)}"
        own = probe.cost(pairs.y[row], pairs.u[row])
        _check_stage_cost(cost, own, size(pairs.y[row], pairs.u[row], own), where)
        if outcomes is not None:
            _check_frequencies(model, nxt, outcomes, outcomes.pair == number, where)


def _check_stage_cost(cost: Tensor, own: Tensor, size: Tensor, where: str) -> None:
    refuse(
        (cost - own).abs() > tolerance(own.dtype) * size,
        "advance",
        "its stage cost is expected_cost of the state before the control",
        lambda i: f"{float(cost[i]):g} instead of {float(own[i]):g} for {where}",
        "Return self.expected_cost(y, u), the belief's expectation, not a sampled cost.",
    )


def _check_frequencies(model: BeliefModel, nxt: TensorDictBase, outcomes: Outcomes, mine: Tensor, where: str) -> None:
    """Raise unless successors ``nxt`` ``[S]`` are outcomes of a pair, as often as their probabilities say."""
    reached, number = entries_of(nxt, model.state_keys).unique(dim=0, return_inverse=True)
    possible, probability = entries_of(outcomes.y[mine], model.state_keys), outcomes.probability[mine].double()
    scale = possible.abs().amax(0).clamp_min(1.0)
    possible, reached, limit = possible / scale, reached / scale, tolerance(model.dtype)
    distance, nearest = torch.cdist(reached, possible, p=torch.inf).min(-1)
    refuse(
        distance[number] > limit,
        "advance",
        "every successor is F(y, u, z) for an observation z of positive probability",
        lambda i: f"one that differs from all of them by {float(distance[number[i]]):.3g} for {where}",
        "Draw z by inverse_cdf(self.observation_probs(y, u), noise[..., 0]) and call self.estimator, or mend the faster way.",
    )
    # Observations that lead to one state count together.
    group = (torch.cdist(possible, possible, p=torch.inf) <= limit).to(torch.int8).argmax(-1)
    expected = torch.zeros_like(probability).index_add_(0, group, probability)
    drawn = group[nearest[number[2:]]]
    count = torch.bincount(drawn, minlength=len(group)).double()
    off = (count - len(drawn) * expected).abs()
    allowed = _SIGMAS * (len(drawn) * expected * (1 - expected).clamp_min(0.0)).sqrt() + _SIGMAS
    z = outcomes.z[mine]
    refuse(
        off > allowed,
        "advance",
        "observations come as often as observation_probs says",
        lambda i: (
            f"observation {int(z[i])} in {float(count[i]) / len(drawn):.3f} of {len(drawn)} steps instead of "
            f"{float(expected[i]):.3f} for {where}"
        ),
        "Both must follow one model: look at the order of the observations, and at what the noise is compared with.",
    )


def check_terminal(probe: Probe, y: TensorDictBase, size: CostSize, seed: int) -> None:
    """Raise unless terminal states cost nothing, and lead to terminal states."""
    if y.batch_size[0] == 0:
        return
    model = probe.model
    pairs = legal_pairs(probe, y, seed)
    cost = probe.cost(pairs.y, pairs.u).abs()
    what = "No cost may follow a terminal state: let is_terminal be False there, or the cost 0."
    refuse(
        cost > _SMALL_COST * size.largest,
        "is_terminal",
        "terminal states cost nothing",
        lambda i: f"expected_cost {float(cost[i]):g} for control {int(pairs.u[i])} in {_shown_state(pairs.y[i], model)}",
        what,
    )
    samples = _STEPS
    row = torch.arange(len(pairs.u), device=device_of(y)).repeat_interleave(samples)
    noise = noise_of(model, fold(seed_keys(seed, torch.arange(len(row), device=device_of(y))), -3), model.noise_dim)
    _, nxt = probe.advance(pairs.y[row], pairs.u[row], noise)
    leaves = (~probe.terminal(nxt)).view(-1, samples)
    # A state that is terminal up to a small probability may be left with that probability.
    share = leaves.double().mean()
    refuse(
        leaves.any(-1) & (share > _SMALL_PROBABILITY) | (leaves.sum(-1) >= _TOO_OFTEN),
        "is_terminal",
        "a terminal state stays terminal whatever is done",
        lambda i: f"control {int(pairs.u[i])} leading out of {_shown_state(pairs.y[i], model)}",
        what,
    )


def _shown_state(row: TensorDictBase, model: BeliefModel) -> str:
    return "state " + shown({key: row.get(key).tolist() for key in model.state_keys})


def check_bayes(probe: Probe, pairs: Pairs, outcomes: Outcomes, size: CostSize) -> None:
    """Raise unless the model follows Bayes' rule, as far as that can be told."""
    _check_arrays(probe, pairs, outcomes)
    _check_linear(probe, pairs, size)


def _check_arrays(probe: Probe, pairs: Pairs, outcomes: Outcomes) -> None:
    """Raise unless a tabular model follows Bayes' rule on its own arrays."""
    model = probe.model
    if not isinstance(model, TabularModel) or model.num_states > _MOST_STATES:
        return
    belief, u, z = pairs.y.get("belief")[outcomes.pair].double(), pairs.u[outcomes.pair], outcomes.z
    joint = torch.zeros_like(belief)
    for control in u.unique().tolist():
        rows = u == control
        moves, sees = (array[control].to_dense().double() for array in (model.transition, model.observation))
        joint[rows] = belief[rows] @ moves * sees.T[z[rows]]
    probability = joint.sum(-1)
    limit = tolerance(model.dtype)
    mend = "Follow b'(j) = sum_i b(i) p_ij(u) p(z | j, u), divided by its sum, p(z | b, u)."
    refuse(
        (probability - outcomes.probability).abs() > limit,
        "observation_probs",
        "p(z | b, u) follows from the arrays by Bayes' rule",
        lambda i: f"{float(outcomes.probability[i]):.6g} instead of {float(probability[i]):.6g} for observation {int(z[i])}",
        mend,
    )
    off = (joint / probability.unsqueeze(-1) - outcomes.y.get("belief")).abs().amax(-1) * probability
    refuse(
        off > limit,
        "estimator",
        "F(y, u, z) follows from the arrays by Bayes' rule",
        lambda i: f"a posterior that is off by {float(off[i]):.3g} for control {int(u[i])}, observation {int(z[i])}",
        mend,
    )


def _check_linear(probe: Probe, pairs: Pairs, size: CostSize) -> None:
    """Raise unless costs and unnormalised posteriors are linear in the belief, where there is one to speak of."""
    model = probe.model
    floating = [key for key in model.state_keys if pairs.y.get(key).is_floating_point()]
    if len(floating) != 1 or floating[0] not in probe.conserved or pairs.y.get(floating[0]).ndim != 2:
        return
    (key,) = floating
    # Pairs of one control whose states differ in the belief alone.
    rest = [pairs.u.unsqueeze(-1).double()]
    rest += [pairs.y.get(k).reshape(len(pairs.u), -1).double() for k in model.state_keys if k != key]
    _, group = torch.cat(rest, -1).unique(dim=0, return_inverse=True)
    order = group.argsort(stable=True)
    first, second = order[:-1][group[order].diff() == 0], order[1:][group[order].diff() == 0]
    if not len(first):
        return
    y = pairs.y[first].clone()
    y.set(key, (pairs.y.get(key)[first] + pairs.y.get(key)[second]) / 2)
    legal = model.action_mask(y).gather(-1, pairs.u[first].unsqueeze(-1)).squeeze(-1)
    first, second, mixed = first[legal], second[legal], Pairs(y[legal], pairs.u[first[legal]])
    most = max(1, MOST_ROWS // model.num_observations)
    first, second, mixed = first[:most], second[:most], mixed.rows(torch.arange(min(most, len(first)), device=device_of(y)))
    if len(first):
        _check_mixed(probe, pairs.rows(first), pairs.rows(second), mixed, key, size)


def _check_mixed(probe: Probe, first: Pairs, second: Pairs, mixed: Pairs, key: str, size: CostSize) -> None:
    limit = tolerance(probe.model.dtype)
    costs = [probe.cost(pairs.y, pairs.u) for pairs in (first, second, mixed)]
    sizes = [size(pairs.y, pairs.u, cost) for pairs, cost in zip((first, second), costs[:2], strict=True)]
    off = (costs[2] - (costs[0] + costs[1]) / 2).abs()
    refuse(
        off > limit * (sizes[0] + sizes[1]),
        "expected_cost",
        f"the expected cost is linear in {key!r}",
        lambda i: f"{float(costs[2][i]):g} half way between states of cost {float(costs[0][i]):g} and {float(costs[1][i]):g}",
        "Return the sum over hidden states of their probability times their cost.",
    )
    weights = [_posteriors(probe, pairs, key) for pairs in (first, second, mixed)]
    off = (weights[2] - (weights[0] + weights[1]) / 2).abs().flatten(1).amax(-1)
    refuse(
        off > limit,
        "estimator",
        f"by Bayes' rule p(z | y, u) times F(y, u, z) is linear in {key!r}",
        lambda i: f"a difference of {float(off[i]):.3g} for control {int(mixed.u[i])}, half way between two states",
        "Multiply the prediction by the likelihood of z; its sum is p(z | y, u), and divided by that it is F(y, u, z).",
    )


def _posteriors(probe: Probe, pairs: Pairs, key: str) -> Tensor:
    """p(z | y, u) times the next belief, ``[P, Z, n]``, zero where z is impossible."""
    probs = probe.probs(pairs.y, pairs.u)
    pair, z = (probs > 0).nonzero(as_tuple=True)
    belief = probe.estimator(pairs.y[pair], pairs.u[pair], z).get(key) * probs[pair, z].unsqueeze(-1)
    return belief.new_zeros(*probs.shape, belief.shape[-1]).index_put_((pair, z), belief)
