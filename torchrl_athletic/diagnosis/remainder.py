"""What the findings leave, said in words without naming an effect of the catalogue."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import coherence, welch

from torchrl_athletic.diagnosis.screen import Bank
from torchrl_athletic.diagnosis.search import Scored
from torchrl_athletic.effects import Signals, project_recording
from torchrl_athletic.effects.effect import torque_unit
from torchrl_athletic.recordings import sensor_noise

Array = NDArray[np.float64]

FINE_KERNEL = 0.003
SEGMENT = 1.0
"""Length of a spectral segment [s]."""
COHERENT = 3.0
"""Coherence with the command over what chance gives, from which on missing torque is a response and no noise."""


@dataclass(frozen=True)
class Flexibility:
    """Missing torque above the band of motion that answers to the command, as a rigid robot's does not."""

    joint: str
    band: tuple[float, float]
    """[Hz]."""
    rms: float
    """Coherent part of the missing torque [N·m, N]."""
    coherence: float
    """Mean coherence with the command in the band, 0..1."""
    noise: float
    """What sensor noise explains there [N·m, N]."""
    unit: str


def remarks_on(train: Sequence[Signals], heldout: Sequence[Signals], best: Scored, band: float) -> tuple[str, ...]:
    """What stays unexplained above the band of motion, in sentences.

    Args:
        train: Takes that were fitted.
        heldout: Takes kept aside.
        best: The findings.
        band: Upper end of the band of motion [Hz].
    """
    out = []
    for where, takes in (("The recordings kept aside leave", heldout), ("The fitted recordings leave", train)):
        found = [f for f in flexibilities(takes, best, band)] if takes else []
        named = {f.joint for f in found}
        for f in found:
            out.append(
                f"{where} a flexibility unexplained at {f.joint}: from {f.band[0]:.0f} to {f.band[1]:.0f} Hz, faster "
                f"than the robot moves, {f.rms:.2g} {f.unit} of what is missing still answer to the command "
                f"(coherence {f.coherence:.2f}, sensor noise {f.noise:.1g} {f.unit}). A rigid model cannot follow "
                "that; pulses or a chirp with a second encoder on the link would tell what gives way."
            )
        if named:
            break
    return tuple(out)


def flexibilities(takes: Sequence[Signals], best: Scored, band: float) -> list[Flexibility]:
    """Joints whose missing torque answers to the command above the band of motion, after the findings."""
    per_joint: dict[int, list[tuple[Array, Array, Array, float, float]]] = {}
    for s in takes:
        kernel = max(FINE_KERNEL, 1.2 / s.recording.rate)
        if 0.13 / kernel < 3 * band or s.recording.duration < 8 * SEGMENT:
            continue
        fine = project_recording(s.recording, s.nominal, *sensor_noise(s.recording), kernel=kernel)
        left = _left(fine, best)
        step = float(np.median(np.diff(fine.time)))
        size = int(SEGMENT / step)
        for j in range(fine.num_joints):
            if fine.command[:, j].std() < 1e-9:
                continue
            f, c = coherence(left[:, j], fine.command[:, j], 1 / step, nperseg=size)
            _, p = welch(left[:, j], 1 / step, nperseg=size)
            inside = (f > 2 * band) & (f < 0.13 / kernel)
            chance = size / len(left) * 1.5
            per_joint.setdefault(j, []).append(
                (f[inside], np.where(np.isfinite(c), c, 0.0)[inside], p[inside], chance, fine.noise[j])
            )
    out = []
    for j, parts in per_joint.items():
        f, *_, noise = parts[0]
        if any(len(part[0]) != len(f) for part in parts):
            continue
        c, p = np.mean([part[1] for part in parts], axis=0), np.mean([part[2] for part in parts], axis=0)
        chance = float(np.mean([part[3] for part in parts]))  # a short take has fewer segments, and more of it
        answers = c > COHERENT * chance / np.sqrt(len(parts))
        coherent = float(np.sqrt((c * p)[answers].sum() * (f[1] - f[0]))) if answers.sum() > 3 else 0.0
        mean = float((c * p).sum() / p.sum())
        if coherent > 3 * noise and mean > chance * 2:
            low, high = np.quantile(f[answers], [0.05, 0.95])
            s = takes[0]
            name, unit = s.recording.joint_names[j], torque_unit(s.nominal, s.address, j)
            out.append(Flexibility(name, (float(low), float(high)), coherent, float(c[answers].mean()), noise, unit))
    return out


def _left(s: Signals, best: Scored) -> Array:
    bank = Bank([s], [])
    atoms = [bank.add(a.candidate, a.fixed) for a in best.fit.terms]
    return bank.rows(bank.fit([a for a in atoms if a is not None]))
