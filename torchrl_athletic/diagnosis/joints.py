"""The fit of the standard joints as one of the trials."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.fit import Fitted, Hypothesis, as_trims
from torchrl_athletic.diagnosis.fitting import Fit, fit
from torchrl_athletic.diagnosis.screen import Atom, Candidate
from torchrl_athletic.diagnosis.search import Judge, Scored
from torchrl_athletic.diagnosis.stages import Given, Run
from torchrl_athletic.diagnosis.thresholds import SIMULATION, SPENDING
from torchrl_athletic.effects import CATALOGUE, FIT_TRIMS, Effect, Parameter

Array = NDArray[np.float64]

NORMAL = 3.92
"""Width of a normal distribution's 95 % interval, in standard deviations."""


def standard_joints_of(given: Given, run: Run) -> Fitted | None:
    """What the fit of the standard joints keeps; None if that is nothing, or holds what the catalogue lacks.

    What is no effect of the catalogue but what every model is a little wrong in is a trim.
    """
    named = {e.name for e in given.catalogue}
    if not named:  # whatever it keeps would lack a name
        return None
    known = {e.name: e for e in (*FIT_TRIMS, *CATALOGUE, *given.catalogue)}

    def compute() -> Fitted:
        left = run.left(SPENDING.to_fit_joints)
        found = fit(given.xml, given.recordings, drive=given.drive, seed=given.seed, time_budget=left)
        return _with_draws(found, given)

    key = "standard joints" + ("" if run.time_budget is None else f" in {run.time_budget:g} s")
    fitted = run.checkpoint.result(key, compute, _encode, lambda content: _decode(content, known))
    terms = fitted.hypothesis.terms
    return fitted if terms and all(c.effect.name in named for c in terms) else None


def in_torques(judge: Judge, fitted: Fitted) -> Scored:
    """The combination of a fit in the torque domain, at the fitted values of what enters nonlinearly.

    A joint of which a number stops at a bound there has no names: what stops is a stand-in, and bends what is beside
    it. The others keep theirs. One of the whole robot that stops leaves none.
    """
    atoms = [_atom(judge, c, fitted.hypothesis.values_of(c, fitted.values)) for c in fitted.hypothesis.terms]
    scored = judge.score([atom for atom in atoms if atom is not None])
    while stand_ins := scored.fit.stand_ins:
        nameless = {atom.candidate.joint_name for atom in stand_ins}
        kept = [a for a in scored.fit.terms if None not in nameless and a.candidate.joint_name not in nameless]
        scored = judge.score(kept)
    return scored


def _atom(judge: Judge, c: Candidate, values: Array) -> Atom | None:
    """A candidate at its fitted values; None where the torques do not show it."""
    takes = judge.bank.takes
    grid = c.effect.grid_of(takes, c.joint) if all(c.effect.applies(s) for s in takes) else []
    if not grid:
        return None
    own = {p.name: float(v) for p, v in zip(c.parameters, values, strict=True)}
    return judge.bank.add(c, {name: own.get(name, value) for name, value in grid[0].items()})


def _with_draws(found: Fit, given: Given) -> Fitted:
    """A fit with draws from the intervals of its parameters, each by itself."""
    corrected, rng = found.corrected, given.rng("joints")
    h, values = corrected.hypothesis, corrected.values
    ends = {(p.joint, p.effect, p.name): p.ci95 for p in found.parameters}
    place = [(c, p) for c in h.terms for p in c.parameters]
    sigma = np.array([np.ptp(ends.get((c.where, c.effect.name, p.name), (0.0, 0.0))) / NORMAL for c, p in place])
    samples = values + sigma * rng.standard_normal((SIMULATION.samples, len(values)))
    if len(values):
        samples = np.clip(samples, *h.bounds)
    named = {e.name for e in given.catalogue}
    trims = {e.name for e in FIT_TRIMS} - named
    whole = Fitted(h, values, samples, 0.0)
    return as_trims(whole, [c for c in h.terms if c.effect.name in trims])


def _encode(fitted: Fitted) -> dict[str, Any]:
    h = fitted.hypothesis
    return {
        "parts": [
            {
                "effect": c.effect.name,
                "joint": c.joint,
                "joint_name": c.joint_name,
                "parameters": [asdict(p) for p in c.parameters],
                "trim": c in h.trims,
            }
            for c in (*h.terms, *h.trims)
        ],
        "values": fitted.values.tolist(),
        "samples": fitted.samples.tolist(),
    }


def _decode(content: dict[str, Any], known: dict[str, Effect]) -> Fitted:
    parts = [
        (
            Candidate(known[e["effect"]], e["joint"], e["joint_name"], tuple(Parameter(**p) for p in e["parameters"])),
            e["trim"],
        )
        for e in content["parts"]
    ]
    h = Hypothesis(tuple(c for c, trim in parts if not trim), tuple(c for c, trim in parts if trim))
    samples = np.array(content["samples"]).reshape(SIMULATION.samples, len(content["values"]))
    return Fitted(h, np.array(content["values"]), samples, 0.0)
