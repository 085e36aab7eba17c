"""Long logs cut to stretches that lie evenly in them: more of the same motion says little more."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.recording import BEGAN, MEAN_READING, Recording
from torchrl_athletic.recordings.resampling import GAP_FACTOR, gap_rows

STRETCH = 6.0
"""Time of one stretch [s]."""
LEAST = 10.0
"""Time that is kept of all recordings together, whatever it takes [s]."""
PAUSE = 1.0
"""Time without a sample from which on nothing was recorded, where it is also a gap [s]."""


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
    clocks = [recorded_time(r) for r in recordings]
    total = sum(clock[-1] for clock in clocks)
    size = sum(r.num_samples * r.num_joints for r in recordings)
    most = max(min(seconds, total * values / max(size, 1)), LEAST)
    if total <= most:
        return list(recordings)
    count = max(math.ceil(LEAST / STRETCH), int(most / STRETCH))
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
            low = min(int(low), r.num_samples - 2)  # two samples make a recording, however rare they are
            out.append(replace(r.slice(low, max(int(high), low + 2)), metadata=notes))
    return out


def recorded_time(recording: Recording) -> NDArray[np.float64]:
    """Time of each sample since the first, in which no pause counts for more than a usual step [s]. Shape (T,).

    Example:
        >>> still = np.zeros((4, 1))
        >>> recorded_time(Recording(np.array([0.0, 0.1, 9.0, 9.1]), ("hinge",), still, torque_command=still)).round(3)
        array([0. , 0.1, 0.2, 0.3])
    """
    steps = np.diff(recording.time)
    usual = float(np.median(steps))
    rows = gap_rows(recording.time, max(PAUSE, GAP_FACTOR * usual))
    paused = np.zeros(recording.num_samples)
    paused[rows + 1] = steps[rows] - usual
    return recording.time - recording.time[0] - np.cumsum(paused)
