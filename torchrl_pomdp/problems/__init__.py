"""Problems: a belief model with all that goes with it (paper, Sections IV to VI)."""

from torchrl_pomdp.problems.classic import tiger
from torchrl_pomdp.problems.presets import PRESETS, make_problem
from torchrl_pomdp.problems.problem import Problem, Symmetry
from torchrl_pomdp.problems.repair import repair_problem
from torchrl_pomdp.problems.specs import problem_from_spec

__all__ = ["PRESETS", "Problem", "Symmetry", "make_problem", "problem_from_spec", "repair_problem", "tiger"]
