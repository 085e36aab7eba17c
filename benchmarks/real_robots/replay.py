"""The neutral judge: plain MuJoCo with its own actuators, in windows of half a second from the measured state."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from benchmarks.real_robots.robots.robot import Robot
from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.replay import Windows, simulate, take_of
from torchrl_athletic.recordings import Recording, split_at_gaps

Array = NDArray[np.float64]

NAMES = ("frictionloss", "damping", "armature", "delay", "limit", "offset", "encoder", "scale", "kp", "kd")
"""What the rows of a parameter array (10, J) are."""
WINDOW = 0.5
"""[s]."""
HELD = 1.0
"""Time for which the first command of a log was held before it [s]: longer than any delay."""
SMOOTHED, SHORTEST, LONGEST = 11, 0.02, 0.1
"""Samples over which a cubic gives the state in which a window starts; but it spans no less and no more than this [s],
and has five samples. Five of an encoder at 200 Hz give a velocity that is off by a fifth, by the drive's own velocity.
Half of them lie in the motion that is scored, for all alike."""
ENOUGH = 100
"""Windows; where back to back there are fewer, they overlap: the mean of a few says where they happen to begin."""
LOST = 10.0
"""Error of a simulation that diverges [rad, m]."""
JUDGE = f"{SMOOTHED} samples, {ENOUGH} windows of {WINDOW:g} s"
"""What a score was made by: no other is its peer."""
SAME_RATE = 0.002
"""Relative difference of sampling rates below which recordings share a grid."""


@dataclass(frozen=True, eq=False)
class Window:
    """Half a second of one recording. ``length`` samples are compared."""

    model: mujoco.MjModel
    """The given one, with what the recording carried."""
    q: Array
    """Where it starts. Shape (J,)."""
    v: Array
    measured: Array
    """Shape (length, J)."""
    step: float
    """Time step of the physics [s]."""
    substeps: int
    edges: Array
    """When physics steps begin and end [s]. Shape (length * substeps + 1,)."""
    stamps: Array
    """Stamps of the commands, the first of which held long before [s]. Shape (T + 1,)."""
    integral: Array
    """Integral of the commands over time. Shape (T + 1, J)."""
    gains: tuple[Array, Array] | None
    """kp and kd where positions were commanded. Shapes (J,)."""
    recording: Recording
    """Gap-free."""
    first: int
    """Sample of its grid at which the window starts."""

    @property
    def kind(self) -> tuple[Any, ...]:
        """What windows of one batch share."""
        gains = None if self.gains is None else (*self.gains[0], *self.gains[1])
        return id(self.model), self.step, len(self.edges), gains


def smoothed_samples(period: float) -> int:
    """Samples, an odd number, over which a log with this sampling period is smoothed."""
    least, most = (2 * round(span / 2 / period) + 1 for span in (SHORTEST, LONGEST))
    return max(5, least, min(SMOOTHED, most))


class Replay:
    """Recordings cut into windows; parameters are (10, J), as :data:`NAMES`."""

    def __init__(self, robot: Robot, recordings: Sequence[Recording]) -> None:
        self.given, self.names = mujoco.MjModel.from_xml_string(robot.xml), recordings[0].joint_names
        self.joint = [self.given.joint(n).id for n in self.names]
        self.dof, self.qpos = self.given.jnt_dofadr[self.joint], self.given.jnt_qposadr[self.joint]
        self.actuator = [int(np.flatnonzero(self.given.actuator_trnid[:, 0] == j)[0]) for j in self.joint]
        periods: list[float] = []
        models: dict[bytes, mujoco.MjModel] = {}
        parts = []
        for r in recordings:
            model = self.given if robot.model_of is None else robot.model_of(r)
            model = models.setdefault(model.body_mass.tobytes(), model)
            own = 1.0 / r.rate
            periods.append(next((p for p in periods if abs(own / p - 1) < SAME_RATE), own))
            parts += [(part, model, periods[-1]) for part in split_at_gaps(r)]
        self.windows = [w for part in parts for w in self._cut(*part)]
        if not self.windows:
            raise ValueError(f"{recordings[0].source}: no part of the logs holds a window of {WINDOW:g} s.")
        if len(self.windows) < ENOUGH:
            times = -(-ENOUGH // len(self.windows))
            self.windows = [w for part in parts for w in self._cut(*part, times)]
        self.targets = any(r.position_target is not None for r in recordings)
        damped = {float(r.kd[0]) if r.kd is not None else 0.0 for r in recordings}
        drive = ("kp", "kd") if len(damped) > 1 else ("kp",)
        self.movable = (*NAMES[:7], *(drive if self.targets else ("scale",)))

    def _cut(self, r: Recording, model: mujoco.MjModel, period: float, times: int = 1) -> list[Window]:
        """Back to back, or so many times as many, with states from the smoothed positions: a drive's own may be late.

        The first begins where the smoothing has samples on both sides: at an edge the velocity is extrapolated.
        """
        substeps = int(np.ceil(period / self.given.opt.timestep - 1e-3))
        grid = r.time[0] + period * np.arange(int((r.time[-1] - r.time[0]) / period + 1e-6) + 1)
        q = np.stack([np.interp(grid, r.time, c) for c in r.position.T], -1)
        size = smoothed_samples(period)
        if len(grid) < size:
            return []
        smooth = savgol_filter(q, size, 3, axis=0)
        v = savgol_filter(q, size, 3, deriv=1, delta=period, axis=0)
        length = round(WINDOW / period)
        stamps = np.append(r.time[0] - HELD, r.time)
        held = np.vstack([r.command[0], r.command[:-1]])  # a command that comes late was given before the log began
        integral = np.vstack([np.zeros(len(self.names)), np.cumsum(np.diff(stamps)[:, None] * held, 0)])
        gains = None if r.kp is None or r.kd is None else (r.kp, r.kd)
        return [
            Window(
                model,
                smooth[first],
                v[first],
                q[first + 1 : first + length + 1],
                period / substeps,
                substeps,
                grid[first] + period / substeps * np.arange(length * substeps + 1),
                stamps,
                integral,
                gains,
                r,
                first,
            )
            for first in range(size // 2, len(grid) - length, max(1, length // times))
        ]

    def with_windows(self, most: int) -> Replay:
        """A replay with at most so many of the windows, evenly among all."""
        other = object.__new__(Replay)
        other.__dict__.update(self.__dict__)
        chosen = np.linspace(0, len(self.windows) - 1, min(most, len(self.windows))).astype(int)
        other.windows = [self.windows[k] for k in chosen]
        return other

    def nominal(self) -> Array:
        """The given model's parameters. Shape (10, J)."""
        m, one = self.given, np.ones(len(self.dof))
        damping = m.dof_damping.reshape(m.nv, -1)[self.dof, 0]
        given = (m.dof_frictionloss[self.dof], damping, m.dof_armature[self.dof])
        limit = np.array([self._limit(a) for a in self.actuator])
        return np.stack([*given, 0 * one, limit, 0 * one, 0 * one, one, one, one])

    def _limit(self, actuator: int) -> float:
        """Largest torque that the model says an actuator gives."""
        m = self.given
        if m.actuator_forcelimited[actuator]:
            return float(m.actuator_forcerange[actuator, 1])
        return float(m.actuator_ctrlrange[actuator, 1]) if m.actuator_ctrllimited[actuator] else 1e6

    def model(self, x: Array, window: Window) -> mujoco.MjModel:
        """A model with the parameters in it, for one window's step and gains."""
        friction, damping, armature, _, limit, offset, _, scale, kp, kd = x
        m = window.model.__copy__()
        m.opt.timestep = window.step
        m.dof_frictionloss[self.dof], m.dof_armature[self.dof] = friction, armature
        m.dof_damping.reshape(m.nv, -1)[self.dof, 0] = damping
        a = self.actuator
        m.actuator_ctrllimited[a] = 0
        m.actuator_gaintype[a] = mujoco.mjtGain.mjGAIN_FIXED
        m.actuator_biastype[a] = mujoco.mjtBias.mjBIAS_AFFINE
        m.actuator_biasprm[a, 0] = offset
        m.actuator_gainprm[a, 0] = scale
        if window.gains is not None:
            m.actuator_gainprm[a, 0] = kp * window.gains[0]
            m.actuator_biasprm[a, 1] = -kp * window.gains[0]
            m.actuator_biasprm[a, 2] = -kd * window.gains[1]
        m.actuator_forcelimited[a] = 1
        m.actuator_forcerange[a] = np.stack([-limit, limit], -1)
        return m

    def state(self, w: Window, encoder: Array) -> Array:
        """Full physics state in which a window starts. Shape (1 + nq + nv,)."""
        out = np.zeros(1 + self.given.nq + self.given.nv)
        out[1 : 1 + self.given.nq] = self.given.qpos0
        out[1 + self.qpos], out[1 + self.given.nq + self.dof] = w.q - encoder, w.v
        return out

    def control(self, w: Window, delay: Array) -> Array:
        """Mean command over each physics step. Shape (steps, nu)."""
        late = w.edges[:, None] - delay
        columns = [np.interp(late[:, j], w.stamps, w.integral[:, j]) for j in range(len(self.dof))]
        out = np.zeros((len(late) - 1, self.given.nu))
        out[:, self.actuator] = np.diff(np.stack(columns, -1), axis=0) / w.step
        return out

    def errors(self, x: Array) -> list[Array]:
        """Predicted less measured positions of every window. Shapes (length, J)."""
        encoder, delay = x[NAMES.index("encoder")], x[NAMES.index("delay")]
        groups: dict[Any, list[int]] = {}
        for k, w in enumerate(self.windows):
            groups.setdefault(w.kind, []).append(k)
        out: list[Array] = [np.zeros(0)] * len(self.windows)
        for rows in groups.values():
            model = self.model(x, self.windows[rows[0]])
            data = [mujoco.MjData(model) for _ in range(os.cpu_count() or 1)]
            states = np.stack([self.state(self.windows[k], encoder) for k in rows])
            controls = np.stack([self.control(self.windows[k], delay) for k in rows])
            path, _ = rollout.rollout(model, data, states, controls)
            for k, states_of in zip(rows, path, strict=True):
                w = self.windows[k]
                read = states_of[w.substeps - 1 :: w.substeps, 1 + self.qpos] + encoder
                wrong = np.nan_to_num(read - w.measured, nan=LOST, posinf=LOST, neginf=-LOST)
                out[k] = np.clip(wrong, -LOST, LOST)
        return out

    def mean_square(self, x: Array) -> Array:
        """Mean square error of each window. Shape (W, J)."""
        return np.stack([(e**2).mean(0) for e in self.errors(x)])

    def mean_square_of(self, corrected: Simulation) -> Array:
        """Mean square error of each window in a corrected simulation, started and driven alike. Shape (W, J)."""
        groups: dict[tuple[int, int], list[int]] = {}
        for k, w in enumerate(self.windows):
            groups.setdefault((id(w.recording), id(w.model)), []).append(k)
        out = np.empty((len(self.windows), len(self.dof)))
        quiet = np.full(len(self.dof), 1e-9)
        for rows in groups.values():
            first = self.windows[rows[0]]
            take = take_of(first.recording, first.model, quiet, period=first.step * first.substeps)
            starts = np.array([self.windows[k].first for k in rows])
            windows = Windows(take, starts, len(first.measured))
            begin = np.stack([self.windows[k].q for k in rows]), np.stack([self.windows[k].v for k in rows])
            path = simulate(windows, corrected.hypothesis.build, corrected.values[None], begin)[0]
            for k, read in zip(rows, path, strict=True):
                out[k] = (np.clip(read - self.windows[k].measured, -LOST, LOST) ** 2).mean(0)
        return out

    def residual(self, x: Array) -> Array:
        """Whose sum of squares is that of the windows' mean squares."""
        return np.concatenate([(e / np.sqrt(len(e))).ravel() for e in self.errors(x)])
