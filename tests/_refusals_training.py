"""Cases of the test of refusals: collectors, losses and training; see the cases of planning."""

from __future__ import annotations

import torch
from _hostile import (
    INF,
    NAN,
    Hostile,
    choices,
    devices,
    entries,
    flags,
    integers,
    keys,
    mappings,
    not_callable,
    numbers,
    objects,
    paths,
    seeds,
    sequences,
    sizes,
    terminal_costs,
    texts,
    values,
    wrong_actions,
)
from _valid import (
    KEYS,
    a_config,
    a_module,
    a_policy,
    a_problem,
    a_start,
    at_once,
    belief_model,
    callback,
    case,
    collector,
    config,
    greedy,
    labelled,
    model,
    network,
    on_tensordict,
    saved,
    some_workers,
    start,
    state,
    value_network,
    visited,
    written,
)

from torchrl_pomdp import collectors, modules, objectives, trainers
from torchrl_pomdp.modules import FlatEncoder, ZeroCost
from torchrl_pomdp.modules.repair import NeverRepairCost
from torchrl_pomdp.trainers import checkpoint, run

__all__ = ["COLLECTORS", "TRAINERS"]

# fmt: off

COUNTS = ("iterations", "samples_per_part", "trajectories", "max_steps", "memory_capacity", "value_samples", "batch_size",
          "epochs", "least_steps", "validation_states")
PARTS = [-1, 1.5, True, "0", None, NAN, [0]]


def lacking(*keys):
    """Labelled states without one of the entries that a loss reads."""
    return [Hostile(f"no {key}", labelled().exclude(key), names=(key,)) for key in keys]


COLLECTORS = {
    "collectors.StateMemory": lambda _: case(
        collectors.StateMemory, lambda made: made.visit(greedy(), start(), KEYS, max_steps=3),
        model=belief_model(),
        capacity=(10, integers(1)),
        retain=(1.0, numbers("(0, 1]")),
        seed=(0, integers()),
    ),
    "collectors.StateMemory.visit": lambda _: case(
        visited().visit,
        policy=at_once(a_policy()),
        start=at_once(a_start()),
        keys=(KEYS, keys()),
        exploration=(0.0, numbers("[0, 1]")),
        max_steps=(3, integers(1)),
        workers=some_workers(),
    ),
    "collectors.StateMemory.count": lambda _: case(visited().count, part=(1, integers(0, 5))),
    "collectors.StateMemory.generator": lambda _: case(
        visited().generator, part=(next(part for part in range(6) if visited().count(part)), integers(0, 5))
    ),
    "collectors.PartSampler": lambda _: case(
        collectors.PartSampler, lambda made: made(KEYS),
        generators=({0: start()}, [
            *mappings(), *values({}),
            *(Hostile(f"of {key!r}", {key: start()}) for key in (-1, 1.5, True, None, "0", NAN)),
            *(Hostile(f"{wrong.label} of 0", {0: wrong.value}) for wrong in not_callable()),
        ]),
        seed=(0, integers()),
    ),
    "collectors.PartSampler.__call__": lambda _: case(collectors.PartSampler({0: start()}, 0), index=(KEYS, keys())),
    "collectors.training_states": lambda _: case(
        collectors.training_states,
        problem=a_problem(),
        memory=(visited(), objects(collectors.StateMemory)),
        part=(1, integers(0, 5)),
        visited_share=(0.5, numbers("[0, 1]")),
    ),
    "collectors.LabelCollector": lambda _: case(collectors.LabelCollector, lambda made: made.next(), **collector()),
    "collectors.RolloutImprovement": lambda _: case(collectors.RolloutImprovement, lambda made: made.next(), **collector()),
    "collectors.PolicyEvaluation": lambda _: case(collectors.PolicyEvaluation, lambda made: made.next(), **collector()),
    "objectives.ClassificationLoss": lambda _: case(
        objectives.ClassificationLoss,
        policy=(network(), objects(modules.PolicyNetwork)),
        loss=("soft", choices()),
    ),
    "objectives.ClassificationLoss.forward": lambda _: on_tensordict(
        objectives.ClassificationLoss(network()),
        (labelled(), [
            *lacking("belief", "location", "action_mask", "action", "q_factors"),
            *wrong_actions(labelled()),
            *entries(labelled(), "q_factors", {
                "NaN": torch.full((2, 3), NAN), "all inf": torch.full((2, 3), INF), "-inf": torch.full((2, 3), -INF),
                "of a control less": torch.ones(2, 2), "one for each state": torch.ones(2), "bool": torch.ones(2, 3) > 0,
            }),
        ]),
    ),
    "objectives.ValueLoss": lambda _: case(
        objectives.ValueLoss,
        value=(value_network(), objects(modules.ValueNetwork)),
        scale=(NeverRepairCost(model()), objects(NeverRepairCost)),
    ),
    "objectives.ValueLoss.forward": lambda _: on_tensordict(
        objectives.ValueLoss(value_network(), NeverRepairCost(model())),
        (labelled(), [
            *lacking("belief", "location", "cost_to_go"),
            *entries(labelled(), "cost_to_go", {
                "NaN": torch.full((2,), NAN), "inf": torch.full((2,), INF), "of shape [N, 1]": torch.ones(2, 1),
                "complex": torch.ones(2, dtype=torch.complex64), "bool": torch.ones(2) > 0,
            }),
        ]),
    ),
}

TRAINERS = {
    "trainers.PolicyIterationConfig": lambda _: case(
        trainers.PolicyIterationConfig,
        **{name: (getattr(config(), name), integers(1)) for name in COUNTS},
        **{name: (getattr(config(), name), choices()) for name in ("leaves", "allocation", "encoder", "loss")},
        visited_share=(0.5, numbers("[0, 1]")),
        exploration=(0.5, numbers("[0, 1]")),
        visits_per_label=(0.5, numbers("(0, inf)")),
        learning_rate=(0.5, numbers("(0, inf)")),
        symmetries=(True, flags()),
        label_steps=(5, [wrong for wrong in integers(1) if wrong.value is not None]),
        multiagent=(False, flags()),
        hidden=((4,), sizes()),
        value_hidden=((4,), sizes()),
        seed=(0, seeds()),
    ),
    "trainers.Improve": lambda _: a_step(trainers.Improve),
    "trainers.Evaluate": lambda _: a_step(trainers.Evaluate),
    "trainers.PolicyIteration": lambda _: case(
        trainers.PolicyIteration,
        problem=a_problem(),
        config=a_config(),
        base_policy=a_module(),
        plan=([trainers.Improve((0,))], sequences(
            [trainers.Improve((0,))], None, 3, "x", (0,), trainers.Improve, trainers.Improve((99,)), trainers.Evaluate((99,))
        )),
        folder=(None, paths()),
        logger=(None, objects()),
        progress=(False, flags()),
        on_labels=callback(),
        workers=some_workers(),
    ),
    "trainers.AsynchronousIteration": lambda _: case(
        trainers.AsynchronousIteration,
        iteration=(trainers.papi_nt(a_problem()[0], config(), greedy()), objects(trainers.PolicyIteration)),
        staleness=(1, integers(0)),
    ),
    "trainers.papi_nt": lambda _: an_algorithm(trainers.papi_nt),
    "trainers.papi_t": lambda _: an_algorithm(trainers.papi_t),
    "trainers.api": lambda _: an_algorithm(trainers.api, partitioned=False),
    "trainers.ppo": lambda folder: case(
        trainers.ppo,
        problem=a_problem(),
        steps=(4096, integers(4096, 10**12)),
        seed=(0, seeds()),
        episodes=(256, integers(1, 1 << 20)),
        path=(folder / "ppo.pt", [*(wrong for wrong in paths() if wrong.value is not None), Hostile("a folder", folder)]),
        progress=(False, flags()),
    ),
    "trainers.r_nt": lambda _: case(trainers.r_nt, problem=a_problem(), base_policy=(greedy(), not_callable())),
    "trainers.r_t": lambda _: case(
        trainers.r_t, lambda made: made(state()),
        problem=a_problem(),
        base_policy=(greedy(), not_callable()),
        terminal_cost=(ZeroCost(), [wrong for wrong in terminal_costs() if wrong.refused == "at once"]),
    ),
    "trainers.make_networks": lambda _: an_architecture(trainers.make_networks),
    "trainers.make_values": lambda _: an_architecture(trainers.make_values, scale=(None, objects(ZeroCost))),
    "trainers.train_part": lambda _: case(
        trainers.train_part,
        batch=(labelled(), [*values(None, 3, "x", {}, [], object()), Hostile("no states", labelled()[:0])]),
        loss=(objectives.ClassificationLoss(network()), objects(network(), objectives.ClassificationLoss)),
        config=a_config(),
        seed=(0, seeds()),
        name=("part", texts()),
        logger=(None, objects()),
        progress=(False, flags()),
    ),
    "trainers.Checkpoint": lambda _: case(
        checkpoint.Checkpoint,
        problem=a_problem(),
        config=a_config(),
        algorithm=("pAPI-NT", texts()),
        iteration=(1, integers(0)),
        policy=(saved().policy, objects(modules.PartitionedPolicy)),
        value=(saved().value, objects(modules.PartitionedValue, saved().policy)),
    ),
    "trainers.save_checkpoint": lambda folder: case(
        checkpoint.save_checkpoint,
        path=(folder / "a.pt", paths()),
        checkpoint=(saved(), objects(checkpoint.Checkpoint, greedy())),
    ),
    "trainers.load_checkpoint": lambda folder: case(
        checkpoint.load_checkpoint,
        path=(written(folder / "a.pt"), [
            *paths(), *(Hostile(path.name, path, names=(path.name,)) for path in (folder, folder / "none.pt"))
        ]),
        problem=(None, a_problem()[1]),
        device=("cpu", devices()),
    ),
    "trainers.checkpoint.open_run_folder": lambda folder: case(
        checkpoint.open_run_folder,
        path=(folder / "run", paths()),
        identity=({"seed": 0}, [*mappings(), *values({"seed": object()}, {1j: 0})]),
    ),
    "trainers.run.TrainingRun": lambda _: case(
        run.TrainingRun,
        problem=a_problem(),
        algorithm=("API", choices()),
        base=("greedy", choices()),
        config=a_config(),
        states=(8, integers(1)),
        rollout_states=(0, integers(0)),
        online_states=(0, integers(0)),
        online_trajectories=(1, integers(1)),
        staleness=(None, integers(0)),
    ),
    "trainers.run.TrainingRun.carry_out": lambda folder: case(
        run.TrainingRun(a_problem()[0], "API", config=config(), states=8, online_states=0, online_trajectories=1).carry_out,
        folder=(folder / "run", paths()),
        progress=(False, flags()),
        report=callback(),
        on_labels=callback(),
        workers=some_workers(),
    ),
}


def a_step(step):
    return case(step, parts=((0,), sequences((0,), *PARTS)), truncation=(None, objects(modules.AfterSteps)))


def an_algorithm(algorithm, *, partitioned=True):
    return case(algorithm, problem=a_problem(partitioned=partitioned), config=a_config(), base_policy=a_module())


def an_architecture(make, **more):
    return case(make, problem=a_problem(), config=a_config(), seed=(0, seeds()), encoder=(None, objects(FlatEncoder)), **more)
