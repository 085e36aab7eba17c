"""What a joint has beside the standard: laws that take the place of one of its, and what its link lacks.

A law is tried where it is neutral, that is, where the simulation stays what it was, or nearly. Folds that were not
fitted choose: first to first order, then in simulation, then after a fit of all.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.descent import Linearised, descend, linearise
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.joint_fit import GAIN, folded, follows_better, gain_of, search, stated, trusted
from torchrl_athletic.diagnosis.prepare import Prepared
from torchrl_athletic.diagnosis.problem import Mask, evenly, folds_of, independent, weighed, window_cost
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.diagnosis.standard import ROOM, STILL, Seen, agreement, columns_of, has_columns
from torchrl_athletic.effects import (
    ActuationLag,
    AsymmetricFriction,
    Backlash,
    Compliance,
    Effect,
    Fingerprint,
    GravityTilt,
    Hysteresis,
    JointSpring,
    LinkComShift,
    LinkInertia,
    LinkMass,
    LoadDependentFriction,
    Parameter,
    SpeedTorqueLimit,
    StribeckFriction,
)
from torchrl_athletic.effects.signals import FEWEST

Array = NDArray[np.float64]

LAWS: tuple[Effect, ...] = (
    StribeckFriction(),
    LoadDependentFriction(),
    AsymmetricFriction(),
    Hysteresis(),
    ActuationLag(),
    SpeedTorqueLimit(),
    JointSpring(),
    LinkMass(),
    LinkInertia(),
    LinkComShift(),
    GravityTilt(),
)
GEARS: tuple[Effect, ...] = (Compliance(), Backlash())
MANY = 12
"""Values of a gear to start from at most."""
FINER = np.geomspace(0.4, 2.5, 25)
"""Stiffnesses to start from, per the one that the torques like best [1]: a resonance is missed by a few per cent."""
HINT = 0.6
"""Share of the variance that a joint's torques leave open, below which a gear must leave it to be searched for [1]."""
REPLACED: Mapping[str, tuple[str, ...]] = {
    "stribeck_friction": ("coulomb_friction",),
    "load_dependent_friction": ("coulomb_friction",),
    "asymmetric_friction": ("coulomb_friction", "viscous_friction"),
    "speed_torque_limit": ("torque_saturation",),
}
"""Standard effects that a law contains."""
INHERITED: Mapping[str, tuple[str, str]] = {
    "coulomb": ("coulomb_friction", "torque"),
    "coulomb_positive": ("coulomb_friction", "torque"),
    "coulomb_negative": ("coulomb_friction", "torque"),
    "viscous_positive": ("viscous_friction", "damping"),
    "viscous_negative": ("viscous_friction", "damping"),
    "stall_torque": ("torque_saturation", "limit"),
}
"""What a law's parameter starts from."""
SPEEDS = (0.1, 0.5)
"""Stribeck speeds to start from, per the root mean square speed [1]."""
WIDTHS = (0.03, 0.15)
"""Widths of a hysteresis to start from [rad], on a joint that travels a radian or more."""
NO_LOAD = 4.0
"""No-load speed to start from, per the root mean square speed [1]."""
SCREENED = 32
"""Windows by which laws are screened."""
ROUNDS = 2
"""Rounds of screening: what is found makes room for more."""


@dataclass(frozen=True, eq=False)
class Offer:
    """A law for one joint, or for the robot, at values to start from."""

    candidate: Candidate
    replaced: tuple[Candidate, ...]
    start: Array
    """Shape (its P,)."""


def extend(
    near: Linearised,
    prepared: Prepared,
    seen: Seen,
    deadline: Deadline,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Linearised:
    """The fit with the laws that folds ask for."""
    for k in range(ROUNDS):
        if not deadline.allows(4 * near.seconds):
            break
        chosen = _chosen(near, offers(near, prepared, seen), deadline)
        progress((k + 0.6) / ROUNDS)
        if not chosen:
            break
        better = _with(near, chosen, prepared, deadline)
        helps = follows_better(near, better)
        if not helps and len(chosen) > 1:  # they get into each other's way
            better = _with(near, chosen[:1], prepared, deadline)
            helps = follows_better(near, better)
        if not helps:
            break
        near = better
        progress((k + 1) / ROUNDS)
    return near


def with_gear(near: Linearised, prepared: Prepared, rng: np.random.Generator, deadline: Deadline) -> Linearised:
    """The fit with a gear that gives way, where the torques hint at one and folds ask for it.

    A gear is neutral nowhere near where it acts, so that it is searched for anew, with all else.
    """
    h = near.problem.hypothesis
    hints = _hints(h, prepared)
    if not hints or not deadline.allows(30 * near.seconds):
        return near
    wider = Hypothesis((*h.terms, hints[0].candidate))
    stiff = np.append(h.nominal, [p.nominal for p in hints[0].candidate.parameters])
    names = [p.name for p in hints[0].candidate.parameters]
    finer = np.ones((len(FINER), len(names)))
    finer[:, names.index("stiffness")] = FINER
    begin = [stiff, *(np.append(x, y) for x in (h.nominal, near.values) for y in hints[0].start * finer)]
    begin += [np.append(h.nominal, hint.start) for hint in hints[1:]]
    takes = tuple(dict.fromkeys(w.take for w in near.problem.windows))  # both are compared in the same steps
    found = search(wider, takes, np.stack(begin), rng, Deadline(deadline.left), agreement(wider, prepared))
    return found if stated(found) < (1 - 2 * GAIN) * stated(near) else near


def _hints(h: Hypothesis, prepared: Prepared) -> list[Offer]:
    """The gear that leaves least of what the torques of a joint leave open, if it is much less: at several values."""
    take, found = prepared.takes[0], []
    for j, name in enumerate(take.recording.joint_names):
        terms = [c for c in h.terms if j in c.effect.turns(take.model, take.address, c.joint) and has_columns(c)]
        blocks = [columns_of(c, prepared) for c in terms]
        a = np.hstack([np.concatenate([part[:, j] for part in block]) for block in blocks])
        good = np.concatenate([s.valid[:, j] for s in prepared.signals])
        if good.sum() < FEWEST:
            continue
        missing = np.concatenate([s.missing[:, j] for s in prepared.signals])[good]
        solve = np.linalg.pinv(a[good], rcond=1e-8)

        def left(y: Array, solve: Array = solve, a: Array = a[good]) -> float:
            return float(np.mean((y - a @ (solve @ y)) ** 2))

        rigid = left(missing)
        for law in GEARS:
            own = law.parameters(take.model, take.address, j)
            grid = law.grid_of(prepared.signals, j) if own else []
            prints = [law.fingerprints(s, j, grid) for s in prepared.signals]
            for k, fixed in enumerate(grid):
                bent = np.concatenate([_constant(of_piece[k])[:, j] for of_piece in prints])[good]
                start = np.array([fixed.get(p.name, p.nominal) for p in own])
                found.append(
                    (left(missing - bent) / max(rigid, 1e-300), Offer(Candidate(law, j, name, own), (), start))
                )
    found.sort(key=lambda f: f[0])
    if not found or found[0][0] > HINT:
        return []
    return [offer for _, offer in found if offer.candidate.key == found[0][1].candidate.key][:MANY]


def _constant(f: Fingerprint) -> Array:
    return f.constant if f.constant is not None else np.zeros(f.columns.shape[:2])


def offers(near: Linearised, prepared: Prepared, seen: Seen) -> list[Offer]:
    """Laws that the joints may have beside what they have; those of joints that move."""
    h, take, out = near.problem.hypothesis, prepared.takes[0], []
    have = {c.key for c in h.terms}
    for j, name in enumerate(take.recording.joint_names):
        if seen.travel[j] < STILL:
            continue
        for law in LAWS:
            own = law.parameters(take.model, take.address, j)
            where = None if law.whole_robot else name
            known = (law.name, where) in have or (law.whole_robot and j > 0)
            if known or not own or not any(law.applies(s) for s in prepared.signals):
                continue
            replaced = tuple(c for c in h.terms if c.joint == j and c.effect.name in REPLACED.get(law.name, ()))
            if len(replaced) < len(REPLACED.get(law.name, ())):
                continue
            bounded = tuple(_bounded(p, j, seen) for p in own)
            candidate = Candidate(law, j, where, bounded)
            for shape in _shapes(law, j, seen):
                start = [shape.get(p.name, _inherited(p, replaced, h, near.values)) for p in bounded]
                low, high = np.array([[p.lower, p.upper] for p in bounded]).T
                out.append(Offer(candidate, replaced, np.clip(start, low, high)))
    return out


def _shapes(law: Effect, j: int, seen: Seen) -> list[dict[str, float]]:
    """Values of the parameters that shape a law, where it has such."""
    if law.name == "stribeck_friction":
        return [{"stribeck_speed": share * float(seen.speed[j])} for share in SPEEDS]
    if law.name == "hysteresis":
        return [{"width": width * min(float(seen.travel[j]), 1.0)} for width in WIDTHS]
    if law.name == "speed_torque_limit":
        return [{"no_load_speed": NO_LOAD * float(seen.speed[j])}]
    return [{}]


def _inherited(p: Parameter, replaced: Sequence[Candidate], h: Hypothesis, values: Array) -> float:
    effect, name = INHERITED.get(p.name, ("", ""))
    for c in replaced:
        if c.effect.name == effect:
            own = h.values_of(c, values)
            return float(own[[q.name for q in c.parameters].index(name)])
    return p.nominal


def _bounded(p: Parameter, j: int, seen: Seen) -> Parameter:
    """With a unit and a bound of what the recordings show, for torques and dampings."""
    size = {
        "N·m": seen.torque,
        "N": seen.torque,
        "N·m·s/rad": seen.torque / seen.speed,
        "N·s/m": seen.torque / seen.speed,
    }
    if p.unit not in size:
        return p
    most = ROOM * float(size[p.unit][j])
    low, high = max(p.lower, -most), min(p.upper, most)
    return replace(p, lower=min(low, p.nominal), upper=max(high, p.nominal), scale=0.02 * float(size[p.unit][j]))


def _joined(near: Linearised, chosen: Sequence[Offer]) -> tuple[Hypothesis, Array]:
    """Hypothesis and values with some laws."""
    h = near.problem.hypothesis
    gone = [c for offer in chosen for c in offer.replaced]
    kept = tuple(c for c in h.terms if c not in gone)
    parts = [h.values_of(c, near.values) for c in kept] + [offer.start for offer in chosen]
    return Hypothesis((*kept, *(offer.candidate for offer in chosen))), np.concatenate(parts)


def _free(h: Hypothesis) -> Mask:
    return np.asarray(h.bounds[1] > h.bounds[0])


def _with(near: Linearised, chosen: Sequence[Offer], prepared: Prepared, deadline: Deadline) -> Linearised:
    """The fit with some laws."""
    h, x = _joined(near, chosen)
    problem = replace(near.problem, hypothesis=h, torques=near.problem.torques and agreement(h, prepared))
    x = descend(weighed(problem, x), x, _free(h), 2, deadline)
    return trusted(linearise(weighed(problem, x), x, _free(h)))


def _chosen(near: Linearised, tried: Sequence[Offer], deadline: Deadline) -> list[Offer]:
    """Choose for each joint the law that helps folds most, the best first; no joint has two at a time."""
    problem, mask = near.problem, evenly(near.problem, SCREENED)
    few = near.alone().of_windows(mask)
    fold, apart = folds_of(problem)[mask], independent(few.problem)
    before = _cost(few, folded(few, [_nothing(few)], fold, first_order=True))[0]
    gains: list[tuple[float, Offer]] = []
    seconds = 0.0
    for offer in tried:
        if not deadline.allows(1.3 * seconds):
            break
        begin = time.monotonic()
        beside = _beside(few, offer)
        after = _cost(few, folded(beside, [_nothing(beside)], fold, first_order=True))[0]
        if (gain := gain_of(before, after, apart)) > 0:
            gains.append((gain, offer))
        seconds = time.monotonic() - begin
    best: dict[int, tuple[float, Offer]] = {}
    for gain, offer in sorted(gains, key=lambda g: -g[0]):
        best.setdefault(offer.candidate.joint, (gain, offer))
    chosen: list[tuple[float, Offer]] = []
    before = _cost(few, folded(few, [_nothing(few)], fold))[0]
    for _, offer in best.values():
        beside = _beside(few, offer)
        if (gain := gain_of(before, _cost(few, folded(beside, [_nothing(beside)], fold))[0], apart)) > 0:
            chosen.append((gain, offer))
    return [offer for _, offer in sorted(chosen, key=lambda g: -g[0])]


def _nothing(near: Linearised) -> Mask:
    return np.zeros(int(near.free.sum()), dtype=bool)


def _cost(near: Linearised, square: Array) -> Array:
    return window_cost(near.problem, square)


def _beside(near: Linearised, offer: Offer) -> Linearised:
    """Add a law's parameters to what is linearised, to first order."""
    h, x = _joined(near, [offer])
    old = near.problem.hypothesis
    problem, free = replace(near.problem, hypothesis=h), _free(h)
    own = np.zeros(len(x), dtype=bool)
    h.values_of(offer.candidate, own)[:] = True
    new = linearise(problem, x, free & own)
    column = np.full(len(near.values), -1)
    column[near.free] = np.arange(int(near.free.sum()))
    columns = np.empty((len(new.errors), int(free.sum())))
    at = np.cumsum(free) - 1
    index = np.arange(len(x))
    for c in h.terms[:-1]:
        for here, there in zip(h.values_of(c, index), old.values_of(c, np.arange(len(near.values))), strict=True):
            if free[here]:
                columns[:, at[here]] = near.columns[:, column[there]]
    columns[:, at[free & own]] = new.columns
    nothing, damped = np.zeros((0, int(free.sum()))), ~own[free]  # a fold that stays says nothing against a law
    return Linearised(problem, x, free, new.errors, columns, nothing[:, 0], nothing, new.seconds, near.ridges, damped)
