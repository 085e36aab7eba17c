"""Is a take fit for a diagnosis? What is masked and why, and what looks wrong with stamps, units and alignment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_athletic.recordings.base import base_pose
from torchrl_athletic.recordings.mixed_up import target_doubts
from torchrl_athletic.recordings.noise import base_noise, encoder_step, noise_correlation, repeat_noise, sensor_noise
from torchrl_athletic.recordings.recording import Recording, RecordingError
from torchrl_athletic.recordings.resampling import GAP_FACTOR, gap_rows, resample, split_at_gaps

__all__ = ["Gap", "Quality", "check_quality", "repeat_noise", "resample", "sensor_noise", "split_at_gaps"]

SLOWEST_RATE = 30.0
"""Below this rate [Hz] delay, damping and friction cannot be told apart: refused."""
SLOW_RATE = 100.0
"""Below this rate [Hz] they are told apart poorly: a warning."""
LOST_FACTOR = 1.75
"""Length of a step, in median steps, from which rows count as lost [1]."""
SHORT_FACTOR = 0.75
"""Length in median steps below which a step makes up for a long neighbour: a stamp came late, no row was lost [1]."""
LOST_CHANGE = 0.1
"""Change of the command while rows were lost from which it matters that nobody knows it, in its standard deviations."""
LOST_EVERY = 3.0
"""A hole is masked in each so many seconds at most, the worst first: masks reach as far as the projection looks [s]."""
STALL_TIME = 0.1
"""A joint that rests for less [s] turns round; it is not stalled."""
HELD_POSES = 0.9
"""Share of new poses below which a moving base was logged by something slower than the joints, and held between."""
FASTEST_BASE = 20.0
"""Speed that no robot in the air is carried at [m/s]."""
_LIKELY_RADIANS = 8 * np.pi
_KNOWN_FACTORS = {
    180 / np.pi: "degrees/s against rad",
    np.pi / 180: "rad/s against degrees",
    30 / np.pi: "rev/min against rad",
    1 / (2 * np.pi): "turns/s against rad",
}

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Gap:
    """A stretch in which nothing was logged."""

    time: float
    """Stamp of the last sample before it [s]."""
    length: float
    """Until the next sample [s]."""
    row: int
    """Row of the last sample before it."""


@dataclass(frozen=True, eq=False)
class Quality:
    """What :func:`check_quality` found. Nothing is repaired, and every masked sample has a reason."""

    source: str
    joint_names: tuple[str, ...]
    samples: int
    duration: float
    """[s]."""
    rate: float
    """Median sampling rate [Hz]."""
    jitter: Mapping[str, float]
    """Deviation of the step from its median, as a share of it [1]: quantiles '0.5', '0.95', '0.99' and '1'."""
    gaps: tuple[Gap, ...]
    """Steps over :data:`~torchrl_athletic.recordings.resampling.GAP_FACTOR` = 5 median steps."""
    lost_samples: int
    """Samples that a uniform clock would have had and the take has not, those in gaps included."""
    encoder_step: tuple[float | None, ...]
    """Resolution of the position [rad, m], one a joint; None when it is continuous."""
    position_noise: Floats
    """Standard deviation of a reading [rad, m]. Shape (J,)."""
    noise_correlation: Floats
    """Correlation of the position noise from one sample to the next [1]. Shape (J,)."""
    velocity_noise: Floats | None
    """[rad/s, m/s]. Shape (J,)."""
    velocity_scale: tuple[float | None, ...]
    """Velocity channel / differentiated position [1]; 1 is right. None when there is too little motion to tell."""
    velocity_shift: tuple[float | None, ...]
    """How late the velocity channel is against the position [s]. Filters in the drive make it positive."""
    command_shift: tuple[float | None, ...]
    """How late the response is against the command [s]; None when they hardly correlate. Reported, never corrected: a
    pendulum or a soft controller answers late without any delay in the drive."""
    command_shift_of: str
    """The response that was compared: 'torque_measured', 'acceleration' (of a torque command) or 'position' (of a
    target)."""
    masks: Mapping[str, Mask]
    """Reason -> what it makes unfit, shape (T, J).

    - 'gap': the two samples at its ends.
    - 'lost': the two samples beside rows that the logger lost, too few for a gap, while the command changed: what it
      was meanwhile is not known. The worst ones, one in three seconds at most.
    - 'frozen': the logger repeats an old reading while the joint moves.
    - 'dropout': the reading jumps away and back within three samples.
    - 'saturated': the commanded or measured torque is at the given limit, or the measured one is clipped flat.
    - 'clipped': the commanded torque has flat tops. What was logged after the clipping did act, hence :meth:`usable`
      ignores this reason unless told otherwise.
    - 'stalled': the joint is pushed hard against something that the command does not know of, such as a stop. A joint
      that sticks in friction is *not* stalled: how hard it was pushed before it broke loose is what friction is
      identified from.
    - 'base', of a floating robot only: the pose of the base jumps away and back, or repeats an old one while it moves.
    """
    warnings: tuple[str, ...]
    """Sentences, each with the mend."""
    bridged: tuple[int, ...] = ()
    """Readings of each joint that :func:`~torchrl_athletic.recordings.misread.mended` put between good ones."""

    def usable(self, ignore: tuple[str, ...] = ("clipped",)) -> Mask:
        """Where no reason masks. Shape (T, J).

        Args:
            ignore: Reasons that do not count, in place of the default: ``("clipped", "saturated")`` when the limit
                itself is what one is after.

        Raises:
            ValueError: If a reason to ignore is not one of the masks, since a misspelt one would mask after all.
        """
        unknown = set(ignore) - set(self.masks)
        if unknown:
            raise ValueError(f"{sorted(unknown)} is no reason to mask. Known are {sorted(self.masks)}.")
        masked = [mask for reason, mask in self.masks.items() if reason not in ignore]
        return np.asarray(~np.any(masked, axis=0), dtype=np.bool_)

    def report(self) -> dict[str, Any]:
        """This quality as plain dicts, lists and numbers, as ``diagnosis.json`` holds it.

        ``masked`` counts samples of which at least one joint is masked, ``masked_by_joint`` counts joint by joint.
        """
        joints = self.joint_names
        return {
            "source": self.source,
            "rate": self.rate,
            "duration": self.duration,
            "samples": self.samples,
            "masked": {reason: int(mask.any(axis=1).sum()) for reason, mask in self.masks.items()},
            "masked_by_joint": {
                reason: dict(zip(joints, mask.sum(axis=0).tolist(), strict=True)) for reason, mask in self.masks.items()
            },
            "bridged": dict(zip(joints, self.bridged or [0] * len(joints), strict=True)),
            "jitter": dict(self.jitter),
            "gaps": [{"time": gap.time, "length": gap.length, "row": gap.row} for gap in self.gaps],
            "lost_samples": self.lost_samples,
            "encoder_step": dict(zip(joints, self.encoder_step, strict=True)),
            "position_noise": dict(zip(joints, self.position_noise.tolist(), strict=True)),
            "noise_correlation": dict(zip(joints, self.noise_correlation.tolist(), strict=True)),
            "velocity_noise": None
            if self.velocity_noise is None
            else dict(zip(joints, self.velocity_noise.tolist(), strict=True)),
            "velocity_scale": dict(zip(joints, self.velocity_scale, strict=True)),
            "velocity_shift_ms": dict(zip(joints, _milliseconds(self.velocity_shift), strict=True)),
            "command_shift_ms": dict(zip(joints, _milliseconds(self.command_shift), strict=True)),
            "command_shift_of": self.command_shift_of,
            "warnings": list(self.warnings),
        }


def check_quality(recording: Recording, torque_limit: ArrayLike | None = None) -> Quality:
    """Look a take over before anything is fitted to it.

    Args:
        recording: The take.
        torque_limit: Largest torque of the drives [N·m, N], one number or one a joint. None: saturation shows only
            where a torque is clipped flat, and a stall only where a stop is met twice.

    Raises:
        RecordingError: If the median rate is under 30 Hz, since delay, damping and friction then look alike; if the
            take is too short to tell noise from motion; or if ``torque_limit`` is not positive or does not fit the
            joints.

    Source:
        30 Hz: the tutorial of NVIDIA's system identification found 40 to 56 % parameter error at 15 Hz. Stalls: frames
        of a blocked servo made the identified motor of a Dynamixel bench 29 % weaker.

    Example:
        >>> import numpy as np
        >>> time = np.arange(0.0, 2.0, 0.025)
        >>> take = Recording(time, ("hinge",), np.sin(5 * time)[:, None], torque_command=np.cos(5 * time)[:, None])
        >>> quality = check_quality(take)
        >>> print(quality.warnings[0])
        memory: sampled at 40.0 Hz. Below 100 Hz delay and friction near standstill blur: log at 200 Hz or more.
    """
    if recording.rate < SLOWEST_RATE * (1 - 1e-3):  # stamps of a 30 Hz logger jitter about 30 Hz
        raise RecordingError(
            f"{recording.source}: sampled at {recording.rate:.1f} Hz (median step {1e3 / recording.rate:.1f} ms). "
            f"Below {SLOWEST_RATE:.0f} Hz delay, damping and friction look alike. Log at 200 Hz or more; resampling "
            f"does not help.{_counted_otherwise(recording)}"
        )
    limit = _torque_limit(recording, torque_limit)
    position_noise, velocity_noise = sensor_noise(recording)
    steps = tuple(encoder_step(joint) for joint in recording.position.T)
    resolution = np.array([step or 0.0 for step in steps])
    gaps = tuple(
        Gap(float(recording.time[row]), float(recording.time[row + 1] - recording.time[row]), int(row))
        for row in gap_rows(recording.time)
    )
    saturated = _saturated(recording, limit)
    masks = {
        "gap": _beside_gaps(recording, gaps),
        "lost": _beside_lost(recording),
        "frozen": _frozen(recording, 2 * resolution + 4 * position_noise, velocity_noise),
        "dropout": _dropouts(recording, position_noise + resolution, velocity_noise),
        "saturated": saturated,
        "clipped": _flat_tops(recording.torque_command, recording),
        "stalled": _stalled(recording, saturated, 1.5 * resolution + 6 * position_noise),
    }
    if recording.base_position is not None:
        masks["base"] = np.repeat(_base_lost(recording)[:, None], recording.num_joints, axis=1)
    scale, velocity_shift = _velocity_against_position(recording)
    response, command_shift = _response_against_command(recording)
    quality = Quality(
        source=recording.source,
        joint_names=recording.joint_names,
        samples=recording.num_samples,
        duration=recording.duration,
        rate=recording.rate,
        jitter=_jitter(recording.time),
        gaps=gaps,
        lost_samples=_lost_samples(recording),
        encoder_step=steps,
        position_noise=position_noise,
        noise_correlation=noise_correlation(recording),
        velocity_noise=velocity_noise,
        velocity_scale=scale,
        velocity_shift=velocity_shift,
        command_shift=command_shift,
        command_shift_of=response,
        masks=masks,
        warnings=(),
    )
    return _with_warnings(quality, recording, limit)


def _torque_limit(recording: Recording, torque_limit: ArrayLike | None) -> Floats | None:
    if torque_limit is None:
        return None
    limit = np.asarray(torque_limit, dtype=np.float64)
    if limit.shape not in ((), (recording.num_joints,)) or not (limit > 0).all():
        raise RecordingError(
            f"{recording.source}: torque_limit is {torque_limit}; needed is one positive number, or one for each of "
            f"the joints {', '.join(recording.joint_names)}, in N·m (N for slides)."
        )
    return np.broadcast_to(limit, (recording.num_joints,))


def _jitter(time: Floats) -> dict[str, float]:
    step = np.diff(time)
    deviation = np.abs(step / np.median(step) - 1)
    return {name: float(np.quantile(deviation, float(name))) for name in ("0.5", "0.95", "0.99", "1")}


# --- masks ------------------------------------------------------------------------------------------------------------


def _beside_gaps(recording: Recording, gaps: tuple[Gap, ...]) -> Mask:
    mask = np.zeros(recording.position.shape, dtype=np.bool_)
    for gap in gaps:
        mask[gap.row : gap.row + 2] = True
    return mask


def _beside_lost(recording: Recording) -> Mask:
    mask = np.zeros(recording.position.shape, dtype=np.bool_)
    step = np.diff(recording.time) * recording.rate
    long = (step > LOST_FACTOR) & (step <= GAP_FACTOR) & ~_made_up_for(step)
    command = recording.command
    acts = command if recording.position_target is None else command - recording.position  # what the motor hears of it
    change = np.abs(np.diff(command, axis=0)) / np.maximum(acts.std(axis=0), 1e-12)
    harm = np.where(long, change.max(axis=1) * (step - 1.0), 0.0)
    most = 1 + int(recording.duration / LOST_EVERY)
    worst = np.argsort(-harm, kind="stable")[:most]
    rows = worst[harm[worst] > LOST_CHANGE]
    mask[rows] = mask[rows + 1] = True
    return mask


def _made_up_for(step: Floats) -> Mask:
    """Which steps, in median steps, have a short one beside them: a stamp came late, no row was lost."""
    beside = np.minimum(np.append(step[1:], 1.0), np.insert(step[:-1], 0, 1.0))
    return np.asarray(beside <= SHORT_FACTOR, dtype=np.bool_)


def _lost_samples(recording: Recording) -> int:
    step = np.diff(recording.time) * recording.rate
    late = (step <= GAP_FACTOR) & _made_up_for(step)
    return int(np.maximum(np.round(step) - 1, 0)[~late].sum())


def _frozen(recording: Recording, smallest_move: Floats, velocity_noise: Floats | None) -> Mask:
    """Readings repeated exactly while the joint moved by more than ``smallest_move`` (J,)."""
    mask = np.zeros(recording.position.shape, dtype=np.bool_)
    for j, q in enumerate(recording.position.T):
        mask[:, j] = _repeated(recording.time, q, smallest_move[j])
        if recording.velocity is None or velocity_noise is None:
            continue
        v = recording.velocity[:, j]
        slowest = 4 * velocity_noise[j] + 2 * (encoder_step(v) or 0.0)
        for start, stop in _runs((np.diff(q) == 0) & (np.diff(v) == 0)):
            hidden = v[start] * (recording.time[stop] - recording.time[start])
            caught_up = stop + 1 == len(q) or (q[stop + 1] - q[stop]) * np.sign(hidden) > 0.5 * abs(hidden)
            if abs(v[start]) > slowest and abs(hidden) > smallest_move[j] and caught_up:
                mask[start + 1 : stop + 1, j] = True
    return mask


def _repeated(time: Floats, q: Floats, smallest_move: float) -> Mask:
    """Where one channel stands still and then jumps to where it would have been."""
    mask = np.zeros(len(q), dtype=np.bool_)
    for start, stop in _runs(np.diff(q) == 0):  # rows start + 1 to stop repeat row start
        if _catches_up(time, q, start, stop, smallest_move):
            mask[start + 1 : stop + 1] = True
    return mask


def _base_lost(recording: Recording) -> Mask:
    """Where no number of the base's pose was read anew, or one is a spike. Shape (T,)."""
    pose = base_pose(recording)
    assert pose is not None
    linear, angular = base_noise(recording)
    noise = np.array([linear] * 3 + [angular / 2] * 4)
    repeated = [_repeated(recording.time, channel, 4 * sigma) for channel, sigma in zip(pose.T, noise, strict=True)]
    lost = np.any(repeated, axis=0) | _spikes(pose, np.maximum(10 * noise, 1e-9)).any(1)
    jumps = np.linalg.norm(np.diff(pose[:, :3], axis=0), axis=1) / np.diff(recording.time) > FASTEST_BASE
    for start, stop in _runs((np.diff(pose, axis=0) == 0).all(1)):  # a filler in place of the pose
        if start > 0 and stop + 1 < len(pose) and jumps[start - 1] and jumps[stop]:
            lost[start : stop + 1] = True
    return np.asarray(lost, dtype=np.bool_)


def with_known_base(recording: Recording) -> Recording:
    """The recording without the samples at which the pose of its base was lost; itself if none was."""
    if recording.base_position is None:
        return recording
    lost = _base_lost(recording)
    return recording.where(~lost) if lost.any() else recording


def _catches_up(time: Floats, q: Floats, start: int, stop: int, smallest_move: float) -> bool:
    """Whether the reading, after standing still, jumps to where its speed would have taken it meanwhile."""
    if start == 0 or stop + 2 >= len(q):
        return False
    before = (q[start] - q[start - 1]) / (time[start] - time[start - 1])
    after = (q[stop + 2] - q[stop + 1]) / (time[stop + 2] - time[stop + 1])
    if before * after <= 0:
        return False
    speed = np.sign(before) * min(abs(before), abs(after))
    hidden = speed * (time[stop] - time[start])
    jump = q[stop + 1] - q[stop]
    return bool(abs(hidden) > smallest_move and 0.7 < jump / (speed * (time[stop + 1] - time[start])) < 3.0)


def _dropouts(recording: Recording, position_scale: Floats, velocity_noise: Floats | None) -> Mask:
    """Readings that leave by more than the joint ever moves in three samples, and come back within three."""
    mask = _spikes(recording.position, 10 * position_scale)
    if recording.velocity is not None and velocity_noise is not None:
        mask |= _spikes(recording.velocity, 10 * velocity_noise)
    return mask


def _spikes(values: Floats, floor: Floats) -> Mask:
    from scipy.ndimage import median_filter

    moves = np.quantile(np.abs(np.diff(values, axis=0)), 0.99, axis=0)
    away = np.abs(values - median_filter(values, size=(7, 1), mode="nearest"))
    return np.asarray(away > floor + 4 * moves, dtype=np.bool_)


def _saturated(recording: Recording, limit: Floats | None) -> Mask:
    mask = _flat_tops(recording.torque_measured, recording)
    if limit is not None:
        mask |= np.abs(_effort(recording)) >= 0.999 * limit
        if recording.torque_measured is not None:
            mask |= np.abs(recording.torque_measured) >= 0.999 * limit
    return mask


def _flat_tops(torque: Floats | None, recording: Recording) -> Mask:
    if torque is None:
        return np.zeros(recording.position.shape, dtype=np.bool_)
    return np.column_stack([_clipped(channel) | _clipped(-channel) for channel in torque.T])


def _clipped(torque: Floats) -> Mask:
    """Flat tops of a torque that otherwise changes from sample to sample.

    A square wave and a torque held for many samples are flat everywhere, by intention: they are not clipped.
    """
    top = torque >= torque.max() - 1e-9 * np.abs(torque).max()
    flat = [(start, stop) for start, stop in _runs(top) if stop - start >= 3]
    below = ~(top[1:] | top[:-1])
    changes = np.diff(torque) != 0
    mask = np.zeros(len(torque), dtype=np.bool_)
    if len(flat) >= 2 and below.any() and changes[below].mean() > 0.5:
        for start, stop in flat:
            mask[start:stop] = True
    return mask


def _stalled(recording: Recording, saturated: Mask, band: Floats) -> Mask:
    """Pushed hard, and resting for STALL_TIME or longer where friction cannot be what holds the joint.

    Friction holds a joint anywhere; a stop holds it at the same place each time. So the rest counts as a stall only

    - when the torque is saturated; or
    - at the end of the travel, if the joint rests there at least twice, and is pushed outward with half of the largest
      torque or more, and either 1.5 times as hard as what usually moves it that way, or after it arrived at speed and
      stood at once. It stays stalled for as long as it rests and is pushed outward.
    """
    mask = np.zeros(recording.position.shape, dtype=np.bool_)
    effort = _effort(recording)
    for j, (q, torque) in enumerate(zip(recording.position.T, effort.T, strict=True)):
        tolerance = band[j] + 1e-4 * np.ptp(q)
        rests = _rests(recording.time, q, tolerance)
        for rows in rests:
            mask[rows, j] |= saturated[rows, j]
        for way in (1.0, -1.0):
            end = (way * q).max()
            visits = [rows for rows in rests if end - way * np.median(q[rows]) <= 2 * tolerance]
            if _separate(visits, q, 10 * tolerance) < 2:
                continue
            for rows in visits:
                push = way * torque[rows]
                if push.max() >= _hard_push(recording.time, way * q, way * torque, rows):
                    mask[rows[push > 0], j] = True  # the stop bears the push from the first newton on
    return mask


def _rests(time: Floats, q: Floats, tolerance: float) -> list[NDArray[np.intp]]:
    """Rows of each stretch of STALL_TIME or longer in which the position stays within ``tolerance``."""
    half = max(1, round(0.025 / float(np.median(np.diff(time)))))
    change = np.full(len(q), np.inf)
    change[half:-half] = np.abs(q[2 * half :] - q[: -2 * half])
    found = []
    for start, stop in _runs(change <= tolerance):
        rows = np.arange(max(start - half, 0), min(stop + half, len(q)))
        rows = rows[np.abs(q[rows] - np.median(q[rows])) <= tolerance]
        if len(rows) > 2 and time[rows[-1]] - time[rows[0]] >= STALL_TIME:
            found.append(rows)
    return found


def _separate(visits: list[NDArray[np.intp]], q: Floats, away: float) -> int:
    """How many of the visits are new arrivals: the joint was ``away`` in between."""
    arrivals = min(len(visits), 1)
    for before, after in pairwise(visits):
        between = np.abs(q[before[-1] : after[0] + 1] - q[before[-1]])
        arrivals += bool(between.max(initial=0.0) > away)  # rows of two rests may overlap
    return arrivals


def _hard_push(time: Floats, outward: Floats, push: Floats, rows: NDArray[np.intp]) -> float:
    """Least outward torque that friction cannot account for in this rest at the end of the travel."""
    speed = np.diff(outward) / np.diff(time)
    fast = 0.3 * float(np.quantile(np.abs(speed), 0.99))
    start = int(rows[0])
    arrival = push[np.searchsorted(time, time[start] - STALL_TIME / 2) : start + 1].max()
    moving = push[:-1][speed > 0.1 * fast]
    crashed = start > 0 and speed[max(start - 3, 0) : start + 1].max() > fast
    usual = max(float(arrival), float(np.quantile(moving, 0.75)) if len(moving) else 0.0)
    return max(0.5 * float(np.abs(push).max()), 0.9 * float(arrival) if crashed else 1.5 * usual)


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Start and stop (exclusive) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False]))))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _effort(recording: Recording) -> Floats:
    """Torque that the command asks for [N·m]. Shape (T, J)."""
    if recording.position_target is None:
        return recording.command
    assert recording.kp is not None  # Recording saw to it
    assert recording.kd is not None
    if recording.velocity is not None:
        velocity = recording.velocity
    else:
        velocity = np.gradient(recording.position, recording.time, axis=0)
    return recording.kp * (recording.position_target - recording.position) - recording.kd * velocity


# --- units and alignment ----------------------------------------------------------------------------------------------


def _velocity_against_position(recording: Recording) -> tuple[tuple[float | None, ...], tuple[float | None, ...]]:
    """Scale of the velocity channel [1] and its lateness [s] against the differentiated position, joint by joint."""
    if recording.velocity is None:
        return (None,) * recording.num_joints, (None,) * recording.num_joints
    step = 1 / recording.rate
    position, velocity = _uniform(recording, recording.position), _uniform(recording, recording.velocity)
    derivative = _smooth(np.gradient(position, step, axis=0), recording.rate)
    measured = _smooth(velocity, recording.rate)
    scales, shifts = [], []
    for j in range(recording.num_joints):
        shift, correlation, scale = _time_shift(derivative[:, j], measured[:, j], step)
        sure = abs(correlation) > 0.8
        scales.append(scale if sure else None)
        shifts.append(shift if sure else None)
    return tuple(scales), tuple(shifts)


def _response_against_command(recording: Recording) -> tuple[str, tuple[float | None, ...]]:
    """What answers the command, and how late [s].

    A held command is centred half a step after its stamp. A measured torque is compared stamp by stamp.
    """
    step = 1 / recording.rate
    late = step / 2
    if recording.position_target is not None:
        name, response = "position", _uniform(recording, recording.position)
    elif recording.torque_measured is not None:
        name, response, late = "torque_measured", _uniform(recording, recording.torque_measured), 0.0
    else:
        name = "acceleration"
        speed = np.gradient(_uniform(recording, recording.position), step, axis=0)
        response = np.gradient(speed, step, axis=0)
    command, response = (_smooth(x, recording.rate) for x in (_uniform(recording, recording.command), response))
    shifts: list[float | None] = []
    for j in range(recording.num_joints):
        shift, correlation, _ = _time_shift(command[:, j], response[:, j], step)
        causal = name != "acceleration" or shift - late > -step  # else the phase of a resonance, not a delay
        shifts.append(shift - late if correlation > 0.8 and causal else None)
    return name, tuple(shifts)


def _uniform(recording: Recording, values: Floats) -> Floats:
    """Linear interpolation at the median rate, across gaps as well: good enough to compare two channels of one log."""
    grid = np.arange(recording.time[0], recording.time[-1], 1 / recording.rate)
    return np.column_stack([np.interp(grid, recording.time, joint) for joint in values.T])


def _smooth(values: Floats, rate: float) -> Floats:
    from scipy.ndimage import gaussian_filter1d

    smoothed: Floats = gaussian_filter1d(values, sigma=max(1.0, 0.01 * rate), axis=0, mode="nearest")
    return smoothed


def _time_shift(a: Floats, b: Floats, step: float, longest: float = 0.3) -> tuple[float, float, float]:
    """How late ``b`` is against ``a`` [s], their correlation there, and the factor b / a.

    Only the inner part of ``b`` is compared, with all of ``a``: each lag then sees whole signals, without an edge.
    """
    from scipy.signal import correlate

    a, b = a - a.mean(), b - b.mean()
    most = min(round(longest / step), len(a) // 4)
    inner = b[most : len(b) - most]
    power = np.concatenate(([0.0], np.cumsum(a**2)))
    power_a = (power[len(inner) :] - power[: -len(inner)])[::-1]  # of the part of a at each lag
    power_b = float(inner @ inner)
    if most < 1 or power_b == 0 or power_a.min() <= 0:
        return 0.0, 0.0, 0.0
    products = correlate(a, inner, mode="valid", method="fft")[::-1]  # b late by -most ... most samples
    similar = products / np.sqrt(power_a * power_b)
    size = np.abs(similar)
    peaks = (size[1:-1] >= size[:-2]) & (size[1:-1] >= size[2:]) & (size[1:-1] >= 0.97 * size.max())
    if not peaks.any():
        return 0.0, 0.0, 0.0
    found = np.flatnonzero(peaks) + 1
    peak = int(found[np.argmin(np.abs(found - most))])  # a periodic motion fits again one period later
    left, top, right = similar[peak - 1 : peak + 2]
    bend = left - 2 * top + right
    fraction = 0.5 * (left - right) / bend if bend != 0 else 0.0
    return float((peak - most + fraction) * step), float(top), float(products[peak] / power_a[peak])


def _counted_otherwise(recording: Recording) -> str:
    """A sentence where the logged velocities say that time is counted in another unit, or in samples."""
    if recording.velocity is None:
        return ""
    moved, speed = np.diff(recording.position, axis=0), (recording.velocity[1:] + recording.velocity[:-1]) / 2
    agree = float((moved * speed).sum() / max(np.sqrt((moved**2).sum() * (speed**2).sum()), 1e-300))
    step = float((moved * speed).sum() / max((speed**2).sum(), 1e-300))
    if agree < 0.9 or step > 0.1 / recording.rate:
        return ""
    return (
        f" But by the logged velocities a sample lasts {1e3 * step:.3g} ms: either time counts samples or "
        "milliseconds, or velocities have another unit. Say which in the column map."
    )


# --- warnings ---------------------------------------------------------------------------------------------------------


def _with_warnings(quality: Quality, recording: Recording, limit: Floats | None) -> Quality:
    found = [*_stamp_warnings(quality), *_mask_warnings(quality, limit), *_unit_warnings(quality, recording)]
    found += _base_warnings(quality, recording) + target_doubts(recording, quality.position_noise)
    return replace(quality, warnings=tuple(f"{quality.source}: {text}" for text in found))


def _stamp_warnings(quality: Quality) -> list[str]:
    found = []
    if quality.rate < SLOW_RATE * (1 - 1e-3):
        found.append(
            f"sampled at {quality.rate:.1f} Hz. Below {SLOW_RATE:.0f} Hz delay and friction near standstill blur: log "
            "at 200 Hz or more."
        )
    if quality.jitter["0.95"] > 0.2:
        found.append(
            f"one step in twenty is off by {quality.jitter['0.95']:.0%} or more of the median step of "
            f"{1e3 / quality.rate:.2f} ms. Stamp the samples where they are taken, not where they are written."
        )
    if quality.gaps:
        longest = max(quality.gaps, key=lambda gap: gap.length)
        found.append(
            f"{len(quality.gaps)} gaps of more than {GAP_FACTOR:.0f} median steps, the longest {longest.length:.3f} s "
            f"after {longest.time:.3f} s (row {longest.row}). Use split_at_gaps."
        )
    elif quality.lost_samples > 0.01 * quality.samples:
        found.append(
            f"{quality.lost_samples} of {quality.samples + quality.lost_samples} samples are missing, one or a few at "
            "a time. Look for lost packets in the logger."
        )
    return found


def _mask_warnings(quality: Quality, limit: Floats | None) -> list[str]:
    mends = {
        "frozen": "repeat an old reading while the joint moves. Log a sample only when the drive has sent a new one",
        "dropout": "jump away and back. Look for lost encoder readings that are logged as a default value",
        "saturated": "are at the torque limit. There the command is not what acted: excite more gently",
        "clipped": "have a torque command with flat tops. If the drive limited it after that was logged, state "
        "its limit in the model, as the joint's actuatorfrcrange",
        "stalled": "are pushed hard against something immovable. Keep the motion off the stops",
    }
    if limit is not None:  # which says already where a drive is limited
        del mends["clipped"]
    found = []
    for reason, mend in mends.items():
        by_joint = quality.masks[reason].mean(axis=0)
        for joint, share in zip(quality.joint_names, by_joint, strict=True):
            if share > 0.01 or (share > 0 and reason == "dropout"):
                part = f"{share:.1%}" if share >= 0.001 else f"{round(share * quality.samples)}"
                found.append(f"{joint}: {part} of the samples {mend}.")
    return found


def _unit_warnings(quality: Quality, recording: Recording) -> list[str]:
    found, still = [], []
    for j, joint in enumerate(quality.joint_names):
        q = recording.position[:, j]
        moves, travel = np.diff(q), float(np.ptp(q))
        if travel <= 10 * quality.position_noise[j] + 2 * (quality.encoder_step[j] or 0.0):
            still.append(joint)
            continue
        fastest = float(np.quantile(np.abs(moves / np.diff(recording.time)), 0.99))
        jumps = int(((np.abs(moves) > 5.5) & (np.abs(moves) > 20 * np.quantile(np.abs(moves), 0.99))).sum())
        if jumps:
            found.append(
                f"the position of {joint} jumps {jumps} times, by {np.abs(moves).max():.2f}. Unwrap it (numpy.unwrap) "
                "where the encoder starts anew each turn."
            )
        elif travel > _LIKELY_RADIANS or fastest > 100:
            found.append(
                f"the position of {joint} covers {travel:.1f} at up to {fastest:.0f} a second, which looks like "
                "degrees or encoder counts. Convert it to rad, unless the joint does make several turns."
            )
        found += _velocity_warnings(joint, quality.velocity_scale[j], quality.velocity_shift[j], 1 / quality.rate)
    if len(still) == 1:
        found.append(f"{still[0]} never moves. Nothing can be said about it from this take.")
    elif still:
        found.append(f"{', '.join(still)} never move. Nothing can be said about them from this take.")
    return found


def _base_warnings(quality: Quality, recording: Recording) -> list[str]:
    if recording.base_position is None:
        return []
    found, lost = [], quality.masks["base"].any(1).mean()
    pose = base_pose(recording)
    assert pose is not None
    new = float(np.diff(pose, axis=0).any(1).mean())
    if 0.0 < new < HELD_POSES:
        found.append(
            f"the base: {1 - new:.0%} of its poses are the one before, as where a slower log is held until the next "
            "pose comes. Interpolate the base's own log at the joints' stamps."
        )
    speed = np.linalg.norm(np.diff(recording.base_position, axis=0), axis=1) / np.diff(recording.time)
    if lost:
        found.append(
            f"the base: {lost:.1%} of its poses jump away and back, or repeat an old one. Look for lost markers."
        )
    if (fastest := float(np.quantile(speed, 0.99))) > FASTEST_BASE:
        found.append(
            f"base_position moves at up to {fastest:.0f} a second, which looks like millimetres. Convert it to m."
        )
    return found


def _velocity_warnings(joint: str, scale: float | None, shift: float | None, step: float) -> list[str]:
    if scale is None or shift is None:
        return []
    found = []
    if scale < 0:
        found.append(f"the velocity of {joint} has the other sign than its position. Flip one of them.")
    if abs(abs(scale) - 1) > 0.1:
        near = [text for factor, text in _KNOWN_FACTORS.items() if abs(abs(scale) / factor - 1) < 0.1]
        cause = near[0] if near else "a gear ratio or a unit, perhaps"
        found.append(
            f"the velocity of {joint} is {scale:.3g} times its differentiated position ({cause}). Convert it to the "
            "unit of the position per second."
        )
    if abs(shift) > max(0.005, 1.5 * step):
        found.append(
            f"the velocity of {joint} is {1e3 * abs(shift):.1f} ms {'late' if shift > 0 else 'early'} against its "
            "position. If the drive filters it, leave it out: position alone serves better."
        )
    return found


def _milliseconds(seconds: tuple[float | None, ...]) -> list[float | None]:
    return [None if value is None else 1e3 * value for value in seconds]
