"""Recordings as everything that replays them takes them: on the grid of the physics, in the robot's order."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings import Recording, RecordingError, resample
from torchrl_athletic.robots import Robot

Array = NDArray[np.float64]

SAME_RATE = 1e-3
"""Rates that differ by less than this share count as one: over 5 min a command is then off by 0.3 s at most."""


def on_grid(recording: Recording, robot: Robot) -> Recording:
    """The take on the time step of the robot's physics, with a velocity; the joints stay as they are.

    Args:
        recording: Of any rate; resampled if it is off by more than :data:`SAME_RATE`, or if rows were lost.
        robot: Whose time step counts.

    Raises:
        RecordingError: If the take has gaps, since positions in them would be made up.

    Example:
        >>> from torchrl_athletic.robots import z1
        >>> time = np.arange(0.0, 1.0, 0.01)
        >>> take = Recording(time, ("joint1",), np.sin(time)[:, None], torque_command=np.zeros((100, 1)))
        >>> fine = on_grid(take, z1())
        >>> round(fine.rate), fine.velocity.shape
        (200, (199, 1))
    """
    step = float(robot.model().opt.timestep)
    lost = bool((np.diff(recording.time) > 1.5 * step).any())  # one row a step would play what is left faster
    if lost or abs(recording.rate * step - 1) > SAME_RATE:
        recording = resample(recording, step)
    return recording if recording.velocity is not None else replace(recording, velocity=velocity_of(recording))


def on_all_joints(recording: Recording, robot: Robot) -> Recording:
    """The take :func:`on_grid`, with all joints of the robot in its order; measured torques are left out.

    Joints that a take of position targets does not name rest at the robot's default, with the robot's gains.

    Raises:
        RecordingError: If a joint is none of the robot's, or has no torque where torques are the command.
    """
    check_joints(recording, robot)
    recording = on_grid(recording, robot)
    columns = [robot.joint_names.index(name) for name in recording.joint_names]
    rest = np.tile(np.asarray(robot.default_pose), (recording.num_samples, 1))

    def spread(values: Array | None, others: Array) -> Array | None:
        if values is None:
            return None
        whole = others.copy()
        whole[..., columns] = values
        return whole

    whole = {name: spread(getattr(recording, name), rest) for name in ("position", "position_target", "torque_command")}
    whole["velocity"] = spread(recording.velocity, 0 * rest)
    whole |= {name: spread(getattr(recording, name), np.asarray(getattr(robot, name))) for name in ("kp", "kd")}
    bare = {"torque_measured": None, "torque_semantics": None}
    return replace(recording, joint_names=robot.joint_names, **whole, **bare)  # type: ignore[arg-type]


def velocity_of(recording: Recording) -> Array:
    """As logged; else the slope of a cubic through seven positions [rad/s]. Shape (T, J)."""
    if recording.velocity is not None:
        return recording.velocity
    from scipy.signal import savgol_filter

    length = min(7, recording.num_samples - 1 + recording.num_samples % 2)
    slope = savgol_filter(recording.position, length, min(3, length - 1), deriv=1, delta=1 / recording.rate, axis=0)
    return np.asarray(slope)


def digest_of(recordings: Sequence[Recording]) -> str:
    """Names what was recorded, whatever the files are called: other numbers, joints or gains give other digests.

    Example:
        >>> time = np.arange(0.0, 1.0, 0.01)
        >>> take = Recording(time, ("hinge",), np.sin(time)[:, None], torque_command=np.zeros((100, 1)))
        >>> digest_of([take]) == digest_of([replace(take, position=take.position + 1e-9)])
        False
    """
    total = hashlib.sha256()
    for recording in recordings:
        for name in ("time", "position", "velocity", "command", "kp", "kd", "torque_measured"):
            value = getattr(recording, name)
            total.update(f"{name} {None if value is None else value.shape}".encode())
            total.update(b"" if value is None else np.ascontiguousarray(value).tobytes())
        total.update(repr((recording.joint_names, recording.torque_command is None)).encode())
    return total.hexdigest()[:16]


def check_joints(recording: Recording, robot: Robot) -> None:
    """Refuse a take of joints that the robot lacks, or with joints that nothing would drive."""
    unknown = [name for name in recording.joint_names if name not in robot.joint_names]
    if unknown:
        raise RecordingError(
            f"{recording.source}: joint {unknown[0]!r} is none of {robot.name}'s {robot.joint_names}. Rename the "
            "columns, or give the robot that was recorded."
        )
    if recording.torque_command is not None and recording.num_joints < len(robot.joint_names):
        missing = [name for name in robot.joint_names if name not in recording.joint_names]
        raise RecordingError(
            f"{recording.source}: there is no torque of {missing}, which would fall limp in the replay. Record all "
            "joints, or take a model in which these are welded."
        )
