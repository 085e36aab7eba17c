"""Long logs cut to stretches that lie evenly in them: more of the same motion says little more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchrl_athletic.recordings.recording import BEGAN, MEAN_READING, Recording

STRETCH = 6.0
"""Time of one stretch [s]."""
LEAST = 10.0
"""Time that is kept of all recordings together, whatever it takes [s]."""


def cut_stretches(recordings: Sequence[Recording], seconds: float, values: float = np.inf) -> list[Recording]:
    """Stretches of six seconds, evenly over all recordings, or the recordings themselves where they are short enough.

    Args:
        recordings: Takes of the same joints.
        seconds: Time that is kept of all of them together [s].
        values: Samples times joints that are kept at most.

    Example:
        >>> still = np.zeros((36000, 1))
        >>> hour = Recording(np.arange(36000) / 10, ("hinge",), still, torque_command=still)
        >>> kept = cut_stretches([hour], 60.0)
        >>> len(kept), round(sum(r.duration for r in kept))
        (10, 59)
    """
    total = sum(r.duration for r in recordings)
    size = sum(r.num_samples * r.num_joints for r in recordings)
    most = max(min(seconds, total * values / max(size, 1)), LEAST)
    if total <= most:
        return list(recordings)
    count = max(1, int(most / STRETCH))
    ends = np.cumsum([r.duration for r in recordings])
    middles = (np.arange(count) + 0.5) * total / count
    out = []
    for r, end in zip(recordings, ends, strict=True):
        own = middles[(middles >= end - r.duration) & (middles < end)] - (end - r.duration)
        length = min(STRETCH, r.duration / max(len(own), 1))
        notes = {**r.metadata, BEGAN: r.began, MEAN_READING: r.mean_reading}
        for middle in own:
            first = r.time[0] + min(max(middle - length / 2, 0.0), r.duration - length)
            low, high = np.searchsorted(r.time, [first, first + length])
            out.append(replace(r.slice(int(low), int(high)), metadata=notes))
    return out
