"""What is drawn of repair problems: the network, its damage and the robots (paper, Section VI-A)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tensordict import TensorDictBase

from torchrl_pomdp.envs.repair.model import REPAIR, RepairModel
from torchrl_pomdp.envs.repair.rendering.figures import network_figure
from torchrl_pomdp.envs.repair.rendering.network import edges_of, places_of
from torchrl_pomdp.envs.repair.rendering.played import expected_damage
from torchrl_pomdp.envs.scene import Scene, rounded

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["NetworkScene"]


class NetworkScene(Scene):
    """Locations at their places with the expected damage and, where it is known, the true one; robots and what they do.

    Args:
        model: the repair model.

    Examples:
        >>> import torch
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.trajectories import play
        >>> problem, key = make_problem("line3"), torch.tensor(1)
        >>> scene = problem.model.scene()
        >>> scene.layout()["edges"]
        [[0, 1], [1, 2]]
        >>> scene.frames(play(problem.model, problem.base_policies["greedy"], problem.start(key), key, max_steps=1))
        [{'does': 'robot 1 repairs 0', 'damage': [1.0, 2.0, 2.0], 'truth': [1, 3, 1], 'robots': [0], 'to': [-1]}]
    """

    model: RepairModel

    def layout(self) -> dict[str, Any]:
        """Places, edges, names and the largest level."""
        graph = self.model.graph
        return {
            "kind": "network",
            "places": rounded(places_of(graph)),
            "edges": edges_of(graph).unique(dim=0).tolist(),
            "names": list(graph.location_names),
            "levels": self.model.num_levels - 1,
        }

    def frames(self, trajectory: TensorDictBase) -> list[dict[str, Any]]:
        """Expected damage, true levels, where the robots are, where they go, -1 for repair."""
        model, location = self.model, trajectory["location"]
        controls = model.split_controls(trajectory["action"])
        to = model.destinations[location, controls].masked_fill(controls == REPAIR, -1).tolist()
        hidden = trajectory.get("hidden", None)
        truth = [None] * len(trajectory) if hidden is None else hidden["level"].tolist()
        return [
            {"does": self._does(robots, ways), "damage": damage, "truth": true, "robots": robots, "to": ways}
            for damage, true, robots, ways in zip(
                rounded(expected_damage(model, trajectory["belief"])), truth, location.tolist(), to, strict=True
            )
        ]

    def figure(self, y: TensorDictBase, title: str = "") -> Figure:
        """The feature state on the graph, see :func:`~torchrl_pomdp.envs.repair.network_figure`."""
        return network_figure(self.model, y, title=title)

    def _does(self, robots: list[int], to: list[int]) -> str:
        names = self.model.graph.location_names
        return "; ".join(
            f"robot {number} {f'repairs {names[here]}' if there < 0 else f'goes from {names[here]} to {names[there]}'}"
            for number, (here, there) in enumerate(zip(robots, to, strict=True), 1)
        )
