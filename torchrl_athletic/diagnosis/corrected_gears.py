"""A gear that gives way or has play, in MJCF: one hinge for the motor and one for the link."""

from __future__ import annotations

from collections import Counter

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.effects import Plant
from torchrl_athletic.effects.gear import ROTOR_FLOOR, Spring

Array = NDArray[np.float64]

_NO_CONSTRAINTS = int(
    mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_LIMIT
)
_BEARING = 1e-6
"""Mass of the body that bears a motor's hinge, of which only the armature counts, per the link's [1]."""
_IMPEDANCES = (1e-4, 1 - 1e-4)
"""Bounds at which MuJoCo clips ``solimp``."""
_OF_THE_LINK = (
    mujoco.mjtSensor.mjSENS_JOINTLIMITPOS,
    mujoco.mjtSensor.mjSENS_JOINTLIMITVEL,
    mujoco.mjtSensor.mjSENS_JOINTLIMITFRC,
)
"""Sensors of what stays at the link."""


def write_gears(spec: mujoco.MjSpec, plant: Plant, names: tuple[str, ...]) -> dict[str, str]:
    """Part motors from their links where a gear is soft or has play.

    The joint of the given name becomes the motor's: its armature, its actuators and the range of their torque, and
    what the encoder reads. The link hangs at a new joint ``<name>_link``, with friction, damping, springs and limits.
    Between them acts a constraint on the tendon ``<name>_gear``: an equality as soft as the gear, or, with play, a
    limit on either side. Its impedance makes it the implicit spring that the diagnosis simulates,
    :meth:`torchrl_athletic.effects.gear.Spring.torque`, so that its stiffness is never too much for the time step; what
    damps or steers the lighter motor and link beside it may be.

    Args:
        spec: The model, all else written; edited in place. Keyframes start the motor where the link is.
        plant: With the gears, one row.
        names: Of the plant's joints.

    Returns:
        Link's joint by name, of the gears that are written. Others are those of a joint that an equality or a tendon
        names as well, or whose motor compensates gravity, and of a model without constraints, or with one of these
        names in use.
    """
    before, gears = spec.compile(), Counter(names[gear.joint] for gear in plant.gears)
    springs = {
        name: gear.spring
        for gear in plant.gears
        if gears[name := names[gear.joint]] == 1 and _is_free(spec, before, name)
    }
    if not springs:
        return {}
    states = [(key.qpos, key.qvel) for key in spec.keys]
    for key in spec.keys:
        key.qpos, key.qvel = [], []
    for name, spring in springs.items():
        _part(spec, before, name)
        _couple(spec, name, spring)
    after = spec.compile()
    for name, spring in springs.items():
        _soften(spec, after, name, spring)
    for key, (qpos, qvel) in zip(spec.keys, states, strict=True):
        if len(qpos):
            key.qpos = _moved(np.asarray(qpos), after.qpos0, (before, after), tuple(springs))
        if len(qvel):
            key.qvel = _moved(np.asarray(qvel), np.zeros(after.nv), (before, after), tuple(springs))
    return {name: f"{name}_link" for name in springs}


def _is_free(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str) -> bool:
    """Whether nothing but bodies, actuators and sensors knows of the joint, and the names that it needs are free."""
    joint, equalities = model.joint(name).id, model.eq_type == mujoco.mjtEq.mjEQ_JOINT
    wraps = model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT
    users = (model.eq_obj1id[equalities], model.eq_obj2id[equalities], model.wrap_objid[wraps])
    taken = (
        spec.body(f"{name}_motor"),
        spec.joint(f"{name}_link"),
        spec.tendon(f"{name}_gear"),
        spec.equality(f"{name}_gear"),
    )
    return not (
        model.opt.disableflags & _NO_CONSTRAINTS
        or model.jnt_actgravcomp[joint]
        or any(joint in ids for ids in users)
        or any(element is not None for element in taken)
    )


def _part(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str) -> None:
    """Give a joint's name, armature and drive to a motor of its own, beside the link on the same parent."""
    link, joint = spec.joint(name), model.joint(name)
    body = int(joint.bodyid[0])
    mass = _BEARING * max(float(model.body_mass[body]), 1e-3)
    motor_body = link.parent.parent.add_body(
        name=f"{name}_motor",
        pos=model.body_pos[body],
        quat=model.body_quat[body],
        mass=mass,
        ipos=[0, 0, 0],  # without which no inertia is written
        inertia=[mass] * 3,
        explicitinertial=True,
    )
    link.name = f"{name}_link"
    motor_body.add_joint(
        name=name,
        type=link.type,
        axis=joint.axis,
        pos=joint.pos,
        ref=link.ref,
        armature=_rotor(model, int(joint.dofadr[0])),
        actfrclimited=link.actfrclimited,
        actfrcrange=link.actfrcrange,
        limited=mujoco.mjtLimited.mjLIMITED_FALSE,
        damping=[0, 0, 0],
        stiffness=[0, 0, 0],
        frictionloss=0,
        springdamper=[0, 0],
    )
    link.armature, link.actfrclimited = 0.0, mujoco.mjtLimited.mjLIMITED_FALSE
    for sensor in spec.sensors:
        if sensor.objname == name and sensor.type in _OF_THE_LINK:
            sensor.objname = link.name


def _rotor(model: mujoco.MjModel, dof: int) -> float:
    """Armature of a motor [kg·m², kg], which cannot be without."""
    link = 1.0 / max(float(model.dof_invweight0[dof]), 1e-12) - float(model.dof_armature[dof])
    return max(float(model.dof_armature[dof]), ROTOR_FLOOR * link)


def _couple(spec: mujoco.MjSpec, name: str, spring: Spring) -> None:
    tendon = spec.add_tendon(
        name=f"{name}_gear",
        stiffness=[0, 0, 0],
        damping=[0, 0, 0],
        frictionloss=0,
        armature=0,
        margin=0,
        limited=mujoco.mjtLimited.mjLIMITED_FALSE,
        actfrclimited=mujoco.mjtLimited.mjLIMITED_FALSE,
        actfrcrange=[0, 0],
    )
    tendon.wrap_joint(name, 1.0)
    tendon.wrap_joint(f"{name}_link", -1.0)
    if spring.play:
        half = _number(spring.gap) / 2
        tendon.limited, tendon.range = mujoco.mjtLimited.mjLIMITED_TRUE, [-half, half]
    else:
        spec.add_equality(
            name=f"{name}_gear",
            type=mujoco.mjtEq.mjEQ_TENDON,
            objtype=mujoco.mjtObj.mjOBJ_TENDON,
            name1=tendon.name,
            active=True,
        )


def _soften(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str, spring: Spring) -> None:
    r"""Make a constraint a spring.

    MuJoCo's pushes with :math:`(-k r - b \dot r - a) / R`, where a is the acceleration that comes of it and
    :math:`R = (1 - d) A / d`, with the inverse inertia A that it sees at ``qpos0``. With 1/R the implicit part of the
    spring, :meth:`~torchrl_athletic.effects.gear.Spring.softness`, k = K R and b = D R that is the spring's torque.
    Teeth that would meet and part within a step rest instead: theirs is the torque at its end (backward Euler).
    """
    step = float(model.opt.timestep)
    inverse = float(model.tendon_invweight0[model.tendon(f"{name}_gear").id])
    stiffness, damping = _number(spring.stiffness), _number(spring.damping)
    implicit = _number(spring.softness(np.array(1.0 / inverse), step))
    if spring.play and inverse * implicit > 1:
        implicit, damping = step * (damping + step * stiffness), damping + step * stiffness
    impedance = float(np.clip(inverse * implicit / (1 + inverse * implicit), *_IMPEDANCES))
    per_torque = (1 - impedance) * inverse  # d R, as MuJoCo divides these by d
    solref = [-per_torque * stiffness, -per_torque * damping]
    solimp = [impedance, impedance, 1e-3, 0.5, 2.0]
    if spring.play:
        tendon = spec.tendon(f"{name}_gear")
        tendon.solref_limit, tendon.solimp_limit = solref, solimp
    else:
        equality = spec.equality(f"{name}_gear")
        equality.solref, equality.solimp = solref, solimp


def _moved(
    state: Array, rest: Array, models: tuple[mujoco.MjModel, mujoco.MjModel], parted: tuple[str, ...]
) -> list[float]:
    """Positions or velocities of the model before as those of the model after, motors as their links."""
    before, after = models
    is_position = len(rest) == after.nq
    start, to = ((m.jnt_qposadr if is_position else m.jnt_dofadr) for m in models)
    motors = [after.joint(name).id for name in parted]
    others = [j for j in range(after.njnt) if j not in motors]  # in the order of before
    of_motors = [before.joint(name).id for name in parted]
    out = rest.copy()
    for old, new in (*enumerate(others), *zip(of_motors, motors, strict=True)):
        floats = before.jnt_type[old] == mujoco.mjtJoint.mjJNT_FREE
        size = (7 if is_position else 6) if floats else 1
        out[to[new] : to[new] + size] = state[start[old] : start[old] + size]
    return [float(x) for x in out]


def _number(value: Array) -> float:
    """The only number of an array of one row."""
    return float(np.ravel(value)[0])
