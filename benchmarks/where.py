"""Where the time of a rollout goes."""

from __future__ import annotations

import time
from collections import defaultdict
from contextlib import ExitStack
from unittest.mock import patch

import torch

from benchmarks.harness import Table, threads
from benchmarks.setting import by_tensors, linear20, networks
from torchrl_pomdp.envs.repair import RepairModel
from torchrl_pomdp.modules import PartitionedPolicy, TruncatedRollout
from torchrl_pomdp.modules import rollout as rollout_module
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.modules.scenarios import Scenarios

_PARTS = {
    "policy": [(GreedyRepair, "forward"), (PartitionedPolicy, "forward")],
    "features (mask, part)": [(RepairModel, "successor")],
    "cost": [(RepairModel, "_stage_cost")],
    "observation": [(RepairModel, "_draw_levels"), (RepairModel, "_columns")],
    "belief update": [(RepairModel, "_degrade_planes"), (RepairModel, "_set_levels")],
    "noise": [(Scenarios, "draw"), (RepairModel, "observed")],
    "end of trajectories": [
        (RepairModel, "is_terminal"),
        (rollout_module._Live, "replace_rows"),
        (rollout_module._Live, "rows"),
    ],
}


def profile(table: Table) -> None:
    """Shares of the time of a rollout by tensors on one core; what no part claims is bookkeeping."""
    problem = linear20()
    keys = torch.arange(32_768)
    y = problem.start(keys)
    for name, policy in (("greedy", GreedyRepair(problem.model)), ("network", networks())):
        spent: dict[str, float] = defaultdict(float)
        with ExitStack() as stack, threads(1):
            for part, places in _PARTS.items():
                for owner, attribute in places:
                    stack.enter_context(patch.object(owner, attribute, _timed(getattr(owner, attribute), part, spent)))
            rollout = by_tensors(TruncatedRollout(problem.model, policy))
            rollout(y[:4096], keys[:4096])
            spent.clear()
            begin = time.perf_counter()
            rollout(y, keys)
            total = time.perf_counter() - begin
        spent["bookkeeping"] = total - sum(spent.values())
        for part in [*_PARTS, "bookkeeping"]:
            table.add(f"{name} rollout: {part}", 100 * spent[part] / total, "%")


def _timed(function, part, spent):
    def call(*args, **kwargs):
        begin = time.perf_counter()
        result = function(*args, **kwargs)
        spent[part] += time.perf_counter() - begin
        return result

    return call
