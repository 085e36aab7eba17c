"""The Unitree B2 quadruped with a Z1 arm on its back."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_athletic.robots.arm import (
    ARM_JOINTS,
    ARM_ON_TRUNK,
    ARM_SENSORS,
    GROUND,
    add_arm,
    add_box,
    add_joint,
    add_motors,
    add_round,
    add_sensor,
)
from torchrl_athletic.robots.inertial import Inertial, Vector, set_inertial
from torchrl_athletic.robots.robot import Joint, Robot, assemble
from torchrl_athletic.robots.scene import Cone, add_keyframe, empty_scene
from torchrl_athletic.robots.terrain import Terrain, add_terrain
from torchrl_athletic.robots.tools import Tool, add_tool, tool_bodies, tool_sensors

LEGS = {"FR": (1, -1), "FL": (1, 1), "RR": (-1, -1), "RL": (-1, 1)}
"""Order of the legs as in the paper's reward tables, and on which side each is: front is +1, left is +1."""

HIP_X, HIP_Y, THIGH_Y = 0.3285, 0.072, 0.11973
THIGH_LENGTH = CALF_LENGTH = 0.35
FOOT_RADIUS = 0.032
"""[m]."""
MOUNT = (0.15, 0.0, 0.10)
"""Mounting plane of the arm in the base's frame [m]: Jimmyangzl/b2z1_deploy, used on a real robot."""
MOUNT_MASS = 1.579
"""Plate and cables [kg]: what the paper's 6.8 kg of arm have above the 5.221 kg of Unitree's description."""

# 71.30 kg of Unitree's description without rotors, scaled by 0.8415 to the 60 kg of the data sheet with battery.
_BASE = Inertial(
    33.9498874,
    (0.0241029297, 0.00467058515, 0.0117168835),
    (0.296149468, 1.3950944, 1.43952022, 0.00356817962, -0.111659166, 0.000602484626),
)
_HIP = Inertial(  # front left, as the two below
    2.24938464,
    (-0.003841, -0.009068, 0.0),
    (0.00279283866, 0.004101824, 0.00312094755, 6.02528769e-05, -3.17253277e-07, 3.36608251e-09),
)
_THIGH = Inertial(
    3.81713757,
    (-0.006279, -0.032049, -0.057835),
    (0.0524258936, 0.051668525, 0.00690021669, 0.000738695222, -0.00306944649, 0.00702981087),
)
_CALF = Inertial(  # with the foot
    0.446005933,
    (0.00792094717, 0.0, -0.180894536),
    (0.0141199207, 0.0142389355, 0.000342859274, 0.0, 0.000190511861, 0.0),
)
_PAYLOAD_SIZE, _PAYLOAD_CENTRE = (0.28, 0.24, 0.10), (-0.13, 0.0, 0.15)
_GREY, _DARK, _RUBBER = (0.78, 0.79, 0.8, 1.0), (0.2, 0.21, 0.24, 1.0), (0.08, 0.08, 0.08, 1.0)
_RED = (0.75, 0.22, 0.17, 1.0)


def _leg_joints(leg: str) -> tuple[Joint, Joint, Joint]:
    hip_motor = {"torque_limit": 200.0, "velocity_limit": 23.0, "armature": 0.063259741}
    calf_motor = {"torque_limit": 320.0, "velocity_limit": 14.0, "armature": 0.160478022}
    friction = {"damping": 0.3, "frictionloss": 1.5}
    x, y = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    return (
        Joint(
            f"{leg}_hip_joint", ("leg", "hip"), x, (-0.87, 0.87), **hip_motor, **friction, default=0.0, kp=200.0, kd=8.0
        ),
        Joint(
            f"{leg}_thigh_joint",
            ("leg", "thigh"),
            y,
            (-0.94, 4.69),
            **hip_motor,
            **friction,
            default=0.67,
            kp=200.0,
            kd=8.0,
        ),
        Joint(
            f"{leg}_calf_joint",
            ("leg", "calf"),
            y,
            (-2.82, -0.43),
            **calf_motor,
            damping=0.3,
            frictionloss=2.5,
            default=-1.3,
            kp=300.0,
            kd=10.0,
        ),
    )


LEG_JOINTS = tuple(joint for leg in LEGS for joint in _leg_joints(leg))
SOLVER_ITERATIONS = (10, 20)
"""Most of Newton's, and of its line search. On a GPU the slowest of thousands of robots rules the time of a step."""
STAND_HEIGHT = FOOT_RADIUS + THIGH_LENGTH * float(np.cos(0.67)) + CALF_LENGTH * float(np.cos(0.67 - 1.3))
"""Height of the base's origin with the feet just touching the floor in the default pose, 0.589 [m]."""

SENSORS: dict[str, tuple[str, ...]] = {
    "base_position": ("base_position",),
    "base_quaternion": ("base_quaternion",),
    "base_linear_velocity": ("base_linear_velocity",),
    "base_angular_velocity": ("base_angular_velocity",),
    "projected_gravity": ("projected_gravity",),
    **ARM_SENSORS,
    "foot_position": tuple(f"{leg}_foot_position" for leg in LEGS),
    "foot_velocity": tuple(f"{leg}_foot_velocity" for leg in LEGS),
    "foot_force": tuple(f"{leg}_foot_force" for leg in LEGS),
    "leg_force": tuple(f"{leg}_{part}_force" for leg in LEGS for part in ("thigh", "shin")),
    "trunk_force": ("trunk_force",),
}


def b2z1(
    *,
    reinforced: bool = False,
    tool: Tool | None = None,
    payload: float = 0.0,
    terrain: Terrain | None = None,
    cone: Cone = "elliptic",
) -> Robot:
    """The B2 with a Z1: 12 leg joints in the order FR, FL, RR, RL (hip, thigh, calf each), 6 of the arm, the gripper.

    It weighs 60 + 6.8 kg. The keyframe ``"stand"`` has the feet touching the floor; under the default gains the base
    then settles 4 cm lower.

    Args:
        reinforced: Whether links 2 to 5 of the arm carry the paper's kind of reinforcement.
        tool: A :class:`~torchrl_athletic.robots.tools.Bucket` with a ball, a
            :class:`~torchrl_athletic.robots.tools.Dumbbell`, or a :class:`~torchrl_athletic.robots.tools.Handle` for a
            rope, in the gripper.
        payload: Of a box on the back, behind the arm, body ``payload`` [kg].
        terrain: Uneven ground to stand on instead of the flat floor.
        cone: Of friction, see :func:`~torchrl_athletic.robots.scene.empty_scene`.

    Raises:
        ValueError: If the payload is negative, since MuJoCo would refuse it later with less to go by.

    Source:
        Lengths, ranges, torques, speeds: unitreerobotics/unitree_ros@d6f13aa, ``b2_description`` (BSD-3). Masses:
        the same, without rotors, hips mirrored, times 60 / 71.30. Armature: rotor times gear ratio squared of Unitree's
        M107 motors, 15:1 at hip and thigh and 24:1 at the knee, which match the description's rotors, torques and
        speeds. Joint friction is an estimate. Gains: ours, near those of Portela et al. 2024. Pose: Unitree's stand.

    Example:
        >>> robot = b2z1()
        >>> round(float(robot.model().body_mass.sum()), 3)
        66.8
        >>> robot.joint_names[:3]
        ('FR_hip_joint', 'FR_thigh_joint', 'FR_calf_joint')
    """
    if not 0 <= payload < np.inf:
        raise ValueError(f"payload is {payload} kg. Give a positive mass, or 0 for none.")
    return assemble(
        "b2z1",
        (*LEG_JOINTS, *ARM_JOINTS),
        _Blueprint(reinforced, tool, payload, terrain, cone),
        {**SENSORS, **tool_sensors(tool)},
        base="base",
        keyframe="stand",
        ground=("floor",) if terrain is None else ("floor", "terrain"),
        loads=(*(("payload",) if payload else ()), *tool_bodies(tool)),
    )


@dataclass(frozen=True)
class _Blueprint:
    reinforced: bool
    tool: Tool | None
    payload: float
    terrain: Terrain | None
    cone: Cone

    def __call__(self) -> mujoco.MjSpec:
        spec = empty_scene("b2z1", self.cone)
        spec.option.iterations, spec.option.ls_iterations = SOLVER_ITERATIONS
        base = spec.worldbody.add_body(name="base", pos=[0, 0, STAND_HEIGHT])
        base.add_freejoint(name="root")
        set_inertial(base, _BASE)
        _add_trunk(spec, base)
        for leg, (front, left) in LEGS.items():
            _add_leg(spec, base, leg, front, left)
        add_arm(spec, base, MOUNT, reinforced=self.reinforced)
        mount = base.add_body(name="mount", pos=MOUNT)
        set_inertial(mount, Inertial(MOUNT_MASS, (0.0, 0.0, 0.005), (0.004, 0.004, 0.0078, 0.0, 0.0, 0.0)))
        joints = (*LEG_JOINTS, *ARM_JOINTS)
        add_motors(spec, joints)
        height = STAND_HEIGHT
        if self.payload:
            box = base.add_body(name="payload", pos=_PAYLOAD_CENTRE)
            add_box(box, "payload", (0, 0, 0), _PAYLOAD_SIZE, rgba=_RED, conaffinity=ARM_ON_TRUNK, mass=self.payload)
        if self.terrain is not None:
            add_terrain(spec, self.terrain)
            height += self.terrain.roughness[1]  # clear of every bump
        pose = [0, 0, height, 1, 0, 0, 0, *(joint.default for joint in joints)]
        add_tool(spec, self.tool, pose)
        add_keyframe(spec, "stand", pose)
        return spec


def _add_trunk(spec: mujoco.MjSpec, base: mujoco.MjsBody) -> None:
    add_box(base, "trunk", (0, 0, 0.005), (0.42, 0.29, 0.19), rgba=_GREY, contype=GROUND, conaffinity=ARM_ON_TRUNK)
    add_box(base, "chassis", (0, 0, 0.005), (0.8, 0.13, 0.13), rgba=_GREY)
    add_box(base, "head", (0.41, 0, 0.005), (0.04, 0.12, 0.14), rgba=_DARK)
    add_box(base, "tail", (-0.405, 0, 0.005), (0.025, 0.12, 0.14), rgba=_DARK)
    for leg, (front, left) in LEGS.items():
        start, end = (0.2 * front, HIP_Y * left, 0.0), (0.33 * front, HIP_Y * left, 0.0)
        add_round(base, f"{leg}_hip_motor", start, end, 0.062, rgba=_DARK)
    base.add_site(name="base", size=[0.01] * 3, group=4)
    solid = mujoco.mjtGeom.mjGEOM_BOX
    base.add_site(name="trunk", type=solid, pos=[0, 0, 0.005], size=[0.22, 0.155, 0.105], group=4)
    spec.worldbody.add_site(name="down", quat=[0, 1, 0, 0], size=[0.01] * 3, group=4)  # its z axis points down
    add_sensor(spec, "framepos", "base", "base_position")
    add_sensor(spec, "framequat", "base", "base_quaternion")
    add_sensor(spec, "velocimeter", "base", "base_linear_velocity")
    add_sensor(spec, "gyro", "base", "base_angular_velocity")
    spec.add_sensor(
        name="projected_gravity",
        type=mujoco.mjtSensor.mjSENS_FRAMEZAXIS,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname="down",
        reftype=mujoco.mjtObj.mjOBJ_SITE,
        refname="base",
    )
    add_sensor(spec, "touch", "trunk", "trunk_force")


def _add_leg(spec: mujoco.MjSpec, base: mujoco.MjsBody, leg: str, front: int, left: int) -> None:
    hip_joint, thigh_joint, calf_joint = _leg_joints(leg)
    hip_inertial = _HIP if front > 0 else _HIP.mirrored(0)
    across = [part if left > 0 else part.mirrored(1) for part in (hip_inertial, _THIGH, _CALF)]

    hip = base.add_body(name=f"{leg}_hip", pos=[HIP_X * front, HIP_Y * left, 0])
    add_joint(hip, hip_joint)
    add_round(hip, f"{leg}_hip", (0, -0.063 * left, 0), (0, 0.0535 * left, 0), 0.063, cylinder=True, rgba=_DARK)

    thigh = hip.add_body(name=f"{leg}_thigh", pos=[0, THIGH_Y * left, 0])
    add_joint(thigh, thigh_joint)
    add_round(
        thigh, f"{leg}_thigh_motor", (0, -0.099 * left, 0), (0, 0.028 * left, 0), 0.0615, cylinder=True, rgba=_DARK
    )
    add_round(thigh, f"{leg}_thigh", (-0.012, 0, -0.05), (-0.02, 0, -0.29), 0.042, rgba=_GREY, contype=GROUND)
    _add_ball(thigh, f"{leg}_knee", 0.03, -THIGH_LENGTH, _DARK)
    _add_feeler(thigh, f"{leg}_thigh", (-0.012, 0, -0.05), (0, 0, -THIGH_LENGTH), 0.055)

    calf = thigh.add_body(name=f"{leg}_calf", pos=[0, 0, -THIGH_LENGTH])
    add_joint(calf, calf_joint)
    add_round(calf, f"{leg}_calf", (0.004, 0, -0.03), (0.034, 0, -0.17), 0.018, rgba=_DARK, contype=GROUND)
    add_round(calf, f"{leg}_shin", (0.034, 0, -0.17), (0.02, 0, -0.31), 0.02, rgba=_DARK, contype=GROUND)
    _add_ball(calf, f"{leg}_foot", FOOT_RADIUS, -CALF_LENGTH, _RUBBER)
    _add_feeler(calf, f"{leg}_shin", (0.02, 0, 0), (0.02, 0, -0.288), 0.042)  # ends above where the foot touches

    for body, inertial in zip((hip, thigh, calf), across, strict=True):
        set_inertial(body, inertial)
    add_sensor(spec, "framepos", f"{leg}_foot", f"{leg}_foot_position")
    add_sensor(spec, "framelinvel", f"{leg}_foot", f"{leg}_foot_velocity")
    for part in ("foot", "thigh", "shin"):
        add_sensor(spec, "touch", f"{leg}_{part}", f"{leg}_{part}_force")


def _add_feeler(body: mujoco.MjsBody, name: str, start: Vector, end: Vector, radius: float) -> None:
    """A site around a part of a leg, whose touch sensor feels all that the part touches."""
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    body.add_site(name=name, type=capsule, fromto=[*start, *end], size=[radius, 0, 0], group=4)


def _add_ball(body: mujoco.MjsBody, name: str, radius: float, height: float, rgba: tuple[float, ...]) -> None:
    # The site is a little larger, so that a touch sensor on it feels every contact of the sphere.
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    position = [0.0, 0.0, height]
    body.add_geom(
        name=name, type=sphere, pos=position, size=[radius, 0, 0], contype=GROUND, conaffinity=0, mass=0.0, rgba=rgba
    )
    body.add_site(name=name, type=sphere, pos=position, size=[radius + 0.005] * 3, group=4)
