"""Clusters of one and of two workers give what one process gives."""

from __future__ import annotations

import pytest
from _tiger import assert_same, carried_out

from torchrl_pomdp.collectors import labels
from torchrl_pomdp.distributed import RayWorkers
from torchrl_pomdp.workers import LOCAL


@pytest.mark.parametrize("count", [1, 2])
def test_synchronous_is_local_to_the_last_bit(monkeypatch, count):
    expected = carried_out(LOCAL)
    monkeypatch.setattr(labels, "_BLOCK", 512)
    with RayWorkers(num_workers=count) as workers:
        assert workers.num_workers == count
        assert_same(carried_out(workers), expected)
