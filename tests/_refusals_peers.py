"""Cases of the test of refusals: tree searches, and methods beside each other; see the cases of planning."""

from __future__ import annotations

import pytest
import torch
from _hostile import choices, flags, integers, mappings, numbers, objects, paths, policies, sequences, values
from _valid import a_problem, belief_model, callback, case, state

from torchrl_pomdp import changes, planners, report, trainers
from torchrl_pomdp.evaluation import compare

__all__ = ["PEERS"]

# fmt: off

TITLES = values(None, 3, b"x", [], object())


def few_changes(*args, **options):
    """Nothing has changed: what is refused is refused before."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(changes, "model_changes", dict)
        return changes.measure_changes(*args, **options)


def outcome():
    cost = torch.tensor([10.0, 20.0])
    return report.Outcome(compare(cost, cost), 0.1, 10.0, (10.0, 20.0))


def search(kind, **options):
    return case(
        kind, lambda made: made(state()),
        model=belief_model(),
        base_policy=(None, [wrong for wrong in policies() if wrong.value is not None]),
        max_steps=(5, [wrong for wrong in integers(1) if wrong.value is not None]),
        seed=(0, integers()),
        **options,
    )


def a_search(kind, **options):
    """A search with a budget of simulations; and one of time."""
    return {
        f"planners.{kind.__name__}": lambda _: search(
            lambda **given: kind(**given, seconds=None), simulations=(2, integers(1)), **options
        ),
        f"planners.{kind.__name__}.seconds": lambda _: case(
            lambda seconds: kind(belief_model()[0], seconds=seconds), seconds=(0.001, numbers("(0, inf)")),
        ),
    }


PEERS = {
    **a_search(planners.POMCP, exploration=(0.2, numbers("[0, inf)"))),
    **a_search(
        planners.DESPOT,
        scenarios=(3, integers(1)),
        depth=(4, [wrong for wrong in integers(1) if wrong.value is not None]),
        regularisation=(0.0, numbers("[0, inf)")),
        gap=(0.5, numbers("[0, 1)")),
        bound=("trivial", choices()),
    ),
    "report.Outcome": lambda _: case(
        report.Outcome,
        comparison=(outcome().comparison, objects(3)),
        seconds=(0.1, numbers("(0, inf)")),
        steps=(3.0, numbers("[0, inf)")),
        costs=((1.0, 2.0), [*sequences((1.0, 2.0), None, "x", 3, float("nan"))]),
    ),
    "report.peer_table": lambda _: case(
        report.peer_table, outcomes=({"a": outcome()}, [*mappings(), *values({"a": 3}, {"a": None})])
    ),
    "report.peer_figure": lambda _: case(
        report.peer_figure,
        outcomes=({"a": outcome()}, [*mappings(), *values({"a": 3}, {"a": None}, {})]),
        title=("title", TITLES),
    ),
    "changes.measure_changes": lambda _: case(
        few_changes,
        states=(2, integers(2)),
        trajectories=(1, integers(1)),
        report=callback(),
        progress=(False, flags()),
    ),
    "trainers.compare_peers": lambda folder: case(
        trainers.compare_peers,
        problem=a_problem(),
        folder=(folder / "run", paths()),
        checkpoint=(None, objects(3)),
        ppo_steps=(None, [wrong for wrong in integers(4096) if wrong.value is not None]),
        methods=(["urgency"], [wrong for wrong in sequences(["urgency"], None, 3, "x", b"x") if wrong.value is not None]),
        states=(2, integers(2)),
        seconds=(0.0005, numbers("(0, inf)")),
        seed=(0, integers()),
        report=callback(),
        progress=(False, flags()),
    ),
}
