"""What is drawn of feature states: plain numbers and texts, whatever draws them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded
from torchrl.data.tensor_specs import TensorSpec

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchrl_pomdp.envs.belief_model import BeliefModel

__all__ = ["MOST_CONTROLS", "Scene", "StatesScene", "control_bars", "rounded"]

MOST_CONTROLS = 32
"""Models with more controls have no bars of Q-factors: their names are too long."""

# Larger entries are drawn up to so many numbers.
_MOST_BARS = 60
# Bars of Q-factors: of the best controls.
_BEST = 8


class Scene:
    """How the feature states of a model are drawn: a bar for each number of a core entry in [0, 1], other entries as text.

    A model gives its scene by :meth:`BeliefModel.scene`; one that has a better picture gives a subclass.

    Args:
        model: the belief model.

    Examples:
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.trajectories import play
        >>> problem, key = make_problem("tiger"), torch.tensor(1)
        >>> scene = problem.model.scene()
        >>> scene.layout()
        {'kind': 'bars', 'bars': ['tiger left', 'tiger right'], 'more': 0}
        >>> scene.frames(play(problem.model, problem.base_policies["listen"], problem.start(key), key, max_steps=1))
        [{'does': 'listen', 'bars': [0.5, 0.5], 'text': '', 'truth': 'tiger right'}]
    """

    def __init__(self, model: BeliefModel) -> None:
        self.model = model
        spec = model.state_spec()
        self._bars = [key for key in model.state_keys if spec[key].dtype.is_floating_point and _shares(spec[key])]

    def layout(self) -> dict[str, Any]:
        """What stays the same, as JSON: the names of the bars, and how many are left out."""
        spec, names = self.model.state_spec(), []
        for key in self._bars:
            names += [" ".join([key, ",".join(map(str, place))]) for place in product(*map(range, spec[key].shape))]
        return {"kind": "bars", "bars": names[:_MOST_BARS], "more": max(0, len(names) - _MOST_BARS)}

    def frames(self, trajectory: TensorDictBase) -> list[dict[str, Any]]:
        """What changes, as JSON: one frame for each stage.

        Args:
            trajectory: ``[T]``, see :func:`~torchrl_pomdp.trajectories.play`.
        """
        found = [trajectory[key].reshape(len(trajectory), -1) for key in self._bars]
        bars = rounded(torch.cat(found, -1)[:, :_MOST_BARS]) if found else [[]] * len(trajectory)
        others = {key: trajectory[key] for key in self.model.state_keys if key not in self._bars}
        texts, truths = _texts(others, len(trajectory)), _texts(dict(trajectory.get("hidden", {}).items()), len(trajectory))
        does = [", ".join(self.model.shown_control(u)) for u in trajectory["action"]]
        return [
            {"does": doing, "bars": numbers, "text": text, "truth": truth}
            for doing, numbers, text, truth in zip(does, bars, texts, truths, strict=True)
        ]

    def figure(self, y: TensorDictBase, title: str = "") -> Figure:
        """A picture of a feature state, of batch ``()``; most models have none and raise a ``TypeError``."""
        raise TypeError(f"model has no picture: {type(self.model).__name__} must give a scene that overrides figure()")


class StatesScene(Scene):
    """The belief over states that have names.

    Args:
        model: a model whose core entry is a belief over states, and whose hidden states have their numbers as ``"state"``.
        names: of the states.
    """

    def __init__(self, model: BeliefModel, names: Sequence[str]) -> None:
        super().__init__(model)
        self.names = list(names)

    def layout(self) -> dict[str, Any]:
        """See :meth:`Scene.layout`."""
        return {**super().layout(), "bars": self.names[:_MOST_BARS]}

    def frames(self, trajectory: TensorDictBase) -> list[dict[str, Any]]:
        """See :meth:`Scene.frames`."""
        frames, hidden = super().frames(trajectory), trajectory.get("hidden", None)
        truths = [] if hidden is None else [self.names[state] for state in hidden["state"].reshape(-1).tolist()]
        return [{**frame, "truth": truth} for frame, truth in zip(frames, truths, strict=True)] if truths else frames


def rounded(numbers: Tensor) -> list[Any]:
    """Numbers ``[T, …]`` as nested lists, to what can be seen."""
    return [[round(number, 3) for number in row] for row in numbers.double().cpu().tolist()]


def _texts(entries: dict[str, Tensor], stages: int) -> list[str]:
    """Entries ``[T, …]`` in a line for each stage."""
    values = {key: value.reshape(stages, -1)[:, :_MOST_BARS].tolist() for key, value in entries.items()}
    lines = []
    for stage in range(stages):
        parts = [f"{key} {', '.join(f'{number:g}' for number in rows[stage])}" for key, rows in values.items()]
        lines.append("; ".join(parts))
    return lines


def control_bars(model: BeliefModel, trajectory: TensorDictBase) -> list[list[tuple[str, float, bool]]] | None:
    """For every stage of a trajectory ``[T]`` the best controls and the chosen one: name, Q-factor, and whether it is chosen.

    None where the trajectory has no ``q_factors`` of joint controls ``[T, U]``, or the model has more than 32 controls.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_pomdp.problems import make_problem
        >>> q = torch.tensor([[3.0, torch.inf, 2.0]])
        >>> trajectory = TensorDict({"q_factors": q, "action": torch.tensor([2])}, batch_size=1)
        >>> control_bars(make_problem("tiger").model, trajectory)
        [[('listen', 3.0, False), ('open right', 2.0, True)]]
    """
    q_factors = trajectory.get("q_factors", None)
    if q_factors is None or q_factors.ndim != 2 or model.num_controls > MOST_CONTROLS:
        return None
    bars = []
    for q, chosen in zip(q_factors.cpu(), trajectory["action"].tolist(), strict=True):
        legal = torch.isfinite(q).nonzero().flatten()
        shown = sorted({chosen, *legal[q[legal].argsort(stable=True)][:_BEST].tolist()})
        names = [", ".join(model.shown_control(torch.tensor(u, device=model.device))) for u in shown]
        bars.append([(name, float(q[u]), u == chosen) for name, u in zip(names, shown, strict=True)])
    return bars


def _shares(leaf: TensorSpec) -> bool:
    """Whether the numbers of an entry lie in [0, 1]."""
    return isinstance(leaf, Bounded) and bool((leaf.space.low >= 0.0).all() and (leaf.space.high <= 1.0).all())
