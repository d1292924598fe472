from __future__ import annotations

import math
import warnings
from dataclasses import replace
from functools import partial

import pytest
import torch
from torchrl.trainers import Trainer

from torchrl_pomdp.collectors import PartSampler, RolloutImprovement, labels
from torchrl_pomdp.envs import BeliefEnv, InPart
from torchrl_pomdp.envs.repair import RandomState, RepairModel, RepairPartition, UniformStart, damage_chain, line
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import (
    FlatEncoder,
    OnEntering,
    PartitionedPolicy,
    PolicyCost,
    PolicyNetwork,
    RolloutPolicy,
    ValueNetwork,
    ZeroCost,
)
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, SteadyStateCost, UrgencyRepair
from torchrl_pomdp.objectives import ClassificationLoss
from torchrl_pomdp.problems import Problem, make_problem
from torchrl_pomdp.trainers import (
    Evaluate,
    Improve,
    PolicyIteration,
    PolicyIterationConfig,
    api,
    make_networks,
    papi_nt,
    papi_t,
    parts,
    r_nt,
    r_t,
    train_part,
)
from torchrl_pomdp.trainers import policy_iteration as module
from torchrl_pomdp.trainers.parts import PartData

TINY = PolicyIterationConfig(
    iterations=1,
    samples_per_part=200,
    value_samples=150,
    trajectories=2,
    epochs=2,
    least_steps=1,
    batch_size=50,
    hidden=(16, 8),
    value_hidden=(16,),
    max_steps=60,
    visits_per_label=0.1,
    validation_states=100,
)


def run(problem, config=TINY, recipe=papi_nt, **options):
    return list(recipe(problem, config, GreedyRepair(problem.model), **options))


def weights(policy):
    return torch.cat([parameter.detach().flatten() for parameter in policy.parameters()])


def test_policy_iteration_improves_greedy_on_the_line_of_3(line3):
    config = replace(TINY, samples_per_part=250, trajectories=5, epochs=25, hidden=(64, 32), max_steps=400)
    config = replace(config, visits_per_label=0.2)
    iteration = papi_nt(line3, replace(config, validation_states=1500), GreedyRepair(line3.model))
    (only,) = iteration
    assert only.accepted
    assert iteration.best is only.policy
    greedy = discounted_costs(line3.model, GreedyRepair(line3.model), line3.start, num_states=4000)
    comparison = compare(discounted_costs(line3.model, only.policy, line3.start, num_states=4000), greedy)
    assert comparison.ratio.interval[1] < 1.0
    assert comparison.cost.mean + 3 * comparison.cost.standard_error > 168.96, "nothing is below the optimum"


def test_the_same_seed_gives_the_same_policy_and_the_global_generator_is_untouched(line3):
    state = torch.random.get_rng_state()
    with warnings.catch_warnings():
        warnings.filterwarnings("error", module="torchrl_pomdp")
        first = run(line3, recipe=papi_t)[0]
    assert torch.equal(torch.random.get_rng_state(), state)
    torch.manual_seed(123)
    second = run(line3, recipe=papi_t)[0]
    assert torch.equal(weights(second.policy), weights(first.policy))
    assert torch.equal(weights(second.value), weights(first.value))
    assert not torch.equal(weights(run(line3, replace(TINY, seed=1), papi_t)[0].policy), weights(first.policy))


def collected(monkeypatch, problem, recipe):
    """What each collector of an iteration simulates: step, part, local policies, values, truncation."""
    seen = []
    original = PolicyIteration._collector

    def record(self, index, policy, value, number, cache, part):
        step = self.plan[index]
        local = [type(p).__name__ for p in policy.policies]
        values = [type(v).__name__ for v in value.values]
        seen.append((type(step).__name__, part, local, values, step.truncation))
        return original(self, index, policy, value, number, cache, part)

    monkeypatch.setattr(PolicyIteration, "_collector", record)
    run(problem, recipe=recipe)
    return seen


GREEDY, NETWORK, NEVER, VALUE = (kind.__name__ for kind in (GreedyRepair, PolicyNetwork, NeverRepairCost, ValueNetwork))


def test_stages_train_the_endgame_first_and_roll_the_startgame_out_with_it(line3, monkeypatch):
    seen = collected(monkeypatch, line3, papi_nt)
    assert [entry[:2] for entry in seen] == [("Improve", part) for part in (3, 4, 5, 0, 1, 2)]
    assert all(entry[2] == [GREEDY] * 6 for entry in seen[:3])
    assert all(entry[2] == [GREEDY] * 3 + [NETWORK] * 3 for entry in seen[3:])
    assert all(entry[4] is None for entry in seen)


def test_truncation_cuts_the_startgame_with_endgame_values_of_the_new_policy(line3, monkeypatch):
    seen = collected(monkeypatch, line3, papi_t)
    steps = [("Improve", p) for p in (3, 4, 5)] + [("Evaluate", p) for p in (3, 4, 5)] + [("Improve", p) for p in (0, 1, 2)]
    assert [entry[:2] for entry in seen] == steps
    assert all(entry[2] == [GREEDY] * 3 + [NETWORK] * 3 for entry in seen[3:]), "values are those of the new endgame policy"
    assert all(entry[3] == [NEVER] * 3 + [VALUE] * 3 for entry in seen[6:]), "6 policy and 3 value networks"
    assert all(entry[4] is None for entry in seen[:6])
    assert all(entry[4].parts == (3, 4, 5) for entry in seen[6:])


def test_all_six_parts_can_have_values(line3):
    plan = [Improve((3, 4, 5)), Evaluate((3, 4, 5)), Improve((0, 1, 2)), Evaluate((0, 1, 2))]
    (iteration,) = PolicyIteration(line3, TINY, GreedyRepair(line3.model), plan)
    assert all(isinstance(value, ValueNetwork) for value in iteration.value.values)


def test_truncation_saves_simulated_steps(linear20):
    config = replace(TINY, samples_per_part=30, value_samples=30, max_steps=150, validation_states=10, visits_per_label=0.05)
    steps = []
    for recipe in (papi_nt, papi_t):
        (iteration,) = run(linear20, config, recipe)
        steps.append(
            sum(r.simulated_steps for name, r in iteration.records.items() if "improve-part" in name and name[-1] in "012")
        )
        assert all(record.simulated_steps > record.samples for record in iteration.records.values())
    assert steps[1] < 0.5 * steps[0]


def test_one_part_equals_the_unpartitioned_run_bit_for_bit():
    """Collector, loss and trainer with a bare network and no router anywhere, against API."""
    problem = make_problem("line3", partitioned=False)
    config = replace(TINY, symmetries=False, visited_share=0.0)
    greedy = GreedyRepair(problem.model)
    algorithm = api(problem, config, greedy)
    (iteration,) = algorithm
    bare = make_networks(problem, config, algorithm._seed(1, "weights")).policies[0]
    cut = {"max_steps": config.max_steps, "terminal_cost": NeverRepairCost(problem.model)}
    label = partial(RolloutPolicy, trajectories=config.trajectories, seed=algorithm._seed(1, "labels"), **cut)
    collector = RolloutImprovement(
        BeliefEnv(problem.model, problem.start),
        greedy,
        states=PartSampler({0: problem.training[0]}, algorithm._seed(1, "states")),
        frames_per_batch=config.samples_per_part,
        total_frames=config.samples_per_part,
        label=label,
    )
    (batch,) = collector
    train_part(batch.exclude("collector"), ClassificationLoss(bare), config, seed=algorithm._seed(1, "batches"), name="bare")
    assert torch.equal(weights(bare), weights(iteration.policy))
    y = problem.model.with_features(problem.start(torch.arange(50)))
    with torch.no_grad():
        assert torch.equal(bare(y.copy())["logits"], iteration.policy(y.copy())["logits"])


def test_training_keeps_no_graphs(line3, monkeypatch):
    """TorchRL's trainer averages the losses of all steps; with their graphs the memory would grow with every step."""
    kept = []
    monkeypatch.setattr(Trainer, "_post_optim_complete_log_hook", lambda self, count, losses: kept.append(losses))
    y = line3.model.with_features(line3.start(torch.arange(100)))
    batch = RolloutPolicy(line3.model, GreedyRepair(line3.model), trajectories=1)(y)
    policy = make_networks(line3, TINY, seed=0).policies[0]
    train_part(batch, ClassificationLoss(policy), TINY, seed=0, name="part")
    (losses,) = kept
    assert losses.get("loss_policy") is not None
    assert not any(loss.requires_grad for loss in losses.values())


def test_mirror_images_are_training_data_of_their_parts(line3):
    algorithm = papi_nt(line3, TINY, GreedyRepair(line3.model))
    labelled = {}
    for part in (0, 1, 2):
        y = line3.model.with_features(line3.training[part](torch.arange(30)))
        y.set(("collector", "mask"), torch.ones(30, dtype=torch.bool))
        labelled[part] = RolloutPolicy(line3.model, GreedyRepair(line3.model), trajectories=1)(y)
    images = {}
    for part in labelled:
        data = PartData(part, algorithm._images)
        for source, block in labelled.items():
            data.add(source, block)
        images[part] = torch.cat(list(data))
    assert [len(images[part]) for part in (0, 1, 2)] == [60, 60, 60]
    left, right, repair = 1, 2, 0
    mirrored = images[0][30:]
    assert torch.equal(mirrored["belief"], labelled[2]["belief"].flip(1))
    swap = torch.tensor([repair, right, left])
    assert torch.equal(mirrored["action"], swap[labelled[2]["action"]])


def test_a_worse_iteration_is_rejected_and_the_best_policy_stays(line3):
    """Hardly any training makes networks that are worse than a near-optimal base policy."""
    base = UrgencyRepair(line3.model)
    algorithm = papi_nt(line3, replace(TINY, iterations=2, samples_per_part=20, epochs=1), base)
    iterations = list(algorithm)
    assert [iteration.accepted for iteration in iterations] == [False, False]
    assert algorithm.best is base
    assert all(iteration.reason.startswith("cost higher: +") for iteration in iterations)
    assert all(iteration.comparison.ratio.mean > 1 for iteration in iterations)
    assert not torch.equal(weights(iterations[0].policy), weights(iterations[1].policy)), "it tries other states"


def test_values_are_the_best_policys(line3, monkeypatch):
    """What a rejected iteration has learnt is no terminal cost of the next one."""
    seen = []
    original = PolicyIteration._collector

    def record(self, index, policy, value, number, cache, part):
        seen.append((number, index, {type(v).__name__ for v in value.values}))
        return original(self, index, policy, value, number, cache, part)

    monkeypatch.setattr(PolicyIteration, "_collector", record)
    config = replace(TINY, iterations=2, samples_per_part=20, value_samples=20, epochs=1)
    algorithm = PolicyIteration(line3, config, UrgencyRepair(line3.model), [Improve((3,)), Evaluate((3,))])
    assert not any(iteration.accepted for iteration in algorithm)
    assert seen == [(1, 0, {NEVER}), (1, 1, {NEVER}), (2, 0, {NEVER}), (2, 1, {NEVER})]


def test_steps_for_the_same_part_draw_other_states_and_noise(line3):
    algorithm = PolicyIteration(line3, TINY, GreedyRepair(line3.model), [Improve((3, 4)), Evaluate((4,)), Improve((4,))])
    collectors = [
        algorithm._collector(index, PartitionedPolicy([algorithm.base_policy] * 6), algorithm._scale, 1, None, 4)
        for index in range(3)
    ]
    assert len({collector.labeller.seed for collector in collectors}) == 3
    states = [set(line3.model.fingerprint(collector.states(torch.arange(50))).tolist()) for collector in collectors]
    assert all(len(one & other) < 25 for one in states for other in states if one is not other)


def test_to_iterate_again_is_to_start_anew(line3):
    algorithm = papi_nt(line3, TINY, GreedyRepair(line3.model))
    one, other = list(algorithm), list(algorithm)
    assert torch.equal(weights(one[0].policy), weights(other[0].policy))
    assert one[0].comparison == other[0].comparison


def test_a_folder_is_of_one_run(line3, tmp_path):
    run(line3, folder=tmp_path)
    with pytest.raises(ValueError, match=r"holds another run, which differs in config\.seed: name another folder"):
        run(line3, replace(TINY, seed=1), folder=tmp_path)
    with pytest.raises(ValueError, match="differs in plan"):
        run(line3, recipe=papi_t, folder=tmp_path)
    with pytest.raises(ValueError, match="differs in base_policy"):
        list(papi_nt(line3, TINY, UrgencyRepair(line3.model), folder=tmp_path))


def test_states_of_every_iterations_policy_are_remembered(line3, monkeypatch):
    seen = []
    monkeypatch.setattr(module.StateMemory, "visit", lambda self, policy, *args, **options: seen.append(policy))
    base = UrgencyRepair(line3.model)
    iterations = list(papi_nt(line3, replace(TINY, iterations=3, samples_per_part=20, epochs=1), base))
    assert not any(iteration.accepted for iteration in iterations)
    assert seen == [base, iterations[0].policy, iterations[1].policy], "of the last one no iteration would learn"


def test_visited_states_keep_pace_with_labels(linear20):
    """A part's memory holds about as many states as it has labels, so that few are labelled twice."""
    counts = []
    for samples in (100, 400):
        config = replace(PolicyIterationConfig(), iterations=1, samples_per_part=samples, least_steps=1, validation_states=10)
        run = PolicyIteration(linear20, config, GreedyRepair(linear20.model), [Improve((3,))])
        next(iter(run))
        counts.append([run.memory.count(part) / samples for part in range(6)])
    assert min(counts[0] + counts[1]) > 0.5
    assert counts[1] == pytest.approx(counts[0], rel=0.3)


class Killed(BaseException):
    """Stands for SIGKILL: nothing catches it."""


SMALL = replace(TINY, iterations=2, samples_per_part=40, value_samples=40, epochs=1, max_steps=20, validation_states=30)


@pytest.fixture(scope="module")
def uninterrupted(line3, tmp_path_factory):
    """Folder and iterations of a run by each recipe."""
    folders = {recipe: tmp_path_factory.mktemp("whole") for recipe in (papi_nt, papi_t)}
    return {recipe: (folder, run(line3, SMALL, recipe, folder=folder)) for recipe, folder in folders.items()}


@pytest.mark.parametrize(("where", "recipe"), [("label", papi_nt), ("label", papi_t), ("train", papi_t), ("validate", papi_t)])
def test_killed_and_resumed_equals_uninterrupted(line3, tmp_path, monkeypatch, uninterrupted, where, recipe):
    folder, whole = uninterrupted[recipe]
    broken = {"label": (labels, "label_states"), "train": (parts, "train_part"), "validate": (module, "compare")}
    owner, name = broken[where]
    original, calls = getattr(owner, name), []

    def interrupted(*args, **kwargs):
        calls.append(name)
        if len(calls) in (2, 5, 9):
            raise Killed
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, name, interrupted)
    attempts = 0
    while True:
        attempts += 1
        try:
            resumed = run(line3, SMALL, recipe, folder=tmp_path)
            break
        except Killed:
            assert attempts < 10
    assert attempts > 1
    for one, other in zip(whole, resumed, strict=True):
        assert torch.equal(weights(one.policy), weights(other.policy))
        assert (one.accepted, one.comparison) == (other.accepted, other.comparison)
        steps = [{name: r.simulated_steps for name, r in it.records.items()} for it in (one, other)]
        assert steps[0] == steps[1]
    files = [{path.relative_to(own) for path in own.rglob("*") if path.is_file()} for own in (folder, tmp_path)]
    assert files[0] == files[1], "no labels and no temporary files are left"


def test_labels_of_an_interrupted_run_are_not_made_again(line3, tmp_path, monkeypatch):
    calls = []
    original = RolloutPolicy.forward

    def interrupted(self, y):
        calls.append(len(y))
        if len(calls) == 3:
            raise Killed
        return original(self, y)

    monkeypatch.setattr(RolloutPolicy, "forward", interrupted)
    with pytest.raises(Killed):
        run(line3, folder=tmp_path / "run")
    calls[:] = [0, 0, 0]
    told = []
    run(line3, folder=tmp_path / "run", on_labels=lambda *labels: told.append(labels))
    assert len(calls) - 3 == 4, "two of six parts were labelled before"
    assert told == [(200, True)] * 2 + [(200, False)] * 4
    told.clear()
    run(line3, folder=tmp_path / "run", on_labels=lambda *labels: told.append(labels))
    assert told == [(600, True)] * 2


def test_the_algorithms_refuse_partitions_that_do_not_fit(line3):
    greedy = GreedyRepair(line3.model)
    with pytest.raises(ValueError, match=r"a single part, 'line3' has 6: take problem\.unpartitioned"):
        api(line3, TINY, greedy)
    with pytest.raises(ValueError, match="at least two stages, problem 'line3' has 1"):
        papi_t(make_problem("line3", partitioned=False), TINY, greedy)
    with pytest.raises(ValueError, match="R-T needs a partition of at least two stages"):
        r_t(make_problem("line3", partitioned=False), greedy, ZeroCost())
    with pytest.raises(ValueError, match="plan is empty"):
        PolicyIteration(line3, TINY, greedy, [])


def test_online_truncation_cuts_startgame_simulations_alone(linear20):
    """As policy iteration with truncation labels: at the endgame's border, and not at all from within."""
    model, greedy, values = linear20.model, GreedyRepair(linear20.model), SteadyStateCost(linear20.model)
    y = torch.cat([model.with_features(states(torch.arange(20))) for states in linear20.training])
    q = r_t(linear20, greedy, values, trajectories=2)(y.copy())["q_factors"]
    cut = RolloutPolicy(model, greedy, truncation=OnEntering((3, 4, 5)), terminal_cost=values, trajectories=2)
    startgame = y["partition"] < 3
    assert torch.equal(q[startgame], cut.q_factors(y)[startgame])
    assert torch.equal(q[~startgame], r_nt(linear20, greedy, trajectories=2).q_factors(y)[~startgame])
    assert not torch.equal(q[~startgame], cut.q_factors(y)[~startgame])


def test_value_networks_learn_costs_of_all_magnitudes(linear20):
    """A value network of the endgame, trained as policy iteration does it, against fresh simulations."""
    model, greedy = linear20.model, GreedyRepair(linear20.model)
    config = replace(TINY, value_samples=2000, value_hidden=(64, 32), epochs=20, batch_size=100, max_steps=400)
    config = replace(config, visits_per_label=0.05, validation_states=10)
    algorithm = PolicyIteration(linear20, config, greedy, [Evaluate((4,))])
    (iteration,) = algorithm
    value = iteration.value
    assert [type(v).__name__ for v in value.values] == [NEVER] * 4 + [VALUE] + [NEVER]
    y = model.with_features(linear20.training[4](torch.arange(10_000, 10_200)))
    with torch.no_grad():
        found = value(y.copy())["state_value"]
    exact = PolicyCost(model, greedy, trajectories=30)(y.copy())["cost_to_go"]
    assert exact.max() / exact.min() > 1e3
    assert float((found - exact).abs().mean() / exact.mean()) < 0.2
    never = NeverRepairCost(model).costs(y)
    assert float(((found - exact).abs() / never).mean()) < 0.2 * float(((never - exact) / never).mean())


def test_states_where_nothing_is_to_be_paid_spoil_no_network():
    """The first damage costs nothing and does not grow: many states have a pessimistic cost of zero."""
    partition = RepairPartition(line(3), torch.tensor((0.0, 1.0, 5.0)))
    model = RepairModel(line(3), damage_chain((0.0, 0.0)), (0.0, 0.0, 5.0), 0.9, partition=partition)
    training = tuple(InPart(model, RandomState(model), part) for part in range(6))
    problem = Problem(model, UniformStart(model), training=training, pessimistic_cost=NeverRepairCost(model))
    scale = NeverRepairCost(model).costs(torch.cat([states(torch.arange(50)) for states in training]))
    assert 0 < int((scale == 0).sum()) < 300
    (iteration,) = run(problem, replace(TINY, samples_per_part=60, value_samples=60), papi_t)
    for network in (iteration.policy, iteration.value):
        assert all(bool(torch.isfinite(parameter).all()) for parameter in network.parameters())
    assert all(math.isfinite(loss) for record in iteration.records.values() for loss in record.losses.values())
    assert math.isfinite(iteration.comparison.difference.mean)


def test_a_model_without_a_partition_has_a_single_part():
    model = RepairModel(line(3), damage_chain((0.0, 0.02)), (0.0, 1.0, 2.0), 0.99)
    problem = Problem(model, UniformStart(model))
    assert problem.partition.names == ("all",)
    assert model.partition is None, "the user's own model is left alone"
    assert [step.parts for step in papi_nt(problem, TINY, GreedyRepair(model)).plan] == [(0,)]


def test_encoders_with_weights_are_refused(line3, tmp_path):
    """All networks share the encoder: one that is trained would change the others."""

    class Trained(FlatEncoder):
        def __init__(self, model):
            super().__init__(model)
            self.layer = torch.nn.Linear(3, 3)

    class Kept(FlatEncoder):
        def __init__(self, model):
            super().__init__(model)
            self.register_buffer("scale", torch.ones(3))

    for kind, named in ((Trained, "layer.bias, layer.weight"), (Kept, "scale")):
        with pytest.raises(ValueError, match=f"encoder must have no weights of its own, .* got {named}"):
            list(papi_nt(replace(line3, encoder=kind, spec=None), TINY, GreedyRepair(line3.model), folder=tmp_path / "run"))


def test_it_trains_where_gradients_are_switched_off(line3):
    config = replace(TINY, iterations=1, samples_per_part=20, least_steps=1, validation_states=20)
    base = GreedyRepair(line3.model)
    with torch.no_grad():
        (one,) = papi_nt(line3, config, base)
    (other,) = papi_nt(line3, config, base)
    for a, b in zip(one.policy.parameters(), other.policy.parameters(), strict=True):
        assert torch.equal(a, b)


def test_agents_that_decide_in_turn_keep_their_order():
    """Exchanged, a label would be of decisions that nobody has to make: the first robot's knows nothing of the second's."""
    two = make_problem("two_robots20")
    config = replace(TINY, multiagent=True)
    assert len(PolicyIteration(two, TINY, GreedyRepair(two.model), [Improve((0,))])._images.symmetries) == 4
    in_turn = PolicyIteration(two, config, GreedyRepair(two.model), [Improve((0,))])._images.symmetries
    assert [each.robots.tolist() for each in in_turn] == [[0, 1], [0, 1]]
    none = PolicyIteration(two, replace(config, symmetries=False), GreedyRepair(two.model), [Improve((0,))])
    assert len(none._images.symmetries) == 1
    # They do so in any case where nobody could list their joint controls.
    many = make_problem("network32x8")
    assert not many.model.enumerable
    for multiagent in (False, True):
        run = PolicyIteration(many, replace(TINY, multiagent=multiagent), GreedyRepair(many.model), [Improve((0,))])
        assert len(run._images.symmetries) == len(many.symmetries)


def test_labels_that_a_kill_has_left_behind_are_removed(line3, tmp_path):
    folder = tmp_path / "run"
    list(papi_nt(line3, TINY, GreedyRepair(line3.model), folder=folder))
    (step, *_) = sorted(folder.glob("iteration-1/*.pt"))
    left = step.with_suffix(".labels")
    left.mkdir()
    (left / "block.pt").write_bytes(b"labels")
    list(papi_nt(line3, TINY, GreedyRepair(line3.model), folder=folder))
    assert not left.exists()
