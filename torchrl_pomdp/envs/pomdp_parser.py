"""The grammar of ``.POMDP`` files (A. R. Cassandra's format, the input of ``pomdp-solve``)."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Callable, Sequence
from math import isfinite
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from torchrl_pomdp.checks import shown
from torchrl_pomdp.envs.pomdp_tables import MAX_ROWS, Rewards, Rows

__all__ = ["KEYWORDS", "MAX_ELEMENTS", "NAME", "Elements", "Parser"]

MAX_ELEMENTS = 1 << 17
"""Most states, controls or observations."""

# fmt: off
KEYWORDS = frozenset((
    "discount", "values", "states", "actions", "observations", "start", "T", "O", "R",
    "reward", "cost", "uniform", "identity", "reset", "include", "exclude",
))
# fmt: on
"""Words that are no names."""

NAME = re.compile(r"[A-Za-z_][!\"$-)+-9;-~]*")
"""What a name is: a letter first, no space, and no colon, asterisk or number sign, which end a word."""

_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
_STRANGE = re.compile(r"[^\t\v\f -~]")


class _Words:
    """The words of a text one after another, and on which lines they are."""

    def __init__(self, text: str, name: str) -> None:
        self.name, self.at = name, 0
        self.all: list[str] = []
        self._ends: list[int] = []
        for line in text.replace("\r\n", "\n").replace("\r", "\n").split("\n"):
            content = line.partition("#")[0]
            words = content.replace(":", " : ").replace("*", " * ").split()
            # A sign may stand apart from its number.
            if "-" in words or "+" in words:
                words = re.sub(r"(^|\s)([+-])\s+(?=[\d.])", r"\1\2", " ".join(words)).split()
            self.all += words
            self._ends.append(len(self.all))
            if strange := _STRANGE.search(content):
                found = f"found {strange[0]!r} outside a comment"
                raise ValueError(f"{name}, line {len(self._ends)}: {found}: a .POMDP file holds printable ASCII characters")
        self.all.append("")

    @property
    def next(self) -> str:
        """The next word, empty at the end."""
        return self.all[self.at]

    def take(self) -> str:
        """The next word, which is then the last one."""
        self.at += 1
        return self.all[self.at - 1]

    def line(self, at: int) -> int:
        """The line of a word; of one behind the end, the last line."""
        return min(bisect_right(self._ends, at), len(self._ends) - 1) + 1

    def fail(self, message: str) -> NoReturn:
        """Raise, naming the line of the next word."""
        raise ValueError(f"{self.name}, line {self.line(self.at)}: {message}")

    def expect(self, what: str, at: int | None = None) -> NoReturn:
        """Raise: the next word, or the one at a place, is not what it must be."""
        self.at = self.at if at is None else at
        found = f"got {shown(self.next)}" if self.next else "got the end of the file"
        self.fail(f"expected {what}, {found}")


class Elements:
    """States, controls or observations: how many, and which number each name stands for."""

    def __init__(self, kind: str, names: Sequence[str] | None, count: int) -> None:
        self.kind, self.count = kind, count
        self.names = None if names is None else tuple(names)
        self.numbers = {str(i): i for i in range(count)} | {name: i for i, name in enumerate(names or ())}

    def allowed(self) -> str:
        """What stands for one of them, for messages."""
        numbers = f"0 to {self.count - 1}"
        return numbers if self.names is None else f"a name such as {shown(self.names[0])} or a number {numbers}"


class Parser:
    """Reads a text to its end.

    Args:
        text: what a file holds.
        name: name of the file, for messages.
        largest: the largest size of a value of R.

    Attributes:
        name: name of the file.
        discount: discount factor.
        sign: -1 where values are rewards, 1 where they are costs.
        states, controls, observations: the elements, each with ``count`` and ``names``.
        start: probabilities of the start states ``[n]``; uniform where nothing else is said.
        moves: probabilities of next states.
        sees: probabilities of observations.
        rewards: values by control, state, next state and observation.

    Raises:
        ValueError: if the text is no such file; the message names file and line.

    Examples:
        >>> text = "discount: 0.9 values: cost states: 2 actions: stay observations: 1 T: stay identity O: stay uniform"
        >>> parser = Parser(text, "example", 1e9)
        >>> parser.states.count, parser.controls.names, parser.start.tolist()
        (2, ('stay',), [0.5, 0.5])
    """

    states: Elements
    controls: Elements
    observations: Elements
    moves: Rows
    sees: Rows
    rewards: Rewards

    def __init__(self, text: str, name: str, largest: float) -> None:
        self.name, self._largest = name, largest
        self._words = _Words(text, name)
        self._given: dict[str, int] = {}
        self._ready = False
        preamble: dict[str, Callable[[], None]] = {
            "discount": self._discount,
            "values": self._values,
            "states": lambda: self._elements("states"),
            "actions": lambda: self._elements("controls"),
            "observations": lambda: self._elements("observations"),
            "start": self._start,
        }
        tables = {"T": self._transition, "O": self._observation, "R": self._reward}
        while keyword := self._words.next:
            if keyword in tables:
                self._prepare()
                self._table(tables[keyword])
            elif keyword in preamble:
                self._once(keyword)
                preamble[keyword]()
            else:
                self._words.expect(f"one of {', '.join([*preamble, *tables])}")
        self._prepare()

    # ---- preamble ----------------------------------------------------------------------------------------------------

    def _once(self, keyword: str) -> None:
        if self._ready:
            self._words.fail(f"{keyword} must come before the first T, O or R")
        if keyword in self._given:
            self._words.fail(f"{keyword} is given twice, first on line {self._given[keyword]}")
        self._given[keyword] = self._words.line(self._words.at)
        self._words.take()
        if keyword != "start":
            self._colon()

    def _colon(self) -> None:
        if self._words.next != ":":
            self._words.expect("a colon")
        self._words.take()

    def _discount(self) -> None:
        self.discount = self._number("a number in (0, 1)")
        if not 0.0 < self.discount < 1.0:
            self._words.expect("a discount in (0, 1)", self._words.at - 1)

    def _values(self) -> None:
        if self._words.next not in ("reward", "cost"):
            self._words.expect("reward or cost")
        self.sign = 1.0 if self._words.take() == "cost" else -1.0

    def _elements(self, kind: str) -> None:
        words, names = self._words, []
        if words.next.isdigit():
            count = int(words.next) if len(words.next) < 10 else MAX_ELEMENTS + 1
            if not 1 <= count <= MAX_ELEMENTS:
                words.expect(f"a number of {kind} in 1 to {MAX_ELEMENTS}")
            words.take()
            setattr(self, kind, Elements(kind, None, count))
            return
        while (word := words.next) and word not in KEYWORDS:
            if not NAME.fullmatch(word):
                words.expect(f"a name of one of the {kind}, which begins with a letter")
            names.append(words.take())
        if not names or len(names) > MAX_ELEMENTS:
            words.expect(f"1 to {MAX_ELEMENTS} {kind}, as a number or as names")
        elements = Elements(kind, names, len(names))
        twice = next((name for i, name in enumerate(names) if elements.numbers[name] != i), None)
        if twice is not None:
            words.fail(f"{kind} must have different names, got {shown(twice)} twice")
        setattr(self, kind, elements)

    def _start(self) -> None:
        words = self._words
        if "states" not in self._given:
            words.fail("start must come after states")
        n, mode = self.states.count, words.next
        if mode in ("include", "exclude"):
            words.take()
            self._colon()
            chosen = np.zeros(n)
            while (word := words.next) and (word not in KEYWORDS):
                chosen[self._element(self.states)] = 1.0
            chosen = chosen if mode == "include" else 1.0 - chosen
            if not chosen.any():
                words.expect(f"states to {mode}, so that one is left")
            self.start = chosen / chosen.sum()
            return
        self._colon()
        # A number without another one behind it is a state, not a list of probabilities.
        behind = words.all[min(words.at + 1, len(words.all) - 1)]
        number = _NUMBER.fullmatch(words.next)
        # The only state has the number 0, which is no probability to start in it.
        single = not number or (words.next.strip("0") == "" if n == 1 else not _NUMBER.fullmatch(behind))
        if words.next == "uniform":
            words.take()
            self.start = np.full(n, 1.0 / n)
        elif single:
            self.start = np.eye(1, n, self._element(self.states))[0]
        else:
            at = words.at
            self.start = self._probabilities(n, "probabilities of start states")
            if abs(self.start.sum() - 1.0) > 1e-5:
                words.at = at
                words.fail(f"probabilities of the start states must sum to 1, got {self.start.sum():.7g}")

    def _prepare(self) -> None:
        """Make the tables, once all is known that decides their size."""
        if self._ready:
            return
        missing = [key for key in ("discount", "values", "states", "actions", "observations") if key not in self._given]
        if missing:
            self._words.fail(f"{', '.join(missing)} must be given before the first T, O or R")
        u, n, z = self.controls.count, self.states.count, self.observations.count
        if u * n > MAX_ROWS:
            self._words.fail(f"states times actions must be at most {MAX_ROWS}, got {u * n}")
        if "start" not in self._given:
            self.start = np.full(n, 1.0 / n)
        self.moves, self.sees, self.rewards = Rows(u, n, n), Rows(u, n, z), Rewards((u, n, n, z))
        self._ready = True

    # ---- tables ------------------------------------------------------------------------------------------------------

    def _table(self, statement: Callable[[], None]) -> None:
        at = self._words.at
        self._words.take()
        self._colon()
        try:
            statement()
        except OverflowError as error:
            self._words.at = at
            self._words.fail(str(error))

    def _transition(self) -> None:
        self._distribution(self.moves, self.states, (self.controls, self.states, self.states))

    def _observation(self) -> None:
        self._distribution(self.sees, self.observations, (self.controls, self.states, self.observations))

    def _distribution(self, rows: Rows, outcomes: Elements, kinds: tuple[Elements, ...]) -> None:
        rows.line = self._words.line(self._words.at)
        where, word = self._selection(kinds), self._words.next
        size = outcomes.count
        what = f"probabilities of {outcomes.kind}"
        if len(where) == 3:
            rows.put(*where, self._probability())
        elif word == "uniform":
            self._words.take()
            rows.put_row(where[0], where[1] if len(where) == 2 else -1, np.full(size, 1.0 / size))
        elif word == "identity" and len(where) == 1 and size == self.states.count:
            self._words.take()
            rows.put_identity(where[0])
        elif word == "reset" and len(where) == 2 and outcomes is self.states:
            self._words.take()
            rows.put_row(where[0], where[1], self.start)
        elif len(where) == 2:
            rows.put_row(where[0], where[1], self._probabilities(size, what))
        else:
            values = self._probabilities(self.states.count * size, f"{what} by state")
            rows.put_matrix(where[0], values.reshape(-1, size))

    def _reward(self) -> None:
        where = self._selection((self.controls, self.states, self.states, self.observations))
        n, z = self.states.count, self.observations.count
        if len(where) == 1:
            self._words.expect("a colon and a state")
        at = self._words.at
        if len(where) == 4:
            values = np.array([self._number("a finite number")])
        elif len(where) == 3:
            values = self._numbers(z, "values of observations")
        else:
            values = self._numbers(n * z, "values of next states and observations")
        large = (np.abs(values) > self._largest).nonzero()[0]
        if len(large):
            self._words.expect(f"a value of at most {self._largest:.3g} in size", at + int(large[0]))
        if len(where) == 4:
            self.rewards.put(where, float(values[0]))
        else:
            self.rewards.put_block(where, values if len(where) == 3 else values.reshape(n, z))

    # ---- words -------------------------------------------------------------------------------------------------------

    def _selection(self, kinds: tuple[Elements, ...]) -> tuple[int, ...]:
        """As many elements, parted by colons, as there are; -1 where there is an asterisk."""
        words, chosen = self._words, []
        for elements in kinds:
            chosen.append(-1 if words.next == "*" else self._element(elements, " or *"))
            words.at += words.next == "*"
            if len(chosen) == len(kinds) or words.next != ":":
                break
            words.at += 1
        return tuple(chosen)

    def _element(self, elements: Elements, wildcard: str = "") -> int:
        word = self._words.next
        # Numbers may begin with zeros.
        found = elements.numbers.get(word if word in elements.numbers or not word.isdigit() else word.lstrip("0") or "0")
        if found is None:
            self._words.expect(f"one of the {elements.kind}, {elements.allowed()}{wildcard}")
        self._words.at += 1
        return found

    def _number(self, what: str) -> float:
        """The next word, which must be a finite number."""
        words = self._words
        if not _NUMBER.fullmatch(words.next) or not isfinite(float(words.next)):
            words.expect(what)
        words.at += 1
        if _NUMBER.fullmatch(words.next):
            words.expect(f"{what} and no more")
        return float(words.all[words.at - 1])

    def _probability(self) -> float:
        value = self._number("a probability")
        if not 0.0 <= value <= 1.0:
            self._words.expect("a probability in [0, 1]", self._words.at - 1)
        return value

    def _probabilities(self, count: int, what: str) -> NDArray[np.float64]:
        at = self._words.at
        values = self._numbers(count, what)
        wrong = ((values < 0.0) | (values > 1.0)).nonzero()[0]
        if len(wrong):
            self._words.expect(f"{what} in [0, 1]", at + int(wrong[0]))
        return values

    def _numbers(self, count: int, what: str) -> NDArray[np.float64]:
        """The next words, which must be just so many numbers."""
        words, what = self._words, f"{count} {what}"
        at = words.at
        given = words.all[at : min(at + count, len(words.all) - 1)]
        wrong = next((k for k, word in enumerate(given) if not _NUMBER.fullmatch(word)), len(given))
        if wrong < count:
            words.expect(f"{what}{f' of which there are {wrong}' if wrong else ''}", at + wrong)
        words.at += count
        if _NUMBER.fullmatch(words.next):
            words.expect(f"{what} and no more")
        values = np.array([float(word) for word in given])
        infinite = (~np.isfinite(values)).nonzero()[0]
        if len(infinite):
            words.expect(f"{what}, finite", at + int(infinite[0]))
        return values
