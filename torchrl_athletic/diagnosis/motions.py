"""Motions that a robot may be asked for: sines, constant speeds, steps, chirps, all joints at once, within limits."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.thresholds import PLAN
from torchrl_athletic.effects.effect import is_slide, torque_scale
from torchrl_athletic.effects.signals import HALF_POWER, QUICKEST, JointAddress, Signals, torque_range
from torchrl_athletic.recordings import ExcitationError, Safety, chirp, multisine, sine, square

Array = NDArray[np.float64]

QUICK = (0.6, 1.0, 0.3, 0.15, 0.07)
"""Upper ends of the bands of small quick motions, which show what slow ones hide: in units of the highest frequency
that the narrowest test function passes. Wide bands, since in a narrow one a lag is a delay."""
ROUNDING: Mapping[str, float] = {"steps": 0.02, "sweep": 0.05}
"""Least width of the Gaussian that rounds corners which no drive can follow [s]."""


@dataclass(frozen=True, eq=False)
class Limits:
    """What robot and surroundings can take. State yours; :meth:`of` guesses from the model and the recordings."""

    position: Array
    """Lowest and highest position [rad, m]. Shape (J, 2)."""
    velocity: Array
    """Fastest motion [rad/s, m/s]. Shape (J,)."""
    torque: Array
    """Largest torque [N·m, N]. Shape (J,)."""
    frequency: float = np.inf
    """Highest frequency in a motion, of rounded corners that at half power [Hz]. Lower where something is loose."""

    @classmethod
    def of(cls, takes: Sequence[Signals]) -> Limits:
        """The model's joint and motor limits.

        Where it states none, 1 rad to both sides of the start, and half more speed and torque than was recorded (but
        2 rad/s, and what bears the link).
        """
        s = takes[0]
        model, address, joints = s.nominal, s.address, range(s.num_joints)
        slide = np.array([is_slide(model, address, j) for j in joints])
        recorded = np.concatenate([t.recording.position for t in takes])
        start = s.recording.position[0]
        reach = np.where(slide, 0.0, 1.0)
        low, high = np.minimum(recorded.min(0), start - reach), np.maximum(recorded.max(0), start + reach)
        limited = model.jnt_limited[address.joint].astype(bool)
        given = model.jnt_range[address.joint]
        clear = np.where(slide, 0.05 * (given[:, 1] - given[:, 0]), 0.06)
        low = np.where(limited, np.minimum(given[:, 0] + clear, start), low)
        high = np.where(limited, np.maximum(given[:, 1] - clear, start), high)
        fastest = np.max([np.abs(t.velocity).max(0) for t in takes], axis=0)
        strongest = np.max([np.abs(t.command).max(0) for t in takes], axis=0)
        motor = np.minimum(*np.abs(torque_range(model, address)))
        typical = np.array([torque_scale(model, address, j) for j in joints])
        torque = np.where(np.isfinite(motor), motor, np.maximum(1.5 * strongest, typical))
        return cls(np.stack([low, high], -1), np.maximum(1.5 * fastest, np.where(slide, 0.0, 2.0)), torque)


@dataclass(frozen=True, eq=False)
class Motion:
    """What moves how, about which pose."""

    joint: str
    """The joint that moves, or 'all joints'."""
    kind: str
    """'sine', 'sweep' (constant speeds both ways), 'steps', 'chirp', 'mix' (of sines) or 'multisine'."""
    amplitude: float
    """Amplitude to both sides of the pose [rad, m]."""
    frequency: float
    """Frequency of its repetition, or the highest of a band [Hz]."""
    pose: Array
    """About which it moves [rad, m]. Shape (J,)."""
    wave: Array
    """Position about the pose. Shape (T, J)."""
    rounding: float = 0.0
    """Width of the Gaussian that rounds its corners [s]."""

    @property
    def highest(self) -> float:
        """The highest frequency in it: of its repetition, its band or its rounded corners [Hz]."""
        return max(self.frequency, HALF_POWER / self.rounding if self.rounding else 0.0)

    def smaller(self, share: float) -> Motion:
        """A copy with a share of the amplitude."""
        return replace(self, amplitude=share * self.amplitude, wave=share * self.wave)

    def words(self, unit: str) -> str:
        """As an instruction; ``unit`` of the amplitude."""
        size = f"±{self.amplitude:.2g} {unit}"
        how = {
            "sine": f"move {self.joint} in a sine of {size} at {self.frequency:.2g} Hz",
            "sweep": f"move {self.joint} both ways over {size} at a constant "
            f"{4 * self.amplitude * self.frequency:.2g} {unit}/s",
            "steps": f"step {self.joint} by {size} at {self.frequency:.2g} Hz",
            "chirp": f"move {self.joint} in a sine of {size} that rises from 0.2 to {self.frequency:.2g} Hz",
            "mix": f"move {self.joint} in a mix of sines by up to {size}, up to {self.frequency:.2g} Hz",
            "multisine": f"move all joints at once by up to {size}, up to {self.frequency:.2g} Hz",
        }[self.kind]
        return f"{how} about ({', '.join(f'{q + 0.0:.2f}' for q in self.pose)})"


def motions(takes: Sequence[Signals], limits: Limits, joints: Sequence[int], seconds: float) -> Iterator[Motion]:
    """Candidates within the limits, joints and kinds in turn, until there are enough."""
    low, high = limits.position.T
    start = takes[0].recording.position[0]
    names, middle, half = takes[0].recording.joint_names, (low + high) / 2, (high - low) / 2
    poses = [start] if len(names) == 1 else [start, middle + 0.5 * half]
    clearest = min(HALF_POWER / max(QUICKEST, 1.2 / min(takes[0].recording.rate, PLAN.rate)), limits.frequency)

    def kinds(j: int, pose: Array) -> list[Iterator[Motion]]:
        own = (names, j, pose, limits, seconds)
        return [_sweeps(*own), _mixes(*own, clearest), _sines(*own), _jumps(*own)]

    streams = [_in_turn(kinds(j, pose)) for pose in poses for j in joints]
    if len(names) > 1:
        streams.append(_of_all(names, middle, half, limits, seconds))
    yield from islice((m for m in _in_turn(streams) if m.highest <= limits.frequency), PLAN.motions)


def _in_turn(streams: Iterable[Iterator[Motion]]) -> Iterator[Motion]:
    """One of each stream after the other, until all are at their ends."""
    left = list(streams)
    while left:
        for stream in list(left):
            motion = next(stream, None)
            if motion is None:
                left.remove(stream)
            else:
                yield motion


def _sizes(joint: int, pose: Array, limits: Limits) -> Iterator[tuple[float, Array]]:
    """Amplitudes, the widest first, and poses about which they fit into the range."""
    low, high = limits.position[joint]
    for share in (1.0, 0.5, 0.2):
        amplitude = float(share * PLAN.margin * (high - low) / 2)
        yield amplitude, _about(pose, joint, amplitude, limits)


def _about(pose: Array, joint: int, amplitude: float, limits: Limits) -> Array:
    """The pose, moved until the motion is within its share of the range."""
    low, high = limits.position[joint]
    clear = amplitude + (1 - PLAN.margin) / 2 * (high - low)
    about = pose.copy()
    about[joint] = np.clip(pose[joint], low + clear, high - clear)
    return about


def _sweeps(names: tuple[str, ...], joint: int, pose: Array, limits: Limits, seconds: float) -> Iterator[Motion]:
    """One joint at constant speeds both ways."""
    name, fastest = names[joint], PLAN.margin * limits.velocity[joint]
    for amplitude, about in _sizes(joint, pose, limits):
        for speed in (0.8, 0.3, 0.1):
            frequency = float(speed * fastest / (4 * amplitude))
            whole = np.ceil(seconds * frequency) / frequency
            if 1 / seconds <= frequency <= 2.0:
                slewed = Safety(slew=speed * fastest)
                wave = square(names, name, [(amplitude, frequency)], PLAN.rate, whole, "position_target", slewed)
                way_back = _home(wave.command, speed * fastest)
                yield Motion(name, "sweep", amplitude, frequency, about, way_back, _rounding("sweep", limits))


def _mixes(
    names: tuple[str, ...], joint: int, pose: Array, limits: Limits, seconds: float, clearest: float
) -> Iterator[Motion]:
    """One joint quickly, as far as its speed allows, with the same speed at every frequency.

    With the same amplitude nearly all torque would be at the upper end, and a narrow band tells no lag from a delay.
    """
    low, high = limits.position[joint]
    name, fastest = names[joint], PLAN.margin * limits.velocity[joint]
    for share in QUICK:
        band = PLAN.slowest, max(share * clearest, PLAN.slowest + 2 / seconds)  # wide enough for some sines
        velocity = multisine(names, [name], 1.0, band, seconds, rate=PLAN.rate, field="position_target").command
        way = np.cumsum(velocity, axis=0) - np.cumsum(velocity, axis=0).mean(0)
        wave = way * _fade(len(way))[:, None]
        wave /= np.abs(wave).max()
        speed = PLAN.rate * float(np.abs(np.diff(wave, axis=0)).max())
        amplitude = min(0.5 * PLAN.margin * float(high - low) / 2, float(fastest) / speed)
        yield Motion(name, "mix", amplitude, band[1], _about(pose, joint, amplitude, limits), amplitude * wave)


def _fade(samples: int) -> Array:
    """Weight that goes from zero to one and back to zero within half a second of both ends. Shape (samples,)."""
    time = np.arange(samples) / PLAN.rate
    return np.asarray(np.sin(np.pi / 2 * np.clip(np.minimum(time, time[::-1]) / 0.5, 0.0, 1.0)) ** 2)


def _sines(names: tuple[str, ...], joint: int, pose: Array, limits: Limits, seconds: float) -> Iterator[Motion]:
    """One joint in sines, slow ones first."""
    name, fastest = names[joint], PLAN.margin * limits.velocity[joint]
    for amplitude, about in _sizes(joint, pose, limits):
        for frequency in (1 / seconds, 0.25, 0.5, 1.0, 2.0, 4.0):
            if 2 * np.pi * frequency * amplitude < fastest:
                faded = Safety(fade=min(1.0, 1 / frequency))
                wave = sine(names, name, [(amplitude, frequency)], PLAN.rate, seconds, "position_target", faded)
                yield Motion(name, "sine", amplitude, frequency, about, wave.command)


def _jumps(names: tuple[str, ...], joint: int, pose: Array, limits: Limits, seconds: float) -> Iterator[Motion]:
    """One joint in chirps and steps."""
    name, fastest = names[joint], PLAN.margin * limits.velocity[joint]
    for amplitude, about in _sizes(joint, pose, limits):
        highest = min(8.0, float(fastest / (2 * np.pi * amplitude)))
        if highest > 0.4:
            faded = Safety(fade=0.5)
            wave = chirp(
                names, name, amplitude, (0.2, highest), seconds, PLAN.rate, field="position_target", safety=faded
            )
            yield Motion(name, "chirp", amplitude, highest, about, wave.command)
        rounding = _rounding("steps", limits)
        if amplitude / (rounding * np.sqrt(2 * np.pi)) < fastest / 2:
            wave = square(names, name, [(amplitude, 1.0)], PLAN.rate, seconds, "position_target")
            yield Motion(name, "steps", amplitude, 1.0, about, _home(wave.command, fastest), rounding)


def _rounding(kind: str, limits: Limits) -> float:
    """Such that the corners hold no more than the highest frequency allowed [s]."""
    return max(ROUNDING[kind], HALF_POWER / limits.frequency)


def _home(wave: Array, speed: float) -> Array:
    """The wave, and from where it ends back to zero at a constant speed. Shape (T, J)."""
    count = int(np.ceil(np.abs(wave[-1]).max() / speed * PLAN.rate))
    return np.concatenate([wave, wave[-1] * np.linspace(1, 0, count + 1)[1:, None]])


def _of_all(names: tuple[str, ...], middle: Array, half: Array, limits: Limits, seconds: float) -> Iterator[Motion]:
    """All joints at once, each over the same share of its range, or as far as its speed allows."""
    for share, highest in ((0.8, 0.6), (0.4, 1.2), (0.15, 3.0)):
        try:
            wave = multisine(
                names,
                None,
                1.0,
                (0.2, highest),
                seconds,
                rate=PLAN.rate,
                field="position_target",
                safety=Safety(fade=0.5),
            ).command
        except ExcitationError:  # fewer harmonics than joints
            continue
        fastest = PLAN.rate * np.abs(np.diff(wave, axis=0)).max(0)
        amplitude = np.minimum(share * half, PLAN.margin * limits.velocity / fastest)
        yield Motion("all joints", "multisine", float(amplitude.max()), highest, middle, wave * amplitude)


def way(start: Array, end: Array, limits: Limits) -> Array:
    """Path from rest to rest, a fifth of a second still at both ends, at half the fastest speed. Shape (T, J)."""
    seconds = max(0.5, float((1.875 * np.abs(end - start) / (0.5 * limits.velocity)).max()))
    x = np.linspace(0, 1, round(seconds * PLAN.rate))[:, None]
    way = start + (end - start) * (10 * x**3 - 15 * x**4 + 6 * x**5)
    wait = round(0.2 * PLAN.rate)
    return np.concatenate([np.repeat(way[:1], wait, 0), way, np.repeat(way[-1:], wait, 0)])


def touches(model: mujoco.MjModel, address: JointAddress, path: Array) -> bool:
    """Whether the motion makes parts of the model touch that do not at its start."""
    data, first = mujoco.MjData(model), None
    for q in path[:: round(0.1 * PLAN.rate)]:
        data.qpos[address.qpos] = q
        mujoco.mj_fwdPosition(model, data)
        pairs = {tuple(c.geom) for c in data.contact[: data.ncon]}
        first = pairs if first is None else first
        if pairs - first:
            return True
    return False
