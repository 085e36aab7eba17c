"""Say what physics a model leaves out, from recordings: quality, floor, locate, screen, fit, compare, gates, report.

:func:`diagnose` runs all of it; the stages are modules of their own, in that order. :func:`fit` fits the standard
joints alone.
"""

from torchrl_athletic.diagnosis.diagnose import Diagnosis, diagnose
from torchrl_athletic.diagnosis.fitting import Fit, JointParameter, fit
from torchrl_athletic.diagnosis.result import Answer, Estimate, Finding, Location, Rival, Score

__all__ = [
    "Answer",
    "Diagnosis",
    "Estimate",
    "Finding",
    "Fit",
    "JointParameter",
    "Location",
    "Rival",
    "Score",
    "diagnose",
    "fit",
]
