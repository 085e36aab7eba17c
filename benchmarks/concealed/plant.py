"""Rigid bodies on a tree of hinges and slides, two inertias per joint, and an integrator of our own.

Nothing here knows MuJoCo. The mass matrix comes from composite bodies and the bias from Newton and Euler, both in the
world's frame (Featherstone 2008, Rigid Body Dynamics Algorithms, chapters 5 and 6). Velocity Verlet with a predicted
velocity integrates at 0.1 ms or less, of second order; friction is driven by displacement, so it is exact at any step.
Steps end at every instant at which a command arrives or an encoder is read: none of them is rounded to a grid.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.concealed.laws import (
    dahl,
    drive_torque,
    encoder,
    encoder_gain,
    flank,
    friction_level,
    link_torque,
    maxwell_slip,
)

Array = NDArray[np.float64]

STEP = 1e-4
"""Longest step of the integrator [s]."""
LOAD_TIME = 0.002
"""Within which friction follows the transmitted torque [s]: an algebraic loop otherwise."""


class Tree(NamedTuple):
    """Bodies, each on one joint. A body's frame sits at its joint."""

    parent: NDArray[np.int64]
    """Index of the body before; -1 for the world. Shape (J,)."""
    slide: NDArray[np.bool_]
    axis: Array
    """In the body's frame. Shape (J, 3)."""
    place: Array
    """Origin of the frame in the parent's, at q = 0 [m]. Shape (J, 3)."""
    turn: Array
    """Rotation of the frame into the parent's, at q = 0. Shape (J, 3, 3)."""
    mass: Array
    com: Array
    """In the body's frame [m]. Shape (J, 3)."""
    inertia: Array
    """About the centre of mass, in the body's frame [kg·m²]. Shape (J, 3, 3)."""
    gravity: Array
    """[m/s²]. Shape (3,)."""


class Drive(NamedTuple):
    """What the robot is told to do in one take."""

    time: Array
    """Instants of the control loop [s]. Shape (T,)."""
    target: Array
    """Reference of the loop, or position target that is sent [rad]. Shape (T, J)."""
    target_speed: Array
    feedforward: Array
    """Torque beside the feedback [N·m]. Shape (T, J)."""
    kp: Array
    """Stiffness of the loop that makes torques, or of the drive's own [N·m/rad]. Shape (J,)."""
    kd: Array
    limit: Array
    """Largest torque that is commanded [N·m]. Shape (J,)."""
    position_control: bool
    """The command is the target, and the drive closes the loop at the integrator's rate."""
    sample: Array
    """Instants at which the encoders are read for the log [s]. Shape (T,)."""
    noise: Array
    """Noise of the readings [rad]. Shape (T, J)."""
    resolution: Array
    """Resolution of the encoders [rad]. Shape (J,)."""
    take: float


@njit(cache=True)
def _turned(axis, angle, out):  # type: ignore[no-untyped-def]
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = axis[0], axis[1], axis[2]
    d = 1.0 - c
    out[0, 0], out[0, 1], out[0, 2] = c + d * x * x, d * x * y - s * z, d * x * z + s * y
    out[1, 0], out[1, 1], out[1, 2] = d * x * y + s * z, c + d * y * y, d * y * z - s * x
    out[2, 0], out[2, 1], out[2, 2] = d * x * z - s * y, d * y * z + s * x, c + d * z * z


@njit(cache=True)
def _times(a, b, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit(cache=True)
def _apply(a, x, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        out[i] = a[i, 0] * x[0] + a[i, 1] * x[1] + a[i, 2] * x[2]


@njit(cache=True)
def _cross(a, b, out):  # type: ignore[no-untyped-def]
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def workspace(joints):  # type: ignore[no-untyped-def]
    """Room for :func:`dynamics`: matrices and vectors of each body."""
    return np.zeros((joints, 4, 3, 3)), np.zeros((joints, 16, 3))


@njit(cache=True)
def dynamics(tree, q, v, matrices, vectors, mass_matrix, bias):  # type: ignore[no-untyped-def]
    """Write M(q), without rotors, and the bias torque of gravity, Coriolis and centrifugal forces.

    Moments are taken about the world's origin, so that those of a subtree simply add.
    """
    n = tree.parent.shape[0]
    tmp = np.empty(3)
    tmp2 = np.empty(3)
    for b in range(n):
        world, turn, spin_inertia, about_origin = matrices[b, 0], matrices[b, 1], matrices[b, 2], matrices[b, 3]
        z, p, w, alpha, acc = vectors[b, 0], vectors[b, 1], vectors[b, 2], vectors[b, 3], vectors[b, 4]
        c, force, moment, first = vectors[b, 5], vectors[b, 6], vectors[b, 7], vectors[b, 8]
        parent = tree.parent[b]
        if tree.slide[b]:
            turn[:, :] = tree.turn[b]
        else:
            _turned(tree.axis[b], q[b], about_origin)
            _times(tree.turn[b], about_origin, turn)
        if parent < 0:
            world[:, :] = turn
            p[:] = tree.place[b]
            w[:] = 0.0
            alpha[:] = 0.0
            for i in range(3):
                acc[i] = -tree.gravity[i]
            tmp[:] = tree.place[b]
        else:
            _times(matrices[parent, 0], turn, world)
            _apply(matrices[parent, 0], tree.place[b], tmp)
            for i in range(3):
                p[i] = vectors[parent, 1, i] + tmp[i]
            w[:] = vectors[parent, 2]
            alpha[:] = vectors[parent, 3]
            acc[:] = vectors[parent, 4]
        _apply(world, tree.axis[b], z)
        if tree.slide[b]:
            for i in range(3):
                p[i] += z[i] * q[b]
                tmp[i] += z[i] * q[b]
        if parent >= 0:
            _cross(alpha, tmp, tmp2)
            for i in range(3):
                acc[i] += tmp2[i]
            _cross(w, tmp, tmp2)
            _cross(w, tmp2, tmp)
            for i in range(3):
                acc[i] += tmp[i]
            _cross(w, z, tmp)
            if tree.slide[b]:
                for i in range(3):
                    acc[i] += 2.0 * v[b] * tmp[i]
            else:
                for i in range(3):
                    alpha[i] += v[b] * tmp[i]
        if not tree.slide[b]:
            for i in range(3):
                w[i] += v[b] * z[i]
        m = tree.mass[b]
        _apply(world, tree.com[b], tmp)
        for i in range(3):
            c[i] = p[i] + tmp[i]
            force[i] = acc[i]
        _cross(alpha, tmp, tmp2)
        for i in range(3):
            force[i] += tmp2[i]
        _cross(w, tmp, tmp2)
        _cross(w, tmp2, tmp)
        for i in range(3):
            force[i] = m * (force[i] + tmp[i])
            first[i] = m * c[i]
        # inertia in the world's frame: R I R'
        _times(world, tree.inertia[b], turn)
        for i in range(3):
            for j in range(3):
                spin_inertia[i, j] = turn[i, 0] * world[j, 0] + turn[i, 1] * world[j, 1] + turn[i, 2] * world[j, 2]
        _apply(spin_inertia, alpha, moment)
        _apply(spin_inertia, w, tmp)
        _cross(w, tmp, tmp2)
        for i in range(3):
            moment[i] += tmp2[i]
        _cross(c, force, tmp)
        for i in range(3):
            moment[i] += tmp[i]
        square = _dot(c, c)
        for i in range(3):
            for j in range(3):
                about_origin[i, j] = spin_inertia[i, j] - m * c[i] * c[j]
            about_origin[i, i] += m * square
        vectors[b, 9, 0] = m
    for b in range(n - 1, -1, -1):
        z, p, force, moment, first = vectors[b, 0], vectors[b, 1], vectors[b, 6], vectors[b, 7], vectors[b, 8]
        linear, angular = vectors[b, 10], vectors[b, 11]
        if tree.slide[b]:
            bias[b] = _dot(z, force)
            for i in range(3):
                linear[i] = vectors[b, 9, 0] * z[i]
            _cross(first, z, angular)
        else:
            _cross(p, force, tmp)
            for i in range(3):
                tmp[i] = moment[i] - tmp[i]
            bias[b] = _dot(z, tmp)
            _cross(z, p, tmp)
            _cross(z, first, linear)
            for i in range(3):
                linear[i] -= vectors[b, 9, 0] * tmp[i]
            _apply(matrices[b, 3], z, angular)
            _cross(first, tmp, tmp2)
            for i in range(3):
                angular[i] -= tmp2[i]
        j = b
        while j >= 0:
            zj = vectors[j, 0]
            if tree.slide[j]:
                value = _dot(zj, linear)
            else:
                _cross(vectors[j, 1], linear, tmp)
                for i in range(3):
                    tmp[i] = angular[i] - tmp[i]
                value = _dot(zj, tmp)
            mass_matrix[b, j] = value
            mass_matrix[j, b] = value
            j = tree.parent[j]
        parent = tree.parent[b]
        if parent >= 0:
            vectors[parent, 9, 0] += vectors[b, 9, 0]
            for i in range(3):
                vectors[parent, 6, i] += force[i]
                vectors[parent, 7, i] += moment[i]
                vectors[parent, 8, i] += first[i]
                for k in range(3):
                    matrices[parent, 3, i, k] += matrices[b, 3, i, k]


@njit(cache=True)
def inverse(tree, q, v, a):  # type: ignore[no-untyped-def]
    """Torques of a motion, without rotors and friction [N·m]. Shapes (T, J) in and out; M of each instant, too."""
    samples, n = q.shape
    matrices, vectors = workspace(n)
    masses = np.zeros((samples, n, n))
    out = np.empty((samples, n))
    for t in range(samples):
        dynamics(tree, q[t], v[t], matrices, vectors, masses[t], out[t])
        for i in range(n):
            for j in range(n):
                out[t, i] += masses[t, i, j] * a[t, j]
    return out, masses


@njit(cache=True)
def solve(matrix, right, n):  # type: ignore[no-untyped-def]
    """Solve in place by Cholesky; both arguments are overwritten, ``right`` with the solution."""
    for i in range(n):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i == j:
                matrix[i, i] = np.sqrt(value)
            else:
                matrix[i, j] = value / matrix[j, j]
    for i in range(n):
        for k in range(i):
            right[i] -= matrix[i, k] * right[k]
        right[i] /= matrix[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= matrix[k, i] * right[k]
        right[i] /= matrix[i, i]


@njit(cache=True)
def simulate(tree, laws, elements, gear_elements, drive, start, step):  # type: ignore[no-untyped-def]
    """Move the robot, from rest at ``start``.

    Args:
        tree: Bodies, a :class:`Tree`.
        laws: Of each joint, ``laws.JOINT``. Shape (J,).
        elements: Maxwell elements of the dry friction: shares and stiffness. Shape (J, E, 2).
        gear_elements: The same of the hysteresis; all shares zero for Dahl's. Shape (J, E, 2).
        drive: What the robot is told, a :class:`Drive`.
        start: First position [rad]. Shape (J,).
        step: Longest step [s].

    Returns:
        Command at ``drive.time``; logged reading, and speed without noise, at ``drive.sample``; reading and speed
        without noise and steps at ``drive.time``. Shape (T, J) each.
    """
    n = tree.parent.shape[0]
    samples = drive.time.shape[0]
    matrices, vectors = workspace(n)
    mass_matrix, system, bias, right = np.zeros((n, n)), np.zeros((n, n)), np.zeros(n), np.zeros(n)
    flexible = np.zeros(n, dtype=np.bool_)
    for j in range(n):
        flexible[j] = laws[j].stiffness < np.inf
    q, v, a = start.copy(), np.zeros(n), np.zeros(n)
    theta, omega, motor_a = start.copy(), np.zeros(n), np.zeros(n)
    slip, gear_slip, bristle, loss = (
        np.zeros(elements.shape[:2]),
        np.zeros(elements.shape[:2]),
        np.zeros(n),
        np.zeros(n),
    )
    friction, borne, load, cold = np.zeros(n), np.zeros(n), np.zeros(n), np.ones(n)
    lagged, looped, looped_speed = np.zeros(n), np.zeros(n), np.zeros(n)
    wanted, active, torque = np.zeros(n), np.full(n, -1), np.zeros(n)
    command = np.zeros((samples, n))
    reading, speed = np.zeros((samples, n)), np.zeros((samples, n))
    clean, clean_speed = np.zeros((samples, n)), np.zeros((samples, n))
    time = min(drive.time[0], drive.sample[0])
    k, s, first = -1, 0, True
    moved = np.zeros(n)
    while True:
        # what happens now: readings for the log, the control loop, commands that arrive
        while s < samples and drive.sample[s] <= time + 1e-12:
            for j in range(n):
                raw = encoder(laws[j], theta[j]) + drive.noise[s, j]
                reading[s, j] = np.round(raw / drive.resolution[j]) * drive.resolution[j]
                speed[s, j] = encoder_gain(laws[j], theta[j]) * omega[j]
            s += 1
        while k + 1 < samples and drive.time[k + 1] <= time + 1e-12:
            k += 1
            for j in range(n):
                clean[k, j] = encoder(laws[j], theta[j])
                clean_speed[k, j] = encoder_gain(laws[j], theta[j]) * omega[j]
                if drive.position_control:
                    command[k, j] = drive.target[k, j]
                else:
                    raw = clean[k, j] + drive.noise[k, j]
                    raw = np.round(raw / drive.resolution[j]) * drive.resolution[j]
                    u = drive.feedforward[k, j] + drive.kp[j] * (drive.target[k, j] - raw)
                    u += drive.kd[j] * (drive.target_speed[k, j] - clean_speed[k, j])
                    command[k, j] = min(max(u, -drive.limit[j]), drive.limit[j])
        if k == samples - 1 and s == samples:
            break
        until = drive.time[k + 1] if k + 1 < samples else np.inf
        if s < samples:
            until = min(until, drive.sample[s])
        for j in range(n):
            while active[j] < k and drive.time[active[j] + 1] + laws[j].delay <= time + 1e-12:
                active[j] += 1
            if active[j] < k:
                until = min(until, drive.time[active[j] + 1] + laws[j].delay)
        count = int(np.ceil((until - time) / step - 1e-9))
        h = (until - time) / count
        for i in range(-1, count):
            if i >= 0:  # -1 computes the acceleration under the new command, and moves nothing
                for j in range(n):
                    q[j] += h * (v[j] + 0.5 * h * a[j])
                    v[j] += 0.5 * h * a[j]
                    moved[j] = h * (omega[j] + 0.5 * h * motor_a[j])
                    theta[j] += moved[j]
                    omega[j] += 0.5 * h * motor_a[j]
                now = time + (i + 1) * h
            else:
                now = time
                moved[:] = 0.0
            half = 0.5 * h if i >= 0 else 0.0
            for j in range(n):
                p = laws[j]
                rate = omega[j] + half * motor_a[j]  # predicted
                if i >= 0:
                    if p.cold != 0.0:
                        heat = 1.0
                        if p.cold_heat != 0.0:
                            heat = 1.0 - p.cold_heat + p.cold_heat * abs(friction[j] * rate) / p.cold_power
                        cold[j] *= np.exp(-h * heat / p.cold_time)
                    level = friction_level(p, theta[j], rate, load[j], cold[j])
                    dry = 0.0
                    if level > 0.0:
                        dry = maxwell_slip(elements[j], slip[j], moved[j], rate, level, p.slip_rate, p.micro_damping, h)
                    dry += (p.viscous_positive if rate >= 0 else p.viscous_negative) * rate
                    dry += p.quadratic * abs(rate) * rate
                    if p.hysteresis != 0.0:
                        if gear_elements[j, 0, 0] > 0.0:
                            dry += maxwell_slip(
                                gear_elements[j], gear_slip[j], moved[j], rate, p.hysteresis, np.inf, 0.0, h
                            )
                        else:
                            bristle[j] = dahl(bristle[j], moved[j], p.hysteresis_width)
                            dry += p.hysteresis * bristle[j]
                    friction[j] = dry
                # the drive
                given = command[active[j], j] if active[j] >= 0 else (theta[j] if drive.position_control else 0.0)
                if drive.position_control:
                    given = p.kp_scale * drive.kp[j] * (given - encoder(p, theta[j]))
                    given -= p.kd_scale * drive.kd[j] * encoder_gain(p, theta[j]) * rate
                    given = min(max(given, -drive.limit[j]), drive.limit[j])
                if p.dead_zone != 0.0:
                    given = max(given - p.dead_zone, 0.0) + min(given + p.dead_zone, 0.0)
                if first:
                    lagged[j] = looped[j] = given
                if p.lag > 0.0:
                    if i >= 0:
                        lagged[j] = given + (lagged[j] - given) * np.exp(-h / p.lag)
                    given = lagged[j]
                if p.loop_frequency > 0.0:
                    if i >= 0:
                        f = p.loop_frequency
                        looped_speed[j] += h * f * (f * (given - looped[j]) - 2.0 * p.loop_damping * looped_speed[j])
                        looped[j] += h * looped_speed[j]
                    given = looped[j]
                torque[j] = drive_torque(p, given, theta[j], rate) - friction[j]
            first = False
            # accelerations of links and rotors
            for j in range(n):
                wanted[j] = v[j] + half * a[j]
            dynamics(tree, q, wanted, matrices, vectors, mass_matrix, bias)
            for j in range(n):
                p = laws[j]
                for m in range(n):
                    system[j, m] = mass_matrix[j, m]
                rate = omega[j] + half * motor_a[j]
                if flexible[j]:
                    beyond = flank(p, theta[j] - q[j])
                    gear = p.stiffness * beyond + p.stiffness_cubic * beyond**3
                    if p.gap == 0.0 or abs(theta[j] - q[j]) > 0.5 * p.gap:
                        gear += p.gear_damping * (rate - wanted[j])
                    if p.gear_loss != 0.0:
                        if i >= 0:
                            loss[j] = dahl(loss[j], moved[j] - h * wanted[j], p.gear_loss_width)
                        gear += p.gear_loss * loss[j]
                    motor_a[j] = (torque[j] - gear) / p.armature
                    borne[j] = gear
                    right[j] = gear
                else:
                    system[j, j] += p.armature
                    right[j] = torque[j]
                right[j] += link_torque(p, q[j], wanted[j], now, drive.take) - bias[j]
            solve(system, right, n)
            for j in range(n):
                a[j] = right[j]
                if not flexible[j]:
                    motor_a[j] = a[j]
                    borne[j] = torque[j] - laws[j].armature * a[j]
                if i >= 0:
                    load[j] += (borne[j] - load[j]) * (1.0 - np.exp(-h / LOAD_TIME))
                    v[j] += half * a[j]
                    omega[j] += half * motor_a[j]
        time = until
    return command, reading, speed, clean, clean_speed
