"""Tabular models against sums that are written out: beliefs, costs, legal controls, terminal states, sparse tables."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_pomdp.envs import FixedBelief, TabularModel
from torchrl_pomdp.modules import Myopic, TruncatedRollout
from torchrl_pomdp.problems import tiger

NEGATIVE = torch.tensor([[[1.0, 0.0], [2.0, -1.0]]])


def distributions(generator, *shape, share=0.7):
    """Rows with zeros among their numbers."""
    values = torch.rand(shape, generator=generator, dtype=torch.float64)
    values = values * (torch.rand(shape, generator=generator) < share)
    values[..., 0] += 1e-3
    return values / values.sum(-1, keepdim=True)


def arrays(seed, controls=2, states=4, observations=3, share=0.7):
    generator = torch.Generator().manual_seed(seed)
    cost = torch.randn(controls, states, generator=generator, dtype=torch.float64)
    transition = distributions(generator, controls, states, states, share=share)
    return transition, distributions(generator, controls, states, observations, share=share), cost


def make(transition, observation, cost, **change):
    return TabularModel(transition, observation, cost, **{"discount": 0.9, "dtype": torch.float64, **change})


def beliefs(seed, rows, states):
    belief = torch.rand(rows, states, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return TensorDict({"belief": belief / belief.sum(-1, keepdim=True)}, [rows])


FORMS = [
    pytest.param(lambda table: table, lambda table: table, id="dense"),
    pytest.param(torch.Tensor.to_sparse, lambda table: table, id="sparse moves"),
    pytest.param(torch.Tensor.to_sparse, torch.Tensor.to_sparse, id="sparse"),
]


# ---- Bayes' rule -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("moves", "sees"), FORMS)
@given(seed=st.integers(0, 10_000), u=st.integers(0, 1))
@settings(max_examples=20, deadline=None)
def test_equals_bayes_written_out(moves, sees, seed, u):
    transition, observation, cost = arrays(seed)
    model = make(moves(transition), sees(observation), cost)
    y, control = beliefs(seed, 1, 4), torch.tensor([u])
    belief = y["belief"][0]
    expected = sum(float(belief[i] * cost[u, i]) for i in range(4))
    assert model.expected_cost(y, control).item() == pytest.approx(expected)
    for z in range(3):
        joint = [sum(float(belief[i] * transition[u, i, j]) for i in range(4)) * float(observation[u, j, z]) for j in range(4)]
        assert model.observation_probs(y, control)[0, z].item() == pytest.approx(sum(joint))
        if sum(joint) == 0:
            with pytest.raises(ValueError, match=f"observation {z} at batch index \\(0,\\) is impossible"):
                model.estimator(y, control, torch.tensor([z]))
            continue
        posterior = model.estimator(y, control, torch.tensor([z]))["belief"][0]
        torch.testing.assert_close(posterior, torch.tensor(joint, dtype=torch.float64) / sum(joint))


def test_tiger_beliefs_by_hand():
    model = tiger().model
    y = TensorDict({"belief": torch.tensor([[0.5, 0.5]])}, [1])
    listen, hear_left = torch.tensor([0]), torch.tensor([0])
    once = model.estimator(y, listen, hear_left)
    assert once["belief"][0, 0].item() == pytest.approx(0.85)
    twice = model.estimator(once, listen, hear_left)
    assert twice["belief"][0, 0].item() == pytest.approx(0.85**2 / (0.85**2 + 0.15**2))
    opened = model.estimator(twice, torch.tensor([2]), hear_left)
    assert opened["belief"][0].tolist() == [0.5, 0.5]


# Small tables are gathered, larger ones multiplied control by control, sparse ones summed by columns.
@pytest.mark.parametrize(("controls", "states", "share"), [(3, 20, 0.5), (3, 60, 0.5), (2, 150, 0.02), (1, 300, 0.01)])
def test_sparse_and_dense_tables_agree(controls, states, share):
    transition, observation, cost = arrays(states, controls, states, 5, share)
    transition[:, :, 7] += 1.0  # every state leads to one of them
    transition /= transition.sum(-1, keepdim=True)
    dense = make(transition, observation, cost)
    sparse = make(transition.to_sparse(), observation.to_sparse(), cost)
    y, u = beliefs(0, 64, states), torch.arange(64) % controls
    probs = dense.observation_probs(y, u)
    torch.testing.assert_close(sparse.observation_probs(y, u), probs)
    z = probs.argmax(-1)
    torch.testing.assert_close(sparse.estimator(y, u, z)["belief"], dense.estimator(y, u, z)["belief"])
    torch.testing.assert_close(sparse.transition.to_dense(), dense.transition)
    torch.testing.assert_close(sparse.observation.to_dense(), dense.observation)
    assert torch.equal(sparse.cost, dense.cost)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("controls", "states", "share"), [(3, 7, 0.5), (2, 150, 0.05), (1, 300, 0.01)])
def test_sparse_steps_are_functions_of_a_row_to_the_last_bit(controls, states, share, dtype):
    transition, observation, cost = arrays(1, controls, states, 5, share)
    model = make(transition.to_sparse(), observation.to_sparse(), cost, dtype=dtype)
    rows = 71
    y = beliefs(1, rows, states).apply(lambda leaf: leaf.to(dtype))
    u, noise = torch.arange(rows) * 7 % controls, torch.rand(rows, 1, generator=torch.Generator().manual_seed(1))

    def results(y, u, noise):
        cost, following = model.advance(y, u, noise)
        return torch.cat([model.observation_probs(y, u), cost.unsqueeze(1), following["belief"]], 1)

    whole = results(y, u, noise)
    for size in (1, 17):
        parts = [results(*part) for part in zip(y.split(size), u.split(size), noise.split(size), strict=True)]
        assert torch.equal(torch.cat(parts), whole)
    order = torch.randperm(rows, generator=torch.Generator().manual_seed(2))
    assert torch.equal(results(y[order], u[order], noise[order]), whole[order])
    turned = TensorDict({"belief": y["belief"].T.contiguous().T}, [rows])
    assert torch.equal(results(turned, u, noise), whole)


@pytest.mark.parametrize(("moves", "sees"), FORMS)
def test_any_batch_shape(moves, sees):
    transition, observation, cost = arrays(3, 2, 60)
    legal = torch.ones(60, 2, dtype=torch.bool)
    legal[5, 1] = False
    model = make(moves(transition), sees(observation), cost, legal=legal)
    y, u, noise = beliefs(3, 24, 60), torch.zeros(24, dtype=torch.int64), torch.rand(24, 1)
    flat = model.advance(model.with_features(y), u, noise)
    for shape in ((24,), (2, 3, 4), (1, 24)):
        cost, following = model.advance(model.with_features(y.view(shape)), u.view(shape), noise.view(*shape, 1))
        assert torch.equal(cost.view(-1), flat[0])
        assert following["action_mask"].shape == (*shape, 2)
        assert torch.equal(following["belief"].view(24, 60), flat[1]["belief"])
    none = model.advance(model.with_features(y[:0]), u[:0], noise[:0])
    assert none[1]["belief"].shape == (0, 60)
    cost, following = model.advance(model.with_features(y[0]), u[0], noise[0])
    assert torch.equal(cost, flat[0][0])
    assert torch.equal(following["belief"], flat[1]["belief"][0])


def test_tables_stay_what_they_are_when_they_are_given_again():
    for dtype in (torch.float32, torch.float64):
        for moves, sees in ((lambda t: t, lambda t: t), (torch.Tensor.to_sparse, torch.Tensor.to_sparse)):
            transition, observation, cost = arrays(5, 2, 30, 4)
            once = make(moves(transition), sees(observation), cost, dtype=dtype)
            again = make(once.transition, once.observation, once.cost, dtype=dtype)
            assert torch.equal(again.transition.to_dense(), once.transition.to_dense())
            assert torch.equal(again.observation.to_dense(), once.observation.to_dense())
            assert torch.equal(again.cost, once.cost)


def test_rows_that_are_nearly_distributions_are_scaled():
    third = torch.full((1, 3, 3), 0.333333)
    for table in (third, third.to_sparse()):
        model = make(table, torch.ones(1, 3, 1), torch.zeros(1, 3))
        torch.testing.assert_close(model.transition.to_dense(), torch.full((1, 3, 3), 1 / 3, dtype=torch.float64))


# ---- costs -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("moves", "sees"), FORMS)
def test_costs_by_next_state_and_observation_are_expected(moves, sees):
    transition, observation, _ = arrays(9)
    generator = torch.Generator().manual_seed(9)
    by_next = torch.randn(2, 4, 4, generator=generator, dtype=torch.float64)
    by_observation = torch.randn(2, 4, 4, 3, generator=generator, dtype=torch.float64)
    tables = moves(transition), sees(observation)
    three, four = make(*tables, by_next), make(*tables, by_observation)
    for u in range(2):
        for i in range(4):
            next_costs = [float(transition[u, i, j] * by_next[u, i, j]) for j in range(4)]
            costs = [
                float(transition[u, i, j] * observation[u, j, z] * by_observation[u, i, j, z])
                for j in range(4)
                for z in range(3)
            ]
            assert float(three.cost[u, i]) == pytest.approx(sum(next_costs))
            assert float(four.cost[u, i]) == pytest.approx(sum(costs))
    assert three.max_cost == float(three.cost.abs().max())


def test_only_legal_controls_bound_the_cost():
    legal = torch.tensor([[True, False], [True, True]])
    model = make(torch.eye(2).repeat(2, 1, 1), torch.ones(2, 2, 1), torch.tensor([[1.0, -2.0], [50.0, 3.0]]), legal=legal)
    assert model.max_cost == 3.0


# ---- legal controls ----------------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_a_control_is_legal_where_all_of_the_support_allows_it(seed):
    generator = torch.Generator().manual_seed(seed)
    legal = torch.rand(4, 3, generator=generator) < 0.7
    legal[:, 1] = True
    model = make(*arrays(seed, 3), legal=legal)
    y = beliefs(seed, 20, 4)
    y["belief"] *= torch.rand(20, 4, generator=generator) < 0.5
    y["belief"][:, 0] += 1e-12
    y["belief"] /= y["belief"].sum(-1, keepdim=True)
    mask = model.with_features(y)["action_mask"]
    for row in range(20):
        support = [i for i in range(4) if y["belief"][row, i] > 0]
        assert mask[row].tolist() == [all(bool(legal[i, u]) for i in support) for u in range(3)]
    assert torch.equal(model.legal, legal)


def test_a_belief_without_a_legal_control_is_refused():
    legal = torch.tensor([[True, False], [False, True]])
    model = make(torch.eye(2).repeat(2, 1, 1), torch.eye(2).repeat(2, 1, 1), torch.zeros(2, 2), legal=legal)
    assert model.with_features(TensorDict({"belief": torch.eye(2).double()}, [2]))["action_mask"].tolist() == legal.tolist()
    half = TensorDict({"belief": torch.tensor([[1.0, 0.0], [0.5, 0.5]]).double()}, [2])
    with pytest.raises(ValueError, match=r"'belief' of y at batch index \(1,\) has states that share no legal control"):
        model.with_features(half)
    with pytest.raises(ValueError, match=r"action 1 at batch index \(0,\) is illegal; legal there: \[0\]"):
        model.estimator(half[:1], torch.tensor([1]), torch.tensor([0]))


# ---- terminal states ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", [lambda table: table, torch.Tensor.to_sparse])
def test_a_belief_is_terminal_where_all_of_its_support_is(form):
    # A walk to the right end; the two states there are left no more.
    transition = torch.tensor([[[0.5, 0.5, 0, 0], [0, 0, 0.5, 0.5], [0, 0, 1, 0], [0, 0, 0, 1]]])
    terminal = torch.tensor([False, False, True, True])
    cost = torch.tensor([[1.0, 2.0, 0.0, 0.0]])
    model = make(form(transition), torch.ones(1, 4, 1), cost, terminal=terminal)
    belief = torch.tensor([[0, 0, 0.5, 0.5], [0, 1e-9, 0.5, 0.5 - 1e-9], [0, 0, 0, 1], [1, 0, 0, 0]]).double()
    assert model.is_terminal(TensorDict({"belief": belief}, [4])).tolist() == [True, False, True, False]
    assert torch.equal(model.terminal, terminal)
    # From the second state there is one stage.
    start = model.drawn(FixedBelief(torch.tensor([0.0, 1.0, 0.0, 0.0])), torch.arange(2))
    rollout = TruncatedRollout(model, Myopic(model), max_steps=50)
    assert rollout(start, torch.arange(2)).tolist() == [2.0, 2.0]
    assert rollout.simulated_steps == 2
    assert not make(form(transition), torch.ones(1, 4, 1), cost).is_terminal(TensorDict({"belief": belief}, [4])).any()


def test_terminal_states_that_are_left_or_cost_something_are_refused():
    stay, leave = torch.eye(2), torch.tensor([[1.0, 0.0], [0.5, 0.5]])
    sees, last = torch.ones(2, 2, 1), torch.tensor([False, True])
    with pytest.raises(ValueError, match="terminal states must stay what they are at no cost, got state 1 where control 1"):
        make(torch.stack([stay, leave]), sees, torch.zeros(2, 2), terminal=last)
    with pytest.raises(ValueError, match="got state 1 where control 0 does something"):
        make(torch.stack([stay, stay]), sees, torch.tensor([[0.0, 1.0], [0.0, 0.0]]), terminal=last)
    # What an illegal control would do does not matter.
    legal = torch.tensor([[True, True], [True, False]])
    assert make(torch.stack([stay, leave]), sees, torch.zeros(2, 2), terminal=last, legal=legal).terminal.tolist() == [
        False,
        True,
    ]


@pytest.mark.parametrize("form", [lambda table: table, torch.Tensor.to_sparse])
def test_terminal_states_may_be_left_by_rounding(form):
    # Ten times 0.1 are a bit less than 1; a sum may leave a bit elsewhere.
    tenths = sum([0.1] * 10)
    transition = torch.tensor([[[0.5, 0.5, 0.0], [0.0, tenths, 0.0], [0.0, 1e-12, 1.0 - 1e-12]]], dtype=torch.float64)
    terminal = torch.tensor([False, True, True])
    model = make(form(transition), torch.ones(1, 3, 1), torch.zeros(1, 3), terminal=terminal)
    assert model.terminal.tolist() == [False, True, True]
    assert model.transition.to_dense().tolist() == [[[0.5, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]]
    # Others stay as they are given.
    plain = make(form(transition), torch.ones(1, 3, 1), torch.zeros(1, 3))
    assert torch.equal(plain.transition.to_dense(), transition)


def all_of(model):
    return model.transition, model.observation, model.cost, model.legal, model.terminal


@pytest.mark.parametrize("form", [lambda table: table, torch.Tensor.to_sparse])
def test_what_is_written_into_arguments_later_changes_nothing(form):
    transition, observation, cost = (part.double() for part in arrays(1, 2, 3, 2))
    legal, terminal = torch.ones(3, 2, dtype=torch.bool), torch.zeros(3, dtype=torch.bool)
    legal[0, 0], terminal[2] = False, True
    transition[:, 2], cost[:, 2] = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 0.0
    given = [form(transition), form(observation), cost, legal, terminal]
    model = make(*given[:3], legal=legal, terminal=terminal)
    before = [
        each.to_dense().clone() for each in (model.transition, model.observation, model.cost, model.legal, model.terminal)
    ]
    for each in given:
        (each._values() if each.is_sparse else each).zero_()
    assert all(torch.equal(one, other.to_dense()) for one, other in zip(before, all_of(model), strict=True))
    assert float(before[2].abs().sum()) > 0


@pytest.mark.parametrize("form", [lambda table: table, torch.Tensor.to_sparse])
def test_tables_keep_no_gradients(form):
    given = [form(part).requires_grad_() for part in arrays(1, 2, 3, 2)[:2]]
    model = make(*given, arrays(1, 2, 3, 2)[2].requires_grad_())
    assert not any(each.requires_grad for each in (model.transition, model.observation, model.cost))


# ---- names, refusals ---------------------------------------------------------------------------------------------------


def test_names():
    names = {"state_names": ["left", "right"], "control_names": ("a", "b", "c"), "observation_names": ["x", "y"]}
    known = tiger().model
    model = TabularModel(known.transition, known.observation, known.cost, 0.9, **names)
    assert (model.state_names, model.control_names) == (("left", "right"), ("a", "b", "c"))
    assert TabularModel(known.transition, known.observation, known.cost, 0.9).control_names is None
    for wrong in (["left"], ["left", "left"], ["left", "right", "up"]):
        with pytest.raises(ValueError, match="state_names must hold 2 different names, got"):
            TabularModel(known.transition, known.observation, known.cost, 0.9, state_names=wrong)
    with pytest.raises(TypeError, match="control_names must be a sequence of str"):
        TabularModel(known.transition, known.observation, known.cost, 0.9, control_names="abc")
    with pytest.raises(ValueError, match=r"observation_names\[1\] must be a text of printable characters"):
        TabularModel(known.transition, known.observation, known.cost, 0.9, observation_names=["a", "\n"])


@pytest.mark.filterwarnings("ignore:Sparse CSR")
def test_bad_arrays_are_named():
    eye, half = torch.eye(2).unsqueeze(0), torch.full((1, 2, 2), 0.5)
    cost = torch.zeros(1, 2)
    for rows in (NEGATIVE, NEGATIVE.to_sparse()):
        with pytest.raises(ValueError, match=r"rows of transition must .* row \(0, 1\) has -1"):
            TabularModel(rows, torch.ones(1, 2, 1), torch.zeros(1, 2), 0.9)
    with pytest.raises(ValueError, match=r"rows of transition must .* row \(0, 1\) sums to 2"):
        TabularModel(torch.tensor([[[1.0, 0.0], [1.0, 1.0]]]), half, cost, 0.9)
    with pytest.raises(ValueError, match=r"rows of transition must .* row \(0, 1\) sums to 2"):
        TabularModel(torch.tensor([[[1.0, 0.0], [1.0, 1.0]]]).to_sparse(), half, cost, 0.9)
    with pytest.raises(ValueError, match=r"rows of transition must .* row \(0, 1\) sums to 0"):
        TabularModel(torch.tensor([[[1.0, 0.0], [0.0, 0.0]]]).to_sparse(), half, cost, 0.9)
    with pytest.raises(ValueError, match="rows of observation"):
        TabularModel(eye, -half, cost, 0.9)
    with pytest.raises(ValueError, match="rows of observation"):
        TabularModel(eye, -half.to_sparse(), cost, 0.9)
    with pytest.raises(ValueError, match=r"cost must be finite as .* \[1, 2\], \[1, 2, 2\], \[1, 2, 2, 2\], got \(2, 1\)"):
        TabularModel(eye, half, cost.T, 0.9)
    for number in (torch.nan, 1e39):
        with pytest.raises(ValueError, match=r"cost must be finite as torch\.float32"):
            TabularModel(eye, half, torch.full((1, 2), number, dtype=torch.float64), 0.9)
    with pytest.raises(ValueError, match="transition must have shape"):
        TabularModel(torch.eye(2), half, cost, 0.9)
    with pytest.raises(ValueError, match="observation must have shape"):
        TabularModel(eye, torch.eye(2), cost, 0.9)
    with pytest.raises(TypeError, match="transition must be dense or sparse in COO layout"):
        TabularModel(eye.to_sparse_csr(), half, cost, 0.9)
    with pytest.raises(ValueError, match="transition must be sparse in all dimensions"):
        TabularModel(eye.to_sparse(2), half, cost, 0.9)
    with pytest.raises(ValueError, match="discount"):
        TabularModel(eye, half, cost, 1.5)


@pytest.mark.parametrize("name", ["legal", "terminal"])
def test_bad_sets_of_states_are_named(name):
    eye, one = torch.eye(2).unsqueeze(0), torch.ones(1, 2, 1)
    for wrong in (torch.ones(3, dtype=torch.bool), torch.ones(2, 2, dtype=torch.bool)):
        with pytest.raises(ValueError, match=f"{name} must have shape"):
            TabularModel(eye, one, torch.zeros(1, 2), 0.9, **{name: wrong})
    for wrong in (torch.ones(2), [1, 1], "yes", len):
        with pytest.raises(TypeError, match=f"{name} must be a tensor"):
            TabularModel(eye, one, torch.zeros(1, 2), 0.9, **{name: wrong})
    with pytest.raises(ValueError, match="legal must allow at least one control in every state, got none in state 1"):
        TabularModel(eye, one, torch.zeros(1, 2), 0.9, legal=torch.tensor([[True], [False]]))
