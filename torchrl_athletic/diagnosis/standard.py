"""The standard joint: what every real joint has, with bounds that the motor and the recordings set.

Dry and viscous friction, rotor inertia, delay, torque limit and offsets; the scale of the torque, or the controller's
gains where positions were commanded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.prepare import Prepared
from torchrl_athletic.diagnosis.screen import Candidate, bounded_least_squares
from torchrl_athletic.effects import (
    ActuationDelay,
    CoulombFriction,
    CoupledDrive,
    Effect,
    EncoderOffset,
    GainMismatch,
    Parameter,
    ReflectedInertia,
    TorqueOffset,
    TorqueSaturation,
    TorqueScale,
    ViscousFriction,
)
from torchrl_athletic.effects.signals import FEWEST, inertia_matrix, torque_range
from torchrl_athletic.recordings import Recording

Array = NDArray[np.float64]
Name = tuple[str, str]
"""(effect, parameter)."""

MECHANICS: tuple[Effect, ...] = (
    CoulombFriction(),
    ViscousFriction(),
    ReflectedInertia(),
    ActuationDelay(),
    TorqueSaturation(),
    TorqueOffset(),
    EncoderOffset(),
)
ROOM = 10.0
"""Times what a recording's own torques, speeds and accelerations allow, up to which a joint's numbers may go [1]."""
SCALES = (0.05, 20.0)
"""Least and greatest scale of a torque: a drive's unit may be mistaken for another one's [1]."""
GAINS = (0.01, 100.0)
"""Least and greatest scale of a gain, which firmware may count in units of its own [1]."""
LATEST = 10.0
"""Samples by which a command may be late, if they last longer than the effect's own bound."""
DELAYS = (0.5, 1.0, 2.0, 4.0)
"""Samples of delay to start from."""
LIMITS = (0.4, 0.7, 0.9)
"""Torque limits to start from, per the largest torque that was asked for."""
NONLINEAR = ("actuation_delay", "actuation_lag", "torque_saturation", "speed_torque_limit", "encoder_offset")
"""Effects that no column of a regression stands for."""
NO_TORQUE = 1e-9
"""What counts as none [N·m, N]."""
OF_THE_MOTOR = frozenset({("torque_scale", "scale"), ("torque_saturation", "limit"), ("actuation_delay", "delay")})
"""Effects and their numbers of which a joint says nothing that swings without being driven."""
STILL = 1e-3
"""Travel below which a joint never moved [rad, m]."""
RIDGE = 1e-3
"""Pull of the regression towards the given model, per what the recordings say [1]."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What the recordings say of the size of a joint's numbers. Shapes (J,)."""

    asked: Array
    """Largest torque that was asked for, by the logged gains where positions were commanded, and that the given model's
    motor has [N·m, N]."""
    torque: Array
    """Largest torque that was asked for, or that the given model needs for the measured motion [N·m, N]."""
    speed: Array
    """Root mean square [rad/s, m/s]."""
    acceleration: Array
    """Root mean square [rad/s², m/s²]."""
    inertia: Array
    """Inertia in the given model at rest, what hangs on the joint included [kg·m², kg]."""
    travel: Array
    """From the least to the greatest position [rad, m]."""
    period: float
    """Longest sampling period [s]."""


def seen_in(prepared: Prepared) -> Seen:
    """Read the sizes off the recordings."""
    takes, signals = prepared.takes, prepared.signals
    first = takes[0]
    asked = np.max([np.abs(t.torque).max(0) for t in takes], axis=0)
    asked = np.minimum(asked, np.max(np.abs(torque_range(first.model, first.address)), axis=0))
    needed = np.max([np.quantile(np.abs(s.required), 0.99, axis=0) for s in signals], axis=0)
    rest = inertia_matrix(first.model, first.address, np.zeros((1, len(first.address.dof))))[0]

    def rms(parts: Sequence[Array]) -> Array:
        return np.maximum(np.sqrt(np.mean(np.concatenate(parts) ** 2, axis=0)), 1e-6)

    return Seen(
        asked=np.maximum(asked, NO_TORQUE),
        torque=np.maximum(np.maximum(asked, needed), NO_TORQUE),
        speed=rms([t.velocity for t in takes]),
        acceleration=rms([s.acceleration for s in signals]),
        inertia=np.diag(rest).copy(),
        travel=np.ptp(np.concatenate([t.measured for t in takes]), axis=0),
        period=max(t.period for t in takes),
    )


def standard_joints(prepared: Prepared, seen: Seen) -> Hypothesis:
    """All standard effects of all joints; a parameter that no recording can move has equal bounds."""
    take = prepared.takes[0]
    recordings = [part.recording for t in prepared.takes for part in t.parts]
    targets = any(r.position_target is not None for r in recordings)
    effects = (*MECHANICS, GainMismatch() if targets else TorqueScale())
    terms = []
    for j, name in enumerate(take.recording.joint_names):
        swings = seen.asked[j] <= NO_TORQUE and seen.travel[j] >= STILL
        fixed = _fixed(recordings, j) | (OF_THE_MOTOR if swings else set())
        for effect in effects:
            own = effect.parameters(take.model, take.address, j)
            bounded = tuple(_bounded(effect, p, j, seen, (effect.name, p.name) in fixed) for p in own)
            terms.append(Candidate(effect, j, name, bounded))
    return Hypothesis(tuple(terms))


def _fixed(recordings: Sequence[Recording], joint: int) -> set[Name]:
    """What stays the given model's: kd where one and the same damps every take, as viscous friction does."""
    fixed = {("coulomb_friction", "turnover")}
    if all(r.position_target is None or r.kp is None or not r.kp[joint] for r in recordings):
        fixed.add(("gain_mismatch", "kp_scale"))
    damping = {0.0 if r.kd is None else float(r.kd[joint]) for r in recordings}
    if len(damping) == 1 or not any(damping):
        fixed.add(("gain_mismatch", "kd_scale"))
    return fixed


def _bounded(effect: Effect, p: Parameter, j: int, seen: Seen, fixed: bool) -> Parameter:
    if fixed:
        return replace(p, lower=p.nominal, upper=p.nominal)
    torque = float(seen.torque[j])
    bounds: Mapping[Name, tuple[float, float]] = {
        ("coulomb_friction", "torque"): (0.0, ROOM * torque),
        ("viscous_friction", "damping"): (0.0, ROOM * torque / seen.speed[j]),
        ("reflected_inertia", "armature"): (0.0, max(p.upper, ROOM * torque / seen.acceleration[j])),
        ("actuation_delay", "delay"): (0.0, max(p.upper, LATEST * seen.period)),
        ("torque_saturation", "limit"): (0.02 * float(seen.asked[j]), p.upper),
        ("torque_offset", "torque"): (-torque, torque),
        ("torque_scale", "scale"): SCALES,
        ("gain_mismatch", "kp_scale"): GAINS,
        ("gain_mismatch", "kd_scale"): GAINS,
    }
    units: Mapping[Name, float] = {
        ("coulomb_friction", "torque"): 0.02 * torque,
        ("viscous_friction", "damping"): 0.02 * torque / seen.speed[j],
        ("torque_saturation", "limit"): 0.02 * float(seen.asked[j]),
        ("torque_offset", "torque"): 0.02 * torque,
    }
    low, high = bounds.get((effect.name, p.name), (p.lower, p.upper))
    unit = units.get((effect.name, p.name), p.scale)
    return replace(p, lower=min(float(low), p.nominal), upper=max(float(high), p.nominal), scale=float(unit))


def starts(h: Hypothesis, prepared: Prepared, seen: Seen, rng: np.random.Generator, draws: int) -> Array:
    """Where a search may begin: the given model, the torque domain's regression, its neighbours, and chance.

    Shape (K, P). The given model is the first.
    """
    names = [(c.effect.name, p.name) for c in h.terms for p in c.parameters]
    joint = np.array([c.joint for c in h.terms for _ in c.parameters])
    regressed = torque_domain(h, prepared)
    out = [h.nominal, regressed]
    late = np.array([n == ("actuation_delay", "delay") for n in names])
    limit = np.array([n == ("torque_saturation", "limit") for n in names])
    out += [np.where(late, x * seen.period, regressed) for x in DELAYS]
    out += [np.where(limit, x * seen.asked[joint], regressed) for x in LIMITS]
    out += [_drawn(h, names, joint, seen, rng) for _ in range(draws)]
    return np.clip(np.stack(out), *h.bounds)


def _drawn(
    h: Hypothesis, names: Sequence[Name], joint: NDArray[np.intp], seen: Seen, rng: np.random.Generator
) -> Array:
    """Numbers of a plausible joint, over decades; each is the given model's every other time."""
    torque, speed, inertia = seen.torque[joint], seen.speed[joint], seen.inertia[joint]
    decades = {
        "torque": (torque, -2.5, -0.3),
        "damping": (torque / speed, -2.5, -0.3),
        "armature": (inertia, -1.5, 1.5),
        "delay": (np.full(len(joint), seen.period), -0.5, 0.7),
        "limit": (seen.asked[joint], -0.5, 0.0),
        "scale": (np.ones(len(joint)), -0.5, 0.5),
        "kp_scale": (np.ones(len(joint)), -1.0, 1.0),
        "kd_scale": (np.ones(len(joint)), -1.0, 1.0),
    }
    x = h.nominal
    for i, (effect, name) in enumerate(names):
        if name in decades and effect != "torque_offset" and rng.random() < 0.5:
            size, low, high = decades[name]
            x[i] = size[i] * 10 ** rng.uniform(low, high)
    return x


@dataclass(frozen=True, eq=False)
class Agreement:
    """How much worse than need be values explain the torques, joint by joint.

    A simulation that coasts follows smooth motion over half a second nearly as well as one that is right, with a rotor
    of tons or a motor without torque. The torques tell: they would have had to be other ones.
    """

    parts: tuple[tuple[NDArray[np.intp], Array, int, Array, Array], ...]
    """For each joint: indices of its linear parameters, their given values, that of the torque's scale or -1, root of
    the normal equations per residual variance, and their solution."""

    def rows(self, values: Array) -> Array:
        """Whose squares sum up to the residual variance of the torques over the least one, less 1, of all joints.

        Shape (R, K) for values (K, P).
        """
        out = [np.zeros((0, len(values)))]
        for index, given, scale, root, best in self.parts:
            inverse = 1.0 / values[:, scale] if scale >= 0 else np.ones(len(values))
            found = (values[:, index] - given) * inverse[:, None]
            out.append(root @ (np.column_stack([1.0 - inverse, found]) - best).T)
        return np.concatenate(out)

    def at_given_scales(
        self, x: Array, low: Array, high: Array, way: float = 1.0
    ) -> dict[int, tuple[NDArray[np.intp], Array]]:
        """Numbers that ask for the same torques at the given torque scale, of each joint that has another one.

        Args:
            x: Values. Shape (P,).
            low: Bounds.
            high: Bounds.
            way: How far the scale goes to the given one, by equal factors, 0..1.

        Returns:
            Index of the scale -> indices, of the scale first and of the joint's linear parameters, and their values.
        """
        out = {}
        for index, given, scale, root, _ in self.parts:
            if scale < 0 or x[scale] == 1.0:
                continue
            to = float(x[scale]) ** (1.0 - way)
            torque = root @ np.append(1.0 - to / x[scale], to * (x[index] - given) / x[scale])
            a = root[:, 1:]
            found = bounded_least_squares(a.T @ a, a.T @ torque, low[index] - given, high[index] - given)
            out[scale] = np.append(scale, index), np.append(to, given + found)
        return out


def agreement(h: Hypothesis, prepared: Prepared) -> Agreement:
    """The torques' say on the parameters that enter them linearly: of the motor u = (ID + friction ...) / scale."""
    place = [(c, k) for c in h.terms for k in range(len(c.parameters))]
    index_of = {(id(c), k): n for n, (c, k) in enumerate(place)}
    prints: list[tuple[Candidate, list[Array]]] = []
    scales: dict[int, int] = {}
    for c in h.terms:
        if c.effect.name == "torque_scale":
            scales[c.joint] = index_of[id(c), 0]
        elif has_columns(c):
            prints.append((c, columns_of(c, prepared)))
    parts = []
    for j in range(len(prepared.takes[0].address.dof)):
        good = np.concatenate([s.valid[:, j] for s in prepared.signals])
        if good.sum() < FEWEST:
            continue
        columns = [np.concatenate([s.required[:, j] for s in prepared.signals])]
        index, given = [], []
        for c, parts_of in prints:
            both = np.concatenate([part[:, j] for part in parts_of])
            for k, p in zip(_linear(c, prepared), both.T, strict=False):
                if c.parameters[k].upper > c.parameters[k].lower and p.any():
                    columns.append(p)
                    index.append(index_of[id(c), k])
                    given.append(c.parameters[k].nominal)
        scale = scales.get(j, -1)
        a = np.stack(columns, -1)[good]
        y = np.concatenate([s.missing[:, j] for s in prepared.signals])[good]
        if scale < 0:
            a[:, 0] = 0.0
        normal = a.T @ a / len(y)
        normal += 1e-9 * np.diag(np.diag(normal)) + 1e-300 * np.eye(len(normal))
        best = np.linalg.lstsq(normal, a.T @ y / len(y), rcond=1e-10)[0]
        variance = max(float(np.mean((y - a @ best) ** 2)), 1e-12 * float(np.mean(y**2)), 1e-300)
        value, vector = np.linalg.eigh(normal / variance)
        root = np.sqrt(np.maximum(value, 0.0))[:, None] * vector.T
        parts.append((np.array(index, dtype=np.intp), np.array(given), scale, root, best))
    return Agreement(tuple(parts))


def _linear(c: Candidate, prepared: Prepared) -> list[int]:
    """Which of a term's parameters its columns stand for: those that its grid does not hold."""
    grids = (c.effect.grid(s, c.joint) for s in prepared.signals if c.effect.applies(s))
    held = next((grid[0] for grid in grids if grid), {})
    return [k for k, p in enumerate(c.parameters) if p.name not in held]


def has_columns(c: Candidate) -> bool:
    """Whether columns of a regression stand for a term: a drive of two joints has others for each ratio."""
    if isinstance(c.effect, CoupledDrive) and len(c.effect.ratios) > 1:
        return False
    return c.effect.name not in NONLINEAR


def columns_of(c: Candidate, prepared: Prepared) -> list[Array]:
    """A term's fingerprint in each piece. Shapes (N, J, K)."""
    out = []
    for s in prepared.signals:
        grid = c.effect.grid(s, c.joint) if c.effect.applies(s) else []
        if grid:
            out.append(c.effect.fingerprint(s, c.joint, grid[0]).columns)
        else:
            out.append(np.zeros((len(s.keep), s.num_joints, 0)))
    width = min((part.shape[2] for part in out if part.shape[2]), default=0)
    return [part[:, :, :width] if part.shape[2] else np.zeros((*part.shape[:2], width)) for part in out]


def torque_domain(h: Hypothesis, prepared: Prepared) -> Array:
    """What the missing torque says of the parameters that enter it linearly; the others are the given model's.

    Shape (P,).
    """
    x = h.nominal
    for joints in _together(h, prepared):
        terms = [c for c in h.terms if c.joint in joints and has_columns(c)]
        blocks = [columns_of(c, prepared) for c in terms]
        place = [
            (c, k, [part[:, :, n] for part in block])
            for c, block in zip(terms, blocks, strict=True)
            for n, k in zip(range(block[0].shape[2]), _linear(c, prepared), strict=False)
            if c.parameters[k].upper > c.parameters[k].lower
        ]
        rows, torques = [], []
        for j in joints:
            good = np.concatenate([s.valid[:, j] for s in prepared.signals])
            y = np.concatenate([s.missing[:, j] for s in prepared.signals])[good]
            unit = max(float(np.sqrt(np.mean(y**2))), 1e-300) if len(joints) > 1 and len(y) else 1.0
            columns = [np.concatenate([part[:, j] for part in block])[good] for _, _, block in place]
            rows.append(np.stack(columns, -1) / unit if columns else np.zeros((len(y), 0)))
            torques.append(y / unit)
        a, y = np.concatenate(rows), np.concatenate(torques)
        if not place or len(y) < 2 * len(place):
            continue
        low, high = (
            np.array([c.effect.change(c.parameters[k], getattr(c.parameters[k], side)) for c, k, _ in place])
            for side in ("lower", "upper")
        )
        normal = a.T @ a
        normal += RIDGE * np.diag(np.diag(normal))  # a scale and all that it scales are one without gravity
        found = bounded_least_squares(normal, a.T @ y, low, high)
        for (c, k, _), change in zip(place, found, strict=True):
            h.values_of(c, x)[k] = c.effect.value(c.parameters[k], float(change))
    return x


def _together(h: Hypothesis, prepared: Prepared) -> list[tuple[int, ...]]:
    """Joints by themselves, or with those that a term of theirs turns as well."""
    take = prepared.takes[0]
    groups = [{j} for j in range(len(take.address.dof))]
    for c in h.terms:
        own = set(c.effect.turns(take.model, take.address, c.joint))
        touched = [g for g in groups if g & own]
        groups = [*(g for g in groups if not g & own), set().union(*touched)]
    return sorted(tuple(sorted(g)) for g in groups)
