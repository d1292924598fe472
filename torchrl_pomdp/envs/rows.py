"""Rows of batches: drawing from their distributions, taking and putting them in the memory layout that they have."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase
from torch import Tensor

__all__ = ["flat_rows", "inverse_cdf", "put_rows", "random_control", "take_rows"]


def flat_rows(y: TensorDictBase) -> TensorDictBase:
    """The states of a batch ``[*B]`` as a flat one ``[N]``.

    ``y.reshape(-1)`` would make a row of none.

    Examples:
        >>> flat_rows(TensorDict({}, [2, 3])).batch_size, flat_rows(TensorDict({}, [2, 0])).batch_size
        (torch.Size([6]), torch.Size([0]))
    """
    return y.reshape(y.batch_size.numel())


def inverse_cdf(probs: Tensor, noise: Tensor, dim: int = -1) -> Tensor:
    """Index drawn from ``probs`` by inverting its distribution function at ``noise``.

    Args:
        probs: nonnegative weights with positive sum along ``dim``.
        noise: uniforms in [0, 1) of ``probs``' shape without ``dim``.
        dim: the dimension that is drawn from.

    Returns:
        int64 index of ``noise``'s shape; an index of probability zero is never returned.

    Examples:
        >>> import torch
        >>> inverse_cdf(torch.tensor([0.0, 0.25, 0.75, 0.0]).expand(3, 4), torch.tensor([0.0, 0.25, 0.999])).tolist()
        [1, 2, 2]
    """
    cumulative = probs.cumsum(dim)
    # Scaling by the rounded total keeps the threshold below it, so trailing zeros are not reached.
    threshold = (noise * cumulative.select(dim, -1)).unsqueeze(dim)
    return (cumulative.narrow(dim, 0, probs.shape[dim] - 1) <= threshold).sum(dim)


def random_control(mask: Tensor, noise: Tensor) -> Tensor:
    """A legal control, each as probable as another.

    Args:
        mask: legal controls, bool ``[*B, *S, n]``, at least one in a row, see :mod:`~torchrl_pomdp.envs.controls`.
        noise: uniforms in [0, 1), ``[*B, *S]``.

    Returns:
        controls, int64 ``[*B, *S]``.

    Examples:
        >>> import torch
        >>> random_control(torch.tensor([False, True, True]).expand(3, 3), torch.tensor([0.0, 0.4, 0.6])).tolist()
        [1, 1, 2]
    """
    return inverse_cdf(mask.to(noise.dtype), noise)


def take_rows(y: TensorDictBase, index: Tensor) -> TensorDictBase:
    """Rows ``index`` (int64 ``[M]``) of the flat batch ``y`` ``[N]``, each entry in the memory layout that it has.

    Indexing ``y[index]`` would turn entries whose batch dimension is innermost, such as beliefs kept as planes, into
    row-major ones, and every later step would pay for turning them back.

    Examples:
        >>> import torch
        >>> y = TensorDict({"belief": torch.rand(3, 5).T}, [5])
        >>> take_rows(y, torch.tensor([4, 0]))["belief"].stride()
        (1, 2)
    """

    def take(leaf: Tensor) -> Tensor:
        if _batch_innermost(leaf):
            planes = leaf.movedim(0, -1)
            return planes.flatten(0, -2).index_select(1, index).view(*planes.shape[:-1], -1).movedim(-1, 0)
        return leaf.index_select(0, index)

    return TensorDict({key: take(leaf) for key, leaf in y.items()}, batch_size=index.shape, device=y.device)


def put_rows(y: TensorDictBase, index: Tensor, rows: TensorDictBase) -> TensorDictBase:
    """The flat batch ``y`` ``[N]`` with ``rows`` ``[M]`` in the places ``index`` (int64 ``[M]``); ``y`` is left alone.

    Examples:
        >>> import torch
        >>> y = TensorDict({"belief": torch.zeros(3, 5).T}, [5])
        >>> put_rows(y, torch.tensor([4]), TensorDict({"belief": torch.ones(1, 3)}, [1]))["belief"].sum(-1).tolist()
        [0.0, 0.0, 0.0, 0.0, 3.0]
    """

    def put(leaf: Tensor, new: Tensor) -> Tensor:
        if _batch_innermost(leaf):
            planes = leaf.movedim(0, -1)
            result = planes.flatten(0, -2).index_copy(1, index, new.movedim(0, -1).flatten(0, -2))
            return result.view(planes.shape).movedim(-1, 0)
        return leaf.index_copy(0, index, new)

    changed = {key: put(leaf, rows.get(key)) for key, leaf in y.items()}
    return TensorDict(changed, batch_size=y.batch_size, device=y.device)


def _batch_innermost(leaf: Tensor) -> bool:
    return leaf.ndim > 1 and leaf.stride(0) == 1
