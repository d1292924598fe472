"""The library's ids in Gymnasium.

``import gymnasium`` registers them by itself where the library is installed: it calls :func:`register`, the entry point of
group ``gymnasium.envs``. So nothing is imported here that takes long.
"""

from __future__ import annotations

__all__ = ["register"]

# The paper's number of stages.
_STAGES = 400


def register() -> None:
    """Register the ids that are not registered yet.

    Examples:
        >>> import gymnasium
        >>> register()
        >>> gymnasium.spec("torchrl_pomdp/PipelineRepair-v0").max_episode_steps
        400
    """
    from gymnasium.envs import registration

    for name in ("PipelineRepair", "PipelineRepairObservations"):
        if f"torchrl_pomdp/{name}-v0" not in registration.registry:
            registration.register(
                f"torchrl_pomdp/{name}-v0",
                entry_point=f"torchrl_pomdp.problems.gym:{name}",
                vector_entry_point=f"torchrl_pomdp.problems.gym:{name}Vector",
                max_episode_steps=_STAGES,
            )
