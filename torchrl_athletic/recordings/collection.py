"""Playing excitations on an arm and writing down what it does: equivalent targets, a watchdog, takes that resume.

Motors such as the Z1's take a position target, gains and a torque to be added. A torque wave about a held pose is then
the same as a position target that moves: k_p (q* - q) - k_d q' + τ = k_p (q* + τ / k_p - q) - k_d q'. Takes are
recorded with that target, so that whatever replays them closes the same loop about the simulated arm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_athletic.recordings.excitation import Excitation, ExcitationError
from torchrl_athletic.recordings.formats import read_recordings
from torchrl_athletic.recordings.recording import Recording

Floats = NDArray[np.float64]


class TakeStopped(RuntimeError):
    """The watchdog ended a take; the message says which joint left which limit, and when."""


class Reading(Protocol):
    """What an arm reports at one instant, in the order of its joints."""

    @property
    def position(self) -> Floats:
        """[rad]. Shape (J,)."""

    @property
    def velocity(self) -> Floats:
        """[rad/s]. Shape (J,)."""

    @property
    def torque(self) -> Floats:
        """Motor current times a constant [N·m]. Shape (J,)."""


class Arm(Protocol):
    """What an arm must be able to do so that takes can be recorded on it; a real one keeps the time itself."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Length J."""

    @property
    def rate(self) -> float:
        """Commands and readings a second [Hz]."""

    def reset(self, pose: Floats, kp: Floats, kd: Floats) -> Reading:
        """Go slowly to a pose, hold it with these gains until all is still, and report."""

    def step(self, target: Floats) -> Reading:
        """Send position targets [rad], shape (J,), wait for the next instant, and report."""

    def stop(self) -> None:
        """Make the arm safe: whatever that means for this one. Called whenever a take ends, or fails."""


@dataclass(frozen=True)
class Watchdog:
    """What a measured joint may do before the take is stopped.

    Example:
        >>> watchdog = Watchdog(np.array([[-1.0, 1.0]]), np.array([3.0]), np.array([30.0]))
        >>> watchdog.check(("hinge",), 0.5, np.array([0.0]), np.array([-4.0]), np.array([1.0]))
        Traceback (most recent call last):
        ...
        torchrl_athletic.recordings.collection.TakeStopped: 0.500 s: velocity of hinge is -4, its limit is 3...
    """

    position: Floats
    """Lowest and highest [rad]. Shape (J, 2)."""
    velocity: Floats
    """Fastest [rad/s]. Shape (J,)."""
    torque: Floats
    """Largest [N·m]. Shape (J,)."""

    def check(self, names: Sequence[str], time: float, position: Floats, velocity: Floats, torque: Floats) -> None:
        """Pass, or stop.

        Args:
            names: Of the joints. Length J.
            time: Since the take began [s].
            position: Measured [rad]. Shape (J,).
            velocity: Measured [rad/s]. Shape (J,).
            torque: Measured [N·m]. Shape (J,).

        Raises:
            TakeStopped: If a value lies beyond its limit, or is not a number.
        """
        limits = {"velocity": self.velocity, "torque": self.torque}
        seen = {"position": position, "velocity": velocity, "torque": torque}
        for what, values in seen.items():
            low, high = self.position.T if what == "position" else (-limits[what], limits[what])
            outside = ~((values >= low) & (values <= high))  # NaN is outside
            if outside.any():
                j = int(np.argmax(outside))
                limit = f"{low[j]:.4g} to {high[j]:.4g}" if what == "position" else f"{high[j]:.4g}"
                raise TakeStopped(
                    f"{time:.3f} s: {what} of {names[j]} is {values[j]:.4g}, its limit is {limit}. Look at the arm, "
                    "then lower the amplitudes, or choose a pose with more room; takes already written are kept."
                )


def held(excitation: Excitation, pose: ArrayLike, kp: ArrayLike, position_limit: ArrayLike) -> Excitation:
    r"""The position targets that are equivalent to a torque wave about a held pose.

    .. math:: q_{eq} = \mathrm{clip}(q_{hold} + \tau / k_p)

    Args:
        excitation: Torques [N·m].
        pose: That is held [rad]. Shape (J,).
        kp: Of the joints' controllers [N·m/rad]. Shape (J,).
        position_limit: Lowest and highest target [rad]. Shape (J, 2).

    Returns:
        Targets [rad]; the metadata says how many samples were clipped.

    Raises:
        ExcitationError: If these are no torques, a gain is not positive, or the pose lies outside the limits.

    Example:
        >>> from torchrl_athletic.recordings import sine
        >>> wave = held(sine(("hinge",), "hinge", [(8.0, 1.0)]), [0.5], [64.0], [[-1.0, 1.0]])
        >>> wave.field, float(wave.command.max())
        ('position_target', 0.625)
    """
    if excitation.field != "torque_command":
        raise ExcitationError(
            f"the excitation is a {excitation.field}, which needs no equivalent target. Play it as it is, or make it "
            "with field='torque_command'."
        )
    hold, gain, limit = (np.asarray(x, dtype=np.float64) for x in (pose, kp, position_limit))
    joints = len(excitation.joint_names)
    if hold.shape != (joints,) or gain.shape != (joints,) or limit.shape != (joints, 2):
        raise ExcitationError(
            f"pose, kp and position_limit have shapes {hold.shape}, {gain.shape} and {limit.shape}; for {joints} "
            f"joints they must be ({joints},), ({joints},) and ({joints}, 2)."
        )
    if not (gain > 0).all():
        raise ExcitationError(
            f"kp is {gain}: without stiffness no target is equivalent to a torque. Record torque commands instead."
        )
    if not ((hold >= limit[:, 0]) & (hold <= limit[:, 1])).all():
        j = int(np.argmax((hold < limit[:, 0]) | (hold > limit[:, 1])))
        raise ExcitationError(
            f"{excitation.joint_names[j]} is to be held at {hold[j]:.4g} rad, outside {limit[j, 0]:.4g} to "
            f"{limit[j, 1]:.4g}. Choose a pose within the limits."
        )
    wanted = hold + excitation.command / gain
    target = np.clip(wanted, limit[:, 0], limit[:, 1])
    clipped = int((target != wanted).any(axis=1).sum())
    metadata = {**excitation.metadata, "hold": hold.tolist(), "clipped_targets": clipped}
    return replace(excitation, command=target, field="position_target", metadata=metadata)


def through_poses(
    joint_names: Sequence[str], poses: Sequence[tuple[float, ArrayLike]], rate: float = 200.0, kind: str = "throw"
) -> Excitation:
    """Position targets from pose to pose with the least jerk, at rest in each.

    Args:
        joint_names: All joints, in the model's order.
        poses: (when it is reached [s], pose [rad] of shape (J,)), from time 0 on.
        rate: Sampling rate of the command [Hz].
        kind: Its name.

    Raises:
        ExcitationError: If there are fewer than two poses, or their times do not increase from 0.

    Source:
        Flash, Hogan 1985, J. Neuroscience 5(7): s(u) = 10 u³ - 15 u⁴ + 6 u⁵.

    Example:
        >>> swing = through_poses(("hinge",), [(0.0, [0.0]), (1.0, [2.0])])
        >>> swing.command.shape, float(swing.command[100, 0])
        ((200, 1), 1.0)
    """
    when = np.array([time for time, _ in poses])
    if len(when) < 2 or when[0] != 0 or not (np.diff(when) > 0).all():
        raise ExcitationError(f"poses are reached at {when.tolist()} s. Give two or more, later and later, from 0 on.")
    places = np.array([np.broadcast_to(np.asarray(pose, dtype=np.float64), (len(joint_names),)) for _, pose in poses])
    time = np.arange(int(np.floor(when[-1] * rate + 1e-9))) / rate
    leg = np.clip(np.searchsorted(when, time, side="right") - 1, 0, len(when) - 2)
    u = ((time - when[leg]) / np.diff(when)[leg])[:, None]
    command = places[leg] + (10 * u**3 - 15 * u**4 + 6 * u**5) * (places[leg + 1] - places[leg])
    passed = [[float(t), place.tolist()] for t, place in zip(when, places, strict=True)]
    metadata = {"excitation": kind, "rate": rate, "poses": passed}
    return Excitation(time, command, tuple(joint_names), kind, "position_target", metadata)


def beginning(excitation: Excitation, seconds: float) -> Excitation:
    """The first seconds of an excitation, to try things out.

    Raises:
        ExcitationError: If less than two samples would be left.

    Example:
        >>> len(beginning(through_poses(("hinge",), [(0.0, [0.0]), (1.0, [2.0])]), 0.5).time)
        100
    """
    count = int(np.count_nonzero(excitation.time < seconds - 1e-9))
    if count < 2:
        raise ExcitationError(f"{seconds} s leave {count} samples of a take. Give at least two: longer.")
    metadata = {**excitation.metadata, "cut": seconds} if count < len(excitation.time) else excitation.metadata
    return replace(excitation, time=excitation.time[:count], command=excitation.command[:count], metadata=metadata)


def recorded(path: str | Path, excitation: Excitation) -> bool:
    """Whether a file holds the take of this excitation already, so that a run that was cut short can go on.

    Raises:
        ExcitationError: If it holds another one: takes of different settings would mix.
    """
    if not Path(path).exists():
        return False
    command = read_recordings(path)[0].command
    if not np.array_equal(command, excitation.command):
        raise ExcitationError(
            f"{path} holds a take with another command ({len(command)} samples; now {len(excitation.command)}): it was "
            "recorded with other settings. Move it away, or write to another folder."
        )
    return True


def record(
    arm: Arm,
    excitation: Excitation,
    pose: ArrayLike,
    kp: ArrayLike,
    kd: ArrayLike,
    watchdog: Watchdog,
    metadata: Mapping[str, Any] | None = None,
    each: Callable[[], object] = lambda: None,
) -> Recording:
    """Play one excitation, and watch every sample.

    Row k of the recording was read just before target k was sent.

    Args:
        arm: On which.
        excitation: Position targets; of torques, those of :func:`held`.
        pose: To begin at, at rest [rad]. Shape (J,).
        kp: [N·m/rad]. Shape (J,).
        kd: [N·m·s/rad]. Shape (J,).
        watchdog: Checks each reading.
        metadata: Added to the excitation's own.
        each: Called after each sample, for a progress bar.

    Raises:
        TakeStopped: If the watchdog says so; the arm has been stopped by then.
        ExcitationError: If joints, rate or kind of the command are not the arm's.
    """
    if excitation.field != "position_target":
        raise ExcitationError("the arm takes position targets, and the excitation is a torque. Pass it through held().")
    if excitation.joint_names != tuple(arm.joint_names):
        raise ExcitationError(
            f"the excitation moves {', '.join(excitation.joint_names)}, the arm has {', '.join(arm.joint_names)}. "
            "Make it with the arm's joint_names."
        )
    rate = 1.0 / float(excitation.time[1] - excitation.time[0])
    if abs(rate - arm.rate) > 1e-6 * rate:
        raise ExcitationError(
            f"the excitation has {rate:g} samples a second and the arm takes {arm.rate:g}: it would be played at "
            f"another speed. Make it with rate={arm.rate:g}."
        )
    gains = np.asarray(kp, dtype=np.float64), np.asarray(kd, dtype=np.float64)
    rows = []
    try:
        now = arm.reset(np.asarray(pose, dtype=np.float64), *gains)
        for time, target in zip(excitation.time, excitation.command, strict=True):
            watchdog.check(arm.joint_names, float(time), now.position, now.velocity, now.torque)
            rows.append((now.position, now.velocity, now.torque))
            now = arm.step(target)
            each()
    finally:
        arm.stop()
    position, velocity, torque = (np.stack(column) for column in zip(*rows, strict=True))
    return Recording(
        time=excitation.time,
        joint_names=excitation.joint_names,
        position=position,
        velocity=velocity,
        position_target=excitation.command,
        kp=gains[0],
        kd=gains[1],
        torque_measured=torque,
        torque_semantics="current_derived",
        metadata={**excitation.metadata, **(metadata or {})},
    )
