from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn

from torchrl_pomdp.modules import FlatEncoder, MultistepLookahead, PolicyNetwork, RolloutPolicy
from torchrl_pomdp.objectives import ClassificationLoss
from torchrl_pomdp.problems import tiger


class Logits(TensorDictModuleBase):
    """Policy whose masked logits are its parameters."""

    in_keys = ["action_mask"]
    out_keys = ["logits", "action"]

    def __init__(self, logits):
        super().__init__()
        self.logits = nn.Parameter(torch.tensor(logits))

    def forward(self, y):
        logits = self.logits.expand(*y.batch_size, -1).masked_fill(~y["action_mask"], -torch.inf)
        return y.update({"logits": logits, "action": logits.argmax(-1)})


def batch():
    """Two states: the first with gaps 0, 4, 16; in the second the last control is illegal, gaps 3, 0."""
    return TensorDict(
        {
            "action_mask": torch.tensor([[True, True, True], [True, True, False]]),
            "action": torch.tensor([0, 1]),
            "q_factors": torch.tensor([[1.0, 5.0, 17.0], [8.0, 5.0, math.inf]]),
        },
        [2],
    )


P1 = [1 / 7, 2 / 7, 4 / 7]
P2 = [1 / 3, 2 / 3]


def softened(gaps):
    weights = [math.exp(-gap / (0.1 * sum(gaps))) for gap in gaps]
    return [w / sum(weights) for w in weights]


def advantage():
    """Logits 0, ln 2, ln 4 and 0, ln 2 against the advantages in their unit."""
    logits = [[0.0, math.log(2.0), math.log(4.0)], [0.0, math.log(2.0)]]
    advantages = [[20 / 3, 20 / 3 - 4, 20 / 3 - 16], [-1.5, 1.5]]
    deviations = [math.sqrt(sum(a * a for a in row) / len(row)) for row in advantages]
    units = [math.sqrt(deviation * sum(deviations) / 2) for deviation in deviations]
    rows = zip(logits, advantages, units, strict=True)
    return sum(sum((v - a / unit) ** 2 for v, a in zip(row, each, strict=True)) / len(row) for row, each, unit in rows) / 2


EXPECTED = {
    "advantage": advantage(),
    "l2": ((P1[0] - 1) ** 2 + P1[1] ** 2 + P1[2] ** 2 + P2[0] ** 2 + (P2[1] - 1) ** 2) / 2,
    "cross_entropy": -(math.log(P1[0]) + math.log(P2[1])) / 2,
    "cost_weighted": ((P1[1] * 4 + P1[2] * 16) / 20 + P2[0] * 3 / 3) / 2,
    "soft": -(
        sum(t * math.log(p) for t, p in zip(softened([0, 4, 16]), P1, strict=True))
        + sum(t * math.log(p) for t, p in zip(softened([3, 0]), P2, strict=True))
    )
    / 2,
}


@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_losses_by_hand(name):
    policy = Logits([0.0, math.log(2.0), math.log(4.0)])
    loss = ClassificationLoss(policy, name)
    out = loss(batch())
    assert out["loss_policy"].item() == pytest.approx(EXPECTED[name], rel=1e-5)
    assert out["accuracy"].item() == 0.5
    assert out["regret"].item() == pytest.approx(16 / 2)
    out["loss_policy"].backward()
    gradients = [p.grad for p in loss.parameters()]
    assert all(torch.isfinite(g).all() for g in gradients)
    assert any((g != 0).any() for g in gradients)
    shaped = loss(batch().reshape(2, 1))
    assert shaped["loss_policy"].item() == pytest.approx(EXPECTED[name], rel=1e-5)


def test_training_the_loss_trains_the_policy():
    policy = Logits([0.0, 0.0, 0.0])
    loss = ClassificationLoss(policy, "cross_entropy")
    optimizer = torch.optim.SGD(loss.parameters(), 0.5)
    for _ in range(20):
        optimizer.zero_grad()
        loss(batch()[:1])["loss_policy"].backward()
        optimizer.step()
    assert policy(batch()[:1])["action"].item() == 0


def test_one_legal_control_or_equal_costs_give_finite_losses():
    data = batch()
    data["action_mask"][0] = torch.tensor([False, False, True])
    data["q_factors"][0] = torch.tensor([math.inf, math.inf, 3.0])
    data["action"][0] = 2
    data["q_factors"][1, :2] = 4.0
    for name in EXPECTED:
        loss = ClassificationLoss(Logits([0.0, 1.0, 2.0]), name)
        value = loss(data)["loss_policy"]
        value.backward()
        assert torch.isfinite(value), name
        assert all(torch.isfinite(p.grad).all() for p in loss.parameters()), name


def test_unknown_losses_are_refused():
    with pytest.raises(ValueError, match="loss must be one of"):
        ClassificationLoss(Logits([0.0]), "hinge")


@pytest.mark.parametrize("loss", ["soft", "cost_weighted", "advantage", "l2", "cross_entropy"])
def test_dominated_controls_are_not_learnt_as_good_ones(loss):
    """Lookahead with a margin gives them no Q-factor though they are legal."""
    problem = tiger()
    labeller = MultistepLookahead(RolloutPolicy(problem.model, problem.base_policies["listen"]), margin=0.0)
    batch = labeller(problem.model.with_features(problem.start(torch.arange(2))))
    assert batch["q_factors"].isinf().sum() == 4
    network = PolicyNetwork(FlatEncoder(problem.model), 3, generator=torch.Generator().manual_seed(0))
    if loss in ("l2", "cross_entropy"):
        found = ClassificationLoss(network, loss)(batch)
        assert found["loss_policy"].isfinite()
        assert found["regret"] == 0
        return
    with pytest.raises(ValueError, match=f"q_factors of legal controls must be finite for loss='{loss}', got \\+inf"):
        ClassificationLoss(network, loss)(batch)


def test_the_regret_of_a_dominated_control_is_at_least_the_largest_known():
    given = batch()
    given["q_factors"][1, 2], given["action_mask"] = math.inf, torch.ones(2, 3, dtype=torch.bool)
    assert ClassificationLoss(Logits([0.0, 0.0, 9.0]), "l2")(given)["regret"] == (16 + 3) / 2


@pytest.mark.parametrize("name", ["soft", "cost_weighted", "advantage"])
def test_no_module_is_taught_illegal_controls(name):
    """A module that does not mask its logits would take an infinite Q-factor for the best."""
    plain = TensorDictModule(nn.LazyLinear(3), ["belief"], ["logits"])
    data = batch().set("belief", torch.rand(2, 4))
    plain(data.select("belief"))
    with pytest.raises(ValueError, match=f"q_factors of legal controls must be finite for loss='{name}'"):
        ClassificationLoss(plain, name)(data)
