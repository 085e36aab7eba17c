"""Say an answer to a person: sentences for the terminal, one self-contained page, one picture.

Numbers keep the digits that their intervals deserve and carry their units (``quantity``); what is drawn first is
what tells most (``telling``). The page loads nothing from anywhere and runs no script.
"""

from torchrl_athletic.diagnosis.report.figures import summary_figure
from torchrl_athletic.diagnosis.report.page import write_report
from torchrl_athletic.diagnosis.report.terminal import terminal_summary

__all__ = ["summary_figure", "terminal_summary", "write_report"]
