"""What to show first: the joints, the maps and the seconds in which the error speaks most clearly."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.result import Answer, Finding, Overlay, RegimeMap
from torchrl_athletic.effects import CATALOGUE


def joint_order(answer: Answer, joints: Sequence[str]) -> list[str]:
    """``joints`` with those of findings first, then by share of the error, then as they came."""
    found = [f.joint for f in answer.findings if f.joint is not None]
    shares: dict[str, float] = {}
    for location in answer.locations:
        shares[location.joint] = shares.get(location.joint, 0.0) + location.share_of_error
    rank = {joint: i for i, joint in reversed(list(enumerate(found)))}
    return sorted(dict.fromkeys(joints), key=lambda joint: (rank.get(joint, len(found)), -shares.get(joint, 0.0)))


def visible_energy(regime_map: RegimeMap) -> float:
    """Mean square of the missing torque before, beyond what its bootstrap band leaves open [torque_unit²]."""
    half_band = np.ptp(regime_map.before_band, axis=1) / 2
    energy = regime_map.before**2 - half_band**2
    return float(np.nanmean(energy)) if np.isfinite(energy).any() else 0.0


def by_telling(maps: Sequence[RegimeMap]) -> list[RegimeMap]:
    """Maps with the most visible missing torque first."""
    return sorted(maps, key=visible_energy, reverse=True)


def map_of(finding: Finding, maps: Sequence[RegimeMap]) -> RegimeMap | None:
    """The map along the quantity that gives a finding away; of the whole robot's, that of the joint that shows it most.

    An effect that the catalogue does not have is looked for where its regime says. None where its joint has no map.
    """
    own = by_telling([m for m in maps if finding.joint in (None, m.joint)])
    shows_in = [e.shows_in for e in CATALOGUE if e.name == finding.effect]
    return next(
        (m for wanted in (shows_in, finding.regime) for m in own if m.feature in wanted),
        own[0] if own else None,
    )


def first_map(answer: Answer, maps: Sequence[RegimeMap], joint: str) -> RegimeMap:
    """The map of a joint that shows its most probable finding, else the one with the most visible missing torque."""
    own = [m for m in maps if m.joint == joint]
    found = next((f for f in answer.findings if f.joint in (joint, None)), None)
    shown = map_of(found, own) if found else None
    return shown or by_telling(own)[0]


def rms(values: NDArray[np.float64]) -> float:
    """Root mean square of the finite values, NaN where there are none: a simulation may have run away."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else math.nan


def telling_overlays(overlays: Sequence[Overlay]) -> list[Overlay]:
    """Recordings kept aside first; among equals the one whose error before the correction is largest."""

    def key(overlay: Overlay) -> tuple[bool, float]:
        motion = np.nanstd(overlay.measured, axis=0) + 1e-12
        error = [rms(e) for e in (overlay.before - overlay.measured).T]
        return not overlay.heldout, -float(np.mean(np.nan_to_num(error) / motion))

    return sorted(overlays, key=key)


def telling_window(overlay: Overlay, seconds: float = 3.0) -> slice:
    """The ``seconds`` with the largest error before the correction, each joint weighed by its own mean."""
    error = overlay.before - overlay.measured
    error = np.where(np.isfinite(error), error, 0.0) ** 2
    weighed = (error / (error.mean(axis=0) + 1e-30)).sum(axis=1)
    stop = np.searchsorted(overlay.time, overlay.time + seconds)
    full = overlay.time + seconds <= overlay.time[-1]
    if not full.any():
        return slice(0, len(overlay.time))
    total = np.concatenate(([0.0], np.cumsum(weighed)))
    start = int(np.argmax(np.where(full, total[stop] - total[:-1], -np.inf)))
    return slice(start, int(stop[start]))
