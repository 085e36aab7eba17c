"""Errors of the torque itself: its scale, its zero, its limits, and what comes back with every turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_athletic.effects.effect import (
    Array,
    Effect,
    Fingerprint,
    Parameter,
    is_slide,
    local,
    torque_bound,
    torque_scale,
    torque_unit,
)
from torchrl_athletic.effects.plant import Now, Plant
from torchrl_athletic.effects.signals import JointAddress, Signals, sliding_direction, torque_range

_SHARES = (
    *(0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.74, 0.78, 0.82, 0.85, 0.88, 0.9),
    *(0.92, 0.94, 0.955, 0.97, 0.98, 0.99),
)
"""Shares of the greatest command: limits to try.

Under a lower one nobody would have commanded so much, and a motor that gives next to nothing, on a link that weighs
next to nothing, explains any motion.
"""
_STALL = (0.5, 0.7, 1.0, 1.4, 2.0, 3.0)
"""Shares of the greatest command: limits at standstill to try."""
_NO_LOAD = (0.8, 1.0, 1.15, 1.35, 1.7, 2.4, 4.0)
"""Shares of the greatest speed: no-load speeds to try."""
_NO_LIMIT = 1e3
"""No-load speed beyond reach [rad/s, m/s]."""
_UNSTATED = 1e6
"""A limit that the model does not state, per :func:`torque_bound`: a rotor may outweigh the link many times."""
_PERIODS = (*range(2, 31), 36, 40, 48, 60)
"""A revolution, of a joint that travels a radian or more."""
_ROBUST_ROUNDS = 5
_BINS = 4096


class TorqueScale(Effect):
    """The joint receives a multiple of the commanded torque: a wrong torque constant, gear ratio or efficiency.

    Parameters: ``scale`` [1] of the command.

    Fingerprint: the torque that the motion asks for, since u = ID / k.

    Simulation: the command times the scale, within the motor's range.

    Where the drive follows position targets it is the same as both gains being off by one factor.
    """

    name = "torque_scale"
    family = "torque"
    own_joint = True
    tolerance = 1.0  # 5 %
    odds = 1 / 3
    between_torques = True
    mjcf = "actuator"
    shows_in = "load"
    equation = "τ = k u"
    excludes = frozenset({"link_mass", "link_com"})  # one joint shows ratios of the three only
    identical_to = (frozenset({"gain_mismatch"}),)
    source = "Gautier, Briot 2014, doi:10.1109/TRO.2013.2290862 (drive gains)"
    experiments: ClassVar[Mapping[str, str]] = {
        "link_mass": "hang a known weight on {joint} and hold it still in two poses",
        "reflected_inertia": "hold {joint} still against a known weight: a rotor has none",
        "viscous_friction": "let {joint} swing freely with no torque",
        "gain_mismatch": "change kp of {joint} by a known factor and repeat the take",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        return (Parameter("scale", "1", 1.0, 0.2, 3.0, 0.05),)

    def is_physical(self, parameters: Sequence[Parameter], values: Array) -> bool:
        """A motor as strong or as weak as none stands in for something else."""
        return bool(1.01 * parameters[0].lower < values[0] < 0.99 * parameters[0].upper)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        # u = ID / k: scaling the command instead would let "no torque and no mass" explain everything
        return Fingerprint(local(s.required[:, joint], s, joint), fixed)

    def change(self, parameter: Parameter, value: float) -> float:
        return 1.0 - 1.0 / value

    def value(self, parameter: Parameter, change: float) -> float:
        return 1.0 / (1.0 - change)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.torque_scale[:, joint] = values[:, 0]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        percent = 100 * (values["scale"] - 1)
        word = "more" if percent > 0 else "less"
        return f"{joint} receives {abs(percent):.3g} % {word} torque than commanded (scale {values['scale']:.3g})."


class TorqueOffset(Effect):
    """A constant torque beside the command: a current sensor's zero, a cable, a counterweight, a slope.

    Parameters: ``torque`` [N·m, N for slides], added to the command.

    Fingerprint: 1.

    Simulation: the command plus the offset, within the motor's range.
    """

    name = "torque_offset"
    family = "torque"
    own_joint = True
    between_torques = True
    mjcf = "actuator"
    shows_in = "position"
    equation = "τ = u + o"
    source = "Janot, Gautier, Brunot 2019, nonlinearbenchmark.org (EMPS), equation 2"
    excludes = frozenset({"asymmetric_friction"})
    experiments: ClassVar[Mapping[str, str]] = {
        "encoder_offset": "hold {joint} at several angles far apart: an encoder offset changes with the pose, a torque "
        "offset does not",
        "link_mass": "hold {joint} at angles on both sides of the vertical",
        "coulomb_friction": "move {joint} slowly both ways over the same path",
        "asymmetric_friction": "move {joint} both ways at three constant speeds",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        limit, unit = torque_scale(model, address, joint), torque_unit(model, address, joint)
        bound = torque_bound(model, address, joint)
        return (Parameter("torque", unit, 0.0, -bound, bound, 0.02 * limit),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return Fingerprint(local(np.ones(len(s.time)), s, joint), fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.torque_offset[:, joint] += values[:, 0]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        return (
            f"A constant {values['torque']:+.3g} {parameters[0].unit} acts on {joint} beside the command; "
            "the model has none."
        )


class TorqueSaturation(Effect):
    """The motor gives no more than a limit, either way, whatever is commanded: a current limit, a thermal derating.

    Parameters: ``limit`` [N·m, N for slides] of the torque, in total, in the corrected model.

    Fingerprint: clip(u, -L, L) - u of the raw command, at limits L from three tenths of the greatest command to just
    below it, closer together near the top, since a limit is mostly met in rare peaks.

    Simulation: the motor's torque, clipped.
    """

    name = "torque_saturation"
    family = "torque"
    own_joint = True
    before_sensor = True
    mjcf = "actuator"
    shows_in = "load"
    equation = "τ = clip(u, -L, L)"
    source = "Siciliano et al. 2009, Robotics, section 5.2 (drive limits)"
    excludes = frozenset({"speed_torque_limit"})
    experiments: ClassVar[Mapping[str, str]] = {
        "speed_torque_limit": "push {joint} against a stop, or against a heavy load at standstill, with rising torque, "
        "and repeat at speed: a current limit is the same at both",
        "torque_scale": "command {joint} in small and in large steps: a limit leaves the small ones alone",
        "actuation_lag": "hold the largest torque on {joint} for a second: a lag catches up, a limit does not",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        scale, unit = torque_scale(model, address, joint), torque_unit(model, address, joint)
        return (_limit_parameter("limit", unit, model, address, joint, 0.02 * scale),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        most = float(np.abs(fine_torque(s, joint)).max())
        return [{"limit": most * share} for share in _SHARES] if most > 0 else []

    def grid_of(self, takes: Sequence[Signals], joint: int) -> list[Mapping[str, float]]:
        """Limits in proportion to the greatest torque of all takes."""
        return self.grid(max(takes, key=lambda s: float(np.abs(fine_torque(s, joint)).max())), joint)

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return self.fingerprints(s, joint, [fixed])[0]

    def fingerprints(self, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
        u = fine_torque(s, joint)[:, None]
        limit = np.array([fixed["limit"] for fixed in grid])
        return _constants(np.clip(u, -limit, limit) - u, s, joint, grid)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        limit = values[:, 0]
        if not plant.motor:  # the first of the motor's laws needs no look at the state
            plant.torque_limit[:, joint] = np.minimum(plant.torque_limit[:, joint], limit)
            return

        def clipped(now: Now) -> Array:
            torque = now.torque.copy()
            torque[:, joint] = np.clip(torque[:, joint], -limit, limit)
            return torque

        plant.motor.append(clipped)

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        (limit,) = parameters
        return f"The torque of {joint} saturates at {values['limit']:.3g} {limit.unit}; {_allows(limit)}."


class SpeedTorqueLimit(Effect):
    """The faster the motor turns, the less it can push: the back-EMF uses the supply's voltage up.

    Parameters, in total, in the corrected model: ``stall_torque`` [N·m, N for slides], the limit at standstill, and
    ``no_load_speed`` [rad/s, m/s], at which nothing is left. A motor that brakes keeps the limit of standstill.

    Fingerprint: clip(u, -L (1 + q̇/v₀), L (1 - q̇/v₀)) - u of the raw command, with the factors within 0 and 1.

    Simulation: the motor's torque, clipped likewise.
    """

    name = "speed_torque_limit"
    family = "torque"
    own_joint = True
    before_sensor = True
    shows_in = "speed"
    equation = "|τ| ≤ L (1 - |q̇|/v₀) when driving, L when braking"
    source = (
        "Shin et al. 2023, doi:10.1109/LRA.2023.3290509; Hughes, Drury 2013, Electric Motors and Drives, section 3.4"
    )
    excludes = frozenset({"torque_saturation"})
    experiments: ClassVar[Mapping[str, str]] = {
        "torque_saturation": "command the largest torque on {joint} from standstill and keep it up to full speed",
        "viscous_friction": "turn {joint} fast with little torque: friction remains, a limit is not met",
        "torque_scale": "command {joint} in small and in large steps at low speed",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        scale, unit = torque_scale(model, address, joint), torque_unit(model, address, joint)
        speed = "m/s" if is_slide(model, address, joint) else "rad/s"
        return (
            _limit_parameter("stall_torque", unit, model, address, joint, 0.02 * scale),
            Parameter("no_load_speed", speed, _NO_LIMIT, 1e-6, _NO_LIMIT, 0.5),
        )

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        u, v = np.abs(fine_torque(s, joint)), np.abs(s.fine_velocity[:, joint])
        if u.max() <= 0 or v.max() <= 0:
            return []
        most = self.parameters(s.nominal, s.address, joint)[0].upper
        torques, speeds = np.minimum(float(u.max()) * np.array(_STALL), most), float(v.max()) * np.array(_NO_LOAD)
        points = [{"stall_torque": float(t), "no_load_speed": float(n)} for t in np.unique(torques) for n in speeds]
        return [p for p in points if (u > p["stall_torque"] * (1 - np.minimum(v / p["no_load_speed"], 1))).any()]

    def grid_of(self, takes: Sequence[Signals], joint: int) -> list[Mapping[str, float]]:
        """Limits in proportion to the greatest torque of all takes."""
        return self.grid(max(takes, key=lambda s: float(np.abs(fine_torque(s, joint)).max())), joint)

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return self.fingerprints(s, joint, [fixed])[0]

    def fingerprints(self, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
        u, v = fine_torque(s, joint)[:, None], s.fine_velocity[:, joint, None]
        stall, no_load = (np.array([fixed[name] for fixed in grid]) for name in ("stall_torque", "no_load_speed"))
        return _constants(np.clip(u, *_speed_torque(v, stall, no_load)) - u, s, joint, grid)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        stall, no_load = values.T

        def clipped(now: Now) -> Array:
            torque = now.torque.copy()
            torque[:, joint] = np.clip(torque[:, joint], *_speed_torque(now.velocity[:, joint], stall, no_load))
            return torque

        plant.motor.append(clipped)

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        stall, no_load = parameters
        return (
            f"The motor of {joint} gives at most {values['stall_torque']:.3g} {stall.unit} at standstill and nothing "
            f"beyond {values['no_load_speed']:.3g} {no_load.unit}, falling in between; {_allows(stall)} at any speed."
        )


FEWEST = 3.0
"""Waves a turn below which what repeats along the position is no ripple of poles or teeth."""


class TorqueRipple(Effect):
    """A torque that comes back with every tooth, pole or screw turn: cogging, gear teeth, a bent shaft.

    Parameters: ``sine`` and ``cosine`` [N·m, N for slides], amplitudes at the true position, and ``periods`` [1/rev,
    1/m for slides] a revolution or a metre.

    Fingerprint: sin(n q) and cos(n q), at two to sixty periods a radian's travel or more, and at those that stand out
    of the missing torque as a function of position.

    Simulation: added to the motor's torque.
    """

    name = "torque_ripple"
    family = "torque"
    own_joint = True
    mjcf = "passive"
    shows_in = "position"
    equation = "τ = u + A sin(n q) + B cos(n q)"
    source = "Holtz, Springob 1996, IEEE Transactions on Industrial Electronics 43(2); MuJoCo's dcmotor cogging"
    experiments: ClassVar[Mapping[str, str]] = {
        "encoder_offset": "turn {joint} slowly at constant speed over its whole travel, twice",
        "hysteresis": "turn {joint} slowly both ways over its whole travel: ripple is the same function of position",
        "joint_spring": "turn {joint} slowly at constant speed over its whole travel",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        scale, unit = torque_scale(model, address, joint), torque_unit(model, address, joint)
        bound = torque_bound(model, address, joint)
        per = "1/m" if is_slide(model, address, joint) else "1/rev"
        return (
            Parameter("sine", unit, 0.0, -bound, bound, 0.01 * scale),
            Parameter("cosine", unit, 0.0, -bound, bound, 0.01 * scale),
            Parameter("periods", per, 1.0, 1e-2, 1e5, 0.05),
        )

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return self.grid_of([s], joint)

    def grid_of(self, takes: Sequence[Signals], joint: int) -> list[Mapping[str, float]]:
        """Fixed periods, scaled to the travel, and the peaks of the missing torque's spectrum along the position."""
        seen = np.concatenate([s.fine_position[:, joint] for s in takes])
        travel = float(np.ptp(seen))
        if travel <= 0:
            return []
        waves = {n / min(travel, 1.0) for n in _PERIODS if n * max(travel, 1.0) > np.pi}
        waves |= set(_spectral_peaks(takes, joint, travel))
        if is_slide(takes[0].model, takes[0].address, joint):
            return [{"periods": n / (2 * np.pi)} for n in sorted(waves)]
        return [{"periods": n} for n in sorted(waves) if n >= FEWEST]

    def is_physical(self, parameters: Sequence[Parameter], values: Array) -> bool:
        """With fewer waves a turn it is a weight's lever, or the inertia's change with the pose."""
        return bool(parameters[2].unit != "1/rev" or values[2] >= FEWEST)

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return self.fingerprints(s, joint, [fixed])[0]

    def fingerprints(self, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
        waves = wave_number(np.array([fixed["periods"] for fixed in grid]), s.model, s.address, joint)
        phase = s.fine_position[:, joint, None] * waves
        sine, cosine = s.project(np.sin(phase)), s.project(np.cos(phase))
        return [
            Fingerprint(local(np.stack([sine[:, k], cosine[:, k]], -1), s, joint), fixed)
            for k, fixed in enumerate(grid)
        ]

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        sine, cosine, periods = values.T
        wave = wave_number(periods, plant.model, plant.address, joint)

        def rippled(now: Now) -> Array:
            torque, phase = now.torque.copy(), wave * now.position[:, joint]
            torque[:, joint] += sine * np.sin(phase) + cosine * np.cos(phase)
            return torque

        plant.motor.append(rippled)

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        sine, _, periods = parameters
        of = "metre" if periods.unit == "1/m" else "revolution"
        size = np.hypot(values["sine"], values["cosine"])
        return (
            f"A torque of {size:.3g} {sine.unit} ripples along the position of {joint}, {values['periods']:.4g} "
            f"{periods.unit} ({values['sine']:+.3g} {sine.unit} sine, {values['cosine']:+.3g} {sine.unit} cosine a "
            f"{of}); the model has none."
        )


def fine_torque(s: Signals, joint: int) -> Array:
    """Torque that is asked of a motor before any smoothing, within the model's range [N·m, N]. Shape (M,)."""
    torque = s.raw_command()[:, joint]
    r = s.recording
    if r.position_target is not None:
        assert r.kp is not None
        assert r.kd is not None
        torque = r.kp[joint] * (torque - s.fine_position[:, joint]) - r.kd[joint] * s.fine_velocity[:, joint]
    low, high = torque_range(s.nominal, s.address)
    return np.asarray(np.clip(torque, low[joint], high[joint]), dtype=np.float64)


def leftover(pieces: Sequence[Signals], joint: int) -> Array:
    """Missing torque beyond dry and viscous friction, inertia, scale, offset and gravity; zero where invalid.

    What is confined in time or in position stands out of it before anything else is known, as those are fitted with
    Cauchy weights (Holland, Welsch 1977): a push that is a hundred times what else is missing must not bend them. The
    pieces of a take are fitted together, since a push may fill one of them.
    Shape (N of all pieces,).
    """
    basis = np.concatenate([_usual_causes(s, joint) for s in pieces])
    good = np.concatenate([s.valid[:, joint] for s in pieces])
    if good.sum() < 2 * basis.shape[1]:
        return np.zeros(len(basis))
    basis = basis / np.maximum(np.linalg.norm(basis, axis=0), 1e-300)
    missing = left = np.concatenate([s.missing[:, joint] for s in pieces])
    for _ in range(_ROBUST_ROUNDS):
        usual = 1.4826 * float(np.median(np.abs(left[good])))
        weight = 1.0 / np.hypot(1.0, left / max(2.385 * usual, 1e-300))
        explained = np.linalg.lstsq(basis[good] * weight[good, None], (missing * weight)[good], rcond=1e-9)[0]
        left = missing - basis @ explained
    return np.where(good, left, 0.0)


def _usual_causes(s: Signals, joint: int) -> Array:
    """Torques of dry and viscous friction, inertia, scale, offset and gravity, for numbers of 1. Shape (N, 8)."""
    q, v, a = s.position[:, joint], s.velocity[:, joint], s.acceleration[:, joint]
    return np.stack(
        [np.ones_like(q), sliding_direction(s, joint), v, a, q, np.sin(q), np.cos(q), s.required[:, joint]], -1
    )


def _spectral_peaks(takes: Sequence[Signals], joint: int, travel: float, count: int = 6) -> list[float]:
    """Wave numbers at which the leftover, summed over places, is strongest [rad/rad, rad/m]."""
    start = min(float(s.position[:, joint].min()) for s in takes)
    total = np.zeros(_BINS)
    for s in takes:
        place = ((s.position[:, joint] - start) / travel * (_BINS - 1)).astype(np.intp).clip(0, _BINS - 1)
        total += np.bincount(place, leftover([s], joint), _BINS)
    power = np.abs(np.fft.rfft(total, 4 * _BINS))
    wave = 2 * np.pi / travel * np.arange(len(power)) / 4
    peak = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    peak = peak[(wave[peak] * travel > 3 * np.pi) & (wave[peak] * travel < _BINS / 4)]
    return [float(wave[k]) for k in sorted(peak, key=lambda k: -power[k])[:count]]


def wave_number(periods: Array, model: mujoco.MjModel, address: JointAddress, joint: int) -> Array:
    """Wave number of so many periods a revolution, or a metre [rad/rad, rad/m]."""
    return 2 * np.pi * periods if is_slide(model, address, joint) else periods


def _speed_torque(velocity: Array, stall: Array, no_load: Array) -> tuple[Array, Array]:
    """Least and greatest torque, as :func:`torchrl_athletic.functional.actuation.torque_speed_limits` has them."""
    used = velocity / no_load
    return -stall * (1 + np.clip(used, -1, 0)), stall * (1 - np.clip(used, 0, 1))


def _limit_parameter(
    name: str, unit: str, model: mujoco.MjModel, address: JointAddress, joint: int, scale: float
) -> Parameter:
    """A limit below the model's; a model that states none has one beyond reach, and room above it says so."""
    bound = torque_bound(model, address, joint)
    stated = bool(np.isfinite(torque_range(model, address)[1][joint]))
    nominal = bound if stated else _UNSTATED * bound
    return Parameter(name, unit, nominal, 1e-6 * bound, nominal if stated else 2 * nominal, scale)


def _allows(limit: Parameter) -> str:
    stated = limit.upper == limit.nominal
    return f"the model allows {limit.nominal:.3g} {limit.unit}" if stated else "the model has no limit"


def _constants(torque: Array, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
    """Predictions without a coefficient, from torques on the fine instants. ``torque`` has shape (M, len(grid))."""
    projected, none = s.project_command(torque), np.zeros((len(s.keep), s.num_joints, 0))
    return [Fingerprint(none, fixed, local(projected[:, k], s, joint)[:, :, 0]) for k, fixed in enumerate(grid)]
