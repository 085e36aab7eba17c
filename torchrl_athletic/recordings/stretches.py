"""Long logs cut to stretches that lie evenly in them: more of the same motion says little more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.recording import BEGAN, MEAN_READING, Recording

STRETCH = 6.0
"""Time of one stretch [s]."""
LEAST = 10.0
"""Time that is kept of all recordings together, whatever it takes [s]."""
PAUSE = 3.0
"""Periods between two samples that count at most: a longer pause was not recorded."""


def cut_stretches(recordings: Sequence[Recording], seconds: float, values: float = np.inf) -> list[Recording]:
    """Stretches of six seconds, evenly over all that was recorded, or the recordings where they are short enough.

    Args:
        recordings: Takes of the same joints, with or without pauses.
        seconds: Time that is kept of all of them together [s]; pauses do not count.
        values: Samples times joints that are kept at most.

    Example:
        >>> still = np.zeros((36000, 1))
        >>> hour = Recording(np.arange(36000) / 10, ("hinge",), still, torque_command=still)
        >>> kept = cut_stretches([hour], 60.0)
        >>> len(kept), round(sum(r.duration for r in kept))
        (10, 59)
    """
    clocks = [_recorded(r.time) for r in recordings]
    total = sum(clock[-1] for clock in clocks)
    size = sum(r.num_samples * r.num_joints for r in recordings)
    most = max(min(seconds, total * values / max(size, 1)), LEAST)
    if total <= most:
        return list(recordings)
    count = max(1, int(most / STRETCH))
    ends = np.cumsum([clock[-1] for clock in clocks])
    middles = (np.arange(count) + 0.5) * total / count
    out = []
    for r, clock, end in zip(recordings, clocks, ends, strict=True):
        own = middles[(middles >= end - clock[-1]) & (middles < end)] - (end - clock[-1])
        length = min(STRETCH, clock[-1] / max(len(own), 1))
        notes = {**r.metadata, BEGAN: r.began, MEAN_READING: r.mean_reading}
        for middle in own:
            first = min(max(middle - length / 2, 0.0), clock[-1] - length)
            low, high = np.searchsorted(clock, [first, first + length])
            out.append(replace(r.slice(int(low), int(high)), metadata=notes))
    return out


def _recorded(time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Time of each sample since the first, less the pauses [s]. Shape (T,)."""
    steps = np.diff(time)
    return np.concatenate([[0.0], np.cumsum(np.minimum(steps, PAUSE * np.median(steps)))])
