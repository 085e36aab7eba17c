"""Joints with harmonic drives: a rotor and a link each, with a gear between them that bends, lags behind and rubs.

Per joint, all seen at the link's side, with wind-up φ = θ - q [rad] and ω the rotor's speed [rad/s]:

    J ω'  = τ - f - B ω - g                      rotor: motor torque, dry and viscous friction, gear
    g     = elastic(φ) + h + C φ'                the link gets it
    h'    = S (φ' - |φ'| h / H)                  hysteresis of the flexspline (Dahl)
    f'    = s (ω - |ω| f / level)                dry friction of bearings and teeth (LuGre's bristle)
    level = (F + μ |elastic + h|) (1 + (r - 1) exp(-(ω / v)²))        load-dependent, with Stribeck's fall
    τ'    = (wanted - τ) / lag                   current loop

Bristles start, stick, slip and forget in an ordinary differential equation, and are passive at any speed: their power
f ω = (f²/2s)' + |ω| f² / level never falls below the change of what they store (the same holds for h).

All that is compiled stands in this file, since Numba's cache sees no change in another one: after an edit of
``plant.py``, delete ``__pycache__``.

Sources:
    Stiffness in three pieces: Harmonic Drive's catalogues. Dahl 1968, TOR-0158(3107-18)-1. Canudas de Wit, Olsson,
    Åström, Lischinsky 1995, IEEE Trans. Automatic Control 40(3), without the bristle's damping, which alone can make
    the model active (Barabanov, Ortega 2000, same journal, 45(4)).
"""

from __future__ import annotations

from math import inf

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.concealed.plant import dynamics, solve

Array = NDArray[np.float64]

STEP = 1e-4
"""Step of the integrator [s]."""
LOOP = 1e-3
"""Period of the drives' own control loop [s]."""
PERIOD = 5e-3
"""Between two commands [s]."""
LOOPS, STEPS = round(PERIOD / LOOP), round(LOOP / STEP)
RATIO = 50
"""Ratio of the gears."""
RESOLUTION = 2 * np.pi / (2**14 * RATIO)
"""Resolution of the encoders, 14 bits on the rotor, seen at the joint [rad]."""
SPEED_FILTER = 0.4
"""Share of a new encoder difference in the drive's estimate of the speed, each millisecond."""
SPEED_RESOLUTION = 1e-6
"""Below which that estimate is zero [rad/s]."""

FIELDS: dict[str, float] = {
    "rotor": 0.03,  # [kg·m²] J, with the wave generator, times the ratio squared
    "viscous": 0.0,  # [N·m·s/rad] B
    "coulomb": 0.0,  # [N·m] F; no dry friction at 0, whatever the load
    "load_coefficient": 0.0,  # μ, friction per transmitted torque
    "breakaway_ratio": 1.0,  # r
    "stribeck_speed": 0.1,  # [rad/s] v
    "bristle_stiffness": 0.0,  # [N·m/rad] s
    "first_stiffness": 1e4,  # [N·m/rad] of the gear, up to first_torque
    "second_stiffness": 1e4,  # [N·m/rad] up to second_torque
    "third_stiffness": 1e4,  # [N·m/rad] beyond
    "first_torque": inf,  # [N·m]
    "second_torque": inf,  # [N·m]
    "gear_damping": 0.0,  # [N·m·s/rad] C
    "hysteresis": 0.0,  # [N·m] H
    "hysteresis_stiffness": 0.0,  # [N·m/rad] S
    "lag": 0.0,  # [s]; 0 for none
    "lowest": -inf,  # [rad] stops of the link
    "highest": inf,
    "stop_stiffness": 0.0,  # [N·m/rad]
    "stop_damping": 0.0,  # [N·m·s/rad²] times the depth
}  # fmt: skip

JOINT = np.dtype([(name, np.float64) for name in FIELDS])

POSITION, SPEED, ROTOR, ROTOR_SPEED, FRICTION, HYSTERESIS, TORQUE = range(7)
"""Columns of the state: q [rad], q' [rad/s], θ [rad], ω [rad/s], f, h and τ [N·m]."""
STATES = 7


def ideal(joints: int) -> NDArray[np.void]:
    """Drives without friction, hysteresis and lag, with a straight spring. Shape (J,)."""
    out = np.zeros(joints, dtype=JOINT)
    for name, value in FIELDS.items():
        out[name] = value
    return out


@njit(cache=True)
def elastic_torque(p, windup):  # type: ignore[no-untyped-def]
    """Torque of the gear's spring, stiffer the more it is wound up [N·m]."""
    size = abs(windup)
    torque = p.first_stiffness * size
    if torque > p.first_torque:
        size -= p.first_torque / p.first_stiffness
        torque = p.first_torque + p.second_stiffness * size
        if torque > p.second_torque:
            size -= (p.second_torque - p.first_torque) / p.second_stiffness
            torque = p.second_torque + p.third_stiffness * size
    return torque if windup >= 0.0 else -torque


@njit(cache=True)
def slip_level(p, speed, load):  # type: ignore[no-untyped-def]
    """Dry friction at which the rotor slides at this speed [N·m]."""
    fall = np.exp(-((speed / p.stribeck_speed) ** 2))
    return (p.coulomb + p.load_coefficient * abs(load)) * (1.0 + (p.breakaway_ratio - 1.0) * fall)


@njit(cache=True)
def stop_torque(p, position, speed):  # type: ignore[no-untyped-def]
    """What an end stop pushes back with; it never pulls [N·m].

    Source:
        Hunt, Crossley 1975, J. Applied Mechanics 42(2).
    """
    if position > p.highest:
        depth = position - p.highest
        return -max(p.stop_stiffness * depth + p.stop_damping * depth * speed, 0.0)
    if position < p.lowest:
        depth = p.lowest - position
        return max(p.stop_stiffness * depth - p.stop_damping * depth * speed, 0.0)
    return 0.0


@njit(cache=True)
def derivative(tree, p, x, wanted, room, out):  # type: ignore[no-untyped-def]
    """Time derivative of the state under the torques that the current loops are asked for.

    Args:
        tree: Bodies, a :class:`~benchmarks.concealed.plant.Tree`.
        p: Drives, records of :data:`JOINT`. Shape (J,).
        x: State. Shape (J, 7).
        wanted: [N·m]. Shape (J,).
        room: Of :func:`workroom`.
        out: Is written. Shape (J, 7).
    """
    matrices, vectors, mass_matrix, bias, force = room
    n = x.shape[0]
    dynamics(tree, x[:, 0], x[:, 1], matrices, vectors, mass_matrix, bias)
    for j in range(n):
        windup_speed = x[j, 3] - x[j, 1]
        carried = elastic_torque(p[j], x[j, 2] - x[j, 0]) + x[j, 5]
        gear = carried + p[j].gear_damping * windup_speed
        motor = x[j, 6] if p[j].lag > 0.0 else wanted[j]
        force[j] = gear + stop_torque(p[j], x[j, 0], x[j, 1]) - bias[j]
        out[j, 0] = x[j, 1]
        out[j, 2] = x[j, 3]
        out[j, 3] = (motor - x[j, 4] - p[j].viscous * x[j, 3] - gear) / p[j].rotor
        out[j, 4] = 0.0
        if p[j].coulomb > 0.0:
            level = slip_level(p[j], x[j, 3], carried)
            out[j, 4] = p[j].bristle_stiffness * (x[j, 3] - abs(x[j, 3]) * x[j, 4] / level)
        out[j, 5] = 0.0
        if p[j].hysteresis > 0.0:
            rate = windup_speed - abs(windup_speed) * x[j, 5] / p[j].hysteresis
            out[j, 5] = p[j].hysteresis_stiffness * rate
        out[j, 6] = (wanted[j] - x[j, 6]) / p[j].lag if p[j].lag > 0.0 else 0.0
    solve(mass_matrix, force, n)
    for j in range(n):
        out[j, 1] = force[j]


@njit(cache=True)
def workroom(joints):  # type: ignore[no-untyped-def]
    """Room for :func:`derivative`."""
    square = np.zeros((joints, joints))
    return np.zeros((joints, 4, 3, 3)), np.zeros((joints, 16, 3)), square, np.zeros(joints), np.zeros(joints)


@njit(cache=True)
def advance(tree, p, x, wanted, step, steps, room, slopes):  # type: ignore[no-untyped-def]
    """Move the state on in place, under constant ``wanted`` [N·m], by the classical Runge-Kutta method.

    Args:
        tree: Bodies, a :class:`~benchmarks.concealed.plant.Tree`.
        p: Drives, records of :data:`JOINT`. Shape (J,).
        x: State, is overwritten. Shape (J, 7).
        wanted: [N·m]. Shape (J,).
        step: [s].
        steps: How many.
        room: Of :func:`workroom`.
        slopes: Room. Shape (5, J, 7).
    """
    k1, k2, k3, k4, moved = slopes[0], slopes[1], slopes[2], slopes[3], slopes[4]
    for _ in range(steps):
        derivative(tree, p, x, wanted, room, k1)
        moved[:] = x + 0.5 * step * k1
        derivative(tree, p, moved, wanted, room, k2)
        moved[:] = x + 0.5 * step * k2
        derivative(tree, p, moved, wanted, room, k3)
        moved[:] = x + step * k3
        derivative(tree, p, moved, wanted, room, k4)
        x += step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


@njit(cache=True)
def play(  # type: ignore[no-untyped-def]
    tree, p, x, register, last_target, targets, kp, kd, limit, no_load, torque_scale, delay, room, slopes, rows
):
    """Send targets to the drives, which close their loops at :data:`LOOP`, and let them move the arm.

    Args:
        tree: Bodies, a :class:`~benchmarks.concealed.plant.Tree`.
        p: Drives, records of :data:`JOINT`. Shape (J,).
        x: State, is overwritten. Shape (J, 7).
        register: The drives' last encoder reading [rad] and estimate of the speed [rad/s]; overwritten. Shape (2, J).
        last_target: That was sent before [rad]. Shape (J,).
        targets: One each :data:`PERIOD` [rad]. Shape (T, J).
        kp: [N·m/rad]. Shape (J,).
        kd: [N·m·s/rad]. Shape (J,).
        limit: Torque at standstill [N·m]. Shape (J,).
        no_load: Speed at which no torque is left [rad/s]. Shape (J,).
        torque_scale: True torque per torque that the drive believes in [1]. Shape (J,).
        delay: Of targets, less than :data:`PERIOD` [s].
        room: Of :func:`workroom`.
        slopes: Room. Shape (5, J, 7).
        rows: Written: position, velocity, torque as the drives see them, before each target. Shape (T, 3, J).
    """
    n = x.shape[0]
    wanted = np.zeros(n)
    for k in range(targets.shape[0]):
        for j in range(n):
            rows[k, 0, j] = np.round(x[j, ROTOR] / RESOLUTION) * RESOLUTION
            rows[k, 1, j] = register[1, j]
            rows[k, 2, j] = x[j, TORQUE] / torque_scale[j]
        for m in range(LOOPS):
            late = m * LOOP < delay - 1e-9
            for j in range(n):
                target = targets[k, j]
                if late:
                    target = last_target[j] if k == 0 else targets[k - 1, j]
                reading = np.round(x[j, ROTOR] / RESOLUTION) * RESOLUTION
                register[1, j] += SPEED_FILTER * ((reading - register[0, j]) / LOOP - register[1, j])
                if abs(register[1, j]) < SPEED_RESOLUTION:
                    register[1, j] = 0.0
                register[0, j] = reading
                speed = register[1, j]
                used = speed / no_load[j]
                torque = kp[j] * (target - reading) - kd[j] * speed
                torque = min(torque, limit[j] * (1.0 - min(max(used, 0.0), 1.0)))
                torque = max(torque, -limit[j] * (1.0 + max(min(used, 0.0), -1.0)))
                wanted[j] = torque_scale[j] * torque
            advance(tree, p, x, wanted, STEP, STEPS, room, slopes)
