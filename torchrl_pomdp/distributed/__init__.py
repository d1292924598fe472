"""Policy iteration on a Ray cluster; needs the extra ``ray``.

Ray trusts all who reach its ports: whoever does can run code on every machine of the cluster. A cluster that is started here
listens on the loopback address alone; a cluster of several machines belongs into a network of its own.
"""

from torchrl_pomdp.distributed.ray_workers import RayWorkers

__all__ = ["RayWorkers"]
