"""Friction between the bodies of a joint: dry, viscous, falling with speed, growing with load, unlike by direction."""

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
    damping,
    damping_bound,
    dry_friction,
    is_slide,
    local,
    per_speed_unit,
    torque_bound,
    torque_scale,
    torque_unit,
)
from torchrl_athletic.effects.plant import Now, Plant, Start
from torchrl_athletic.effects.presliding import Bristle, directions, forms
from torchrl_athletic.effects.signals import JointAddress, Signals, presliding_width, sliding_direction

_TURNOVER = (0.5, 1.0)
"""Turnovers to try, per the one of the model's time constant."""
_EARLY = 0.004
"""Above it, friction is said to turn over before the motion does [s]."""
_BREAKAWAY = 3.0
"""Most that a joint takes to break away, per its dry friction at speed. Measured ones take 1.1 to 2.5 times as much."""
_STRIBECK = (0.02, 0.04, 0.07, 0.12, 0.2, 0.35)
"""Stribeck speeds to try, per the joint's greatest speed."""


class CoulombFriction(Effect):
    """Dry friction: a constant torque against the direction of motion.

    Parameters, in total, in the corrected model: ``torque`` [N·m, N for slides], and ``turnover`` [s], by which the
    friction turns over before the velocity does. It is 0 in a bearing, and 9.5 ms in a simulation with MuJoCo's
    ``frictionloss`` and default ``solref``, so that a model of a simulation is recognised too.

    Fingerprint: -z, where z is the direction of sliding, -1 to 1, which turns over within a presliding width after a
    reversal: 0.3, 1.5 or 4 mrad on a joint that moves a radian or more, less in proportion on one that moves less. Or
    it turns over with the velocity; in MuJoCo's form -clip(q̇(t + T) / v, -1, 1) with the turnover T and the speed v at
    which such a joint creeps.

    Simulation: MuJoCo's ``frictionloss``, without a turnover as stiff as the time step allows, so that it comes close
    to ideal friction.
    """

    name = "coulomb_friction"
    family = "friction"
    own_joint = True
    misfit = 0.02
    mjcf = "model"
    equation = "τ = -Fc sign(q̇)"
    source = "Coulomb 1785; Armstrong-Hélouvry et al. 1994, doi:10.1016/0005-1098(94)90209-7, section 2"
    excludes = frozenset({"asymmetric_friction", "stribeck_friction", "load_dependent_friction"})
    experiments: ClassVar[Mapping[str, str]] = {
        "viscous_friction": "turn {joint} at three or more constant speeds from very slow to fast, both ways: dry "
        "friction keeps its level, viscous friction grows",
        "torque_offset": "move {joint} slowly both ways over the same path: friction turns over with the direction, an "
        "offset stays",
        "reflected_inertia": "move {joint} slowly at constant speed (no acceleration), then with a fast chirp",
        "stribeck_friction": "turn {joint} at constant speeds from the slowest possible upwards, both ways",
        "load_dependent_friction": "turn {joint} slowly both ways without and with a known weight on it",
        "hysteresis": "reverse {joint} slowly after moves of very different lengths",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        nominal = float(model.dof_frictionloss[address.dof[joint]])
        given = _turnover(model, address, joint) if nominal else 0.0
        turnover = given if given > _EARLY else 0.0  # as stiff as a time step allows is a bearing's, no number more
        return (
            dry_friction("torque", model, address, joint),
            Parameter("turnover", "s", turnover, 0.0, max(0.05, 2 * turnover), 0.002),
        )

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        width, turnover = presliding_width(s, joint), _turnover(s.nominal, s.address, joint)
        ideal, creep = [{"turnover": 0.0, **form} for form in forms(s, joint)], _creep(s, joint, turnover)
        if creep <= 0:
            return [*ideal]
        return [*ideal, *({"turnover": x * turnover, "presliding": width, "creep": creep} for x in _TURNOVER)]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return self.fingerprints(s, joint, [fixed])[0]

    def fingerprints(self, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
        columns = -s.project(directions(s, joint, grid))
        return [Fingerprint(local(columns[:, k], s, joint), fixed) for k, fixed in enumerate(grid)]

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.set_dry_friction(joint, values[:, 0])
        dof, given, step = plant.address.dof[joint], plant.model.dof_solimp, float(plant.model.opt.timestep)
        ideal = np.exp(-((values[:, 1] / step) ** 2))  # a smooth way from one form to the other, for the optimiser
        plant.of("dof_solref")[:, dof, 0] = 2 * values[:, 1] / given[dof, 1] + 2 * step * ideal
        solimp = plant.of("dof_solimp")
        solimp[:, dof] = ideal[:, None] * solimp[:, dof] + (1 - ideal[:, None]) * given[dof]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        torque, turnover = parameters
        early = f"{1e3 * values['turnover']:.3g} ms"
        form = f"at once when the motion does, as in a bearing (turnover {early})"
        if values["turnover"] > _EARLY:
            form = f"{early} before the motion does, as MuJoCo's frictionloss with a soft solref"
        had = f"; the model has {torque.nominal:.3g} {torque.unit}" if torque.nominal else "; the model has none"
        if turnover.nominal:
            had += f", and {1e3 * turnover.nominal:.3g} ms"
        return (
            f"Dry (Coulomb) friction of {values['torque']:.3g} {torque.unit} opposes every motion of {joint}, and "
            f"turns over {form}{had}."
        )


class ViscousFriction(Effect):
    """Friction in proportion to speed.

    Parameters: ``damping`` [N·m·s/rad, N·s/m for slides], in total, in the corrected model. In a closed loop it cannot
    be told from the drive's own derivative gain.

    Fingerprint: -q̇.

    Simulation: the joint's linear damping.
    """

    name = "viscous_friction"
    family = "friction"
    own_joint = True
    misfit = 0.02
    mjcf = "model"
    equation = "τ = -b q̇"
    source = "Reynolds 1886; Armstrong-Hélouvry et al. 1994, doi:10.1016/0005-1098(94)90209-7, section 2"
    excludes = frozenset({"asymmetric_friction"})
    experiments: ClassVar[Mapping[str, str]] = {
        "coulomb_friction": "turn {joint} at three or more constant speeds from very slow to fast, both ways",
        "gain_mismatch": "let {joint} swing freely with the drive off, or change its kd by a known factor and repeat "
        "the take",
        "torque_scale": "let {joint} swing freely with no torque: friction remains, a torque scale does not",
        "actuation_delay": "command {joint} with steps and a chirp above 10 Hz: a delay shifts the phase in proportion "
        "to frequency",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        limit, nominal = torque_scale(model, address, joint), damping(model, address, joint)
        unit = per_speed_unit(model, address, joint)
        return (Parameter("damping", unit, nominal, 0.0, damping_bound(model, address, joint), 0.01 * limit),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return Fingerprint(local(-s.velocity[:, joint], s, joint), fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.of("dof_damping")[:, plant.address.dof[joint]] = values[:, 0]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        (b,) = parameters
        return (
            f"Viscous friction at {joint} brakes with {values['damping']:.3g} {b.unit}, growing with speed; "
            f"{_has(b.nominal, b.unit)}."
        )


class AsymmetricFriction(Effect):
    """Coulomb and viscous friction whose levels depend on the direction of motion.

    Parameters, in total, in the corrected model: ``coulomb_positive``, ``coulomb_negative`` [N·m, N] and
    ``viscous_positive``, ``viscous_negative`` [N·m·s/rad, N·s/m] for motion towards larger and smaller positions.

    Fingerprint: -max(z, 0), -min(z, 0), -max(q̇, 0) and -min(q̇, 0), with the direction of sliding z of Coulomb friction.

    Simulation: the mean of both directions as friction loss and damping, the difference as a torque beside the motor.

    Its Coulomb part alone is identical to a symmetric one plus a constant torque, so only the viscous part can be told
    from ``coulomb_friction`` with ``torque_offset``.
    """

    name = "asymmetric_friction"
    family = "friction"
    own_joint = True
    misfit = 0.02
    equation = "τ = -(Fc± + b± |q̇|) sign(q̇)"
    source = "Janot, Gautier, Brunot 2019, nonlinearbenchmark.org (EMPS), section 2.3"
    special_cases = frozenset({"coulomb_friction", "viscous_friction"})
    sets_apart = (("coulomb_positive", "coulomb_negative"), ("viscous_positive", "viscous_negative"))
    excludes = frozenset(
        {"coulomb_friction", "viscous_friction", "torque_offset", "stribeck_friction", "load_dependent_friction"}
    )
    identical_to = (frozenset({"coulomb_friction", "torque_offset"}),)
    experiments: ClassVar[Mapping[str, str]] = {
        "torque_offset": "move {joint} both ways at three constant speeds: an offset shifts all levels alike, "
        "direction-dependent friction opens with speed",
        "coulomb_friction": "move {joint} both ways over the same path at the same speeds and compare the torques",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        coulomb = dry_friction("torque", model, address, joint)
        (viscous,) = ViscousFriction().parameters(model, address, joint)
        return tuple(
            Parameter(f"{kind}_{side}", p.unit, p.nominal, p.lower, p.upper, p.scale)
            for kind, p in (("coulomb", coulomb), ("viscous", viscous))
            for side in ("positive", "negative")
        )

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [*forms(s, joint)]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return self.fingerprints(s, joint, [fixed])[0]

    def fingerprints(self, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
        z, v = directions(s, joint, grid), s.fine_velocity[:, joint, None]
        slopes = s.project(np.concatenate([np.maximum(v, 0), np.minimum(v, 0)], -1))
        forwards, backwards = s.project(np.maximum(z, 0)), s.project(np.minimum(z, 0))
        return [
            Fingerprint(local(-np.column_stack([forwards[:, k], backwards[:, k], slopes]), s, joint), fixed)
            for k, fixed in enumerate(grid)
        ]

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        coulomb_pos, coulomb_neg, viscous_pos, viscous_neg = values.T
        plant.set_dry_friction(joint, (coulomb_pos + coulomb_neg) / 2)
        plant.of("dof_damping")[:, plant.address.dof[joint]] = (viscous_pos + viscous_neg) / 2
        constant, slope = (coulomb_pos - coulomb_neg) / 2, (viscous_pos - viscous_neg) / 2

        def even_part(now: Now) -> Array:
            """What friction does the same to both directions; beside the motor, whose limit it does not share."""
            torque = np.zeros_like(now.velocity)
            torque[:, joint] = -constant - slope * np.abs(now.velocity[:, joint])
            return torque

        plant.laws.append(even_part)

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        coulomb, viscous = parameters[0], parameters[2]
        return (
            f"Friction at {joint} depends on the direction of motion: "
            f"{values['coulomb_positive']:.3g} {coulomb.unit} + {values['viscous_positive']:.3g} {viscous.unit} "
            f"forwards, {values['coulomb_negative']:.3g} {coulomb.unit} + {values['viscous_negative']:.3g} "
            f"{viscous.unit} backwards; the model has {coulomb.nominal:.3g} {coulomb.unit} + {viscous.nominal:.3g} "
            f"{viscous.unit} both ways."
        )


class StribeckFriction(Effect):
    """Dry friction that is greater when a joint moves slowly: the lubricant's film has to build up first.

    Parameters, in total, in the corrected model: ``coulomb`` [N·m, N for slides] at speed, ``stribeck`` [N·m, N], by
    which it takes more to break away, and ``stribeck_speed`` [rad/s, m/s] at which 37 % of that are left.

    Fingerprint: -z and -z exp(-(q̇/v)²), with the direction of sliding z of Coulomb friction, at Stribeck speeds v from
    2 to 35 % of the joint's greatest speed.

    Simulation: MuJoCo's ``frictionloss`` of the breakaway torque, and a torque beside the motor that takes back what
    speed saves.
    """

    name = "stribeck_friction"
    family = "friction"
    own_joint = True
    misfit = 0.02
    equation = "τ = -(Fc + (Fs - Fc) exp(-(q̇/vs)²)) sign(q̇)"
    source = "Armstrong-Hélouvry et al. 1994, doi:10.1016/0005-1098(94)90209-7, section 2"
    excludes = frozenset({"coulomb_friction", "asymmetric_friction", "load_dependent_friction"})
    experiments: ClassVar[Mapping[str, str]] = {
        "coulomb_friction": "turn {joint} at constant speeds from the slowest possible upwards, both ways: Stribeck "
        "friction falls with speed first",
        "viscous_friction": "turn {joint} at five or more constant speeds from the slowest possible to fast, both ways",
        "load_dependent_friction": "turn {joint} at several constant speeds both ways, without and with a known weight",
        "hysteresis": "reverse {joint} after short and long moves, slowly and fast",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        bound, scale = torque_bound(model, address, joint), torque_scale(model, address, joint)
        speed = "m/s" if is_slide(model, address, joint) else "rad/s"
        return (
            dry_friction("coulomb", model, address, joint),
            Parameter("stribeck", torque_unit(model, address, joint), 0.0, 0.0, bound, 0.02 * scale),
            Parameter("stribeck_speed", speed, 1.0, 1e-9, 20.0, 0.02),  # any will do where nothing depends on it
        )

    def is_physical(self, parameters: Sequence[Parameter], values: Array) -> bool:
        """Friction that all but vanishes at speed is a spline of something else."""
        return bool(values[1] <= (_BREAKAWAY - 1) * values[0])

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        fastest = float(np.abs(s.velocity[:, joint]).max())
        if fastest <= 0:
            return []
        return [{"stribeck_speed": share * fastest, **form} for share in _STRIBECK for form in forms(s, joint)]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return self.fingerprints(s, joint, [fixed])[0]

    def fingerprints(self, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
        z, speeds = directions(s, joint, grid), np.array([fixed["stribeck_speed"] for fixed in grid])
        slow = np.exp(-((s.fine_velocity[:, joint, None] / speeds) ** 2))
        dry, excess = -s.project(z), -s.project(z * slow)
        return [
            Fingerprint(local(np.stack([dry[:, k], excess[:, k]], -1), s, joint), fixed) for k, fixed in enumerate(grid)
        ]

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        coulomb, excess, speed = values.T
        plant.set_dry_friction(joint, coulomb + excess)

        def saved(now: Now) -> Array:
            torque, v = np.zeros_like(now.velocity), now.velocity[:, joint]
            torque[:, joint] = -excess * np.expm1(-((v / speed) ** 2)) * np.sign(v)
            return torque

        plant.laws.append(saved)

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        coulomb, _, speed = parameters
        return (
            f"Dry friction at {joint} falls from {values['coulomb'] + values['stribeck']:.3g} {coulomb.unit} at "
            f"breakaway, by {values['stribeck']:.3g} {coulomb.unit}, to {values['coulomb']:.3g} {coulomb.unit} well "
            f"above {values['stribeck_speed']:.3g} {speed.unit} (Stribeck); {_has(coulomb.nominal, coulomb.unit)}."
        )


class LoadDependentFriction(Effect):
    """Dry friction that grows with the torque that passes through the gear, whose teeth it presses together.

    What passes is what the motor gives less the friction itself: T = u - F. A motor that drives its load therefore
    loses less than one that brakes it, and from a ``coefficient`` of 1 on the load cannot turn the motor.

    Parameters, in total, in the corrected model: ``coulomb`` [N·m, N for slides] without load, and ``coefficient`` [1],
    the friction per transmitted torque.

    Fingerprint: -z and -z |ID|, with the direction of sliding z of Coulomb friction and the torque ID that the motion
    asks for.

    Simulation: MuJoCo's ``frictionloss`` of the part without load; for the rest, bristles beside the motor, of the
    strength that solves the law for the motor's torque.
    """

    name = "load_dependent_friction"
    family = "friction"
    own_joint = True
    misfit = 0.02
    sets_apart = ("coefficient",)
    shows_in = "load"
    equation = "τ = -(Fc + μ |u + τ|) sign(q̇)"
    source = "Hamon, Gautier, Garrec 2010, Dynamic identification of robots with a dry friction model, IROS"
    excludes = frozenset({"coulomb_friction", "asymmetric_friction", "stribeck_friction"})
    experiments: ClassVar[Mapping[str, str]] = {
        "coulomb_friction": "turn {joint} slowly both ways without and with a known weight on it: friction in "
        "proportion to the load grows by the weight's share",
        "torque_scale": "turn {joint} slowly upwards and downwards under a known weight: a scale has the same sign "
        "both ways, friction does not",
        "stribeck_friction": "turn {joint} at several constant speeds both ways, without and with a known weight",
        "viscous_friction": "turn {joint} at two constant speeds both ways, without and with a known weight",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        return dry_friction("coulomb", model, address, joint), Parameter("coefficient", "1", 0.0, 0.0, 0.9, 0.02)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [*forms(s, joint)]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return self.fingerprints(s, joint, [fixed])[0]

    def fingerprints(self, s: Signals, joint: int, grid: Sequence[Mapping[str, float]]) -> list[Fingerprint]:
        z = directions(s, joint, grid)
        load = np.interp(s.fine_time, s.time, np.abs(s.rigid[:, joint]))
        dry, loaded = -s.project(z), -s.project(z * load[:, None])
        return [
            Fingerprint(local(np.stack([dry[:, k], loaded[:, k]], -1), s, joint), fixed) for k, fixed in enumerate(grid)
        ]

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.set_dry_friction(joint, values[:, 0])
        plant.laws.append(_Loaded(joint, values[:, 0], values[:, 1], plant))

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        coulomb, _ = parameters
        return (
            f"Dry friction at {joint} grows with the load: {values['coulomb']:.3g} {coulomb.unit} and "
            f"{values['coefficient']:.3g} times the torque that passes through its gear; "
            f"{_has(coulomb.nominal, coulomb.unit)}."
        )


class _Loaded(Bristle):
    """Bristles that the torque through the gear presses down."""

    def __init__(self, joint: int, coulomb: Array, coefficient: Array, plant: Plant) -> None:
        self.coulomb, self.coefficient = coulomb, coefficient
        level = coefficient * torque_scale(plant.model, plant.address, joint)
        super().__init__(joint, np.full(plant.rows, 1.5e-3), level, plant)

    def begin(self, start: Start) -> None:
        travel = start.each(lambda piece: float(np.ptp(start.position[piece, self.joint])))
        loudest = start.each(lambda piece: float(np.abs(start.command[piece, self.joint]).max()))
        most = _pressed(loudest, -1.0, self.coulomb, self.coefficient)
        self.width = self._stable(np.maximum(1.5e-3 * np.minimum(travel, 1.0), 1e-9), most)
        super().begin(start)

    def level_of(self, now: Now) -> Array:
        torque = now.torque[:, self.joint]
        driving = np.where(torque == 0, -np.abs(self.direction), np.sign(torque) * self.direction)  # at rest it brakes
        return _pressed(np.abs(torque), driving, self.coulomb, self.coefficient)


def _pressed(torque: Array | float, driving: Array | float, coulomb: Array, coefficient: Array) -> Array:
    """Friction F beyond ``coulomb`` that solves F = coulomb + coefficient * |u - F z|.

    Args:
        torque: |u| [N·m, N].
        driving: Direction of sliding z in that of u: 1 if the motor drives its load, -1 if it brakes it.
        coulomb: [N·m, N].
        coefficient: [1].
    """
    passes = torque - driving * coulomb  # through the gear, if nothing but dry friction were there
    turned = np.where(passes > 0, driving, -driving)
    return np.asarray(coefficient * np.abs(passes) / np.maximum(1.0 + coefficient * turned, 0.1))


def _turnover(model: mujoco.MjModel, address: JointAddress, joint: int) -> float:
    """By which MuJoCo's friction loss turns over before the velocity does [s]; 0 where ``solref`` gives a stiffness.

    The reference acceleration of the constraint is -2 q̇ / (dmax timeconst).
    """
    dof = address.dof[joint]
    time_constant = max(float(model.dof_solref[dof, 0]), 2 * float(model.opt.timestep))
    return time_constant * float(model.dof_solimp[dof, 1]) / 2 if model.dof_solref[dof, 0] > 0 else 0.0


def _creep(s: Signals, joint: int, turnover: float) -> float:
    """Speed at which MuJoCo's friction loss reaches its full torque [rad/s, m/s], if it has what seems to be missing.

    The constraint's regularisation (1 - d) / d, over the joint's inertia, times the turnover and the torque.
    """
    good, z, dof = s.valid[:, joint], sliding_direction(s, joint), s.address.dof[joint]
    basis = np.stack([z, s.velocity[:, joint], s.acceleration[:, joint], s.required[:, joint], np.ones_like(z)], -1)
    if good.sum() < 2 * basis.shape[1]:
        return 0.0
    seems = -float(np.linalg.lstsq(basis[good], s.missing[good, joint], rcond=1e-9)[0][0])
    torque = max(seems + float(s.nominal.dof_frictionloss[dof]), 1e-3 * torque_scale(s.nominal, s.address, joint))
    impedance = float(s.nominal.dof_solimp[dof, 0])
    return torque * turnover * (1 - impedance) / impedance * float(s.nominal.dof_invweight0[dof])


def _has(nominal: float, unit: str) -> str:
    return f"the model has {nominal:.3g} {unit}" if nominal else "the model has none"
