"""What others do with the same recordings: least squares by hand, mujoco.sysid, and PACE's list by CMA-ES.

All minimise the error by which they are judged, :meth:`Replay.residual`, over windows of the recordings to fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import Any

import mujoco
import numpy as np
from cmaes import CMA  # type: ignore[import-untyped]
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.real_robots.replay import NAMES, Replay

Array = NDArray[np.float64]

RIVALS = ("by hand, 4 numbers", "by hand, the same list", "PACE's list", "mujoco.sysid")
SHORT = ("frictionloss", "damping", "armature", "limit")
"""What most people fit by hand."""
PACE = ("frictionloss", "damping", "armature", "encoder")
"""What PACE fits at every joint, beside one delay of all (Bjelonic et al. 2025, arXiv 2509.06342)."""
DIFFERENCES = (0.01, 0.1)
"""Steps of finite differences, in sizes of a number, each of which is tried: a simulation with friction is rough."""
GENERATIONS = 150
"""Generations of CMA-ES."""


def bounds(replay: Replay) -> tuple[Array, Array, Array]:
    """Wide ones, and a size of each number. Shapes (10, J)."""
    x = replay.nominal()
    limit = x[4]
    one = np.ones_like(limit)
    low = np.stack([0 * one, 0 * one, 0 * one, 0 * one, 0.01 * limit, -limit, -0.5 * one, *[0.05 * one] * 3])
    high = np.stack([limit, 20 * limit, 100 * one, 0.2 * one, limit, limit, 0.5 * one, *[20 * one] * 3])
    size = np.stack([0.02 * limit, 0.02 * limit, 0.01 * one, 0.005 * one, 0.1 * limit, 0.02 * limit, 0.02 * one,
                     *[0.1 * one] * 3])  # fmt: skip
    mass = np.zeros((replay.given.nv, replay.given.nv))
    data = mujoco.MjData(replay.given)
    mujoco.mj_forward(replay.given, data)
    mujoco.mj_fullM(replay.given, data, mass)
    inertia = np.diag(mass)[replay.dof]
    high[2], size[2] = 100 * inertia, 0.1 * inertia
    return low, high, size


def by_hand(replay: Replay, names: Sequence[str]) -> Array:
    """``scipy.optimize.least_squares`` from a sensible guess, as one would write it in an afternoon.

    Of the fits with each of :data:`DIFFERENCES` that of the least error on the recordings to fit counts.
    """
    low, high, size = bounds(replay)
    x = replay.nominal()
    rows = [NAMES.index(n) for n in names]
    guess = x.copy()
    guess[:3] = np.maximum(guess[:3], 0.3 * size[:3])
    if "limit" in names:  # just below what was asked for, or no slope would show it
        guess[4] = np.minimum(x[4], 0.9 * _asked(replay))
    bottom, top, begin = ((y / size)[rows].ravel() for y in (low, high, guess))
    begin = np.clip(begin, bottom + 1e-6, top - 1e-6)

    def values(z: Array) -> Array:
        y = x.copy()
        y[rows] = z.reshape(len(rows), -1) * size[rows]
        return y

    def residual(z: Array) -> Array:
        return replay.residual(values(z))

    def slopes(z: Array, step: float) -> Array:
        here, steps = residual(z), np.where(z + step > top, -step, step)
        return np.stack([(residual(z + move) - here) / move.sum() for move in np.diag(steps)], -1)

    fits = [
        least_squares(
            residual, begin, partial(slopes, step=step), (bottom, top), x_scale="jac", max_nfev=40, xtol=1e-4, ftol=1e-4
        )
        for step in DIFFERENCES
    ]
    return values(min(fits, key=lambda fitted: float(fitted.cost)).x)


def _asked(replay: Replay) -> Array:
    """Largest torque that was asked for."""
    most = np.zeros(len(replay.dof))
    for w in replay.windows:
        command = np.diff(w.integral, axis=0) / np.diff(w.stamps)[:, None]
        if w.gains is not None:
            command = w.gains[0] * (command - w.measured.mean(0))
        most = np.maximum(most, np.abs(command).max(0))
    return most


def by_pace(replay: Replay, seed: int = 0) -> Array:
    """PACE's list by its optimiser, CMA-ES, from the middle of the same bounds as the other rivals'."""
    low, high, size = bounds(replay)
    x, joints = replay.nominal(), len(replay.dof)
    rows, late = [NAMES.index(n) for n in PACE], NAMES.index("delay")
    unit = np.append(10 * size[rows].ravel(), 10 * size[late, 0])

    def values(z: Array) -> Array:
        y = x.copy()
        y[rows] = (z[:-1] * unit[:-1]).reshape(len(rows), joints)
        y[late] = z[-1] * unit[-1]
        return y

    edges = np.stack([np.append(side[rows].ravel(), side[late, 0]) / unit for side in (low, high)], -1)
    begin = np.append(np.where(np.array(rows)[:, None] < 3, 0.3 * size[rows], 0.0).ravel(), 0.0) / unit
    given = np.append(x[rows].ravel(), x[late, 0]) / unit
    search = CMA(mean=np.clip(np.maximum(begin, given), *edges.T), sigma=0.3, bounds=edges, seed=seed)
    best, least = given, np.inf
    for _ in range(GENERATIONS):
        told = []
        for _ in range(search.population_size):
            z = search.ask()
            cost = float(np.sum(replay.residual(values(z)) ** 2))
            told.append((z, cost))
            if cost < least:
                best, least = z, cost
        search.tell(told)
        if search.should_stop():
            break
    return values(best)


def by_sysid(replay: Replay) -> Array | None:
    """mujoco.sysid with friction, damping, rotor, offset and scale or gain, one model for all; None if it cannot.

    Delays and limits by parameter, logs with several payloads, gains or rates are beyond its one model; a simulation
    that diverges, as of the Gen3 without friction, ends it.
    """
    sysid = import_module("mujoco.sysid")
    if not hasattr(sysid, "ParameterDict") or len({w.kind for w in replay.windows}) > 1:
        return None
    low, high, size = bounds(replay)
    drive = "kp" if replay.targets else "scale"
    x, rows = replay.nominal(), [NAMES.index(n) for n in ("frictionloss", "damping", "armature", "offset", drive)]
    params = sysid.ParameterDict()
    for k in rows:
        begin = np.clip(x[k], low[k] + 0.3 * size[k] * (k < 3), high[k])
        params.add(sysid.Parameter(NAMES[k], begin, low[k], high[k]))
    window = replay.windows[0]

    def build(p: Any, spec: Any = None) -> mujoco.MjModel:
        y = x.copy()
        for k in rows:
            y[k] = np.ravel(p[NAMES[k]].value)
        return replay.model(y, window)

    model, still = replay.model(x, window), np.zeros(len(replay.dof))
    mapping = sysid.TimeSeries.compute_all_state_mappings(model)[0]
    trajectories = []
    for w in replay.windows:
        control = replay.control(w, still)
        time = w.step * np.arange(len(control) + 1)
        read = np.tile(model.qpos0, (len(w.measured) + 1, 1))
        read[:, replay.qpos] = np.vstack([w.q, w.measured])
        trajectories.append(
            sysid.SystemTrajectory(
                model,
                sysid.TimeSeries.from_control_names(time, np.vstack([control, control[-1:]]), model),
                sysid.TimeSeries(time[:: w.substeps], read, mapping),
                replay.state(w, still),
                None,
            )
        )
    residual = _sysid_residual(sysid, params, build, trajectories)
    try:
        found, _ = sysid.optimize(params, residual, optimizer="mujoco", verbose=False, max_iters=15, x_scale="jac")
    except ValueError:  # MuJoCo sets the clock back where a simulation diverges, which it does not take
        return None
    for k in rows:
        x[k] = np.ravel(found[NAMES[k]].value)
    return x


def _sysid_residual(sysid: Any, params: Any, build: Callable[..., Any], trajectories: Sequence[Any]) -> Any:
    def residual(z: Array, p: Any, **options: Any) -> Any:
        return [sysid.model_residual(z, p, build, t, **options)[0] for t in trajectories], [], []

    return residual
