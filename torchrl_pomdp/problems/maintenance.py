r"""The k-out-of-5 maintenance problem of Bhustali and Andriotis (2023), in their hard configuration, and its base policies."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pomdp.checks import check_instance, check_integer, check_number
from torchrl_pomdp.envs.digits import joined
from torchrl_pomdp.envs.sums import sum_first
from torchrl_pomdp.modules.encoders import Encoder
from torchrl_pomdp.modules.policies import Policy
from torchrl_pomdp.modules.terminal_costs import ClosedFormCost
from torchrl_pomdp.noise import fold, uniform
from torchrl_pomdp.problems.maintenance_model import INSPECT, REPLACE, Component, MaintenanceModel
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.tensor_checks import check_device, check_entries, check_keys

__all__ = [
    "NewComponents",
    "PeriodicInspection",
    "RandomWear",
    "RemainingStages",
    "ReplaceFailed",
    "WearEncoder",
    "maintenance",
]

COMPONENTS = (
    Component(30, 1.00, 20, 0.80, ((0.82, 0.13, 0.05, 0), (0, 0.87, 0.09, 0.04), (0, 0, 0.91, 0.09), (0, 0, 0, 1))),
    Component(90, 0.90, 40, 0.85, ((0.72, 0.19, 0.09, 0), (0, 0.78, 0.18, 0.04), (0, 0, 0.85, 0.15), (0, 0, 0, 1))),
    Component(80, 0.95, 25, 0.90, ((0.79, 0.17, 0.04, 0), (0, 0.85, 0.09, 0.06), (0, 0, 0.91, 0.09), (0, 0, 0, 1))),
    Component(250, 0.85, 50, 0.95, ((0.80, 0.12, 0.08, 0), (0, 0.83, 0.12, 0.05), (0, 0, 0.89, 0.11), (0, 0, 0, 1))),
    Component(350, 0.80, 100, 0.80, ((0.88, 0.12, 0, 0), (0, 0.90, 0.10, 0), (0, 0, 0.93, 0.07), (0, 0, 0, 1))),
)
PENALTY = 3.0 * sum(component.replacement_cost for component in COMPONENTS)
# What a key's independent streams of uniforms are for.
_TIME, _LEVELS, _KIND = range(3)
# Stages over which what is left tells the encoder of the end.
_SCALES = (3.0, 10.0)
# The best inspection period and replacement threshold for each k, found by a search over both.
INSPECTIONS = {1: (35, 2), 2: (35, 2), 3: (35, 2), 4: (26, 2), 5: (3, 1)}


class ReplaceFailed(TensorDictModuleBase):
    """Replace the components that have failed, and do nothing else; a failure is always seen.

    Args:
        model: the maintenance model.

    Raises:
        TypeError: if it is none.

    Examples:
        >>> problem = maintenance(3)
        >>> problem.model.control_names[int(ReplaceFailed(problem.model)(problem.start(torch.tensor(0)))["action"])]
        'nothing'
    """

    in_keys = ["belief"]
    out_keys = ["action"]

    def __init__(self, model: MaintenanceModel) -> None:
        super().__init__()
        self.model = check_instance("model", model, MaintenanceModel)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"``, int64 ``[*B]``."""
        check_entries("tensordict", tensordict, self.in_keys)
        failed = tensordict.get("belief")[..., -1] > 0.5
        return tensordict.set("action", joined(failed * REPLACE, 3))


class PeriodicInspection(TensorDictModuleBase):
    """Inspect all components every ``period`` stages and replace those found worn; replace failed ones at any stage.

    A component is found worn if, in the stage after an inspection, it is more likely than not to have reached a level. What an
    inspection in the last stage would show comes too late, so there is none.

    Args:
        model: the maintenance model.
        period: T, the number of stages from one inspection to the next; the first one is in stage T - 1, counted from 0.
        threshold: the level.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``period`` is not positive or ``threshold`` is not a level of wear.

    Examples:
        >>> problem = maintenance(5)
        >>> y = problem.start(torch.tensor(0)).set("time", torch.tensor(4))
        >>> problem.model.control_names[int(PeriodicInspection(problem.model, 5, 2)(y)["action"])]
        'inspect 1 2 3 4 5'
    """

    in_keys = ["belief", "time"]
    out_keys = ["action"]

    def __init__(self, model: MaintenanceModel, period: int, threshold: int) -> None:
        super().__init__()
        self.model = check_instance("model", model, MaintenanceModel)
        self.period = check_integer("period", period, 1)
        self.threshold = check_integer("threshold", threshold, 1, model.num_levels - 1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"``, int64 ``[*B]``."""
        check_entries("tensordict", tensordict, self.in_keys)
        belief, time = tensordict.get("belief").movedim(-1, 0), tensordict.get("time").unsqueeze(-1)
        worn = sum_first(belief[self.threshold :].clone()) > 0.5
        inspected = (time > 0) & (time % self.period == 0)
        replaced = (belief[-1] > 0.5) | (worn & inspected)
        inspects = ((time + 1) % self.period == 0) & (time + 1 < self.model.num_stages)
        return tensordict.set("action", joined(torch.where(replaced, REPLACE, inspects * INSPECT), 3))


class NewComponents:
    """The start: every component new, and known to be.

    Args:
        model: the maintenance model.

    Raises:
        TypeError: if it is none.

    Examples:
        >>> NewComponents(maintenance(1).model)(torch.arange(2))["belief"][0, 0].tolist()
        [1.0, 0.0, 0.0, 0.0]
    """

    def __init__(self, model: MaintenanceModel) -> None:
        self.model = check_instance("model", model, MaintenanceModel)

    def __call__(self, keys: Tensor) -> TensorDictBase:
        """Feature states ``[*B]`` (core entries) for int64 keys ``[*B]``."""
        keys, model = check_keys("keys", keys), self.model
        belief = torch.zeros(*keys.shape, model.num_components, model.num_levels, dtype=model.dtype, device=keys.device)
        belief[..., 0] = 1.0
        return TensorDict({"belief": belief, "time": torch.zeros_like(keys)}, batch_size=keys.shape, device=keys.device)


class RandomWear:
    """Random feature states, for training: any stage, and components failed, new or worn.

    Whether a component has failed is known, as it is in play. A worn one's belief is Dirichlet(1, …, 1) over the other levels.

    Args:
        model: the maintenance model.
        failed: probability that a component has failed.
        new: probability that it is known to be new.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if a probability is out of range, or they add up to more than 1.

    Examples:
        >>> y = RandomWear(maintenance(1).model)(torch.arange(1000))
        >>> (y["belief"][..., -1] == 1.0).any(-1).sum() > 500, int(y["time"].max())
        (tensor(True), 49)
    """

    def __init__(self, model: MaintenanceModel, failed: float = 0.2, new: float = 0.2) -> None:
        self.model = check_instance("model", model, MaintenanceModel)
        self.failed, self.new = check_number("failed", failed, "[0, 1]"), check_number("new", new, "[0, 1]")
        # Decimal shares of 1 may add up to a bit more.
        if self.failed + self.new > 1.0 + 1e-9:
            raise ValueError(f"failed and new must add up to at most 1, got {self.failed} and {self.new}")

    def __call__(self, keys: Tensor) -> TensorDictBase:
        """Feature states ``[*B]`` (core entries) for int64 keys ``[*B]``."""
        keys, model = check_keys("keys", keys), self.model
        shape = (*keys.shape, model.num_components, model.num_levels)
        time = (_uniforms(keys, _TIME, 1).squeeze(-1) * model.num_stages).to(torch.int64)
        # Normalised exponentials are Dirichlet(1, …, 1).
        weight = -torch.log1p(-_uniforms(keys, _LEVELS, shape[-2] * shape[-1]).double()).view(shape).clamp_min(2.0**-30)
        weight[..., -1] = 0.0
        belief = weight / sum_first(weight.movedim(-1, 0).clone()).unsqueeze(-1)
        certain = torch.eye(model.num_levels, dtype=belief.dtype, device=keys.device)
        kind = _uniforms(keys, _KIND, model.num_components).unsqueeze(-1)
        belief = torch.where(kind < self.failed + self.new, certain[0], belief)
        belief = torch.where(kind < self.failed, certain[-1], belief)
        return TensorDict({"belief": belief.to(model.dtype), "time": time}, batch_size=keys.shape, device=keys.device)


class RemainingStages(ClosedFormCost):
    r""":math:`\hat J` is the largest stage cost in all stages that are left, and in one at least.

    Args:
        model: the maintenance model.

    Raises:
        TypeError: if it is none.

    Examples:
        >>> problem = maintenance(1)
        >>> RemainingStages(problem.model).costs(problem.start(torch.arange(1)).set("time", torch.tensor([48])))
        tensor([6368.])
    """

    in_keys = ["time"]
    table: Tensor

    def __init__(self, model: MaintenanceModel) -> None:
        super().__init__()
        check_instance("model", model, MaintenanceModel)
        left = torch.arange(model.num_stages, -1, -1, dtype=torch.float64).clamp_min(1.0)
        costs = (1.0 - model.discount**left) / (1.0 - model.discount) * model.max_cost
        self.register_buffer("table", costs.to(model.device, model.dtype), persistent=False)

    def costs(self, y: TensorDictBase) -> Tensor:
        """Costs ``[*B]``."""
        return self.table[y.get("time")]


class WearEncoder(Encoder):
    """What the networks see: the components' beliefs, how many have failed (one-hot), and the stages that are left.

    Near the end less and less pays. The stages left are therefore three smooth numbers: their share of all stages, and two that
    rise from zero in the last stages. They tell more from fewer labels than the stage one-hot.

    Args:
        model: the maintenance model.

    Raises:
        TypeError: if it is none.

    Examples:
        >>> problem = maintenance(1)
        >>> WearEncoder(problem.model)(problem.start(torch.arange(2))).shape
        torch.Size([2, 29])
    """

    stages: Tensor

    def __init__(self, model: MaintenanceModel) -> None:
        super().__init__()
        self.keys, self.dtype = check_instance("model", model, MaintenanceModel).state_keys, model.dtype
        left = torch.arange(model.num_stages, -1, -1, dtype=torch.float64)
        stages = torch.stack([left / model.num_stages, *((-left / scale).exp() for scale in _SCALES)], -1)
        # A table: functions such as exp may round by the number of states.
        self.register_buffer("stages", stages.to(model.device, model.dtype), persistent=False)
        self.num_features = model.num_components * (model.num_levels + 1) + 1 + stages.shape[-1]

    def encode_rows(self, y: TensorDictBase, rows: Tensor | None) -> Tensor:
        """See :class:`Encoder`."""
        belief, time = y.get("belief"), y.get("time")
        if rows is not None:
            belief, time = belief.index_select(0, rows), time.index_select(0, rows)
        failed = (belief[..., -1] > 0.5).sum(-1, keepdim=True)
        count = failed == torch.arange(belief.shape[-2] + 1, device=belief.device)
        return torch.cat([belief.flatten(-2), count.to(self.dtype), self.stages[time]], -1)


def _uniforms(keys: Tensor, purpose: int, count: int) -> Tensor:
    """``count`` uniforms ``[*B, count]`` of each key's stream for one purpose."""
    return uniform(fold(keys, purpose).unsqueeze(-1), torch.arange(count, device=keys.device))


def maintenance(k: int = 5, *, name: str | None = None, device: torch.device | str = "cpu") -> Problem:
    """The maintenance problem of five components, k of which must work, for 50 stages at discount 0.99.

    Its base policies are ``failed``, replace what has failed, and ``condition``, inspect all periodically and replace what is
    worn. The first of them is the better one, for k = 5 ``condition``; with k below 5 no period is worth its inspections.

    Recipe: ``torchrl-pomdp train maintenance4 --algorithm API --iterations 1 --samples-per-part 15000 --trajectories 1
    --loss advantage --hidden 64 64 --visits-per-label 0.2 --exploration 0.05 --states 10``, a few minutes on one core; then
    ``torchrl-pomdp evaluate`` with ``--states 20000``. With two training seeds the networks cost 0.91 and 0.93 times what the
    base policy costs. With 10000 samples it is 0.49 and 0.42 times for k = 1, 0.76 and 0.74 for k = 2, 0.98 and 0.95 for k = 5.
    For k = 3, with ``--samples-per-part 30000 --visited-share 0.85 --least-steps 2000``, it is 0.96 times, or more than the
    base policy's cost.

    Args:
        k: how many components must work, 1 to 5.

    Keyword Args:
        name: what it is called; None: as k says.
        device: where the model computes.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``k`` is out of range or there is no such device.

    Examples:
        >>> problem = maintenance(4)
        >>> problem.name, problem.model.num_controls, list(problem.base_policies)
        ('4-out-of-5 maintenance', 243, ['failed', 'condition'])
    """
    k = check_integer("k", k, 1, len(COMPONENTS))
    model = MaintenanceModel(COMPONENTS, k, penalty=PENALTY, device=check_device("device", device))
    policies: dict[str, Policy] = {"failed": ReplaceFailed(model), "condition": PeriodicInspection(model, *INSPECTIONS[k])}
    first = "condition" if k == len(COMPONENTS) else "failed"
    return Problem(
        model,
        NewComponents(model),
        name=f"{k}-out-of-{len(COMPONENTS)} maintenance" if name is None else name,
        # Half as many failed as it takes for the system to fail.
        training=(RandomWear(model, (len(COMPONENTS) + 1 - k) / (2 * len(COMPONENTS))),),
        base_policies={first: policies.pop(first), **policies},
        pessimistic_cost=RemainingStages(model),
        encoder=WearEncoder,
    )
