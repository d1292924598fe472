"""What a training run calls the policies that it makes."""

from __future__ import annotations

import re

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.modules.multiagent import SCHEMES

__all__ = ["ALGORITHM_NAMES", "SCHEME_NAMES", "is_iteration", "is_on_top", "is_online", "is_own"]

ALGORITHM_NAMES = "pAPI-NT", "pAPI-T", "API"
"""Names of the algorithms that learn."""

SCHEME_NAMES = {scheme: scheme.replace("_", "-") for scheme in SCHEMES}
"""Names of multiagent rollout by scheme."""

_ONLINE = "|".join(["R-NT", "R-T", *SCHEME_NAMES.values()])


def is_iteration(policy: str) -> bool:
    """Whether a policy's name is that of what an iteration has trained.

    Raises:
        TypeError: if something is of the wrong kind.

    Examples:
        >>> is_iteration("pAPI-NT 2"), is_iteration("pAPI-NT 2 + R-NT"), is_iteration("rule 2")
        (True, False, False)
    """
    return re.fullmatch(rf"({'|'.join(ALGORITHM_NAMES)}) \d+", check_instance("policy", policy, str)) is not None


def is_online(policy: str) -> bool:
    """Whether a policy's name is that of online rollout of a base policy, such as R-NT of greedy."""
    return re.fullmatch(rf"({_ONLINE}) of .+", policy) is not None


def is_on_top(policy: str) -> bool:
    """Whether a policy's name is that of online rollout on top of another policy, such as API 2 + R-NT."""
    return re.fullmatch(rf".+ \+ ({_ONLINE})", policy) is not None


def is_own(policy: str) -> bool:
    """Whether a policy's name is that of something that a run makes."""
    return is_iteration(policy) or is_online(policy) or is_on_top(policy)
