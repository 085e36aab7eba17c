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
DRIVEN = {
    mujoco.mjtObj.mjOBJ_JOINT: (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT),
    mujoco.mjtObj.mjOBJ_TENDON: (mujoco.mjtTrn.mjTRN_TENDON,),
}
"""How an actuator says that it drives one."""


def locked_joints(
    model: Path | str, lock: Sequence[str], recordings: Sequence[Recording]
) -> tuple[str, tuple[str, ...]]:
    """MJCF of a model with some joints held, and the joints that are left.

    Actuators, sensors, equalities and tendons of nothing but what is held go with it.

    Args:
        model: MJCF as a path or as text.
        lock: Joints by name, or ``name=position`` [rad, m]; else they are held where the recordings have them, or at
            the model's zero.
        recordings: Of the robot.

    Raises:
        RecordingError: If there is no such joint, it moves in the recordings, or a tendon or an equality ties it to one
            that is left.
    """
    spec = mujoco.MjSpec.from_string(load_model(model)[1])
    names = [joint.name for joint in spec.joints]
    places = _places(spec, lock, recordings)
    _untie(spec, set(places))
    for name, place in places.items():
        _hold(spec.joint(name), place)
        _delete(spec, spec.joint(name), mujoco.mjtObj.mjOBJ_JOINT)
    for key in list(spec.keys):
        spec.delete(key)
    spec.nkey = 0  # else as many are made anew, at the model's zero
    try:
        spec.compile()
    except ValueError as error:
        raise RecordingError(
            f"--lock {' '.join(places)}: MuJoCo cannot compile what is left of the model "
            f"({' '.join(str(error).split())}). Take out of the model what it names, or what speaks of these joints."
        ) from error
    return str(spec.to_xml()), tuple(n for n in names if n not in places)


def _places(spec: mujoco.MjSpec, lock: Sequence[str], recordings: Sequence[Recording]) -> dict[str, float]:
    """Where each joint is held; all that is wrong with them is said at once."""
    said: dict[str, str] = {}
    out, wrong = {}, []
    for entry in lock:
        name, _, place = entry.partition("=")
        try:
            if said.setdefault(name, place) != place:
                raise RecordingError(f"--lock {name}: it is named twice, at two places. Say one.")
            out[name] = _place(spec, name, place, recordings)
        except RecordingError as error:
            wrong.append(str(error))
    if wrong:
        raise RecordingError(" ".join(wrong))
    return out


def _place(spec: mujoco.MjSpec, name: str, said: str, recordings: Sequence[Recording]) -> float:
    names = [joint.name for joint in spec.joints if joint.name]
    if name not in names:
        raise RecordingError(f"--lock {name}: the model has no such joint; it has {', '.join(names)}.")
    if spec.joint(name).type not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
        raise RecordingError(
            f"--lock {name}: only hinges and slides are held at a number. Delete this joint from the model, where its "
            "body has the attitude in which it stood."
        )
    return _position(name, said, recordings)


def _position(name: str, said: str, recordings: Sequence[Recording]) -> float:
    if said:
        try:
            place = float(said)
        except ValueError:
            place = np.nan
        if not np.isfinite(place):
            raise RecordingError(f"--lock {name}={said}: give a number of rad or m after the equals sign.")
        return place
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


def _untie(spec: mujoco.MjSpec, held: set[str]) -> None:
    """Delete tendons and equalities of nothing but what is held.

    Raises:
        RecordingError: If one ties what is held to a joint that is left: it would hold that, too.
    """
    cut: set[str] = set()
    for tendon in list(spec.tendons):
        own = {wrap.target.name for wrap in tendon.path if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT}
        if own & held:
            _refuse_half(f"tendon {tendon.name}", own, held)
            cut.add(tendon.name)
            _delete(spec, tendon, mujoco.mjtObj.mjOBJ_TENDON)
    for kind, lost in ((mujoco.mjtEq.mjEQ_JOINT, held), (mujoco.mjtEq.mjEQ_TENDON, cut)):
        for equality in [e for e in spec.equalities if e.type == kind]:
            own = {equality.name1, equality.name2} - {""}
            if own & lost:
                if equality.active:
                    _refuse_half(f"equality {equality.name}", own, lost)
                spec.delete(equality)


def _refuse_half(tie: str, ends: set[str], lost: set[str]) -> None:
    if left := sorted(ends - lost):
        raise RecordingError(
            f"--lock: the model's {tie.strip()} ties {', '.join(sorted(ends & lost))}, which is held, to "
            f"{', '.join(left)}, which is not. Lock that, too, or take the {tie.split()[0]} out of the model."
        )


def _delete(spec: mujoco.MjSpec, element: mujoco.MjsJoint | mujoco.MjsTendon, kind: mujoco.mjtObj) -> None:
    """Delete a joint or a tendon with its actuators, and the sensors of both."""
    for actuator in [a for a in spec.actuators if a.trntype in DRIVEN[kind] and a.target == element.name]:
        _delete_sensors(spec, actuator.name, mujoco.mjtObj.mjOBJ_ACTUATOR)
        spec.delete(actuator)
    _delete_sensors(spec, element.name, kind)
    spec.delete(element)


def _delete_sensors(spec: mujoco.MjSpec, name: str, kind: mujoco.mjtObj) -> None:
    for sensor in [s for s in spec.sensors if s.objtype == kind and s.objname == name]:
        spec.delete(sensor)


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
