"""Which terms of a fit its simulation needs, so that what is handed over is what was fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.problem import Mask, Problem, part_of
from torchrl_athletic.diagnosis.screen import Candidate

Array = NDArray[np.float64]

VISIBLE = 1e-3
"""Change of a window's error, in typical errors, that makes it another simulation [1]."""
TOLD = 20
"""Windows at a time by which it is told which of the terms that did not move make one."""


def acting(problem: Problem, values: Array, needed: Mask, gone: Sequence[Candidate] = ()) -> tuple[Hypothesis, Array]:
    """The terms without which the simulation would be another one, and their numbers; none where none moved.

    Those that moved, and those that act at the given model's numbers beside them: the given limit is one of the motor's
    torque, before an offset is added.

    Args:
        problem: Windows to compare.
        values: Of all terms. Shape (P,).
        needed: Which of them moved. Shape (P,).
        gone: Terms that were taken back.
    """
    h = problem.hypothesis
    kept = [c for c in h.terms if c not in gone]
    chosen = [c for c in kept if h.values_of(c, needed).any()]

    def part(terms: Sequence[Candidate]) -> tuple[Hypothesis, Array]:
        return Hypothesis(tuple(terms)), np.concatenate([np.zeros(0), *(h.values_of(c, values) for c in terms)])

    def errors(windows: Problem, terms: Sequence[Candidate]) -> Array:
        own, numbers = part(terms)
        return replace(windows, hypothesis=own).errors(numbers[None])[:, 0]

    def differs(windows: Problem, some: Array, others: Array) -> Mask:
        """Which windows move otherwise."""
        return np.asarray((windows.squares(some - others) > (VISIBLE * windows.unit) ** 2).any(1))

    if len(chosen) in (0, len(kept)):
        return part(chosen)
    whole = errors(problem, kept)
    while (different := differs(problem, errors(problem, chosen), whole)).any():
        looked_at = different & (np.cumsum(different) <= TOLD)
        few, fewer = part_of(problem, looked_at), whole[looked_at[problem.window]]
        resting = [c for c in kept if c not in chosen]
        act = [c for c in resting if differs(few, errors(few, [o for o in kept if o is not c]), fewer).any()]
        chosen = [c for c in kept if c in chosen or c in (act or resting)]  # two may act only where both are missing
    return part(chosen)
