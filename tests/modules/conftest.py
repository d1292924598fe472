"""Tests of the engine run by the compiled loop and by tensors."""

from __future__ import annotations

import pytest

BOTH = {"test_engine", "test_last_bit", "test_lookahead", "test_multistep", "test_parallel", "test_rollout", "test_truncation"}
# Of these modules, tests of what tensors alone do.
TENSORS = {
    "test_beliefs_stay_normalised",
    "test_each_compiled_function_has_its_own_limit_of_compilations",
    "test_float32_agrees_with_float64_over_long_runs_on_long_lines",
    "test_fused_and_eager_agree",
    "test_labels_of_tabular_problems",
    "test_networks_of_the_papers_size",
    "test_outputs_of_networks",
    "test_realised_costs_with_independent_noise_make_rollout_worse_than_greedy",
    "test_without_a_compiler_it_runs_as_it_is",
}


def pytest_generate_tests(metafunc):
    if metafunc.module.__name__ in BOTH and metafunc.function.__name__ not in TENSORS:
        metafunc.fixturenames.append("simulated_by")
        metafunc.parametrize("simulated_by", ["loop", "tensors"], indirect=True)


@pytest.fixture
def simulated_by(request, monkeypatch):
    if request.param == "tensors":
        monkeypatch.setattr("torchrl_pomdp.modules.rollout.scalar_engine", lambda *_: None)
