"""Friction between the bodies of a joint: dry, viscous, and different by direction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_athletic.effects.effect import (
    Array,
    Effect,
    Fingerprint,
    Parameter,
    damping,
    local,
    per_speed_unit,
    torque_bound,
    torque_scale,
    torque_unit,
)
from torchrl_athletic.effects.plant import Now, Plant
from torchrl_athletic.effects.signals import (
    JointAddress,
    Signals,
    bristle,
    joint_feature,
    presliding_width,
    sliding_direction,
)


class CoulombFriction(Effect):
    """Dry friction: a constant torque against the direction of motion.

    Parameters: ``torque`` [N·m, N for slides], in total, in the corrected model.

    Fingerprint: -z, where z is the direction of sliding, -1 to 1, which turns over within a presliding width after a
    reversal: 1.5 mrad on a joint that moves a radian or more, less in proportion on one that moves less.

    Simulation: MuJoCo's ``frictionloss``, as stiff as the time step allows, so that it comes close to ideal friction.
    """

    name = "coulomb_friction"
    equation = "τ = -Fc sign(q̇)"
    source = "Coulomb 1785; Armstrong-Hélouvry et al. 1994, doi:10.1016/0005-1098(94)90209-7, section 2"
    excludes = frozenset({"asymmetric_friction"})
    experiments: ClassVar[Mapping[str, str]] = {
        "viscous_friction": "turn {joint} at three or more constant speeds from very slow to fast, both ways: dry "
        "friction keeps its level, viscous friction grows",
        "torque_offset": "move {joint} slowly both ways over the same path: friction turns over with the direction, an "
        "offset stays",
        "reflected_inertia": "move {joint} slowly at constant speed (no acceleration), then with a fast chirp",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        limit, unit = torque_scale(model, address, joint), torque_unit(model, address, joint)
        bound = torque_bound(model, address, joint)
        nominal = float(model.dof_frictionloss[address.dof[joint]])
        return (Parameter("torque", unit, nominal, 0.0, max(bound, 3 * nominal), 0.02 * limit),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return Fingerprint(local(-sliding_direction(s, joint), s, joint), fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.set_dry_friction(joint, values[:, 0])

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        (torque,) = parameters
        return (
            f"Dry (Coulomb) friction of {values['torque']:.3g} {torque.unit} opposes every motion of {joint}; "
            f"{_has(torque.nominal, torque.unit)}."
        )


class ViscousFriction(Effect):
    """Friction in proportion to speed.

    Parameters: ``damping`` [N·m·s/rad, N·s/m for slides], in total, in the corrected model. In a closed loop it cannot
    be told from the drive's own derivative gain.

    Fingerprint: -q̇.

    Simulation: the joint's linear damping.
    """

    name = "viscous_friction"
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
        bound = torque_bound(model, address, joint)
        unit = per_speed_unit(model, address, joint)
        return (Parameter("damping", unit, nominal, 0.0, max(bound, 5 * nominal), 0.01 * limit),)

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
    equation = "τ = -(Fc± + b± |q̇|) sign(q̇)"
    source = "Janot, Gautier, Brunot 2019, nonlinearbenchmark.org (EMPS), section 2.3"
    excludes = frozenset({"coulomb_friction", "viscous_friction", "torque_offset"})
    experiments: ClassVar[Mapping[str, str]] = {
        "torque_offset": "move {joint} both ways at three constant speeds: an offset shifts all levels alike, "
        "direction-dependent friction opens with speed",
        "coulomb_friction": "move {joint} both ways over the same path at the same speeds and compare the torques",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        (coulomb,) = CoulombFriction().parameters(model, address, joint)
        (viscous,) = ViscousFriction().parameters(model, address, joint)
        return tuple(
            Parameter(f"{kind}_{side}", p.unit, p.nominal, p.lower, p.upper, p.scale)
            for kind, p in (("coulomb", coulomb), ("viscous", viscous))
            for side in ("positive", "negative")
        )

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        width = presliding_width(s, joint)

        def side(sign: float) -> list[Array]:
            def level(q: Array, v: Array) -> Array:
                return sign * np.maximum(sign * bristle(q, width), 0)

            def slope(q: Array, v: Array) -> Array:
                return sign * np.maximum(sign * v, 0)

            return [joint_feature(s, joint, level), joint_feature(s, joint, slope)]

        (level_pos, slope_pos), (level_neg, slope_neg) = side(1.0), side(-1.0)
        return Fingerprint(local(-np.stack([level_pos, level_neg, slope_pos, slope_neg], -1), s, joint), fixed)

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


def _has(nominal: float, unit: str) -> str:
    return f"the model has {nominal:.3g} {unit}" if nominal else "the model has none"
