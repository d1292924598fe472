from __future__ import annotations

import re

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite

from torchrl_pomdp.envs import BeliefModel, FixedBelief, TabularModel
from torchrl_pomdp.envs.repair import RandomState, RepairModel, damage_chain, line
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.noise import uniform
from torchrl_pomdp.problems import make_problem, rocksample, tiger
from torchrl_pomdp.problems.check import check_belief_model

END = 6
WEAR = torch.tensor([[0.7, 0.3], [0.0, 1.0]])
# Levels as they are seen when the machine runs, and when it is inspected.
SEEN = torch.tensor([[[0.8, 0.2], [0.4, 0.6]], [[1.0, 0.0], [0.0, 1.0]]])


class Machine(BeliefModel):
    """A machine that wears out, for so many stages; it can run, be inspected unless it is known, or be replaced."""

    state_keys = ("belief", "stage")
    num_controls, num_observations = 3, 2
    device, dtype = torch.device("cpu"), torch.float32

    def __init__(self):
        super().__init__(0.9)

    def state_spec(self, batch_size=()):
        belief = Bounded(0.0, 1.0, shape=(*batch_size, 2), dtype=torch.float32)
        return Composite(belief=belief, stage=Categorical(END + 1, shape=batch_size), shape=batch_size)

    def action_mask(self, y):
        known = y["belief"].amax(-1) == 1.0
        return torch.stack([torch.ones_like(known), ~known, torch.ones_like(known)], -1)

    def is_terminal(self, y):
        return y["stage"] == END

    def expected_cost(self, y, u):
        cost = 5.0 * y["belief"][..., 1] + torch.tensor([0.0, 1.0, 4.0])[u]
        return torch.where(self.is_terminal(y), 0.0, cost)

    def joint(self, y, u):
        """P(next level j, observation z), [*B, j, z]."""
        now = torch.where((u == 2).unsqueeze(-1), torch.tensor([1.0, 0.0]), y["belief"])
        predicted = sum_first(now.movedim(-1, 0).unsqueeze(-1) * WEAR.view(2, *([1] * u.ndim), 2))
        return predicted.unsqueeze(-1) * SEEN[(u == 1).long()]

    def observation_probs(self, y, u):
        return sum_first(self.joint(y, u).movedim(-2, 0).clone())

    def estimator(self, y, u, z):
        weight = self.joint(y, u).gather(-1, z[..., None, None].expand(*z.shape, 2, 1)).squeeze(-1)
        belief = weight / (weight[..., :1] + weight[..., 1:])
        return self.successor(y, belief=belief, stage=(y["stage"] + 1).clamp(max=END))


def start(keys):
    return TensorDict({"belief": torch.tensor([1.0, 0.0]).expand(*keys.shape, 2).clone(), "stage": keys * 0}, keys.shape)


def test_a_right_model_passes():
    for seed in (0, -5):
        check_belief_model(Machine(), start, seed=seed)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("robots", [1, 2])
def test_repair_models_pass(robots, dtype):
    model = RepairModel(line(4), damage_chain((0.1, 0.2)), (0.0, 1.0, 10.0), 0.9, num_robots=robots, dtype=dtype)
    check_belief_model(model, RandomState(model), seed=1)


def test_problems_pass(line3):
    check_belief_model(line3.model, line3.start)
    two = make_problem("two_robots20")
    check_belief_model(two.model, two.start)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_tabular_models_pass(dtype):
    arrays = tiger().model
    model = TabularModel(arrays.transition, arrays.observation, arrays.cost, 0.95, dtype=dtype)
    check_belief_model(model, FixedBelief(torch.tensor([0.5, 0.5], dtype=dtype)))


class WrongSums(Machine):
    def observation_probs(self, y, u):
        return super().observation_probs(y, u) * 0.9


class WrongShape(Machine):
    def expected_cost(self, y, u):
        return super().expected_cost(y, u).unsqueeze(-1)


class WrongType(Machine):
    def observation_probs(self, y, u):
        return super().observation_probs(y, u).double()


class NothingLegal(Machine):
    def action_mask(self, y):
        return super().action_mask(y) & (y["stage"] != 3).unsqueeze(-1)


class NotNormalised(Machine):
    def estimator(self, y, u, z):
        nxt = super().estimator(y, u, z)
        return self.successor(y, belief=nxt["belief"] * 0.5, stage=nxt["stage"])


class Mutating(Machine):
    def estimator(self, y, u, z):
        y["stage"].add_(1).clamp_(max=END)
        return super().estimator(y, u, z)


class Spending(Machine):
    def expected_cost(self, y, u):
        return super().expected_cost(self.successor(y, belief=y["belief"].mul_(0.5), stage=y["stage"]), u)


class OfTheBatch(Machine):
    def expected_cost(self, y, u):
        return super().expected_cost(y, u) * (1.0 + 0.001 * y.batch_size.numel())


class FlatOnly(Machine):
    def observation_probs(self, y, u):
        return (self.joint(y, u).transpose(0, 1)).sum(0)


class DearEnd(Machine):
    def expected_cost(self, y, u):
        return 5.0 * y["belief"][..., 1] + 1.0


class ComesBack(Machine):
    def estimator(self, y, u, z):
        nxt = super().estimator(y, u, z)
        again = torch.where(y["stage"] == END, 0, nxt["stage"])
        return self.successor(y, belief=nxt["belief"], stage=again)


class OtherSteps(Machine):
    def advance(self, y, u, noise):
        cost, nxt = super().advance(y, u, noise)
        return cost, self.successor(y, belief=(nxt["belief"] + nxt["belief"].flip(-1)) / 2, stage=nxt["stage"])


class OtherOdds(Machine):
    def advance(self, y, u, noise):
        return super().advance(y, u, noise**2)


class SampledCost(Machine):
    def advance(self, y, u, noise):
        cost, nxt = super().advance(y, u, noise)
        return cost + noise[..., 0], nxt


class NoBayes(Machine):
    """Mixed with something that is not linear; sums, odds and sampled steps are all as they should be."""

    def estimator(self, y, u, z):
        nxt = super().estimator(y, u, z)
        predicted = sum_first(self.joint(y, u).movedim(-1, 0).clone())
        belief = 0.9 * nxt["belief"] + 0.1 * predicted.square() / (predicted.square()[..., :1] + predicted.square()[..., 1:])
        return self.successor(y, belief=belief, stage=nxt["stage"])


class RiskAverse(Machine):
    def expected_cost(self, y, u):
        return super().expected_cost(y, u) ** 2


class Forgetful(Machine):
    def fingerprint(self, y):
        return y["stage"] * 7


class Remembers(Machine):
    calls = 0

    def is_terminal(self, y):
        Remembers.calls += 1
        return super().is_terminal(y) & (Remembers.calls % 2 == 0)


class StaleMask(Machine):
    def successor(self, y, **core):
        nxt = super().successor(y, **core)
        return nxt.set("action_mask", y["action_mask"]) if "action_mask" in set(y.keys()) else nxt


class LooseSpec(Machine):
    def state_spec(self, batch_size=()):
        return super().state_spec()


class Cheap(Machine):
    max_cost = 4.5


class FewNames(Machine):
    control_names = ("run", "inspect")


class Uninitialised(Machine):
    def __init__(self):
        pass


class Negative(Machine):
    def observed(self, y, u):
        return super().observed(y, u) - 1


class OneMask(Machine):
    num_agents = 2


class NoAgents(Machine):
    num_agents, num_agent_controls = 2, 2
    num_controls = 4

    def action_mask(self, y):
        return torch.cat([super().action_mask(y), super().action_mask(y)[..., :1]], -1)

    def expected_cost(self, y, u):
        return super().expected_cost(y, u.clamp(max=2))

    def observation_probs(self, y, u):
        return super().observation_probs(y, u.clamp(max=2))

    def estimator(self, y, u, z):
        return super().estimator(y, u.clamp(max=2), z)


class OtherMask(NoAgents):
    def agent_mask(self, y):
        return torch.tensor([True, False]).expand(*y.batch_size, 2, 2)


BROKEN = {
    WrongSums: "observation_probs: every row holds probabilities, not negative, that sum to 1; found row 0 .* sum 0.9",
    WrongShape: r"expected_cost: the .* is a tensor of torch.float32 and shape \(32,\) .*found .* \(32, 1\)",
    WrongType: "observation_probs: .* torch.float32 .* found torch.float64",
    NothingLegal: "action_mask: every state has at least one legal control",
    NotNormalised: "estimator: entry 'belief' is a distribution .*; found a sum of 0.5",
    Mutating: "estimator: a pure function leaves what it is given alone; found stage changed",
    Spending: "expected_cost: a pure function leaves what it is given alone; found belief changed",
    OfTheBatch: "expected_cost: a state gives in a batch what it gives alone, to the last bit",
    FlatOnly: "observation_probs: ",
    DearEnd: "is_terminal: terminal states cost nothing; found expected_cost",
    ComesBack: "is_terminal: a terminal state stays terminal",
    OtherSteps: r"advance: every successor is F\(y, u, z\)",
    OtherOdds: "advance: observations come as often as observation_probs says; found observation",
    SampledCost: "advance: its stage cost is expected_cost",
    NoBayes: r"estimator: by Bayes' rule p\(z \| y, u\) times F\(y, u, z\) is linear in 'belief'",
    RiskAverse: "expected_cost: the expected cost is linear in 'belief'",
    Forgetful: "fingerprint: different states have different fingerprints",
    Remembers: "is_terminal: the same state gives the same result",
    StaleMask: "estimator: action_mask is a function of the core",
    LooseSpec: r"state_spec: the shape of 'belief' is the batch \(7,\)",
    Cheap: "max_cost: no stage cost is larger than max_cost, 4.5",
    Uninitialised: r"__init__: it calls that of BeliefModel; .* Call super\(\).__init__\(discount\) first",
    FewNames: "control_names: it is None or a tuple of 3 different names; found",
    OneMask: r"num_agent_controls: there are 3 controls; found 3\^2 joint controls",
    NoAgents: r"agent_mask: it gives bool \[\d+, 2, 2\], for every agent and its controls; found torch.bool of shape",
    OtherMask: "agent_mask: what is legal jointly is legal for each agent",
    Negative: "observed: names of hidden variables are not negative",
}


@pytest.mark.parametrize("broken", BROKEN, ids=lambda kind: kind.__name__)
def test_each_broken_model_is_told_what_is_wrong(broken):
    with pytest.raises(AssertionError, match=BROKEN[broken]):
        check_belief_model(broken(), start)


def test_tabular_models_are_compared_with_their_arrays():
    class Blind(TabularModel):
        def estimator(self, y, u, z):
            return super().estimator(y, u, z * 0)

        def advance(self, y, u, noise):
            return super().advance(y, u, noise * 0)

    class Shifted(TabularModel):
        def observation_probs(self, y, u):
            return super().observation_probs(y, u).flip(-1)

        def advance(self, y, u, noise):
            return BeliefModel.advance(self, y, u, noise)

    arrays = tiger().model
    for kind, method in ((Blind, "advance|estimator"), (Shifted, "observation_probs")):
        model = kind(arrays.transition, arrays.observation, arrays.cost, 0.95)
        with pytest.raises(AssertionError, match=method):
            check_belief_model(model, FixedBelief(torch.tensor([0.5, 0.5])))


def test_generators_are_looked_at():
    def other(keys):
        y = start(keys)
        return y.set("stage", torch.full_like(keys, keys.numel() % END))

    with pytest.raises(AssertionError, match="generator of start states: a key has the same state in every batch"):
        check_belief_model(Machine(), other)
    with pytest.raises(ValueError, match="outside its bounds"):
        check_belief_model(Machine(), lambda keys: start(keys).set("stage", keys * 0 + 99))
    with pytest.raises(AssertionError, match="terminal states alone"):
        check_belief_model(Machine(), lambda keys: start(keys).set("stage", keys * 0 + END))


def test_wrong_arguments_are_refused():
    with pytest.raises(TypeError, match="model must be a BeliefModel"):
        check_belief_model(tiger(), start)
    with pytest.raises(TypeError, match="generator must be callable"):
        check_belief_model(Machine(), 3)
    with pytest.raises(TypeError, match="seed must be an integer"):
        check_belief_model(Machine(), start, seed=0.5)


class SeldomOver(TabularModel):
    """One of many terminal states is left now and then."""

    def is_terminal(self, y):
        return y["belief"][..., 1:].sum(-1) == 1.0


def test_a_single_terminal_state_that_is_left_is_found():
    size = 48
    moves = torch.eye(size).expand(1, size, size).clone()
    moves[0, 0, 1:], moves[0, 0, 0] = 1.0 / (size - 1), 0.0
    moves[0, 1, 0], moves[0, 1, 1] = 0.04, 0.96
    cost = torch.zeros(1, size)
    cost[0, 0] = 1.0
    model = SeldomOver(moves, torch.eye(size).expand(1, size, size), cost, 0.9)
    with pytest.raises(AssertionError, match="is_terminal: a terminal state stays terminal"):
        check_belief_model(model, FixedBelief(torch.eye(size)[0]))


class Observes(Machine):
    """An entry of a name that an environment's own has."""

    state_keys = ("observation",)


def test_an_entry_may_not_have_the_name_of_what_is_seen():
    with pytest.raises((AssertionError, ValueError), match="observation"):
        check_belief_model(Observes(), start)


def scaled(kind, unit):
    model = tiger().model
    found = kind(model.transition, model.observation, unit * model.cost, model.discount)
    # It would be found out by its bound of costs.
    found.max_cost = None
    return found


class Thrice(TabularModel):
    """A sampled step costs three times what is expected."""

    def advance(self, y, u, noise):
        cost, nxt = super().advance(y, u, noise)
        return 3 * cost, nxt


class Curved(TabularModel):
    """A stage cost that is no expectation."""

    def expected_cost(self, y, u):
        return super().expected_cost(y, u) * (1 + y["belief"][..., 0])


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_the_unit_of_costs_changes_no_verdict(unit):
    check_belief_model(scaled(TabularModel, unit), tiger().start)
    with pytest.raises(AssertionError, match="advance: its stage cost is expected_cost"):
        check_belief_model(scaled(Thrice, unit), tiger().start)
    with pytest.raises(AssertionError, match="expected_cost: "):
        check_belief_model(scaled(Curved, unit), tiger().start)


def test_large_costs_that_cancel_out_are_no_fault():
    """What is left of them is rounded as they are."""
    costs = [[1e6, -1e6, 3.0], [1e6, -1e6, 3.0]]
    model = TabularModel(torch.eye(3).expand(2, 3, 3), torch.ones(2, 3, 1), costs, 0.9)

    def start(keys):
        first, little = 0.1 + 0.3 * uniform(keys, 0), 1e-5 * uniform(keys, 1)
        return TensorDict({"belief": torch.stack([first + little, first, 1 - 2 * first - little], -1)}, keys.shape)

    check_belief_model(model, start)


class Surcharge(TabularModel):
    """A sampled step costs 2 more than is expected."""

    def advance(self, y, u, noise):
        cost, nxt = super().advance(y, u, noise)
        return cost + 2.0, nxt


def test_an_expensive_state_hides_no_fault_elsewhere():
    """Such as one that stands for what is forbidden, and is never met."""
    model = Surcharge(torch.eye(3).expand(1, 3, 3), torch.ones(1, 3, 1), [[1.0, 3.0, 1e6]], 0.9)
    with pytest.raises(AssertionError, match="advance: its stage cost is expected_cost"):
        check_belief_model(model, FixedBelief(torch.tensor([0.5, 0.5, 0.0])))


@pytest.mark.parametrize("name", ["rocksample(5, 2)", "rocksample(40, 1)"])
def test_probabilities_that_add_up_to_one_by_chance_are_no_distribution(name):
    size, rocks = map(int, re.findall(r"\d+", name))
    problem = rocksample(size, rocks)
    check_belief_model(problem.model, problem.start)
