"""What the rest of the library needs to know of a robot, next to the model it was built with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import mujoco


@dataclass(frozen=True)
class Joint:
    """One actuated hinge: what its data sheet says and how this library drives it."""

    name: str
    groups: tuple[str, ...]
    """Groups of :attr:`Robot.joint_groups` that it belongs to."""
    axis: tuple[float, float, float]
    """In the body's frame [1]."""
    position_limit: tuple[float, float]
    """[rad]."""
    torque_limit: float
    """[N·m]."""
    velocity_limit: float
    """[rad/s]."""
    armature: float
    """Inertia of rotor and gear seen at the joint [kg·m²]."""
    damping: float
    """Viscous friction [N·m·s/rad]."""
    frictionloss: float
    """Coulomb friction [N·m]."""
    default: float
    """[rad]."""
    kp: float
    """[N·m/rad]."""
    kd: float
    """[N·m·s/rad]."""


@dataclass(frozen=True)
class Robot:
    """A robot as data: names, limits, gains, and a recipe for its MuJoCo model.

    Joint order is the order of the model's actuators, which are torque motors: ``ctrl`` is the joint torque [N·m].
    J joints. Everything is a tuple of plain floats, so that a robot can be sent to another process.
    """

    name: str
    joint_names: tuple[str, ...]
    """Length J."""
    joint_groups: Mapping[str, tuple[int, ...]]
    """``"arm"``, ``"gripper"`` and, with legs, ``"leg"``, ``"hip"``, ``"thigh"``, ``"calf"``: indices of joints."""
    default_pose: tuple[float, ...]
    """Joint positions of the keyframe and of the action zero [rad]. Length J."""
    kp: tuple[float, ...]
    """Proportional gains [N·m/rad]. Length J."""
    kd: tuple[float, ...]
    """Derivative gains [N·m·s/rad]. Length J."""
    torque_limit: tuple[float, ...]
    """Stall torques [N·m]. Length J."""
    velocity_limit: tuple[float, ...]
    """Speeds at which no torque is left [rad/s]. Length J."""
    position_limit: tuple[tuple[float, float], ...]
    """Ranges of the joints [rad]. Length J."""
    base: str | None
    """Name of the body with the free joint; None if the robot is bolted to the world."""
    sensors: Mapping[str, tuple[str, ...]]
    """Observation key -> MJCF sensors: several vectors are stacked on a new dim, several scalars are one vector."""
    build: Callable[[], mujoco.MjSpec] = field(repr=False)
    """Makes a new spec, the same each time. It can be pickled and compared."""
    keyframe: str = "stand"
    """Name of the keyframe that holds the default state, at rest."""
    ground: tuple[str, ...] = ("floor",)
    """Names of the geoms to stand on, whose friction and softness rule in every contact with them."""
    loads: tuple[str, ...] = ()
    """Names of bodies that are no part of it: the tool in its hand, what lies in that, a payload."""

    def spec(self) -> mujoco.MjSpec:
        """The robot's description, new and yours to edit."""
        return self.build()

    def model(self) -> mujoco.MjModel:
        """The robot's compiled model."""
        return self.build().compile()


def with_options(robot: Robot, **options: float) -> Robot:
    """A robot in another simulation: of finer steps, or a solver that goes on for longer.

    Args:
        robot: As it is.
        options: Of MuJoCo's ``mjOption``: ``timestep`` [s], ``iterations``, ``ls_iterations``...

    Raises:
        ValueError: If MuJoCo has no such option, or time would stand still.

    Example:
        >>> from torchrl_athletic.robots import z1
        >>> with_options(z1(), timestep=0.001).model().opt.timestep
        0.001
    """
    known = vars(mujoco.MjOption)
    if unknown := [name for name in options if name not in known or name.startswith("_")]:
        raise ValueError(f"MuJoCo has no option {unknown[0]!r}. Give one of mjOption: timestep, iterations, cone...")
    if not options.get("timestep", 1.0) > 0:
        raise ValueError(f"timestep is {options['timestep']} s, and time would stand still. Give more than 0.")
    return replace(robot, build=_WithOptions(robot.build, tuple(options.items())))


@dataclass(frozen=True)
class _WithOptions:
    build: Callable[[], mujoco.MjSpec]
    options: tuple[tuple[str, float], ...]

    def __call__(self) -> mujoco.MjSpec:
        spec = self.build()
        for name, value in self.options:
            setattr(spec.option, name, value)
        return spec


def assemble(
    name: str,
    joints: tuple[Joint, ...],
    build: Callable[[], mujoco.MjSpec],
    sensors: Mapping[str, tuple[str, ...]],
    *,
    base: str | None,
    keyframe: str,
    ground: tuple[str, ...] = ("floor",),
    loads: tuple[str, ...] = (),
) -> Robot:
    """Turn a table of joints into the columns of a :class:`Robot`."""
    groups: dict[str, tuple[int, ...]] = {}
    for index, joint in enumerate(joints):
        for group in joint.groups:
            groups[group] = (*groups.get(group, ()), index)
    return Robot(
        name=name,
        joint_names=tuple(joint.name for joint in joints),
        joint_groups=groups,
        default_pose=tuple(joint.default for joint in joints),
        kp=tuple(joint.kp for joint in joints),
        kd=tuple(joint.kd for joint in joints),
        torque_limit=tuple(joint.torque_limit for joint in joints),
        velocity_limit=tuple(joint.velocity_limit for joint in joints),
        position_limit=tuple(joint.position_limit for joint in joints),
        base=base,
        sensors=dict(sensors),
        build=build,
        keyframe=keyframe,
        ground=ground,
        loads=loads,
    )
