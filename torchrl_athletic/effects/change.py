"""What changes while a take is recorded: friction that warms up, and a push that comes once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import mujoco
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from torchrl_athletic.effects.effect import (
    Array,
    Effect,
    Fingerprint,
    Parameter,
    damping_bound,
    dry_friction,
    local,
    per_speed_unit,
    torque_bound,
    torque_scale,
    torque_unit,
)
from torchrl_athletic.effects.plant import Law, Now, Plant, Start
from torchrl_athletic.effects.presliding import Bristle, directions, forms
from torchrl_athletic.effects.signals import JointAddress, Signals
from torchrl_athletic.effects.torque import leftover

_OF_TAKE = (0.08, 0.2, 0.5, 1.5)
"""Time constants to try, per the length of the longest take."""
_LONG_ENOUGH = 10.0
"""A take in which something may warm up [s]."""
_QUICKEST = 3.0
"""Nothing that a motor turns warms up faster [s]; what changes sooner is another law of friction."""
_LEAST = 1.01
"""A drift is slower than that by more than this factor: at its bound it stands in for another law."""
_DURATIONS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4)
"""Durations of a disturbance, to start the search from [s]."""
_DROP_OUT = 2.0
"""What is recorded before and after so long a gap is looked at apart [s]."""
_PER_TAKE, _IN_ALL = 3, 8
"""Intervals to propose."""


class ThermalDrift(Effect):
    """Friction that is not the same at the end of a take as at its start: thinner grease, tighter bearings.

    Parameters: ``coulomb`` [N·m, N for slides], the dry friction at the start of a take, in total, in the corrected
    model; ``amplitude`` [N·m, N] and ``damping`` [N·m·s/rad, N·s/m], by which the dry and the viscous friction end up
    higher (or lower); and ``time_constant`` [s]. Every take counts from its own first stamp, as if the robot had rested
    before it.

    Fingerprint: -z, -z w and -q̇ w with w = 1 - exp(-t/T) and the direction of sliding z of Coulomb friction, at time
    constants T above 3 s, from 8 to 150 % of the longest take. One that ends at 3 s stands in for another friction.

    Simulation: MuJoCo's ``frictionloss`` of the lower of both levels; for the rest, bristles and a damper beside the
    motor, as strong as the time in the take says.
    """

    name = "thermal_drift"
    family = "change"
    own_joint = True
    misfit = 0.02
    shows_in = "time"
    equation = "τ = -Fc sign(q̇) - (A sign(q̇) + B q̇) (1 - exp(-t/T))"
    source = "Simoni, Beschi, Legnani, Visioli 2015, Friction modeling with temperature effects for industrial robots"
    excludes = frozenset({"coulomb_friction", "stribeck_friction", "load_dependent_friction", "asymmetric_friction"})
    special_cases = frozenset({"coulomb_friction", "viscous_friction"})
    experiments: ClassVar[Mapping[str, str]] = {
        "coulomb_friction": "repeat one slow motion of {joint} from cold for several minutes: a drift changes from "
        "period to period",
        "viscous_friction": "repeat one motion of {joint} from cold for several minutes",
        "disturbance": "let {joint} cool and repeat the take: a drift comes back, a disturbance does not",
        "torque_scale": "hold {joint} still under a known weight for several minutes: friction does not show there",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        scale, bound = torque_scale(model, address, joint), torque_bound(model, address, joint)
        most = damping_bound(model, address, joint)
        return (
            dry_friction("coulomb", model, address, joint),
            Parameter("amplitude", torque_unit(model, address, joint), 0.0, -bound, bound, 0.02 * scale),
            Parameter("damping", per_speed_unit(model, address, joint), 0.0, -most, most, 0.01 * scale),
            Parameter("time_constant", "s", _QUICKEST, _QUICKEST, 1e4, 2.0),
        )

    def is_physical(self, parameters: Sequence[Parameter], values: Array) -> bool:
        """What would rather be quicker still is no warming."""
        return bool(values[3] > _LEAST * parameters[3].lower)

    def parameters_of(self, takes: Sequence[Signals], joint: int) -> tuple[Parameter, ...]:
        """A drift much slower than the longest take shows only its beginning, a straight line without an end."""
        *others, slow = super().parameters_of(takes, joint)
        longest = max(s.recording.time[-1] - s.recording.began for s in takes)
        return (*others, replace(slow, upper=max(_OF_TAKE[-1] * longest, 2 * _QUICKEST)))

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return self.grid_of([s], joint)

    def grid_of(self, takes: Sequence[Signals], joint: int) -> list[Mapping[str, float]]:
        """Time constants in proportion to the longest take; none if it is too short to warm up in."""
        longest = max(s.recording.time[-1] - s.recording.began for s in takes)
        if longest < _LONG_ENOUGH:
            return []
        return [
            {"time_constant": share * longest, **form}
            for share in _OF_TAKE
            if share * longest > _LEAST * _QUICKEST
            for form in forms(takes[0], joint)
        ]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return self.fingerprints(s, joint, [fixed])[0]

    def fingerprints(self, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
        dry, viscous = s.project(directions(s, joint, grid)), s.velocity[:, joint]
        passed = s.time - s.recording.began
        out = []
        for k, fixed in enumerate(grid):  # slow against the kernel, so that warmth may come after the projection
            warmth = _warmth(passed, fixed["time_constant"])
            columns = np.stack([dry[:, k], dry[:, k] * warmth, viscous * warmth], -1)
            out.append(Fingerprint(local(-columns, s, joint), fixed))
        return out

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        coulomb, amplitude, damping, time_constant = values.T
        plant.set_dry_friction(joint, np.minimum(coulomb, np.maximum(coulomb + amplitude, 0.0)))
        plant.laws.append(_Warming(joint, np.maximum(amplitude, -coulomb), damping, time_constant, plant))

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        coulomb, _, viscous, _ = parameters
        return (
            f"Friction at {joint} changes during a take, with a time constant of {values['time_constant']:.3g} s "
            f"({1e3 * values['time_constant']:.4g} ms): dry friction from {values['coulomb']:.3g} by "
            f"{values['amplitude']:+.3g} {coulomb.unit}, viscous friction by {values['damping']:+.3g} {viscous.unit} "
            "in the end; the model has none of this."
        )


class _Warming(Bristle):
    """Bristles that go or come with time, and a damper that comes: what the colder or the warmer joint has more."""

    def __init__(self, joint: int, amplitude: Array, damping: Array, time_constant: Array, plant: Plant) -> None:
        super().__init__(joint, np.full(plant.rows, 1.5e-3), np.abs(amplitude), plant)
        self.goes = amplitude < 0
        self.damping, self.time_constant, self.first = damping, time_constant, np.zeros(plant.rows)

    def begin(self, start: Start) -> None:
        began = start.time[start.begins] if start.began is None else start.began
        self.first = began[start.piece]
        travel = start.each(lambda piece: float(np.ptp(start.position[piece, self.joint])))
        self.width = self._stable(np.maximum(1.5e-3 * np.minimum(travel, 1.0), 1e-9), self.level)
        super().begin(start)

    def level_of(self, now: Now) -> Array:
        warmth = _warmth(now.time - self.first, self.time_constant)
        return self.level * np.where(self.goes, 1.0 - warmth, warmth)

    def __call__(self, now: Now) -> Array:
        torque = super().__call__(now)
        warmth = _warmth(now.time - self.first, self.time_constant)
        torque[:, self.joint] -= self.damping * warmth * now.velocity[:, self.joint]
        return torque


class Disturbance(Effect):
    """A push that came once: someone leaned on the robot, a cable caught, a part was dropped on it.

    Parameters: ``start`` [s] after the take's first stamp, ``duration`` [s], ``torque`` [N·m, N for slides], and
    ``take`` [1], which tells the take from the others: the time average of all its joints' readings, the k-th of them
    counted k times. A take that drop-outs have cut is one, a take that was cropped or sampled anew is another. It is no
    property of the robot: recordings kept aside do not have it.

    Fingerprint: 1 within the interval, in that take only. Intervals are proposed by a matched filter on what dry and
    viscous friction, inertia, scale, offset and gravity together leave of the missing torque.

    Simulation: a constant torque beside the motor in that interval of that take.
    """

    name = "disturbance"
    family = "change"
    own_joint = True
    misfit = 0.02
    shows_in = "time"
    equation = "τ = d for t₀ ≤ t < t₀ + T, once"
    source = "Turin 1960, doi:10.1109/TIT.1960.1057571 (matched filter)"
    experiments: ClassVar[Mapping[str, str]] = {
        "torque_offset": "repeat the take of {joint}: a disturbance does not come back",
        "thermal_drift": "let {joint} cool and repeat the take",
        "torque_saturation": "repeat the take of {joint}",
        "joint_stop": "repeat the take of {joint}",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        scale, bound = torque_scale(model, address, joint), torque_bound(model, address, joint)
        return (
            Parameter("start", "s", 0.0, 0.0, 1e5, 0.02),
            Parameter("duration", "s", 1.0, 1e-3, 1e4, 0.02),
            Parameter("torque", torque_unit(model, address, joint), 0.0, -bound, bound, 0.02 * scale),
            Parameter("take", "1", 0.0, -1e6, 1e6, 1e-6),  # no optimiser should move it
        )

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return self.grid_of([s], joint)

    def grid_of(self, takes: Sequence[Signals], joint: int) -> list[Mapping[str, float]]:
        """The intervals of all takes that stand out most."""
        found = []
        for pieces in _uncut(takes):
            take = pieces[0].recording.mean_reading
            found += [
                (score, {"start": a, "duration": b - a, "take": take}) for score, a, b in _intervals(pieces, joint)
            ]
        return [interval for _, interval in sorted(found, key=lambda x: -x[0])[:_IN_ALL]]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        if abs(fixed["take"] - s.recording.mean_reading) >= _close(s.recording.position):
            return Fingerprint(np.zeros((len(s.keep), s.num_joints, 1)), fixed)
        half, passed = fixed["duration"] / 2, s.fine_time - s.recording.began
        inside = half - np.abs(passed - fixed["start"] - half)
        box = np.clip(inside / s.fine_step + 0.5, 0.0, 1.0)  # edges fall between instants
        return Fingerprint(local(s.project_command(box), s, joint), fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.laws.append(_Once(joint, *values.T))

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        return (
            f"In one take (mean reading {values['take']:.8g}), {values['torque']:+.3g} {parameters[2].unit} acted on "
            f"{joint} once, {values['start']:.5g} s after its start, for {1e3 * values['duration']:.3g} ms; the model "
            "has none."
        )


class _Once(Law):
    """A torque in one interval of one take."""

    def __init__(self, joint: int, start: Array, duration: Array, torque: Array, take: Array) -> None:
        self.joint, self.start, self.duration, self.torque, self.take = joint, start, duration, torque, take
        self.first = np.zeros(len(take))

    def begin(self, start: Start) -> None:
        assert start.mean_reading is not None
        assert start.began is not None
        near = np.array([_close(start.position[piece]) for piece in start.pieces])
        here = np.abs(self.take[:, None] - start.mean_reading) < near
        self.torque = self.torque * here[np.arange(len(self.take)), start.piece]
        self.first = start.began[start.piece]

    def __call__(self, now: Now) -> Array:
        torque, passed = np.zeros_like(now.velocity), now.time - self.first
        until = np.minimum(passed + now.step, self.start + self.duration)
        share = (until - np.maximum(passed, self.start)) / now.step
        torque[:, self.joint] = self.torque * np.clip(share, 0.0, 1.0)
        return torque


def _warmth(passed: Array, time_constant: float | Array) -> Array:
    """How far the change has come, 0 to 1."""
    return np.asarray(-np.expm1(-np.maximum(passed, 0.0) / time_constant), dtype=np.float64)


def _close(position: Array) -> float:
    """Difference of mean readings up to which a take is the same; repeated under control it differs by more."""
    return 1e-6 * float(np.ptp(position, axis=0).max()) + 1e-9


def _uncut(takes: Sequence[Signals]) -> list[list[Signals]]:
    """The pieces of each take, one after the other, apart where more than a drop-out lies between."""
    out: list[list[Signals]] = []
    for s in takes:
        last = out[-1][-1] if out else s
        same = (s.recording.mean_reading, s.recording.began) == (last.recording.mean_reading, last.recording.began)
        if same and 0.0 < s.time[0] - last.time[-1] < _DROP_OUT:
            out[-1].append(s)
        else:
            out.append([s])
    return out


def _intervals(pieces: Sequence[Signals], joint: int) -> list[tuple[float, float, float]]:
    """Stretches of a take over which the leftover stays on one side: score, and when in the take [s]; best first."""
    step = float(np.median(np.concatenate([np.diff(s.time) for s in pieces])))
    valid = np.concatenate([s.valid[:, joint] for s in pieces])
    left = leftover(pieces, joint)
    left = left - _local_median(left, valid, max(1, round(0.5 / step)))
    left = np.where(valid, left, 0.0)
    total = np.concatenate([[0.0], np.cumsum(left)])
    found: list[tuple[float, int, int]] = []
    for size in sorted({max(2, round(duration / step)) for duration in _DURATIONS}):
        if size > len(left) // 3:
            continue
        score = np.abs(total[size:] - total[:-size]) / np.sqrt(size)
        for _ in range(_PER_TAKE):
            first = int(score.argmax())
            found.append(_edges(total, first, first + size))
            score[max(0, first - size) : first + size] = 0.0
    best: list[tuple[float, int, int]] = []
    for score_, a, b in sorted(found, reverse=True):
        if all(min(b, d) - max(a, c) < 0.5 * max(b - a, d - c) for _, c, d in best):
            best.append((score_, a, b))
    passed = np.concatenate([s.time for s in pieces]) - pieces[0].recording.began
    return [(score_, float(passed[a]), float(passed[b - 1]) + step) for score_, a, b in best[:_PER_TAKE]]


def _edges(total: Array, first: int, last: int) -> tuple[float, int, int]:
    """Move the two edges of an interval, in turn, to where it stands out most."""
    for _ in range(3):
        reach = max(2, (last - first) // 2)
        ends = np.arange(max(first + 2, last - reach), min(len(total) - 1, last + reach) + 1)
        last = int(ends[np.argmax(np.abs(total[ends] - total[first]) / np.sqrt(ends - first))])
        starts = np.arange(max(0, first - reach), min(last - 2, first + reach) + 1)
        first = int(starts[np.argmax(np.abs(total[last] - total[starts]) / np.sqrt(last - starts))])
    return float(abs(total[last] - total[first]) / np.sqrt(last - first)), first, last


def _local_median(left: Array, good: NDArray[np.bool_], size: int) -> Array:
    """Median over 10 s, of medians over half a second; at the ends over the first and the last 10 s. Shape (N,)."""
    blocks = np.arange(len(left)) // size
    parts = (slice(size * k, size * (k + 1)) for k in range(int(blocks[-1]) + 1))
    medians = np.array([np.median(left[at][good[at]]) if good[at].any() else 0.0 for at in parts])
    width = min(21, len(medians))
    around = np.median(sliding_window_view(medians, width), axis=1)
    return np.asarray(around[np.clip(blocks - width // 2, 0, len(around) - 1)], dtype=np.float64)
