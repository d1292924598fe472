"""The same answers on an accelerator."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_pomdp.collectors import PartSampler, RolloutImprovement
from torchrl_pomdp.envs import BeliefEnv, FixedBelief, TabularModel
from torchrl_pomdp.evaluation import discounted_costs
from torchrl_pomdp.modules import PartitionedPolicy, PolicyNetwork, RolloutPolicy
from torchrl_pomdp.modules.repair import GreedyRepair, RelativeEncoder
from torchrl_pomdp.objectives import ClassificationLoss
from torchrl_pomdp.problems import make_problem
from torchrl_pomdp.trainers import PolicyIterationConfig, papi_nt, papi_t, ppo
from torchrl_pomdp.trainers.checkpoint import problem_digest

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def test_start_states_and_costs_agree_with_the_cpu(linear20):
    there = make_problem("linear20", device="cuda")
    costs = [discounted_costs(p.model, GreedyRepair(p.model), p.start, num_states=200) for p in (linear20, there)]
    assert costs[1].is_cuda
    torch.testing.assert_close(costs[1].cpu(), costs[0], rtol=1e-3, atol=1e-2)


def test_collecting_and_training_stay_on_the_device():
    problem = make_problem("linear20", device="cuda")
    generator = torch.Generator(device="cuda").manual_seed(0)
    encoder = RelativeEncoder(problem.model)
    policy = PartitionedPolicy([PolicyNetwork(encoder, 3, (16,), generator=generator) for _ in range(6)])
    collector = RolloutImprovement(
        BeliefEnv(problem.model, problem.start),
        policy,
        states=PartSampler(dict(enumerate(problem.training)), seed=0),
        frames_per_batch=60,
        total_frames=60,
        label=lambda model, base: RolloutPolicy(model, base, trajectories=2),
    )
    batch = next(iter(collector))
    assert all(leaf.is_cuda for leaf in batch.values(include_nested=True, leaves_only=True))
    loss = ClassificationLoss(policy)(batch)["loss_policy"]
    loss.backward()
    assert torch.isfinite(loss)


def test_environments_draw_legal_controls_there():
    problem = make_problem("linear20", device="cuda")
    for batch in ((), (5,)):
        env = BeliefEnv(problem.model, problem.start, batch_size=batch, seed=0)
        check_env_specs(env)
        data = env.rollout(30, break_when_any_done=False)
        assert data["action"].is_cuda
        assert data["action_mask"].gather(-1, data["action"].unsqueeze(-1)).all()
    assert problem.model.to("cuda") is problem.model
    assert env.to("cuda") is env
    with pytest.raises(ValueError, match="build the model on cpu"):
        problem.model.to("cpu")


def test_generators_may_give_states_of_the_cpu():
    half = torch.full((1, 2, 2), 0.5)
    model = TabularModel(half, half, torch.zeros(1, 2), 0.9, device="cuda")
    assert BeliefEnv(model, FixedBelief(torch.tensor([0.3, 0.7])), batch_size=(2,)).reset()["belief"].is_cuda


def test_tabular_models_agree_with_the_cpu():
    generator = torch.Generator().manual_seed(0)
    transition, observation = torch.rand(4, 33, 33, generator=generator), torch.rand(4, 33, 7, generator=generator)
    tables = transition / transition.sum(-1, keepdim=True), observation / observation.sum(-1, keepdim=True)
    cost = torch.rand(4, 33, generator=generator)
    belief = torch.rand(500, 33, generator=generator)
    u = torch.arange(500) % 4
    probs = []
    for device in ("cpu", "cuda"):
        model = TabularModel(*tables, cost, 0.9, device=device)
        y = model.drawn(
            lambda keys: TensorDict({"belief": belief / belief.sum(-1, keepdim=True)}, keys.shape), torch.arange(500)
        )
        probs.append(model.observation_probs(y, u.to(device)).cpu())
    torch.testing.assert_close(*probs)


def test_policy_iteration_trains_there():
    problem = make_problem("line3", device="cuda")
    config = PolicyIterationConfig(iterations=1, samples_per_part=64, value_samples=64, least_steps=3, validation_states=50)
    for algorithm in (papi_nt, papi_t):
        (iteration,) = algorithm(problem, config, GreedyRepair(problem.model))
        for network in (*iteration.policy.policies, *iteration.value.values):
            assert all(parameter.is_cuda and torch.isfinite(parameter).all() for parameter in network.parameters())


@pytest.mark.parametrize("name", ["linear20", "two_robots20", "rocksample7x8"])
def test_a_problem_is_the_same_there(name):
    assert problem_digest(make_problem(name, device="cuda")) == problem_digest(make_problem(name))


def test_feature_states_need_not_say_where_they_are():
    problem = make_problem("linear20", device="cuda")
    y = problem.start(torch.arange(40, device="cuda"))
    network = PolicyNetwork(RelativeEncoder(problem.model), 3, (16,), generator=torch.Generator(device="cuda").manual_seed(0))
    for policy in (network, PartitionedPolicy([network] * 6), GreedyRepair(problem.model)):
        rollout = RolloutPolicy(problem.model, policy, trajectories=2)
        silent = problem.model.with_features(y).clone().clear_device_()
        assert silent.device is None
        for each in (policy, rollout):
            assert torch.equal(each(silent.clone())["action"], each(problem.model.with_features(y).clone())["action"])


def test_ppo_trains_there():
    policy = ppo(make_problem("linear20", device="cuda"), steps=4096)
    assert all(parameter.is_cuda and torch.isfinite(parameter).all() for parameter in policy.parameters())
