"""Takes on a uniform grid, and takes without gaps: nothing is invented where nothing was logged."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.base import base_pose
from torchrl_athletic.recordings.recording import Recording, RecordingError

GAP_FACTOR = 5.0
"""A step longer than this many median steps is a gap: nothing is known of what happened in it."""


def resample(recording: Recording, step: float, max_gap: float | None = None) -> Recording:
    """Put a take on the uniform grid t0, t0 + step, ...

    - Position: cubic Hermite through positions and velocities. Without a velocity channel, Akima's cubic: a joint at
      rest stays at rest as with PCHIP, but turning points are not flattened.
    - Velocity and measured torque: linear.
    - Command: the zero-order hold is averaged exactly over each new interval [t, t + step), which keeps its impulse and
      its timing. Sampling it, or averaging about the new stamp, would shift it by half a sample, and that looks like
      missing physics. Past its last stamp the last command is held.

    Args:
        recording: Any stamps, without a gap.
        step: Step of the new grid [s].
        max_gap: Longest step that is still interpolated [s]. None: five median steps.

    Raises:
        RecordingError: If ``step`` does not fit the take, or if there is a gap, since positions in it would be made up.

    Example:
        >>> import numpy as np
        >>> time = np.arange(0.0, 1.0, 0.01)
        >>> take = Recording(time, ("hinge",), np.sin(time)[:, None], torque_command=time[:, None])
        >>> resample(take, 0.02).torque_command[:3, 0].round(3)  # means of 0.00 and 0.01, of 0.02 and 0.03, ...
        array([0.005, 0.025, 0.045])
    """
    if not 0 < step <= recording.duration:
        raise RecordingError(
            f"{recording.source}: step is {step} s, but the take lasts {recording.duration:.3f} s. Give a step in "
            "seconds between 0 and that, such as 0.005 for 200 Hz."
        )
    gaps = gap_rows(recording.time, max_gap)
    if len(gaps):
        row = int(gaps[0])
        raise RecordingError(
            f"{recording.source}: nothing was logged between {recording.time[row]:.3f} s and "
            f"{recording.time[row + 1]:.3f} s (row {row}; {len(gaps)} such gaps). Call split_at_gaps first and "
            "resample the pieces."
        )
    count = int(np.floor(recording.duration / step * (1 + 1e-12) + 1e-9)) + 1
    grid = recording.time[0] + step * np.arange(count)

    def linear(values: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        return None if values is None else np.column_stack([np.interp(grid, recording.time, v) for v in values.T])

    def held(values: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        return None if values is None else _mean_of_hold(recording.time, values, grid, step)

    base = linear(base_pose(recording))
    return replace(
        recording,
        time=grid,
        position=_position_at(recording, grid),
        velocity=linear(recording.velocity),
        torque_command=held(recording.torque_command),
        position_target=held(recording.position_target),
        torque_measured=linear(recording.torque_measured),
        base_position=None if base is None else base[:, :3],
        base_orientation=None if base is None else base[:, 3:] / np.linalg.norm(base[:, 3:], axis=1, keepdims=True),
    )


def split_at_gaps(recording: Recording, max_gap: float | None = None) -> list[Recording]:
    """The pieces between the gaps, each a take of its own whose ``source`` says which rows it holds.

    A lone sample between two gaps is no take: it is left out, and a warning counts such samples.

    Args:
        recording: Any take.
        max_gap: Longest step that is still one take [s]. None: five median steps.

    Raises:
        RecordingError: If no two samples are closer than ``max_gap``.
    """
    cuts = gap_rows(recording.time, max_gap) + 1
    if len(cuts) == 0:
        return [recording]
    bounds = np.concatenate(([0], cuts, [recording.num_samples]))
    pieces = [(int(start), int(stop)) for start, stop in pairwise(bounds) if stop - start > 1]
    alone = recording.num_samples - sum(stop - start for start, stop in pieces)
    if not pieces:
        raise RecordingError(
            f"{recording.source}: no two samples are closer than max_gap = {max_gap} s; the median step is "
            f"{1 / recording.rate:.4f} s. Allow a longer max_gap, in seconds."
        )
    if alone:
        warnings.warn(
            f"{recording.source}: {alone} samples stand alone between two gaps and are left out.", stacklevel=2
        )
    return [
        replace(recording.slice(start, stop), source=f"{recording.source} [rows {start} to {stop - 1}]")
        for start, stop in pieces
    ]


def gap_rows(time: NDArray[np.float64], max_gap: float | None = None) -> NDArray[np.intp]:
    """Rows after which more than ``max_gap`` [s] is missing; None: :data:`GAP_FACTOR` median steps. Shape (G,)."""
    step = np.diff(time)
    limit = GAP_FACTOR * float(np.median(step)) if max_gap is None else max_gap
    rows: NDArray[np.intp] = np.flatnonzero(step > limit)
    return rows


def _position_at(recording: Recording, grid: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.interpolate import Akima1DInterpolator, CubicHermiteSpline  # 0.2 s that no import need pay

    within = np.minimum(grid, recording.time[-1])
    if recording.velocity is not None:
        spline = CubicHermiteSpline(recording.time, recording.position, recording.velocity)
    else:
        spline = Akima1DInterpolator(recording.time, recording.position)
    return np.asarray(spline(within), dtype=np.float64)


def _mean_of_hold(
    time: NDArray[np.float64], values: NDArray[np.float64], grid: NDArray[np.float64], step: float
) -> NDArray[np.float64]:
    """Mean of the zero-order hold over [grid, grid + step). Shape (len(grid), J)."""
    edges = np.append(grid, grid[-1] + step)
    knots = np.append(time, max(edges[-1], time[-1]) + step)
    impulse = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(values * np.diff(knots)[:, None], axis=0)))
    at_edges = np.column_stack([np.interp(edges, knots, joint) for joint in impulse.T])
    return np.diff(at_edges, axis=0) / step
