"""Joints that stood still while the robot was recorded, made part of their parent in the model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.diagnosis.model import load_model
from torchrl_athletic.recordings import Recording, RecordingError

Array = NDArray[np.float64]

STILL = 0.02
"""Travel from which a joint that is recorded did not stand still [rad, m]."""


def locked_joints(
    model: Path | str, lock: Sequence[str], recordings: Sequence[Recording]
) -> tuple[str, tuple[str, ...]]:
    """MJCF of a model with some joints held, and the joints that are left.

    Args:
        model: MJCF as a path or as text.
        lock: Joints by name, or ``name=position`` [rad, m]; else they are held where the recordings have them, or at
            the model's zero.
        recordings: Of the robot.

    Raises:
        RecordingError: If there is no such joint, or it moves in the recordings.
    """
    spec = mujoco.MjSpec.from_string(load_model(model)[1])
    names = [joint.name for joint in spec.joints]
    for entry in lock:
        name, _, said = entry.partition("=")
        if name not in names:
            raise RecordingError(f"--lock {name}: the model has no such joint; it has {', '.join(names)}.")
        joint = spec.joint(name)
        _hold(joint, _position(name, said, recordings))
        for actuator in list(spec.actuators):
            if actuator.target == name:
                spec.delete(actuator)
        for sensor in list(spec.sensors):
            if sensor.objname == name:
                spec.delete(sensor)
        for key in list(spec.keys):
            spec.delete(key)
        spec.nkey = 0  # else as many are made anew, at the model's zero
        spec.delete(joint)
    spec.compile()
    gone = {entry.partition("=")[0] for entry in lock}
    return str(spec.to_xml()), tuple(n for n in names if n not in gone)


def _position(name: str, said: str, recordings: Sequence[Recording]) -> float:
    if said:
        try:
            return float(said)
        except ValueError:
            raise RecordingError(f"--lock {name}={said}: give a number of rad or m after the equals sign.") from None
    own = [r.position[:, r.joint_names.index(name)] for r in recordings if name in r.joint_names]
    if not own:
        return 0.0
    travel = float(np.ptp(np.concatenate(own)))
    if travel > STILL:
        raise RecordingError(
            f"--lock {name}: it moves by {travel:.3g} in the recordings. Leave it free, or say where it was held: "
            f"--lock {name}=0."
        )
    return float(np.median(np.concatenate(own)))


def _hold(joint: mujoco.MjsJoint, position: float) -> None:
    """Move a joint's body to where the joint has it, and take along the joints of that body that act before it."""
    body, amount = joint.parent, position - float(joint.ref)
    quat, axis = np.array(body.quat), np.array(joint.axis) / np.linalg.norm(joint.axis)
    turn, both, rotation, moved = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(4), np.zeros(9), np.zeros(3)
    shift = amount * axis
    if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
        mujoco.mju_axisAngle2Quat(turn, axis, amount)
        mujoco.mju_rotVecQuat(moved, np.array(joint.pos), turn)
        shift = np.array(joint.pos) - moved
    mujoco.mju_quat2Mat(rotation, turn)
    back = rotation.reshape(3, 3).T
    own = list(body.joints)
    for before in own[: [other.name for other in own].index(joint.name)]:
        before.axis, before.pos = back @ np.array(before.axis), back @ (np.array(before.pos) - shift)
    mujoco.mju_rotVecQuat(moved, shift, quat)
    mujoco.mju_mulQuat(both, quat, turn)
    body.pos, body.quat = np.array(body.pos) + moved, both
