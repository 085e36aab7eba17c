"""A robot with the joints and links that a diagnosis found, such as a whole quadruped with a diagnosed arm."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import mujoco
import numpy as np

from torchrl_athletic.robots.robot import Robot

SCHEMA = "torchrl_athletic/corrected/1"

Values: TypeAlias = Mapping[str, float]


def with_correction(
    robot: Robot,
    corrected_json: str | os.PathLike[str] | Mapping[str, Any],
    joints: Mapping[str, str] | None = None,
) -> Robot:
    """Give a robot the friction, damping, armature, masses and centres of mass that a diagnosis found.

    The diagnosed model may be a part of the robot: an arm that was diagnosed on its stand, now on a quadruped. Joints
    of the same name are changed, and the links that they move. Values hold in total, as in ``corrected.json``. What a
    model cannot say (delay, lag, scales and offsets of torques and encoders) is left to
    :class:`~torchrl_athletic.transforms.CorrectedActuation`, which takes the same file and refuses what nobody acts
    out.

    Args:
        robot: The given one, which stays as it is.
        corrected_json: Path of a ``corrected.json``, or its content.
        joints: The robot's name of a joint by that of the diagnosed model, where the two differ.

    Returns:
        The same robot with another model.

    Raises:
        ValueError: If the file is of another schema, the robot lacks a joint, or a link was diagnosed whose given mass
            or lever is another than this robot's.

    Example:
        >>> from torchrl_athletic.robots import b2z1
        >>> dry = {"effect": "coulomb_friction", "joint": "joint2", "parameters": {"torque": {"value": 2.5}}}
        >>> found = {"schema": "torchrl_athletic/corrected/1", "joint_names": ["joint2"]}
        >>> robot = with_correction(b2z1(), found | {"effects": [dry], "trims": []})
        >>> robot.model().joint("joint2").frictionloss
        array([2.5])
    """
    content = _read(corrected_json)
    named = joints or {}
    entries = []
    for entry in (*content["effects"], *content["trims"]):
        if entry["effect"] not in _EFFECTS:
            continue
        joint = named.get(entry["joint"], entry["joint"])
        if joint not in robot.joint_names:
            raise ValueError(
                f"{entry['effect']} was found on joint {entry['joint']!r}, but {robot.name!r} has {robot.joint_names}: "
                "it would be left out. Tell the robot's name of it: joints={...}."
            )
        _check_nominal(robot, joint, entry)
        values = tuple((name, float(given["value"])) for name, given in entry["parameters"].items())
        entries.append((entry["effect"], joint, values))
    return replace(robot, build=partial(_corrected, robot.build, tuple(entries)))


def _read(correction: str | os.PathLike[str] | Mapping[str, Any]) -> Mapping[str, Any]:
    content = correction if isinstance(correction, Mapping) else json.loads(Path(correction).read_text("utf-8"))
    if content.get("schema") != SCHEMA:
        raise ValueError(
            f"schema is {content.get('schema')!r}, with_correction reads {SCHEMA!r}. Give it the corrected.json of a "
            "diagnosis made by this version."
        )
    return content


def _check_nominal(robot: Robot, joint: str, entry: Mapping[str, Any]) -> None:
    """A total of a link means nothing for another link."""
    if entry["effect"] not in _OF_LINKS:
        return
    name, of_model = _OF_LINKS[entry["effect"]]
    nominal = entry["parameters"][name].get("nominal")
    model = robot.model()
    has = of_model(model, model.joint(joint).id)
    if nominal is not None and abs(has - nominal) > 1e-3 * abs(nominal):
        raise ValueError(
            f"{entry['effect']} of {joint!r} was found on a link with a {name} of {nominal:.4g}, that of "
            f"{robot.name!r} has {has:.4g}: what was added to it since would be lost. Diagnose with the link that the "
            "robot has, or leave the entry out and add the difference by hand."
        )


def _corrected(
    build: Callable[[], mujoco.MjSpec], entries: tuple[tuple[str, str, tuple[tuple[str, float], ...]], ...]
) -> mujoco.MjSpec:
    spec = build()
    given, model = spec.compile(), spec.compile()
    for effect, joint, values in entries:
        _EFFECTS[effect](model, given, model.joint(joint).id, dict(values))
    for joint in dict.fromkeys(joint for _, joint, _ in entries):
        _write_joint(spec.joint(joint), model, int(model.joint(joint).dofadr[0]))
        _write_link(spec.joint(joint).parent, model, given, int(model.joint(joint).bodyid[0]))
    return spec


def _write_joint(joint: Any, model: mujoco.MjModel, dof: int) -> None:
    joint.frictionloss = float(model.dof_frictionloss[dof])
    joint.solref_friction, joint.solimp_friction = model.dof_solref[dof], model.dof_solimp[dof]
    joint.damping[0] = float(model.dof_damping[dof])
    joint.armature = float(model.dof_armature[dof])


def _write_link(link: Any, model: mujoco.MjModel, given: mujoco.MjModel, body: int) -> None:
    """Mass, centre and principal moments, where they changed. The link itself, since it may have no name."""
    fields = ("body_mass", "body_ipos", "body_inertia")
    if all(np.array_equal(getattr(model, name)[body], getattr(given, name)[body]) for name in fields):
        return
    link.mass, link.ipos, link.iquat = float(model.body_mass[body]), model.body_ipos[body], model.body_iquat[body]
    link.fullinertia = [np.nan, 0, 0, 0, 0, 0]  # which would count instead
    link.inertia, link.explicitinertial = model.body_inertia[body], True


# What each effect changes, as the diagnosis simulates it. Of the model as given, and as corrected so far.


def _dry_friction(model: mujoco.MjModel, joint: int, torque: float) -> int:
    """Ideal: regularised as little as the time step allows."""
    dof = int(model.jnt_dofadr[joint])
    model.dof_frictionloss[dof] = torque
    model.dof_solref[dof] = (2 * model.opt.timestep, 1.0)
    model.dof_solimp[dof] = (0.99, 0.99, 1e-3, 0.5, 2.0)
    return dof


def _coulomb(model: mujoco.MjModel, given: mujoco.MjModel, joint: int, values: Values) -> None:
    dof = _dry_friction(model, joint, values["torque"])
    time_constant = 2 * values.get("turnover", 0.0) / given.dof_solimp[dof, 1]
    if time_constant > 2 * model.opt.timestep:  # friction as a simulation has it, which turns over early
        model.dof_solref[dof, 0], model.dof_solimp[dof] = time_constant, given.dof_solimp[dof]


def _asymmetric(model: mujoco.MjModel, given: mujoco.MjModel, joint: int, values: Values) -> None:
    """The part that opposes both directions alike."""
    dof = _dry_friction(model, joint, (values["coulomb_positive"] + values["coulomb_negative"]) / 2)
    model.dof_damping[dof] = (values["viscous_positive"] + values["viscous_negative"]) / 2


def _stribeck(model: mujoco.MjModel, given: mujoco.MjModel, joint: int, values: Values) -> None:
    """The torque to break away; what speed saves of it is the chain's."""
    _dry_friction(model, joint, values["coulomb"] + values["stribeck"])


def _viscous(model: mujoco.MjModel, given: mujoco.MjModel, joint: int, values: Values) -> None:
    model.dof_damping[model.jnt_dofadr[joint]] = values["damping"]


def _armature(model: mujoco.MjModel, given: mujoco.MjModel, joint: int, values: Values) -> None:
    model.dof_armature[model.jnt_dofadr[joint]] = values["armature"]


def _mass(model: mujoco.MjModel, given: mujoco.MjModel, joint: int, values: Values) -> None:
    body = model.jnt_bodyid[joint]
    model.body_mass[body] = values["mass"]
    model.body_inertia[body] *= values["mass"] / given.body_mass[body]


def _centre(model: mujoco.MjModel, given: mujoco.MjModel, joint: int, values: Values) -> None:
    lever = _lever(given, joint)
    model.body_ipos[model.jnt_bodyid[joint]] += (values["distance"] / np.linalg.norm(lever) - 1) * lever


def _centre_shift(model: mujoco.MjModel, given: mujoco.MjModel, joint: int, values: Values) -> None:
    model.body_ipos[model.jnt_bodyid[joint]] += [values[axis] for axis in ("x", "y", "z")]


def _inertia(model: mujoco.MjModel, given: mujoco.MjModel, joint: int, values: Values) -> None:
    model.body_inertia[model.jnt_bodyid[joint]] *= values["scale"]


def _lever(model: mujoco.MjModel, joint: int) -> Any:
    """Way from the joint to the centre of mass of its link [m]. Shape (3,)."""
    return model.body_ipos[model.jnt_bodyid[joint]] - model.jnt_pos[joint]


_EFFECTS: Mapping[str, Callable[[mujoco.MjModel, mujoco.MjModel, int, Values], None]] = {
    "coulomb_friction": _coulomb,
    "asymmetric_friction": _asymmetric,
    "stribeck_friction": _stribeck,
    "viscous_friction": _viscous,
    "reflected_inertia": _armature,
    "link_mass": _mass,
    "link_com": _centre,
    "link_com_shift": _centre_shift,
    "link_inertia": _inertia,
}

_OF_LINKS: Mapping[str, tuple[str, Callable[[mujoco.MjModel, int], float]]] = {
    "link_mass": ("mass", lambda model, joint: float(model.body_mass[model.jnt_bodyid[joint]])),
    "link_com": ("distance", lambda model, joint: float(np.linalg.norm(_lever(model, joint)))),
}
