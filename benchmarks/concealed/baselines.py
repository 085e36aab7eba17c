"""What others would answer on the same folder: naive BIC, a full parameter list fitted at once, PACE's list by CMA-ES.

    python benchmarks/concealed/baselines.py FOLDER --method naive_bic

They see what the diagnosis sees, and write the same ``answer.json``. None of them has a gate or a noise floor: each
states the one cause that its criterion puts first.

``naive_bic`` regresses the torque that the model misses on one effect at a time, and takes the lowest Bayesian
information criterion, as if samples were independent. ``sysid`` is the procedure of ``mujoco.sysid`` (box-constrained
least squares of rollouts, every parameter free at once; written with SciPy, since that package needs more than MuJoCo
installs) and names the parameter that moved furthest within its bounds. ``pace`` fits PACE's list (rotor inertia,
viscous and dry friction, encoder bias of each joint, one delay) by CMA-ES with the package ``cmaes``
(https://github.com/leggedrobotics/pace-sim2real), and names its largest change in the same way.
"""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import tyro
from mujoco import rollout
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares
from scipy.signal import lfilter

from torchrl_athletic.recordings import Recording, read_recordings

Array = NDArray[np.float64]
SMOOTHING = 0.010
"""Width of the Gaussian that all signals pass [s]."""
WINDOW, STEP = 0.5, 0.002
"""Length of a rollout and step of the simulation [s]."""
WINDOWS = 12
"""Rollouts that parameter lists are fitted to: about a minute on one core for six joints."""
SIGMA = 0.3
"""First spread of CMA-ES, in the parameters' ranges."""
GENERATIONS = 60


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    folder: tyro.conf.Positional[Path]
    method: Literal["naive_bic", "sysid", "pace"] = "naive_bic"
    without: tuple[str, ...] = ()
    """Names that must not be stated."""


Named = tuple[str, str | None, float, dict[str, float]]
"""Effect, joint, probability, parameters."""


def main(cfg: Config) -> None:
    begin = time.monotonic()
    xml = (cfg.folder / "model.xml").read_text(encoding="utf-8")
    takes = read_recordings(cfg.folder / "fit")
    names = {"naive_bic": naive_bic, "sysid": sysid, "pace": pace}[cfg.method](xml, takes, cfg.without)
    findings: list[dict[str, Any]] = [
        {
            "effect": effect, "joint": joint, "probability": probability, "sentence": "", "regime": "", "rivals": [],
            "parameters": {k: {"value": v, "ci95": [v, v], "unit": ""} for k, v in parameters.items()},
        }
        for effect, joint, probability, parameters in names
    ]  # fmt: skip
    answer: dict[str, Any] = {
        "verdict": "explained" if findings else "nothing_missing",
        "findings": findings,
        "fit": {},
    }
    content = {
        "answer": answer,
        "seconds": time.monotonic() - begin,
        "megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "joints": takes[0].num_joints,
    }
    (cfg.folder / "answer.json").write_text(json.dumps(content), encoding="utf-8")


# --- naive BIC ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Signals:
    """All takes one after the other, smoothed. Shape (T, J) each."""

    take: NDArray[np.int64]
    time: Array
    q: Array
    v: Array
    a: Array
    u: Array
    """Torque that was commanded."""
    command: Sequence[tuple[Array, Array]]
    """(stamps, command held from them) of each take: torques, or what targets ask for, ``kp * target``."""
    feedback: Array
    """What the drive adds to the command by itself: ``-kp q - kd v`` for targets, else nothing."""
    missing: Array
    """Torque that the model misses."""


def signals(model: mujoco.MjModel, takes: Sequence[Recording]) -> Signals:
    """Uniform, smoothed signals at every 10 ms, and the torque that the model misses in them."""
    parts: list[list[Array]] = []
    commands = []
    for number, take in enumerate(takes):
        step = 1.0 / take.rate
        t = np.arange(take.time[0], take.time[-1], step)
        q = _resampled(t, take.time, take.position)
        width = SMOOTHING * take.rate
        q = gaussian_filter1d(q, width, axis=0)
        if take.velocity is not None:
            v = gaussian_filter1d(_resampled(t, take.time, take.velocity), width, axis=0)
        else:
            v = np.gradient(q, step, axis=0)
        a = np.gradient(v, step, axis=0)
        held, feedback = take.torque_command, np.zeros_like(q)
        if held is None:
            assert take.position_target is not None
            assert take.kp is not None
            assert take.kd is not None
            held, feedback = take.kp * take.position_target, -take.kp * q - take.kd * v
        commands.append((take.time, held))
        keep = slice(20, -20, max(1, round(0.010 / step)))
        u = _held(commands[-1], t, 0.0) + feedback
        parts.append([x[keep] for x in (np.full(len(t), number), t, q, v, a, u, feedback)])
    take_of, t, q, v, a, u, feedback = (np.concatenate(x) for x in zip(*parts, strict=True))
    missing = inverse_dynamics(model, q, v, a) - u
    return Signals(take_of.astype(np.int64), t, q, v, a, u, commands, feedback, missing)


def _resampled(t: Array, stamps: Array, x: Array) -> Array:
    return np.stack([np.interp(t, stamps, column) for column in x.T], axis=1)


def _held(command: tuple[Array, Array], t: Array, delay: float, lag: float = 0.0) -> Array:
    """Command that was held, after a delay and a lag, smoothed."""
    stamps, values = command
    fine = np.arange(t[0], t[-1] + 1e-9, 0.001)
    rows = np.clip(np.searchsorted(stamps, fine - delay, side="right") - 1, 0, None)
    u = values[rows]
    if lag > 0:
        pole = np.exp(-0.001 / lag)
        u = lfilter([1 - pole], [1, -pole], u, axis=0, zi=pole * u[:1])[0]
    u = gaussian_filter1d(u, SMOOTHING * 1000, axis=0)
    return _resampled(t, fine + 0.0005, u)


def inverse_dynamics(model: mujoco.MjModel, q: Array, v: Array, a: Array) -> Array:
    """Torque of a motion without joint limits. Shape (T, J)."""
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    data, out = mujoco.MjData(model), np.empty_like(q)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
        mujoco.mj_inverse(model, data)
        out[k] = data.qfrc_inverse
    return out


Columns = tuple[str, str | None, int | None, Array]
"""Effect, joint, row of the joint (None: all rows), and its columns: (T, k) of a joint or (T, J, k) of all."""


def columns(xml: str, s: Signals, position_control: bool) -> Iterator[Columns]:
    """What each effect of the catalogue would make the model miss, its nonlinear parameters on a grid."""
    model = mujoco.MjModel.from_xml_string(xml)
    names = [model.joint(j).name for j in range(model.njnt)]
    t = s.time
    for j, name in enumerate(names):
        q, v, a, u = s.q[:, j], s.v[:, j], s.a[:, j], s.u[:, j]
        typical = np.sqrt((v**2).mean())
        reach = float(np.ptp(q))
        sign = np.tanh(v / (0.03 * typical))
        one = np.ones_like(q)
        yield "coulomb_friction", name, j, sign[:, None]
        yield "viscous_friction", name, j, v[:, None]
        for share in (0.08, 0.15, 0.3, 0.5):
            yield "stribeck_friction", name, j, np.stack([sign, sign * np.exp(-((v / (share * typical)) ** 2))], 1)
        yield "load_dependent_friction", name, j, np.stack([sign, sign * abs(u)], 1)
        yield "asymmetric_friction", name, j, np.stack([sign * (v > 0), sign * (v < 0), v * (v > 0), v * (v < 0)], 1)
        for share in (0.02, 0.05, 0.1, 0.2):
            yield "hysteresis", name, j, _bristle(s, j, share * reach)[:, None]
        yield "reflected_inertia", name, j, a[:, None]
        yield "torque_offset", name, j, one[:, None]
        yield "torque_scale", name, j, u[:, None]
        yield "joint_spring", name, j, np.stack([q, one], 1)
        for share in (0.05, 0.1, 0.2, 0.35):
            yield "joint_stop", name, j, np.maximum(q - np.max(q) + share * reach, 0)[:, None]
            yield "joint_stop", name, j, np.minimum(q - np.min(q) - share * reach, 0)[:, None]
        for n in (*range(3, 41), *range(42, 64, 2)):
            yield "torque_ripple", name, j, np.stack([np.sin(n * q), np.cos(n * q)], 1)
        for limit in np.quantile(abs(u), (0.5, 0.7, 0.85, 0.95)):
            yield "torque_saturation", name, j, (np.clip(u, -limit, limit) - u)[:, None]
            for top in np.quantile(abs(v), (0.9, 0.999)) * 1.2:
                upper, lower = limit * np.clip(1 - v / top, 0, 1), -limit * np.clip(1 + v / top, 0, 1)
                yield "speed_torque_limit", name, j, (np.clip(u, lower, upper) - u)[:, None]
        for tau in (0.002, 0.005, 0.01, 0.02):
            yield "actuation_delay", name, j, (_delayed(s, j, tau, 0.0) - u)[:, None]
            yield "actuation_lag", name, j, (_delayed(s, j, 0.0, tau) - u)[:, None]
        for tau in (5.0, 10.0, 15.0):
            yield "thermal_drift", name, j, (sign * np.exp(-t / tau))[:, None]
        for start in np.arange(2.0, 16.0, 0.5):
            for take in range(len(s.command)):
                yield "disturbance", name, j, ((s.take == take) & (t >= start) & (t < start + 0.7))[:, None] * 1.0
        stretched = np.gradient(np.gradient(u)) / 0.01**2  # the rotor moves ahead of the link by u / K
        yield "compliance", name, j, stretched[:, None]
        yield "backlash", name, j, np.gradient(np.gradient(np.tanh(3 * u / (abs(u).mean() + 1e-9))))[:, None] / 0.01**2
        shifted = [x.copy() for x in (s.q, s.v, s.a)]
        shifted[0][:, j] += 1e-3
        yield "encoder_offset", name, None, _change(model, s, shifted, 1e-3)
        scaled = [x.copy() for x in (s.q, s.v, s.a)]
        for x in scaled:
            x[:, j] *= 1.001
        yield "encoder_scale", name, None, _change(model, s, scaled, 1e-3)
        for effect, edit in (("link_mass", _heavier), ("link_com", _longer), ("payload", _loaded)):
            if effect != "payload" or j == len(names) - 1:
                changed = mujoco.MjModel.from_xml_string(xml)
                edit(changed, j)
                yield effect, name, None, (inverse_dynamics(changed, s.q, s.v, s.a) - s.u - s.missing)[:, :, None]
        if position_control:
            yield "gain_mismatch", name, j, np.stack([u + 0 * v, v], 1)
    tilts = []
    for axis in (0, 1):
        changed = mujoco.MjModel.from_xml_string(xml)
        changed.opt.gravity[axis] = 0.1
        tilts.append(inverse_dynamics(changed, s.q, s.v, s.a) - s.u - s.missing)
    yield "gravity_tilt", None, None, np.stack(tilts, axis=2)
    late = np.stack([_delayed(s, j, 0.002, 0.0) for j in range(len(names))], axis=1)
    yield "clock_offset", None, None, (late - s.u)[:, :, None]


def _change(model: mujoco.MjModel, s: Signals, moved: Sequence[Array], size: float) -> Array:
    return ((inverse_dynamics(model, *moved) - s.u - s.missing) / size)[:, :, None]


def _heavier(model: mujoco.MjModel, j: int) -> None:
    body = model.jnt_bodyid[j]
    model.body_mass[body] *= 1.1
    model.body_inertia[body] *= 1.1
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _longer(model: mujoco.MjModel, j: int) -> None:
    model.body_ipos[model.jnt_bodyid[j]] *= 1.1
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _loaded(model: mujoco.MjModel, j: int) -> None:
    """A tenth of the link's mass at the far end of its capsule: to first order, and without turning the inertia."""
    body = model.jnt_bodyid[j]
    geom = model.body_geomadr[body]
    tip = 2 * model.geom_pos[geom]
    more = 0.1 * model.body_mass[body]
    total = model.body_mass[body] + more
    com = (model.body_mass[body] * model.body_ipos[body] + more * tip) / total
    model.body_inertia[body] += more * float((tip - com) @ (tip - com)) * np.array([1.0, 1.0, 0.2])
    model.body_mass[body], model.body_ipos[body] = total, com
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _delayed(s: Signals, j: int, delay: float, lag: float) -> Array:
    out = np.empty(len(s.time))
    for take, (stamps, values) in enumerate(s.command):
        rows = s.take == take
        out[rows] = _held((stamps, values[:, j : j + 1]), s.time[rows], delay, lag)[:, 0]
    return out + s.feedback[:, j]


def _bristle(s: Signals, j: int, length: float) -> Array:
    z, out = 0.0, np.empty(len(s.q))
    for k, moved in enumerate(np.diff(s.q[:, j], prepend=s.q[0, j])):
        side = 1.0 if moved > 0 else -1.0
        z = side + (z - side) * float(np.exp(-abs(moved) / length))
        out[k] = z
    return out


def naive_bic(xml: str, takes: Sequence[Recording], without: Sequence[str]) -> list[Named]:
    """The effect of the lowest BIC; nothing only if no effect beats the empty model."""
    s = signals(mujoco.MjModel.from_xml_string(xml), takes)
    samples = len(s.missing)
    alone = samples * np.log((s.missing**2).mean(0))
    found: list[tuple[float, str, str | None]] = [(float(alone.sum()), "", None)]
    for effect, joint, row, x in columns(xml, s, takes[0].position_target is not None):
        if effect in without:
            continue
        bic = alone.copy()
        if row is not None:
            bic[row] = samples * np.log(_left(x, s.missing[:, row]))
        else:
            weight = np.sqrt((s.missing**2).mean(0))
            left = _left((x / weight[:, None]).reshape(-1, x.shape[2]), (s.missing / weight).ravel(), mean=False)
            bic = samples * np.log(weight**2 * left.reshape(samples, -1).mean(0))
        found.append((float(bic.sum() + x.shape[-1] * np.log(samples)), effect, joint))
    found.sort(key=lambda f: f[0])
    if not found[0][1]:
        return []
    weights = np.exp(-0.5 * (np.array([f[0] for f in found]) - found[0][0]))
    return [(found[0][1], found[0][2], float(weights[0] / weights.sum()), {})]


def _left(x: Array, y: Array, mean: bool = True) -> Any:
    """Squares that least squares leaves: their mean, or each."""
    coefficients = np.linalg.lstsq(x, y, rcond=None)[0]
    squares = (y - x @ coefficients) ** 2
    return float(squares.mean()) if mean else squares


# --- parameter lists fitted to rollouts --------------------------------------------------------------------------


@dataclass(frozen=True)
class Parameter:
    """One free number: what it is called, where it starts and how far it may go."""

    effect: str
    joint: str | None
    index: int
    start: float
    low: float
    high: float


@dataclass(frozen=True)
class Windows:
    """Pieces of the takes that are simulated again. W windows of T steps."""

    start: Array
    """Position and velocity. Shape (W, 2 J)."""
    command: Sequence[tuple[Array, Array]]
    """(stamps, commands) of each window's take."""
    begin: Array
    """[s]. Shape (W,)."""
    measured: Array
    """Position at the steps. Shape (W, T, J)."""


def windows(takes: Sequence[Recording]) -> Windows:
    """Windows spread evenly over all takes, each started from the smoothed measurement."""
    start, command, begin, measured = [], [], [], []
    for take in takes:
        t = np.arange(take.time[0], take.time[-1], STEP)
        q = gaussian_filter1d(_resampled(t, take.time, take.position), SMOOTHING / STEP, axis=0)
        v = np.gradient(q, STEP, axis=0)
        if take.velocity is not None:
            v = gaussian_filter1d(_resampled(t, take.time, take.velocity), SMOOTHING / STEP, axis=0)
        length = round(WINDOW / STEP)
        for k in np.linspace(50, len(t) - length - 50, WINDOWS // len(takes)).astype(int):
            start.append(np.concatenate([q[k], v[k]]))
            command.append((take.time, take.command))
            begin.append(t[k])
            measured.append(_resampled(t[k + 1 : k + 1 + length], take.time, take.position))
    return Windows(np.array(start), command, np.array(begin), np.array(measured))


def parameters(model: mujoco.MjModel, takes: Sequence[Recording], full: bool) -> list[Parameter]:
    """PACE's list, or with ``full`` also mass, centre of mass, stiffness, torque gain and offset of each joint."""
    reach = np.concatenate([t.position for t in takes]).std(0)
    speed = np.concatenate([np.gradient(t.position, t.time, axis=0) for t in takes]).std(0)
    matrix, data = np.zeros((model.nv, model.nv)), mujoco.MjData(model)
    data.qpos[:] = np.concatenate([t.position for t in takes]).mean(0)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, matrix)
    torque = 0.25 * model.actuator_ctrlrange[:, 1]
    out = []
    for j in range(model.nv):
        name = model.joint(j).name
        out += [
            Parameter("reflected_inertia", name, j, model.dof_armature[j], 0.0, model.dof_armature[j] + matrix[j, j]),
            Parameter(
                "viscous_friction", name, j, model.dof_damping[j], 0.0, model.dof_damping[j] + torque[j] / speed[j]
            ),
            Parameter("coulomb_friction", name, j, 0.0, 0.0, torque[j]),
            Parameter("encoder_offset", name, j, 0.0, -0.5 * reach[j], 0.5 * reach[j]),
        ]
        if full:
            out += [
                Parameter("link_mass", name, j, 1.0, 0.4, 2.0),
                Parameter("link_com", name, j, 1.0, 0.4, 2.0),
                Parameter("joint_spring", name, j, 0.0, 0.0, torque[j] / reach[j]),
                Parameter("torque_scale", name, j, 1.0, 0.5, 1.5),
                Parameter("torque_offset", name, j, 0.0, -torque[j], torque[j]),
            ]
    return [*out, Parameter("actuation_delay", None, 0, 0.0, 0.0, 0.03)]


def simulated(xml: str, w: Windows, takes: Sequence[Recording], free: Sequence[Parameter], values: Array) -> Array:
    """Positions that the encoders would read with these parameters. Shape (W, T, J)."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep = STEP
    joints = model.nv
    bias, scale, offset, delay = np.zeros(joints), np.ones(joints), np.zeros(joints), 0.0
    for parameter, value in zip(free, values, strict=True):
        j, body = parameter.index, model.jnt_bodyid[parameter.index]
        match parameter.effect:
            case "reflected_inertia":
                model.dof_armature[j] = value
            case "viscous_friction":
                model.dof_damping[j] = value
            case "coulomb_friction":
                model.dof_frictionloss[j] = value
            case "encoder_offset":
                bias[j] = value
            case "link_mass":
                model.body_mass[body] *= value
                model.body_inertia[body] *= value
            case "link_com":
                model.body_ipos[body] *= value
            case "joint_spring":
                model.jnt_stiffness[j] = value
                model.qpos_spring[j] = model.qpos0[j]
            case "torque_scale":
                scale[j] = value
            case "torque_offset":
                offset[j] = value
            case "actuation_delay":
                delay = value
    mujoco.mj_setConst(model, mujoco.MjData(model))
    first = takes[0]
    if first.position_target is not None:
        assert first.kp is not None
        assert first.kd is not None
        model.actuator_ctrllimited[:] = 0
        model.actuator_forcelimited[:] = 1
        model.actuator_forcerange[:] = model.actuator_ctrlrange
        model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
        model.actuator_gainprm[:, 0] = scale * first.kp
        model.actuator_biasprm[:, 0] = offset - scale * first.kp * bias
        model.actuator_biasprm[:, 1], model.actuator_biasprm[:, 2] = -scale * first.kp, -scale * first.kd
    length = w.measured.shape[1]
    control = np.empty((len(w.begin), length, joints))
    for k, (stamps, command) in enumerate(w.command):
        now = w.begin[k] + STEP * np.arange(length) - delay
        # The share of each step for which either command was held, so that the delay need not be whole steps.
        total = np.vstack([np.zeros(joints), np.cumsum(command[:-1] * np.diff(stamps)[:, None], axis=0)])
        held = _resampled(now + STEP, stamps, total) - _resampled(now, stamps, total)
        control[k] = held / STEP
        if first.position_target is None:
            control[k] = np.clip(scale * control[k] + offset, *model.actuator_ctrlrange.T)
    state = np.zeros((len(w.begin), mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    state[:, 1 : 1 + 2 * joints] = w.start
    state[:, 1 : 1 + joints] -= bias
    states, _ = rollout.rollout(model, mujoco.MjData(model), initial_state=state, control=control)
    return np.asarray(states[:, :, 1 : 1 + joints] + bias)


def _largest(free: Sequence[Parameter], values: Array, without: Sequence[str]) -> list[Named]:
    moved = [(abs(v - p.start) / (p.high - p.low), p, float(v)) for p, v in zip(free, values, strict=True)]
    moved = sorted((m for m in moved if m[1].effect not in without), key=lambda m: -m[0])
    share, best, value = moved[0]
    probability = share / sum(m[0] for m in moved)
    return [(best.effect, best.joint, float(probability), {"value": value})] if share > 0.01 else []


def _objective(xml: str, takes: Sequence[Recording], full: bool) -> tuple[list[Parameter], Callable[[Array], Array]]:
    free = parameters(mujoco.MjModel.from_xml_string(xml), takes, full)
    w = windows(takes)
    unit = w.measured.std(axis=(0, 1))
    low, span = np.array([p.low for p in free]), np.array([p.high - p.low for p in free])

    def residual(x: Array) -> Array:
        """Residual of parameters that are scaled to 0..1."""
        error = (simulated(xml, w, takes, free, low + span * x) - w.measured) / unit
        return np.clip(np.nan_to_num(error, nan=10.0), -10, 10).ravel()

    return free, residual


def sysid(xml: str, takes: Sequence[Recording], without: Sequence[str]) -> list[Named]:
    """Every parameter free at once, by box-constrained least squares; the largest relative change is named."""
    free, residual = _objective(xml, takes, full=True)
    low, span = np.array([p.low for p in free]), np.array([p.high - p.low for p in free])
    start = np.clip((np.array([p.start for p in free]) - low) / span, 1e-3, 1 - 1e-3)
    x = least_squares(residual, start, bounds=(0.0, 1.0), diff_step=[1e-3] * len(free), max_nfev=15).x
    return _joint_of_delay(_largest(free, low + span * x, without), takes)


def pace(xml: str, takes: Sequence[Recording], without: Sequence[str]) -> list[Named]:
    """PACE's parameters by CMA-ES on the mean squared position error; the largest relative change is named."""
    from cmaes import CMA  # type: ignore[import-untyped]  # only this baseline needs it

    free, residual = _objective(xml, takes, full=False)
    low, span = np.array([p.low for p in free]), np.array([p.high - p.low for p in free])
    start = (np.array([p.start for p in free]) - low) / span
    bounds = np.stack([np.zeros(len(free)), np.ones(len(free))], axis=1)
    optimizer = CMA(mean=np.clip(start, 0.02, 0.98), sigma=SIGMA, bounds=bounds, seed=0)
    best, least = start, np.inf
    for _ in range(GENERATIONS):
        answers = []
        for _ in range(optimizer.population_size):
            x = optimizer.ask()
            cost = float((residual(x) ** 2).mean())
            answers.append((x, cost))
            if cost < least:
                best, least = x, cost
        optimizer.tell(answers)
        if optimizer.should_stop():
            break
    return _joint_of_delay(_largest(free, low + span * best, without), takes)


def _joint_of_delay(named: list[Named], takes: Sequence[Recording]) -> list[Named]:
    """The one delay of the list is of all joints: a clock's offset, unless there is but one joint."""
    if not named or named[0][0] != "actuation_delay":
        return named
    if takes[0].num_joints == 1:
        return [("actuation_delay", takes[0].joint_names[0], *named[0][2:])]
    return [("clock_offset", None, *named[0][2:])]


if __name__ == "__main__":
    main(tyro.cli(Config))
