"""How much the sensors scatter: from one take, or better from repeats of the same take."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.base import base_pose
from torchrl_athletic.recordings.recording import Recording, RecordingError
from torchrl_athletic.recordings.resampling import GAP_FACTOR

_ORDER = 4
_STRIDES = 6
"""Longest distance over which differences are taken [samples]."""
_MEMORY = 4
"""Longest distance that tells of noise with memory [samples]; beyond it, little motions leave as much."""
_ALIKE = 0.15
"""Relative error of these variances up to which noise explains them."""
_ENOUGH = 100
"""Fewest windows that say something of noise with a memory."""
_INTERPOLATED = 100
"""Samples, at most, over which a logger draws a step of the encoder out."""
_CONDITIONS = ("robot", "payload", "fixture", "excitation")
_REPEAT_KEYS = ("repeat_id", "repeat")


def sensor_noise(recording: Recording) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    r"""Standard deviation of one reading of position and velocity, from one take.

    Fourth differences remove any motion that is smooth over five samples and leave white noise,

    .. math:: \sigma = 1.4826\,\mathrm{median}\,|\Delta^4 x| / \sqrt{70},

    where the divided differences use the actual stamps, so that jitter of the clock does not pass for noise. The
    estimate is never below the rounding error step / sqrt(12) of a quantised channel. Noise of the position that is
    correlated over several samples, as behind a filter in the drive, is seen by what is left of it with differences of
    every second and third sample (:func:`noise_correlation`). What differences over some other number of samples do not
    have is a gear that rings, no noise. What repeats do not share is noise of any kind (:func:`repeat_noise`).

    Returns:
        Noise of the position [rad, m for slides], shape (J,), and of the velocity [rad/s, m/s], shape (J,), or None
        when the recording has no velocity.

    Raises:
        RecordingError: If there are fewer than 10 gap-free windows of five samples.

    Example:
        >>> import numpy as np
        >>> time, noise = np.arange(2000) / 200, np.random.default_rng(0).normal(0, 1e-3, 2000)
        >>> take = Recording(time, ("hinge",), (np.sin(time) + noise)[:, None], torque_command=np.zeros((2000, 1)))
        >>> position_noise, velocity_noise = sensor_noise(take)
        >>> bool(abs(position_noise[0] - 1e-3) < 1e-4), velocity_noise
        (True, None)
    """
    weights, rows = _difference_weights(recording)

    def channels(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([_channel_noise(weights, channel[rows], encoder_step(channel)) for channel in values.T])

    left, step = _left_of_differences(recording)
    white, least = channels(recording.position), 1.1 * np.sqrt(left.min(axis=0))
    steady = np.where(least > 0, np.minimum(white, least), white)
    white = np.maximum(steady, step / np.sqrt(12.0))
    correlated = np.array([sigma for sigma, _ in _first_order(left, step)])
    position = np.maximum(white, correlated)
    return position, None if recording.velocity is None else channels(recording.velocity)


def base_noise(recording: Recording) -> NDArray[np.float64]:
    """Standard deviation of one reading of the base's position [m] and of its attitude about an axis [rad].

    Found as :func:`sensor_noise` finds white noise; zero if no base was recorded. Shape (2,).
    """
    pose = base_pose(recording)
    if pose is None:
        return np.zeros(2)
    weights, rows = _difference_weights(recording)
    square = np.array([_channel_noise(weights, channel[rows], encoder_step(channel)) ** 2 for channel in pose.T])
    return np.sqrt([square[:3].mean(), 4 * square[3:].sum() / 3])  # of four numbers of a unit quaternion three are free


def noise_correlation(recording: Recording) -> NDArray[np.float64]:
    r"""Correlation of the position's noise from one sample to the next, as of a first-order filter.

    Of noise with the autocorrelation :math:`\rho^{|k|}`, fourth differences over every n-th sample leave

    .. math:: \frac{\mathrm{Var}\,\Delta_n^4 x}{70\,\sigma^2} =
        1 - \tfrac{8}{5}\rho^n + \tfrac{4}{5}\rho^{2n} - \tfrac{8}{35}\rho^{3n} + \tfrac{1}{35}\rho^{4n},

    so that n = 1 to 4, or to 3 at least, tell :math:`\rho`, and whether it is noise: what a motion leaves grows with
    :math:`n^8` instead, and then 0 is returned.

    Returns:
        Correlation, 0 to 0.95. Shape (J,).

    Raises:
        RecordingError: If there are fewer than 10 gap-free windows of five samples.

    Example:
        >>> import numpy as np
        >>> from scipy.signal import lfilter
        >>> time, white = np.arange(4000) / 200, np.random.default_rng(0).normal(0, 1e-3, 4000)
        >>> position = np.sin(time) + lfilter([0.8], [1, -0.6], white)
        >>> take = Recording(time, ("hinge",), position[:, None], torque_command=np.zeros((4000, 1)))
        >>> bool(abs(noise_correlation(take)[0] - 0.6) < 0.1), bool(abs(sensor_noise(take)[0][0] - 1e-3) < 1e-4)
        (True, True)
    """
    return np.array([rho for _, rho in _first_order(*_left_of_differences(recording))])


def _left_of_differences(recording: Recording) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What differences over n = 1, 2, ... samples leave of each joint [rad²], shape (N, J), and its encoder's step.

    As many as the take is long enough for.
    """
    strides = [_difference_weights(recording, n) for n in range(1, _STRIDES + 1)]
    left = [
        [_typical_square(weights, channel[rows]) for channel in recording.position.T]
        for weights, rows in strides
        if len(rows) >= _ENOUGH or rows is strides[0][1]
    ]
    return np.array(left), np.array([encoder_step(channel) or 0.0 for channel in recording.position.T])


def _first_order(left: NDArray[np.float64], step: NDArray[np.float64]) -> list[tuple[float, float]]:
    """Standard deviation and correlation of each joint's noise; zeros where differences show no correlation.

    Of as many numbers of samples as first-order noise explains, three at least: beyond, the motion begins.
    """
    rho = np.linspace(0.0, 0.95, 191)
    shares = np.log([_share_of_differences(rho**n) for n in range(1, len(left) + 1)])
    out = []
    for joint, rounding in zip((left - step**2 / 12).T, step / np.sqrt(12.0), strict=True):
        found = (0.0, 0.0)
        for most in range(min(len(left), _MEMORY), 2, -1):
            if joint[:most].min() <= 0:
                continue
            level = np.log(joint[:most, None]) - shares[:most]
            k = int(np.argmin(level.std(axis=0)))
            if np.abs(level[:, k] - level[:, k].mean()).max() < _ALIKE:
                sigma = float(np.exp(level[:, k].mean() / 2))
                found = (sigma, float(rho[k])) if k and sigma > rounding else found
                break
        out.append(found)
    return out


def _share_of_differences(rho: NDArray[np.float64]) -> NDArray[np.float64]:
    """Variance of fourth differences of unit norm, of noise with variance 1 and this correlation."""
    return np.asarray(1 - 8 / 5 * rho + 4 / 5 * rho**2 - 8 / 35 * rho**3 + rho**4 / 35)


def repeat_noise(recordings: Sequence[Recording]) -> NDArray[np.float64] | None:
    """Scatter of the position between repeats of one take: sensors, friction that varies, everything not repeatable.

    Repeats are takes that carry ``repeat_id`` (or ``repeat``) in their metadata, got the same command up to two samples
    of jitter, and agree in joints, gains, robot, payload, fixture and excitation. Two takes give RMS difference /
    sqrt(2), more takes the scatter about their mean.

    Returns:
        Standard deviation of one take [rad, m for slides]. Shape (J,). None when nothing was repeated.

    Raises:
        RecordingError: If repeats of different joints are mixed, since one number a joint could not be returned.
    """
    groups: list[list[Recording]] = []
    for recording in recordings:
        if any(key in recording.metadata for key in _REPEAT_KEYS):
            home = next((group for group in groups if _is_repeat(group[0], recording)), None)
            groups.append([recording]) if home is None else home.append(recording)
    groups = [group for group in groups if len(group) > 1]
    if not groups:
        return None
    if len({group[0].joint_names for group in groups}) > 1:
        raise RecordingError(
            f"{groups[0][0].source}: repeats of takes with different joints were given "
            f"({sorted({group[0].joint_names for group in groups})}). Call repeat_noise once for each set of joints."
        )
    squares = np.zeros(groups[0][0].num_joints)
    freedom = 0
    for group in groups:
        takes = _positions_on_common_stamps(group)
        squares += ((takes - takes.mean(axis=0)) ** 2).sum(axis=(0, 1))
        freedom += (len(takes) - 1) * takes.shape[1]
    scatter: NDArray[np.float64] = np.sqrt(squares / freedom)
    return scatter


def encoder_step(values: NDArray[np.float64]) -> float | None:
    """Resolution of a quantised channel: the greatest common spacing of its values [unit of the values].

    Where a logger has interpolated between readings, the values that stay the same over three samples or more decide,
    if the channel bends sharply enough between them: two poses in which a joint rests are no step of its encoder.

    Args:
        values: One channel. Shape (T,).

    Returns:
        The step, or None when the values are continuous, or constant.
    """
    step = _common_spacing(values, len(values) // 10)
    if step is not None:
        return step
    same = np.diff(values) == 0
    held = values[1:-1][same[1:] & same[:-1]]
    step = _common_spacing(held, len(held) // 3) if len(held) else None
    return step if step is not None and step <= _INTERPOLATED * np.abs(np.diff(values, 2)).max() else None


def _common_spacing(values: NDArray[np.float64], most_of_few: int) -> float | None:
    distinct = np.unique(values)
    spacing = np.diff(distinct)
    # A handful of values is evidence of a coarse encoder only if each of them comes many times.
    if len(spacing) == 0 or (len(spacing) < 20 and len(distinct) > most_of_few):
        return None
    for divisor in range(1, 13):  # the smallest spacing may be several steps of an encoder that jumps
        step = spacing.min() / divisor
        multiple = np.round(spacing / step)
        if (np.abs(spacing / step - multiple) < 0.02).mean() > 0.98:
            common = float(spacing.sum() / multiple.sum())
            return common if common > np.abs(distinct).max() * 2.0**-23 else None  # float32 rounds that finely
    return None


def _difference_weights(recording: Recording, stride: int = 1) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Weights of unit norm that cancel every cubic on the stamps of a window, and the windows' rows, (W, 5) both."""
    step = np.diff(recording.time)
    windows = max(recording.num_samples - _ORDER * stride, 0)
    rows = np.arange(windows)[:, None] + stride * np.arange(_ORDER + 1)
    gap = step > GAP_FACTOR * np.median(step)
    gaps = np.concatenate([[0], np.cumsum(gap)])  # before each row
    rows = rows[gaps[rows[:, -1]] == gaps[rows[:, 0]]] if windows else rows
    if len(rows) < 10 and stride == 1:
        raise RecordingError(
            f"{recording.source}: {recording.num_samples} samples hold {len(rows)} windows of {_ORDER + 1} samples "
            "without a gap; at least 10 are needed to tell noise from motion. Record for longer."
        )
    stamps = recording.time[rows]
    stamps = (stamps - stamps.mean(axis=1, keepdims=True)) / np.median(step)
    distance = stamps[:, :, None] - stamps[:, None, :] + np.eye(_ORDER + 1)
    weights = 1.0 / distance.prod(axis=2)
    return weights / np.linalg.norm(weights, axis=1, keepdims=True), rows


def _channel_noise(weights: NDArray[np.float64], windows: NDArray[np.float64], step: float | None) -> float:
    left = np.abs((weights * windows).sum(axis=1))
    left[left < 1e-12 * np.abs(windows).max(initial=0.0)] = 0.0
    sigma = 1.4826 * float(np.median(left))
    if sigma == 0.0:  # mostly at rest behind a coarse encoder: the median sees none of the readings that do change
        sigma = float(np.sqrt(np.mean(np.minimum(left, np.quantile(left, 0.99)) ** 2)))
    return max(sigma, (step or 0.0) / np.sqrt(12.0))


def _typical_square(weights: NDArray[np.float64], windows: NDArray[np.float64]) -> float:
    """Mean square of all but the largest twentieth, as a share of what it is of Gaussian noise.

    Unlike a median's, it does not jump with the counts of an encoder.
    """
    square = np.sort((weights * windows).sum(axis=1) ** 2)[: 19 * len(windows) // 20]
    return float(square.mean()) / 0.759


def _is_repeat(a: Recording, b: Recording) -> bool:
    return (
        a.joint_names == b.joint_names
        and (a.position_target is None) == (b.position_target is None)
        and abs(a.duration - b.duration) < 0.02 * a.duration
        and all(_same(a, b, gain) for gain in ("kp", "kd"))
        and all(a.metadata.get(key) == b.metadata.get(key) for key in _CONDITIONS)
        and _same_command(a, b)
    )


def _same(a: Recording, b: Recording, name: str) -> bool:
    left, right = getattr(a, name), getattr(b, name)
    return (left is None and right is None) or (left is not None and right is not None and np.allclose(left, right))


def _same_command(a: Recording, b: Recording) -> bool:
    """Whether the commands agree up to two samples of jitter, since two takes are never stamped alike."""
    held = np.searchsorted(b.time - b.time[0], a.time - a.time[0], side="right") - 1
    near = b.command[np.clip(held[:, None] + np.arange(-2, 3), 0, b.num_samples - 1)]  # (T, 5, J)
    slack = 1e-3 * np.ptp(a.command, axis=0)
    inside = (a.command >= near.min(axis=1) - slack) & (a.command <= near.max(axis=1) + slack)
    return bool((inside.mean(axis=0) > 0.99).all())


def _positions_on_common_stamps(group: Sequence[Recording]) -> NDArray[np.float64]:
    """Positions of all takes on the stamps of the first, as far as all of them last. Shape (R, T, J)."""
    stamps = group[0].time - group[0].time[0]
    stamps = stamps[stamps <= min(take.duration for take in group)]
    return np.stack(
        [
            np.column_stack([np.interp(stamps, take.time - take.time[0], joint) for joint in take.position.T])
            for take in group
        ]
    )
