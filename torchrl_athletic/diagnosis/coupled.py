"""Drives that two joints turn, where the torques of both ask for one: before a fit, as nothing leads there later.

A fit without it stretches what two joints do have, until no slope points at the drive any more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.prepare import Prepared
from torchrl_athletic.diagnosis.screen import Candidate, bounded_least_squares
from torchrl_athletic.diagnosis.standard import FEWEST, NONLINEAR, ROOM, Seen, columns_of
from torchrl_athletic.effects import CoupledDrive, Parameter
from torchrl_athletic.effects.coupling import RATIOS

Array = NDArray[np.float64]

LEFT = 0.3
"""Share of what the torques of two joints leave open, below which a drive of both must leave it [1; tuned]. A coupled
wrist leaves 0.05, the joints of ten other robots 0.7 to 1."""


def with_coupled_drives(h: Hypothesis, prepared: Prepared, seen: Seen) -> Hypothesis:
    """The standard joints, and drives that the torques ask for beside them: of a joint the one that leaves less.

    Torques that a controller makes say nothing of it before its gains are known. Their ratio is held, and so are the
    torque scales of the two joints: a wrist is light, and with other scales another ratio moves it alike.
    """
    take, found = prepared.takes[0], []
    if any(part.recording.position_target is not None for t in prepared.takes for part in t.parts):
        return h
    for j, name in enumerate(take.recording.joint_names):
        tried = []
        for ratio in RATIOS:
            effect = CoupledDrive((ratio,))
            if own := effect.parameters(take.model, take.address, j):
                drive = Candidate(effect, j, name, tuple(_bounded(p, j, ratio, seen) for p in own))
                joints = effect.turns(take.model, take.address, j)
                tried.append((left_by(drive, joints, h, prepared), ratio, drive))
        if tried and min(tried)[0] < LEFT:
            found.append(min(tried)[2])
    shared = {j for c in found for j in c.effect.turns(take.model, take.address, c.joint)}
    terms = [_held(c) if c.effect.name == "torque_scale" and c.joint in shared else c for c in h.terms]
    return Hypothesis((*terms, *found))


def _held(c: Candidate) -> Candidate:
    return replace(c, parameters=tuple(replace(p, lower=p.nominal, upper=p.nominal) for p in c.parameters))


def _bounded(p: Parameter, j: int, ratio: float, seen: Seen) -> Parameter:
    """The ratio as it is, torque and damping in units of what the recordings show."""
    torque, damping = float(seen.torque[j]), float(seen.torque[j] / seen.speed[j])
    if p.name == "ratio":
        return replace(p, nominal=ratio, lower=ratio, upper=ratio)
    if p.name == "armature":
        return p
    size = torque if p.name == "torque" else damping
    return replace(p, upper=ROOM * size, scale=0.02 * size)


def left_by(drive: Candidate, joints: Sequence[int], h: Hypothesis, prepared: Prepared) -> float:
    """Share of what the torques of two joints leave open beside the standard, that a drive of both leaves open."""
    opens, besides = [], []
    of_drive = columns_of(drive, prepared)
    for j in joints:
        terms = [c for c in h.terms if c.joint == j and c.effect.name not in NONLINEAR]
        good = np.concatenate([s.valid[:, j] for s in prepared.signals])
        if good.sum() < FEWEST:
            return 1.0
        a = np.hstack([np.concatenate([part[:, j] for part in columns_of(c, prepared)]) for c in terms])[good]
        b = np.concatenate([part[:, j] for part in of_drive])[good]
        missing = np.concatenate([s.missing[:, j] for s in prepared.signals])[good]
        solve = np.linalg.pinv(a, rcond=1e-8)
        left, beside = (x - a @ (solve @ x) for x in (missing, b))
        unit = max(float(np.linalg.norm(left)), 1e-300)
        opens.append(left / unit)
        besides.append(beside / unit)
    y, b = np.concatenate(opens), np.concatenate(besides)
    zero = np.zeros(b.shape[1])
    x = bounded_least_squares(b.T @ b, b.T @ y, zero, zero + np.inf)
    return float(np.sum((y - b @ x) ** 2) / np.sum(y**2))
