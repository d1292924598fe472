"""Compiled loops: random numbers and policies one at a time. Needs numba, which the extra ``fast`` installs."""

from torchrl_pomdp.scalar.twins import ScalarTwin, scalar_twin

__all__ = ["ScalarTwin", "scalar_twin"]
