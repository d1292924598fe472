from __future__ import annotations

import json
import threading
from itertools import product

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Binary

from torchrl_pomdp.controller import Controller, Decision
from torchrl_pomdp.envs import SinglePart, TabularModel
from torchrl_pomdp.envs.repair import RepairModel, damage_chain, line
from torchrl_pomdp.modules import Myopic, RolloutPolicy
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.problems import make_problem, tiger

CHAIN = damage_chain((0.1, 0.3))
LEVELS = 3


def two_robots(**options):
    return RepairModel(line(4), CHAIN, (0.0, 1.0, 10.0), 0.9, num_robots=2, dtype=torch.float64, **options)


def prior(location=(0, 2)):
    belief = torch.tensor([[0.5, 0.3, 0.2], [0.2, 0.8, 0.0], [1.0, 0.0, 0.0], [0.1, 0.2, 0.7]], dtype=torch.float64)
    return TensorDict({"belief": belief, "location": torch.tensor(location)})


class Filter:
    """Weights of all joint levels, by the problem's statement alone."""

    def __init__(self, belief, location):
        self.weight = {s: float(torch.tensor([belief[i][k] for i, k in enumerate(s)]).prod()) for s in self.states(belief)}
        self.place = list(location)

    @staticmethod
    def states(belief):
        return product(range(LEVELS), repeat=len(belief))

    def see(self, levels):
        seen = [(place, level) for place, level in zip(self.place, levels, strict=True) if level is not None]
        kept = {s: w for s, w in self.weight.items() if all(s[place] == level for place, level in seen)}
        self.weight = {s: w / sum(kept.values()) for s, w in kept.items()}

    def act(self, controls):
        repaired = {place for place, c in zip(self.place, controls, strict=True) if c == 0}
        after = {}
        for s, w in self.weight.items():
            chances = [[(k, float(CHAIN[level, k])) for k in range(LEVELS)] for level in s]
            options = [[(0, 1.0)] if i in repaired else chance for i, chance in enumerate(chances)]
            for outcome in product(*options):
                nxt = tuple(k for k, _ in outcome)
                after[nxt] = after.get(nxt, 0.0) + w * float(torch.tensor([p for _, p in outcome]).prod())
        self.weight = after
        self.place = [place + (0, -1, 1)[c] for place, c in zip(self.place, controls, strict=True)]

    def marginals(self):
        total = sum(self.weight.values())
        size = len(next(iter(self.weight)))
        each = [[sum(w for s, w in self.weight.items() if s[i] == k) / total for k in range(LEVELS)] for i in range(size)]
        return torch.tensor(each, dtype=torch.float64)


def agree(controller, exact):
    torch.testing.assert_close(controller.state["belief"], exact.marginals(), rtol=1e-6, atol=1e-6)
    assert controller.state["location"].tolist() == exact.place


def test_two_robots_with_missing_reports_agree_with_brute_force():
    controller = Controller(two_robots(), lambda y: y.set("action", y["action_mask"].to(torch.int8).argmax(-1)))
    controller.reset(prior())
    exact = Filter(prior()["belief"].tolist(), (0, 2))
    agree(controller, exact)
    controller.observe([None, 0])
    exact.see([None, 0])
    agree(controller, exact)
    controller.observe((1, None))
    exact.see([1, None])
    agree(controller, exact)
    step(controller, exact, ("repair", "left"), (None, 1))
    # Both stand where the second one repairs: level 0 is certain.
    with pytest.raises(ValueError, match=r"robot 0 must be possible: level 1 at location 1 .* allows levels \[0\]"):
        controller.update(("right", "repair"), (1, None))
    step(controller, exact, ("right", "repair"), (0, None))
    step(controller, exact, ("left", 2), None)
    step(controller, exact, (0, "repair"), (None, None))
    step(controller, exact, ("right", "left"), (None, 1))
    step(controller, exact, (2, 2), [2, None])
    assert controller.steps == 6


def step(controller, exact, controls, levels):
    controller.update(controls, levels)
    exact.act([c if isinstance(c, int) else ("repair", "left", "right").index(c) for c in controls])
    exact.see(levels or (None, None))
    agree(controller, exact)


def test_robots_that_stand_together_must_report_the_same():
    controller = Controller(two_robots(), Myopic(two_robots()))
    controller.reset(prior((1, 1)))
    with pytest.raises(ValueError, match=r"observation of robot 1 must be possible: level 1 at location 1 .*levels \[0\]"):
        controller.observe([0, 1])
    controller.observe([1, 1])
    assert controller.state["belief"][1].tolist() == [0.0, 1.0, 0.0]


def test_decisions_are_those_of_the_policy(linear20):
    model = linear20.model
    policy = RolloutPolicy(model, GreedyRepair(model), trajectories=2)
    controller = Controller(model, policy)
    y = linear20.start(torch.tensor([5]))
    controller.reset(y)
    for _ in range(6):
        u = policy(model.with_features(y))["action"]
        assert controller.act() == Decision(int(u), (model.graph.control_names[int(u)],))
        z = model.observation_probs(y, u).argmax(-1)
        y = model.estimator(y, u, z)
        controller.update(int(u), int(z))
        assert all(torch.equal(controller.state[key], y[key][0]) for key in model.state_keys)
    assert not controller.finished


def text(controller):
    return controller.to_json()


def worse_pipes():
    """A controller of a model that is described in the same words: pipes that fail twice as fast."""
    model = two_robots()
    other = RepairModel(model.graph, model.chain @ model.chain, model.costs, model.discount, num_robots=2, dtype=model.dtype)
    assert other.describe() == model.describe()
    controller = Controller(other, Myopic(other))
    controller.reset(prior())
    return controller


def test_a_state_is_taken_over_where_the_partition_is_another():
    first, model = Controller(two_robots(), Myopic(two_robots())), two_robots().with_partition(SinglePart())
    first.reset(prior())
    second = Controller(model, Myopic(model))
    second.load_json(first.to_json())
    assert all(torch.equal(second.state[key], first.state[key]) for key in model.state_keys)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda c: c.update(("left", "left"), (0, 0)), ValueError, "control must be legal here, got left, left; legal are"),
        (
            lambda c: c.update(("right", "up"), (0, 0)),
            ValueError,
            "control of robot 1 must be one of repair, left, right",
        ),
        (lambda c: c.update(9, (0, 0)), ValueError, "control must be at most 8, got 9"),
        (lambda c: c.update(-1, (0, 0)), ValueError, "control must be at least 0, got -1"),
        (lambda c: c.update("right", (0, 0)), TypeError, "control must be a sequence, one for each of the 2 robots"),
        (lambda c: c.update(("right",), (0, 0)), ValueError, "control must hold one for each of the 2 robots"),
        (lambda c: c.update(1.5, (0, 0)), TypeError, "control must be a sequence"),
        (lambda c: c.update(("right", "right"), (0, 3)), ValueError, "observation of robot 1 must be at most 2, got 3"),
        (lambda c: c.update(("right", "right"), (0, -1)), ValueError, "observation of robot 1 must be at least 0"),
        (lambda c: c.update(("right", "right"), (0, "bad")), ValueError, "observation of robot 1 must be a number in 0..2"),
        (lambda c: c.update(("right", "right"), (0, 0.5)), TypeError, "observation of robot 1 must be an integer"),
        (lambda c: c.update(("right", "right"), 0), TypeError, "observation must be a sequence, one for each of the 2"),
        (lambda c: c.update(("right", "right"), (0,)), ValueError, "observation must hold one for each of the 2 robots"),
        (lambda c: c.update(("repair", "right"), (1, None)), ValueError, r"robot 0 must be possible: level 1 at location 0"),
        (lambda c: c.observe((0, 1)), ValueError, r"robot 1 must be possible: level 1 at location 2 .* levels \[0\]"),
        (lambda c: c.reset(prior().set("belief", torch.zeros(4, 3, dtype=torch.float64))), ValueError, "sum to 1"),
        (lambda c: c.reset(prior().exclude("location")), ValueError, "lacks the entry 'location'"),
        (lambda c: c.reset(torch.stack([prior(), prior()])), ValueError, r"prior must be a single feature state"),
        (lambda c: c.reset({"belief": 0}), TypeError, "prior must be a TensorDictBase"),
        (lambda c: c.load_json("{}"), ValueError, "text must be what to_json gave"),
        (lambda c: c.load_json("no JSON"), ValueError, "text must be what to_json gave"),
        (lambda c: c.load_json(text(c).replace("line of 4", "line of 5")), ValueError, "text must be what to_json gave"),
        (lambda c: c.load_json(text(c).replace("0.5", "0.9", 1)), ValueError, "sum to 1"),
        (lambda c: c.load_json(text(worse_pipes())), ValueError, "text must be what to_json gave for the model"),
    ],
)
def test_what_is_refused_changes_nothing(call, error, message):
    controller = Controller(two_robots(), Myopic(two_robots()))
    controller.reset(prior())
    before = controller.to_json()
    with pytest.raises(error, match=message):
        call(controller)
    assert controller.to_json() == before


def test_the_order_of_calls_matters():
    problem = tiger()
    controller = Controller(problem.model, Myopic(problem.model))
    for call in (controller.act, lambda: controller.update(0, 0), lambda: controller.observe(0), controller.to_json):
        with pytest.raises(ValueError, match=r"call reset\(prior\) first"):
            call()
    controller.reset(problem.start(torch.tensor(0)))
    with pytest.raises(ValueError, match="observation must wait for a control: TabularModel sees nothing before"):
        controller.observe(0)
    repair = Controller(two_robots(), Myopic(two_robots()))
    repair.reset(prior())
    repair.update(("right", "right"), None)
    with pytest.raises(ValueError, match="observe is for the first look, got it after 1 controls"):
        repair.observe((0, 0))


def test_tiger_by_names():
    problem = tiger()
    model = problem.model
    model.control_names, model.observation_names = ("listen", "open left", "open right"), ("hear left", "hear right")
    controller = Controller(model, Myopic(model))
    controller.reset(problem.start(torch.tensor(0)))
    assert controller.act() == Decision(0, ("listen",))
    controller.update("listen", "hear left")
    torch.testing.assert_close(controller.state["belief"], torch.tensor([0.85, 0.15]))
    with pytest.raises(ValueError, match="observation must be one of hear left, hear right, got 'silence'"):
        controller.update("listen", "silence")
    with pytest.raises(ValueError, match="control must be one of listen, open left, open right, got 'wait'"):
        controller.update("wait", 0)
    with pytest.raises(TypeError, match="observation must be an integer, got None"):
        controller.update("listen", None)
    controller.update(0, 0)
    torch.testing.assert_close(controller.state["belief"][0], torch.tensor(0.85**2 / (0.85**2 + 0.15**2)))
    nameless = Controller(tiger().model, Myopic(tiger().model))
    nameless.model.control_names = None
    nameless.reset(problem.start(torch.tensor(0)))
    assert nameless.act().names == ("0",)
    with pytest.raises(ValueError, match=r"control must be a number in 0\.\.2, got 'listen': the model has no names for it"):
        nameless.update("listen", 0)


def test_an_impossible_observation_of_a_tabular_model_is_refused():
    from torchrl_pomdp.envs import TabularModel

    stay, see = torch.eye(2).unsqueeze(0), torch.eye(2).unsqueeze(0)
    model = TabularModel(stay, see, torch.zeros(1, 2), 0.9)
    controller = Controller(model, Myopic(model))
    controller.reset(TensorDict({"belief": torch.tensor([1.0, 0.0])}))
    with pytest.raises(ValueError, match="observation must be possible after this control, one of 0; got 1"):
        controller.update(0, 1)
    assert controller.steps == 0


def test_illegal_controls_of_the_policy_are_refused():
    controller = Controller(two_robots(), lambda y: y.set("action", torch.tensor([4])))
    controller.reset(prior())
    with pytest.raises(ValueError, match=r"action 4 at batch index .* is illegal"):
        controller.act()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_state_in_a_file_gives_the_same_decisions(dtype):
    model = RepairModel(line(4), CHAIN, (0.0, 1.0, 10.0), 0.9, num_robots=2, dtype=dtype)
    policy = RolloutPolicy(model, GreedyRepair(model), trajectories=3)
    first, second = Controller(model, policy), Controller(model, policy)
    first.reset(prior())
    first.update(("right", "right"), (1, None))
    for _ in range(4):
        second.load_json(json.dumps(json.loads(first.to_json())))
        assert all(torch.equal(first.state[key], second.state[key]) for key in model.state_keys)
        assert first.act() == second.act()
        first.update(first.act().control, None)


def test_truth_values_are_part_of_a_state():
    class Lamp(TabularModel):
        state_keys = ("belief", "on")

        def state_spec(self, batch_size=()):
            spec = super().state_spec(batch_size)
            return spec.set("on", Binary(shape=batch_size, dtype=torch.bool))

    model = Lamp(torch.ones(1, 1, 1), torch.ones(1, 1, 1), torch.ones(1, 1), 0.9)
    first, second = (Controller(model, lambda y: y.set("action", torch.zeros(y.batch_size, dtype=torch.int64))) for _ in "ab")
    first.reset(TensorDict({"belief": torch.ones(1), "on": torch.tensor(True)}))
    second.load_json(first.to_json())
    assert second.state["on"].dtype == torch.bool
    assert bool(second.state["on"])
    with pytest.raises(ValueError, match=r"on must hold numbers of type torch\.bool, got 1"):
        second.load_json(first.to_json().replace("true", "1"))


def test_a_model_that_no_text_can_tell_is_named():
    class Locked(RepairModel):
        def __init__(self, *args):
            super().__init__(*args)
            self.lock = threading.Lock()

    model = Locked(line(4), CHAIN, (0.0, 1.0, 10.0), 0.9)
    control = Controller(model, GreedyRepair(model))
    control.reset(prior((0,)).to(torch.float32).set("location", torch.tensor([0])))
    for call in (control.to_json, lambda: control.load_json("{}")):
        with pytest.raises(TypeError, match=r"what a _thread\.lock holds cannot be told"):
            call()


@pytest.mark.parametrize("online", [False, True])
def test_a_checkpoint_becomes_a_controller(tmp_path, online):
    from torchrl_pomdp.config import PolicyIterationConfig
    from torchrl_pomdp.trainers.architecture import make_networks, make_values
    from torchrl_pomdp.trainers.checkpoint import Checkpoint, save_checkpoint

    problem, config = make_problem("line3"), PolicyIterationConfig()
    policy, value = make_networks(problem, config, seed=0), make_values(problem, config, seed=0)
    save_checkpoint(tmp_path / "policy.pt", Checkpoint(problem, config, "pAPI-NT", 1, policy, value))
    controller = Controller.from_checkpoint(tmp_path / "policy.pt", online=online)
    given = controller.policy
    assert isinstance(given, RolloutPolicy) == online
    # As evaluations measure it: nothing is added where simulations end.
    assert not online or given.cost_to_go.terminal_cost is None
    trained = given.cost_to_go.base_policy if online else given
    y = problem.model.with_features(problem.start(torch.arange(20)))
    assert torch.equal(trained(y.copy())["action"], policy(y.copy())["action"])
    with pytest.raises(TypeError, match="online must be True or False"):
        Controller.from_checkpoint(tmp_path / "policy.pt", online=1)
    with pytest.raises(ValueError, match="there is no checkpoint"):
        Controller.from_checkpoint(tmp_path / "no.pt")
