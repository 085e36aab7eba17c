"""Readings that repeat or leave for a moment, told by their neighbours."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from torchrl_athletic.recordings.quality import Quality, check_quality
from torchrl_athletic.recordings.recording import Recording
from torchrl_athletic.recordings.resampling import gap_rows

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUNDS = 4
"""Misread samples make a log look noisy, and hide others beside them: so often it is looked at, at most."""
SIDE = 2
"""Good readings needed on each side: with one the cubic would be carried on beyond it."""
MISREAD = ("frozen", "dropout")
"""Reasons to mask of :func:`check_quality` that are wrong readings."""


def mended(
    recording: Recording, quality: Quality, longest: float, torque_limit: ArrayLike | None = None
) -> tuple[Recording, Quality]:
    """A take with its brief misreadings bridged, and what is known of it then; themselves where there are none.

    Position and velocity change. The command, or the torque beside them, stays as logged, also where it is as old.

    Args:
        recording: One take.
        quality: What :func:`check_quality` found of it.
        longest: Time between good readings that may be bridged [s].
        torque_limit: As for :func:`check_quality`.

    Returns:
        The take, and its quality: warnings are those of the log, noise that of the mended take, and ``masks`` hold the
        misreadings that are left.
    """
    out, found = recording, quality
    misread = {reason: quality.masks[reason] for reason in MISREAD}
    for _ in range(ROUNDS):
        wrong = np.logical_or.reduce(list(misread.values()))
        short = brief(recording.time, wrong, longest)
        if not short.any():
            return recording, quality
        out = bridged(recording, wrong, short)
        found = check_quality(out, torque_limit)
        more = {reason: mask | found.masks[reason] for reason, mask in misread.items()}
        if all((more[reason] == mask).all() for reason, mask in misread.items()):
            break
        misread = more
    left = {reason: mask & ~short for reason, mask in misread.items()}
    return out, replace(
        _no_noisier(found, quality),
        masks={**found.masks, **left},
        warnings=quality.warnings,
        bridged=tuple(int(n) for n in short.sum(0)),
    )


def _no_noisier(found: Quality, quality: Quality) -> Quality:
    """What is known of the mended take, with the log's own encoder, and its noise where that is less.

    Bridges lie between the counts of an encoder, so that what is left of a joint at rest can look like a coarse one.
    """
    less = found.position_noise <= quality.position_noise
    velocity = found.velocity_noise
    if velocity is not None and quality.velocity_noise is not None:
        velocity = np.minimum(velocity, quality.velocity_noise)
    return replace(
        found,
        encoder_step=quality.encoder_step,
        position_noise=np.where(less, found.position_noise, quality.position_noise),
        noise_correlation=np.where(less, found.noise_correlation, quality.noise_correlation),
        velocity_noise=velocity,
    )


def brief(time: Array, misread: Mask, longest: float) -> Mask:
    """Which misread samples have good ones on both sides, at most so long apart, and no gap between. Shape (T, J).

    Args:
        time: Stamps [s]. Shape (T,).
        misread: Samples that are not to be trusted. Shape (T, J).
        longest: Time between the good readings before and after them [s].

    Example:
        >>> misread = np.zeros((9, 1), dtype=bool)
        >>> misread[[2, 4, 5]] = True
        >>> np.flatnonzero(brief(np.arange(9) / 100, misread, 0.02))
        array([2])
    """
    out = np.zeros_like(misread)
    for part in _parts(time):
        wrong, stamp = misread[part], time[part]
        place, good = np.arange(len(stamp))[:, None], np.cumsum(~wrong, axis=0)
        inside = (good >= SIDE) & (good[-1] - good >= SIDE)
        before = np.maximum.accumulate(np.where(wrong, 0, place))
        after = np.minimum.accumulate(np.where(wrong, len(stamp) - 1, place)[::-1])[::-1]
        out[part] = wrong & inside & (stamp[after] - stamp[before] <= longest * (1 + 1e-6))
    return out


def bridged(recording: Recording, misread: Mask, short: Mask) -> Recording:
    """The recording with some of its misreadings where a cubic through the good readings passes; itself without any.

    Args:
        recording: One take.
        misread: Samples that are not to be trusted. Shape (T, J).
        short: Which of them are bridged (:func:`brief`). Shape (T, J).
    """
    if not short.any():
        return recording
    velocity = recording.velocity
    return replace(
        recording,
        position=_through(recording.time, recording.position, misread, short),
        velocity=None if velocity is None else _through(recording.time, velocity, misread, short),
    )


def _through(time: Array, readings: Array, misread: Mask, short: Mask) -> Array:
    out = readings.copy()
    for part in _parts(time):
        for j in np.flatnonzero(short[part].any(0)):
            good, rows = ~misread[part, j], short[part, j]
            out[part, j][rows] = CubicSpline(time[part][good], readings[part, j][good])(time[part][rows])
    return out


def _parts(time: Array) -> Iterator[slice]:
    """Between gaps."""
    edges = [0, *(gap_rows(time) + 1), len(time)]
    return (slice(a, b) for a, b in itertools.pairwise(edges))
