"""The library's ids in Gymnasium, registered by ``import torchrl_pomdp``."""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

__all__ = ["register_ids"]

# The paper's number of stages.
_STAGES = 400


def register_ids() -> None:
    """Register the ids; what they make is imported when it is made.

    Examples:
        >>> import gymnasium
        >>> register_ids()
        >>> gymnasium.spec("torchrl_pomdp/PipelineRepair-v0").max_episode_steps
        400
    """
    for name in ("PipelineRepair", "PipelineRepairObservations"):
        if f"torchrl_pomdp/{name}-v0" not in registry:
            register(
                f"torchrl_pomdp/{name}-v0",
                entry_point=f"torchrl_pomdp.problems.gym:{name}",
                vector_entry_point=f"torchrl_pomdp.problems.gym:{name}Vector",
                max_episode_steps=_STAGES,
            )
