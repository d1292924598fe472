"""What a problem says of itself."""

from __future__ import annotations

import pytest

from torchrl_pomdp.cli import main
from torchrl_pomdp.problems import make_problem


def test_what_an_evaluation_cuts_does_not_outweigh_small_costs(capsys):
    """Listening for ever costs 1 a stage: 20 in all. The largest cost of a stage, for ever, would be 2000."""
    assert main(["evaluate", "listen", "--problem", "tiger", "--states", "5"]) == 0
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| listen |")]
    assert float(row.split("|")[2].split("±")[0]) == pytest.approx(20.0, abs=0.05)
    line3 = make_problem("line3")
    assert line3.evaluation_cost is line3.pessimistic_cost
