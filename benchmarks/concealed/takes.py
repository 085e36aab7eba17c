"""What a concealed robot is told, and what its log then holds: motions, encoders, clocks, losses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from benchmarks.concealed import plant
from benchmarks.concealed.plant import Drive
from benchmarks.concealed.robots import Robot
from torchrl_athletic.recordings import Recording

Array = NDArray[np.float64]
Mode = Literal["torque_command", "position_target"]
FIT_KINDS = ("multisine", "chirp", "square", "sweep", "random")
HELDOUT_KINDS = ("gait", "poses")
DITHERED = ("square", "random", "chirp")
"""Kinds with a random telegraph signal on the torque, which timing shows in."""


@dataclass(frozen=True)
class Sensors:
    """Encoders, clocks and the logger, the same for all takes of a robot."""

    bits: int = 17
    """Counts per turn, or per metre, as a power of two."""
    noise: float = 3e-5
    """Standard deviation of a reading [rad, m]."""
    correlation: float = 0.0
    """Correlation of that noise from one sample to the next [1]."""
    velocity: Literal["measured", "difference"] | None = "measured"
    velocity_noise: float = 3e-3
    """[rad/s, m/s]"""
    loop_jitter: float = 0.0
    """Jitter of the control loop's period, honestly stamped [1]."""
    stamp_jitter: float = 0.0
    """Jitter of the stamps, as a share of the period [1]."""
    dropouts: float = 0.0
    """Share of rows that the logger loses, in bursts [1]."""
    clock_offset: float = 0.0
    """Position stamps are late by so much against those of the commands [s]."""


def draw_sensors(rng: np.random.Generator, rate: float) -> Sensors:
    """Sensors with all their nuisances."""
    velocity = rng.choice(["measured", "difference", "none"], p=[0.55, 0.2, 0.25])
    return Sensors(
        bits=int(rng.integers(12, 18)),
        noise=float(np.exp(rng.uniform(np.log(1e-5), np.log(2e-4)))),
        correlation=float(rng.uniform(0.0, 0.9)),
        velocity=None if velocity == "none" else velocity,
        velocity_noise=float(np.exp(rng.uniform(np.log(1e-3), np.log(1e-2)))),
        loop_jitter=float(rng.choice([0.0, rng.uniform(0.002, 0.03)])),
        stamp_jitter=float(rng.choice([0.0, rng.uniform(0.001, 0.01)])),
        dropouts=float(rng.choice([0.0, rng.uniform(0.001, 0.01)], p=[0.6, 0.4])),
        clock_offset=float(rng.uniform(-0.25, 0.25) / rate),
    )


@dataclass(frozen=True, eq=False)
class Plan:
    """Motion that a take asks for."""

    kind: str
    time: Array
    """[s]. Shape (T,)."""
    position: Array
    """[rad]. Shape (T, J)."""
    velocity: Array
    acceleration: Array
    dither: Array
    """Torque beside what the motion needs, where torques are sent [N·m]. Shape (T, J)."""


def plan(robot: Robot, kind: str, duration: float, rate: float, amplitude: float, rng: np.random.Generator) -> Plan:
    """A motion within the robot's reach and, by its model, within 0.6 of its torques.

    Args:
        robot: Its model sets the torques.
        kind: One of ``FIT_KINDS`` or ``HELDOUT_KINDS``.
        duration: [s]
        rate: [Hz]
        amplitude: Share of the reach [1].
        rng: Of the signal.
    """
    time = np.arange(round(duration * rate)) / rate
    shape = np.stack([_KINDS[kind](time, rng) for _ in range(robot.joints)], axis=1)
    shape *= np.minimum(1.0, time / 1.0)[:, None] ** 2  # from rest at the centre
    shape = gaussian_filter1d(shape, 0.02 * rate, axis=0)
    while True:
        position = robot.centre + amplitude * robot.reach * shape
        velocity = np.gradient(position, 1 / rate, axis=0)
        acceleration = np.gradient(velocity, 1 / rate, axis=0)
        result = Plan(kind, time, position, velocity, acceleration, np.zeros_like(position))
        torque = np.abs(nominal_torque(robot, every_10_ms(result)))
        if (torque < 0.6 * robot.torque_limit).all() or amplitude < 0.05:
            break
        amplitude *= 0.85
    if kind in DITHERED:
        share = rng.uniform(0.05, 0.2) * np.sqrt((torque**2).mean(0))
        result = replace(result, dither=share * _telegraph(time, robot.joints, rng))
    return result


def every_10_ms(motion: Plan) -> Plan:
    """Show the motion every 10 ms only, which shows what it takes as well."""
    every = slice(None, None, max(1, round(0.010 / (motion.time[1] - motion.time[0]))))
    rows = (motion.time, motion.position, motion.velocity, motion.acceleration, motion.dither)
    return Plan(motion.kind, *(np.ascontiguousarray(x[every]) for x in rows))  # strides would be compiled for anew


def nominal_torque(robot: Robot, motion: Plan) -> Array:
    """Torque that the model asks for [N·m]. Shape (T, J)."""
    torque, _ = plant.inverse(robot.tree, motion.position, motion.velocity, motion.acceleration)
    return np.asarray(torque + robot.armature * motion.acceleration + robot.damping * motion.velocity)


def _telegraph(t: Array, joints: int, rng: np.random.Generator) -> Array:
    """Plus or minus one, held for 10 to 80 ms. Shape (T, J)."""
    out = np.empty((len(t), joints))
    for j in range(joints):
        edges = np.cumsum(rng.uniform(0.010, 0.080, int(t[-1] / 0.010) + 2))
        out[:, j] = np.where(np.searchsorted(edges, t) % 2, 1.0, -1.0)
    return out


def _multisine(t: Array, rng: np.random.Generator) -> Array:
    f = np.geomspace(0.1, 2.8, 9) * rng.uniform(0.9, 1.1, 9)
    x = (np.sin(2 * np.pi * (f * t[:, None] + rng.random(9))) / (1 + f / 0.6)).sum(1)
    return np.asarray((x - x[0]) / np.abs(x - x[0]).max())


def _chirp(t: Array, rng: np.random.Generator) -> Array:
    low, high, period = 0.1, rng.uniform(3.0, 5.0), t[-1] * rng.uniform(0.5, 1.0)
    up = (t / period) % 1.0
    up = up if rng.random() < 0.5 else 1.0 - up
    f = low * (high / low) ** up
    phase = 2 * np.pi * np.cumsum(f) * (t[1] - t[0])
    return np.asarray(np.sin(phase) / (1 + (f / 0.7) ** 1.5))


def _square(t: Array, rng: np.random.Generator) -> Array:
    edges = np.cumsum(rng.uniform(0.5, 2.0, int(t[-1] / 0.5) + 3))
    levels = rng.uniform(0.2, 0.9, len(edges) + 1) * np.where(np.arange(len(edges) + 1) % 2, 1.0, -1.0)
    x = levels[np.searchsorted(edges, t)]
    step = t[1] - t[0]
    return np.asarray(gaussian_filter1d(x, 0.06 / step) + 0.1 * np.sin(2 * np.pi * rng.uniform(1.0, 2.0) * t))


def _sweep(t: Array, rng: np.random.Generator) -> Array:
    step, x, left, pace = 0.01, 0.0, 0.0, 0.0
    coarse = np.arange(0.0, t[-1] + step, step)
    out = np.empty(len(coarse))
    for i in range(len(coarse)):
        if left <= 0.0:
            left = rng.uniform(0.8, 3.0)
            pace = float(np.exp(rng.uniform(np.log(0.06), np.log(1.2)))) * (1.0 if rng.random() < 0.5 else -1.0)
        if abs(x + pace * step) > 1.0:
            pace = -pace
        x += pace * step
        left -= step
        out[i] = x
    return np.asarray(gaussian_filter1d(np.interp(t, coarse, out), 0.04 / (t[1] - t[0])))


def _random(t: Array, rng: np.random.Generator) -> Array:
    step = t[1] - t[0]
    x = gaussian_filter1d(rng.normal(size=len(t)), 0.16 / step) + gaussian_filter1d(rng.normal(size=len(t)), 0.6 / step)
    return np.asarray(x / np.abs(x).max())


def _gait(t: Array, rng: np.random.Generator) -> Array:
    f, x = rng.uniform(0.4, 1.1), np.zeros(len(t))
    for n in (1, 2, 3):
        x += rng.uniform(0.3, 1.0) / n**1.5 * np.sin(2 * np.pi * (n * f * t + rng.random()))
    return np.asarray(x / np.abs(x).max())


def _poses(t: Array, rng: np.random.Generator) -> Array:
    out, now, x = np.empty(len(t)), 0.0, 0.0
    while now <= t[-1]:
        travel, dwell, goal = rng.uniform(0.4, 1.5), rng.uniform(0.1, 0.6), rng.uniform(-1, 1)
        inside = (t >= now) & (t <= now + travel + dwell + 1e-9)
        s = np.clip((t[inside] - now) / travel, 0, 1)
        out[inside] = x + (goal - x) * s**3 * (10 - 15 * s + 6 * s * s)
        now, x = now + travel + dwell, goal
    return out


_KINDS: dict[str, Callable[[Array, np.random.Generator], Array]] = {
    "multisine": _multisine, "chirp": _chirp, "square": _square, "sweep": _sweep, "random": _random,
    "gait": _gait, "poses": _poses,
}  # fmt: skip


def drive_for(
    robot: Robot, motion: Plan, mode: Mode, kp: Array, kd: Array, sensors: Sensors, take: int, rng: np.random.Generator
) -> Drive:
    """The take as the plant needs it: instants of loop and encoders with their jitter, noise of the readings."""
    samples, n = motion.position.shape
    period = motion.time[1] - motion.time[0]
    jitter = np.clip(sensors.loop_jitter * rng.normal(size=samples), -0.3, 0.3)
    time = motion.time + period * jitter
    late = np.clip(sensors.stamp_jitter * rng.normal(size=samples), -0.1, 0.1) * period
    rho = sensors.correlation
    white = sensors.noise * rng.normal(size=(samples, n))
    noise = lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], white, axis=0)
    resolution = np.where(robot.tree.slide, 1.0, 2 * np.pi) / 2.0**sensors.bits
    feedforward = nominal_torque(robot, motion) + motion.dither
    return Drive(
        time, motion.position, motion.velocity, feedforward, kp, kd, robot.torque_limit,
        mode == "position_target", time - sensors.clock_offset + late, noise, resolution, float(take),
    )  # fmt: skip


def log(robot: Robot, drive: Drive, sensors: Sensors, command: Array, reading: Array, speed: Array,
        source: str, rng: np.random.Generator) -> Recording:  # fmt: skip
    """What the logger keeps of a take."""
    velocity: Array | None = None
    if sensors.velocity == "measured":
        velocity = speed + sensors.velocity_noise * rng.normal(size=speed.shape)
    elif sensors.velocity == "difference":
        velocity = np.diff(reading, axis=0, prepend=reading[:1]) / np.gradient(drive.time)[:, None]
        velocity[0] = 0.0
    keep = np.ones(len(command), dtype=bool)
    while (~keep).mean() < sensors.dropouts:
        start = int(rng.integers(1, len(keep) - 12))
        keep[start : start + int(rng.integers(1, 11))] = False
    targets = drive.position_control
    return Recording(
        drive.time[keep], robot.joint_names, reading[keep],
        velocity=None if velocity is None else velocity[keep],
        torque_command=None if targets else command[keep],
        position_target=command[keep] if targets else None,
        kp=drive.kp if targets else None,
        kd=drive.kd if targets else None,
        metadata={"robot": robot.name},
        source=source,
    )  # fmt: skip


def perfect(sensors: Sensors) -> Sensors:
    """The loop with encoders that do not err, for the oracle."""
    return replace(sensors, bits=40, noise=0.0, stamp_jitter=0.0, dropouts=0.0, velocity="measured", velocity_noise=0.0)
