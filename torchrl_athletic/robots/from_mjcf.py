"""A robot of one's own, from its MJCF."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import mujoco
import numpy as np

from torchrl_athletic.functional.gears import link_joint
from torchrl_athletic.robots.robot import Robot

_SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def from_mjcf(
    mjcf: str | os.PathLike[str],
    *,
    kp: Sequence[float] | float | None = None,
    kd: Sequence[float] | float | None = None,
    torque_limit: Sequence[float] | float | None = None,
    velocity_limit: Sequence[float] | float = np.inf,
    joint_groups: Mapping[str, Sequence[str]] | None = None,
    sensors: Mapping[str, Sequence[str]] | None = None,
    keyframe: str | None = None,
    name: str | None = None,
) -> Robot:
    """Describe a robot by its own model, so that environments and transforms can drive it.

    Its joints are those of the model's actuators, in their order, or, without actuators, every hinge and slide. The
    actuators themselves are switched off: torques reach the joints directly, and what drives them is a chain of
    transforms. The base is the body with a free joint that carries them, where there is one.

    Args:
        mjcf: Path of the file, or the XML itself.
        kp: Gains, for what asks the robot for some [N·m/rad]; None takes those of position actuators, else 0. One for
            all or one for each joint.
        kd: [N·m·s/rad]; as ``kp``.
        torque_limit: [N·m]; None takes the model's actuator and joint force ranges.
        velocity_limit: At which no torque is left [rad/s]; an MJCF does not say.
        joint_groups: Joints by the name of their group.
        sensors: Observation key -> the model's sensors, as of :class:`Robot`.
        keyframe: Where an episode starts; None takes the model's first, or where it has none its default state.
        name: None takes the model's.

    Raises:
        ValueError: If an actuator drives something else than a hinge or slide, or a joint's torque has no limit.

    Example:
        >>> from torchrl_athletic.robots.benches import two_link_arm
        >>> robot = from_mjcf(two_link_arm(), kp=20.0, kd=0.5)
        >>> robot.joint_names, robot.torque_limit
        (('shoulder', 'elbow'), (10.0, 10.0))
    """
    text_or_path = os.fspath(mjcf)
    given = _read(text_or_path)
    keys = [key.name for key in given.keys]
    start = keyframe or (keys[0] if keys else "default")
    build = partial(_build, text_or_path if _is_xml(text_or_path) else str(Path(text_or_path).absolute()), start)
    model = build().compile()
    actuators, joints = _driven(model)
    names = tuple(model.joint(j).name for j in joints)
    limits = _torque_limits(model, actuators, joints) if torque_limit is None else _each(torque_limit, len(joints))
    for joint, limit in zip(names, limits, strict=True):
        if not np.isfinite(limit):
            raise ValueError(
                f"joint {joint!r} has no torque limit in the model: random actions and clips need one. Give it a "
                "forcerange in the MJCF, or torque_limit=..."
            )
    servo_kp, servo_kd = _servo_gains(model, actuators, len(joints))
    address = model.jnt_qposadr[joints]
    links = [model.joint(link_joint(model, joint)).id for joint in names]
    return Robot(
        name=name or given.modelname,
        joint_names=names,
        joint_groups={
            group: tuple(names.index(member) for member in members) for group, members in (joint_groups or {}).items()
        },
        default_pose=tuple(float(q) for q in model.key(start).qpos[address]),
        kp=servo_kp if kp is None else _each(kp, len(joints)),
        kd=servo_kd if kd is None else _each(kd, len(joints)),
        torque_limit=limits,
        velocity_limit=_each(velocity_limit, len(joints)),
        position_limit=tuple(
            (float(low), float(high)) if limited else (-np.inf, np.inf)
            for (low, high), limited in zip(model.jnt_range[links], model.jnt_limited[links], strict=True)
        ),
        base=_base(model, joints),
        sensors={key: tuple(members) for key, members in (sensors or {}).items()},
        build=build,
        keyframe=start,
        ground=tuple(geom.name for geom in build().worldbody.geoms if geom.type in _GROUND),
    )


_GROUND = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)


def _is_xml(text_or_path: str) -> bool:
    return text_or_path.lstrip().startswith("<")


def _read(text_or_path: str) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(text_or_path) if _is_xml(text_or_path) else mujoco.MjSpec.from_file(text_or_path)


def _build(text_or_path: str, keyframe: str) -> mujoco.MjSpec:
    spec = _read(text_or_path)
    for number, geom in enumerate(spec.worldbody.geoms):
        if geom.type in _GROUND and not geom.name:
            geom.name = f"ground{number}"
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    if keyframe not in [key.name for key in spec.keys]:
        if keyframe != "default":
            raise ValueError(f"the model has no keyframe {keyframe!r}; it has {[key.name for key in spec.keys]}.")
        spec.add_key(name=keyframe, qpos=spec.compile().qpos0)
    return spec


def _driven(model: mujoco.MjModel) -> tuple[list[int], list[int]]:
    """Actuators with an input, and the joint of each; all hinges and slides where there are none."""
    actuators, joints = [int(i) for i in np.flatnonzero(model.actuator_ctrlnum)], []
    if not actuators:
        return [], [j for j in range(model.njnt) if int(model.jnt_type[j]) in _SINGLE]
    for i in actuators:
        joint = int(model.actuator_trnid[i, 0])
        if model.actuator_trntype[i] != mujoco.mjtTrn.mjTRN_JOINT or int(model.jnt_type[joint]) not in _SINGLE:
            raise ValueError(
                f"actuator {model.actuator(i).name!r} drives no hinge or slide, so there is no joint torque for it. "
                "Remove it from the MJCF."
            )
        joints.append(joint)
    return actuators, list(dict.fromkeys(joints))


def _torque_limits(model: mujoco.MjModel, actuators: list[int], joints: list[int]) -> tuple[float, ...]:
    """The smallest of the ranges that the model states for a joint's force."""
    limits = []
    for joint in joints:
        ranges = [model.jnt_actfrcrange[joint]] if model.jnt_actfrclimited[joint] else []
        for i in actuators:
            if model.actuator_trnid[i, 0] == joint and model.actuator_forcelimited[i]:
                ranges.append(abs(model.actuator_gear[model.actuator_outadr[i], 0]) * model.actuator_forcerange[i])
        limits.append(float(min((np.abs(r).min() for r in ranges), default=np.inf)))
    return tuple(limits)


def _servo_gains(model: mujoco.MjModel, actuators: list[int], joints: int) -> tuple[tuple[float, ...], ...]:
    """Gains of the actuators that are position servos, 0 of others."""
    if len(actuators) != joints:
        return (0.0,) * joints, (0.0,) * joints
    affine = model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    squared = model.actuator_gear[model.actuator_outadr, 0] ** 2  # the joint's angle is geared up, and so is the torque
    kp, kd = (np.where(affine, -squared * model.actuator_biasprm[:, k], 0.0)[actuators] for k in (1, 2))
    return tuple(map(float, kp)), tuple(map(float, kd))


def _base(model: mujoco.MjModel, joints: list[int]) -> str | None:
    """Of the bodies with a free joint, which a ball on the floor has too, the one that carries the driven joints."""
    carrying = model.body_rootid[model.jnt_bodyid[joints]]
    free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    bases = free[np.isin(free, carrying)]
    return model.body(bases[0]).name if bases.size else None


def _each(value: Sequence[float] | float, count: int) -> tuple[float, ...]:
    return tuple(float(v) for v in np.broadcast_to(np.asarray(value, dtype=float), count))
