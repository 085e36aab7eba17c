"""Inertia that the model lacks: the rotor seen through the gear, and the mass of a link."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_athletic.effects.effect import Array, Effect, Fingerprint, Parameter, is_slide, local
from torchrl_athletic.effects.plant import Plant
from torchrl_athletic.effects.signals import JointAddress, Signals, inertia_matrix

_WORTH = 0.05
"""Share of the joint's inertia: a change worth mentioning."""
_STEP = 1.05
"""Ratio between distances of a centre of mass at which a fingerprint is taken."""


LEAST_ROTOR = 1e-4
"""Share of the joint's inertia: with less there is no rotor any more, which something else only looks like."""


class ReflectedInertia(Effect):
    """The motor's rotor, seen at the joint: rotor inertia times the gear ratio squared.

    Parameters: ``armature`` [kg·m², kg for slides], in total, in the corrected model.

    Fingerprint: -q̈.

    Simulation: the joint's armature.
    """

    name = "reflected_inertia"
    family = "inertia"
    mjcf = "model"
    shows_in = "acceleration"
    equation = "τ = -Ir n² q̈"
    source = "Siciliano et al. 2009, Robotics, section 7.1.2; MuJoCo's joint armature"
    experiments: ClassVar[Mapping[str, str]] = {
        "link_mass": "hold {joint} still against gravity in several poses, then shake it fast: a mass shows in both, a "
        "rotor only when accelerating",
        "torque_scale": "hang a known weight on {joint} and hold it still: a rotor has no weight",
        "actuation_lag": "chirp {joint} from 0.5 Hz to 20 Hz: a lag rolls the torque off, a rotor grows with frequency "
        "squared",
        "actuation_delay": "chirp {joint} from 0.5 Hz to 20 Hz: a delay shifts the phase in proportion to frequency",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        nominal = float(model.dof_armature[address.dof[joint]])
        zero = np.zeros((1, len(address.dof)))
        at_rest = float(inertia_matrix(model, address, zero)[0, joint, joint])
        unit = "kg" if is_slide(model, address, joint) else "kg·m²"
        return (Parameter("armature", unit, nominal, 0.0, 20 * at_rest, _WORTH * at_rest),)

    def is_physical(self, parameters: Sequence[Parameter], values: Array) -> bool:
        """No motor is without a rotor."""
        return bool(values[0] > LEAST_ROTOR * parameters[0].scale / _WORTH)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        return Fingerprint(local(-s.acceleration[:, joint], s, joint), fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.of("dof_armature")[:, plant.address.dof[joint]] = values[:, 0]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        (armature,) = parameters
        has = f"{armature.nominal:.3g} {armature.unit}" if armature.nominal else "none"
        return (
            f"The rotor behind {joint} adds {values['armature']:.3g} {armature.unit} of reflected inertia; "
            f"the model has {has}."
        )


class LinkMass(Effect):
    """The link that the joint moves is heavier or lighter than in the model, with its inertia in proportion.

    Parameters: ``mass`` [kg], in total, in the corrected model.

    Fingerprint: -∂ID/∂m on every joint, from the inverse dynamics with 1 % more mass and inertia.

    Simulation: the body's mass, and its inertia in proportion.
    """

    name = "link_mass"
    family = "inertia"
    tolerance = 1.0  # 5 %
    odds = 1 / 3
    mjcf = "model"
    shows_in = "load"
    equation = "m → m + Δm, I → I (1 + Δm/m)"
    source = "Atkeson, An, Hollerbach 1986, doi:10.1177/027836498600500306"
    experiments: ClassVar[Mapping[str, str]] = {
        "reflected_inertia": "hold {joint} still against gravity in several poses, then shake it fast",
        "torque_scale": "hang a known weight on {joint}: a wrong torque scale makes it weigh wrong too",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        mass = float(model.body_mass[address.body[joint]])
        if not mass or not carries_link(address, joint):
            return ()
        return (Parameter("mass", "kg", mass, 0.2 * mass, 5 * mass, 0.05 * mass),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}] if s.model.body_mass[s.address.body[joint]] > 0 else []

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        body, model = s.address.body[joint], s.model.__copy__()
        step = 0.01 * model.body_mass[body]
        model.body_mass[body] *= 1.01
        model.body_inertia[body] *= 1.01
        recompute_constants(model)
        return Fingerprint(-((s.inverse(model) - s.rigid) / step)[:, :, None], fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        body = plant.address.body[joint]
        scale = values[:, 0] / plant.model.body_mass[body]
        plant.of("body_mass")[:, body] = values[:, 0]
        plant.of("body_inertia")[:, body] *= scale[:, None]

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        (mass,) = parameters
        return f"The link moved by {joint} weighs {values['mass']:.3g} kg; the model says {mass.nominal:.3g} kg."


class LinkCom(Effect):
    """The link's centre of mass lies nearer to its joint or farther than in the model; its inertia about itself stays.

    Parameters: ``distance`` [m] of the centre of mass from the joint, in total, in the corrected model, along the given
    direction. What of it lies along the axis, only the joints before feel.

    Fingerprint: -ΔID/Δd on every joint, from the inverse dynamics with half the lever and one and a half; since inertia
    grows with the distance squared, of a change near the one that was found.

    Simulation: the position of the body's centre of mass.
    """

    name = "link_com"
    family = "inertia"
    tolerance = 0.6  # 3 % of the link's size
    odds = 1 / 3
    mjcf = "model"
    excludes = frozenset({"link_mass", "torque_scale"})  # one joint shows ratios of the three only
    shows_in = "load"
    equation = "c → c (1 + Δd/d), from the joint"
    source = "Atkeson, An, Hollerbach 1986, doi:10.1177/027836498600500306"
    experiments: ClassVar[Mapping[str, str]] = {
        "link_mass": "weigh the link, or hold {joint} still in several poses and shake it fast: mass and distance "
        "enter gravity and inertia with different powers",
        "torque_scale": "hang a known weight on {joint} and hold it still in two poses",
        "reflected_inertia": "hold {joint} still against gravity in several poses, then shake it fast",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        distance = float(np.linalg.norm(_lever(model, address, joint)))
        if is_slide(model, address, joint) or distance < 1e-4 or not carries_link(address, joint):
            return ()
        return (Parameter("distance", "m", distance, 0.2 * distance, 3 * distance, 0.05 * distance),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}] if self.parameters(s.nominal, s.address, joint) else []

    def near(self, parameters: Sequence[Parameter], values: Array) -> Mapping[str, float]:
        (share,) = values / [p.nominal for p in parameters]
        return {"near": float(_STEP ** np.round(np.log(share) / np.log(_STEP)))}

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        lever, torques = _lever(s.model, s.address, joint), []
        for share in (0.5, -0.5):  # the torque is a parabola of the distance
            model = s.model.__copy__()
            model.body_ipos[s.address.body[joint]] += share * lever
            recompute_constants(model)
            torques.append(s.inverse(model) - s.rigid)
        secant = torques[0] - torques[1] + 2 * (fixed.get("near", 1.0) - 1.0) * (torques[0] + torques[1])
        distance = max(float(np.linalg.norm(lever)), 1e-4)  # without a lever nothing moves, and nothing is predicted
        return Fingerprint(-(secant / distance)[:, :, None], fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        lever = _lever(plant.model, plant.address, joint)
        change = values[:, 0] / np.linalg.norm(lever) - 1.0
        plant.of("body_ipos")[:, plant.address.body[joint]] += change[:, None] * lever

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        (distance,) = parameters
        return (
            f"The centre of mass of the link moved by {joint} is {1e3 * values['distance']:.3g} mm from it; "
            f"the model says {1e3 * distance.nominal:.3g} mm."
        )


def carries_link(address: JointAddress, joint: int) -> bool:
    """Whether the body's mass is counted with this joint: of several joints of one body, with the last."""
    return address.body[joint] not in address.body[joint + 1 :]


def recompute_constants(model: mujoco.MjModel) -> None:
    """MuJoCo takes the inertia of a simple body, such as a carriage, from constants that only this updates."""
    free_of_simple_bodies(model)
    mujoco.mj_setConst(model, mujoco.MjData(model))


def free_of_simple_bodies(model: mujoco.MjModel) -> None:
    """Let centres of mass move off their frames, in place; ``mj_setConst`` refuses that of bodies compiled as simple.

    A wheel or a carriage is one. With several joints, it stays so: its inertia matrix has no room for what would couple
    them.
    """
    alone = model.body_dofnum == 1
    model.body_simple[alone] = model.body_sameframe[alone] = 0
    model.dof_simplenum[alone[model.dof_bodyid]] = 0


def _lever(model: mujoco.MjModel, address: JointAddress, joint: int) -> Array:
    """Way from the joint to the centre of mass, in the body's frame [m]. Shape (3,)."""
    return np.asarray(model.body_ipos[address.body[joint]] - model.jnt_pos[address.joint[joint]], dtype=np.float64)


class LinkInertia(Effect):
    """The rotational inertia of the link about its own centre of mass is off: the least certain number of a CAD model.

    It is adjusted within a tolerance beside the findings and is no finding itself, since on most joints a rotor
    explains the same motion.

    Parameters: ``scale`` [1] of the given inertia.

    Fingerprint: -∂ID/∂s on every joint, from the inverse dynamics with 1 % more inertia.

    Simulation: the body's inertia.
    """

    name = "link_inertia"
    family = "inertia"
    tolerance = 1.5  # 15 %
    mjcf = "model"
    shows_in = "acceleration"
    equation = "Ic → s Ic"
    source = "Atkeson, An, Hollerbach 1986, doi:10.1177/027836498600500306"

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        turns = not is_slide(model, address, joint) and bool(model.body_inertia[address.body[joint]].any())
        if not turns or not carries_link(address, joint):
            return ()
        return (Parameter("scale", "1", 1.0, 0.3, 3.0, 0.1),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}]

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        model = s.model.__copy__()
        model.body_inertia[s.address.body[joint]] *= 1.01
        recompute_constants(model)
        return Fingerprint(-((s.inverse(model) - s.rigid) / 0.01)[:, :, None], fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        plant.of("body_inertia")[:, plant.address.body[joint]] *= values

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        return f"The rotational inertia of the link moved by {joint} is {values['scale']:.3g} times the model's."
