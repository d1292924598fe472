"""What every public callable refuses: each argument in turn is given every hostile value of its kind.

For every public name a table has a call that works and the kind of each of its arguments. Of nonsense a ``ValueError`` or
``TypeError`` is expected that names the argument, at once.
"""

from __future__ import annotations

import importlib
import inspect
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path

import pytest
import torch
from _hostile import Hostile
from _refusals_exact import EXACT
from _refusals_gym import GYM
from _refusals_peers import PEERS
from _refusals_planning import ENVS, MODULES
from _refusals_problems import PROBLEMS
from _refusals_results import FILES, REPORTS
from _refusals_training import COLLECTORS, TRAINERS
from _refusals_world import WORLDS
from _valid import Case

from torchrl_pomdp.modules import RolloutPolicy
from torchrl_pomdp.modules.repair import GreedyRepair
from torchrl_pomdp.problems import make_problem

CASES: dict[str, Callable[[Path], Case]] = {
    **ENVS,
    **WORLDS,
    **MODULES,
    **PROBLEMS,
    **COLLECTORS,
    **TRAINERS,
    **REPORTS,
    **FILES,
}
CASES |= EXACT | PEERS | GYM

PUBLIC = (
    *("envs", "envs.repair", "modules", "modules.repair", "problems"),
    *("collectors", "objectives", "trainers", "trainers.run"),
    *("controller", "evaluation", "noise", "report", "reproduce", "files", "checks", "tensor_checks", "identity"),
    *("planners", "bounds", "changes", "envs.gym", "problems.gym", "trajectories", "report.page"),
)

# What is not tried, and why.
EXEMPT = {
    "names of types": "*.Policy *.TerminalCost *.StateGenerator *.StateSampler *.OnLabels problems.Symmetry",
    "tables and constants": "*.PRESETS *.REPAIR *.ALGORITHMS *.BASE_POLICIES *.EXPERIMENTS *.OPTIMA *.PUBLISHED *_SEED",
    "abstract, tried by what they are bases of": "envs.Partition modules.Encoder modules.AgentEncoder modules.ClosedFormCost "
    "envs.gym.Simulation modules.Truncation",
    "made by the library, not by its users": "*.Comparison *.Estimate *.Iteration *.PartRecord *.Effort *.DamagedFileError "
    "*.PartitionReport *.Change *.Version *.Decision *.Interval *.Solution *.ErrorBounds",
    "run at every belief step, on what was checked before": "noise.fold noise.uniform noise.fingerprint noise.permuted "
    "tensor_checks.device_of tensor_checks.place",
    "of any object": "identity.*",
    "of no argument": "changes.model_changes",
}

LIMIT_SECONDS = 2.0
LEAST_CALLS = 1500


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """Simulations that are cut are compiled before the time of a refusal counts."""
    model = make_problem("line3").model
    cut = {"trajectories": 1, "max_steps": 3, "terminal_cost": lambda y: torch.zeros(y.batch_size)}
    RolloutPolicy(model, GreedyRepair(model), **cut)(make_problem("line3").start(torch.arange(2)))


@pytest.mark.parametrize("name", CASES)
def test_refuses_nonsense(name, tmp_path, monkeypatch):
    # Whatever is written in spite of a hostile path is written there.
    monkeypatch.chdir(tmp_path)
    case = CASES[name](tmp_path)
    case.use(case.call(**case.given()))
    tried = ((f"{name}({argument}={wrong.label})", fault(case, argument, wrong)) for argument, wrong in case.hostile())
    faults = [f"{call}: {found}" for call, found in tried if found is not None]
    assert not faults, "\n" + "\n".join(faults)


@pytest.mark.parametrize("name", CASES)
def test_tries_every_argument(name, tmp_path):
    case = CASES[name](tmp_path)
    # Ray adds a parameter to the methods of classes that it has run elsewhere.
    parameters = [p for p in inspect.signature(case.call).parameters.values() if p.name != "_ray_trace_ctx"]
    assert {p.name for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)} <= set(case.arguments)
    assert {argument for argument, _ in case.hostile()} == set(case.arguments)


def test_tries_every_public_name():
    public = {f"{module}.{name}" for module in PUBLIC for name in importlib.import_module(f"torchrl_pomdp.{module}").__all__}
    tried = {name for name in public if any(known == name or known.startswith(f"{name}.") for known in CASES)}
    exempt = {name for name in public if any(fnmatch(name, pattern) for pattern in " ".join(EXEMPT.values()).split())}
    assert public - tried - exempt == set(), "neither tried nor exempt"
    assert tried & exempt == set()


def test_tries_enough(tmp_path):
    assert sum(1 for make in CASES.values() for _ in make(tmp_path).hostile()) >= LEAST_CALLS


def fault(case: Case, argument: str, wrong: Hostile) -> str | None:
    """What is wrong with how a hostile value is met; None if it is refused well."""
    try:
        with within_limit():
            made = case.call(**case.given(**{argument: wrong.value}))
            if wrong.refused != "at once":
                case.use(made)
    except (ValueError, TypeError) as error:
        named = any(re.search(rf"\b{re.escape(name)}\b", str(error)) for name in (argument, *wrong.names))
        return None if named else f"{type(error).__name__} that does not name it: {_first_line(error)}"
    except Exception as error:
        return f"{type(error).__name__}: {_first_line(error)}"
    return None if wrong.refused == "or harmless" else "accepted"


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [""])[0][:160]


@contextmanager
def within_limit() -> Iterator[None]:
    """Raise TimeoutError in what takes longer than the limit."""

    def too_long(*_: object) -> None:
        raise TimeoutError(f"took more than {LIMIT_SECONDS:g} s")

    before = signal.signal(signal.SIGALRM, too_long)
    signal.setitimer(signal.ITIMER_REAL, LIMIT_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
