"""Tabular models in compiled loops, for tree searches. Needs numba, which the extra ``fast`` installs."""

from torchrl_pomdp.modules.tabular.engine import TabularEngine, tabular_engine
from torchrl_pomdp.modules.tabular.searches import TabularView

__all__ = ["TabularEngine", "TabularView", "tabular_engine"]
