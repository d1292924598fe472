"""Small problems that everyone knows, as arrays."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_pomdp.checks import check_instance, check_integer, check_number
from torchrl_pomdp.envs.generators import FixedBelief
from torchrl_pomdp.envs.tabular import TabularModel
from torchrl_pomdp.modules.base_policies import Myopic
from torchrl_pomdp.modules.policies import Policy
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.tensor_checks import check_entries

__all__ = ["WhenProbable", "crying_baby", "tiger"]


class WhenProbable(TensorDictModuleBase):
    """One control where a state's probability reaches a threshold, else another; a policy for tabular models.

    Args:
        model: the tabular model.
        control: the control above the threshold.
        state: the state.
        threshold: the probability, in [0, 1]; at 0 it is always ``control``.
        otherwise: the control below the threshold.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if there is no such state or control, or the threshold is no probability.

    Examples:
        >>> problem = crying_baby()
        >>> feed = WhenProbable(problem.model, control=0, state=1, threshold=0.5, otherwise=1)
        >>> int(feed(problem.start(torch.tensor(0)))["action"])
        1
    """

    in_keys = ["belief"]
    out_keys = ["action"]

    def __init__(self, model: TabularModel, control: int, state: int = 0, threshold: float = 0.0, otherwise: int = 0) -> None:
        super().__init__()
        most = check_instance("model", model, TabularModel).num_controls - 1
        self.control = check_integer("control", control, 0, most)
        self.otherwise = check_integer("otherwise", otherwise, 0, most)
        self.state = check_integer("state", state, 0, model.num_states - 1)
        self.threshold = check_number("threshold", threshold, "[0, 1]")

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"``, int64 ``[*B]``."""
        check_entries("tensordict", tensordict, self.in_keys)
        reached = tensordict.get("belief")[..., self.state] >= self.threshold
        return tensordict.set("action", torch.where(reached, self.control, self.otherwise))


def tiger(discount: float = 0.95, *, name: str = "tiger", device: torch.device | str = "cpu") -> Problem:
    r"""Tiger (Kaelbling, Littman and Cassandra 1998): controls listen, open left, open right; observations hear left, right.

    Listening costs 1 and is right with probability 0.85; the door of the tiger costs 100, the other pays 10. After a door
    is opened the tiger is placed anew. The base policy ``listen``, which opens no door, is a poor one; ``myopic`` opens one
    where that costs less than listening. What trains it: ``torchrl-pomdp train tiger --algorithm API --samples-per-part 500``.

    Args:
        discount: :math:`\alpha`.
        name: what it is called.
        device: where the model computes.

    Examples:
        >>> tiger().model.cost.tolist()
        [[1.0, 1.0], [100.0, -10.0], [-10.0, 100.0]]
    """
    half = torch.full((2, 2), 0.5)
    transition = torch.stack([torch.eye(2), half, half])
    hear = torch.tensor([[0.85, 0.15], [0.15, 0.85]])
    observation = torch.stack([hear, half, half])
    cost = torch.tensor([[1.0, 1.0], [100.0, -10.0], [-10.0, 100.0]])
    model = TabularModel(
        transition,
        observation,
        cost,
        discount,
        state_names=("tiger left", "tiger right"),
        control_names=("listen", "open left", "open right"),
        observation_names=("hear left", "hear right"),
        device=device,
    )
    policies: dict[str, Policy] = {"listen": WhenProbable(model, control=0), "myopic": Myopic(model)}
    return Problem(model, FixedBelief(torch.full((2,), 0.5, device=device)), name=name, base_policies=policies)


def crying_baby(discount: float = 0.9, *, name: str = "crying_baby", device: torch.device | str = "cpu") -> Problem:
    r"""Crying baby (Kochenderfer 2015): controls feed, ignore; observations crying, quiet; the baby is full or hungry.

    A stage costs 10 if the baby is hungry and 5 more if it is fed. Fed, it is full; a full one that is ignored gets hungry with
    probability 0.1, a hungry one stays so. It cries with probability 0.8 if it is hungry and 0.1 if it is full. It starts full.
    The base policy ``hungry`` feeds a baby that is more likely hungry than not; ``feed`` always does, a poor one.
    What trains it: ``torchrl-pomdp train crying_baby --algorithm API --base feed --samples-per-part 500``.

    Args:
        discount: :math:`\alpha`.
        name: what it is called.
        device: where the model computes.

    Examples:
        >>> crying_baby().model.cost.tolist()
        [[5.0, 15.0], [0.0, 10.0]]
    """
    transition = torch.tensor([[[1.0, 0.0], [1.0, 0.0]], [[0.9, 0.1], [0.0, 1.0]]])
    observation = torch.tensor([[0.1, 0.9], [0.8, 0.2]]).expand(2, 2, 2)
    model = TabularModel(
        transition,
        observation,
        torch.tensor([[5.0, 15.0], [0.0, 10.0]]),
        discount,
        state_names=("full", "hungry"),
        control_names=("feed", "ignore"),
        observation_names=("crying", "quiet"),
        device=device,
    )
    policies: dict[str, Policy] = {
        "hungry": WhenProbable(model, control=0, state=1, threshold=0.5, otherwise=1),
        "feed": WhenProbable(model, control=0),
    }
    return Problem(model, FixedBelief(torch.tensor([1.0, 0.0], device=device)), name=name, base_policies=policies)
