"""One page about a training run, which needs nothing but a browser."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from os import PathLike
from pathlib import Path
from string import Template
from typing import Any

from torchrl_pomdp.checks import check_instance, check_path
from torchrl_pomdp.files import write_bytes
from torchrl_pomdp.problems.problem import Problem
from torchrl_pomdp.report.disagreements import Disagreements, disagreements
from torchrl_pomdp.report.iteration_chart import iteration_chart
from torchrl_pomdp.report.names import is_iteration
from torchrl_pomdp.report.player import player_data, side_by_side, starts
from torchrl_pomdp.report.run_folder import RunFolder, read_run_folder
from torchrl_pomdp.report.tables import interval_text, ratio_texts
from torchrl_pomdp.trajectories import has_world

__all__ = ["write_report"]

# Start states of the player and of the disagreements, the first of the evaluations; stages of a trajectory at most.
_PLAYED, _COMPARED, _STAGES = 3, 50, 100
_MOST_PAIRS = 12
# Attributes of cells and rows.
_TEXT, _BEST = ' class="text"', ' class="best"'
_TITLES = ("Cost per iteration", "Policies", "Parts", "Where the policies disagree", "Trajectories")
_WORDS = {
    "R-NT of a policy": "rollout: simulates the policy after each control and takes the one of least cost; nothing is learnt",
    "R-T": "the same, where simulations are cut and a learnt cost is added",
    "API 2": "a network that imitates such rollout, and was improved once more: policy iteration 2",
    "pAPI-NT 2, pAPI-T 2": "the same with a network for each part of the partition; T: simulations are truncated",
    "part": "a region of the feature states, which has networks of its own",
    "Q-factor": "expected discounted cost of a control, with the base policy from there on; the player has estimates",
}
# What is shown of the losses of a part, and in which form.
_LOSSES = {"accuracy": ".1%", "regret": ".4g", "relative_error": ".1%"}


def write_report(folder: str | PathLike[str], *, problem: Problem | None = None) -> Path:
    """Write ``report.html`` into the folder of a training run: what the run has found so far, and a player of trajectories.

    The page has the problem, the cost of each iteration with its 95 % interval, the table of policies, accuracy and regret of
    each part, where the trained policy and its base policy decide differently, and both of them played side by side from the
    same states under the same noise. It holds all it needs, and is below 3 MB.

    Args:
        folder: folder of a run, which may be unfinished: the page then has what is there, and says what is not.

    Keyword Args:
        problem: the problem, for a run on a problem of one's own code; None: as the folder says.

    Returns:
        the path of the page.

    Raises:
        TypeError: if something is of the wrong kind.
        DamagedFileError: a ``ValueError``, if a record of the run is damaged.
        ValueError: if ``folder`` is no folder of a run, or ``problem`` is not the run's.
        OSError: if the page cannot be written; nothing is left behind.

    Examples:
        >>> import tempfile
        >>> from torchrl_pomdp.config import PolicyIterationConfig
        >>> from torchrl_pomdp.problems import make_problem
        >>> from torchrl_pomdp.trainers.run import TrainingRun
        >>> config = PolicyIterationConfig(1, samples_per_part=40, least_steps=1, validation_states=50)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = TrainingRun(make_problem("line3"), config=config, states=20, online_states=0).carry_out(folder)
        ...     write_report(folder).name
        'report.html'
    """
    folder = check_path("folder", folder)
    if problem is not None:
        check_instance("problem", problem, Problem)
    run = read_run_folder(folder, problem)
    reasons, rejected = _reasons(run)
    sections = [_problem(run, rejected), _costs(run, reasons, rejected), _table(run, rejected), _parts(run)]
    data = ""
    if run.policy is None:
        sections += [_section(title, _paragraph(run.missing)) for title in _TITLES[3:]]
    else:
        disagreeing, player, data = _played(run, run.policy.problem)
        sections += [disagreeing, player]
    room = files("torchrl_pomdp.report")
    page = Template(room.joinpath("page.html").read_text("utf-8")).substitute(
        title=escape(f"{run.config['problem']}, {run.config['algorithm']}"),
        style=room.joinpath("page.css").read_text("utf-8"),
        body="\n".join(sections),
        data=data,
    )
    write_bytes(folder / "report.html", page.encode())
    return folder / "report.html"


# ---- what the records say ----------------------------------------------------------------------------------------------


def _problem(run: RunFolder, rejected: Mapping[str, str]) -> str:
    config = run.config
    trained = [result for result in run.results if is_iteration(result.name)]
    finished = f"{len(run.iterations)} of {config['config'].get('iterations', '?')}"
    lines = [f"{config['algorithm']} from the base policy {config['base']}; iterations finished: {finished}."]
    if run.policy is not None:
        lines.insert(0, run.policy.problem.model.describe())
        best = next((result for result in run.results if result.name == run.policy.name), None)
        if best is not None and best in trained:
            ratio, interval = ratio_texts(best.comparison.ratio)
            against = f", {ratio} of {run.results[0].name} ({interval})" if best.comparison.ratio else ""
            lines.append(f"{best.name} costs {interval_text(best.comparison.cost)}{against}.")
        if run.policy.name in rejected:
            last = run.policy.name
            lines.append(f"No iteration was accepted, so the base policy is the best one; what is played below is {last}.")
    numbers = {**config["config"], "states": config.get("states"), "version": config.get("version")}
    rows = [(name, json.dumps(value)) for name, value in numbers.items()]
    details = f"<details><summary>All numbers of the run</summary>{_rows(('number', 'value'), rows, texts=2)}</details>"
    words = f"<details><summary>What the words mean</summary>{_rows(('word', 'meaning'), _WORDS.items(), texts=2)}</details>"
    return f"<h1>{escape(str(config['problem']))}</h1>{''.join(map(_paragraph, lines))}{details}{words}{_contents()}"


def _costs(run: RunFolder, reasons: Mapping[str, str], rejected: Mapping[str, str]) -> str:
    costs = [(r.name, r.comparison.cost) for r in run.results if r.name == run.config["base"] or is_iteration(r.name)]
    if not any(is_iteration(name) for name, _ in costs):
        return _section("Cost per iteration", _paragraph("No iteration is finished yet."))
    text = "Means over the start states of the evaluation, with 95 % intervals. A hollow circle was not accepted."
    told = [f"<li>{escape(name)}: {escape(reason)}</li>" for name, reason in reasons.items()]
    return _section("Cost per iteration", f"{_paragraph(text)}{iteration_chart(costs, rejected)}<ul>{''.join(told)}</ul>")


def _reasons(run: RunFolder) -> tuple[dict[str, str], dict[str, str]]:
    """Why each iteration was accepted or not; and of those that were not."""
    named = {f"{run.config['algorithm']} {iteration['number']}": iteration for iteration in run.iterations}
    reasons = {name: iteration["reason"] for name, iteration in named.items()}
    return reasons, {name: reasons[name] for name, iteration in named.items() if not iteration.get("accepted")}


def _table(run: RunFolder, rejected: Mapping[str, str]) -> str:
    if not run.results:
        return _section("Policies", _paragraph("No policy is evaluated yet."))
    best = None if run.policy is None or run.policy.name in rejected else run.policy.name
    rows = [
        (
            result.name,
            interval_text(result.comparison.cost),
            *ratio_texts(result.comparison.ratio),
            interval_text(result.comparison.difference),
            str(result.comparison.cost.count),
        )
        for result in run.results
    ]
    head = ("policy", "discounted cost", "ratio", "95 % interval of the ratio", "difference", "start states")
    text = f"Differences and ratios are paired with {run.results[0].name}: same start states, same noise. Lower is better."
    marked = [number for number, result in enumerate(run.results) if result.name == best]
    return _section("Policies", _paragraph(text) + _rows(head, rows, marked))


def _parts(run: RunFolder) -> str:
    if not run.iterations:
        return _section("Parts", _paragraph("No iteration is finished yet."))
    names = () if run.policy is None else run.policy.problem.partition.names
    rows = []
    for iteration in run.iterations:
        for key, record in iteration["parts"].items():
            kind, _, part = key.rpartition("/")[2].partition("-")[2].partition("-part-")
            name = names[int(part)] if part.isdigit() and int(part) < len(names) else f"part {part}"
            of = {"improve": "policy", "evaluate": "value"}.get(kind, kind)
            losses = [_number(record["losses"].get(loss), form) for loss, form in _LOSSES.items()]
            rows.append((name, str(iteration["number"]), of, str(record["samples"]), *losses))
    head = ("part", "iteration", "network", "labels", "accuracy", "regret", "relative error")
    text = (
        "At the end of the training of each part. Accuracy: the share of labelled states where the network chooses the label. "
        "Regret: the mean Q-factor of what it chooses above that of the label, in units of cost. Relative error: of value "
        "networks, mean absolute error over mean cost."
    )
    return _section("Parts", _paragraph(text) + _rows(head, rows))


def _number(value: Any, form: str) -> str:
    return format(value, form) if isinstance(value, (int, float)) else "–"


# ---- what is played ----------------------------------------------------------------------------------------------------


def _played(run: RunFolder, problem: Problem) -> tuple[str, str, str]:
    """The sections of disagreements and of the player, and the player's data with its script."""
    base, trained = next(iter(run.policies)), list(run.policies)[-1]
    stages = min(_STAGES, problem.model.horizon)
    content = player_data(problem, side_by_side(problem, run.policies, _PLAYED, stages))
    script = files("torchrl_pomdp.report").joinpath("player.js").read_text("utf-8")
    data = f'<script type="application/json" id="player-data">{_json(content)}</script>\n<script>\n{script}</script>'
    if base == trained:
        differing = _section(_TITLES[3], _paragraph("No policy is trained yet."))
    else:
        y, keys = starts(problem, _COMPARED)
        found = disagreements(problem, run.policies[base], run.policies[trained], y, keys, max_steps=stages)
        differing = _disagreements(found, base, trained)
    return differing, _player(problem, content), data


def _disagreements(found: Disagreements, base: str, trained: str) -> str:
    rows = [
        (name, str(decisions), str(differ), f"{100 * differ / decisions:.1f} %")
        for name, (decisions, differ) in found.parts.items()
    ]
    text = f"Decisions of {trained} in {_COMPARED} trajectories of its own, beside what {base} would do in the same states."
    shares = _rows(("part", "decisions", "different", "share"), rows)
    pairs = [(one, other, str(count)) for one, other, count in found.pairs[:_MOST_PAIRS]]
    table = _rows((base, trained, "times"), pairs, texts=2) if pairs else _paragraph("They agree everywhere.")
    return _section(_TITLES[3], f"{_paragraph(text)}{shares}<br>{table}")


def _player(problem: Problem, content: Mapping[str, Any]) -> str:
    model = problem.model
    notes = [
        f"{' and '.join(content['policies'])} from the same states, under the same noise. Arrow keys step; cost is discounted."
    ]
    if not has_world(model):
        notes.append(f"The truth is not shown: {type(model).__name__} has no hidden states, which its world() would give.")
    if not content["starts"][0][0][0]["q"]:
        notes.append("Q-factors are not shown, as there are too many controls.")
    if content["cut"] is not None:
        notes.append(f"Only the first {content['cut']} stages are shown, so that the page stays small.")
    if content["scene"].get("more"):
        shown = len(content["scene"]["bars"])
        notes.append(f"Only the first {shown} of {shown + content['scene']['more']} numbers of the belief are shown.")
    legend = ""
    if content["scene"]["kind"] == "network":
        colours = "rgb(255 255 204), rgb(254 217 118), rgb(253 141 60), rgb(227 26 28), rgb(128 0 38)"
        legend = (
            f'<div class="legend">damage level 0 <span class="ramp" style="background: linear-gradient(90deg, {colours})">'
            f"</span> {content['scene']['levels']}; numbered discs: robots; plus: repair; arrow: move</div>"
        )
    controls = (
        '<div id="player" hidden><div class="controls"><select id="start" aria-label="start state"></select>'
        '<button id="play" type="button">Play</button>'
        '<input id="stage" type="range" min="0" value="0" step="1" aria-label="stage">'
        f'<output id="stage-text" for="stage"></output></div>{legend}<div class="sides" id="sides"></div></div>'
    )
    script = "<noscript><p>The player needs JavaScript.</p></noscript>"
    return _section("Trajectories", "".join(map(_paragraph, notes)) + script + controls)


# ---- pieces of HTML ----------------------------------------------------------------------------------------------------


def _section(title: str, content: str) -> str:
    return f'<section id="{_anchor(title)}"><h2>{escape(title)}</h2>{content}</section>'


def _anchor(title: str) -> str:
    return title.lower().replace(" ", "-")


def _contents() -> str:
    links = [f'<a href="#{_anchor(title)}">{title}</a>' for title in _TITLES]
    return f"<nav>{''.join(links)}</nav>"


def _paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def _rows(head: Sequence[str], rows: Iterable[Sequence[str]], marked: Sequence[int] = (), texts: int = 1) -> str:
    """A table whose first columns are ``texts``, the others numbers; marked rows are bold."""
    cells = [f"<tr{_BEST if number in marked else ''}>{_cells('td', row, texts)}</tr>" for number, row in enumerate(rows)]
    top = _cells("th", head, texts)
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{"".join(cells)}</tbody></table></div>'


def _cells(tag: str, row: Sequence[str], texts: int) -> str:
    kind = {"th": ' scope="col"', "td": ""}[tag]
    return "".join(f"<{tag}{kind}{_TEXT if column < texts else ''}>{escape(cell)}</{tag}>" for column, cell in enumerate(row))


def _json(content: Any) -> str:
    """JSON that may stand in a script element, whatever texts it holds."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
