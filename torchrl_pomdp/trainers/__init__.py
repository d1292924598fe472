"""Policy iteration and the paper's algorithms (Sections IV to VI)."""

from torchrl_pomdp.trainers.architecture import make_networks, make_values
from torchrl_pomdp.trainers.config import PolicyIterationConfig
from torchrl_pomdp.trainers.parts import PartRecord, train_part
from torchrl_pomdp.trainers.policy_iteration import Evaluate, Improve, Iteration, PolicyIteration
from torchrl_pomdp.trainers.recipes import api, papi_nt, papi_t, r_nt, r_t

__all__ = [
    "Evaluate",
    "Improve",
    "Iteration",
    "PartRecord",
    "PolicyIteration",
    "PolicyIterationConfig",
    "api",
    "make_networks",
    "make_values",
    "papi_nt",
    "papi_t",
    "r_nt",
    "r_t",
    "train_part",
]
