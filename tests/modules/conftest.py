"""Tests of the engine run by the compiled loop and by tensors."""

from __future__ import annotations

import pytest

BOTH = {"test_engine", "test_last_bit", "test_lookahead", "test_multistep", "test_parallel", "test_rollout", "test_truncation"}


def pytest_generate_tests(metafunc):
    if metafunc.module.__name__ in BOTH:
        metafunc.fixturenames.append("simulated_by")
        metafunc.parametrize("simulated_by", ["loop", "tensors"], indirect=True)


@pytest.fixture
def simulated_by(request, monkeypatch):
    if request.param == "tensors":
        monkeypatch.setattr("torchrl_pomdp.modules.rollout.scalar_engine", lambda *_: None)
