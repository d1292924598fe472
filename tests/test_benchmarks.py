"""The benchmarks' reference loop is an oracle of its own: written row by row, it must give the engine's costs."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrl_pomdp.modules import TruncatedRollout
from torchrl_pomdp.modules.repair import GreedyRepair

ROOT = Path(__file__).parents[1]


def test_the_scalar_loop_and_the_engine_agree(linear20):
    sys.path.insert(0, str(ROOT))
    try:
        from benchmarks.numba_reference import greedy_rollout
    finally:
        sys.path.remove(str(ROOT))
    keys = torch.arange(300)
    y = linear20.start(keys)
    rise = np.array([0, 0.02, 0.03, 0.05, 0], np.float32)
    planes, places = y["belief"].transpose(1, 2).contiguous().numpy().copy(), y["location"][:, 0].numpy().copy()
    costs, steps = greedy_rollout(
        planes,
        places,
        keys.numpy().astype(np.uint64),
        rise,
        linear20.model.costs.numpy(),
        np.float32(0.99),
        400,
        np.float32(1e-6),
    )
    assert steps > 300 * 20
    engine = TruncatedRollout(linear20.model, GreedyRepair(linear20.model))(y, keys)
    torch.testing.assert_close(torch.from_numpy(costs), engine, rtol=1e-5, atol=1e-3)


def test_results_are_complete_and_unknown_names_are_refused(monkeypatch, capsys):
    results = json.loads((ROOT / "benchmarks" / "results.json").read_text())
    monkeypatch.syspath_prepend(ROOT)
    monkeypatch.setattr(sys, "argv", ["benchmarks", "nonsense"])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_module("benchmarks", run_name="__main__")
    known = capsys.readouterr().err.split("known: ")[1].strip().split(", ")
    assert set(known) == set(results)
    for result in results.values():
        assert result["machine"]["cores"] >= 1
        assert all({"name", "value", "unit", "target"} == set(row) for row in result["rows"])
