"""Cases of the test of refusals: belief models, environments, policies and simulations.

From a folder that may be written to, the case of each public callable: its arguments with a valid value and what they must not
be. Set by hand, a line for each argument.
"""

from __future__ import annotations

import torch
from _hostile import (
    HUGE,
    INF,
    NAN,
    Hostile,
    choices,
    devices,
    dtypes,
    entries,
    flags,
    generators,
    integers,
    keys,
    mappings,
    no_states,
    not_callable,
    numbers,
    objects,
    probabilities,
    seeds,
    sequences,
    sizes,
    states,
    tensors,
    texts,
    values,
    wrong_actions,
)
from _valid import (
    CHAIN,
    COSTS,
    KEYS,
    a_policy,
    a_start,
    belief_model,
    case,
    env,
    greedy,
    model,
    network,
    on_entries,
    on_keys,
    on_tensordict,
    policy_cost,
    problem,
    repair_model,
    rng,
    rollout,
    simulation,
    start,
    state,
    truncated,
    two_robots,
    value_network,
)
from tensordict import TensorDictBase

from torchrl_pomdp import envs, modules, problems
from torchrl_pomdp.envs import Mixture, SinglePart, TabularModel, repair
from torchrl_pomdp.envs.repair import Graph, RepairModel
from torchrl_pomdp.modules import FlatEncoder, OnEntering, RolloutPolicy, ZeroCost
from torchrl_pomdp.modules import repair as repair_modules
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost

__all__ = ["ENVS", "MODULES"]

# fmt: off

SLOTS = [[-1, 1], [0, 2], [1, -1]]
# Ragged, off the graph, no integers, one-way, to itself, in two pieces.
WRONG_SLOTS = sequences(SLOTS, [], [0], [1, 3], [1, -2], [1, NAN], [1, 1.5], [1, None], [1, "2"], [1, HUGE], [-1, -1], [1, 2])
COORDINATES = sequences((0, 1, 2), NAN, INF, "2", None, 1j, [2], 1e39, 10**400, free=False)
# The last leaves a location without an edge.
WRONG_EDGES = [(0,), (0, 1, 2), (0, 0), (0, 3), (0, -1), (0, 1.5), (0, "1"), (0, None), (0, True), (0, HUGE), 3, None, (0, 1)]
PARTS = [-1, 1.5, True, "0", None, NAN, [0]]
SHAPES = [-1, 1.5, "2", None, NAN, [2]]
BELIEF = torch.full((2,), 0.5)
STAY = torch.eye(2).repeat(3, 1, 1)
HEAR = torch.full((3, 2, 4), 0.25)

# A robot of two is lost.
TWO, ONE = (RepairModel(repair.line(2), CHAIN, COSTS, 0.9, num_robots=robots) for robots in (2, 1))


def play(of):
    """Use a model."""
    RolloutPolicy(of, GreedyRepair(of), trajectories=1, terminal_cost=ZeroCost())(repair.CalibratedStart(of)(KEYS))


ENVS = {
    "envs.repair.line": lambda _: case(repair.line, num_locations=(3, integers(1))),
    "envs.repair.grid": lambda _: case(
        repair.grid,
        width=(3, integers(1)),
        height=(2, integers(1)),
        obstacles=([(1, 0)], values(None, 3, "x", [3], [(1,)], [(1, 0.5)], [(3, 0)], [(1, 0), (1, 0)], [(1, 0), (1, 1)])),
    ),
    "envs.repair.Graph.without_edge": lambda _: case(
        repair.grid(2, 2).without_edge, first=(0, integers(0, 3)), second=(1, [*integers(0, 3), *values(0, 3)])
    ),
    "envs.repair.Graph.from_slots": lambda _: case(
        Graph.from_slots,
        name=("pipe", texts()),
        neighbours=(SLOTS, WRONG_SLOTS),
        slot_names=(("left", "right"), sequences(("left", "right"), 1, None, "", "\x1b[31m", free=False)),
        columns=([0, 1, 2], [*COORDINATES, *values((0, 0, 1))]),
        rows=([0, 0, 0], COORDINATES),
        location_names=(("a", "b", "c"), sequences(("a", "b", "c"), "a", "", 3, None, free=False, empty=False)),
    ),
    "envs.repair.Graph.from_edges": lambda _: case(
        Graph.from_edges,
        name=("pipe", texts()),
        num_locations=(3, integers(1)),
        edges=([(0, 1), (1, 2)], sequences([(0, 1), (1, 2)], *WRONG_EDGES)),
        columns=([0, 1, 2], [*COORDINATES, *values((0, 0, 1))]),
        rows=([0, 0, 0], COORDINATES),
        location_names=(("a", "b", "c"), sequences(("a", "b", "c"), "a", "", 3, None, free=False, empty=False)),
    ),
    "envs.repair.damage_chain": lambda _: case(
        repair.damage_chain,
        degradation=((0.0, 0.3), [*sequences((0.0, 0.3), NAN, INF, -1e-9, 1.1, "0.5", None, [0.1], 1j, 10**400), *values(0.5)]),
    ),
    "envs.repair.RepairModel": lambda _: case(
        RepairModel, play,
        graph=(repair.line(3), objects(Graph)),
        chain=(CHAIN, probabilities(CHAIN)),
        costs=(COSTS, tensors(COSTS, -1.0) + values((0.0, 1e39), (0.0, 1e300), ("0", "1"), (0.0, None), (0.0, 10**400))),
        discount=(0.9, numbers("(0, 1)")),
        num_robots=(1, integers(1)),
        repair_probability=(0.5, numbers("(0, 1]")),
        terminal_probability=(0.0, numbers("[0, 1)")),
        partition=(SinglePart(), objects(SinglePart)),
        dtype=(torch.float32, dtypes()),
        device=("cpu", devices()),
    ),
    "envs.BeliefModel.check_state": lambda _: case(model().check_state, y=(state(), states(state()))),
    "envs.BeliefModel.with_features": lambda _: case(
        model().with_features,
        y=(state(), states(state())),
        keys=(("action_mask",), values(3, True, NAN, "action_mask", object())),
    ),
    "envs.TabularModel": lambda _: case(
        TabularModel,
        transition=(STAY, probabilities(STAY)),
        observation=(HEAR, probabilities(HEAR, free=True)),
        cost=(torch.ones(3, 2), tensors(torch.ones(3, 2)) + values([[0.0, 1e39]] * 3, [[0.0, 1e300]] * 3)),
        discount=(0.9, numbers("(0, 1)")),
        legal=(None, values(3, "x", [], torch.ones(3, 2, dtype=torch.bool), torch.zeros(2, 3, dtype=torch.bool))),
        terminal=(None, values(3, "x", [], torch.zeros(3, dtype=torch.bool), torch.ones(2, dtype=torch.bool))),
        state_names=(None, sequences(("a", "b"), "a", 3, "")),
        control_names=(None, sequences(("a", "b", "c"), "a", 3, "")),
        observation_names=(None, sequences(("a", "b"), "a", 3, "")),
        partition=(SinglePart(), objects(SinglePart)),
        dtype=(torch.float32, dtypes()),
        device=("cpu", devices()),
    ),
    "problems.tiger": lambda _: case(
        problems.tiger, discount=(0.9, numbers("(0, 1)")), name=("tiger", texts()), device=("cpu", devices())
    ),
    "envs.BeliefEnv": lambda _: case(
        envs.BeliefEnv, lambda made: made.rollout(2),
        model=belief_model(),
        generator=a_start(),
        batch_size=((2,), sequences((2,), *SHAPES, empty=False)),
        seed=(0, seeds()),
    ),
    # What is no TensorDict is TorchRL's to refuse.
    "envs.BeliefEnv.reset": lambda _: case(
        lambda tensordict: env().reset(tensordict, set_state=True),
        tensordict=(state(), [wrong for wrong in states(state()) if isinstance(wrong.value, TensorDictBase)]),
    ),
    "envs.BeliefEnv.step": lambda _: on_tensordict(
        env().step, (greedy()(state()), [Hostile("no action", state(), names=("action",)), *wrong_actions(state())])
    ),
    "envs.repair.UniformStart": lambda _: case(
        repair.UniformStart,
        model=repair_model(),
        robots=((0,), sequences((0,), -1, 3, HUGE, 1.5, True, "0", None, NAN, [0], free=False)),
        observe_start=(True, flags()),
    ),
    "envs.repair.UniformStart.__call__": lambda _: on_keys(repair.UniformStart(model())),
    "envs.repair.CalibratedStart": lambda _: case(
        repair.CalibratedStart,
        model=repair_model(),
        damaged_fraction=(0.7, numbers("(0, 1]")),
        observe_start=(True, flags()),
    ),
    "envs.repair.CalibratedStart.__call__": lambda _: on_keys(repair.CalibratedStart(model())),
    "envs.repair.RandomState": lambda _: case(
        repair.RandomState, lambda made: made(KEYS),
        model=repair_model(),
        fractions=((0.2, 1.0), sequences((0.2, 1.0), 0.1, -0.1, 1.1, NAN, INF, "1", None, [1.0], 10**400, free=False)),
        max_age=(4, integers(0)),
    ),
    "envs.repair.RandomState.__call__": lambda _: on_keys(repair.RandomState(model())),
    "envs.InPart": lambda _: case(
        envs.InPart, lambda made: made(KEYS),
        model=(model(), objects(RepairModel, problems.tiger().model, two_robots())),
        proposal=(repair.RandomState(model()), generators(start())),
        part=(4, integers(0, 5)),
        max_tries=(500, integers(1)),
    ),
    "envs.InPart.__call__": lambda _: on_keys(problem().training[4]),
    "envs.Mixture": lambda _: case(
        Mixture,
        generators=([start(), start()], [
            # Whether there are too few of them or too many weights, who knows.
            value._replace(names=("weights",)) for value in sequences([start(), start()], None, 3, "x", free=False)
        ]),
        weights=([1.0, 2.0], [
            *sequences([1.0, 2.0], -1.0, NAN, INF, "1", None, 1j, [1.0], 10**400, free=False), *values([0.0, 0.0])
        ]),
    ),
    "envs.Mixture.__call__": lambda _: on_keys(Mixture([start()], [1.0])),
    "envs.FixedBelief": lambda _: case(envs.FixedBelief, belief=(BELIEF, probabilities(BELIEF, free=True))),
    "envs.FixedBelief.__call__": lambda _: on_keys(envs.FixedBelief(BELIEF)),
    "envs.repair.RepairPartition": lambda _: case(
        repair.RepairPartition,
        graph=(repair.line(3), objects(Graph)),
        costs=(COSTS, tensors(COSTS, -1.0, free=True)),
        damage_threshold=(0.0, numbers("[0, 1)")),
        device=("cpu", devices()),
    ),
    "envs.repair.RepairPartition.forward": lambda _: case(
        model().partition, y=(state(), no_states(state(), "belief", "location"))
    ),
    "envs.SinglePart": lambda _: case(SinglePart(), y=(state(), no_states(state()))),
    "problems.Problem": lambda _: case(
        problems.Problem,
        model=belief_model(),
        start=(start(), sequences((), empty=False)),
        name=("line3", texts()),
        training=(problem().training, sequences(problem().training, None, 3, "x", free=False)),
        base_policies=({"greedy": greedy()}, [*mappings(), *values({}, {"greedy": 3}, {3: greedy()}, {"": greedy()})]),
        pessimistic_cost=(problem().pessimistic_cost, objects(greedy(), 3.0)),
        symmetries=(problem().symmetries, values((), (3,), 3, "x")),
        encoder=(problem().encoder, not_callable()),
        agent_encoder=(problem().agent_encoder, not_callable()),
        spec=(None, mappings()),
    ),
    "problems.Problem.unpartitioned": lambda _: case(problem().unpartitioned),
    "problems.problem_from_spec": lambda _: case(
        problems.problem_from_spec,
        spec=({"preset": "tiger"}, [*mappings(), *values({}, {"preset": "none"}, {"preset": 3}, {"preset": "tiger", "x": 3})]),
        device=("cpu", devices()),
    ),
    "problems.make_problem": lambda _: case(
        problems.make_problem, name=("line3", choices()), partitioned=(True, flags()), device=("cpu", devices())
    ),
    "envs.repair.symmetries": lambda _: case(repair.symmetries, model=repair_model()),
    "envs.repair.Symmetry.__call__": lambda _: case(
        repair.symmetries(model())[1], y=(state(), no_states(state(), "belief", "location"))
    ),
}

MODULES = {
    "modules.repair.GreedyRepair": lambda _: case(
        GreedyRepair, model=repair_model(), damage_threshold=(0.0, numbers("[0, 1)"))
    ),
    "modules.repair.GreedyRepair.forward": lambda _: on_entries(greedy(), "belief", "location"),
    "modules.repair.UrgencyRepair": lambda _: case(
        repair_modules.UrgencyRepair, lambda made: made(state()), model=repair_model(), exponent=(3.0, numbers("[0, inf)"))
    ),
    "modules.repair.UrgencyRepair.forward": lambda _: on_entries(repair_modules.UrgencyRepair(model()), "belief", "location"),
    "modules.FlatEncoder": lambda _: case(FlatEncoder, model=belief_model()),
    "modules.FlatEncoder.forward": lambda _: case(
        FlatEncoder(model()), y=(state(), no_states(state(), "belief", "location"))
    ),
    "modules.repair.RelativeEncoder": lambda _: case(repair_modules.RelativeEncoder, model=repair_model()),
    "modules.repair.RelativeEncoder.forward": lambda _: case(
        repair_modules.RelativeEncoder(model()), y=(state(), no_states(state(), "belief", "location"))
    ),
    "modules.PolicyNetwork": lambda _: case(
        modules.PolicyNetwork,
        encoder=(FlatEncoder(model()), objects(FlatEncoder)),
        num_controls=(3, integers(1)),
        hidden=((4,), sizes()),
        generator=(rng(), objects(torch.Generator)),
    ),
    "modules.PolicyNetwork.forward": lambda _: on_entries(network(), "belief", "location", "action_mask"),
    "modules.ValueNetwork": lambda _: case(
        modules.ValueNetwork,
        encoder=(FlatEncoder(model()), objects(FlatEncoder)),
        scale=(NeverRepairCost(model()), objects(NeverRepairCost)),
        hidden=((4,), sizes()),
        generator=(rng(), objects(torch.Generator)),
    ),
    "modules.ValueNetwork.forward": lambda _: on_entries(value_network(), "belief", "location"),
    "modules.PartitionedPolicy": lambda _: case(
        modules.PartitionedPolicy, policies=([greedy()] * 6, sequences([greedy()] * 6, None, 3, "x", GreedyRepair))
    ),
    "modules.PartitionedPolicy.forward": lambda _: on_tensordict(
        modules.PartitionedPolicy([network() for _ in range(6)]),
        (state(), [
            *no_states(state(), "belief", "location", "partition", "action_mask"),
            *entries(state(), "partition", {"negative": KEYS - 1, "too large": KEYS + 5, "float": KEYS + 0.5}),
        ]),
    ),
    "modules.PartitionedValue": lambda _: case(
        modules.PartitionedValue, values=([ZeroCost()] * 6, sequences([ZeroCost()] * 6, None, 3, "x", ZeroCost))
    ),
    "modules.PartitionedValue.forward": lambda _: on_entries(
        modules.PartitionedValue([value_network() for _ in range(6)]), "belief", "location", "partition"
    ),
    "modules.RolloutPolicy": lambda _: case(
        RolloutPolicy, lambda made: made(state()),
        model=belief_model(),
        base_policy=a_policy(),
        trajectories=(1, integers(1)),
        leaves=("control", choices()),
        allocation=("uniform", choices()),
        seconds=(0.001, numbers("(0, inf)")),
        seed=(0, integers()),
        compile=(False, flags()),
        **simulation(),
    ),
    "modules.RolloutPolicy.forward": lambda _: on_tensordict(rollout(), (state(), states(state()))),
    "modules.RolloutPolicy.q_factors": lambda _: case(
        rollout().q_factors,
        y=(state(), states(state())),
        keys=(KEYS, [*keys(), Hostile("one key for two states", KEYS[:1]), Hostile("three keys", torch.arange(3))]),
        seconds=(0.001, numbers("(0, inf)")),
    ),
    "modules.MultiagentRollout": lambda _: case(
        modules.MultiagentRollout, lambda made: made(state()),
        model=belief_model(),
        base_policy=a_policy(),
        scheme=("autonomous", choices()),
        signalling=(greedy(), [wrong for wrong in not_callable() if wrong.value is not None]),
        trajectories=(1, integers(1)),
        leaves=("control", choices()),
        allocation=("uniform", choices()),
        seconds=(0.001, numbers("(0, inf)")),
        seed=(0, integers()),
        compile=(False, flags()),
        **simulation(),
    ),
    "modules.MultiagentRollout.forward": lambda _: on_tensordict(
        modules.MultiagentRollout(model(), greedy()), (state(), states(state()))
    ),
    "modules.FlatAgentEncoder": lambda _: case(modules.FlatAgentEncoder, model=belief_model()),
    "modules.repair.OldPolicy": lambda _: case(
        repair_modules.OldPolicy,
        policy=(greedy(), not_callable()),
        old=(TWO, objects(RepairModel)),
        new=(ONE, objects(RepairModel, TWO)),
        lost=(1, [wrong for wrong in integers(0, 1) if wrong.value is not None]),
        place=(1, integers(0, 1)),
    ),
    "modules.repair.OldPolicy.forward": lambda _: on_entries(
        repair_modules.OldPolicy(greedy(), model(), model()), "belief", "location"
    ),
    "modules.repair.RobotEncoder": lambda _: case(repair_modules.RobotEncoder, model=repair_model()),
    "modules.AgentNetwork": lambda _: case(
        modules.AgentNetwork,
        encoder=(modules.FlatAgentEncoder(model()), objects(FlatEncoder(model()))),
        hidden=((4,), [*sizes(), *values(())]),
        generator=(rng(), objects(torch.Generator)),
    ),
    "modules.AgentNetwork.forward": lambda _: on_entries(
        modules.AgentNetwork(modules.FlatAgentEncoder(model()), (4,), generator=rng()), "belief", "location"
    ),
    "modules.MultistepLookahead": lambda _: case(
        modules.MultistepLookahead, lambda made: made(state()),
        policy=(rollout(), objects(greedy(), RolloutPolicy)),
        depth=(2, integers(1, 3)),
        branches=(5, integers(1)),
        margin=(0.1, numbers("[0, inf)")),
    ),
    "modules.MultistepLookahead.forward": lambda _: on_tensordict(
        modules.MultistepLookahead(rollout()), (state(), states(state()))
    ),
    "modules.ParallelRollout": lambda _: case(
        modules.ParallelRollout,
        policies=([rollout()] * 2, sequences([rollout()] * 2, None, 3, "x", greedy(), rollout(two_robots()))),
    ),
    "modules.ParallelRollout.forward": lambda _: on_tensordict(
        modules.ParallelRollout([rollout()]), (state(), states(state()))
    ),
    "modules.TruncatedRollout": lambda _: case(
        modules.TruncatedRollout, lambda made: made(state(), KEYS),
        model=belief_model(),
        base_policy=a_policy(),
        compile=(False, flags()),
        **simulation(),
    ),
    "modules.TruncatedRollout.forward": lambda _: case(
        truncated(),
        y=(state(), states(state())),
        keys=(KEYS, [*keys(), Hostile("one key for two states", KEYS[:1]), Hostile("three keys", torch.arange(3))]),
        count=(1, integers(1)),
    ),
    "modules.PolicyCost": lambda _: case(
        modules.PolicyCost, lambda made: made(state()),
        model=belief_model(),
        policy=a_policy(),
        trajectories=(1, integers(1)),
        seed=(0, integers()),
        **simulation(),
    ),
    "modules.PolicyCost.forward": lambda _: on_tensordict(policy_cost(), (state(), states(state()))),
    "modules.ZeroCost": lambda _: on_tensordict(ZeroCost(), (state(), values(None, 3, "x", {}, []))),
    "modules.repair.SteadyStateCost": lambda _: case(repair_modules.SteadyStateCost, model=repair_model()),
    "modules.repair.SteadyStateCost.forward": lambda _: on_entries(repair_modules.SteadyStateCost(model()), "belief"),
    "modules.repair.NeverRepairCost": lambda _: case(NeverRepairCost, model=repair_model()),
    "modules.repair.NeverRepairCost.forward": lambda _: on_entries(NeverRepairCost(model()), "belief"),
    "modules.AfterSteps": lambda _: case(
        modules.AfterSteps,
        lambda made: modules.TruncatedRollout(model(), greedy(), truncation=made, terminal_cost=ZeroCost())(state(), KEYS),
        m=(3, [
            *integers(0),
            Hostile("function of None", lambda y: None, "in use"),
            Hostile("function of floats", lambda y: torch.ones(y.batch_size), "in use"),
            Hostile("function of -1", lambda y: torch.full(y.batch_size, -1), "in use"),
            Hostile("function of one number", lambda y: torch.tensor(3), "in use"),
        ]),
    ),
    "modules.OnEntering": lambda _: case(OnEntering, parts=((3,), sequences((3,), *PARTS))),
    "modules.OnEntering.check_model": lambda _: case(OnEntering((3,)).check_model, model=belief_model()),
    "modules.OnLeaving.check_model": lambda _: case(
        modules.OnLeaving().check_model,
        model=(model(), [*objects(RepairModel), Hostile("without a partition", two_robots(), names=("partition",))]),
    ),
}
