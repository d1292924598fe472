"""Lookahead, truncated rollout and partitioned approximate policy iteration for very large POMDPs, on TorchRL.

The method is that of Bhattacharya, Badyal, Wheeler, Gil and Bertsekas, "Reinforcement Learning for POMDP: Partitioned
Rollout and Policy Iteration with Application to Autonomous Sequential Repair Problems" (2020, arXiv:2002.04175); "the
paper" in all docstrings.
"""

import sys

__version__ = "0.1.0"

# A library that is not installed has no entry point; one that is has registered its ids when Gymnasium was imported.
if "gymnasium.envs.registration" in sys.modules:
    from torchrl_pomdp.gym_ids import register

    register()
    del register
del sys
