"""Tables and pictures of results."""

from torchrl_pomdp.report.effort import Effort, effort, effort_table
from torchrl_pomdp.report.figures import cost_figure, draw, iteration_figure, time_figure
from torchrl_pomdp.report.names import is_iteration
from torchrl_pomdp.report.peers import Outcome, peer_figure, peer_table
from torchrl_pomdp.report.tables import Result, interval_text, paired_ratios, paired_table, ratio_texts, table

__all__ = [
    "Effort",
    "Outcome",
    "Result",
    "cost_figure",
    "draw",
    "effort",
    "effort_table",
    "interval_text",
    "is_iteration",
    "iteration_figure",
    "paired_ratios",
    "paired_table",
    "peer_figure",
    "peer_table",
    "ratio_texts",
    "table",
    "time_figure",
]
