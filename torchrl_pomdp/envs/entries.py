"""What a TensorDict of states must hold: the entries of a spec, of their shapes and types and within their bounds."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.data import Composite

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.tensor_checks import bounds_text, within

__all__ = ["RESERVED", "check_state_entries"]

RESERVED = frozenset(
    {"action", "action_mask", "partition", "logits", "q_factors", "state_value", "cost", "hidden", "told", "priority", "part"}
    | {"observation", "prior"}
    | {"next", "reward", "done", "terminated", "truncated", "step_count", "_reset", "_step", "collector", "traj_ids"}
    | {"advantage", "value_target", "action_log_prob"}
)
"""What stands beside a state's entries in the TensorDicts of this library and of TorchRL: no entry has such a name."""


def check_state_entries(name: str, value: Any, spec: Composite, kind: str) -> TensorDictBase:
    """States ``[*B]`` with the entries of a spec of one state; others are not looked at.

    Upper bounds may be passed by the rounding of a few operations, lower ones may not: sums only grow.

    Args:
        name: name of the argument.
        value: what was given.
        spec: the entries of one state.
        kind: what such a state is called.

    Raises:
        TypeError: if it is no TensorDict or an entry has the wrong dtype.
        ValueError: if an entry is missing, has the wrong shape, or lies outside its bounds.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> spec = Composite(level=Categorical(3, shape=(2,)))
        >>> check_state_entries("hidden", TensorDict({"level": torch.tensor([0, 3])}, []), spec, "a hidden state")
        Traceback (most recent call last):
        ValueError: entry 'level' of hidden holds values outside its bounds: expected 0 to 2
    """
    check_instance(name, value, TensorDictBase)
    for key, leaf in spec.items():
        entry = value.get(key, None)
        if entry is None:
            raise ValueError(f"{name} lacks the entry {key!r}; {kind} needs {list(spec.keys())}")
        shape = (*value.batch_size, *leaf.shape)
        if entry.shape != shape:
            raise ValueError(
                f"entry {key!r} of {name} has shape {tuple(entry.shape)}, expected {shape}: "
                f"the batch {tuple(value.batch_size)} followed by the entry's own shape"
            )
        if entry.dtype != leaf.dtype:
            raise TypeError(f"entry {key!r} of {name} has dtype {entry.dtype}, expected {leaf.dtype}")
        if entry.numel() and not within(leaf, entry):
            raise ValueError(f"entry {key!r} of {name} holds values outside its bounds: expected {bounds_text(leaf)}")
    return value
