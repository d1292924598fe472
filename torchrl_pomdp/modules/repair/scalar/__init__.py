"""The repair problem in compiled loops, one trajectory at a time. Needs numba, which the extra ``fast`` installs."""

from torchrl_pomdp.modules.repair.scalar.engine import RepairEngine, repair_engine
from torchrl_pomdp.modules.repair.scalar.view import (
    Tables,
    View,
    expected_cost,
    extra_cost,
    intact,
    legal,
    part_of,
    probability,
)

__all__ = [
    "RepairEngine",
    "Tables",
    "View",
    "expected_cost",
    "extra_cost",
    "intact",
    "legal",
    "part_of",
    "probability",
    "repair_engine",
]
