"""Recordings replayed in longer physics steps: two to twenty times as quick, and nearly the same motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.fit import WINDOW, Fitted, Hypothesis, draw_windows, fit
from torchrl_athletic.diagnosis.problem import Problem, compared_every
from torchrl_athletic.diagnosis.replay import Take, simulate

Array = NDArray[np.float64]

LONGEST = (5e-3, 2e-3)
"""Steps that are tried [s]. Motors that follow logged torques bear the first, controllers seldom: their loops are
stiff."""
ALIKE = 0.1
"""Difference to the motion in the model's own steps, per the error of that, up to which a search bears a step [1]."""
LOOKED_AT = 20
"""Windows by which the two are compared."""


def coarse(takes: Sequence[Take], h: Hypothesis, points: Sequence[Array], rng: np.random.Generator) -> dict[Take, Take]:
    """Copies of takes in the longest steps that move as the takes do, by some of the points; else a take itself.

    Args:
        takes: On the grid of their recordings.
        h: What the values are of.
        points: Values (P,). A given model without friction and rotors may need steps that no fitted one needs. What
            follows a take worse than the first of them has no say: it may be one that coasts in any steps.
        rng: Draws the windows by which they are compared.

    Returns:
        Copy of each take -> the take.
    """
    copies = {}
    for take in takes:
        errors = _errors(take, h, points, rng) if len(points) > 1 else np.zeros(1)
        asked = [x for x, error in zip(points, errors, strict=True) if error <= errors[0]]
        alike = (c for c in _copies(take) if any(moves_alike(c, take, h, x, rng) for x in asked))
        copies[next(alike, take)] = take
    return copies


def _copies(take: Take) -> Iterator[Take]:
    """Copies in steps of :data:`LONGEST`; of a log whose samples are closer than are compared, on those that are."""
    every = compared_every(take)
    grid = take.thinned(every) if every > 1 else take
    for longest in LONGEST:
        copy = grid.stepped(int(np.ceil(grid.period / longest - 1e-3)))
        if copy.model.opt.timestep > (1 + 1e-6) * take.model.opt.timestep:
            yield copy


def _errors(take: Take, h: Hypothesis, points: Sequence[Array], rng: np.random.Generator) -> Array:
    """Squared error of each of some values (P,), summed over a few windows [rad², m²]. Shape (K,)."""
    out = np.zeros(len(points))
    for w in draw_windows([take], WINDOW, LOOKED_AT, rng):
        out += ((simulate(w, h.build, np.stack(points)) - w.measured) ** 2).sum((1, 2, 3))
    return out


def moves_alike(copy: Take, take: Take, h: Hypothesis, x: Array, rng: np.random.Generator) -> bool:
    """Whether a copy in other steps moves as the take does, to values (P,), but for a share of the take's error."""
    if copy is take:
        return True
    wrong, error = np.zeros(len(take.address.dof)), np.zeros(len(take.address.dof))
    windows = draw_windows([copy], WINDOW, LOOKED_AT, rng)
    every = round(copy.period / take.period)
    for w in windows:
        own = w.of(take)
        there = simulate(w, h.build, x[None])[0]
        here, measured = simulate(own, h.build, x[None])[0][:, every - 1 :: every], own.measured[:, every - 1 :: every]
        wrong += ((there - here) ** 2).sum((0, 1))
        error += ((here - measured) ** 2).sum((0, 1))
    return bool(windows) and bool(np.mean(wrong / np.maximum(error, 1e-18)) <= ALIKE**2)


def steps_alike(copies: Mapping[Take, Take], h: Hypothesis, x: Array, rng: np.random.Generator) -> dict[Take, Take]:
    """Each copy of a take -> that in the longest steps, halved as often as it takes, that moves as the take by values.

    Args:
        copies: Copy of each take -> the take.
        h: What the values are of.
        x: Values (P,).
        rng: Draws the windows by which they are compared.
    """
    return {
        copy: next((c for c in _halved(copy, take) if moves_alike(c, take, h, x, rng)), take)
        for copy, take in copies.items()
    }


def _halved(copy: Take, take: Take) -> Iterator[Take]:
    """A copy, and others in steps of half the length, a quarter and so on, of at most half as many as the take's."""
    yield copy
    count = 2 * copy.substeps
    while 2 * count * take.period <= take.substeps * copy.period * (1 + 1e-6):
        yield copy.stepped(count)
        count *= 2


def fit_in_steps_of(
    copies: Mapping[Take, Take], h: Hypothesis, start: Array, rng: Callable[[str], np.random.Generator]
) -> Fitted:
    """Fit copies from values (P,), and again in shorter steps as long as these move otherwise by what was found.

    Args:
        copies: Copy of each take -> the take.
        h: What may change.
        start: First guess. Shape (P,).
        rng: Randomness for one purpose.
    """
    while True:
        fitted = fit(h, tuple(copies), start, rng("fit"))
        shorter = steps_alike(copies, h, fitted.values, rng("coarse"))
        if all(copy is other for copy, other in shorter.items()):
            return fitted
        copies, start = {shorter[copy]: take for copy, take in copies.items()}, fitted.values


def in_steps_of(problem: Problem, steps: Mapping[Take, Take]) -> Problem:
    """The same windows of other copies of their takes; slopes are taken in the longest steps that they had."""
    windows = tuple(w.of(steps[w.take]) for w in problem.windows)
    longest = problem.slope_windows or problem.windows
    same = all(a.take is b.take for a, b in zip(windows, longest, strict=True))
    return replace(problem, windows=windows, slope_windows=() if same else longest)
