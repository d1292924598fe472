"""The library's ids in Gymnasium, registered by ``import torchrl_pomdp``.

Gymnasium has no entry points for plug-ins. Its import takes longer than that of the library's command, so it is not imported
for its registry: the ids are registered now where Gymnasium is imported already, and else as soon as it is.
"""

from __future__ import annotations

import importlib.util
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

__all__ = ["register"]

_REGISTRY = "gymnasium.envs.registration"
# The paper's number of stages.
_STAGES = 400


def register() -> None:
    """Register the ids, now or when Gymnasium is imported.

    Examples:
        >>> import gymnasium
        >>> register()
        >>> gymnasium.spec("torchrl_pomdp/PipelineRepair-v0").max_episode_steps
        400
    """
    if _REGISTRY in sys.modules:
        _register(sys.modules[_REGISTRY])
    elif not any(isinstance(finder, _WhenImported) for finder in sys.meta_path):
        sys.meta_path.insert(0, _WhenImported())


def _register(registration: ModuleType) -> None:
    for name in ("PipelineRepair", "PipelineRepairObservations"):
        if f"torchrl_pomdp/{name}-v0" not in registration.registry:
            registration.register(
                f"torchrl_pomdp/{name}-v0",
                entry_point=f"torchrl_pomdp.problems.gym:{name}",
                vector_entry_point=f"torchrl_pomdp.problems.gym:{name}Vector",
                max_episode_steps=_STAGES,
            )


class _WhenImported:
    """Finds the module of Gymnasium's registry where Python finds it, and registers the ids once it has been executed."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        if name != _REGISTRY:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: ModuleType) -> None:
                execute(module)
                _register(module)

            spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec
