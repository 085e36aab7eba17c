"""Recording sessions with a simulated machine: what is sent to it, and what its log then holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.signal import lfilter

from torchrl_athletic.recordings.demo.effect import HiddenEffect, machine_with
from torchrl_athletic.recordings.demo.robot import Robot
from torchrl_athletic.recordings.demo.simulation import simulate
from torchrl_athletic.recordings.excitation import (
    CommandField,
    Excitation,
    Safety,
    amplitude_frequency_pairs,
    chirp,
    gaussian,
    multisine,
    sine,
    square,
)
from torchrl_athletic.recordings.recording import Recording

Array = NDArray[np.float64]
Kind = Literal["gaussian", "square", "sine", "chirp", "multisine"]

_STEP = 0.001
"""Step of the integrator [s]. A joint that breaks loose within a step costs 2 µrad at most, a fiftieth of the noise."""
_COMMANDS = ("torque_command", "position_target")
_SLEW = 6.0
"""Fastest change of a position target, in amplitudes a second."""


@dataclass(frozen=True)
class Sensors:
    """What stands between the true motion and the log. The defaults are those of a good encoder."""

    position_noise: float = 1e-4
    """Standard deviation [rad]."""
    velocity_noise: float | None = 5e-3
    """Standard deviation [rad/s]. None: velocity is not logged."""
    correlation: float = 0.0
    """Correlation of the noise from one sample to the next (AR(1)), 0 for white noise [1]."""
    encoder_bits: int | None = None
    """Counts per turn (per metre), as a power of two; None does not round the position."""
    loop_jitter: float = 0.0
    """Standard deviation of the instants at which the loop runs, honestly stamped [s]."""
    stamp_jitter: float = 0.0
    """Standard deviation of the stamps about these instants [s]."""
    dropouts: float = 0.0
    """Share of the rows that the logger loses, in bursts of 1 to 20 [1]. The robot gets their commands all the same."""


def make_recordings(
    robot: Robot,
    effects: Sequence[HiddenEffect] = (),
    kinds: Sequence[Kind] = ("gaussian",),
    seed: int = 0,
    duration: float = 15.0,
    rate: float = 200.0,
    sensors: Sensors = Sensors(),
    field: CommandField = "torque_command",
    kp: ArrayLike | None = None,
    kd: ArrayLike | None = None,
    drive_period: float = 0.001,
) -> list[Recording]:
    """Record a machine that hides effects, one take a kind of excitation.

    Args:
        robot: What the model describes.
        effects: What it leaves out; none makes data without anything missing.
        kinds: One take each. 'square', 'sine' and 'chirp' move one joint after the other, 'gaussian' and 'multisine'
            all at once.
        seed: Of excitation and noise. The same seed gives the same data.
        duration: Of each take [s].
        rate: Of the log, and of the commands [Hz].
        sensors: Noise, rounding, jitter, losses.
        field: Whether torques or position targets are sent.
        kp: Gain as the log says it [N·m/rad]. Shape (J,). The robot's if None.
        kd: The same of the velocity [N·m·s/rad]. Shape (J,).
        drive_period: Of the drive's position loop [s]. Its torque is held for so long, so it comes half of that late:
            at 1 ms this is some 2 % of the torque, which a diagnosis of quiet data may notice.

    Example:
        >>> from torchrl_athletic.recordings.demo import HiddenEffect, make_recordings, pendulum
        >>> dry = HiddenEffect("coulomb_friction", "pendulum", {"torque": 0.2})
        >>> [take] = make_recordings(pendulum(), [dry], ["chirp"], duration=2.0)
        >>> take.position.shape, take.metadata["excitation"]
        ((400, 1), 'chirp')
    """
    machine = machine_with(robot, effects)
    gains = (_gain(robot.kp if kp is None else kp, robot), _gain(robot.kd if kd is None else kd, robot))
    takes = []
    for number, kind in enumerate(kinds):
        rng = np.random.default_rng([seed, number])
        command, notes = excitation_for(robot, kind, int(rng.integers(2**31)), duration, rate, field)
        time = _jittered(np.arange(len(command)) / rate, sensors.loop_jitter, rng)
        targets = field == "position_target"
        position, velocity = simulate(machine, time, command, targets, None, gains, drive_period, _STEP)
        position = position + np.array([drive.offset for drive in machine.drives])
        take = Recording(
            time,
            robot.joint_names,
            position,
            velocity=velocity,
            torque_command=None if targets else command,
            position_target=command if targets else None,
            kp=gains[0] if targets else None,
            kd=gains[1] if targets else None,
            metadata={"robot": robot.name, **notes},
            source=f"{robot.name}_{number + 1}_{kind}",
        )
        takes.append(_logged(take, sensors, rng, turn=1.0 if robot.slide else 2 * np.pi))
    return takes


def excitation_for(
    robot: Robot, kind: Kind, seed: int, duration: float, rate: float = 200.0, field: CommandField = "torque_command"
) -> tuple[Array, Mapping[str, object]]:
    """A command within the robot's amplitudes.

    Returns:
        Torques [N·m] or targets [rad], shape (T, J), and what to note down of them.
    """
    names = robot.joint_names
    targets = field == "position_target"
    safety = Safety(limit=1.0, clip=kind == "gaussian", fade=0.25, slew=_SLEW if targets else None)
    share = duration / len(names)
    if kind == "gaussian":
        hold = (0.05, 0.8) if targets else (0.005, 0.4)
        parts = [gaussian(names, 0.45, seed, duration, rate, hold, field=field, safety=safety)]
    elif kind == "multisine":
        parts = [
            multisine(names, None, 1.0, (0.2, 2.0 if targets else 6.0), duration, rate=rate, field=field, safety=safety)
        ]
    elif kind == "chirp":
        highest = 2.0 if targets else 6.0
        parts = [chirp(names, joint, 1.0, (0.2, highest), share, rate, field=field, safety=safety) for joint in names]
    else:
        wave, pairs = (square if kind == "square" else sine), _pairs(share, seed, targets)
        parts = [wave(names, joint, pairs, rate, share / len(pairs), field, safety) for joint in names]
    command = np.concatenate([part.command for part in parts])
    amplitude = np.asarray(robot.target_amplitude if targets else robot.torque_amplitude)
    return command * amplitude, _notes(parts)


def _pairs(seconds: float, seed: int, targets: bool) -> list[tuple[float, float]]:
    """As many pairs of amplitude and frequency as have room, two seconds each, drawn without replacement."""
    pairs = amplitude_frequency_pairs(1.0, frequencies=(0.25, 0.5, 1.0, 2.0) if targets else (0.5, 1.0, 2.0, 4.0))
    number = min(max(round(seconds / 2.0), 1), len(pairs))
    return [pairs[i] for i in np.random.default_rng(seed).permutation(len(pairs))[:number]]


def _notes(parts: Sequence[Excitation]) -> Mapping[str, object]:
    return {"excitation": parts[0].kind, "rate": parts[0].metadata["rate"]}


def _logged(take: Recording, sensors: Sensors, rng: np.random.Generator, turn: float) -> Recording:
    """What is left of the true motion in the log."""
    assert take.velocity is not None
    position = take.position + sensors.position_noise * _noise(take.position.shape, sensors.correlation, rng)
    if sensors.encoder_bits is not None:
        count = turn / 2**sensors.encoder_bits
        position = count * np.round(position / count)
    velocity = None
    if sensors.velocity_noise is not None:
        velocity = take.velocity + sensors.velocity_noise * _noise(take.velocity.shape, sensors.correlation, rng)
    rows = _kept(take.num_samples, sensors.dropouts, rng)
    stamps = _jittered(take.time, sensors.stamp_jitter, rng)
    return replace(
        take,
        time=stamps[rows],
        position=position[rows],
        velocity=None if velocity is None else velocity[rows],
        **{name: getattr(take, name)[rows] for name in _COMMANDS if getattr(take, name) is not None},
    )


def _gain(values: ArrayLike, robot: Robot) -> Array:
    return np.array(np.broadcast_to(np.asarray(values, dtype=np.float64), (len(robot.links),)))


def _jittered(time: Array, deviation: float, rng: np.random.Generator) -> Array:
    """Scattered instants in unchanged order, none further off than 0.4 of the shortest period."""
    if deviation == 0:
        return time
    bound = 0.4 * np.diff(time).min()
    return time + np.clip(rng.normal(0.0, deviation, len(time)), -bound, bound)


def _noise(shape: tuple[int, ...], correlation: float, rng: np.random.Generator) -> Array:
    """Unit variance, white or AR(1)."""
    white = rng.standard_normal(shape)
    if correlation == 0:
        return white
    white[1:] *= np.sqrt(1 - correlation**2)
    return np.asarray(lfilter([1.0], [1.0, -correlation], white, axis=0))


def _kept(samples: int, share: float, rng: np.random.Generator) -> NDArray[np.intp]:
    if not 0 <= share <= 0.5:
        raise ValueError(f"dropouts are a share of the rows, 0 to 0.5; came {share}.")
    keep = np.ones(samples, dtype=bool)
    while 1 - keep.mean() < share:
        start = int(rng.integers(1, samples - 20))
        keep[start : start + int(rng.integers(1, 21))] = False
    return np.flatnonzero(keep)
