"""Policy iteration on a Ray cluster; needs the extra ``ray``.

Labels, visited states and evaluations are stateless tasks. Each part has an actor that trains its network; blocks of labels go
from the workers straight to the actors. :class:`RayWorkers` is given to a recipe, a training run, or an evaluation as
``workers``; the command has ``--backend ray``.

Trust: whoever reaches Ray's ports can run code on every machine of the cluster. A cluster that is started here listens on the
loopback address, without a dashboard, with Ray's token. A cluster of several machines belongs into a network of its own. All
machines need the same versions of this library, torch and numba, and the code of problems of one's own; what goes between them
is pickled, what is kept in files never is.

TorchRL's own ``RayCollector`` takes :class:`~torchrl_pomdp.collectors.RolloutImprovement` as its ``collector_class``, with
``num_workers`` among ``collector_kwargs``; call ``update_policy_weights_`` before the first batch.
"""

from torchrl_pomdp.distributed.ray_workers import RayWorkers

__all__ = ["RayWorkers"]
