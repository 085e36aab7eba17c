"""Say what physics a model leaves out, from recordings: quality, floor, locate, screen, fit, compare, gates, report.

:func:`diagnose` runs all of it; the stages are modules of their own, in that order.
"""

from torchrl_athletic.diagnosis.diagnose import Diagnosis, diagnose
from torchrl_athletic.diagnosis.result import Answer, Estimate, Finding, Location, Rival, Score

__all__ = ["Answer", "Diagnosis", "Estimate", "Finding", "Location", "Rival", "Score", "diagnose"]
