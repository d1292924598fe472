r"""Proximal policy optimisation with masked controls: a peer that policy iteration is compared with (paper, Section VI-D).

It sees what policy iteration sees, the feature state with its legal controls, in networks of the same sizes, but looks ahead
nowhere: it learns from trajectories of its own policy alone. Environment, distribution, advantages and loss are TorchRL's.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_pomdp import __version__
from torchrl_pomdp.checks import check_flag, check_instance, check_integer, check_path, check_seed
from torchrl_pomdp.config import PolicyIterationConfig
from torchrl_pomdp.envs.belief_env import BeliefEnv
from torchrl_pomdp.files import DamagedFileError, check_folder
from torchrl_pomdp.identity import digest
from torchrl_pomdp.kept import keep, own_result
from torchrl_pomdp.modules import PolicyNetwork, ValueNetwork
from torchrl_pomdp.modules.networks import LocalNetwork
from torchrl_pomdp.modules.threads import kept_threads
from torchrl_pomdp.noise import fold, seed_keys
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.progress import progress_bar
from torchrl_pomdp.tensor_checks import device_of
from torchrl_pomdp.trainers.architecture import make_networks, make_values
from torchrl_pomdp.trainers.checkpoint import problem_digest

__all__ = ["ppo"]

# Episodes side by side, and stages of each between two updates.
_EPISODES, _STAGES = 256, 16
BATCH = _EPISODES * _STAGES
_MOST, _MOST_EPISODES = 10**12, 1 << 20
# Updates between two beginnings of new episodes, where a training can go on after an interruption.
SEGMENT = 64

_EPOCHS, _MINIBATCHES = 4, 8
_LEARNING_RATE, _LARGEST_GRADIENT = 5e-4, 0.5
_CLIP, _LAMBDA, _ENTROPY = 0.2, 0.95, 0.02
# The last layers begin that much smaller: a nearly uniform policy, and values near zero, whose noise would drown stage costs.
_SHRINK = 0.01


def ppo(
    problem: Problem,
    *,
    steps: int,
    seed: int = 0,
    episodes: int = _EPISODES,
    path: str | PathLike[str] | None = None,
    progress: bool = False,
) -> PolicyNetwork:
    r"""Train a policy by proximal policy optimisation (Schulman et al., 2017) on the belief steps of its own trajectories.

    Rewards are minus expected stage costs; controls are drawn from a softmax over the legal ones. An episode ends in a terminal
    state, or is cut after ``model.horizon`` stages, and then the value of the state where it is cut stands for what follows.
    After every 64 updates all episodes begin anew, as if they had run for different times already; otherwise all would be in
    the same stage at the same time, and each update would forget the others. Costs span many orders of magnitude, so rewards
    are not scaled by one number: advantages and the targets of values are taken in multiples of their state's pessimistic cost,
    as by :class:`~torchrl_pomdp.objectives.ValueLoss`.

    After every 16 stages of all episodes an update makes 4 passes over their steps in 8 minibatches, by Adam with a step size
    that falls from 0.0005 to 0, gradients of norm 0.5 at most, ratios clipped at 0.2, advantages with :math:`\lambda=0.95`, and
    an entropy bonus that falls from 0.02 to 0. The networks are those of the default
    :class:`~torchrl_pomdp.trainers.PolicyIterationConfig` with the problem's encoder, one of each for all parts. The arguments
    decide the result, however often the training was interrupted; PyTorch's global generators are left as they were.

    With seed 0, 65 536 steps come within 0.2 % of the optimum on ``line3``. On ``linear20`` six million steps cost 0.902 of
    what the greedy policy costs, from 1000 start states, with a standard error of 0.003; with episodes that never began anew a
    million cost 0.946 and two million 0.899, from 500. On ``tiger`` 100 000 steps only learn to listen.

    Args:
        problem: the problem; its partition is not used.

    Keyword Args:
        steps: belief steps of all episodes together; a last batch that is not full is left out.
        seed: seed of weights, start states, observations, controls and minibatches.
        episodes: episodes side by side. More make larger updates and fewer of them, which an accelerator wants.
        path: file where the training is kept after every 64 updates and at its end, and from which it goes on; other arguments,
            and more steps too, make another training, which wants another file. None: it is not kept.
        progress: whether to show a progress bar with the rate.

    Returns:
        the policy that takes the most probable legal control. At feature states ``[*B]`` it writes ``"logits"`` ``[*B, U]`` and
        ``"action"``, int64 ``[*B]``.

    Raises:
        TypeError: if an argument is of the wrong kind, or a training is to be kept of a problem that has no digest.
        ValueError: if there are fewer than 16 steps of each episode, a number is out of range, or ``path`` cannot be written or
            holds something else; before anything is computed.

    Examples:
        >>> from torchrl_pomdp.evaluation import discounted_costs
        >>> from torchrl_pomdp.problems import make_problem
        >>> problem = make_problem("tiger")
        >>> policy = ppo(problem, steps=8192)
        >>> discounted_costs(problem.model, policy, problem.start, num_states=100).shape
        torch.Size([100])
    """
    problem = check_instance("problem", problem, Problem).unpartitioned()
    problem.model.check_enumerable("ppo", "trainers.api, whose network agents share")
    episodes = check_integer("episodes", episodes, 1, _MOST_EPISODES)
    size = episodes * _STAGES
    steps, seed = check_integer("steps", steps, size, _MOST), check_seed("seed", seed)
    check_flag("progress", progress)
    batches = steps // size
    file = None if path is None else _File(path, training_owner(problem, batches, seed, episodes))
    training = Training(problem, batches, seed, episodes)
    if file is not None and file.content is not None:
        training.load_state_dict(file.content)
    bar = progress_bar(batches * size, "step", "PPO", progress, initial=training.done * size)
    # Sums of gradients would depend on the number of threads.
    with bar, kept_threads(1), torch.enable_grad():
        while training.done < batches:
            for batch in training.segment():
                training.update(batch)
                bar.update(size)
            if file is not None:
                keep(file.path, file.owner, training.state_dict())
    return training.policy.eval()


def training_owner(problem: Problem, batches: int, seed: int, episodes: int = _EPISODES) -> str:
    """Digest of all that decides a training of so many updates, see :func:`ppo`: its file belongs to it alone."""
    return digest([__version__, problem_digest(problem.unpartitioned()), batches, seed, episodes])


class _File:
    """The file of a training, which can be written and holds nothing else, and what is in it."""

    def __init__(self, path: str | PathLike[str], owner: str) -> None:
        self.path, self.owner = check_path("path", path), owner
        check_folder("path", self.path.parent)
        if self.path.exists() and not self.path.is_file():
            raise ValueError(f"path must be a file, got {self.path}, which is none")
        try:
            self.content = own_result(self.path, owner)
        except DamagedFileError as error:
            raise ValueError(f"path must be a new file or that of this training: {error}") from error


@contextmanager
def seeded(device: torch.device, seed: int) -> Iterator[None]:
    """Seed the global generators, from which TorchRL draws controls, and restore them afterwards."""
    accelerated = device.type == "cuda"
    with torch.random.fork_rng([device] if accelerated else []):
        torch.default_generator.manual_seed(seed)
        if accelerated:
            with torch.cuda.device(device):
                torch.cuda.manual_seed(seed)
        yield


def _apart(seed: int) -> int:
    """A seed whose stream is another one."""
    return int(seed_keys(seed, torch.tensor(0))) & (2**63 - 1)


class Training:
    """Networks, environment and loss of a training.

    Args:
        problem: a problem of a single part.
        count: number of batches.
        seed: seed of weights and environment.
        episodes: episodes side by side.
    """

    def __init__(self, problem: Problem, count: int, seed: int, episodes: int = _EPISODES) -> None:
        model, config = problem.model, PolicyIterationConfig()
        self.problem, self.count, self.seed, self.episodes = problem, count, seed, episodes
        self.done = 0
        self.policy = cast(PolicyNetwork, make_networks(problem, config, seed).policies[0])
        # Not the weights of the policy network.
        self.value = cast(ValueNetwork, make_values(problem, config, _apart(seed), self.policy.encoder).values[0])
        for network in (self.policy, self.value):
            _shrink(network)
        self.actor = self.policy.actor()
        self.advantage = GAE(
            gamma=model.discount, lmbda=_LAMBDA, value_network=_Critic(self.value), deactivate_vmap=True, device=model.device
        )
        self.loss = ClipPPOLoss(
            self.actor,
            _Critic(self.value, relative=True),
            clip_epsilon=_CLIP,
            entropy_coeff=_ENTROPY,
            critic_coeff=1.0,
            loss_critic_type="l2",
            normalize_advantage=True,
        )
        self.parameters = list(self.loss.parameters())
        self.optimizer = torch.optim.Adam(self.parameters, _LEARNING_RATE)

    def state_dict(self) -> dict[str, Any]:
        """What a training that goes on needs, between two segments."""
        moments = {str(number): each for number, each in self.optimizer.state_dict()["state"].items()}
        return {"policy": self.policy.state_dict(), "value": self.value.state_dict(), "moments": moments, "done": self.done}

    def load_state_dict(self, content: dict[str, Any]) -> None:
        """Go on with a training that was kept."""
        self.policy.load_state_dict(content["policy"])
        self.value.load_state_dict(content["value"])
        moments = {int(number): each for number, each in content["moments"].items()}
        self.optimizer.load_state_dict(self.optimizer.state_dict() | {"state": moments})
        self.done = content["done"]

    def segment(self) -> Iterator[TensorDictBase]:
        """Steps of the policy as it is, ``[episodes, stages]``, of new episodes, until these end or all batches are made."""
        model, left, number = self.problem.model, min(SEGMENT, self.count - self.done), self.done // SEGMENT
        seed = int(fold(torch.tensor(self.seed), number)) & (2**63 - 1) if number else self.seed
        # What is observed does not follow from the random numbers that controls are drawn with.
        env = BeliefEnv(model, self.problem.start, batch_size=(self.episodes,), seed=_apart(seed))
        with seeded(model.device, seed):
            collector = Collector(
                TransformedEnv(env, _SpreadCounter(max_steps=model.horizon)),
                self.actor,
                frames_per_batch=self.episodes * _STAGES,
                total_frames=left * self.episodes * _STAGES,
                auto_register_policy_transforms=False,
            )
            try:
                yield from collector
            finally:
                collector.shutdown()

    def update(self, batch: TensorDictBase) -> None:
        """Improve both networks on a batch."""
        remaining = 1.0 - self.done / self.count
        self.optimizer.param_groups[0]["lr"] = remaining * _LEARNING_RATE
        self.loss.entropy_coeff.fill_(remaining * _ENTROPY)
        rows = self.labelled(batch)
        for _ in range(_EPOCHS):
            for chosen in torch.randperm(len(rows), device=device_of(rows)).chunk(_MINIBATCHES):
                losses = self.loss(rows[chosen])
                self.optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
                nn.utils.clip_grad_norm_(self.parameters, _LARGEST_GRADIENT)
                self.optimizer.step()
        self.done += 1

    def labelled(self, batch: TensorDictBase) -> TensorDictBase:
        """The steps ``[N]`` with advantages and targets of values, in multiples of the states' pessimistic costs."""
        with torch.no_grad():
            self.advantage(batch)
            unit = _unit(self.value, batch).unsqueeze(-1)
        for key in ("advantage", "value_target"):
            batch.set(key, batch.get(key) / unit)
        read = [*self.policy.in_keys, *self.value.in_keys, "action", "action_log_prob", "advantage", "value_target"]
        return batch.select(*read).reshape(-1)


def _shrink(network: LocalNetwork) -> None:
    """Make the weights of the last layer smaller."""
    with torch.no_grad():
        for parameter in network.network[-1].parameters():
            parameter.mul_(_SHRINK)


def _unit(network: ValueNetwork, y: TensorDictBase) -> Tensor:
    """Pessimistic costs ``[*B]``; 1 where nothing can be multiples of them, in terminal start states."""
    costs = network.scale.costs(y)
    return costs.masked_fill(costs == 0, 1.0)


class _SpreadCounter(StepCounter):
    """Cuts episodes; the first ones begin as if they had run for different times already, evenly spread."""

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        first = tensordict.get("_reset", None) is None
        result = super()._reset(tensordict, tensordict_reset)
        if first:
            count = result.get("step_count")
            spread = torch.arange(len(count), device=count.device) * self.max_steps // len(count)
            result.set("step_count", spread.view_as(count))
        return result


class _Critic(TensorDictModuleBase):
    """A value network as TorchRL reads it: ``"state_value"`` ``[*B, 1]`` is minus a cost.

    Args:
        network: the value network.
        relative: whether the value is in multiples of the state's pessimistic cost.
    """

    out_keys = ["state_value"]

    def __init__(self, network: ValueNetwork, *, relative: bool = False) -> None:
        super().__init__()
        self.network, self.relative, self.in_keys = network, relative, network.in_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"state_value"``."""
        cost = self.network(tensordict.select(*self.in_keys)).get("state_value")
        if self.relative:
            cost = cost / _unit(self.network, tensordict)
        return tensordict.set("state_value", -cost.unsqueeze(-1))
