"""The fit of the standard joints as one of the trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.coarse import coarse, fit_in_steps_of
from torchrl_athletic.diagnosis.coupled import with_coupled_drives
from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.fit import Fitted, Hypothesis, as_trims
from torchrl_athletic.diagnosis.fitting import Fit, fit
from torchrl_athletic.diagnosis.replay import follow_targets
from torchrl_athletic.diagnosis.screen import Atom, Candidate, Key, candidates_for
from torchrl_athletic.diagnosis.search import Judge, Scored
from torchrl_athletic.diagnosis.selection import Rival, select
from torchrl_athletic.diagnosis.stages import Given, Ready, Run
from torchrl_athletic.diagnosis.standard import LIMITS, agreement, seen_in, standard_joints
from torchrl_athletic.diagnosis.thresholds import SIMULATION, SPENDING
from torchrl_athletic.effects import CATALOGUE, FIT_TRIMS, Effect, Parameter

Array = NDArray[np.float64]

BESIDE = ("link_mass", "link_com", "payload", "offset_payload", "gravity_tilt", "joint_spring", "clock_offset")
"""What the motion may ask for beside the standard joints."""
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


@dataclass(frozen=True, eq=False)
class Asked:
    """What the motion asks for, one effect after the other."""

    fitted: Fitted
    shares: tuple[float, ...]
    """Share of the error that comes back without each term, 0..1."""
    rivals: tuple[tuple[Rival, ...], ...]
    """What else was fitted in each term's place."""
    offered: tuple[Candidate, ...]
    """What it might have asked for."""
    complete: bool
    """Whether there was time to ask for all."""

    @property
    def classes(self) -> dict[Key, float]:
        """Class and joint -> the most that comes back without one of its effects; 0 of what it does without."""
        out = {(c.effect.family, c.joint_name): 0.0 for c in self.offered}
        for c, share in zip(self.fitted.hypothesis.terms, self.shares, strict=True):
            place = c.effect.family, c.joint_name
            out[place] = max(out[place], share)
        return out


def asked_of_motion(ready: Ready, run: Run, proposed: Sequence[Fitted]) -> Asked:
    """The few effects that the motion asks for.

    Args:
        ready: Recordings.
        run: What may be spent.
        proposed: Combinations that the torques speak for, as fitted: their terms are offered as well.
    """
    given, train = ready.given, ready.train
    h, starts = _offered(ready, proposed)

    def compute() -> Asked:
        takes = coarse(train.takes, h, [h.nominal], given.rng("coarse"))
        left = run.left(SPENDING.to_select)
        deadline = Deadline(np.inf if left is None else left)
        found = select(h, tuple(takes), given.rng("motion"), deadline, agreement(h, train), starts)
        copies = takes if follow_targets(train.takes) else {take: take for take in train.takes}  # these are cheap
        fitted = fit_in_steps_of(copies, found.hypothesis, found.values, given.rng)
        return Asked(fitted, found.shares, found.rivals, h.terms, found.complete)

    def encode(asked: Asked) -> dict[str, Any]:
        rivals = [[[*r.candidate.key, r.values.tolist(), r.against] for r in of] for of in asked.rivals]
        return {**_encode(asked.fitted), "shares": list(asked.shares), "rivals": rivals, "complete": asked.complete}

    def decode(content: dict[str, Any]) -> Asked:
        of = {c.key: c for c in h.terms}
        rivals = tuple(tuple(Rival(of[e, j], np.array(x), z) for e, j, x, z in some) for some in content["rivals"])
        return Asked(_decode(content, known), tuple(content["shares"]), rivals, h.terms, content["complete"])

    key = " ".join(["motion", *(f"{c.effect.name}/{c.where}" for c in starts)])
    key += "" if run.time_budget is None else f" in {run.time_budget:g} s"
    known = {e.name: e for e in given.catalogue}
    return run.checkpoint.result(key, compute, encode, decode)


def _offered(ready: Ready, proposed: Sequence[Fitted]) -> tuple[Hypothesis, dict[Candidate, list[Array]]]:
    """What the motion may ask for, as far as it has names, and the values that are known of some of it.

    The standard joints, drives of two of them, what links and clock may lack, and what the torques speak for; but no
    gears, which stand still in steps of a search.
    """
    train, named = ready.train, {e.name for e in ready.given.catalogue}
    seen = seen_in(train)
    every = with_coupled_drives(standard_joints(train, seen), train, seen)
    standard = [c for c in every.terms if c.effect.name in named]
    known = {c.key for c in standard}
    links = [e for e in ready.given.catalogue if e.name in BESIDE and all(e.applies(s) for s in train.signals)]
    shown = [c for c in candidates_for(train.signals, links) if c.effect.grid_of(train.signals, c.joint)]
    beside = [c for c in shown if c.key not in known]
    offered = {c.key: c for c in (*standard, *beside)}
    limits = [c for c in standard if c.effect.name == "torque_saturation"]  # any size above the asked torque is none
    starts = {c: [np.array([share * seen.asked[c.joint]]) for share in LIMITS] for c in limits}
    for fitted in proposed:
        for c in fitted.hypothesis.terms:
            if not c.effect.of_accelerations:
                own = offered.setdefault(c.key, c)
                starts.setdefault(own, []).append(fitted.hypothesis.values_of(c, fitted.values))
    return Hypothesis(tuple(offered.values())), starts


def as_chosen(judge: Judge, fitted: Fitted) -> Scored:
    """The combination of a fit in the torque domain, at the fitted values of what enters nonlinearly."""
    atoms = [_atom(judge, c, fitted.hypothesis.values_of(c, fitted.values)) for c in fitted.hypothesis.terms]
    return judge.score([atom for atom in atoms if atom is not None])


def rivals_in_torques(judge: Judge, asked: Asked) -> dict[Key, tuple[tuple[Atom, float], ...]]:
    """Term -> what could stand in its place, with what the motion says against it, as far as the torques show it."""
    out = {}
    for c, rivals in zip(asked.fitted.hypothesis.terms, asked.rivals, strict=True):
        atoms = [(_atom(judge, r.candidate, r.values), r.against) for r in rivals]
        out[c.key] = tuple((atom, against) for atom, against in atoms if atom is not None)
    return out


def in_torques(judge: Judge, fitted: Fitted) -> Scored:
    """The same without joints that the torques would drive to a bound.

    A joint of which a number stops at a bound there has no names: what stops is a stand-in, and bends what is beside
    it. The others keep theirs. One of the whole robot that stops leaves none.
    """
    scored = as_chosen(judge, fitted)
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
    resting = [c for c in h.terms if all(h.values_of(c, values) == [p.nominal for p in c.parameters])]
    whole = Fitted(h, values, samples, 0.0)
    return as_trims(whole, [c for c in h.terms if c.effect.name in trims or c in resting])


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
    samples = np.array(content["samples"]).reshape(len(content["samples"]), len(content["values"]))
    return Fitted(h, np.array(content["values"]), samples, 0.0)
