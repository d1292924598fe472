"""What results were taken with: versions, hardware, threads."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

__all__ = ["provenance"]

_PACKAGES = ("torchrl-pomdp", "torch", "torchrl", "tensordict")


def provenance(*packages: str) -> dict[str, Any]:
    """Versions, hardware and threads, to put beside results.

    Args:
        packages: further packages whose versions matter.

    Examples:
        >>> sorted(provenance())
        ['cores', 'cpu', 'python', 'threads', 'versions']
    """
    return {
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in (*_PACKAGES, *packages)},
    }


def _cpu() -> str:
    """Name of the processor, where the system tells."""
    table = Path("/proc/cpuinfo")
    lines = table.read_text().splitlines() if table.is_file() else []
    names = (line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())
