from __future__ import annotations

import dataclasses

import pytest
import torch
from _oracles import random_states, small_model
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_pomdp.collectors import PartSampler
from torchrl_pomdp.envs import FixedBelief, InPart, Mixture, RandomPlay, SinglePart, TabularModel
from torchrl_pomdp.envs.repair import CalibratedStart, RandomState, RepairPartition, UniformStart, grid, line
from torchrl_pomdp.noise import fold, seed_keys, uniform


def part_by_hand(graph, costs, belief, location):
    """The definition of Section VI-B for one state, in plain Python."""
    expected = [sum(float(p) * float(c) for p, c in zip(row, costs, strict=True)) for row in belief]
    damaged = sum(float(row[0]) < 1 for row in belief)
    centre = sum(float(graph.columns[place]) for place in location) / len(location)
    left = sum(e for e, column in zip(expected, graph.columns.tolist(), strict=True) if column < centre)
    right = sum(e for e, column in zip(expected, graph.columns.tolist(), strict=True) if column > centre)
    share = 0.5 if left + right == 0 else left / (left + right)
    density = 0 if share > 0.7 else 2 if share < 0.3 else 1
    return (3 if 2 * damaged < len(belief) else 0) + density


@given(seed=st.integers(0, 10_000), case=st.sampled_from([(line(5), 1), (grid(3, 2), 1), (line(4), 2)]))
@settings(max_examples=40, deadline=None)
def test_every_state_is_in_the_one_part_that_the_definition_gives(seed, case):
    graph, robots = case
    model = small_model(graph, robots)
    y = random_states(model, 20, seed)
    parts = RepairPartition(graph, model.costs)(y)
    for row in range(20):
        assert parts[row] == part_by_hand(graph, model.costs, y["belief"][row], y["location"][row].tolist())


def test_sides_do_not_depend_on_the_unit_of_the_columns(linear20):
    y = random_states(small_model(line(9), 2), 200, 0)
    costs = torch.tensor([0.0, 1.0, 5.0])
    plain = RepairPartition(line(9), costs)(y)
    for scale, shift in ((0.1, 0.0), (0.37, 5.1), (431.7, -90.3)):
        pipe = dataclasses.replace(line(9), columns=line(9).columns * scale + shift)
        assert torch.equal(RepairPartition(pipe, costs)(y), plain)


def test_no_damage_on_either_side_is_balanced():
    partition = RepairPartition(line(3), torch.tensor([0.0, 1.0]))
    belief = torch.tensor([[[1.0, 0], [0, 1.0], [1.0, 0]]])
    y = TensorDict({"belief": belief, "location": torch.tensor([[1]])}, [1])
    assert partition(y).tolist() == [4]


def test_endgame_leads_to_endgame_alone(linear20):
    model = linear20.model
    y = model.with_features(torch.cat([linear20.training[part](torch.arange(50)) for part in (3, 4, 5)]))
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        u = torch.multinomial(y["action_mask"].float(), 1, generator=generator).squeeze(-1)
        _, y = model.advance(y, u, torch.rand(150, 1, generator=generator))
        assert (y["partition"] >= 3).all()


def test_generators_fill_their_parts_and_are_functions_of_the_key(linear20):
    keys = seed_keys(1, torch.arange(60))
    for part, generator in enumerate(linear20.training):
        y = generator(keys)
        linear20.model.check_state(y)
        assert (linear20.model.partition(y) == part).all()
        assert torch.equal(generator(keys[7:31])["belief"], y["belief"][7:31])


def test_calibrated_start_has_the_distribution_it_says(linear20):
    y = CalibratedStart(linear20.model, observe_start=False)(seed_keys(0, torch.arange(4000)))
    possible = y["belief"][..., 0] < 1
    assert (possible.sum(-1) == 14).all()
    assert (possible.float().mean(0) - 0.7).abs().max() < 0.04
    beliefs = y["belief"][possible]
    # Dirichlet(1, …, 1) over five levels: mean 1/5, variance 4 / 150.
    assert (beliefs.mean(0) - 0.2).abs().max() < 0.005
    assert (beliefs.var(0) - 4 / 150).abs().max() < 0.002
    assert (y["location"][:, 0].bincount(minlength=20) / 4000 - 0.05).abs().max() < 0.02
    observed = linear20.start(seed_keys(0, torch.arange(50)))
    here = observed["belief"][torch.arange(50), observed["location"][:, 0]]
    assert ((here == 0) | (here == 1)).all()


class FixedState:
    """Everything is intact: a state that no other generator draws."""

    def __init__(self, problem):
        self.y = problem.start(torch.zeros(1, dtype=torch.int64))
        self.y["belief"] = torch.eye(5)[0].expand(1, 20, 5).clone()

    def __call__(self, keys):
        return self.y[torch.zeros_like(keys)]


def test_sampler_numbers_states_evenly_over_parts(linear20):
    mixture = Mixture([linear20.training[0], linear20.start], [1.0, 0.0])
    sampler = PartSampler({0: mixture, 5: linear20.training[5]}, seed=4)
    whole = sampler(torch.arange(40))
    assert linear20.model.partition(whole).tolist() == [0, 5] * 20
    assert torch.equal(sampler(torch.arange(13, 29))["belief"], whole["belief"][13:29])


def test_a_mixture_within_a_mixture_keeps_its_shares(linear20):
    """The inner choice must not follow from the outer one."""
    inner = Mixture(linear20.training, [1.0, 1.0, 2.0, 1.0, 1.0, 2.0])
    y = Mixture([inner, FixedState(linear20)], [0.5, 0.5])(torch.arange(8000))
    known = (y["belief"][..., 0] == 1).all(-1)
    assert abs(known.float().mean() - 0.5) < 4 * (0.25 / 8000) ** 0.5
    shares = linear20.model.partition(y[~known]).bincount(minlength=6) / int((~known).sum())
    assert (shares - torch.tensor([1.0, 1.0, 2.0, 1.0, 1.0, 2.0]) / 8).abs().max() < 0.02


def test_what_a_proposal_keeps_is_left_alone(linear20):
    stored = linear20.start(torch.arange(50))
    before = stored.clone()
    proposal = lambda keys: stored if len(keys) == 50 else linear20.training[0](keys)  # noqa: E731
    y = InPart(linear20.model, proposal, 0)(torch.arange(50))
    assert linear20.model.partition(y).tolist() == [0] * 50
    assert (stored == before).all()
    assert (linear20.model.partition(stored) != 0).any()


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("wrap", ["function", "part", "play", "play of play"])
def test_a_choice_does_not_follow_from_that_of_a_mixture_around_it(linear20, share, wrap):
    model = linear20.model
    inner, around = Mixture([UniformStart(model, (3,)), UniformStart(model, (10,))], [0.5, 0.5]), UniformStart(model, (17,))
    single = model.with_partition(SinglePart())
    wrapped = {
        "function": lambda keys: inner(keys),
        "part": InPart(single, inner, 0),
        "play": RandomPlay(model, inner, 0),
        "play of play": RandomPlay(model, RandomPlay(model, inner, 0), 0),
    }[wrap]
    y = Mixture([around, wrapped], [share, 1.0 - share])(torch.arange(8000))
    counts = y["location"].flatten().bincount(minlength=20)
    assert int(counts[[3, 10, 17]].sum()) == 8000
    for place, expected in ((3, 0.5 * (1 - share)), (10, 0.5 * (1 - share)), (17, share)):
        assert abs(counts[place] / 8000 - expected) <= 4 * (expected * (1 - expected) / 8000) ** 0.5


def test_random_play_from_random_play_goes_on_by_itself():
    """A stage or none, and again a stage or none, each as likely as the other."""
    forward = torch.eye(3).roll(1, 1)[None]
    model = TabularModel(forward, torch.eye(3)[None], torch.ones(1, 3), 0.9)
    play = RandomPlay(model, RandomPlay(model, FixedBelief(torch.eye(3)[0]), 1), 1)
    shares = play(torch.arange(8000))["belief"].mean(0)
    assert (shares - torch.tensor([0.25, 0.5, 0.25])).abs().max() < 0.02


def test_bad_arguments_are_refused(linear20):
    model = linear20.model
    with pytest.raises(ValueError, match="damaged_fraction"):
        CalibratedStart(model, 0.0)
    with pytest.raises(ValueError, match="fractions"):
        RandomState(model, (0.7, 0.2))
    with pytest.raises(ValueError, match="max_age"):
        RandomState(model, max_age=-1)
    with pytest.raises(ValueError, match="part must be one of the model's 6 parts"):
        InPart(model, RandomState(model), 6)
    with pytest.raises(ValueError, match="no state of part 5"):
        InPart(model, RandomState(model, (0.9, 1.0)), 5, max_tries=3)(torch.arange(2))
    with pytest.raises(ValueError, match="damage_threshold"):
        RepairPartition(line(3), torch.ones(5), damage_threshold=1.0)
    with pytest.raises(ValueError, match="weights"):
        Mixture([linear20.start], [-1.0])
    with pytest.raises(ValueError, match="generators is empty"):
        PartSampler({}, seed=0)
    assert SinglePart().num_parts == 1


def test_noise_is_uniform_and_independent():
    keys = seed_keys(0, torch.arange(100_000))
    u = torch.stack([uniform(keys, counter) for counter in range(4)] + [uniform(fold(keys, 1), 0)])
    assert (u.mean(1) - 0.5).abs().max() < 4 / (12 * 100_000) ** 0.5
    bins = (u * 64).long()
    expected = 100_000 / 64
    for row in bins:
        chi2 = ((row.bincount(minlength=64) - expected) ** 2 / expected).sum()
        assert chi2 < 63 + 5 * (2 * 63) ** 0.5
    correlation = torch.corrcoef(torch.cat([u, u[:1].roll(1, 1)]).double()) - torch.eye(6)
    assert correlation.abs().max() < 5 / 100_000**0.5
    assert len(keys.unique()) == len(keys)
