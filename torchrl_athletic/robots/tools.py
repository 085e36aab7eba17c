"""What the paper's robot holds: a bucket with a ball to throw, a dumbbell to snatch, or the end of a sled's rope."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from torchrl_athletic.robots.arm import ARM_ON_TRUNK, GRIP, GROUND, OBJECT, add_box, add_round, add_sensor
from torchrl_athletic.robots.inertial import Inertial, Vector, set_inertial
from torchrl_athletic.robots.robot import Robot


@dataclass(frozen=True)
class Bucket:
    """An open box in front of the jaws, and a ball that lies in it and flies freely.

    The paper's bucket is drawn but not measured: its size and mass are ours, and so is the ball's radius. The box is
    0.10 x 0.10 m inside and 0.08 m deep. Body and site ``bucket``; body, free joint and site ``ball``.
    """

    opening: Vector = (0.0, 0.0, 1.0)
    """Where it opens to, in ``link06``, of any length [1]. Up (0, 0, 1) holds the ball in the default pose; down
    (0, 0, -1) holds it with the arm stretched backwards, whence an overhead swing throws forward."""
    mass: float = 0.2
    """Mass of the empty bucket [kg]."""
    ball_mass: float = 0.1
    """[kg]. Paper, section Ball throwing."""
    ball_radius: float = 0.035
    """[m]."""

    @property
    def rim(self) -> float:
        """How far it is above the centre of a ball that lies on the bottom [m]."""
        return _DEPTH - self.ball_radius

    def __post_init__(self) -> None:
        if not np.linalg.norm(self.opening) > 0:
            raise ValueError(f"opening is {self.opening}, which points nowhere. Give a direction, such as (0, 0, 1).")
        _check_positive(mass=self.mass, ball_mass=self.ball_mass, ball_radius=self.ball_radius)
        if self.ball_radius >= 0.05:
            raise ValueError(
                f"ball_radius is {self.ball_radius} m, but the bucket is 0.10 m wide inside and the ball would start "
                "within its walls. Take less than 0.05 m."
            )


@dataclass(frozen=True)
class Dumbbell:
    """A bar across the jaws with a disc at each end, strapped to the gripper, whose mass it adds to.

    Body ``dumbbell``. As in the paper it collides with nothing. There it weighs 0 to 10 kg: randomise this body's mass.
    """

    mass: float = 5.0
    """[kg]."""

    def __post_init__(self) -> None:
        _check_positive(mass=self.mass)


@dataclass(frozen=True)
class Handle:
    """A place between the jaws to tie a rope to, which :class:`~torchrl_athletic.transforms.SledRope` pulls at.

    Body and site ``handle`` at the grip, and sensors of its place and velocity in the world. The body weighs a gram and
    has its centre of mass there, so that a force that MuJoCo applies to the body acts at the grip; it touches nothing.
    """


Tool = Bucket | Dumbbell | Handle
EMPTY_BUCKET_SENSORS: dict[str, tuple[str, ...]] = {
    name: (name,) for name in ("bucket_position", "bucket_linear_velocity", "bucket_axis")
}
BUCKET_SENSORS: dict[str, tuple[str, ...]] = {
    **EMPTY_BUCKET_SENSORS,
    "ball_position": ("ball_position",),
    "ball_linear_velocity": ("ball_linear_velocity",),
}
HANDLE_SENSORS: dict[str, tuple[str, ...]] = {name: (name,) for name in ("handle_position", "handle_linear_velocity")}
_RED, _ORANGE, _IRON = (0.75, 0.22, 0.17, 0.55), (0.95, 0.55, 0.1, 1.0), (0.25, 0.26, 0.28, 1.0)
_CENTRE = (0.265, 0.0, 0.0)  # m, in link06: the near wall stands at the tips of the jaws
_WIDTH, _DEPTH, _WALL = 0.10, 0.08, 0.008  # m, inside


def tool_sensors(tool: Tool | None) -> dict[str, tuple[str, ...]]:
    """Observation keys that a tool adds."""
    if isinstance(tool, Bucket):
        return BUCKET_SENSORS
    return HANDLE_SENSORS if isinstance(tool, Handle) else {}


def tool_bodies(tool: Tool | None) -> tuple[str, ...]:
    """Names of the bodies that a tool adds."""
    if isinstance(tool, Bucket):
        return "bucket", "ball"
    if isinstance(tool, Dumbbell):
        return ("dumbbell",)
    return ("handle",) if isinstance(tool, Handle) else ()


def add_tool(spec: mujoco.MjSpec, tool: Tool | None, qpos: Sequence[float]) -> None:
    """Put a tool into the gripper. A ball comes last in the world, so that the robot's own ``qpos`` stays in front.

    Args:
        spec: With the whole robot in it.
        tool: None for empty jaws.
        qpos: The robot's pose in which the ball lies in its bucket.
    """
    if isinstance(tool, Bucket):
        _add_bucket(spec, tool)
        _add_ball(spec, tool, qpos)
    elif isinstance(tool, Dumbbell):
        _add_dumbbell(spec, tool)
    elif isinstance(tool, Handle):
        _add_handle(spec)


def with_bucket(robot: Robot, bucket: Bucket) -> Robot:
    """A robot that holds a bucket whose ball is fixed in it and weighs down the arm: no body flies, nothing collides.

    Where the ball would go is then for :mod:`torchrl_athletic.functional.ball` to tell. Sensors ``bucket_position`` and
    ``bucket_linear_velocity`` are those of the place where the ball lies, ``bucket_axis`` is where the bucket opens to.

    Args:
        robot: With empty jaws and a body ``link06``: a Z1, or one identified from it.
        bucket: What to hold.

    Example:
        >>> from torchrl_athletic.robots.z1 import z1
        >>> robot = with_bucket(z1(), Bucket())
        >>> round(float(robot.model().body("bucket").mass[0]), 3)
        0.3
    """
    sensors = {**robot.sensors, **EMPTY_BUCKET_SENSORS}
    build = _WithBucket(robot.build, bucket)
    return replace(robot, build=build, sensors=sensors, loads=(*robot.loads, "bucket"))


@dataclass(frozen=True)
class _WithBucket:
    build: Callable[[], mujoco.MjSpec]
    bucket: Bucket

    def __call__(self) -> mujoco.MjSpec:
        spec = self.build()
        _add_bucket(spec, self.bucket)
        body = spec.body("bucket")
        body.add_geom(
            name="ball",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=spec.site("bucket").pos,
            size=[self.bucket.ball_radius, 0, 0],
            mass=self.bucket.ball_mass,
            contype=0,
            conaffinity=0,
            group=4,  # not drawn: where the ball is, only its flight knows
            rgba=_ORANGE,
        )
        return spec


def _add_bucket(spec: mujoco.MjSpec, bucket: Bucket) -> None:
    body = spec.body("link06").add_body(name="bucket", pos=_CENTRE, quat=_turn_up_to(bucket.opening))
    outer, wall_height = _WIDTH + 2 * _WALL, _DEPTH + _WALL
    reach = 0.5 * (_WIDTH + _WALL)
    plates = {
        "bottom": ((0.0, 0.0, -0.5 * wall_height), (outer, outer, _WALL)),
        "front": ((reach, 0.0, 0.0), (_WALL, outer, _DEPTH)),
        "back": ((-reach, 0.0, 0.0), (_WALL, outer, _DEPTH)),
        "left": ((0.0, reach, 0.0), (_WIDTH, _WALL, _DEPTH)),
        "right": ((0.0, -reach, 0.0), (_WIDTH, _WALL, _DEPTH)),
    }
    volume = sum(np.prod(size) for _, size in plates.values())
    for name, (centre, size) in plates.items():
        add_box(
            body, f"bucket_{name}", centre, size, rgba=_RED, contype=OBJECT | GROUND | ARM_ON_TRUNK,
            mass=bucket.mass * float(np.prod(size) / volume),
        )  # fmt: skip
    # where the ball's centre lies
    body.add_site(name="bucket", pos=[0, 0, 0.5 * _DEPTH - bucket.rim], size=[0.005] * 3, group=4)
    add_sensor(spec, "framepos", "bucket", "bucket_position")
    add_sensor(spec, "framelinvel", "bucket", "bucket_linear_velocity")
    add_sensor(spec, "framezaxis", "bucket", "bucket_axis")


def _add_ball(spec: mujoco.MjSpec, bucket: Bucket, qpos: Sequence[float]) -> None:
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    body = spec.worldbody.add_body(name="ball", pos=data.site("bucket").xpos)
    body.add_freejoint(name="ball")
    body.add_geom(
        name="ball",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[bucket.ball_radius, 0, 0],
        mass=bucket.ball_mass,
        contype=GROUND,
        conaffinity=OBJECT,
        rgba=_ORANGE,
    )
    body.add_site(name="ball", size=[0.005] * 3, group=4)
    add_sensor(spec, "framepos", "ball", "ball_position")
    add_sensor(spec, "framelinvel", "ball", "ball_linear_velocity")


def _add_dumbbell(spec: mujoco.MjSpec, dumbbell: Dumbbell) -> None:
    body = spec.body("link06").add_body(name="dumbbell", pos=GRIP)
    share = {"bar": 0.1, "left": 0.45, "right": 0.45}  # of the mass
    ends = {"bar": (-0.06, 0.06, 0.014), "left": (0.06, 0.11, 0.055), "right": (-0.11, -0.06, 0.055)}
    for name, (start, end, radius) in ends.items():
        add_round(
            body, f"dumbbell_{name}", (0, start, 0), (0, end, 0), radius, cylinder=True, rgba=_IRON,
            mass=share[name] * dumbbell.mass,
        )  # fmt: skip


def _add_handle(spec: mujoco.MjSpec) -> None:
    body = spec.body("link06").add_body(name="handle", pos=GRIP)
    set_inertial(body, Inertial(1e-3, (0.0, 0.0, 0.0), (4e-8, 4e-8, 4e-8, 0.0, 0.0, 0.0)))  # a bead of 1 cm radius
    body.add_site(name="handle", size=[0.01] * 3, group=4)
    add_sensor(spec, "framepos", "handle", "handle_position")
    add_sensor(spec, "framelinvel", "handle", "handle_linear_velocity")


def _turn_up_to(direction: Vector) -> list[float]:
    """Quaternion of the shortest turn that takes z to a direction."""
    x, y, z = np.array(direction) / np.linalg.norm(direction)
    if z < -1 + 1e-9:
        return [0.0, 1.0, 0.0, 0.0]
    quaternion = np.array([1 + z, -y, x, 0.0])
    return (quaternion / np.linalg.norm(quaternion)).tolist()


def _check_positive(**values: float) -> None:
    for name, value in values.items():
        if not 0 < value < np.inf:
            raise ValueError(
                f"{name} is {value}, and MuJoCo cannot simulate a body without it. Give a positive number, or leave "
                "the tool out."
            )
