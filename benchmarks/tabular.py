"""Belief updates per second of tabular models, sparse and dense."""

from __future__ import annotations

from functools import partial

import torch
from tensordict import TensorDict

from benchmarks.harness import Table, seconds, threads
from torchrl_pomdp.envs import TabularModel

_CONTROLS, _OBSERVATIONS, _NEXT = 4, 8, 8


def walk(states: int, *, sparse: bool) -> TabularModel:
    """A random walk on a ring: from each state to eight of the forty around it; eight observations."""
    generator = torch.Generator().manual_seed(0)
    here = torch.arange(states).repeat_interleave(_NEXT).repeat(_CONTROLS)
    there = (here + torch.randint(-20, 21, here.shape, generator=generator)) % states
    index = torch.stack([torch.arange(_CONTROLS).repeat_interleave(states * _NEXT), here, there])
    equal = torch.full((len(here),), 1.0 / _NEXT, dtype=torch.float64)
    transition = torch.sparse_coo_tensor(index, equal, (_CONTROLS, states, states), check_invariants=True).coalesce()
    observation = torch.rand(_CONTROLS, states, _OBSERVATIONS, generator=generator)
    observation /= observation.sum(-1, keepdim=True)
    cost = torch.rand(_CONTROLS, states, generator=generator)
    return TabularModel(transition if sparse else transition.to_dense(), observation, cost, 0.95)


def updates(table: Table) -> None:
    """Sampled belief steps of tabular models per second on one core, controls mixed, by states and rows at once."""
    for states, sparse in ((100, True), (100, False), (1000, True), (1000, False), (10_000, True)):
        model = walk(states, sparse=sparse)
        for rows in (1, 16, 1024):
            generator = torch.Generator().manual_seed(rows)
            belief = torch.rand(rows, states, generator=generator)
            y = TensorDict({"belief": belief / belief.sum(-1, keepdim=True)}, [rows])
            u, noise = torch.arange(rows) % _CONTROLS, torch.rand(rows, 1, generator=generator)
            with threads(1):
                (time,) = seconds(partial(model.advance, y, u, noise), repeats=7)
            kind = "sparse" if sparse else "dense"
            table.add(f"belief updates, {states} states, {kind}, {rows} rows at once", rows / time, "steps/s")
