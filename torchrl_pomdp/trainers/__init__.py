"""Policy iteration and the paper's algorithms (Sections IV to VI)."""

from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.trainers.architecture import make_networks, make_values
from torchrl_pomdp.trainers.asynchronous import AsynchronousIteration, Version
from torchrl_pomdp.trainers.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from torchrl_pomdp.trainers.parts import PartRecord, train_part
from torchrl_pomdp.trainers.peers import compare_peers
from torchrl_pomdp.trainers.plan import Evaluate, Improve
from torchrl_pomdp.trainers.policy_iteration import Iteration, PolicyIteration
from torchrl_pomdp.trainers.ppo import ppo
from torchrl_pomdp.trainers.recipes import api, papi_nt, papi_t, r_nt, r_t

__all__ = [
    "AsynchronousIteration",
    "Checkpoint",
    "Evaluate",
    "Improve",
    "Iteration",
    "PartRecord",
    "PolicyIteration",
    "PolicyIterationConfig",
    "Version",
    "api",
    "compare_peers",
    "load_checkpoint",
    "make_networks",
    "make_values",
    "papi_nt",
    "papi_t",
    "ppo",
    "r_nt",
    "r_t",
    "save_checkpoint",
    "train_part",
]
