"""The standard joints among the trials, and what folds that were kept aside ask for beyond them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.fit import WINDOW, Fitted, Hypothesis
from torchrl_athletic.diagnosis.fitting import fit, spread_of
from torchrl_athletic.diagnosis.joint_fit import (
    FEWEST,
    Problem,
    affordable,
    descend,
    folds_of,
    linearise,
    problem_of,
    weighed,
)
from torchrl_athletic.diagnosis.replay import Take
from torchrl_athletic.diagnosis.screen import Atom, Candidate
from torchrl_athletic.diagnosis.search import Judge, Scored, suggestions
from torchrl_athletic.diagnosis.stages import Ready, Run
from torchrl_athletic.diagnosis.standard import MECHANICS, seen_in, standard_joints

Array = NDArray[np.float64]

SAMPLES = 200
"""Draws from the intervals of a fit."""
STEPS = 8
"""Gauss-Newton iterations with a further effect."""
ROUNDS = 2
"""Effects that are added at most, one after the other."""
LOOKED_AT = 4
"""Effects that are tried in the simulation in each round, those that the torques speak for most."""
DOUBT = 1.0
"""Standard errors by which an effect has to help windows that did not fit it."""


@dataclass(frozen=True, eq=False)
class Extended:
    """A combination that folds asked for, beyond the standard joints."""

    fitted: Fitted
    torques: Scored
    """The same in the torque domain."""


def standard_fit(ready: Ready, run: Run) -> Fitted | None:
    """The standard joints with what folds ask for of them; None where the catalogue lacks one of their effects."""
    given, takes = ready.given, ready.train.takes
    if not {*(e.name for e in MECHANICS), "torque_scale", "gain_mismatch"} <= {e.name for e in given.catalogue}:
        return None

    def compute() -> Fitted:
        found = fit(given.xml, given.recordings, drive=given.drive, seed=given.seed).corrected
        return drawn(found.hypothesis, found.values, takes, given.rng("joints"))

    def encode(fitted: Fitted) -> dict[str, Any]:
        named = [list(c.key) for c in fitted.hypothesis.terms]
        return {"terms": named, "values": fitted.values.tolist(), "samples": fitted.samples.tolist()}

    def decode(content: dict[str, Any]) -> Fitted:
        known = {c.key: c for c in standard_joints(ready.train, seen_in(ready.train)).terms}
        h = Hypothesis(tuple(known[name, joint] for name, joint in content["terms"]))
        samples = np.array(content["samples"]).reshape(-1, len(content["values"]))
        return Fitted(h, np.array(content["values"]), samples, 0.0)

    return run.checkpoint.result("standard joints", compute, encode, decode)


def in_torques(judge: Judge, fitted: Fitted) -> Scored:
    """The combination of a fit in the torque domain, at the fitted values of what enters nonlinearly."""
    atoms = (_atom(judge, c, fitted.hypothesis.values_of(c, fitted.values)) for c in fitted.hypothesis.terms)
    return judge.score([atom for atom in atoms if atom is not None])


def _atom(judge: Judge, c: Candidate, values: Array) -> Atom | None:
    """A candidate at its fitted values; None where the torques do not show it."""
    takes = judge.bank.takes
    grid = c.effect.grid_of(takes, c.joint) if all(c.effect.applies(s) for s in takes) else []
    if not grid:
        return None
    own = {p.name: float(v) for p, v in zip(c.parameters, values, strict=True)}
    return judge.bank.add(c, {name: own.get(name, value) for name, value in grid[0].items()})


def extended(
    judge: Judge, standard: Fitted, takes: Sequence[Take], rng: np.random.Generator, late: Callable[[], bool]
) -> Extended | None:
    """Add effects to the standard joints as long as windows that did not fit them are followed better; None if none is.

    The torques say which are asked about, the simulation which is taken: the one with which a single step from the
    torques' value helps most, if it still helps once all numbers are fitted.
    """
    now, found = standard, None
    for _ in range(ROUNDS):
        problem = _problem(now, takes, rng)
        before = _aside(problem, now.values)
        trials = []
        for proposed in suggestions(judge, in_torques(judge, now))[:LOOKED_AT]:
            if late():
                return found
            h, start = _with(now, proposed)
            wider = replace(problem, hypothesis=h)
            trials.append(((before - _aside(wider, start)).mean(), proposed, wider, start))
        if not trials:
            return found
        _, proposed, wider, start = max(trials, key=lambda t: float(t[0]))
        x = descend(wider, start, _free(wider.hypothesis), STEPS)
        gained = before - _aside(wider, x)
        if gained.mean() <= DOUBT * gained.std() / np.sqrt(len(gained)):
            return found
        now = drawn(wider.hypothesis, x, takes, rng)
        found = Extended(now, proposed)
    return found


def _free(h: Hypothesis) -> NDArray[np.bool_]:
    return h.bounds[1] > h.bounds[0]


def _problem(fitted: Fitted, takes: Sequence[Take], rng: np.random.Generator) -> Problem:
    h = fitted.hypothesis
    most = max(affordable(h, takes) // 2, FEWEST)
    return weighed(problem_of(h, takes, WINDOW, most, rng, fitted.values), fitted.values)


def _aside(problem: Problem, x: Array) -> Array:
    """Mean square error of each window by what other folds say, in units of the joints' errors. Shape (W,)."""
    free = _free(problem.hypothesis)
    fold = np.unique(folds_of(problem), return_inverse=True)[1]
    near, nothing = linearise(problem, x, free), np.zeros(int(free.sum()), dtype=bool)
    values = np.stack([near.step(fold != k, nothing) for k in range(int(fold.max()) + 1)])
    square = problem.mean_square(values)[fold, np.arange(len(fold))]
    return np.asarray((square / problem.unit**2).mean(1), dtype=np.float64)


def _with(fitted: Fitted, proposed: Scored) -> tuple[Hypothesis, Array]:
    """What a combination of the torque domain keeps of a fit, with its new terms at their values there."""
    known = {c.key: c for c in fitted.hypothesis.terms}
    of = {a.candidate.key: v for a, v in zip(proposed.fit.terms, proposed.fit.values(), strict=False)}
    new = [a.candidate for a in proposed.fit.terms if a.candidate.key not in known]
    kept = [c for c in known.values() if all(c.allows(other) for other in new)]
    parts = [*(fitted.hypothesis.values_of(c, fitted.values) for c in kept), *(of[c.key] for c in new)]
    h = Hypothesis((*kept, *new))
    return h, np.clip(np.concatenate(parts), *h.bounds)


def drawn(h: Hypothesis, x: Array, takes: Sequence[Take], rng: np.random.Generator) -> Fitted:
    """A fit with draws from the intervals of its parameters, each by itself."""
    if not len(x):
        return Fitted(h, x, np.zeros((SAMPLES, 0)), 0.0)
    free = _free(h)
    sigma = np.zeros(len(x))
    problem = _problem(Fitted(h, x, x[None], 0.0), takes, rng)
    sigma[free] = spread_of(linearise(problem, x, free))
    samples = np.clip(x + sigma * rng.standard_normal((SAMPLES, len(x))), *h.bounds)
    return Fitted(h, x, samples, 0.0)
