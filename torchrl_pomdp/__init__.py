"""Lookahead, truncated rollout and partitioned approximate policy iteration for very large POMDPs, on TorchRL.

The method is that of Bhattacharya, Badyal, Wheeler, Gil and Bertsekas, "Reinforcement Learning for POMDP: Partitioned
Rollout and Policy Iteration with Application to Autonomous Sequential Repair Problems" (2020, arXiv:2002.04175); "the
paper" in all docstrings.
"""

from torchrl_pomdp.gym_ids import register_ids

__version__ = "0.1.0"

register_ids()
del register_ids
