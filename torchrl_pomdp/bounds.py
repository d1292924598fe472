r"""Proposition 1 of the paper (Section III) in numbers: both error bounds of truncated rollout beside what they bound.

Lookahead over :math:`\ell` steps, then m steps of rollout with the base policy :math:`\mu`, then the terminal cost
:math:`\hat J` make the policy :math:`\tilde\mu`. With :math:`\tilde J=T_\mu^m\hat J`,

.. math::
    \tilde\mu(y)\in\arg\min_u\Bigl[\hat g(y,u)+\alpha\sum_z\hat p(z\mid b_y,u)\,(T^{\ell-1}\tilde J)\bigl(F(y,u,z)\bigr)\Bigr]

    \text{(a)}\quad\|J_{\tilde\mu}-J^*\|\le\frac{2\alpha^\ell}{1-\alpha}\,\|T_\mu^m\hat J-J^*\|

    \text{(b)}\quad J_{\tilde\mu}(y)\le J_\mu(y)+\frac{2}{1-\alpha}\,\|\hat J-J_\mu\|\quad\text{for all }y

**Which beliefs.** The paper's norm is over all feature states. Every operator at y looks at y and at its successors
F(y, u, z) under legal controls only. On a set of beliefs that is closed under F, functions therefore go to functions, the
contractions stay, and the proposition holds as it stands with the norm over that set. The set taken here is the least closed
one with the start belief: all beliefs that legal controls lead to, see :func:`~torchrl_pomdp.planners.belief_mdp`. Where it is
finite, all sides are exact up to rounding: expectations sum over all observations, and costs of policies solve linear
equations. A norm over more beliefs could only be larger. One over fewer would not do for the right sides:
:math:`J_{\tilde\mu}` at the start depends on decisions at all depths, and each on :math:`\hat J` some :math:`\ell+m` steps on.

**A sharper form of (b).** Rollout contracts, :math:`\|T_\mu^m\hat J-J_\mu\|\le\alpha^m\|\hat J-J_\mu\|`, and so does each step
of lookahead: the right side of (b) may be multiplied by :math:`\alpha^{\ell+m}`. It cannot be improved further, nor can
(a): for all :math:`\ell` and m a chain of :math:`\ell+m+1` states attains both.

``python -m torchrl_pomdp.bounds --models 500`` evaluates all on random problems and says how loose they are.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchrl_pomdp.checks import check_instance, check_integer, check_seed, check_sequence
from torchrl_pomdp.pictures import COLOURS, new_figure
from torchrl_pomdp.planners.belief_mdp import BeliefMDP, belief_mdp
from torchrl_pomdp.problems.random_tabular import random_model
from torchrl_pomdp.report import draw
from torchrl_pomdp.tensor_checks import check_tensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["ErrorBounds", "bounds_figure", "error_bounds", "looseness", "random_bounds"]

# Lookahead and rollout of the random problems.
_DEPTHS, _TRUNCATIONS = (1, 2, 3), (0, 1, 4)
_MOST_STEPS = 1_000
# Seeds of their base policies and errors, apart from those of the problems.
_OWN_STREAM = 0x5A5A5A5A
# A side may pass the other by rounding: this share of the costs.
_ROUNDING = 1e-9


class ErrorBounds(NamedTuple):
    r"""Both sides of both inequalities, norms over all beliefs that can be reached.

    Attributes:
        lookahead: :math:`\ell`.
        truncation: m.
        loss: :math:`\|J_{\tilde\mu}-J^*\|`, left side of (a).
        loss_bound: right side of (a).
        rise: the largest :math:`J_{\tilde\mu}(y)-J_\mu(y)`, left side of (b); negative where the policy improves everywhere.
        rise_bound: :math:`\frac{2}{1-\alpha}\|\hat J-J_\mu\|`, right side of (b).
        sharp_rise_bound: the same times :math:`\alpha^{\ell+m}`.
        rounding: what rounding may do: a billionth of the largest absolute cost among those that were compared, or, with a
            discount very near 1, what it does to the solution of :math:`J=T_\mu J`.
    """

    lookahead: int
    truncation: int
    loss: float
    loss_bound: float
    rise: float
    rise_bound: float
    sharp_rise_bound: float
    rounding: float

    @property
    def hold(self) -> bool:
        """Whether all three inequalities hold, up to rounding."""
        rise_bound = min(self.rise_bound, self.sharp_rise_bound)
        return self.loss <= self.loss_bound + self.rounding and self.rise <= rise_bound + self.rounding


def error_bounds(
    mdp: BeliefMDP, controls: Tensor, terminal_cost: Tensor, *, lookahead: int = 1, truncation: int = 0
) -> ErrorBounds:
    r"""Evaluate Proposition 1 exactly on the beliefs that can be reached.

    Args:
        mdp: the beliefs.
        controls: what the base policy :math:`\mu` does at each of them, int64 ``[M]``.
        terminal_cost: :math:`\hat J` at each of them, ``[M]``.

    Keyword Args:
        lookahead: :math:`\ell`, at least 1.
        truncation: m, at least 0.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if a shape is wrong, a control is illegal, a cost is not finite, or a number is out of range.

    Examples:
        >>> from torchrl_pomdp.problems import tiger
        >>> mdp = belief_mdp(tiger(0.75).model, torch.tensor([0.5, 0.5]))
        >>> listen = torch.zeros(len(mdp), dtype=torch.int64)
        >>> found = error_bounds(mdp, listen, mdp.policy_cost(listen), lookahead=2)
        >>> found.hold, found.rise <= 0.0, found.rise_bound
        (True, True, 0.0)
    """
    check_instance("mdp", mdp, BeliefMDP)
    u = mdp.check_controls("controls", controls)
    terminal = check_tensor("terminal_cost", terminal_cost, (len(mdp),)).double()
    check_integer("lookahead", lookahead, 1, _MOST_STEPS)
    check_integer("truncation", truncation, 0, _MOST_STEPS)
    base, best = mdp.policy_cost(u), mdp.optimal_cost()
    rolled = terminal
    for _ in range(truncation):
        rolled = mdp.q_factors(rolled).gather(1, u.unsqueeze(1)).squeeze(1)
    ahead = rolled
    for _ in range(lookahead - 1):
        ahead = mdp.q_factors(ahead).amin(-1)
    made = mdp.policy_cost(mdp.q_factors(ahead).argmin(-1))
    factor = 2.0 / (1.0 - mdp.discount)
    share = max(_ROUNDING, len(mdp) * torch.finfo(torch.float64).eps * factor)
    rise_bound = factor * _norm(terminal - base)
    return ErrorBounds(
        lookahead,
        truncation,
        loss=_norm(made - best),
        loss_bound=factor * mdp.discount**lookahead * _norm(rolled - best),
        rise=float((made - base).max()),
        rise_bound=rise_bound,
        sharp_rise_bound=rise_bound * mdp.discount ** (lookahead + truncation),
        rounding=share * max(_norm(values) for values in (made, base, best, rolled, terminal)),
    )


def _norm(values: Tensor) -> float:
    return float(values.abs().max())


def random_bounds(models: int, *, seed: int = 0) -> list[ErrorBounds]:
    r"""Proposition 1 on random problems, for :math:`\ell` = 1, 2, 3 and m = 0, 1, 4 each.

    The problems are those of :func:`~torchrl_pomdp.problems.random_tabular.random_model`. The base policy is random. The
    terminal cost is that of the base policy plus an error of known size and random sign; the size is log-uniform from a
    hundredth to ten times the largest cost.

    Args:
        models: how many problems, at most a million.

    Keyword Args:
        seed: seed of the first; the next ones follow.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if a number is out of range.

    Examples:
        >>> all(found.hold for found in random_bounds(2))
        True
    """
    results = []
    for number in range(check_integer("models", models, 1, 1_000_000)):
        model = random_model(check_seed("seed", seed) + number)
        mdp = belief_mdp(model, torch.eye(model.num_states)[0])
        rng = torch.Generator().manual_seed((seed + number) ^ _OWN_STREAM)
        draw = torch.rand(mdp.cost.shape, generator=rng)
        base = draw.masked_fill(mdp.cost.isinf(), torch.inf).argmin(-1)
        cost = mdp.policy_cost(base)
        error = _norm(cost) * 10.0 ** (1.0 - 3.0 * float(torch.rand((), generator=rng)))
        sign = torch.where(torch.rand(len(mdp), generator=rng) < 0.5, -1.0, 1.0)
        for lookahead in _DEPTHS:
            for truncation in _TRUNCATIONS:
                results.append(error_bounds(mdp, base, cost + error * sign, lookahead=lookahead, truncation=truncation))
    return results


def bounds_figure(results: Sequence[ErrorBounds]) -> Figure:
    """Bound against what it bounds, a dot for each result, for (a), (b) and the sharper (b); on the line a bound is attained.

    Results whose left side is not positive are left out.

    Args:
        results: the results.

    Raises:
        TypeError: if they are of the wrong kind.
        ValueError: if there are none.
        ImportError: if matplotlib, the extra ``plot``, is not installed.
    """
    sides = _sides(check_sequence("results", results, ErrorBounds, least=1))
    figure = new_figure(4.0 * len(sides), 3.8)
    for number, (title, by_lookahead) in enumerate(sides.items(), 1):
        axes = figure.add_subplot(1, len(sides), number)
        axes.set_prop_cycle(color=COLOURS)
        for lookahead, pairs in sorted(by_lookahead.items()):
            axes.loglog(*zip(*pairs, strict=True), ".", ms=4, alpha=0.6, label=rf"$\ell={lookahead}$")
        every = [value for pairs in by_lookahead.values() for pair in pairs for value in pair] or [1.0]
        axes.loglog([min(every), max(every)], [min(every), max(every)], color="black", linewidth=0.8, label="attained")
        axes.set(title=title, xlabel="actual", ylabel="bound")
        axes.legend(fontsize="small")
    return figure


def looseness(results: Sequence[ErrorBounds]) -> str:
    """A table of how many times larger than what they bound the bounds are: smallest and median ratio by lookahead.

    Results whose left side is not positive have no ratio; they are counted apart.

    Args:
        results: the results.

    Raises:
        TypeError: if they are of the wrong kind.
        ValueError: if there are none.

    Examples:
        >>> print(looseness(random_bounds(2)).splitlines()[0])
        | inequality | lookahead | positive | of | smallest ratio | median ratio |
    """
    sides = _sides(check_sequence("results", results, ErrorBounds, least=1))
    lines = ["| inequality | lookahead | positive | of | smallest ratio | median ratio |", "|---|---|---|---|---|---|"]
    for name, by_lookahead in sides.items():
        for lookahead, pairs in sorted(by_lookahead.items()):
            ratios = [bound / actual for actual, bound in pairs]
            count = sum(found.lookahead == lookahead for found in results)
            numbers = f"{len(ratios)} | {count} | {min(ratios):.3g} | {median(ratios):.3g}"
            lines.append(f"| {name} | {lookahead} | {numbers} |")
    return "\n".join(lines)


def _sides(results: Sequence[ErrorBounds]) -> dict[str, dict[int, list[tuple[float, float]]]]:
    """Left and right sides by inequality and lookahead, where the left one is more than rounding."""
    sides: dict[str, dict[int, list[tuple[float, float]]]] = {"(a)": {}, "(b)": {}, "(b), sharper": {}}
    for found in results:
        pairs = ((found.loss, found.loss_bound), (found.rise, found.rise_bound), (found.rise, found.sharp_rise_bound))
        for name, pair in zip(sides, pairs, strict=True):
            if pair[0] > found.rounding:
                sides[name].setdefault(found.lookahead, []).append(pair)
    return sides


def main(arguments: Sequence[str] | None = None) -> int:
    """The command: evaluate random problems, write how loose the bounds are, and draw them if a file is named.

    Args:
        arguments: those of the command; None: of the process.

    Returns:
        0 if both inequalities held everywhere, 1 if not, 2 for input that was refused.
    """
    parser = argparse.ArgumentParser(prog="python -m torchrl_pomdp.bounds", description="Proposition 1 on random problems")
    parser.add_argument("--models", type=int, default=500, help="how many problems")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first one")
    parser.add_argument("--figure", type=Path, help="file .png of a picture")
    given = parser.parse_args(arguments)
    try:
        results = random_bounds(given.models, seed=given.seed)
        broken = [found for found in results if not found.hold]
        sys.stdout.write(f"{looseness(results)}\n{len(results)} evaluations, {len(broken)} violations\n")
        if given.figure is not None:
            sys.stdout.write(draw({given.figure: lambda: bounds_figure(results)}) + "\n")
    except (ValueError, OSError) as error:
        sys.stderr.write(f"{parser.prog}: {' '.join(str(error).split())}\n")
        return 2
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
