"""Robots whose equations of motion fit on a few lines, each with its MJCF: a slider, a pendulum, a two-link arm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, sin

GRAVITY = 9.81
"""[m/s²]"""

Dynamics = Callable[[float, float, float, float], tuple[float, float, float, float, float]]
"""(q1, q2, v1, v2) -> (M11, M12, M22, bias1, bias2), with M a + bias = torque before friction."""


@dataclass(frozen=True)
class Link:
    """One joint and the link that it moves. For a slide read kg for kg·m², N for N·m, m for rad."""

    mass: float
    """[kg]"""
    com: float
    """Distance from the joint to the centre of mass [m]."""
    inertia: float
    """About the centre of mass [kg·m²]."""
    length: float
    """Distance to the next joint, or to the tip [m]."""
    armature: float = 0.0
    """Rotor inertia seen at the joint [kg·m²]."""
    damping: float = 0.0
    """Viscous friction [N·m·s/rad]."""
    frictionloss: float = 0.0
    """Dry friction [N·m]."""
    stiffness: float = 0.0
    """Spring towards zero [N·m/rad]."""


@dataclass(frozen=True)
class Robot:
    """One or two joints, with everything that a recording session has to know. Tuples have one entry a joint."""

    name: str
    joint_names: tuple[str, ...]
    links: tuple[Link, ...]
    torque_limit: tuple[float, ...]
    """[N·m]"""
    torque_amplitude: tuple[float, ...]
    """Peak of the torques that a recording sends [N·m]: the arm stays well below the horizontal."""
    target_amplitude: tuple[float, ...]
    """Peak of the position targets that a recording sends [rad]."""
    kp: tuple[float, ...]
    """Gain of the drive's position loop [N·m/rad]."""
    kd: tuple[float, ...]
    """[N·m·s/rad]"""
    timestep: float = 0.001
    """Time step that the MJCF states [s]."""
    slide: bool = False
    """True for a joint that slides, horizontally."""

    @property
    def model_xml(self) -> str:
        """The robot as MJCF, with one motor of gear 1 a joint."""
        inner = ""
        for name, link, parent in reversed(
            list(zip(self.joint_names, self.links, (None, *self.links[:-1]), strict=True))
        ):
            inner = _body(name, link, parent.length if parent else 0.0, self, inner)
        motors = "".join(
            f'<motor name="{name}" joint="{name}" gear="1" ctrlrange="{-limit} {limit}" forcerange="{-limit} {limit}"/>'
            for name, limit in zip(self.joint_names, self.torque_limit, strict=True)
        )
        return f"""
<mujoco model="{self.name}">
  <option timestep="{self.timestep}" integrator="implicitfast" gravity="0 0 {-GRAVITY}">
    <flag contact="disable"/>
  </option>
  <worldbody>{inner}
  </worldbody>
  <actuator>{motors}</actuator>
</mujoco>"""

    @property
    def dynamics(self) -> Dynamics:
        """Closed-form equations of motion. With one joint, the second one is a unit inertia that nothing drives."""
        if self.slide:
            return _slider(self.links[0])
        return _two_links(*self.links) if len(self.links) == 2 else _one_link(self.links[0])


def slider() -> Robot:
    """A carriage of 4 kg between springs, joint ``carriage`` [m]."""
    return Robot(
        "slider",
        ("carriage",),
        (Link(4.0, 0.0, 0.01, 0.1, damping=12.0, stiffness=150.0),),
        torque_limit=(120.0,),
        torque_amplitude=(24.0,),
        target_amplitude=(0.15,),
        kp=(1500.0,),
        kd=(80.0,),
        slide=True,
    )


def pendulum() -> Robot:
    """A link of 0.7 kg on a drive, joint ``pendulum`` [rad], 0 when hanging."""
    return Robot(
        "pendulum",
        ("pendulum",),
        (Link(0.7, 0.35, 0.012, 0.5, armature=0.004, damping=0.06),),
        torque_limit=(8.0,),
        torque_amplitude=(0.9,),
        target_amplitude=(0.6,),
        kp=(25.0,),
        kd=(1.5,),
    )


def two_link_arm() -> Robot:
    """An arm in a vertical plane, joints ``shoulder`` and ``elbow`` [rad], both 0 when hanging."""
    return Robot(
        "two_link_arm",
        ("shoulder", "elbow"),
        (
            Link(1.6, 0.15, 0.014, 0.30, armature=0.02, damping=0.25),
            Link(0.9, 0.12, 0.006, 0.25, armature=0.01, damping=0.10),
        ),
        torque_limit=(20.0, 8.0),
        torque_amplitude=(2.4, 0.7),
        target_amplitude=(0.5, 0.6),
        kp=(60.0, 20.0),
        kd=(3.0, 0.8),
    )


def _slider(link: Link) -> Dynamics:
    inertia, stiffness = link.mass + link.armature, link.stiffness

    def dynamics(q1: float, q2: float, v1: float, v2: float) -> tuple[float, float, float, float, float]:
        return inertia, 0.0, 1.0, stiffness * q1, 0.0

    return dynamics


def _one_link(link: Link) -> Dynamics:
    inertia = link.inertia + link.mass * link.com**2 + link.armature
    weight, stiffness = link.mass * link.com * GRAVITY, link.stiffness

    def dynamics(q1: float, q2: float, v1: float, v2: float) -> tuple[float, float, float, float, float]:
        return inertia, 0.0, 1.0, weight * sin(q1) + stiffness * q1, 0.0

    return dynamics


def _two_links(upper: Link, lower: Link) -> Dynamics:
    """The double pendulum in relative angles; Spong, Hutchinson, Vidyasagar 2006, Robot Modeling and Control, 7.4."""
    lower_inertia = lower.inertia + lower.mass * lower.com**2
    m22 = lower_inertia + lower.armature
    m11 = upper.inertia + upper.mass * upper.com**2 + lower_inertia + lower.mass * upper.length**2 + upper.armature
    coupling = lower.mass * upper.length * lower.com
    upper_weight = (upper.mass * upper.com + lower.mass * upper.length) * GRAVITY
    lower_weight = lower.mass * lower.com * GRAVITY
    k1, k2 = upper.stiffness, lower.stiffness

    def dynamics(q1: float, q2: float, v1: float, v2: float) -> tuple[float, float, float, float, float]:
        c, h, g2 = coupling * cos(q2), coupling * sin(q2), lower_weight * sin(q1 + q2)
        bias1 = upper_weight * sin(q1) + g2 - h * v2 * (2 * v1 + v2) + k1 * q1
        return m11 + 2 * c, lower_inertia + c, m22, bias1, g2 + h * v1 * v1 + k2 * q2

    return dynamics


def _body(name: str, link: Link, below: float, robot: Robot, inner: str) -> str:
    kind = 'type="slide" axis="1 0 0"' if robot.slide else 'axis="0 -1 0"'
    i = link.inertia
    stiff = f'solreffriction="{2 * robot.timestep} 1" solimpfriction="0.9999 0.9999 0.001"'  # dry, within two steps
    geom = (
        '<geom type="box" size="0.06 0.04 0.03" rgba="0.2 0.4 0.7 1"/>'
        if robot.slide
        else f'<geom type="capsule" fromto="0 0 0 0 0 {-link.length}" size="0.015" rgba="0.2 0.4 0.7 1"/>'
    )
    return f"""
    <body name="{name}" pos="0 0 {-below}">
      <joint name="{name}" {kind} armature="{link.armature}" damping="{link.damping}" stiffness="{link.stiffness}"
             frictionloss="{link.frictionloss}" {stiff}/>
      <inertial pos="0 0 {-link.com}" mass="{link.mass}" diaginertia="{i} {i} {i}"/>
      {geom}{inner}
    </body>"""
