"""From observations to feature states: the transform that keeps a belief beside a system whose state is hidden."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite
from torchrl.envs import Transform

from torchrl_pomdp.checks import check_instance
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.legal import LegalSpec

__all__ = ["TrackBelief"]


class TrackBelief(Transform):
    r"""Turns the controls and observations of a :class:`WorldEnv` into feature states, :math:`y' = F(y, u, z)`.

    The environment then has the entries of :class:`BeliefEnv`: core entries, ``"action_mask"`` and, if the model has a
    partition, ``"partition"``. ``"observation"`` stays; ``"prior"`` has become the first feature state and goes. Random
    controls are legal, and an illegal one raises before anything has happened. The feature state is in the TensorDict, not in
    the transform, so ``step`` must be given the TensorDict of the stage that the world is in.

    An episode ends as in :class:`BeliefEnv`: when the feature state is terminal, after which no cost is counted. That the
    hidden state is terminal ends nothing, as nobody knows: a robot goes on until it knows that nothing is damaged. Where the
    feature state is terminal and the hidden state is not, in a repair problem of a probability up to :math:`\epsilon`, the
    costs that would follow are left out, as :class:`BeliefEnv` leaves them out.

    Args:
        model: the belief model by which observations are read: the environment's, or one of the same entries, controls and
            observations, with another partition or, to see what a wrong model costs, other probabilities.

    Raises:
        TypeError: if ``model`` is no belief model.
        ValueError: if the environment is no WorldEnv, or one of other entries or observations; by ``step`` if a control is
            illegal, or an observation impossible by the model.

    Examples:
        >>> import torch
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_pomdp.envs import WorldEnv
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> env = WorldEnv(problem.model, problem.start, batch_size=(4,), seed=0)
        >>> played = TransformedEnv(env, TrackBelief(problem.model)).rollout(6, GreedyRepair(problem.model))
        >>> played["next", "belief"].shape, played["next", "observation"].shape
        (torch.Size([4, 6, 20, 5]), torch.Size([4, 6]))
    """

    def __init__(self, model: BeliefModel) -> None:
        super().__init__()
        self.model = check_instance("model", model, BeliefModel)

    # ---- specs -------------------------------------------------------------------------------------------------------

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """The entries that come out; see :class:`torchrl.envs.Transform`, also for what follows."""
        self._check_fits(observation_spec)
        spec = observation_spec.clone()
        del spec["prior"]
        spec.update(self.model.feature_spec(spec.shape))
        return spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """The entries that a step reads."""
        spec = state_spec.clone()
        spec.update(self.model.feature_spec(spec.shape))
        return spec

    def _check_fits(self, given: Composite) -> None:
        """Raise unless an environment puts out what :class:`WorldEnv` does for this model."""
        if not isinstance(given.get("observation", None), Categorical) or given.get("prior", None) is None:
            raise ValueError("TrackBelief needs a WorldEnv, whose entries are 'observation' and 'prior', beneath it")
        size, shown = self.model.num_observations + 1, given["observation"].n
        # A model's spec need not name a device.
        expected = self.model.state_spec(given.shape).to(self.model.device)
        if given["prior"].to(self.model.device) != expected or shown != size:
            entries = {key: tuple(leaf.shape[given.ndim :]) for key, leaf in given["prior"].items()}
            raise ValueError(
                f"model must be of the environment's entries {entries}, their types and its {shown - 1} observations, "
                f"got {self.model.describe()}"
            )

    # ---- a step and a start ------------------------------------------------------------------------------------------

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # Before the world moves: what is refused here changes nothing.
        self.model.check_state(tensordict)
        self.model.check_controls(tensordict, tensordict.get("action", None))
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        y = tensordict.select(*self.model.state_keys, "action_mask", strict=False)
        u, z, moved = tensordict.get("action"), next_tensordict.get("observation"), tensordict.get("_step", None)
        if moved is None:
            nxt = self.model.estimator(y, u, z)
        else:
            # Rows that TorchRL does not step, because they are finished, stay as they are.
            moved, nxt = moved.reshape(y.batch_size), y.clone()
            nxt[moved] = self.model.estimator(y[moved], u[moved], z[moved])
        nxt = self.model.derive(nxt)
        over = tensordict.get("terminated", None)
        over = self.model.is_terminal(y).unsqueeze(-1) if over is None else over
        next_tensordict.set("reward", next_tensordict.get("reward").masked_fill(over, 0.0))
        return self._put(next_tensordict, nxt, None)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        # The specs are made at the latest here, which sees whether the model fits.
        _ = self.container.observation_spec
        prior, flags = tensordict_reset.get("prior"), tensordict.get("_reset", None)
        if flags is None or bool(flags.all()):
            return self._put(tensordict_reset, self.model.with_features(prior), None)
        # Of rows that do not start anew there may be no prior; TorchRL puts back what they were.
        started, y = flags.reshape(prior.batch_size), self.model.feature_spec(prior.batch_size).zero()
        y[started] = self.model.with_features(prior[started])
        return self._put(tensordict_reset, y, flags)

    def _put(self, tensordict: TensorDictBase, y: TensorDictBase, changed: Tensor | None) -> TensorDictBase:
        """Feature states in place of priors, with their ends; random controls become legal in those that have ``changed``."""
        tensordict.pop("prior")
        tensordict.update(y)
        terminated = self.model.is_terminal(y).unsqueeze(-1)
        tensordict.update({"terminated": terminated, "done": terminated | tensordict.get("truncated")})
        controls = self.container.full_action_spec["action"]
        if isinstance(controls, LegalSpec):
            controls.show(y.get("action_mask"), changed)
        return tensordict

    def forward(self, tensordict: Any) -> TensorDictBase:
        """Refused: of stored observations alone, without the world that gave them, no feature state can be made."""
        raise RuntimeError("TrackBelief works in an environment only: TransformedEnv(WorldEnv(...), TrackBelief(model))")
