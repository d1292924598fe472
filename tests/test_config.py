"""The numbers of a policy iteration: what is refused, by name."""

from __future__ import annotations

import math
from dataclasses import fields

import pytest

from torchrl_pomdp.config import PolicyIterationConfig

NUMBERS = [f.name for f in fields(PolicyIterationConfig) if type(f.default) in (int, float)]
COUNTS = [f.name for f in fields(PolicyIterationConfig) if type(f.default) is int and f.name != "seed"]


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1, 10**40, True, None, "3", (3,)])
def test_what_is_no_sensible_number_is_refused_by_name(name, value):
    with pytest.raises((ValueError, TypeError), match=f"^{name} must be"):
        PolicyIterationConfig(**{name: value})


@pytest.mark.parametrize("name", COUNTS)
@pytest.mark.parametrize("value", [0, 2.0, 10**12])
def test_counts_are_integers_within_bounds(name, value):
    with pytest.raises((ValueError, TypeError), match=f"^{name} must be"):
        PolicyIterationConfig(**{name: value})


@pytest.mark.parametrize(
    "change",
    [
        {"visits_per_label": 0.0}, {"visits_per_label": 1e6}, {"visited_share": 1.5}, {"exploration": -0.1},
        {"learning_rate": 0.0}, {"learning_rate": 1e9}, {"seed": 2**63}, {"symmetries": 1}, {"symmetries": None},
        {"hidden": ()}, {"hidden": "64"}, {"hidden": 64}, {"hidden": (64.0,)}, {"hidden": (10**9,)}, {"hidden": [1] * 200_000},
        {"value_hidden": (0,)}, {"value_hidden": (True,)}, {"value_hidden": None},
        {"loss": "L2"}, {"loss": 2}, {"encoder": "Flat"}, {"allocation": "all"}, {"leaves": None},
    ],
)  # fmt: skip
def test_other_nonsense_is_refused_by_name(change):
    with pytest.raises((ValueError, TypeError), match=f"^{next(iter(change))}"):
        PolicyIterationConfig(**change)


def test_equal_numbers_are_equal_configurations():
    """Whether sizes come as a list, as from JSON, or as a tuple."""
    assert PolicyIterationConfig(hidden=[8, 4], seed=2**63 - 1) == PolicyIterationConfig(hidden=(8, 4), seed=2**63 - 1)
    assert PolicyIterationConfig(learning_rate=1).learning_rate == 1.0


def test_one_validation_state_tells_nothing():
    with pytest.raises(ValueError, match="validation_states must be at least 2, got 1"):
        PolicyIterationConfig(validation_states=1)
