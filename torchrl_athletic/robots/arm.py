"""The Unitree Z1 with its gripper, for a table and for the back of a B2.

Frames are those of Unitree's description: ``link00`` stands on its mounting plane, x forward, z up, and all frames are
parallel at zero, where the arm is folded: the upper arm points back and the forearm lies on it. Positive ``joint2``
raises the upper arm forward, negative ``joint3`` unfolds the elbow. Three sites on ``link06``: ``flange``,
``end_effector`` between the jaws' pads, and ``rope``, where a sled is tied.

Sources:
    Masses, lengths, ranges, torques, speeds, friction: unitreerobotics/unitree_ros@d6f13aa, ``robots/z1_description``
    (BSD-3). Torques are those of the description, 60 N·m at ``joint2`` and 30 elsewhere; the Pro's brochure promises a
    tenth more. 20 N·m at the gripper: unitreerobotics/z1_sdk@f1af2b4. Gains: Portela et al. 2024, Improbable-AI/
    learning-compliance, used on a real Z1; 30 and 1 at the gripper are ours. Armature is an estimate: a frameless motor
    of 65 mm and a wave generator, 1.2e-5 kg·m², behind 50:1; ``joint2`` has two motors. Between 0.01 and 0.07 is
    plausible. Pose: ``forward`` of Unitree's controller.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from torchrl_athletic.robots.inertial import Inertial, Vector, box, combine, set_inertial
from torchrl_athletic.robots.robot import Joint

GROUND, ARM_ON_TRUNK, OBJECT = 1, 4, 8
"""Contact bits: what meets the ground, the arm's parts that meet the trunk, what meets a thrown object."""

SHOULDER_HEIGHT = 0.1035
"""Axis of ``joint2`` above the mounting plane [m]."""
GRIP = (0.186, 0.0, 0.0)
"""Point between the pads of the jaws, in ``link06`` [m]."""
MOST_FORCE = 5000.0
"""Range of a sensor of touch, 7.6 times the weight of B2 and Z1 [N]: fewer than 1 in 1,000 readings of a foot are
above. A foot that hits rough ground at more than 3 m/s sinks in by more than its radius; then MuJoCo wedges it between
the walls of the field's prisms with hundreds of kN. These forces cancel, but the sensor adds them up."""

_GREY, _DARK, _STEEL = (0.75, 0.76, 0.78, 1.0), (0.16, 0.17, 0.19, 1.0), (0.55, 0.6, 0.68, 1.0)


def _joint(
    name: str,
    axis: Vector,
    position_limit: tuple[float, float],
    default: float,
    *,
    motors: int = 1,
    group: str = "arm",
    torque_limit: float = 30.0,
    kp: float = 64.0,
    kd: float = 1.5,
) -> Joint:
    return Joint(
        name,
        (group,),
        axis,
        position_limit,
        torque_limit=motors * torque_limit,
        velocity_limit=3.1415,
        armature=0.03 * motors,
        damping=1.0 * motors,
        frictionloss=1.0 * motors,
        default=default,
        kp=motors * kp,
        kd=motors * kd,
    )


ARM_JOINTS = (
    _joint("joint1", (0.0, 0.0, 1.0), (-2.6179939, 2.6179939), 0.0),
    _joint("joint2", (0.0, 1.0, 0.0), (0.0, 2.9670597), 1.5, motors=2),
    _joint("joint3", (0.0, 1.0, 0.0), (-2.8797933, 0.0), -1.0),
    _joint("joint4", (0.0, 1.0, 0.0), (-1.5184364, 1.5184364), -0.54),
    _joint("joint5", (0.0, 0.0, 1.0), (-1.3439035, 1.3439035), 0.0),
    _joint("joint6", (1.0, 0.0, 0.0), (-2.7925268, 2.7925268), 0.0),
    _joint(
        "jointGripper", (0.0, 1.0, 0.0), (-1.5707963, 0.0), 0.0, group="gripper", torque_limit=20.0, kp=30.0, kd=1.0
    ),
)
"""Joints from the base to the gripper, which is closed at 0 and open at -1.57."""

LINKS: dict[str, tuple[Vector, Inertial]] = {
    "link00": (
        (0.0, 0.0, 0.0),
        Inertial(
            0.47247481,
            (-0.00334984, -0.00013615, 0.02495843),
            (0.00037937, 0.00041521, 0.00053066, -3.5e-07, -1.037e-05, -9.9e-07),
        ),
    ),
    "link01": (
        (0.0, 0.0, 0.0585),
        Inertial(
            0.67332551,
            (2.47e-06, -0.00025198, 0.02317169),
            (0.00128328, 0.00071931, 0.00083936, -6e-08, -4e-07, 5e-07),
        ),
    ),
    "link02": (
        (0.0, 0.0, 0.045),
        Inertial(
            1.19132258,
            (-0.11012601, 0.00240029, 0.00158266),
            (0.00102138, 0.02429457, 0.02466114, 0.00062358, 5.13e-06, -2.1e-06),
        ),
    ),
    "link03": (
        (-0.35, 0.0, 0.0),
        Inertial(
            0.83940874,
            (0.10609208, -0.00541815, 0.03476383),
            (0.00108061, 0.00954238, 0.00886621, -8.669e-05, -0.00208102, -1.332e-05),
        ),
    ),
    "link04": (
        (0.218, 0.0, 0.057),
        Inertial(
            0.56404563,
            (0.04366681, 0.00364738, -0.00170192),
            (0.00031576, 0.00092996, 0.00097912, 8.13e-05, 4.091e-05, -5.96e-06),
        ),
    ),
    "link05": (
        (0.07, 0.0, 0.0),
        Inertial(
            0.38938492,
            (0.03121533, 0.0, 0.00646316),
            (0.00017605, 0.00055896, 0.0005386, 4e-07, 5.689e-05, -1.3e-07),
        ),
    ),
    # with the gripper's fixed half
    "link06": (
        (0.0492, 0.0, 0.0),
        combine(
            Inertial(
                0.28875807,
                (0.0241569, -0.00017355, -0.00143876),
                (0.00018328, 0.0001475, 0.0001468, 1.22e-06, 5.4e-07, 8e-08),
            ),
            Inertial(
                0.52603655,
                (0.051 + 0.04764427, -0.00035819, -0.00249162),
                (0.00038683, 0.00068614, 0.00066293, -3.59e-06, 7.662e-05, 2.09e-06),
            ),
        ),
    ),
    "gripperMover": (
        (0.1, 0.0, 0.0),
        Inertial(
            0.27621302,
            (0.01320633, 0.00476708, 0.00380534),
            (0.00017716, 0.00026787, 0.00035728, 1.683e-05, -1.786e-05, 2.62e-06),
        ),
    ),
}
"""Position in the parent's frame [m] and inertia of each body, from the base to the moving jaw."""


@dataclass(frozen=True)
class Brace:
    """A stiffening part bolted to a link, a box of aluminium that may be a tube."""

    mass: float
    """[kg]."""
    size: Vector
    """Edge lengths [m]."""
    centre: Vector
    """In the link's frame [m]."""
    hollow: Vector = (0.0, 0.0, 0.0)
    """Edge lengths of the hole [m]."""

    def inertial(self) -> Inertial:
        return box(self.mass, self.size, self.centre, self.hollow)


BRACES: dict[str, tuple[Brace, ...]] = {
    # 64 x 64 x 2 mm square tube around the upper arm, 2700 kg/m³
    "link02": (Brace(0.321, (0.24, 0.064, 0.064), (-0.175, 0.0, 0.0), hollow=(0.24, 0.06, 0.06)),),
    # a 4 mm plate with an idler bearing of 40 g, on the side across from the motor it supports
    "link03": (
        Brace(0.065, (0.15, 0.004, 0.04), (0.13, -0.045, 0.045)),
        Brace(0.04, (0.03, 0.01, 0.03), (0, -0.04, 0)),
    ),
    "link04": (
        Brace(0.048, (0.11, 0.004, 0.04), (0.035, -0.042, 0.0)),
        Brace(0.04, (0.03, 0.01, 0.03), (0, -0.038, 0)),
    ),
    "link05": (Brace(0.03, (0.07, 0.04, 0.004), (0.02, 0.0, -0.04)), Brace(0.04, (0.03, 0.03, 0.01), (0, 0, -0.036))),
}
"""The paper reinforced links 2 to 5 (section Arm Modifications) but prints no figures: these are ours, of its kind."""

ARM_SENSORS: dict[str, tuple[str, ...]] = {
    "end_effector_position": ("end_effector_position",),
    "end_effector_quaternion": ("end_effector_quaternion",),
    "end_effector_linear_velocity": ("end_effector_linear_velocity",),
    "end_effector_angular_velocity": ("end_effector_angular_velocity",),
    "arm_force": ("elbow_force", "wrist_force", "gripper_force"),
    "hand_force": ("hand_force",),
}


def add_arm(spec: mujoco.MjSpec, parent: mujoco.MjsBody, position: Vector, *, reinforced: bool = False) -> None:
    """Mount a Z1 on a body, level and facing forward, with its sensors but without its motors.

    Args:
        spec: To which ``parent`` belongs.
        parent: The body under it.
        position: Of the mounting plane's centre in the parent's frame [m].
        reinforced: Whether links 2 to 5 carry :data:`BRACES`.
    """
    joints = dict(zip(list(LINKS)[1:], ARM_JOINTS, strict=True))
    body = parent
    for name, (offset, inertial) in LINKS.items():
        braces = BRACES.get(name, ()) if reinforced else ()
        body = body.add_body(name=name, pos=position if name == "link00" else offset)
        set_inertial(body, combine(inertial, *(brace.inertial() for brace in braces)))
        if name in joints:
            add_joint(body, joints[name])
        for number, brace in enumerate(braces):
            add_box(body, f"{name}_brace{number}", brace.centre, brace.size, rgba=_STEEL)
    _add_shapes(spec)
    _add_sensors(spec)


def add_joint(body: mujoco.MjsBody, joint: Joint) -> None:
    """Hang a body on its joint."""
    body.add_joint(
        name=joint.name,
        axis=joint.axis,
        range=joint.position_limit,
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        armature=joint.armature,
        damping=joint.damping,
        frictionloss=joint.frictionloss,
    )


def add_motors(spec: mujoco.MjSpec, joints: tuple[Joint, ...]) -> None:
    """One torque motor of gear 1 a joint, in this order, within the joint's torque limit."""
    for joint in joints:
        limit = (-joint.torque_limit, joint.torque_limit)
        motor = spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrlrange=limit, forcerange=limit
        )
        motor.set_to_motor()
        motor.ctrllimited = motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE


def add_sensor(spec: mujoco.MjSpec, kind: str, site: str, name: str) -> None:
    """Put a sensor on a site: ``"framepos"``, ``"touch"`` and so on. One of touch reads :data:`MOST_FORCE` at most."""
    spec.add_sensor(
        name=name,
        type=getattr(mujoco.mjtSensor, f"mjSENS_{kind.upper()}"),
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname=site,
        cutoff=MOST_FORCE if kind == "touch" else 0.0,
    )


def add_box(
    body: mujoco.MjsBody,
    name: str,
    centre: Vector,
    size: Vector,
    *,
    rgba: tuple[float, ...] = _GREY,
    contype: int = 0,
    conaffinity: int = 0,
    mass: float = 0.0,
) -> None:
    """A box by its edge lengths [m]; contacts only where asked for."""
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=centre,
        size=[0.5 * edge for edge in size],
        rgba=rgba,
        contype=contype,
        conaffinity=conaffinity,
        mass=mass,
    )


def add_round(
    body: mujoco.MjsBody,
    name: str,
    start: Vector,
    end: Vector,
    radius: float,
    *,
    cylinder: bool = False,
    rgba: tuple[float, ...] = _GREY,
    contype: int = 0,
    mass: float = 0.0,
    group: int = 0,
) -> None:
    """A capsule or a cylinder from point to point [m]; contacts only where asked for, hidden in groups from 3 on."""
    kind = mujoco.mjtGeom.mjGEOM_CYLINDER if cylinder else mujoco.mjtGeom.mjGEOM_CAPSULE
    body.add_geom(
        name=name,
        type=kind,
        fromto=[*start, *end],
        size=[radius, 0, 0],
        rgba=rgba,
        contype=contype,
        conaffinity=0,
        mass=mass,
        group=group,
    )


def _add_shapes(spec: mujoco.MjSpec) -> None:
    touching = GROUND | ARM_ON_TRUNK
    link = spec.body
    add_round(link("link00"), "z1_base", (0, 0, 0), (0, 0, 0.0585), 0.053, cylinder=True, rgba=_DARK)
    add_round(link("link01"), "z1_shoulder", (0, -0.066, 0.045), (0, 0.066, 0.045), 0.033, cylinder=True)
    add_round(link("link02"), "z1_upper_arm", (-0.03, 0, 0), (-0.32, 0, 0), 0.03)
    add_round(
        link("link02"),
        "z1_elbow",
        (-0.35, -0.015, 0),
        (-0.35, 0.015, 0),
        0.0325,
        rgba=_DARK,
        contype=touching,
    )
    add_round(link("link03"), "z1_forearm_root", (0.02, 0, 0.03), (0.06, 0, 0.055), 0.028)
    add_round(link("link03"), "z1_forearm", (0.06, 0, 0.055), (0.218, 0, 0.057), 0.03)
    add_round(link("link04"), "z1_wrist", (0, 0, 0), (0.07, 0, 0), 0.0325, rgba=_DARK, contype=touching)
    add_round(link("link05"), "z1_wrist_yaw", (0, 0, 0), (0.02, 0, 0), 0.0325)
    add_round(link("link06"), "z1_flange", (0, 0, 0), (0.051, 0, 0), 0.0325, cylinder=True)
    add_box(link("link06"), "z1_gripper", (0.082, 0, 0), (0.07, 0.076, 0.066), rgba=_DARK, contype=touching)
    add_box(link("link06"), "z1_jaw", (0.16, 0, -0.0205), (0.08, 0.06, 0.023), contype=OBJECT)
    add_box(link("gripperMover"), "z1_moving_jaw", (0.055, 0, 0.004), (0.09, 0.06, 0.026), contype=OBJECT)
    # what meets the ground in place of the two closed jaws: one shape, since each costs a search for contacts
    add_round(link("link06"), "z1_hand", (0.13, 0, -0.007), (0.172, 0, -0.007), 0.028, contype=GROUND, group=4)


def _add_sensors(spec: mujoco.MjSpec) -> None:
    link06 = spec.body("link06")
    for name, position in {"flange": (0.051, 0.0, 0.0), "end_effector": GRIP, "rope": GRIP}.items():
        link06.add_site(name=name, pos=position, size=[0.008] * 3, group=4)
    add_sensor(spec, "framepos", "end_effector", "end_effector_position")
    add_sensor(spec, "framequat", "end_effector", "end_effector_quaternion")
    add_sensor(spec, "framelinvel", "end_effector", "end_effector_linear_velocity")
    add_sensor(spec, "frameangvel", "end_effector", "end_effector_angular_velocity")
    # A touch sensor adds up the normal forces on its body within its site: the sites enclose the shapes.
    sphere, solid = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_BOX
    spec.body("link02").add_site(name="elbow", type=sphere, pos=[-0.35, 0, 0], size=[0.06] * 3, group=4)
    spec.body("link04").add_site(name="wrist", type=solid, pos=[0.035, 0, 0], size=[0.075, 0.04, 0.04], group=4)
    link06.add_site(name="gripper", type=solid, pos=[0.082, 0, 0], size=[0.042, 0.045, 0.04], group=4)
    link06.add_site(name="hand", type=solid, pos=[0.125, 0, 0], size=[0.085, 0.045, 0.045], group=4)
    for name in ("elbow", "wrist", "gripper", "hand"):
        add_sensor(spec, "touch", name, f"{name}_force")
