"""Shared fixtures."""

from __future__ import annotations

import pytest
from torchrl import logger as torchrl_logger

from torchrl_pomdp.problems import make_problem

torchrl_logger.setLevel("WARNING")


@pytest.fixture(scope="session")
def linear20():
    return make_problem("linear20")


@pytest.fixture(scope="session")
def line3():
    return make_problem("line3")
