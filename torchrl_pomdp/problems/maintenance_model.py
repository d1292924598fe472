r"""k-out-of-n maintenance (Bhustali and Andriotis 2023): components wear unseen, and the system needs k of them to work.

A component has K levels of wear, the last one failed. In a stage, in this order: the control costs, and so does a system of
which fewer than k components work; the components that are replaced become as new or, where the replacement does not succeed,
stay what they are; every component wears by its chain; every component is observed. An inspection shows a level near the true
one; without one only a failure is seen. All ends after a number of stages. The components stay independent given the history,
so the belief is a distribution of the level for each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite

from torchrl_pomdp.checks import check_integer, check_number, check_sequence
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.digits import digits
from torchrl_pomdp.envs.partition import Partition
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.envs.world import World
from torchrl_pomdp.tensor_checks import check_device, check_distributions, check_dtype, check_representable, check_tensor

__all__ = ["INSPECT", "NOTHING", "REPLACE", "Component", "MaintenanceModel"]

NOTHING, REPLACE, INSPECT = range(3)
# Most controls, and most observations: all are numbered.
_MOST = 1 << 20


@dataclass(frozen=True)
class Component:
    """What is known of a component; its levels of wear are 0 (new) to K-1 (failed).

    Attributes:
        replacement_cost: cost of a replacement.
        success: probability that a replacement succeeds.
        inspection_cost: cost of an inspection.
        accuracy: probability that an inspection shows the true level, else it shows a neighbour; failures are always seen.
        chain: row-stochastic matrix ``[K, K]`` of the levels.
    """

    replacement_cost: float
    success: float
    inspection_cost: float
    accuracy: float
    chain: Sequence[Sequence[float]] | Tensor

    def __post_init__(self) -> None:
        for name, interval in {"replacement_cost": "[0, inf)", "inspection_cost": "[0, inf)", "success": "[0, 1]"}.items():
            check_number(name, getattr(self, name), interval)
        check_number("accuracy", self.accuracy, "[0, 1]")
        if isinstance(self.chain, Tensor):
            # What is written into the tensor later is none of the component's.
            object.__setattr__(self, "chain", self.chain.detach().clone())

    def inspection(self, levels: int) -> Tensor:
        """P(level shown | level), ``[K, K]``: a neighbour that works takes what the accuracy leaves, two of them half each."""
        table = torch.eye(levels, dtype=torch.float64)
        for level in range(levels - 1):
            near = [other for other in (level - 1, level + 1) if 0 <= other < levels - 1]
            if near:
                table[level, level] = self.accuracy
                table[level, near] = (1.0 - self.accuracy) / len(near)
        return table


class MaintenanceModel(BeliefModel):
    r"""Belief model of n components, k of which must work.

    Core entries: ``"belief"`` float ``[*B, n, K]``, the marginal distribution of each component's level, and ``"time"`` int64
    ``[*B]``, the number of stages gone, terminal when all are. A control is nothing, replace (1) or inspect (2) for each
    component, an observation the level that each component shows, 0 standing for "works" where it is not inspected; both are
    numbered with the first component most significant. All controls are legal.

    Args:
        components: the components.
        needed: k, how many must work.

    Keyword Args:
        penalty: cost of a stage in which fewer work.
        stages: number of stages.
        discount: :math:`\alpha`.
        partition: partition whose index becomes a feature.
        dtype: float32 or float64.
        device: where the model computes.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if there is no component, their chains do not fit together, there are more than a million controls or
            observations, or a number is out of range.

    Examples:
        >>> bulb = Component(3.0, 1.0, 0.0, 1.0, [[0.9, 0.1], [0.0, 1.0]])
        >>> model = MaintenanceModel([bulb, bulb], 1, penalty=10.0, stages=20)
        >>> model.describe()
        'MaintenanceModel: 9 controls, 4 observations, discount 0.99'
        >>> from tensordict import TensorDict
        >>> y = TensorDict({"belief": torch.full((2, 2), 0.5), "time": torch.tensor(0)})
        >>> model.control_names[3], float(model.expected_cost(y, torch.tensor(3)))
        ('replace 1', 5.5)
    """

    state_keys = ("belief", "time")
    max_cost: float
    chain: Tensor
    success: Tensor
    likelihood: Tensor
    controls: Tensor
    observations: Tensor
    control_cost: Tensor

    def __init__(
        self,
        components: Sequence[Component],
        needed: int,
        *,
        penalty: float,
        stages: int = 50,
        discount: float = 0.99,
        partition: Partition | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(discount, partition)
        dtype, device = check_dtype("dtype", dtype), check_device("device", device)
        self.num_components = self.noise_dim = len(check_sequence("components", components, Component, 1))
        self.needed = check_integer("needed", needed, 1, self.num_components)
        self.penalty = check_number("penalty", penalty, "[0, inf)")
        self.num_stages = check_integer("stages", stages, 1, 100_000)
        chain = _chains(components)
        self.num_levels = chain.shape[-1]
        self.num_controls, self.num_observations = 3**self.num_components, self.num_levels**self.num_components
        if max(self.num_controls, self.num_observations) > _MOST:
            sizes = f"3^{self.num_components} controls and {self.num_levels}^{self.num_components} observations"
            raise ValueError(f"components must have at most {_MOST} joint controls, and as many observations, got {sizes}")
        prices = torch.tensor([[0.0, part.replacement_cost, part.inspection_cost] for part in components], dtype=torch.float64)
        total = float(prices.amax(-1).sum()) + self.penalty
        self.max_cost = check_representable("penalty and costs of the components, in all,", total, dtype)
        inspection = torch.stack([part.inspection(self.num_levels) for part in components])
        controls = digits(torch.arange(self.num_controls), 3, self.num_components)
        tables = {
            "chain": chain,
            "success": torch.tensor([[part.success] for part in components], dtype=torch.float64),
            "likelihood": _likelihood(inspection),
            "control_cost": prices.T[controls, torch.arange(self.num_components)].sum(-1),
        }
        for name, table in tables.items():
            self.register_buffer(name, table.to(device, dtype), persistent=False)
        observations = digits(torch.arange(self.num_observations), self.num_levels, self.num_components)
        numbers = {"controls": controls, "observations": observations}
        for name, table in numbers.items():
            self.register_buffer(name, table.T.contiguous().to(device), persistent=False)
        self._chain_bands, self._inspection_bands = _bands(self.chain), _bands(inspection.to(device, dtype))
        self.control_names = tuple(_named(row) for row in controls.tolist())

    @property
    def device(self) -> torch.device:
        """Device of the model's tensors."""
        return self.chain.device

    @property
    def dtype(self) -> torch.dtype:
        """Type of beliefs and costs."""
        return self.chain.dtype

    @property
    def observation_digits(self) -> tuple[int, int]:
        """K and n: each component reports a level."""
        return self.num_levels, self.num_components

    def state_spec(self, batch_size: torch.Size | tuple[int, ...] = ()) -> Composite:
        """``belief`` ``[*B, n, K]`` in [0, 1] and ``time`` ``[*B]``."""
        shape = torch.Size(batch_size)
        belief = (*shape, self.num_components, self.num_levels)
        return Composite(
            belief=Bounded(0.0, 1.0, shape=belief, dtype=self.dtype, device=self.device),
            time=Categorical(self.num_stages + 1, shape=shape, dtype=torch.int64, device=self.device),
            shape=shape,
            device=self.device,
        )

    def check_state(self, y: TensorDictBase) -> None:
        """Raise unless ``y`` is a feature state; see :meth:`BeliefModel.check_state`. Marginals must sum to one."""
        super().check_state(y)
        check_distributions("entry 'belief' of y", y.get("belief"))

    def action_mask(self, y: TensorDictBase) -> Tensor:
        """All True, ``[*B, U]``."""
        return torch.ones(*y.batch_size, self.num_controls, dtype=torch.bool, device=self.device)

    def is_terminal(self, y: TensorDictBase) -> Tensor:
        """Bool ``[*B]``: all stages are gone."""
        return y.get("time") >= self.num_stages

    def expected_cost(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """Cost of the replacements and inspections, and of the system times P(fewer than k components work); ``[*B]``."""
        failed = y.get("belief")[..., -1].movedim(-1, 0)
        # P(so many of the components looked at work), so many = 0..k-1: the rest of the distribution is not needed.
        working = failed.new_zeros(self.needed, *y.batch_size)
        working[0] = 1.0
        for fails in failed:
            shifted = working[:-1] * (1.0 - fails)
            working = working * fails
            working[1:] += shifted
        cost = self.control_cost[u] + sum_first(working) * self.penalty
        return cost.masked_fill(self.is_terminal(y), 0.0)

    def observation_probs(self, y: TensorDictBase, u: Tensor) -> Tensor:
        r""":math:`\hat p(z\mid b_y,u)`, ``[*B, K^n]``: the product of the components'.

        Raises as :meth:`check_control_shape` does.
        """
        self.check_control_shape(y, u)
        controls = self._controls(u)
        seen = self._seen(self._worn(self._planes(y), controls), controls)
        joint = seen[0]
        for component in seen[1:]:
            joint = (joint.unsqueeze(1) * component).flatten(0, 1)
        return joint.T.reshape(*y.batch_size, self.num_observations)

    def estimator(self, y: TensorDictBase, u: Tensor, z: Tensor) -> TensorDictBase:
        """F(y, u, z): each component's marginal by Bayes' rule.

        Raises:
            ValueError: if a control is illegal or an observation impossible.
        """
        self.check_controls(y, u)
        self.check_observations(y, z)
        controls, shown = self._controls(u), self.observations[:, z.reshape(-1)]
        worn = self._worn(self._planes(y), controls)
        chance = self._seen(worn, controls).gather(1, shown.unsqueeze(1)).squeeze(1)
        self.refuse_impossible(z, (chance > 0).all(0).view(y.batch_size))
        return self._successor(y, worn, controls, shown)

    def advance(self, y: TensorDictBase, u: Tensor, noise: Tensor) -> tuple[Tensor, TensorDictBase]:
        """One sampled step; component i is observed with ``noise[..., i]``. See :meth:`BeliefModel.advance`."""
        controls = self._controls(u)
        worn = self._worn(self._planes(y), controls)
        shown = _drawn(self._seen(worn, controls), noise.reshape(-1, self.num_components).T)
        return self.expected_cost(y, u), self._successor(y, worn, controls, shown)

    def observed(self, y: TensorDictBase, u: Tensor) -> Tensor:
        """The components, ``[*B, n]``: something is seen of each at every stage."""
        return torch.arange(self.num_components, device=self.device).expand(*y.batch_size, -1)

    def world(self) -> World:
        """The components' true levels."""
        # Not at the top: the world knows the model.
        from torchrl_pomdp.problems.maintenance_world import MaintenanceWorld

        return MaintenanceWorld(self)

    # ---- kernels on planes [n, K, N] and components' controls [n, N] -------------------------------------------------

    def _planes(self, y: TensorDictBase) -> Tensor:
        """Belief of ``y`` as contiguous planes; free for states that the model made."""
        return y.get("belief").reshape(-1, self.num_components, self.num_levels).permute(1, 2, 0).contiguous()

    def _controls(self, u: Tensor) -> Tensor:
        return self.controls[:, u.reshape(-1)]

    def _worn(self, planes: Tensor, controls: Tensor) -> Tensor:
        """Marginals at the next stage, before anything is observed."""
        renewed = (controls == REPLACE).unsqueeze(1) * self.success.unsqueeze(1)
        return _mixed(planes, self._chain_bands).mul_(1.0 - renewed).add_(renewed * self.chain[:, 0].unsqueeze(-1))

    def _seen(self, worn: Tensor, controls: Tensor) -> Tensor:
        """P(level shown)."""
        plain = torch.zeros_like(worn)
        plain[:, 0] = sum_first(worn[:, :-1].transpose(0, 1).clone())
        plain[:, -1] = worn[:, -1]
        return torch.where((controls == INSPECT).unsqueeze(1), _mixed(worn, self._inspection_bands), plain)

    def _successor(self, y: TensorDictBase, worn: Tensor, controls: Tensor, shown: Tensor) -> TensorDictBase:
        """The feature states after the components have shown the levels ``shown`` ``[n, N]``."""
        row = torch.arange(self.num_components, device=self.device).unsqueeze(-1) + (controls == INSPECT) * self.num_components
        weight = worn * self.likelihood[:, row * self.num_levels + shown].transpose(0, 1)
        belief = weight / sum_first(weight.transpose(0, 1).clone()).unsqueeze(1)
        belief = belief.permute(2, 0, 1).reshape(*y.batch_size, self.num_components, self.num_levels)
        return self.successor(y, belief=belief, time=(y.get("time") + 1).clamp_max(self.num_stages))


def _bands(rows: Tensor) -> list[tuple[slice, slice, Tensor]]:
    """The diagonals of matrices ``[n, K, K]`` that are not zero: their rows, columns and numbers ``[n, K - |offset|, 1]``."""
    levels, bands = rows.shape[-1], []
    for offset in sorted(range(1 - levels, levels), key=abs):
        numbers = rows.diagonal(offset, 1, 2).unsqueeze(-1).contiguous()
        if offset == 0 or bool((numbers > 0).any()):
            first, last = max(0, -offset), levels - max(0, offset)
            bands.append((slice(first, last), slice(first + offset, last + offset), numbers))
    return bands


def _mixed(planes: Tensor, bands: list[tuple[slice, slice, Tensor]]) -> Tensor:
    """Mixtures ``[n, K, N]`` of the matrices' rows with the weights ``planes``: a pass for each diagonal.

    Multiplied and added number by number: a product of matrices would round by N.
    """
    result = planes * bands[0][2]
    for source, target, numbers in bands[1:]:
        result[:, target] += planes[:, source] * numbers
    return result


def _drawn(probs: Tensor, noise: Tensor) -> Tensor:
    """Indices ``[n, N]`` drawn from ``probs`` ``[n, K, N]`` at uniforms ``[n, N]``; one of probability zero is never drawn."""
    cumulative = [probs[:, 0]]
    for level in range(1, probs.shape[1]):
        cumulative.append(cumulative[-1] + probs[:, level])
    threshold = noise * cumulative[-1]
    index = torch.zeros(noise.shape, dtype=torch.int64, device=noise.device)
    for total in cumulative[:-1]:
        index += total <= threshold
    return index


def _chains(components: Sequence[Component]) -> Tensor:
    """The chains ``[n, K, K]`` in float64."""
    names = [f"chain of component {i + 1}" for i in range(len(components))]
    chains = [check_tensor(name, part.chain, (None, None)).double() for name, part in zip(names, components, strict=True)]
    levels = chains[0].shape[0]
    for name, chain in zip(names, chains, strict=True):
        if levels < 2 or chain.shape != (levels, levels):
            raise ValueError(f"{name} must have shape (K, K), the same K of at least 2 for all, got {tuple(chain.shape)}")
        check_distributions(name, chain)
    stacked = torch.stack(chains)
    return stacked / stacked.sum(-1, keepdim=True)


def _likelihood(inspection: Tensor) -> Tensor:
    """P(level shown | level), ``[K, 2 n K]``: first what components show that are not inspected, then those that are."""
    plain = torch.zeros_like(inspection)
    plain[:, :-1, 0] = plain[:, -1, -1] = 1.0
    return torch.stack([plain, inspection]).movedim(2, 0).flatten(1)


def _named(controls: list[int]) -> str:
    """Name of a joint control, such as ``replace 1 4, inspect 2``."""
    groups = []
    for control, verb in ((REPLACE, "replace"), (INSPECT, "inspect")):
        numbers = [str(i + 1) for i, each in enumerate(controls) if each == control]
        if numbers:
            groups.append(" ".join([verb, *numbers]))
    return ", ".join(groups) or "nothing"
