"""Readings that repeat or leave for a moment, told by their neighbours: between two samples no joint jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from torchrl_athletic.recordings.recording import Recording

Mask = NDArray[np.bool_]


def brief(time: NDArray[np.float64], misread: Mask, longest: float) -> Mask:
    """Which misread samples have good ones on both sides, at most so long apart. Shape (T, J).

    Args:
        time: Stamps [s]. Shape (T,).
        misread: Samples that are not to be trusted. Shape (T, J).
        longest: Time between the good readings before and after them [s].

    Example:
        >>> misread = np.array([[True], [False], [True], [False], [True], [True], [False]])
        >>> brief(np.arange(7) / 100, misread, 0.02).T
        array([[False, False,  True, False, False, False, False]])
    """
    place = np.arange(len(time))[:, None]
    before = np.maximum.accumulate(np.where(misread, -1, place))
    after = np.minimum.accumulate(np.where(misread, len(time), place)[::-1])[::-1]
    inside = (before >= 0) & (after < len(time))
    apart = time[np.minimum(after, len(time) - 1)] - time[np.maximum(before, 0)]
    return np.asarray(misread & inside & (apart <= longest * (1 + 1e-6)), dtype=np.bool_)


def bridged(recording: Recording, misread: Mask, brief: Mask) -> Recording:
    """The recording with its brief misreadings where a cubic through the good readings passes; itself without any.

    Args:
        recording: One take.
        misread: Samples that are not to be trusted. Shape (T, J).
        brief: Which of them are bridged (:func:`brief`). Shape (T, J).
    """
    if not brief.any():
        return recording
    velocity = recording.velocity
    return replace(
        recording,
        position=_through(recording.time, recording.position, misread, brief),
        velocity=None if velocity is None else _through(recording.time, velocity, misread, brief),
    )


def _through(
    time: NDArray[np.float64], readings: NDArray[np.float64], misread: Mask, brief: Mask
) -> NDArray[np.float64]:
    out = readings.copy()
    for j in np.flatnonzero(brief.any(0)):
        good, rows = ~misread[:, j], brief[:, j]
        out[rows, j] = CubicSpline(time[good], readings[good, j])(time[rows])
    return out
