"""Motion of a machine under a held command, with exact sticking and slipping.

Between two events the equations are smooth, and Runge-Kutta's fourth order integrates them. An event is a new command,
or a velocity that reaches zero against dry friction: that instant is found by Brent's method, the joint is stopped
exactly, and it sticks until the torque on it exceeds the friction. Of the ways to stick or to slip, the one whose
accelerations and friction torques agree is unique, because the inertia matrix is positive definite.

Nothing here is MuJoCo's: it regularises dry friction, and steps with the first order.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from math import exp

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.demo.effect import Friction, Machine
from torchrl_athletic.recordings.demo.robot import Dynamics

Array = NDArray[np.float64]
Pair = tuple[float, float]
State = tuple[float, float, float, float]
"""q1, q2, v1, v2"""
Mode = tuple[int, int]
"""Sign of the motion of each joint; 0 while it sticks."""

STEP = 0.00025
"""Longest step [s]."""
_WELDED = Friction(1e30, 1e30)


def simulate(
    machine: Machine,
    time: Array,
    command: Array,
    position_control: bool = False,
    start: Array | None = None,
    gains: tuple[Array, Array] | None = None,
    drive_period: float = 0.001,
    step: float = STEP,
) -> tuple[Array, Array]:
    """Move a machine, from rest.

    Args:
        machine: With or without hidden effects.
        time: Instants at which the command changes and the state is read [s]. Shape (T,).
        command: Torques [N·m], or targets [rad], held from their instant on. Shape (T, J).
        position_control: The drive makes torques ``kp (target - reading) - kd v`` of targets, every ``drive_period``.
        start: First position [rad]. Shape (J,). Zero if None.
        gains: kp, kd as the log says; the robot's if None.
        drive_period: [s]
        step: Longest step of the integrator [s].

    Returns:
        True position [rad] and velocity [rad/s] at ``time``. Shapes (T, J).
    """
    joints = len(machine.drives)
    friction = (*machine.friction, _WELDED)[:2]
    contact = _Contact(machine.dynamics, friction[0], friction[1])
    actuation = _Actuation(machine, command, position_control, gains)
    events, row, arrival = _events(machine, time, drive_period if position_control else None)
    q = np.zeros(joints) if start is None else np.asarray(start, dtype=np.float64)
    state: State = (float(q[0]), float(q[1]) if joints == 2 else 0.0, 0.0, 0.0)
    mode: Mode = (1 if friction[0].smooth else 0, 1 if friction[1].smooth else 0)
    out = np.empty((len(time), 4))
    for k, now in enumerate(events):
        if row[k] >= 0:
            out[row[k]] = state
        if k + 1 == len(events):
            break
        left = events[k + 1] - now
        actuation.command(arrival[k], state)
        steps = max(1, int(np.ceil(left / step - 1e-9)))
        for _ in range(steps):
            state, mode = _advance(contact, actuation, state, mode, left / steps)
    return out[:, :joints], out[:, 2 : 2 + joints]


class _Actuation:
    """Torque of both motors, from the last command on. State: the torque behind the lag."""

    def __init__(self, machine: Machine, command: Array, position_control: bool, gains: tuple[Array, Array] | None):
        self.drives, self.limit = machine.drives, machine.robot.torque_limit
        self.commands: list[list[float]] = command.tolist()
        self.position_control = position_control
        kp, kd = gains if gains is not None else (machine.robot.kp, machine.robot.kd)
        self.kp = [float(k) * d.kp_scale for k, d in zip(kp, self.drives, strict=True)]
        self.kd = [float(k) * d.kd_scale for k, d in zip(kd, self.drives, strict=True)]
        self.wanted: list[float] = []
        self.actual: list[float] = []
        self.lagging = any(d.time_constant > 0 for d in self.drives)
        self.held: Pair = (0.0, 0.0)

    def command(self, rows: Sequence[int], state: State) -> None:
        """Take in what row of the command each drive knows by now."""
        wanted = [self.commands[row][j] for j, row in enumerate(rows)]
        if self.position_control:
            wanted = [
                self.kp[j] * (wanted[j] - (state[j] + drive.offset)) - self.kd[j] * state[2 + j]
                for j, drive in enumerate(self.drives)
            ]
        self.wanted = wanted
        if not self.actual:
            self.actual = wanted
        if not self.lagging:
            self.held = self._at_joints(wanted)

    def after(self, seconds: float) -> Pair:
        """Torques at the joints, ``seconds`` from the state of the lag."""
        return self.held if not self.lagging else self._at_joints(self._lagged(seconds))

    def advance(self, seconds: float) -> None:
        """Let the lag proceed."""
        if self.lagging:
            self.actual = self._lagged(seconds)

    def _lagged(self, seconds: float) -> list[float]:
        return [
            u + (x - u) * exp(-seconds / d.time_constant) if d.time_constant > 0 else u
            for u, x, d in zip(self.wanted, self.actual, self.drives, strict=True)
        ]

    def _at_joints(self, torque: list[float]) -> Pair:
        out = [
            min(max(d.scale * u + d.torque, -limit), limit)
            for u, d, limit in zip(torque, self.drives, self.limit, strict=True)
        ]
        return out[0], out[1] if len(out) == 2 else 0.0


class _Contact:
    """Equations of motion with friction, once it is known which joint sticks and which way the others move."""

    def __init__(self, dynamics: Dynamics, first: Friction, second: Friction):
        self.dynamics, self.friction = dynamics, (first, second)
        self.smooth = (first.smooth, second.smooth)

    def sliding(self, joint: int, sign: int) -> Pair:
        """Friction torque as (constant, slope) of the velocity."""
        f = self.friction[joint]
        return (f.coulomb_positive, f.viscous_positive) if sign > 0 else (-f.coulomb_negative, f.viscous_negative)

    def step(self, state: State, mode: Mode, h: float, torque: tuple[Pair, Pair, Pair]) -> State:
        """Runge-Kutta's step of the fourth order, with the torques at its beginning, middle and end."""
        dynamics = self.dynamics
        s1, s2 = mode
        (f1, d1), (f2, d2) = self.sliding(0, s1), self.sliding(1, s2)

        def acceleration(q1: float, q2: float, v1: float, v2: float, torque: Pair) -> Pair:
            m11, m12, m22, b1, b2 = dynamics(q1, q2, v1, v2)
            r1, r2 = torque[0] - b1 - f1 - d1 * v1, torque[1] - b2 - f2 - d2 * v2
            if s1 and s2:
                det = m11 * m22 - m12 * m12
                return (m22 * r1 - m12 * r2) / det, (m11 * r2 - m12 * r1) / det
            return (r1 / m11 if s1 else 0.0), (r2 / m22 if s2 else 0.0)

        q1, q2, v1, v2 = state
        begin, middle, end = torque
        g = 0.5 * h
        a1, a2 = acceleration(q1, q2, v1, v2, begin)
        bv1, bv2 = v1 + g * a1, v2 + g * a2
        b1, b2 = acceleration(q1 + g * v1, q2 + g * v2, bv1, bv2, middle)
        cv1, cv2 = v1 + g * b1, v2 + g * b2
        c1, c2 = acceleration(q1 + g * bv1, q2 + g * bv2, cv1, cv2, middle)
        dv1, dv2 = v1 + h * c1, v2 + h * c2
        e1, e2 = acceleration(q1 + h * cv1, q2 + h * cv2, dv1, dv2, end)
        w = h / 6
        return (
            q1 + w * (v1 + 2 * (bv1 + cv1) + dv1),
            q2 + w * (v2 + 2 * (bv2 + cv2) + dv2),
            v1 + w * (a1 + 2 * (b1 + c1) + e1),
            v2 + w * (a2 + 2 * (b2 + c2) + e2),
        )

    def settle(self, state: State, mode: Mode, torque: Pair) -> Mode:
        """Which joints at rest stick, and which way the others start."""
        m11, m12, m22, b1, b2 = self.dynamics(*state)
        options: list[tuple[int, ...]] = [(s,) if s else (0, 1, -1) for s in mode]
        for s1, s2 in product(*options):
            (f1, d1), (f2, d2) = self.sliding(0, s1), self.sliding(1, s2)
            r1, r2 = torque[0] - b1, torque[1] - b2
            n1, n2 = r1 - f1 - d1 * state[2], r2 - f2 - d2 * state[3]
            if s1 and s2:
                det = m11 * m22 - m12 * m12
                a1, a2 = (m22 * n1 - m12 * n2) / det, (m11 * n2 - m12 * n1) / det
            else:
                a1, a2 = (n1 / m11 if s1 else 0.0), (n2 / m22 if s2 else 0.0)
            load = (r1 - m12 * a2, r2 - m12 * a1)  # what a stuck joint has to bear
            if self._agrees(0, mode[0], s1, a1, load[0]) and self._agrees(1, mode[1], s2, a2, load[1]):
                return s1, s2
        return mode  # rounding at the very edge of sticking

    def _agrees(self, joint: int, was: int, sign: int, acceleration: float, load: float) -> bool:
        if was:
            return True
        if sign:
            return sign * acceleration > 0
        f = self.friction[joint]
        return -f.coulomb_negative <= load <= f.coulomb_positive


def _advance(contact: _Contact, actuation: _Actuation, state: State, mode: Mode, h: float) -> tuple[State, Mode]:
    """One step, with as many stops and starts as fall into it."""
    while h > 0:
        now = actuation.after(0.0)
        if 0 in mode:
            mode = contact.settle(state, mode, now)
        new = contact.step(state, mode, h, (now, actuation.after(0.5 * h), actuation.after(h)))
        stopping = [j for j in (0, 1) if mode[j] and not contact.smooth[j] and mode[j] * new[2 + j] < 0]
        if not stopping:
            actuation.advance(h)
            return new, mode
        at_once = [j for j in stopping if mode[j] * state[2 + j] <= 1e-12]
        if at_once:  # started, and turns within the same step: it had better stayed
            mode = (0 if 0 in at_once else mode[0], 0 if 1 in at_once else mode[1])
            new = contact.step(state, mode, h, (now, actuation.after(0.5 * h), actuation.after(h)))
            actuation.advance(h)
            return new, mode
        first = min((_stop(contact, actuation, state, mode, h, j, new), j) for j in stopping)
        taken, joint = first
        state = contact.step(state, mode, taken, (now, actuation.after(0.5 * taken), actuation.after(taken)))
        actuation.advance(taken)
        h -= taken
        if joint == 0:
            state, mode = (state[0], state[1], 0.0, state[3]), (0, mode[1])
        else:
            state, mode = (state[0], state[1], state[2], 0.0), (mode[0], 0)
    return state, mode


def _stop(
    contact: _Contact, actuation: _Actuation, state: State, mode: Mode, h: float, joint: int, after: State
) -> float:
    """Time until the joint comes to rest, [s]."""
    from scipy.optimize import brentq  # light import of the package

    now = actuation.after(0.0)

    def velocity(taken: float) -> float:
        if taken == 0:
            return state[2 + joint]
        if taken == h:
            return after[2 + joint]
        torque = (now, actuation.after(0.5 * taken), actuation.after(taken))
        return contact.step(state, mode, taken, torque)[2 + joint]

    return float(brentq(velocity, 0.0, h, xtol=1e-15))


def _events(
    machine: Machine, time: Array, drive_period: float | None
) -> tuple[list[float], list[int], list[tuple[int, ...]]]:
    """Instants at which a sample is taken or a drive changes its mind.

    Returns:
        Instants; the sample taken there, or -1; and the row of the command that each drive follows from there on. A
        drive follows its first command before that arrives, too.
    """
    delays = [d.delay for d in machine.drives]
    late = [time + delay for delay in delays]
    ticks = [] if drive_period is None else [np.arange(time[0], time[-1], drive_period)]
    instants = np.unique(np.round(np.concatenate([time, *late, *ticks]), 12))
    instants = instants[instants <= np.round(time[-1], 12)]
    row = np.full(len(instants), -1)
    row[np.searchsorted(instants, np.round(time, 12))] = np.arange(len(time))
    arrival = np.stack([np.searchsorted(np.round(shifted, 12), instants, side="right") - 1 for shifted in late], -1)
    return instants.tolist(), row.tolist(), [tuple(rows) for rows in np.maximum(arrival, 0).tolist()]
