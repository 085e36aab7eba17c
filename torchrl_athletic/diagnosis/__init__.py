"""Say what physics a model leaves out, from recordings: prepare, locate, propose, simulate, decide,
state, deliver.

:func:`diagnose` runs all of it; the stages are modules of their own, in that order. :func:`fit` fits the standard
joints alone, and :func:`best_of_draws` does so several times.
"""

from torchrl_athletic.diagnosis.diagnose import diagnose
from torchrl_athletic.diagnosis.draws import best_of_draws
from torchrl_athletic.diagnosis.fitting import Fit, JointParameter, fit
from torchrl_athletic.diagnosis.outcome import Diagnosis
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
    "best_of_draws",
    "diagnose",
    "fit",
]
