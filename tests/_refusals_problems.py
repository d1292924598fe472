"""Cases of the test of refusals: problems, their files and checks, and the controller."""

from __future__ import annotations

from pathlib import Path

import networkx
import torch
from _hostile import (
    Hostile,
    choices,
    devices,
    dtypes,
    generators,
    integers,
    mappings,
    no_states,
    not_callable,
    numbers,
    objects,
    paths,
    policies,
    seeds,
    sequences,
    tensors,
    texts,
    values,
)
from _valid import (
    CHAIN,
    COSTS,
    KEYS,
    a_policy,
    belief_model,
    case,
    greedy,
    model,
    on_entries,
    on_keys,
    start,
    state,
)

from torchrl_pomdp import controller, envs, modules, problems
from torchrl_pomdp.envs import repair

__all__ = ["PROBLEMS"]

# fmt: off

TEXT = "discount: 0.9\nvalues: cost\nstates: 2\nactions: 1\nobservations: 1\nT: 0 identity\nO: 0 uniform\n"
NO_TEXTS = values(None, 3, b"x", [], "", "states", "discount: 0.9", "\x00")


def named(name, wrong):
    """Values whose refusal may say of the argument by another name what is wrong."""
    return [value._replace(names=(*value.names, name)) for value in wrong]


def a_file(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def tiger():
    return problems.tiger()


def a_controller():
    made = controller.Controller(tiger().model, tiger().base_policies["listen"])
    made.reset(tiger().start(torch.tensor(0)))
    return made


PROBLEMS = {
    "envs.FunctionPartition": lambda _: case(
        envs.FunctionPartition, lambda made: made(state()),
        names=(("all", "none"), sequences(("all", "none"), "", 3)),
        function=(lambda y: torch.zeros(y.batch_size, dtype=torch.int64), not_callable()),
        stages=(((0,), (1,)), sequences(((0,), (1,)), (0,), (7,), "x", 3, free=False)),
    ),
    "envs.FunctionPartition.forward": lambda _: case(
        envs.FunctionPartition(("all",), lambda y: torch.zeros(y.batch_size, dtype=torch.int64)),
        y=(state(), no_states(state())),
    ),
    "envs.RandomPlay": lambda _: case(
        envs.RandomPlay, lambda made: made(KEYS),
        model=belief_model(), start=(start(), generators(start())), max_stages=(3, integers(0, 10_000)),
    ),
    "envs.RandomPlay.__call__": lambda _: on_keys(envs.RandomPlay(model(), start(), 2)),
    "envs.parse_pomdp": lambda _: case(
        envs.parse_pomdp,
        text=(TEXT, named("line", NO_TEXTS)),
        name=("mine", texts()),
        dtype=(torch.float32, dtypes()),
        device=("cpu", devices()),
    ),
    "envs.read_pomdp": lambda folder: case(
        envs.read_pomdp,
        path=(a_file(folder / "a.POMDP", TEXT), paths()),
        dtype=(torch.float32, dtypes()),
        device=("cpu", devices()),
    ),
    "envs.write_pomdp": lambda folder: case(
        envs.write_pomdp,
        path=(folder / "b.POMDP", paths()),
        model=(tiger().model, objects(envs.TabularModel, model())),
        start=(tiger().start, objects(envs.FixedBelief, start())),
    ),
    "envs.repair.Graph.from_networkx": lambda _: case(
        repair.Graph.from_networkx,
        graph=(networkx.path_graph(3), [
            *values(None, 3, "x", []),
            Hostile("no nodes", networkx.Graph(), names=("num_locations",)),
            Hostile("no edges", networkx.empty_graph(2), names=("edges",)),
        ]),
        name=("pipe", texts()),
        positions=({0: (0, 0), 1: (1, 0), 2: (2, 0)}, [*mappings(), *values({}, {0: (0, 0)}, {0: "x", 1: (1, 0), 2: (2, 0)})]),
    ),
    "modules.ConstantCost": lambda _: case(modules.ConstantCost, model=belief_model(), cost=(3.0, numbers("(-inf, inf)"))),
    "modules.ConstantCost.forward": lambda _: case(
        lambda tensordict: modules.ConstantCost(model(), 3.0)(tensordict), tensordict=(state(), values(None, 3, "x", {}, []))
    ),
    "modules.Myopic": lambda _: case(modules.Myopic, lambda made: made(state()), model=belief_model()),
    "modules.Myopic.forward": lambda _: on_entries(modules.Myopic(model()), "belief", "location"),
    "modules.as_policy": lambda _: case(
        modules.as_policy, lambda made: made(state()),
        policy=(lambda y: greedy()(y), not_callable()),
        model=belief_model(),
        name=("policy", texts()),
    ),
    "problems.check_belief_model": lambda _: case(
        problems.check_belief_model,
        model=(tiger().model, objects(envs.TabularModel, tiger())),
        generator=(tiger().start, not_callable()),
        seed=(0, values(None, 1.5, "x", True)),
    ),
    "problems.check_partition": lambda _: case(
        problems.check_partition,
        model=belief_model(),
        start=(start(), generators(start())),
        policy=(greedy(), policies()),
        num_states=(4, integers(1)),
        max_steps=(2, integers(0)),
        seed=(0, integers()),
    ),
    "problems.crying_baby": lambda _: case(
        problems.crying_baby, discount=(0.9, numbers("(0, 1)")), name=("baby", texts()), device=("cpu", devices())
    ),
    "problems.maintenance": lambda _: case(
        problems.maintenance, k=(3, integers(1, 5)), name=("mine", texts()), device=("cpu", devices())
    ),
    "problems.rocksample": lambda _: case(
        problems.rocksample,
        n=(3, integers(1, 1000)), k=(2, integers(1)), seed=(0, seeds()), name=("mine", texts()), device=("cpu", devices()),
    ),
    "problems.read_problem": lambda folder: case(
        problems.read_problem,
        path=(a_file(folder / "a.toml", 'preset = "tiger"'), [
            *paths(), Hostile("no problem", a_file(folder / "b.toml", ""), names=("b.toml",)),
        ]),
        device=("cpu", devices()),
    ),
    "problems.repair_problem": lambda _: case(
        problems.repair_problem,
        graph=(repair.line(3), objects(repair.Graph)),
        chain=(CHAIN, tensors(CHAIN, -1.0, 2.0)),
        costs=(COSTS, tensors(COSTS, -1.0)),
        discount=(0.9, numbers("(0, 1)")),
        num_robots=(1, integers(1)),
        repair_probability=(0.5, numbers("(0, 1]")),
        start=(repair.CalibratedStart, not_callable()),
        partition=(envs.SinglePart(), objects(envs.Partition)),
        name=("mine", texts()),
        device=("cpu", devices()),
    ),
    "controller.Controller": lambda _: case(
        controller.Controller, lambda made: (made.reset(start()(KEYS[:1])), made.act()), model=belief_model(), policy=a_policy()
    ),
    "controller.Controller.from_checkpoint": lambda folder: case(
        lambda path: controller.Controller.from_checkpoint(path),
        path=(a_checkpoint(folder), [*paths(), Hostile("no file", folder / "none.pt", names=("none.pt",))]),
    ),
    "controller.Controller.reset": lambda _: case(
        a_controller().reset, prior=(tiger().start(torch.tensor(0)), [
            *values(None, 3, "x", {}, []), *named("y", [Hostile("two states", tiger().start(torch.arange(2)))]),
        ]),
    ),
    "controller.Controller.update": lambda _: case(
        a_controller().update,
        control=("listen", [*choices(), *values(7, -1, 1.5)]),
        observation=(0, [*choices(), *values(7, 1.5)]),
    ),
    "controller.Controller.load_json": lambda _: case(
        a_controller().load_json, text=(a_controller().to_json(), named("state", values(None, 3, b"x", "", "{}", "[]", "{")))
    ),
}


def a_checkpoint(folder):
    from torchrl_pomdp.trainers import Checkpoint, PolicyIterationConfig, make_networks, make_values, save_checkpoint

    config = PolicyIterationConfig(hidden=(2,), value_hidden=(2,))
    networks = make_networks(tiger_preset(), config, seed=0), make_values(tiger_preset(), config, seed=0)
    save_checkpoint(folder / "a.pt", Checkpoint(tiger_preset(), config, "API", 1, *networks))
    return folder / "a.pt"


def tiger_preset():
    return problems.make_problem("tiger")
