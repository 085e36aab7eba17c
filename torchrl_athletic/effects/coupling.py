"""A drive that another joint turns as well: wrists whose motor sits before the last joint but one, belts, tendons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import mujoco
import numpy as np
from scipy.optimize import nnls

from torchrl_athletic.effects.effect import (
    Array,
    Effect,
    Fingerprint,
    Parameter,
    damping_bound,
    is_slide,
    torque_bound,
    torque_scale,
)
from torchrl_athletic.effects.inertia import LEAST_ROTOR
from torchrl_athletic.effects.plant import STIFFEST, Now, Plant, Start
from torchrl_athletic.effects.presliding import Bristle, sliding
from torchrl_athletic.effects.signals import (
    FEWEST,
    JointAddress,
    Signals,
    inertia_matrix,
    presliding_width,
    sliding_direction,
)

RATIOS = (1.0, -1.0)
"""Turns of the drive per turn of the joint before, in turns of its own joint, to start from."""
WIDEST_RATIO = 3.0
"""Bound of the ratio, either way [1]."""
LEFT = 0.3
"""Share of what the torques of two joints leave open, below which a drive of both must leave it [1; tuned]. The coupled
wrist of a TX40 leaves 0.06, its other joints 0.63 to 1 and those of nine other robots 0.7 to 1."""
_PRESLIDING = 1.5e-3
"""Presliding width on a joint that travels a radian or more [rad, m]."""


class CoupledDrive(Effect):
    """The drive of a joint turns when the joint before it turns, too.

    It rubs and resists acceleration as it does. The sixth motor of many an industrial wrist is laid out so, and so are
    belts and tendons that run over a joint. What is logged is taken as the joints' own positions and torques: a
    controller knows how its gears are laid out. Friction and rotor of the drive act on the sum of two joints all the
    same.

    Parameters, in total, in the corrected model: ``torque`` [N·m], dry friction of the drive, ``damping``
    [N·m·s/rad], ``armature`` [kg·m²], all as the joint feels them, and ``ratio`` [1], turns of the drive for a turn of
    the joint before, per those for a turn of its own.

    Fingerprint: -z, -ẋ and -ẍ of x = q + r p on the joint, and r times these on the joint before. There p is that
    one's position, z the direction in which x slides, and r is each of the ratios to try.

    Simulation: bristles along x beside the motors. Damping and rotor are each joint's own; what the other's motion
    takes comes a step late. MJCF says all of it, as a fixed tendon.
    """

    name = "coupled_drive"
    family = "coupling"
    odds = 1 / 3
    misfit = 0.02
    of_accelerations = True
    adds_to_link = True
    excludes = frozenset({"backlash", "compliance"})  # it would act on one of two joints there
    shows_in = "speed"
    equation = "τ = -(F sign(ẋ) + d ẋ + I ẍ) ∂x/∂q,  x = q + r p"
    source = (
        "Gautier, Janot, Vandanjon 2013, A new closed-loop output error method for parameter identification of robot "
        "dynamics, IEEE Transactions on Control Systems Technology 21 (2), of a TX40's wrist"
    )
    experiments: ClassVar[Mapping[str, str]] = {
        rival: "hold {joint} still and turn the joint before it at several constant speeds, then the other way round: "
        "a coupled drive rubs in both"
        for rival in ("coulomb_friction", "viscous_friction", "reflected_inertia", "load_dependent_friction")
    }

    def __init__(self, ratios: Sequence[float] = RATIOS) -> None:
        self.ratios = tuple(ratios)

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        before = joint_before(model, address, joint)
        if before is None or is_slide(model, address, joint) or is_slide(model, address, before):
            return ()
        bound, scale = torque_bound(model, address, joint), torque_scale(model, address, joint)
        at_rest = float(inertia_matrix(model, address, np.zeros((1, len(address.dof))))[0, joint, joint])
        return (
            Parameter("torque", "N·m", 0.0, 0.0, bound, 0.02 * scale),
            Parameter("damping", "N·m·s/rad", 0.0, 0.0, damping_bound(model, address, joint), 0.02 * scale),
            Parameter("armature", "kg·m²", 0.0, 0.0, 20 * at_rest, 0.05 * at_rest),
            Parameter("ratio", "1", 0.0, -WIDEST_RATIO, WIDEST_RATIO, 0.1),
        )

    def turns(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[int, ...]:
        before = joint_before(model, address, joint)
        return (joint,) if before is None else (before, joint)

    def is_physical(self, parameters: Sequence[Parameter], values: Array) -> bool:
        """A drive that nothing but its own joint turns is not coupled; one without friction or rotor is none."""
        torque, damping, armature, ratio = values
        rubs = torque > 0 or damping > 0 or armature > LEAST_ROTOR * parameters[2].scale
        return bool(rubs and abs(ratio) >= parameters[3].scale)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{"ratio": ratio} for ratio in self.ratios]

    def grid_of(self, takes: Sequence[Signals], joint: int) -> list[Mapping[str, float]]:
        """The ratio that leaves least of the torques of both joints, if that is little enough: chance leaves most.

        Torques that a controller makes say nothing of it before its gains are known.
        """
        if any(s.recording.position_target is not None for s in takes):
            return []
        left = {ratio: _left_open(self, takes, joint, ratio) for ratio in self.ratios}
        best = min(left, key=lambda ratio: left[ratio])
        return [{"ratio": best}] if left[best] < LEFT else []

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        before, ratio = joint_before(s.nominal, s.address, joint), fixed["ratio"]
        assert before is not None
        x = s.fine_position[:, joint] + ratio * s.fine_position[:, before]
        v, a = (of[:, joint] + ratio * of[:, before] for of in (s.velocity, s.acceleration))
        dry = s.project(sliding(x, np.array([presliding_width(s, joint)])))[:, 0]
        own = -np.stack([dry, v, a], -1)
        columns = np.zeros((len(own), s.num_joints, 3))
        columns[:, joint], columns[:, before] = own, ratio * own
        return Fingerprint(columns, fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        before = joint_before(plant.model, plant.address, joint)
        if before is None:  # then it has no parameters, and nobody asks
            raise ValueError(f"joint {joint} has none before it, so that no other turns its drive.")
        plant.laws.append(_Drive(joint, before, values, plant))
        _, damping, armature, ratio = values.T
        for j, share in ((joint, np.ones_like(ratio)), (before, ratio**2)):
            plant.of("dof_armature")[:, plant.address.dof[j]] += share * armature
            plant.of("dof_damping").reshape(plant.rows, plant.model.nv, -1)[:, plant.address.dof[j], 0] += (
                share * damping
            )

    def write(self, spec: mujoco.MjSpec, joint: str, values: Array) -> bool:
        """As a fixed tendon along x, whose friction, damping and armature are the drive's."""
        before, name = _spec_joint_before(spec, joint), f"{joint}_drive"
        if before is None or spec.tendon(name) is not None:
            return False
        torque, damping, armature, ratio = map(float, values)
        tendon = spec.add_tendon(name=name, frictionloss=torque, armature=armature)
        tendon.damping[0] = damping
        tendon.solref_friction, tendon.solimp_friction = (2 * spec.option.timestep, 1.0), STIFFEST
        tendon.wrap_joint(joint, 1.0)
        tendon.wrap_joint(before, ratio)
        return True

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        return (
            f"The drive of {joint} turns with the joint before, too, {values['ratio']:.3g} times as far. There it has "
            f"{values['torque']:.3g} N·m of dry friction, {values['damping']:.3g} N·m·s/rad of damping and a rotor of "
            f"{values['armature']:.3g} kg·m²; the model has none that both turn."
        )


def joint_before(model: mujoco.MjModel, address: JointAddress, joint: int) -> int | None:
    """The recorded joint next before one on its way to the base, or None."""
    body, dofs = int(address.body[joint]), np.asarray(address.dof)
    own = [j for j in range(len(dofs)) if address.body[j] == body and dofs[j] < dofs[joint]]
    while not own and body:
        body = int(model.body_parentid[body])
        own = [j for j in range(len(dofs)) if body and address.body[j] == body]
    return max(own, key=lambda j: int(dofs[j])) if own else None


def _spec_joint_before(spec: mujoco.MjSpec, joint: str) -> str | None:
    body, here = spec.joint(joint).parent, spec.joint(joint)
    names = [j.name for j in body.joints]
    if before := names[: names.index(here.name)]:
        return str(before[-1])
    while (body := body.parent) is not None and body.name != "world":
        if body.joints:
            return str(body.joints[-1].name)
    return None


def _inertia(plant: Plant, joint: int) -> Array:
    """Of a joint at rest, with the rotors that its rows have [kg·m²]. Shape (rows,)."""
    dof, model = plant.address.dof[joint], plant.model
    given = 1.0 / max(float(model.dof_invweight0[dof]), 1e-12)
    return np.asarray(given + plant.of("dof_armature")[:, dof] - model.dof_armature[dof], dtype=np.float64)


def _left_open(effect: CoupledDrive, takes: Sequence[Signals], joint: int, ratio: float) -> float:
    """Share of what both joints leave open of their torques, that the friction of a shared drive leaves.

    Friction, rotors, scales and offsets of each are taken out first, and what the other's acceleration asks for: an
    inertia that the model has wrong looks like a shared rotor, whose say is not heard for that.
    """
    joints = effect.turns(takes[0].nominal, takes[0].address, joint)
    of_drive = [effect.fingerprint(s, joint, {"ratio": ratio}).columns[..., :2] for s in takes]
    opens, besides = [], []
    for j in joints:
        good = np.concatenate([s.valid[:, j] for s in takes])
        if good.sum() < FEWEST:
            return 1.0
        own = np.concatenate([_own_torques(s, j, joints) for s in takes])[good]
        parts = zip(takes, of_drive, strict=True)
        both = np.concatenate([np.column_stack([s.missing[:, j], columns[:, j]]) for s, columns in parts])[good]
        both = both - own @ np.linalg.lstsq(own, both, rcond=1e-8)[0]
        both /= max(float(np.linalg.norm(both[:, 0])), 1e-300)
        opens.append(both[:, 0])
        besides.append(both[:, 1:])
    y, a = np.concatenate(opens), np.concatenate(besides)
    return float(nnls(a, y)[1] ** 2 / max(y @ y, 1e-300))


def _own_torques(s: Signals, j: int, joints: Sequence[int]) -> Array:
    """What a joint's torque may ask for without a shared drive. Shape (N, K)."""
    alone = [sliding_direction(s, j), s.velocity[:, j], s.required[:, j], np.ones(len(s.keep))]
    return np.column_stack([*alone, s.acceleration[:, list(joints)]])


class _Drive(Bristle):
    """Friction along x = q + r p, and what one joint's motion takes from the other by damping and rotor.

    Either joint has its own share of both in MuJoCo's implicit step; what the other's takes comes from the step before.
    That is stable whatever they are, as long as friction is on the inertia that the joints have without the rotor.
    """

    def __init__(self, joint: int, before: int, values: Array, plant: Plant) -> None:
        torque, self.damping, self.armature, self.ratio = values.T
        self.before, self.rate = before, np.zeros((0, 0))
        super().__init__(joint, np.full(plant.rows, _PRESLIDING), torque, plant)
        self.inertia = 1.0 / (1.0 / _inertia(plant, joint) + self.ratio**2 / _inertia(plant, before))

    def begin(self, start: Start) -> None:
        travel = start.each(lambda piece: float(np.ptp(start.position[piece, self.joint])))
        self.width = self._stable(np.maximum(_PRESLIDING * np.minimum(travel, 1.0), 1e-9), self.level)

        def history(piece: slice, width: float, ratio: float) -> Array:
            x = start.position[piece, self.joint] + ratio * start.position[piece, self.before]
            return sliding(x, np.array([width]))[:, 0]

        self.direction, self.last = start.of(history, self.width, self.ratio), None
        self.rate = np.zeros((0, 0))

    def __call__(self, now: Now) -> Array:
        own, before = self.joint, self.before
        position, velocity = now.position.copy(), now.velocity.copy()
        for motion in (position, velocity):
            motion[:, own] += self.ratio * motion[:, before]
        along = super().__call__(replace(now, position=position, velocity=velocity))[:, own]
        torque = np.zeros_like(now.velocity)
        torque[:, own], torque[:, before] = along, self.ratio * along
        speeding = (now.velocity - self.rate) / now.step if len(self.rate) else np.zeros_like(now.velocity)
        for one, other in ((own, before), (before, own)):
            torque[:, one] -= self.ratio * (self.damping * now.velocity[:, other] + self.armature * speeding[:, other])
        self.rate = now.velocity.copy()
        return torque
