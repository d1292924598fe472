"""Problems: a belief model with all that goes with it (paper, Sections IV to VI)."""

from torchrl_pomdp.problems.check import check_belief_model
from torchrl_pomdp.problems.check_partition import PartitionReport, check_partition
from torchrl_pomdp.problems.classic import crying_baby, tiger
from torchrl_pomdp.problems.maintenance import maintenance
from torchrl_pomdp.problems.presets import PRESETS, make_problem
from torchrl_pomdp.problems.problem import Problem, Symmetry
from torchrl_pomdp.problems.problem_file import read_problem
from torchrl_pomdp.problems.repair import repair_problem
from torchrl_pomdp.problems.rocksample import rocksample
from torchrl_pomdp.problems.specs import problem_from_spec

__all__ = [
    "PRESETS",
    "PartitionReport",
    "Problem",
    "Symmetry",
    "check_belief_model",
    "check_partition",
    "crying_baby",
    "maintenance",
    "make_problem",
    "problem_from_spec",
    "read_problem",
    "repair_problem",
    "rocksample",
    "tiger",
]
