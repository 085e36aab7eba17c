"""Drives that two joints turn, where the torques of both ask for one: before a fit, as nothing leads there later.

A fit without it stretches what two joints do have, until no slope points at the drive any more.
"""

from __future__ import annotations

from dataclasses import replace

from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.prepare import Prepared
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.diagnosis.standard import ROOM, Seen
from torchrl_athletic.effects import CoupledDrive, Parameter


def with_coupled_drives(h: Hypothesis, prepared: Prepared, seen: Seen) -> Hypothesis:
    """The standard joints, and drives that the torques ask for beside them.

    Their ratio is held, and so are the torque scales of the two joints: a wrist is light, and with other scales another
    ratio moves it alike.
    """
    take, found = prepared.takes[0], []
    for j, name in enumerate(take.recording.joint_names):
        own = CoupledDrive().parameters(take.model, take.address, j)
        for fixed in CoupledDrive().grid_of(prepared.signals, j) if own else ():
            bounded = tuple(_bounded(p, j, fixed["ratio"], seen) for p in own)
            found.append(Candidate(CoupledDrive((fixed["ratio"],)), j, name, bounded))
    shared = {j for c in found for j in c.effect.turns(take.model, take.address, c.joint)}
    terms = [_held(c) if c.effect.name == "torque_scale" and c.joint in shared else c for c in h.terms]
    return Hypothesis((*terms, *found))


def _held(c: Candidate) -> Candidate:
    return replace(c, parameters=tuple(replace(p, lower=p.nominal, upper=p.nominal) for p in c.parameters))


def _bounded(p: Parameter, j: int, ratio: float, seen: Seen) -> Parameter:
    """The ratio as it is; the others up to what the recordings allow, as those of a joint of its own."""
    if p.name == "ratio":
        return replace(p, nominal=ratio, lower=ratio, upper=ratio)
    torque = float(seen.torque[j])
    if p.name == "armature":
        return replace(p, upper=max(p.upper, ROOM * torque / float(seen.acceleration[j])))
    size = torque if p.name == "torque" else torque / float(seen.speed[j])
    return replace(p, upper=ROOM * size, scale=0.02 * size)
