r"""Training a policy network on rollout controls is a classification problem (paper, Section IV)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_pomdp.checks import check_choice, check_instance
from torchrl_pomdp.envs.belief_model import BeliefModel
from torchrl_pomdp.modules.agents import AgentNetwork
from torchrl_pomdp.modules.partitioned import PartitionedPolicy
from torchrl_pomdp.objectives.labels import LabelLoss, check_batch, check_loss, label_of, with_weights, without_modes

__all__ = ["ClassificationLoss"]

LossName = Literal["soft", "cross_entropy", "cost_weighted", "l2", "advantage"]
# Temperature of the soft targets as a fraction of the state's sum of gaps.
_TEMPERATURE = 0.1


@without_modes
class ClassificationLoss(LabelLoss):
    r"""Loss of a masked policy network against labels :math:`(y^s,u^s)` with Q-factors.

    * ``"soft"``: cross-entropy with the targets softmax(-gap/τ), τ a tenth of the state's sum of gaps. Controls that are
      nearly as good share the label, so that the noise of the Q-factors is not learnt.
    * ``"l2"``: squared distance of the softmax from the one-hot rollout control, the paper's.
    * ``"cross_entropy"``: negative log-probability of the rollout control.
    * ``"cost_weighted"``: the expected gap :math:`\sum_u\pi(u)\,(\tilde Q(y,u)-\min\tilde Q)`, divided by the state's sum
      of gaps, so that a wrong control matters as much as it costs and no state outweighs the others.
    * ``"advantage"``: squared distance of the logits from the advantages, mean Q-factor of the state's legal controls minus
      their own. Where there are hundreds of controls and few trajectories the best one of a label is chance; the regression
      learns from all Q-factors and averages their noise over the states. The unit is the geometric mean of two standard
      deviations of the Q-factors, the state's and the mean of the batch's: by the state's alone rare large costs, which
      raise it, would count for too little, by the batch's alone the noisiest states would count for all.

    An :class:`~torchrl_pomdp.modules.AgentNetwork` learns from the labels of
    :class:`~torchrl_pomdp.modules.MultiagentRollout`, Q-factors ``[*B, R, A]``: each agent's decision counts as a state, and
    agents are told the labels of the earlier ones.

    Args:
        policy: policy that writes ``"logits"``; a :class:`~torchrl_pomdp.modules.PolicyNetwork` or a partitioned one.
        loss: one of the names above.

    Returns (by ``forward``):
        TensorDict with scalars ``loss_policy``, ``accuracy`` (share of states whose label is chosen) and ``regret``
        (mean gap of the chosen control, a cost).

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if ``loss`` is unknown; by ``forward``, if a label is missing, illegal or no number, or the loss is not
            finite; if a legal control has the Q-factor ``+inf``, as a dominated one, and the loss is not ``"l2"`` or
            ``"cross_entropy"``.

    Examples:
        >>> import torch
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.modules import FlatEncoder, PolicyNetwork, RolloutPolicy
        >>> from torchrl_pomdp.modules.repair import GreedyRepair
        >>> model = make_problem("linear20").model
        >>> y = make_problem("linear20").start(torch.arange(8))
        >>> batch = RolloutPolicy(model, GreedyRepair(model))(model.with_features(y))
        >>> loss = ClassificationLoss(PolicyNetwork(FlatEncoder(model), 3, generator=torch.Generator().manual_seed(0)))
        >>> bool(loss(batch)["loss_policy"] > 0)
        True
    """

    @dataclass
    class _AcceptedKeys:
        action: NestedKey = "action"
        q_factors: NestedKey = "q_factors"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_policy", "accuracy", "regret"]
    policy: TensorDictModuleBase
    policy_params: TensorDictParams
    target_policy_params: TensorDictParams

    def __init__(self, policy: TensorDictModuleBase, loss: LossName = "soft") -> None:
        super().__init__()
        check_instance("policy", policy, TensorDictModuleBase)
        self.loss = check_choice("loss", loss, _LOSSES)
        self.convert_to_functional(policy, "policy")

    @property
    def network(self) -> TensorDictModuleBase:
        """The module that is trained."""
        return self.policy

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss and metrics of labelled states ``[*B]``; see the class."""
        batch = check_batch(tensordict, self.in_keys)
        y = batch.select(*self.policy.in_keys)
        network = self.policy.policies[0] if isinstance(self.policy, PartitionedPolicy) else self.policy
        if isinstance(network, AgentNetwork):
            label = self._told(batch, network.model)
            y.set("told", label)
        else:
            label = label_of(batch, self.tensor_keys.action, 1, floating=False)
        q_factors = label_of(batch, self.tensor_keys.q_factors, label.ndim + 1, floating=True)
        with with_weights(self.policy, self.policy_params):
            logits = self.policy(y).get("logits")
        if logits.shape != q_factors.shape:
            raise ValueError(f"q_factors must have the logits' shape {tuple(logits.shape)}, got {tuple(q_factors.shape)}")
        # Each agent's decision is a row.
        label, q_factors, logits = label.flatten(), q_factors.flatten(0, -2), logits.flatten(0, -2)
        gaps = _gaps(q_factors, label)
        if self.loss in _BY_COST:
            _check_all_told(q_factors, logits, self.loss)
        chosen = logits.detach().argmax(-1)
        return TensorDict(
            {
                "loss_policy": check_loss("loss_policy", _LOSSES[self.loss](logits, label, gaps).mean()),
                "accuracy": (chosen == label).to(logits.dtype).mean(),
                "regret": _missed(q_factors, gaps).gather(-1, chosen.unsqueeze(-1)).mean(),
            }
        )

    def _told(self, batch: TensorDictBase, model: BeliefModel) -> Tensor:
        """The labels of networks for many agents, their controls ``[N, R]``."""
        label = label_of(batch, self.tensor_keys.action, 1 + len(model.control_shape), floating=False)
        if not bool(((label >= 0) & (label < model.control_range)).all()):
            raise ValueError("action must be a legal control, one with a finite Q-factor, got another")
        return model.split_controls(label)


def _gaps(q_factors: Tensor, label: Tensor) -> Tensor:
    """Q-factors ``[N, U]`` minus their smallest, zero where illegal; the labels ``[N]`` must be legal."""
    illegal = q_factors == torch.inf
    gaps = (q_factors - q_factors.amin(-1, keepdim=True)).masked_fill(illegal, 0.0)
    if not bool(torch.isfinite(gaps.sum(-1)).all()) or bool(illegal.all(-1).any()):
        raise ValueError("q_factors must be finite, or +inf where a control is illegal, and not overflow; got others")
    if not bool(((label >= 0) & (label < q_factors.shape[-1])).all()) or bool(illegal.gather(-1, label.unsqueeze(-1)).any()):
        raise ValueError("action must be a legal control, one with a finite Q-factor, got another")
    return gaps


def _check_all_told(q_factors: Tensor, logits: Tensor, loss: str) -> None:
    """Raise if a legal control, one with a finite logit, has no Q-factor."""
    if bool((torch.isposinf(q_factors) & torch.isfinite(logits)).any()):
        raise ValueError(
            f"q_factors of legal controls must be finite for loss={loss!r}, got +inf: lookahead with a margin leaves out "
            "dominated controls; label with margin=None, or learn the control alone, by 'l2' or 'cross_entropy'"
        )


def _missed(q_factors: Tensor, gaps: Tensor) -> Tensor:
    """Gaps, at least the largest one for dominated controls, whose Q-factors are not known."""
    return torch.where(torch.isposinf(q_factors), gaps.amax(-1, keepdim=True), gaps)


def _l2(logits: Tensor, label: Tensor, gaps: Tensor) -> Tensor:
    target = torch.nn.functional.one_hot(label, logits.shape[-1])
    return (logits.softmax(-1) - target).square().sum(-1)


def _cross_entropy(logits: Tensor, label: Tensor, gaps: Tensor) -> Tensor:
    return torch.nn.functional.cross_entropy(logits, label, reduction="none")


def _cost_weighted(logits: Tensor, label: Tensor, gaps: Tensor) -> Tensor:
    scale = gaps.sum(-1, keepdim=True).clamp_min(torch.finfo(gaps.dtype).tiny)
    return (logits.softmax(-1) * gaps / scale).sum(-1)


def _soft(logits: Tensor, label: Tensor, gaps: Tensor) -> Tensor:
    legal = torch.isfinite(logits)
    temperature = (_TEMPERATURE * gaps.sum(-1, keepdim=True)).clamp_min(torch.finfo(gaps.dtype).tiny)
    target = (-gaps / temperature).masked_fill(~legal, -torch.inf).softmax(-1)
    return -(target * logits.log_softmax(-1).masked_fill(~legal, 0.0)).sum(-1)


def _advantage(logits: Tensor, label: Tensor, gaps: Tensor) -> Tensor:
    legal = torch.isfinite(logits)
    count = legal.sum(-1, keepdim=True)
    advantage = (gaps.sum(-1, keepdim=True) / count - gaps).masked_fill(~legal, 0.0)
    deviation = (advantage.square().sum(-1, keepdim=True) / count).sqrt()
    unit = (deviation * deviation.mean()).sqrt().clamp_min(torch.finfo(gaps.dtype).tiny)
    error = (logits.masked_fill(~legal, 0.0) - advantage / unit).square()
    return (error / count).sum(-1)


# Losses that learn from Q-factors; the others learn the control.
_BY_COST = ("soft", "cost_weighted", "advantage")
_LOSSES = {
    "soft": _soft,
    "l2": _l2,
    "cross_entropy": _cross_entropy,
    "cost_weighted": _cost_weighted,
    "advantage": _advantage,
}
