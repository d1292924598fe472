"""A policy on a real robot: what is known, what to do next, what was seen."""

from __future__ import annotations

import json
from functools import cached_property
from os import PathLike
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_pomdp.checks import check_flag, check_instance, check_integer, check_mapping, shown
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.envs.partition import SinglePart
from torchrl_pomdp.identity import digest
from torchrl_pomdp.modules.policies import Policy, check_policy, controls_of

__all__ = ["Controller", "Decision"]

_FORMAT = "torchrl_pomdp controller 1"


class Decision(NamedTuple):
    """What to do next.

    Attributes:
        control: number of the control u; of many robots, whose joint controls are no numbers, each one's.
        names: its name; with several robots the name of each one's control.
    """

    control: int | tuple[int, ...]
    names: tuple[str, ...]


class Controller:
    r"""Keeps the feature state y of one real system, asks a policy for controls, and takes in what is observed.

    The loop is ``reset(prior)``, ``observe(...)`` if there is a look before the first control, and then again and again
    ``act()``, carrying out the control, ``update(control, observation)``. An observation is a number or a name. Of several
    robots it is a sequence, one for each, with None for a robot that does not report; for a
    :class:`~torchrl_pomdp.envs.repair.RepairModel` each is the damage level seen. Whatever is refused changes nothing.

    Args:
        model: the belief model.
        policy: any policy, such as a trained one, or :class:`~torchrl_pomdp.modules.RolloutPolicy` over it.

    Raises:
        TypeError: if an argument is of the wrong kind.

    Examples:
        >>> from torchrl_pomdp.modules import RolloutPolicy
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("linear20")
        >>> controller = Controller(problem.model, RolloutPolicy(problem.model, GreedyRepair(problem.model)))
        >>> controller.reset(problem.start(torch.tensor(3)))
        >>> decision = controller.act()
        >>> decision.names
        ('left',)
        >>> controller.update(decision.control, 0)
        >>> controller.update("left", 9)
        Traceback (most recent call last):
        ValueError: observation of robot 0 must be at most 4, got 9
    """

    def __init__(self, model: BeliefModel, policy: Policy) -> None:
        self.model = check_instance("model", model, BeliefModel)
        self.policy = check_policy("policy", policy, model)
        self._state: TensorDictBase | None = None
        self._steps = 0

    @classmethod
    def from_checkpoint(
        cls,
        path: str | PathLike[str],
        *,
        online: bool = False,
        problem: Any = None,
        device: torch.device | str = "cpu",
    ) -> Controller:
        """A controller with a trained policy.

        Args:
            path: file written by :func:`~torchrl_pomdp.trainers.save_checkpoint`.

        Keyword Args:
            online: whether the policy is the base policy of rollout at every decision, which is better and slower.
            problem: the problem, for a policy that was trained on a problem of one's own.
            device: where everything is put.

        Raises:
            TypeError: if an argument is of the wrong kind.
            ValueError: by :func:`~torchrl_pomdp.trainers.load_checkpoint`.
        """
        # Not at the top: whoever controls a robot by another policy needs no trainer.
        from torchrl_pomdp.trainers.checkpoint import load_checkpoint
        from torchrl_pomdp.trainers.recipes import r_nt

        check_flag("online", online)
        checkpoint = load_checkpoint(path, problem=problem, device=device)
        model, policy = checkpoint.problem.model, checkpoint.policy
        if online:
            # The policy that evaluations measure.
            policy = r_nt(checkpoint.problem, policy)
        return cls(model, policy)

    # ---- the loop ------------------------------------------------------------------------------------------------------

    def reset(self, prior: TensorDictBase) -> None:
        """Start anew from what is known beforehand.

        Args:
            prior: core entries of a feature state, of batch ``()``: for a repair problem ``"belief"`` ``[L, K]`` and
                ``"location"`` ``[R]``, for a tabular one ``"belief"`` ``[n]``. Batch ``(1,)`` is taken too.

        Raises:
            TypeError: if it is no TensorDict, or an entry has another type; floats of another precision are converted.
            ValueError: if it is no single feature state of the model.
        """
        self._state, self._steps = self._single("prior", prior), 0

    def observe(self, observation: Any) -> None:
        """Take in what is seen before the first control.

        Args:
            observation: number or name, for several robots one of each or None.

        Raises:
            TypeError: if it is of the wrong kind.
            ValueError: if there was a control already, the model has no such observation, or it is unknown or impossible.
        """
        y = self.state
        if self._steps:
            raise ValueError(f"observe is for the first look, got it after {self._steps} controls: use update(control, ...)")
        self._state = self._core(self.model.condition(y, observation))

    def act(self) -> Decision:
        """The policy's control in the present state; asked again it is the same.

        Raises:
            TypeError: if the policy gives no control.
            ValueError: if its control is illegal.
        """
        y = self.model.derive(self.state.unsqueeze(0))
        with torch.no_grad():
            u = controls_of("policy", self.policy, y.copy())
        self.model.check_controls(y, u)
        (u,) = u
        return Decision(int(u) if u.ndim == 0 else tuple(u.tolist()), self.model.shown_control(u))

    def update(self, control: Any, observation: Any) -> None:
        """Take in what was done and what was seen after it.

        Args:
            control: number or name of the control that was carried out, whoever chose it; for several robots also one of each.
            observation: number or name, for several robots one of each or None.

        Raises:
            TypeError: if one is of the wrong kind.
            ValueError: if the control is unknown or illegal, or the observation unknown or impossible after it.
        """
        y, u = self.state, self.model.given_control(control)
        self._check_legal(y, u)
        self._state, self._steps = self._core(self.model.follow(y, u, observation)), self._steps + 1

    @property
    def state(self) -> TensorDictBase:
        """What is known: a copy of the core entries of the feature state, of batch ``()``."""
        if self._state is None:
            raise ValueError("state is not known yet: call reset(prior) first")
        return self._state.clone()

    @property
    def steps(self) -> int:
        """Number of controls since the start."""
        return self._steps

    @property
    def finished(self) -> bool:
        """Whether the state is terminal: no cost follows."""
        return bool(self.model.is_terminal(self.state))

    # ---- to a file and back --------------------------------------------------------------------------------------------

    def to_json(self) -> str:
        """The present state as a JSON text, to the last bit; the policy is not in it.

        Raises:
            TypeError: if the model holds what a text cannot tell, such as a lock or an open file.

        Examples:
            >>> from torchrl_pomdp.modules import Myopic
            >>> from torchrl_pomdp.problems import tiger
            >>> problem = tiger()
            >>> first, second = (Controller(problem.model, Myopic(problem.model)) for _ in range(2))
            >>> first.reset(problem.start(torch.tensor(0)))
            >>> first.update(0, 1)
            >>> second.load_json(first.to_json())
            >>> second.steps, second.act() == first.act()
            (1, True)
        """
        y = self.state
        entries = {str(key): y.get(key).tolist() for key in self.model.state_keys}
        return json.dumps({"format": _FORMAT, **self._of_model, "steps": self._steps, "state": entries})

    def load_json(self, text: str) -> None:
        """Go on from a state that :meth:`to_json` gave.

        Raises:
            TypeError: if it is no text, or the model holds what no text can tell.
            ValueError: if it is no such text, or of another model.
        """
        check_instance("text", text, str)
        own = self._of_model
        try:
            given = check_mapping("text", json.loads(text), object)
            if given["format"] != _FORMAT or any(given[key] != value for key, value in own.items()):
                raise ValueError(f"it is {shown(given['format'])} of {shown(given['model'])}, {shown(given['digest'])}")
            steps = check_integer("steps", given["steps"], 0)
            entries = check_mapping("state", given["state"], (list, int, float))
            spec = self.model.state_spec()
            core = {key: _tensor(key, entries[key], spec[key].dtype) for key in self.model.state_keys}
            state = self._single("state", TensorDict(core, batch_size=()))
        except (TypeError, ValueError, KeyError, RuntimeError, OverflowError) as error:
            described = ", ".join(own.values())
            raise ValueError(f"text must be what to_json gave for the model {described}: {error}") from error
        self._state, self._steps = state, steps

    @cached_property
    def _of_model(self) -> dict[str, str]:
        """Whose state a text is: the model's, however a policy divides it."""
        return {"model": self.model.describe(), "digest": digest(self.model.with_partition(SinglePart()))}

    def _single(self, name: str, y: TensorDictBase) -> TensorDictBase:
        """A copy of the core of a single feature state, checked."""
        check_instance(name, y, TensorDictBase)
        if y.batch_size.numel() != 1 or y.ndim > 1:
            raise ValueError(f"{name} must be a single feature state, of batch (), got batch {tuple(y.batch_size)}")
        return self._core(self.model.drawn(lambda _: y.reshape(()) if y.ndim == 0 else y[0], torch.tensor(0), name))

    def _core(self, y: TensorDictBase) -> TensorDictBase:
        return y.select(*self.model.state_keys).clone()

    def _check_legal(self, y: TensorDictBase, u: Tensor) -> None:
        mask = self.model.action_mask(y)
        if bool(mask.gather(-1, u.unsqueeze(-1)).all()):
            return
        given = ", ".join(self.model.shown_control(u))
        if u.ndim:
            raise ValueError(f"control must be legal for every robot, got {given}; legal are {mask.int().tolist()}")
        names = [", ".join(self.model.shown_control(each)) for each in mask.nonzero().flatten()[:20]]
        raise ValueError(f"control must be legal here, got {given}; legal are {'; '.join(names)}")


def _tensor(name: str, numbers: Any, dtype: torch.dtype) -> Tensor:
    """Numbers of a text as a tensor; what is no number of the type is not made one."""
    found = torch.tensor(numbers)
    if (found.dtype == torch.bool) != (dtype == torch.bool) or (found.is_floating_point() and not dtype.is_floating_point):
        raise ValueError(f"{name} must hold numbers of type {dtype}, got {shown(numbers)}")
    return torch.tensor(numbers, dtype=dtype)
