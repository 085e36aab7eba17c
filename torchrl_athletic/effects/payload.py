"""What the robot carries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from torchrl_athletic.effects.effect import Array, Effect, Fingerprint, Parameter
from torchrl_athletic.effects.inertia import carries_link, recompute_constants
from torchrl_athletic.effects.plant import Plant
from torchrl_athletic.effects.signals import JointAddress, Signals

INERTIAL = ("body_mass", "body_ipos", "body_iquat", "body_inertia")
"""Fields of the model that say how a body weighs."""
SHIFT = 0.05
"""To either side of the far end, between which the torque is a line of the first moment [m]."""
FEWEST = 3
"""Joints of a chain that turns a point of its last link in enough ways to tell where it is."""
FELT = 1e-4
"""Torque of a moment that its mass does not explain, per that of the mass at a metre, from which on it is felt [1]."""


class Payload(Effect):
    """Something heavy sits at the end of the arm: a tool, a gripper, a workpiece.

    Parameters: ``mass`` [kg] of a point at the far end of the last link: the site or end of a geom farthest from its
    joint (a capsule's cap does not count) or, on a link without either, twice as far from it as its centre of mass.
    Only the last link of a chain has one.

    Fingerprint: -∂ID/∂m on every joint, from the inverse dynamics with the point mass.

    Simulation: mass, centre of mass and inertia of the link with the point.
    """

    name = "payload"
    family = "inertia"
    mjcf = "model"
    shows_in = "load"
    adds_to_link = True
    equation = "τ = -m J(q)ᵀ (a - g) of the end point"
    source = "Khalil, Gautier, Lemoine 2007, Identification of the payload inertial parameters, ICRA"
    experiments: ClassVar[Mapping[str, str]] = {
        "link_mass": "hold {joint} still in two poses and shake it at 2 to 3 Hz: a point at the end has half again as "
        "much inertia per weight as the link",
        "link_com": "weigh the last link, or shake {joint} at 2 to 3 Hz: a shifted centre loads no other joint",
        "torque_scale": "take the payload off {joint} and repeat the take: a wrong scale stays",
        "reflected_inertia": "hold {joint} still in two poses: a rotor has no weight",
        "gravity_tilt": "take the payload off {joint} and repeat the take: a tilt stays",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        mass = float(model.body_subtreemass[address.body[joint]])
        if not mass or not _is_last(model, address, joint):
            return ()
        return (Parameter("mass", "kg", 0.0, 0.0, _most(model, address, joint), 0.05 * mass),)

    def grid(self, s: Signals, joint: int) -> list[Mapping[str, float]]:
        return [{}] if self.parameters(s.model, s.address, joint) else []

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        torque = _torque_of_point(s, joint, far_end(s.model, s.address, joint))
        return Fingerprint(-torque[:, :, None], fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        if values.any():
            _put(plant, joint, values[:, 0], far_end(plant.model, plant.address, joint))

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        return f"A payload of {values['mass']:.3g} kg sits at the end of the link moved by {joint}; the model has none."


class OffsetPayload(Payload):
    """Something heavy is fastened to the arm, with its centre of mass anywhere: a gripper, a camera, a bracket.

    Parameters: ``mass`` [kg] of a point, and its first moments ``moment_x``, ``moment_y`` and ``moment_z`` [kg·m] about
    the far end of the last link (see :class:`Payload`), along the axes of the link's frame. A moment that the chain
    cannot feel, as that along the axes of a planar arm, stays zero. Only the last link of a chain has one; it is looked
    for where the chain has :data:`FEWEST` joints or more.

    Fingerprint: -∂ID/∂m and -∂ID/∂(m c) on every joint, from the inverse dynamics with the point mass, at the far end
    and :data:`SHIFT` to either side of it.

    Simulation: mass, centre of mass and inertia of the link with the point.
    """

    name = "offset_payload"
    excludes = frozenset({"payload", "link_mass", "link_com"})
    special_cases = frozenset({"payload"})
    sets_apart = MOMENTS = ("moment_x", "moment_y", "moment_z")
    equation = "τ = -m J(q)ᵀ (a - g) of a point of the link"
    experiments: ClassVar[Mapping[str, str]] = {
        "payload": "hold {joint} level and turn it by half a turn: weight on its axis asks for the same torque",
        "torque_scale": "take the payload off {joint} and repeat the take: a wrong scale stays",
        "reflected_inertia": "hold {joint} still in two poses: a rotor has no weight",
        "gravity_tilt": "take the payload off {joint} and repeat the take: a tilt stays",
    }

    def parameters(self, model: mujoco.MjModel, address: JointAddress, joint: int) -> tuple[Parameter, ...]:
        mass = float(model.body_subtreemass[address.body[joint]])
        if not mass or not _is_last(model, address, joint):
            return ()
        most, reach = _most(model, address, joint), _reach(model, address, joint)
        felt = reach * _felt(model, address, joint)
        if not felt.any():
            return ()
        moments = zip(self.MOMENTS, (most * felt).tolist(), strict=True)
        return (
            Parameter("mass", "kg", 0.0, 0.0, most, 0.05 * mass),
            *(Parameter(name, "kg·m", 0.0, -bound, bound, 0.05 * mass * reach) for name, bound in moments),
        )

    def is_physical(self, parameters: Sequence[Parameter], values: Array) -> bool:
        most, *bounds = (p.upper for p in parameters)
        return float(np.linalg.norm(values[1:])) <= float(values[0]) * max(bounds) / most

    def grid_of(self, takes: Sequence[Signals], joint: int) -> list[Mapping[str, float]]:
        model, address = takes[0].model, takes[0].address
        return super().grid_of(takes, joint) if len(_chain(model, address, joint)) >= FEWEST else []

    def fingerprint(self, s: Signals, joint: int, fixed: Mapping[str, float]) -> Fingerprint:
        end = far_end(s.model, s.address, joint)
        columns = [_torque_of_point(s, joint, end)]
        for axis in SHIFT * np.eye(3):
            there, back = (_torque_of_point(s, joint, end + side * axis) for side in (1, -1))
            columns.append((there - back) / (2 * SHIFT))
        return Fingerprint(-np.stack(columns, axis=-1), fixed)

    def apply(self, plant: Plant, joint: int, values: Array) -> None:
        mass = values[:, :1]
        if not mass.any():
            return
        offset = values[:, 1:] / np.maximum(mass, 1e-12)
        way = np.linalg.norm(offset, axis=1, keepdims=True)
        # beyond its reach it is not physical, and would be a flywheel
        offset *= np.minimum(1.0, _reach(plant.model, plant.address, joint) / np.maximum(way, 1e-12))
        _put(plant, joint, mass[:, 0], far_end(plant.model, plant.address, joint) + offset)

    def sentence(self, joint: str, values: Mapping[str, float], parameters: tuple[Parameter, ...]) -> str:
        offset = np.array([values[x] for x in self.MOMENTS]) / max(values["mass"], 1e-12)
        x, y, z = (f"{values[name]:.3g}" for name in self.MOMENTS)
        return (
            f"A payload of {values['mass']:.3g} kg is fastened to the link moved by {joint}, with its centre "
            f"{1e3 * np.linalg.norm(offset):.0f} mm from the link's end (first moments {x}, {y} and {z} kg·m along the "
            "link's axes); the model has none."
        )


def _torque_of_point(s: Signals, joint: int, point: Array) -> Array:
    """Torque that one kilogram at a point of the last link asks for [N·m/kg]. Shape (N, J)."""
    body = int(s.address.body[joint])
    step = 0.1 * float(s.model.body_subtreemass[body])
    loaded = _loaded(s.model, body, int(s.address.dof[joint]), point, step)
    return np.asarray((s.inverse(loaded) - s.rigid) / step, dtype=np.float64)


def _loaded(model: mujoco.MjModel, body: int, dof: int, point: Array, added: float) -> mujoco.MjModel:
    """A copy of the model with a point mass at a point of a body."""
    model = model.__copy__()
    mass, centre, quat, inertia = (getattr(model, name)[body : body + 1] for name in INERTIAL)
    mass, centre, quat, inertia = with_point(mass, centre, quat, inertia, point, np.array([added]))
    model.body_mass[body], model.body_ipos[body] = mass[0], centre[0]
    model.body_iquat[body], model.body_inertia[body] = quat[0], inertia[0]
    model.body_simple[body] = model.dof_simplenum[dof] = 0  # no longer centred on its frame
    recompute_constants(model)
    return model


def _felt(model: mujoco.MjModel, address: JointAddress, joint: int) -> NDArray[np.bool_]:
    """Which first moments of a point of the last link move the chain's torques, beside its mass. Shape (3,).

    By the inverse dynamics in random states, of which torques are linear in mass and moments.
    """
    body, dof = int(address.body[joint]), int(address.dof[joint])
    chain, end, rng = _chain(model, address, joint), far_end(model, address, joint), np.random.default_rng(0)
    added = 0.1 * float(model.body_subtreemass[body])
    ends = [end, *(end + side * axis for axis in SHIFT * np.eye(3) for side in (1, -1))]
    models = [model.__copy__(), *(_loaded(model, body, dof, point, added) for point in ends)]
    states = rng.standard_normal((8, 3, len(chain)))
    torques = np.empty((len(models), len(states), len(chain)))
    for m, torque in zip(models, torques, strict=True):
        m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        data = mujoco.MjData(m)
        for row, (position, velocity, acceleration) in enumerate(states):
            data.qpos[address.qpos[chain]], data.qvel[address.dof[chain]] = position, velocity
            data.qacc[address.dof[chain]] = acceleration
            mujoco.mj_inverse(m, data)
            torque[row] = data.qfrc_inverse[address.dof[chain]]
    mass, *sides = (torques[1:] - torques[:1]).reshape(len(ends), -1)
    known, felt = [mass / max(float(np.linalg.norm(mass)), 1e-300)], np.zeros(3, dtype=bool)
    for k, column in enumerate(np.array(sides[::2]) - np.array(sides[1::2])):
        new = column - sum(float(unit @ column) * unit for unit in known)
        felt[k] = float(np.linalg.norm(new)) > FELT * SHIFT * float(np.linalg.norm(mass))
        if felt[k]:
            known.append(new / np.linalg.norm(new))
    return felt


def _put(plant: Plant, joint: int, added: Array, point: Array) -> None:
    """Add point masses (rows,) to the last link, at one point (3,) or one for each row (rows, 3)."""
    body = plant.address.body[joint]
    mass, centre, quat, inertia = (plant.of(name)[:, body] for name in INERTIAL)
    for name, value in zip(INERTIAL, with_point(mass, centre, quat, inertia, point, added), strict=True):
        plant.of(name)[:, body] = value


def _chain(model: mujoco.MjModel, address: JointAddress, joint: int) -> list[int]:
    """The recorded joints that move the joint's link, from the base to it."""
    above, body = [], int(address.body[joint])
    while body:
        above.append(body)
        body = int(model.body_parentid[body])
    chain = [j for j, body in enumerate(address.body) if body in above]
    return sorted(chain, key=lambda j: int(address.joint[j]))  # in the order of the tree


def _most(model: mujoco.MjModel, address: JointAddress, joint: int) -> float:
    """What may be fastened: ten times the last link, or half of all that the chain moves [kg]."""
    last, first = (int(address.body[j]) for j in (joint, _chain(model, address, joint)[0]))
    return max(10 * float(model.body_subtreemass[last]), 0.5 * float(model.body_subtreemass[first]))


def _reach(model: mujoco.MjModel, address: JointAddress, joint: int) -> float:
    """Half the way from joint to joint to the far end: how far from that a centre of mass may lie [m]."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body = address.body[joint]
    end = data.xpos[body] + data.xmat[body].reshape(3, 3) @ far_end(model, address, joint)
    way = np.vstack([data.xanchor[address.joint[_chain(model, address, joint)]], end])
    return 0.5 * float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())


def with_payload(xml: str, joint_names: Sequence[str], mass: float) -> mujoco.MjModel:
    """The model with a point mass welded to the far end of the last link.

    The link keeps its own mass, so that what an effect says of it still holds.

    Args:
        xml: MJCF.
        joint_names: The recorded joints; the last one moves the link.
        mass: [kg]
    """
    spec = mujoco.MjSpec.from_string(xml)
    model = spec.compile()
    address = JointAddress.of(model, tuple(joint_names))
    last = len(joint_names) - 1
    body = spec.joint(joint_names[-1]).parent  # bodies need no names, joints that are recorded do
    weight = body.add_body(name="fastened_payload", pos=far_end(model, address, last))
    tiny = 1e-6 * mass
    weight.mass, weight.ipos, weight.inertia, weight.explicitinertial = mass, (0, 0, 0), (tiny, tiny, tiny), True
    return spec.compile()


def far_end(model: mujoco.MjModel, address: JointAddress, joint: int) -> Array:
    """The far end of the link, in the body's frame [m]. Shape (3,)."""
    body, data = int(address.body[joint]), mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rigid = _rigidly_held(model, body)
    points = [data.site_xpos[k] for k in range(model.nsite) if model.site_bodyid[k] in rigid]
    for k in range(model.ngeom):
        if model.geom_bodyid[k] in rigid:
            turn, centre, half = data.geom_xmat[k].reshape(3, 3), model.geom_aabb[k, :3], model.geom_aabb[k, 3:]
            if model.geom_type[k] == mujoco.mjtGeom.mjGEOM_CAPSULE:  # from one point to another, with caps about both
                half = half - model.geom_size[k, 0]
            along = half * (half > half.max() - 1e-9) * (half > 1.01 * half.min())  # a ball has no end but its middle
            points += [data.geom_xpos[k] + turn @ (centre + side * along) for side in (1, -1)]
    turn = data.xmat[body].reshape(3, 3)
    local = [turn.T @ (point - data.xpos[body]) for point in points]
    if not local:
        local = [2 * model.body_ipos[body] - model.jnt_pos[address.joint[joint]]]
    distance = np.linalg.norm(np.array(local) - model.jnt_pos[address.joint[joint]], axis=1)
    return np.asarray(local[int(np.argmax(distance))], dtype=np.float64)


def with_point(
    mass: Array, centre: Array, quat: Array, inertia: Array, point: Array, added: Array
) -> tuple[Array, Array, Array, Array]:
    """Inertial parameters of bodies with a point mass, as ``mjModel`` keeps them.

    Args:
        mass: [kg]. Shape (rows,).
        centre: Of mass, in the body's frame [m]. Shape (rows, 3).
        quat: Of the principal axes in the body's frame. Shape (rows, 4).
        inertia: Principal moments [kg·m²]. Shape (rows, 3).
        point: Where the point sits, in the body's frame [m]. Shape (3,) or (rows, 3).
        added: Its mass [kg]. Shape (rows,).

    Returns:
        The first four again, unchanged where nothing is added.
    """
    axes = Rotation.from_quat(quat[:, [1, 2, 3, 0]]).as_matrix()
    total = mass + added
    arm = point - centre
    reduced = (mass * added / total)[:, None, None]
    square = (arm**2).sum(-1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None, :]
    moments, turns = np.linalg.eigh((axes * inertia[:, None, :]) @ axes.transpose(0, 2, 1) + reduced * square)
    turns[:, :, 0] *= np.linalg.det(turns)[:, None]  # a rotation, not a reflection
    new = Rotation.from_matrix(turns).as_quat()[:, [3, 0, 1, 2]]
    same = (added == 0)[:, None]
    return (
        total,
        centre + (added / total)[:, None] * arm,
        np.where(same, quat, new),
        np.where(same, inertia, moments),
    )


def _rigidly_held(model: mujoco.MjModel, body: int) -> set[int]:
    """The body and those welded to it."""
    return {k for k in range(model.nbody) if model.body_weldid[k] == model.body_weldid[body]}


def _is_last(model: mujoco.MjModel, address: JointAddress, joint: int) -> bool:
    """Whether no joint moves anything against the joint's link."""
    held = _rigidly_held(model, int(address.body[joint]))
    others = [k for k in range(model.nbody) if model.body_parentid[k] in held and k not in held]
    return not others and carries_link(address, joint)
