"""Draw the figures of the concept pages from the library itself: ``python docs/figures.py [NAME…]``, some two minutes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from matplotlib.figure import Figure
from tensordict import TensorDictBase

from torchrl_pomdp.envs import BeliefEnv
from torchrl_pomdp.envs.repair import network_figure
from torchrl_pomdp.evaluation import compare, discounted_costs
from torchrl_pomdp.modules import MultiagentRollout, OnEntering, PolicyCost, RolloutPolicy, ZeroCost
from torchrl_pomdp.modules.repair import GreedyRepair, NeverRepairCost, UrgencyRepair
from torchrl_pomdp.pictures import new_figure
from torchrl_pomdp.problems import Problem, make_problem
from torchrl_pomdp.report import draw
from torchrl_pomdp.reproduce import OPTIMA
from torchrl_pomdp.trainers import PolicyIterationConfig, papi_nt

IMAGES = Path(__file__).parent / "images"
# Colours that the colour-blind tell apart (Okabe and Ito), and marks, for those who print in grey.
BLUE, ORANGE, GREEN, RED, PURPLE, SKY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9"
COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY)
MARKS = ("o", "s", "^", "D", "v", "P")
CONTROLS = ("repair", "left", "right")


def _trajectory(name: str, stages: int, seed: int = 3) -> tuple[TensorDictBase, Problem]:
    """Feature states ``[stages]`` that urgency meets, and the problem."""
    problem = make_problem(name)
    env = BeliefEnv(problem.model, problem.start, seed=seed)
    with torch.no_grad():
        return env.rollout(stages, UrgencyRepair(problem.model)), problem


def belief() -> Figure:
    """What the robot knows of a pipeline, at the start and later."""
    trajectory, _ = _trajectory("linear20", 16)
    figure = new_figure(7.2, 2.9)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, stage in zip(panels, (0, 15), strict=True):
        y = trajectory[stage]
        image = axes.imshow(y["belief"].T, aspect="auto", cmap="cividis", vmin=0, vmax=1, origin="lower")
        place = int(y["location"][0])
        axes.plot(place, 4.35, "v", color=RED, ms=9, clip_on=False)
        axes.set(title=f"stage {stage}, robot (▼) at {place}", xlabel="location", xticks=range(0, 20, 5))
    panels[0].set(ylabel="damage level", yticks=range(5))
    figure.colorbar(image, ax=panels, label="probability")
    return figure


def feature_state() -> Figure:
    """Entries of the feature states along a trajectory: what is known, and what follows from it."""
    trajectory, problem = _trajectory("linear20", 60)
    model = problem.model
    figure = new_figure(7.2, 4.4)
    damage, place, part = figure.subplots(3, 1, sharex=True, height_ratios=(3, 1.5, 1.8))
    expected = (trajectory["belief"] * torch.arange(5.0)).sum(-1)
    image = damage.imshow(expected.T, aspect="auto", cmap="cividis", origin="lower")
    damage.set(ylabel="location", title='"belief": expected damage level')
    figure.colorbar(image, ax=damage, label="level")
    place.step(range(len(trajectory)), trajectory["location"][:, 0], color=BLUE, where="mid")
    place.set(ylabel="location", title='"location": where the robot is', ylim=(-1, 20))
    part.step(range(len(trajectory)), trajectory["partition"], color=RED, where="mid")
    part.set(xlabel="stage", title='"partition": the part, a function of the belief', yticks=range(6), ylim=(-0.5, 5.5))
    part.set_yticklabels(model.partition.names, fontsize="x-small")
    return figure


def _stage_costs(problem: Problem, y: TensorDictBase, control: int, stages: int) -> torch.Tensor:
    """Accumulated discounted cost ``[stages, N]`` of a control at ``y`` ``[N]`` and greedy ever after."""
    model, base = problem.model, GreedyRepair(problem.model)
    generator = torch.Generator().manual_seed(1)
    u, total, found = torch.full(y.batch_size, control), torch.zeros(y.batch_size), []
    for stage in range(stages):
        noise = torch.rand(*y.batch_size, model.noise_dim, generator=generator)
        cost, y = model.advance(y, u, noise)
        total = total + model.discount**stage * cost
        found.append(total)
        u = base(y)["action"]
    return torch.stack(found)


def rollout() -> Figure:
    """One decision: simulated costs after each control, and their means, the Q-factors."""
    problem = make_problem("linear20")
    y = problem.start(torch.arange(40))[7]
    y = problem.model.with_features(y.expand(40).clone())
    figure = new_figure(7.2, 3.0)
    lines, bars = figure.subplots(1, 2, width_ratios=(2, 1))
    legal = [u for u in range(3) if bool(y["action_mask"][0, u])]
    for u in legal:
        costs = _stage_costs(problem, y.clone(), u, 200)
        lines.plot(costs[:60, :8], color=COLOURS[u], lw=0.8, alpha=0.6)
        lines.plot([], [], color=COLOURS[u], label=f"first {CONTROLS[u]}")
        mean, error = costs[-1].mean(), 1.96 * costs[-1].std() / len(costs[-1]) ** 0.5
        bars.bar(CONTROLS[u], mean, yerr=error, color=COLOURS[u], capsize=4)
    lines.set(
        xlabel="stage of the simulation",
        ylabel="accumulated discounted cost",
        title="8 simulations of greedy for each",
    )
    lines.legend()
    bottom = min(bar.get_height() for bar in bars.patches) * 0.9
    bars.set(title="Q-factors", ylabel="mean cost of 40 simulations", ylim=(bottom, None))
    return figure


def truncation() -> Figure:
    """How many stages a label's simulation takes, to the end and to the endgame."""
    problem = make_problem("linear20")
    y = problem.model.with_features(problem.start(torch.arange(3000)))
    greedy = GreedyRepair(problem.model)
    endgame = OnEntering((3, 4, 5))
    memory, end, cut = endgame.start(y), torch.full((3000,), 400), torch.full((3000,), 400)
    generator = torch.Generator().manual_seed(0)
    for stage in range(400):
        stop = endgame.stop(y, torch.full((3000,), stage), memory)
        cut = torch.where(stop & (cut == 400), stage, cut)
        over = problem.model.is_terminal(y)
        end = torch.where(over & (end == 400), stage, end)
        _, y = problem.model.advance(y, greedy(y)["action"], torch.rand(3000, problem.model.noise_dim, generator=generator))
    figure = new_figure(7.2, 2.8)
    axes = figure.subplots()
    bins = list(range(60))
    axes.hist(end, bins, color=BLUE, alpha=0.8, label=f"to the end: {end.float().mean():.0f} stages on average")
    axes.hist(cut, bins, color=ORANGE, alpha=0.8, hatch="//", label=f"to the endgame: {cut.float().mean():.0f}")
    axes.set(xlabel="stages of a simulation of greedy, from start states of linear20", ylabel="simulations", xlim=(0, 60))
    axes.legend()
    return figure


def terminal_cost() -> Figure:
    """What rollout costs that is cut after m stages, with different costs at the cut."""
    problem = make_problem("linear20")
    model, greedy = problem.model, GreedyRepair(problem.model)
    cuts = (1, 2, 5, 10, 20, 40)
    costs_at_the_cut = {
        "nothing": ZeroCost(),
        "never repairing again": NeverRepairCost(model),
        "greedy, simulated": PolicyCost(model, greedy, trajectories=2).costs,
    }
    figure = new_figure(7.2, 3.2)
    axes = figure.subplots()
    base = discounted_costs(model, greedy, problem.start, num_states=200).mean()
    for number, (name, cost) in enumerate(costs_at_the_cut.items()):
        ratios = []
        for m in cuts:
            policy = RolloutPolicy(model, greedy, trajectories=5, max_steps=m, terminal_cost=cost)
            ratios.append(float(discounted_costs(model, policy, problem.start, num_states=200).mean() / base))
        axes.plot(cuts, ratios, marker=MARKS[number], color=COLOURS[number], label=f"cost at the cut: {name}")
    axes.axhline(1, color="black", ls="--", lw=1, label="greedy itself")
    axes.set(xscale="log", xlabel="stages m until the cut", ylabel="cost, ratio to greedy", yscale="log")
    axes.set_xticks(cuts, labels=map(str, cuts))
    axes.set_yticks([1, 2, 3, 5, 8], labels=["1", "2", "3", "5", "8"])
    axes.minorticks_off()
    axes.legend(fontsize="small")
    return figure


def partition() -> Figure:
    """The six parts of the paper, in the plane of the two features that divide the states."""
    problem = make_problem("linear20")
    model = problem.model
    env = BeliefEnv(model, problem.start, batch_size=(60,), seed=0)
    with torch.no_grad():
        y = env.rollout(80, GreedyRepair(model), break_when_any_done=False).reshape(-1)
    y = y[~model.is_terminal(y)][::3]
    damaged = (y["belief"][..., 0] < 1).float().mean(-1)
    expected = (y["belief"] * model.costs).sum(-1)
    place, columns = y["location"][:, :1], torch.arange(20)
    left = (expected * (columns < place)).sum(-1)
    right = (expected * (columns > place)).sum(-1)
    side = left / (left + right).clamp(min=1e-9)
    figure = new_figure(7.2, 3.4)
    axes = figure.subplots()
    for part, name in enumerate(model.partition.names):
        mine = (y["partition"] == part) & (left + right > 0)
        axes.scatter(side[mine], 100 * damaged[mine], 9, COLOURS[part], marker=MARKS[part], label=name, alpha=0.7, linewidths=0)
    axes.set(xlabel="share of the expected damage cost that is to the robot's left", ylabel="locations that may be damaged, %")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center", markerscale=2, fontsize="small")
    return figure


def policy_iteration() -> Figure:
    """Cost over the optimum, iteration by iteration."""
    problem = make_problem("line3")
    config = PolicyIterationConfig(iterations=3, samples_per_part=2000, least_steps=600, validation_states=2000)
    policies = {"greedy": problem.base_policies["greedy"]}
    for iteration in papi_nt(problem, config, policies["greedy"]):
        policies[f"iteration {iteration.number}"] = iteration.policy
    last = list(policies)[-1]
    policies[f"{last}\n+ rollout"] = RolloutPolicy(problem.model, policies[last], trajectories=10)
    figure = new_figure(7.2, 3.0)
    axes = figure.subplots()
    costs = {name: discounted_costs(problem.model, each, problem.start, num_states=20_000) for name, each in policies.items()}
    for number, (name, cost) in enumerate(costs.items()):
        estimate = compare(cost, costs["greedy"]).cost
        low, high = (100 * (end / OPTIMA["line3"] - 1) for end in estimate.interval)
        axes.errorbar(name, (low + high) / 2, (high - low) / 2, fmt=MARKS[number], color=COLOURS[number], capsize=5, ms=8)
    axes.axhline(0, color="black", lw=1)
    axes.text(0.01, 0.1, "the optimum", transform=axes.get_yaxis_transform(), va="bottom")
    axes.set(ylabel="cost above the optimum, %", ylim=(-0.8, None))
    return figure


def common_random_numbers() -> Figure:
    """The difference of two Q-factors, with the same scenarios for both controls, and with others."""
    problem = make_problem("linear20")
    model = problem.model
    starts = model.with_features(problem.start(torch.arange(40)))
    greedy = GreedyRepair(model)
    with torch.no_grad():
        q = RolloutPolicy(model, greedy, trajectories=100).q_factors(starts)
        # A state in which two controls are close: where they are not, anything will do.
        two = q.topk(2, largest=False)
        number = int((two.values[:, 1] - two.values[:, 0]).argmin())
        first, second = two.indices[number].tolist()
        y, policy = starts[number].expand(1000).clone(), RolloutPolicy(model, greedy, trajectories=10)
        one, other = (policy.q_factors(y, keys=torch.arange(1000) + start) for start in (0, 10_000))
    figure = new_figure(7.2, 2.8)
    axes = figure.subplots()
    pairs = {"other scenarios for each": one[:, first] - other[:, second], "the same scenarios": one[:, first] - one[:, second]}
    every = torch.cat(list(pairs.values()))
    bins = torch.linspace(float(every.min()), float(every.max()), 60).tolist()
    for (name, gap), colour, hatch in zip(pairs.items(), (ORANGE, BLUE), ("//", ""), strict=True):
        axes.hist(
            gap, bins, color=colour, alpha=0.75, hatch=hatch, label=f"{name}: wrong sign in {(gap > 0).float().mean():.0%}"
        )
    axes.axvline(0, color="black", lw=1)
    axes.set(
        xlabel=f"Q-factor of {CONTROLS[first]} minus that of {CONTROLS[second]}, 10 trajectories each (cost)",
        ylabel="of 1000 estimates",
        ylim=(0, 110),
    )
    axes.legend(fontsize="small")
    return figure


def multiagent() -> Figure:
    """Q-factors of a decision by the number of robots."""
    robots = torch.arange(1, 11)
    figure = new_figure(7.2, 2.8)
    axes = figure.subplots()
    axes.semilogy(robots, 5.0**robots, marker="s", color=ORANGE, label="all joint controls, $5^R$")
    axes.semilogy(robots, 5.0 * robots * (robots + 1) / 2, marker="^", color=GREEN, label="the best order, $5R(R+1)/2$")
    axes.semilogy(robots, 5.0 * robots, marker="o", color=BLUE, label="one robot after the other, $5R$")
    axes.set(xlabel="robots R, each with 5 controls", ylabel="Q-factors of a decision", xticks=robots.tolist())
    axes.legend()
    return figure


def robots() -> Figure:
    """Eight robots on the network of 32, with what one-at-a-time rollout makes them do."""
    problem = make_problem("network32x8")
    policy = MultiagentRollout(
        problem.model, GreedyRepair(problem.model), trajectories=5, max_steps=5, terminal_cost=problem.pessimistic_cost
    )
    y = policy(problem.start(torch.arange(1)))[0]
    known = y.select("belief", "location")
    return network_figure(problem.model, known, control=y["action"], title="eight robots and their next moves")


FIGURES: dict[str, Callable[[], Figure]] = {
    function.__name__.replace("_", "-"): function
    for function in (
        belief, feature_state, rollout, truncation, terminal_cost, partition, policy_iteration, common_random_numbers,
        multiagent, robots,
    )
}  # fmt: skip


def main() -> None:
    """Draw the named figures, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"default: all of {', '.join(FIGURES)}")
    names = parser.parse_args().names or list(FIGURES)
    if unknown := [name for name in names if name not in FIGURES]:
        parser.error(f"unknown figure {unknown[0]!r}; known: {', '.join(FIGURES)}")
    sys.stdout.write(draw({IMAGES / f"{name}.png": FIGURES[name] for name in names}) + "\n")


if __name__ == "__main__":
    main()
