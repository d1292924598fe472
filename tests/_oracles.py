"""Oracles written from the statement of the problem, independent of the library's kernels."""

from __future__ import annotations

from itertools import product

import torch
from tensordict import TensorDict

from torchrl_pomdp.envs.repair import RepairModel, UniformStart, damage_chain, line
from torchrl_pomdp.envs.rows import take_rows

COSTS = (0.0, 0.1, 1.0, 10.0, 100.0)

# Optimal discounted costs of small problems, from an independent point-based solver (lower and upper bound).
LINE3_OPTIMUM = (168.962, 168.971)
LINE3_OPTIMUM_BY_START_LEVEL = (124.745, 125.923, 138.044, 183.060, 273.060)


def small_model(graph=None, num_robots=1, degradation=(0.0, 0.3), costs=(0.0, 1.0, 5.0), dtype=torch.float64, **kw):
    graph = line(3) if graph is None else graph
    return RepairModel(graph, damage_chain(degradation), costs, 0.9, num_robots=num_robots, dtype=dtype, **kw)


def varied_model(graph=None, num_robots=1, seed=0, repair_probability=0.6, dtype=torch.float64, **kw):
    """A model whose locations have chains and costs of their own, with drift, and whose repairs may fail."""
    graph = line(3) if graph is None else graph
    generator = torch.Generator().manual_seed(seed)
    chain = torch.rand(graph.num_locations, 3, 3, generator=generator, dtype=torch.float64)
    chain = chain * (torch.rand(chain.shape, generator=generator, dtype=torch.float64) < 0.7) + torch.eye(3) * 0.1
    costs = torch.rand(graph.num_locations, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.5, 2.0, 9.0])
    options = {"num_robots": num_robots, "repair_probability": repair_probability, "dtype": dtype}
    return RepairModel(graph, chain / chain.sum(-1, keepdim=True), costs, 0.9, **options, **kw)


def random_states(model: RepairModel, count: int, seed: int) -> TensorDict:
    """Random beliefs, some of them certain, robots having observed or not."""
    generator = torch.Generator().manual_seed(seed)
    shape = (count, model.num_locations, model.num_levels)
    belief = torch.rand(shape, generator=generator, dtype=model.dtype) ** 2
    certain = torch.eye(model.num_levels, dtype=model.dtype)[torch.randint(model.num_levels, shape[:2], generator=generator)]
    belief = torch.where(torch.rand(shape[:2], generator=generator).unsqueeze(-1) < 0.4, certain, belief)
    location = torch.randint(model.num_locations, (count, model.num_robots), generator=generator)
    return TensorDict({"belief": belief / belief.sum(-1, keepdim=True), "location": location}, [count])


def exact_cost(model: RepairModel, policy, y: TensorDict, max_steps: int = 400, prune: float = 1e-7) -> float:
    """Expected discounted cost of a policy from one state ``y``, by expanding all observations and merging equal states."""
    y = model.with_features(y.reshape(1))
    weight, total, discount = torch.ones(1, dtype=torch.float64), 0.0, 1.0
    for _ in range(max_steps):
        keep = (~model.is_terminal(y) & (weight > prune)).nonzero().squeeze(-1)
        if keep.numel() == 0:
            break
        y, weight = take_rows(y, keep), weight[keep]
        u = policy(y.copy())["action"]
        assert y["action_mask"].gather(1, u.unsqueeze(1)).all()
        total += discount * float((weight * model.expected_cost(y, u)).sum())
        discount *= model.discount
        probs = model.observation_probs(y, u).double()
        row, z = (probs > 0).nonzero(as_tuple=True)
        y, weight = model.estimator(take_rows(y, row), u[row], z), weight[row] * probs[row, z]
        key, inverse = model.fingerprint(y).unique(return_inverse=True)
        first = torch.zeros(len(key), dtype=torch.int64).scatter_(0, inverse.flip(0), torch.arange(len(z)).flip(0))
        y, weight = take_rows(y, first), torch.zeros(len(key), dtype=torch.float64).index_add_(0, inverse, weight)
    return total


def line3_cost(model: RepairModel, policy, robots=(0,)) -> tuple[float, list[float]]:
    """Exact cost of a policy on the line of 3 from the uniform prior, the start observed; also for each start level."""
    start = UniformStart(model, robots, observe_start=False)(torch.arange(1))
    by_level = []
    for level in range(model.num_levels):
        y = start.clone()
        y["belief"][0, robots[0]] = torch.eye(model.num_levels, dtype=model.dtype)[level]
        by_level.append(exact_cost(model, policy, y))
    return sum(by_level) / len(by_level), by_level


class Memo:
    """A deterministic policy, computed once for every distinct state."""

    def __init__(self, model, policy):
        self.model, self.policy, self.known = model, policy, {}
        self.in_keys = [*model.state_keys, "action_mask"]

    def __call__(self, y):
        keys, inverse = self.model.fingerprint(y).unique(return_inverse=True)
        first = torch.zeros(len(keys), dtype=torch.int64).scatter_(0, inverse, torch.arange(len(inverse)))
        new = torch.tensor([key not in self.known for key in keys.tolist()])
        if new.any():
            u = self.policy(y[first[new]].clone())["action"]
            self.known.update(zip(keys[new].tolist(), u.tolist(), strict=True))
        return y.set("action", torch.tensor([self.known[key] for key in keys.tolist()])[inverse])


def joint_states(model: RepairModel) -> torch.Tensor:
    """All joint damage levels, ``[K^L, L]``."""
    return torch.tensor(list(product(range(model.num_levels), repeat=model.num_locations)))


def brute_force(model: RepairModel, belief: torch.Tensor, location: list[int], controls: list[int]):
    """Bayes over the joint state for one row: stage cost, P(z) over joint observations, posterior marginals for each z.

    Written from the problem's statement alone: enumerates every joint state and its successors.
    """
    states = joint_states(model)
    chain, costs = model.chain.expand(model.num_locations, -1, -1), model.costs.expand(model.num_locations, -1)
    works = model.repair_probability
    size, levels, robots = model.num_locations, model.num_levels, model.num_robots
    prior = torch.stack([belief[i, states[:, i]] for i in range(size)]).prod(0)
    cost = float((prior * sum(costs[i, states[:, i]] for i in range(size))).sum())
    table = model.graph.neighbours.tolist()
    after = [place if c == 0 else table[place][c - 1] for place, c in zip(location, controls, strict=True)]
    repaired = {place for place, c in zip(location, controls, strict=True) if c == 0}
    z_probs, posterior = {}, {}
    for state, p in zip(states.tolist(), prior.tolist(), strict=True):
        if p == 0:
            continue
        options = []
        for i, level in enumerate(state):
            grown = [(k, float(chain[i, level, k])) for k in range(levels) if chain[i, level, k] > 0]
            failed = [(k, (1.0 - works) * q) for k, q in grown] if works < 1.0 else []
            options.append([(0, works), *failed] if i in repaired else grown)
        for outcome in product(*options):
            weight, nxt = p, []
            for level, q in outcome:
                weight *= q
                nxt.append(level)
            z = 0
            for robot in range(robots):
                z = z * levels + nxt[after[robot]]
            z_probs[z] = z_probs.get(z, 0.0) + weight
            marginal = posterior.setdefault(z, torch.zeros(size, levels, dtype=torch.float64))
            for i, level in enumerate(nxt):
                marginal[i, level] += weight
    return cost, z_probs, {z: m / z_probs[z] for z, m in posterior.items()}, after
