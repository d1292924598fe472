from __future__ import annotations

import pytest
import torch
from _oracles import COSTS, Memo, exact_cost, random_states, small_model
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_pomdp.envs import BeliefEnv, FixedBelief
from torchrl_pomdp.envs.repair import RepairModel, UniformStart, damage_chain, line
from torchrl_pomdp.modules import FlatEncoder, PartitionedPolicy, PolicyNetwork, RolloutPolicy, TruncatedRollout
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, RelativeEncoder
from torchrl_pomdp.problems import tiger

# Optimal value of Tiger from the uniform belief at discount 0.95, as a cost.
TIGER_OPTIMUM = -19.371368


class ListenThenOpen:
    """Tiger: listen until one door is likely enough, then open the other."""

    in_keys = ["belief"]

    def __init__(self, threshold):
        self.threshold = threshold

    def __call__(self, y):
        sure, state = y["belief"].max(-1)
        return y.set("action", torch.where(sure > self.threshold, 2 - state, 0))


def networks(model, seed):
    generator = torch.Generator().manual_seed(seed)
    return [PolicyNetwork(e(model), model.num_controls, (8,), generator=generator) for e in (FlatEncoder, RelativeEncoder)]


@given(seed=st.integers(0, 10_000), robots=st.sampled_from([1, 2]))
@settings(max_examples=25, deadline=None)
def test_no_component_ever_chooses_a_masked_control(seed, robots):
    model = small_model(line(3), robots, dtype=torch.float32)
    y = random_states(model, 12, seed)
    # The engine's policies meet states whose robots have observed; others may be given by a caller.
    y = model.with_features(y if seed % 2 else model.observe(y, torch.rand(12, robots)))
    greedy = GreedyRepair(model)
    flat, relative = networks(model, seed)
    components = [
        RolloutPolicy(model, greedy, trajectories=2),
        RolloutPolicy(model, greedy, trajectories=1, leaves="observation"),
        greedy,
        flat,
        relative,
        BeliefEnv(model, UniformStart(model, (0,) * robots), seed=seed).rand_action,
    ]
    for component in components:
        u = component(y.copy())["action"]
        assert y["action_mask"].gather(1, u.unsqueeze(1)).all(), component


def test_q_factors_are_infinite_exactly_where_illegal(linear20):
    y = linear20.model.with_features(linear20.start(torch.arange(50)))
    q = RolloutPolicy(linear20.model, GreedyRepair(linear20.model), trajectories=2).q_factors(y)
    assert torch.equal(torch.isfinite(q), y["action_mask"])


def test_labels_do_not_depend_on_batch_order_or_chunks(linear20):
    model = linear20.model
    y = linear20.start(torch.arange(24))
    order = torch.randperm(24, generator=torch.Generator().manual_seed(0))
    network = PolicyNetwork(RelativeEncoder(model), 3, generator=torch.Generator().manual_seed(0))
    for base in (GreedyRepair(model), network):
        for leaves in ("control", "observation"):

            def q(y, chunk_rows=8192, base=base, leaves=leaves):
                options = {"max_steps": 25, "terminal_cost": NeverRepairCost(model)}
                policy = RolloutPolicy(model, base, trajectories=3, leaves=leaves, chunk_rows=chunk_rows, **options)
                return policy.q_factors(y)

            reference = q(y)
            assert torch.equal(q(y[:1], chunk_rows=1), reference[:1])
            assert torch.equal(q(y, chunk_rows=400), reference)
            assert torch.equal(q(y[order]), reference[order])
            assert torch.equal(q(y[7:8]), reference[7:8])
            assert torch.equal(q(y.reshape(3, 8)), reference.view(3, 8, 3))
            assert q(y[:0]).shape == (0, 3)


def test_labels_of_a_tabular_model_do_not_depend_on_the_batch():
    belief = torch.rand(40, 1, generator=torch.Generator().manual_seed(0))
    y = TensorDict({"belief": torch.cat([belief, 1 - belief], -1)}, [40])
    policy = RolloutPolicy(tiger().model, ListenThenOpen(0.9), trajectories=3, max_steps=80)
    reference = policy.q_factors(y)
    assert torch.equal(torch.cat([policy.q_factors(part) for part in y.split(7)]), reference)


def test_seeds_change_the_noise_and_nothing_else_does(linear20):
    y = linear20.start(torch.arange(20))
    policies = [RolloutPolicy(linear20.model, GreedyRepair(linear20.model), seed=s) for s in (0, 0, 1)]
    q = [policy.q_factors(y) for policy in policies]
    assert torch.equal(q[0], q[1])
    assert not torch.equal(q[0], q[2])


def test_both_kinds_of_leaves_estimate_the_same_q_factors():
    model = small_model(line(3), dtype=torch.float64)
    y = model.observe(random_states(model, 5, 1), torch.full((5, 1), 0.4, dtype=torch.float64))
    greedy = GreedyRepair(model)
    stratified = RolloutPolicy(model, greedy, trajectories=4000).q_factors(y)
    exact = RolloutPolicy(model, greedy, trajectories=2000, leaves="observation").q_factors(y)
    mask = torch.isfinite(exact)
    torch.testing.assert_close(stratified[mask], exact[mask], rtol=0.02, atol=0.02)


def test_q_factors_with_exact_leaves_equal_bellman_by_hand():
    """Opening a door forgets everything, so a base policy that opens one leaves no sampling in equation (1) for m = 1."""
    model = tiger().model
    y = TensorDict({"belief": torch.tensor([[0.5, 0.5], [0.9, 0.1]])}, [2])

    def open_left(y):
        return y.set("action", torch.ones(y.batch_size, dtype=torch.int64))

    policy = RolloutPolicy(
        model, open_left, trajectories=1, leaves="observation", max_steps=1, terminal_cost=lambda y: 8 * y["belief"][..., 0]
    )
    q = policy.q_factors(y)
    for row, tiger_left in enumerate((0.5, 0.9)):
        # Listening keeps the mean belief, opening makes it uniform; then the left door is opened, then 8 * 0.5 is paid.
        for u, stage, after in (
            (0, 1.0, tiger_left),
            (1, 100 * tiger_left - 10 * (1 - tiger_left), 0.5),
            (2, 100 * (1 - tiger_left) - 10 * tiger_left, 0.5),
        ):
            expected = stage + 0.95 * (100 * after - 10 * (1 - after) + 0.95 * 4.0)
            assert q[row, u].item() == pytest.approx(expected, rel=1e-5)


def test_a_rolled_out_first_control_is_really_applied():
    """Two locations, the robot at a mildly damaged one beside total damage: moving there at once is the only sense."""
    model = RepairModel(line(2), damage_chain((0.0, 0.0, 0.03, 0.05)), COSTS, 0.99)
    belief = torch.tensor([[[0, 1.0, 0, 0, 0], [0, 0, 0, 0, 1.0]]])
    y = TensorDict({"belief": belief, "location": torch.zeros(1, 1, dtype=torch.int64)}, [1])
    assert GreedyRepair(model)(y.copy())["action"].item() == 0
    out = RolloutPolicy(model, GreedyRepair(model), trajectories=2)(y.copy())
    assert out["action"].item() == 2
    # Repair, move, repair; or move, repair, move back, repair: level 1 does not degrade here, so nothing is random.
    repair_first = 100.1 + 0.99 * 100 + 0.99**2 * 100
    move_first = 100.1 + 0.99 * 100.1 + 0.99**2 * 0.1 + 0.99**3 * 0.1
    assert out["q_factors"][0, 0].item() == pytest.approx(repair_first, rel=1e-6)
    assert out["q_factors"][0, 2].item() == pytest.approx(move_first, rel=1e-6)


def test_rollout_improves_tiger_and_stays_above_the_optimum():
    model = tiger().model
    y = FixedBelief(torch.tensor([0.5, 0.5]))(torch.arange(1))
    # Listening until 0.98 is one time too often.
    base = ListenThenOpen(0.98)
    rollout = Memo(model, RolloutPolicy(model, base, trajectories=300, max_steps=150))
    before, after = exact_cost(model, base, y, prune=1e-4), exact_cost(model, rollout, y, prune=1e-4)
    assert before > TIGER_OPTIMUM + 1.0
    assert TIGER_OPTIMUM - 0.05 < after < TIGER_OPTIMUM + 0.5


def test_router_with_one_policy_everywhere_changes_nothing(linear20):
    model, greedy = linear20.model, GreedyRepair(linear20.model)
    y = linear20.start(torch.arange(30))
    routed = RolloutPolicy(model, PartitionedPolicy([greedy] * 6), trajectories=3).q_factors(y)
    copies = RolloutPolicy(model, PartitionedPolicy([GreedyRepair(model) for _ in range(6)]), trajectories=3).q_factors(y)
    plain = RolloutPolicy(model, greedy, trajectories=3).q_factors(y)
    assert torch.equal(routed, plain)
    # Of several policies, even equal ones, tensors compute the cost.
    torch.testing.assert_close(copies, plain, rtol=1e-5, atol=0)


def test_plain_callables_are_policies_too(line3):
    def first_legal(y):
        return y.set("action", y["action_mask"].to(torch.int64).argmax(-1))

    y = line3.start(torch.arange(5))
    cost = TruncatedRollout(line3.model, first_legal)(y, torch.arange(5))
    assert (cost > 0).all()
    assert RolloutPolicy(line3.model, first_legal, trajectories=2)(y)["action"].shape == (5,)


def test_bad_arguments_are_refused(line3):
    greedy = GreedyRepair(line3.model)
    for name, value in (("trajectories", 0), ("chunk_rows", 0), ("leaves", "tree"), ("max_steps", 0)):
        with pytest.raises(ValueError, match=name):
            RolloutPolicy(line3.model, greedy, **{name: value})
    with pytest.raises(ValueError, match="'belief' of y has shape"):
        RolloutPolicy(line3.model, greedy)(TensorDict({"belief": torch.ones(2, 3), "location": torch.zeros(2, 1).long()}, [2]))
