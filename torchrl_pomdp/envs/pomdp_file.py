"""Models from and to ``.POMDP`` files, in which most small problems of the field are kept (A. R. Cassandra's format)."""

from __future__ import annotations

from os import PathLike

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrl_pomdp.checks import check_instance, check_path, check_text
from torchrl_pomdp.envs.generators import FixedBelief
from torchrl_pomdp.envs.pomdp_parser import KEYWORDS, NAME, Elements, Parser
from torchrl_pomdp.envs.pomdp_tables import Rows
from torchrl_pomdp.envs.tables import ROUNDING
from torchrl_pomdp.envs.tabular import TabularModel
from torchrl_pomdp.files import read_text, write_bytes
from torchrl_pomdp.tensor_checks import check_device, check_dtype

__all__ = ["parse_pomdp", "read_pomdp", "write_pomdp"]

# From where on tables of which less than an eighth is there are kept sparse.
_SPARSE, _SHARE = 1 << 17, 8
# For what may stand in a name of a model but not of a file.
_HYPHENS = str.maketrans(dict.fromkeys(" :*#", "-"))


def read_pomdp(
    path: str | PathLike[str], *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> tuple[TabularModel, FixedBelief]:
    """Model and start belief of a ``.POMDP`` file, see :func:`parse_pomdp`.

    Args:
        path: the file.

    Keyword Args:
        dtype: float32 or float64.
        device: where the model computes.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if the file is no such file; the message names the line.
        OSError: if it cannot be read.

    Examples:
        >>> import tempfile
        >>> from torchrl_pomdp.problems import tiger
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_pomdp(f"{folder}/tiger.POMDP", tiger().model, tiger().start)
        ...     model, start = read_pomdp(f"{folder}/tiger.POMDP")
        >>> model.state_names, model.cost.tolist(), start.belief.tolist()
        (('tiger-left', 'tiger-right'), [[1.0, 1.0], [100.0, -10.0], [-10.0, 100.0]], [0.5, 0.5])
    """
    path = check_path("path", path)
    return parse_pomdp(
        read_text(path, "latin-1"), path.name if path.name.isprintable() else repr(path.name), dtype=dtype, device=device
    )


def parse_pomdp(
    text: str, name: str = "text", *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> tuple[TabularModel, FixedBelief]:
    r"""Model and start belief of a text in the format of ``.POMDP`` files.

    The whole grammar for POMDPs is known: numbers and names, wildcards, single numbers, rows and matrices of T, O and R,
    ``identity``, ``uniform``, ``reset``, all forms of ``start``; what comes later overrides what came before. Values are turned
    into costs, and costs by next state and observation into their expectation. States that no action leaves or
    charges for are terminal. Large tables with few numbers are kept sparse.

    Args:
        text: what a file holds.
        name: what it is called in messages.

    Keyword Args:
        dtype: float32 or float64.
        device: where the model computes.

    Returns:
        the model, with the names of the text, and its start belief; ``Problem(*parse_pomdp(text))`` can be trained.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if the text does not obey the grammar, with the number of the line; if a row of T or O does not sum to 1; if
            there are too many states, or too many numbers once wildcards are written out.

    Examples:
        >>> text = '''discount: 0.9   values: reward
        ... states: fine broken   actions: run mend   observations: quiet loud
        ... start: fine
        ... T: run    0.9 0.1   0.0 1.0
        ... T: mend : *  reset
        ... O: * : fine    0.8 0.2
        ... O: * : broken  uniform
        ... R: run : fine : * : *  3
        ... R: mend : * : * : * -1'''
        >>> model, start = parse_pomdp(text)
        >>> model.cost.tolist(), model.transition[1].tolist()
        ([[-3.0, 0.0], [1.0, 1.0]], [[1.0, 0.0], [1.0, 0.0]])
    """
    dtype, device = check_dtype("dtype", dtype), check_device("device", device)
    parser = Parser(check_instance("text", text, str), check_text("name", name), torch.finfo(dtype).max)
    u, n, z = parser.controls.count, parser.states.count, parser.observations.count
    moves, sees = parser.moves.result(), parser.sees.result()
    _check_rows(parser, "T", parser.moves, moves)
    _check_rows(parser, "O", parser.sees, sees)
    try:
        cost = 0.0 + parser.sign * parser.rewards.expected(moves, sees)
        model = TabularModel(
            _tensor(moves, (u, n, n)),
            _tensor(sees, (u, n, z)),
            torch.from_numpy(cost),
            parser.discount,
            terminal=_terminal(moves, cost),
            state_names=parser.states.names,
            control_names=parser.controls.names,
            observation_names=parser.observations.names,
            dtype=dtype,
            device=device,
        )
    except (OverflowError, ValueError) as error:
        raise ValueError(f"{name}: {error}") from error
    start = parser.start
    scaled = start if abs(start.sum() - 1.0) <= ROUNDING[dtype] else start / start.sum()
    return model, FixedBelief(torch.from_numpy(scaled).to(device, dtype))


def write_pomdp(path: str | PathLike[str], model: TabularModel, start: FixedBelief) -> None:
    """Write a model and its start belief as a ``.POMDP`` file, whole or not at all.

    What :func:`read_pomdp` gives for it in the same type is equal to the last bit. Only, such files have no word for terminal
    states: all that no control leaves or charges for are read as such, whether the model says so or not, and as certain to
    stay. In names, hyphens stand for the characters that names in such files do not have; partitions are not written.

    Args:
        path: the file to make or replace.
        model: the model.
        start: its start belief.

    Raises:
        TypeError: if an argument is of the wrong kind.
        ValueError: if the belief is not one of the model or does not sum to 1 up to rounding, if a control is not legal
            everywhere, or if a name does not begin with a letter, is a keyword or becomes another one's.
        OSError: if the file cannot be written.

    Examples:
        >>> import tempfile, pathlib
        >>> from torchrl_pomdp.problems import tiger
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_pomdp(f"{folder}/tiger.POMDP", tiger().model, tiger().start)
        ...     pathlib.Path(f"{folder}/tiger.POMDP").read_text().splitlines()[:3]
        ['discount: 0.95', 'values: cost', 'states: tiger-left tiger-right']
    """
    path = check_path("path", path)
    check_instance("model", model, TabularModel)
    check_instance("start", start, FixedBelief)
    if len(start.belief) != model.num_states:
        raise ValueError(f"start must be a belief over the model's {model.num_states} states, got {len(start.belief)}")
    total, allowed = float(start.belief.to(model.dtype).double().sum()), ROUNDING[model.dtype]
    if abs(total - 1.0) > allowed:
        raise ValueError(f"start must sum to 1 up to {allowed:g} to be read as it is, got {total:.8g}")
    if not bool(model.legal.all()):
        raise ValueError("model must allow every control in every state: a .POMDP file cannot say which are legal")
    lines = [f"discount: {model.discount!r}", "values: cost"]
    lines.append(f"states: {_names('state_names', model.state_names) or model.num_states}")
    lines.append(f"actions: {_names('control_names', model.control_names) or model.num_controls}")
    lines.append(f"observations: {_names('observation_names', model.observation_names) or model.num_observations}")
    lines.append(f"start: {' '.join(_texts(start.belief.to(model.dtype)))}")
    lines += _table_lines("T", model.transition) + _table_lines("O", model.observation)
    control, state = model.cost.nonzero(as_tuple=True)
    values = _texts(model.cost[control, state])
    lines += [f"R: {u} : {i} : * : * {v}" for u, i, v in zip(control.tolist(), state.tolist(), values, strict=True)]
    write_bytes(path, ("\n".join(lines) + "\n").encode())


def _names(what: str, names: tuple[str, ...] | None) -> str:
    written = [name.translate(_HYPHENS) for name in names or ()]
    last = {name: i for i, name in enumerate(written)}
    for i, name in enumerate(written):
        if not NAME.fullmatch(name) or name in KEYWORDS or last[name] != i:
            raise ValueError(f"{what} of model must begin with a letter, be no keyword and stay different, got {name!r}")
    return " ".join(written)


def _table_lines(keyword: str, table: Tensor) -> list[str]:
    if table.is_sparse:
        values = _texts(table.values())
        return [f"{keyword}: {u} : {i} : {j} {v}" for (u, i, j), v in zip(table.indices().T.tolist(), values, strict=True)]
    lines = []
    for control, rows in enumerate(table):
        lines += [f"{keyword}: {control}", *(" ".join(_texts(row)) for row in rows)]
    return lines


def _texts(values: Tensor) -> list[str]:
    """The shortest texts that are read as the same numbers."""
    numbers = values.cpu().numpy()
    texts = [str(number) for number in numbers]
    same = np.array(texts, np.float64).astype(numbers.dtype) == numbers
    # Read in double precision and rounded again, a short text may give the next number.
    return [text if equal else repr(float(number)) for text, equal, number in zip(texts, same, numbers, strict=True)]


def _tensor(table: tuple[NDArray[np.int64], NDArray[np.float64]], shape: tuple[int, int, int]) -> Tensor:
    index, values = (torch.from_numpy(part) for part in table)
    size = shape[0] * shape[1] * shape[2]
    sparse = torch.sparse_coo_tensor(index, values, shape, is_coalesced=True, check_invariants=False)
    return sparse if size >= _SPARSE and len(values) * _SHARE < size else sparse.to_dense()


def _check_rows(parser: Parser, keyword: str, rows: Rows, table: tuple[NDArray[np.int64], NDArray[np.float64]]) -> None:
    """Raise unless all rows sum to 1 up to rounding."""
    (u, i, _), values = table
    n = parser.states.count
    sums = np.bincount(u * n + i, values, parser.controls.count * n)
    wrong = (np.abs(sums - 1.0) > 1e-5).nonzero()[0]
    if len(wrong):
        control, state = divmod(int(wrong[0]), n)
        row, line = (
            f"{keyword}: {_named(parser.controls, control)} : {_named(parser.states, state)}",
            rows.last_line(control, state),
        )
        where = f", line {line}: the row {row}" if line else f": the row {row}, which is never given,"
        raise ValueError(f"{parser.name}{where} must sum to 1, got {sums[wrong[0]]:.7g}")


def _named(elements: Elements, index: int) -> str:
    return str(index) if elements.names is None else elements.names[index]


def _terminal(moves: tuple[NDArray[np.int64], NDArray[np.float64]], cost: NDArray[np.float64]) -> Tensor | None:
    """States that no action leaves or charges for, ``[n]``; None if there are none."""
    _, i, j = moves[0]
    left = np.zeros(cost.shape[1], bool)
    left[i[i != j]] = True
    terminal = ~left & (cost == 0.0).all(0)
    return torch.from_numpy(terminal) if terminal.any() else None
