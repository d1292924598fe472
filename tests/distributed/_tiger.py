"""A small problem of two parts, and its policy iteration."""

from __future__ import annotations

from dataclasses import replace

from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.envs import FunctionPartition
from torchrl_pomdp.modules import Myopic
from torchrl_pomdp.problems import Problem, make_problem
from torchrl_pomdp.trainers import papi_nt

CONFIG = PolicyIterationConfig(
    iterations=1, samples_per_part=300, value_samples=200, validation_states=150, epochs=1, least_steps=100, max_steps=12
)
TWICE = replace(CONFIG, iterations=2)


def tiger():
    """The tiger, with a part for beliefs that are sure; they come first."""
    known = make_problem("tiger")
    sure = FunctionPartition(("unsure", "sure"), lambda y: (y["belief"].amax(-1) > 0.9).long(), stages=((1,), (0,)))
    model = known.model.with_partition(sure)
    return Problem(model, known.start, base_policies={"myopic": Myopic(model)})


def weights(module):
    return [p.tolist() for p in module.parameters()]


def carried_out(workers, recipe=papi_nt, base=None, config=CONFIG, **options):
    problem = tiger()
    return list(recipe(problem, config, base or problem.base_policies["myopic"], workers=workers, **options))


def assert_same(found, expected):
    for one, other in zip(found, expected, strict=True):
        assert weights(one.policy) == weights(other.policy)
        assert weights(one.value) == weights(other.value)
        assert (one.accepted, one.reason, one.comparison) == (other.accepted, other.reason, other.comparison)
        steps = [{name: r.simulated_steps for name, r in each.records.items()} for each in (one, other)]
        assert steps[0] == steps[1]
