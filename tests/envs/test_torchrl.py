"""TorchRL's own tools draw legal controls, wherever the spec is copied to."""

from __future__ import annotations

import copy
import pickle
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import Categorical, Composite
from torchrl.envs import ActionMask, ObservationNorm, ParallelEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import RandomPolicy

from torchrl_pomdp.envs import BeliefEnv, FixedBelief
from torchrl_pomdp.envs.legal import LegalControls
from torchrl_pomdp.envs.repair import CalibratedStart, RepairModel, damage_chain, line
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.problems import make_problem, tiger


def make(batch=(), seed=None, dtype=torch.float32):
    """Few locations: many controls are illegal, and states end and start anew."""
    model = RepairModel(line(4), damage_chain((0.0, 0.3)), (0.0, 1.0, 5.0), 0.9, dtype=dtype)
    return BeliefEnv(model, CalibratedStart(model), batch_size=batch, seed=seed)


def assert_legal(data):
    assert data["action_mask"].gather(-1, data["action"].unsqueeze(-1)).all()
    assert len(data["action"].unique()) == 3, "all controls are drawn"
    assert not data["action_mask"].all()


ENVS = {
    "itself": lambda batch: make(batch),
    "mask": lambda batch: TransformedEnv(make(batch), ActionMask(mask_key="action_mask")),
    "counter": lambda batch: TransformedEnv(make(batch), StepCounter(4)),
    "serial": lambda batch: SerialEnv(2, partial(make, batch)),
    "mask over serial": lambda batch: TransformedEnv(SerialEnv(2, partial(make, batch)), ActionMask(mask_key="action_mask")),
}


@pytest.mark.parametrize(
    ("name", "batch"),
    [
        *(("itself", batch) for batch in ((), (4,), (2, 3))),
        *(("serial", batch) for batch in ((), (2, 3))),
        ("mask", (4,)),
        ("counter", (2, 3)),
        ("mask over serial", ()),
        ("mask over serial", (2, 3)),
    ],
)
def test_random_controls_are_legal(name, batch):
    env = ENVS[name](batch)
    check_env_specs(env)
    check_env_specs(env, seed=0)
    assert_legal(env.rollout(60, break_when_any_done=False))
    frames = 60 * env.batch_size.numel()
    collector = Collector(env, None, frames_per_batch=frames, total_frames=2 * frames)
    for data in collector:
        assert_legal(data)
    collector.shutdown()


@pytest.mark.parametrize("way", ["partial", "lambda"])
def test_parallel_environments_draw_legal_controls(way):
    """A lambda is sent to another process with the specs of the environment that it makes."""
    env = ParallelEnv(2, partial(make, (3,)) if way == "partial" else lambda: make((3,)))
    try:
        check_env_specs(env)
        assert_legal(env.rollout(60, break_when_any_done=False))
        env.set_seed(3)
        first = env.rollout(6)
        env.set_seed(3)
        assert (env.rollout(6) == first).all()
        assert (first[0] != first[1]).any()
    finally:
        env.close()


def test_free_batches_and_old_states():
    env = make(seed=0)
    start = CalibratedStart(env.model)(torch.arange(50))
    y = env.reset(start, set_state=True)
    for _ in range(5):
        nxt = env.step(env.rand_action(y))["next"]
        assert_legal(env.rand_action(y.clone()))
        y = env.reset(nxt, set_state=True)
    assert env.action_spec.rand((50,)).shape == (50,)
    drawn = torch.stack([env.action_spec.rand((50,)) for _ in range(20)], -1)
    assert y["action_mask"].gather(-1, drawn).all(), "the spec knows the current states"
    assert env.action_spec.rand((3,)).shape == (3,)


def test_partial_resets_keep_the_other_rows_masks():
    env = make((4,), seed=0)
    y = env.rollout(3)[..., -1]["next"].exclude("reward")
    flags = torch.tensor([[False], [True], [False], [False]])
    y = env.reset(y.set("_reset", flags), set_state=False)
    drawn = torch.stack([env.action_spec.rand() for _ in range(40)], -1)
    assert y["action_mask"].gather(-1, drawn).all()


def test_copies_share_the_mask_and_stored_actions_stay_in_the_spec():
    spec = LegalControls(3, (2,))
    spec.update_mask(torch.tensor([[False, True, False], [False, False, True]]))
    copies = [
        spec.clone(),
        Composite(action=spec, shape=(2,)).clone()["action"],
        spec.to("cpu"),
        spec.unsqueeze(0).squeeze(0),
        LegalControls(3).expand(2),
        torch.stack([LegalControls(3), LegalControls(3)]),
    ]
    for other in copies[:4]:
        assert isinstance(other, LegalControls)
        assert other == spec
        assert other.rand().tolist() == [1, 2]
    assert all(isinstance(other, LegalControls) for other in copies)
    assert spec.is_in(torch.tensor([0, 0]))
    assert not spec.is_in(torch.tensor([0, 3]))
    assert spec != Categorical(3, (2,))
    assert spec.expand(5, 2).rand().shape == (5, 2)
    assert [part.shape for part in spec.unbind(0)] == [torch.Size([])] * 2
    assert spec[0].shape == ()


def test_other_environments_draw_as_ever():
    spec = Categorical(5, (3,))
    torch.manual_seed(0)
    expected = spec.rand()
    torch.manual_seed(0)
    y = TensorDict({"action_mask": torch.zeros(3, 5, dtype=torch.bool)}, [3])
    drawn = RandomPolicy(spec)(y)["action"]
    assert torch.equal(drawn, expected)
    assert RandomPolicy(spec)(td=y)["action"].shape == (3,)


def test_copies_of_an_environment_go_on_as_it_does():
    env = make((4,), seed=0)
    env.rollout(3)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected = env.rollout(10, break_when_any_done=False)
    for other in copies:
        assert (other.rollout(10, break_when_any_done=False) == expected).all()


def test_seeds():
    def short():
        # Of equal length, though an episode may end.
        return make((), seed=None).rollout(5, break_when_any_done=False)

    batches = [SerialEnv(2, make).rollout(5), torch.stack([short() for _ in range(2)])]
    for data in batches:
        assert not torch.equal(data["belief"][0], data["belief"][1]), "environments made by the same call differ"
    env = make((4,), seed=1)
    first = env.rollout(5)
    env.set_seed(None)
    assert not torch.equal(env.rollout(5)["belief"], first["belief"])
    env.set_seed(1)
    assert (env.rollout(5) == first).all()
    assert (make((4,), seed=1).rollout(5) == first).all()
    serial = SerialEnv(2, make)
    serial.set_seed(4)
    first = serial.rollout(6)
    serial.set_seed(4)
    assert (serial.rollout(6) == first).all()
    for bad, error in ((-1, ValueError), (2**63, ValueError), (1.5, TypeError), ("1", TypeError), (True, TypeError)):
        with pytest.raises(error, match="seed must be"):
            make(seed=bad)
        with pytest.raises(error, match="seed must be"):
            make().set_seed(bad)


def test_float64_from_end_to_end():
    for dtype, default in ((torch.float64, torch.float32), (torch.float64, torch.float64), (torch.float32, torch.float64)):
        torch.set_default_dtype(default)
        try:
            env = make((3,), dtype=dtype)
            check_env_specs(env)
            assert env.reward_spec.dtype == dtype
            rollout = env.rollout(4)
            assert rollout["next", "reward"].dtype == rollout["belief"].dtype == dtype
            data = next(iter(Collector(env, GreedyRepair(env.model), frames_per_batch=12, total_frames=12)))
            assert data["next", "reward"].dtype == dtype
        finally:
            torch.set_default_dtype(torch.float32)
    model = tiger().model
    double = type(model)(model.transition, model.observation, model.cost, 0.9, dtype=torch.float64)
    env = BeliefEnv(double, FixedBelief(torch.tensor([0.3, 0.7])), batch_size=(2,))
    check_env_specs(env)
    assert env.rollout(3)["belief"].dtype == torch.float64


def test_states_that_a_transform_has_changed_are_refused():
    problem = make_problem("linear20")
    greedy = GreedyRepair(problem.model)
    env = BeliefEnv(problem.model, problem.start, batch_size=(4,))
    norm = ObservationNorm(0.2, 0.4, in_keys=["belief"], standard_normal=True)
    with pytest.raises(ValueError, match="belief"):
        TransformedEnv(env, norm).rollout(5, greedy)
    apart = ObservationNorm(0.2, 0.4, in_keys=["belief"], out_keys=["normed"], standard_normal=True)
    assert TransformedEnv(env, apart).rollout(5, greedy)["next", "normed"].min() < 0


class Wrong:
    """A generator that gives what it is told."""

    def __init__(self, y):
        self.y = y

    def __call__(self, keys):
        return self.y


def states(count, **changes):
    belief = torch.full((count, 4, 3), 1 / 3)
    return TensorDict({"belief": belief, "location": torch.zeros(count, 1, dtype=torch.int64), **changes}, [count])


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        (torch.zeros(2), TypeError, "generator must give a TensorDict"),
        (None, TypeError, "generator must give a TensorDict"),
        (states(3), ValueError, "one state for each key"),
        (states(2, belief=torch.full((2, 4, 3), 0.5)), ValueError, "sum to 1, got a sum of 1.5"),
        (states(2, belief=torch.full((2, 4, 3), torch.nan)), ValueError, "belief"),
        (states(2, belief=torch.full((2, 3, 3), 1 / 3)), ValueError, "shape"),
        (states(2, location=torch.zeros(2, 1)), TypeError, "dtype"),
        (states(2, location=torch.full((2, 1), 4)), ValueError, "bounds"),
        (states(2).exclude("location"), ValueError, "lacks the entry 'location'"),
    ],
)
def test_what_generators_give_is_checked(given, error, message):
    env = make((2,))
    with pytest.raises(error, match=message):
        BeliefEnv(env.model, Wrong(given), batch_size=(2,)).reset()


def test_generators_of_another_type_or_with_more_entries_are_fine():
    env = make((2,))
    y = states(2, note=torch.ones(2), belief=torch.full((2, 4, 3), 1 / 3, dtype=torch.float64))
    assert BeliefEnv(env.model, Wrong(y), batch_size=(2,)).reset()["belief"].dtype == torch.float32
    assert env.model.drawn(Wrong(y), torch.arange(2))["note"].tolist() == [1, 1]
