"""Progress on a terminal and elsewhere."""

from __future__ import annotations

import io
import sys

import pytest

from torchrl_pomdp import progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("show", [True, False])
def test_a_file_gets_lines(monkeypatch, show):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(progress, "_SELDOM", 0.0)
    with progress.progress_bar(4, "state", "label", show, leave=True) as bar:
        for _ in range(4):
            bar.update()
    lines = stream.getvalue().splitlines()
    assert "\r" not in stream.getvalue()
    assert bool(lines) == show
    assert all(line.startswith("label: ") and "state/s]" in line for line in lines)
    assert not show or any(" 2/4 [" in line for line in lines)


def test_a_file_gets_nothing_of_what_takes_no_time(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with progress.progress_bar(4, "state", "label", show=True) as bar:
        bar.update(4)
    assert stream.getvalue() == ""


def test_a_terminal_gets_a_bar(monkeypatch):
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    with progress.progress_bar(4, "state", "label", show=True, leave=True) as bar:
        bar.update(4)
    assert stream.getvalue().count("\r") >= 2
    assert "| 4/4 [" in stream.getvalue()
