"""Tables of a motion: joints by interpolation between key poses, the hand's path by forward kinematics.

Source:
    Fey et al. 2025, section II-C: references hand-designed "through joint interpolation and forward kinematics".
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_athletic.functional import rotations
from torchrl_athletic.functional.commands import from_roll_pitch_yaw, pose_to_frame
from torchrl_athletic.functional.reference import PEAK_SPEED, interpolate_poses
from torchrl_athletic.robots.motion import KeyPose, Motion, PhaseMotion
from torchrl_athletic.robots.robot import Robot

JUMP = 0.01
"""Most by which a phase may start off where the one before ends [rad, m, m/s, rad/s]."""
CLEARANCE = 0.02
"""Least height over the ground of the end effector and of what it holds [m]."""
DT = 0.02
"""Duration of a policy's step, and so of a table's rows [s]."""


def motion_tables(motion: Motion, robot: Robot, dt: float = DT, frame_height: float = 0.5) -> dict[str, list[Tensor]]:
    """Tables of a motion, as :class:`~torchrl_athletic.transforms.ReferenceTrajectory` takes them.

    The commands' frame follows the base's place and heading at ``frame_height`` over flat ground, and stays upright
    (:func:`~torchrl_athletic.functional.commands.pose_to_frame`). Of a robot that is bolted down it stands over the
    world's origin. Legs stay in the default pose unless their joints are named: how they bring the base to its height
    and pitch is up to the controller.

    Args:
        motion: Is checked by :func:`check_motion`.
        robot: Whose motion it is. J joints.
        dt: Of the tables' rows [s].
        frame_height: Of the commands' frame over the ground [m].

    Returns:
        Of each phase a table with T_r rows, from its beginning to its end, by name:

        - ``joint_position``: [rad]. Shape (T_r, J).
        - ``end_effector_command``: position [m] and the first two columns of the rotation matrix, in the commands'
          frame. Shape (T_r, 9).
        - ``base_velocity_command``: forward, left [m/s], counter-clockwise [rad/s]. Shape (T_r, 3).

    Raises:
        ValueError: As of :func:`check_motion`, and if time would stand still.

    Example:
        >>> from torchrl_athletic.robots import b2z1, read_motion
        >>> tables = motion_tables(read_motion("throw"), b2z1())
        >>> [tuple(table.shape) for table in tables["joint_position"]]
        [(126, 19), (51, 19), (76, 19)]
        >>> tables["end_effector_command"][0][0, :3].round(decimals=2).tolist()  # where the hand is by default
        [0.6499999761581421, 0.0, 0.6000000238418579]
    """
    if not 0 < dt < math.inf:
        raise ValueError(f"dt is {dt} s, needed is more than 0: time would stand still.")
    check_motion(motion, robot)
    return unchecked_tables(motion, PosedRobot(robot), dt, frame_height)


def check_motion(motion: Motion, robot: Robot) -> None:
    """Refuse a motion that the robot cannot make.

    Joints must exist, stay within their position limits, and move within their velocity limits. The first phase must
    start at the default pose, and each other one where the one before ends, within :data:`JUMP`. The end effector and
    what it holds must stay :data:`CLEARANCE` above flat ground. Collisions of the robot with itself are not looked for.

    Args:
        motion: To check.
        robot: Gives the limits and the kinematics.

    Raises:
        ValueError: Names the motion, the phase, the joint, the time, the value, the limit and the mend.

    Example:
        >>> from torchrl_athletic.robots import z1
        >>> hasty = PhaseMotion("nod", (KeyPose(0.0), KeyPose(0.1, {"joint2": 2.5})))
        >>> check_motion(Motion("greet", (hasty,)), z1())
        Traceback (most recent call last):
        ValueError: greet: phase 'nod': joint2 moves at 18.75 rad/s at 0.05 s, but its limit is 3.14 rad/s. Give it at
        least 0.597 s between these two poses, or a shorter way.
    """
    check_names(motion, robot)
    _check_limits(motion, robot)
    _check_speeds(motion, robot)
    posed = PosedRobot(robot)
    _check_joins(motion, posed)
    _check_ground(motion, posed)


class PosedRobot:
    """A robot's model, put by hand into one state after another. Its ground is flat and at height 0.

    Args:
        robot: With sensors of its end effector.

    Raises:
        ValueError: If nothing tells where the end effector is.

    Example:
        >>> from torchrl_athletic.robots import b2z1
        >>> round(PosedRobot(b2z1()).stand, 3)
        0.589
    """

    stand: float
    """Height of the base over the ground on which the robot stands in its default pose [m]; 0 without a base."""

    def __init__(self, robot: Robot) -> None:
        if missing := [key for key in _HAND_SENSORS if key not in robot.sensors]:
            raise ValueError(
                f"robot {robot.name!r} has no {missing[0]!r} among its sensors, so nothing tells where its hand is. "
                "Add framepos and framequat of the hand under these names."
            )
        self.robot, self.model = robot, robot.model()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, self.model.key(robot.keyframe).id)
        mujoco.mj_kinematics(self.model, self.data)
        joints = [self.model.joint(name) for name in robot.joint_names]
        self.columns = np.array([joint.qposadr[0] for joint in joints])
        self._root = self.model.body_rootid[self.model.jnt_bodyid[joints[0].id]]
        self._base = None if robot.base is None else int(self.model.jnt_qposadr[self.model.body(robot.base).jntadr[0]])
        solid = [geom for geom in self._geoms() if self.model.geom_contype[geom]]
        feet = min((self._lowest_point(geom) for geom in solid), default=0.0)
        self.stand = 0.0 if self._base is None else float(self.data.qpos[self._base + 2]) - feet

    def rows(self, phase: PhaseMotion) -> Tensor:
        """Key poses as joints [rad], base height [m] and pitch [rad], velocity command. Shape (P, J + 5)."""
        rows = [
            (
                *(joint_position(pose, self.robot, joint) for joint in range(len(self.robot.joint_names))),
                self.stand if pose.base_height is None else pose.base_height,
                pose.base_pitch,
                *pose.base_velocity,
            )
            for pose in phase.poses
        ]
        return torch.tensor(rows, dtype=torch.float64)

    def place(self, row: Tensor) -> None:
        """Take the joints and the base of a row of :meth:`rows`."""
        count = len(self.columns)
        self.data.qpos[self.columns] = row[:count]
        if self._base is not None:
            height, pitch = row[count : count + 2].tolist()
            turn = from_roll_pitch_yaw(torch.tensor([0.0, pitch, 0.0], dtype=torch.float64))
            self.data.qpos[self._base : self._base + 7] = [0.0, 0.0, height, *turn.tolist()]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_sensorPos(self.model, self.data)

    def hand(self) -> Tensor:
        """Position [m] and quaternion (wxyz) of the end effector in the world. Shape (7,)."""
        names = [name for key in _HAND_SENSORS for name in self.robot.sensors[key]]
        return torch.tensor(np.concatenate([self.data.sensor(name).data for name in names]))

    def lowest(self) -> tuple[str, float]:
        """Which of the end effector and the loads is nearest to the ground, and its height [m]."""
        heights = {"the end effector": float(self.hand()[2])}
        for name in self.robot.loads:
            body = self.model.body(name).id
            parts = [self._lowest_point(geom) for geom in self._geoms() if self.model.geom_bodyid[geom] == body]
            heights |= {name: min(parts)} if parts else {}
        return min(heights.items(), key=lambda entry: entry[1])

    def _geoms(self) -> list[int]:
        """Those of the robot and of what it holds, without what flies freely."""
        root = self.model.body_rootid[self.model.geom_bodyid]
        return np.flatnonzero(root == self._root).tolist()

    def _lowest_point(self, geom: int) -> float:
        """[m]."""
        kind, size = self.model.geom_type[geom], self.model.geom_size[geom]
        down = self.data.geom_xmat[geom].reshape(3, 3)[2]  # the vertical in the geom's axes
        shapes = mujoco.mjtGeom
        if kind == shapes.mjGEOM_MESH:
            mesh = self.model.geom_dataid[geom]
            first = self.model.mesh_vertadr[mesh]
            vertices = self.model.mesh_vert[first : first + self.model.mesh_vertnum[mesh]]
            return float(self.data.geom_xpos[geom, 2] + (vertices @ down).min())
        if kind == shapes.mjGEOM_CAPSULE:
            reach = size[0] + size[1] * abs(down[2])
        elif kind == shapes.mjGEOM_CYLINDER:
            reach = size[0] * math.hypot(*down[:2]) + size[1] * abs(down[2])
        elif kind == shapes.mjGEOM_BOX:
            reach = size @ abs(down)
        elif kind == shapes.mjGEOM_ELLIPSOID:
            reach = np.linalg.norm(size * down)
        else:
            reach = self.model.geom_rbound[geom]  # of a sphere, its radius
        return float(self.data.geom_xpos[geom, 2] - reach)


_HAND_SENSORS = ("end_effector_position", "end_effector_quaternion")


def joint_position(pose: KeyPose, robot: Robot, joint: int) -> float:
    """Position of one joint in a key pose [rad]."""
    return pose.joints.get(robot.joint_names[joint], robot.default_pose[joint])


def phase_starts(motion: Motion) -> list[float]:
    """When each phase begins if each lasts as long as its key poses [s]. Length P."""
    return [sum(phase.duration for phase in motion.phases[:number]) for number in range(len(motion.phases))]


def unchecked_tables(motion: Motion, posed: PosedRobot, dt: float, frame_height: float) -> dict[str, list[Tensor]]:
    """As :func:`motion_tables`, of any motion whose joints exist."""
    tables: dict[str, list[Tensor]] = {
        "joint_position": [],
        "end_effector_command": [],
        "base_velocity_command": [],
    }
    for phase in motion.phases:
        rows = sample_phase(phase, posed, dt)
        joints, base, velocity = rows.split((rows.shape[-1] - 5, 2, 3), -1)
        tables["joint_position"].append(joints.float())
        tables["end_effector_command"].append(_commands(rows, base[:, 1], posed, frame_height).float())
        tables["base_velocity_command"].append(velocity.float())
    return tables


def sample_phase(phase: PhaseMotion, posed: PosedRobot, dt: float) -> Tensor:
    """Rows of a phase every ``dt``, as of :meth:`PosedRobot.rows`; the last is its end. Shape (T_r, J + 5)."""
    times = torch.tensor([pose.time for pose in phase.poses], dtype=torch.float64)
    t = torch.arange(math.ceil(phase.duration / dt - 1e-6) + 1, dtype=torch.float64) * dt
    return interpolate_poses(times, posed.rows(phase), t)


def _commands(rows: Tensor, pitch: Tensor, posed: PosedRobot, frame_height: float) -> Tensor:
    """Shape (T_r, 9)."""
    hands = []
    for row in rows:
        posed.place(row)
        hands.append(posed.hand())
    position, quaternion = torch.stack(hands).split((3, 4), -1)
    place, still = torch.zeros_like(position), torch.zeros_like(pitch)
    attitude = from_roll_pitch_yaw(torch.stack((still, pitch, still), -1))
    seen = pose_to_frame(position, quaternion, place, attitude, frame_height)
    return torch.cat((seen[:, :3], rotations.two_columns(seen[:, 3:])), -1)


def check_names(motion: Motion, robot: Robot) -> None:
    """Refuse a motion of another robot, or of joints or a base that the robot does not have."""
    if motion.robot not in (None, robot.name):
        raise ValueError(
            f"{motion.name}: robot is {motion.robot!r}, but it is to be made by {robot.name!r}. Give that robot, or "
            "leave robot out of the motion if its joints mean the same."
        )
    for phase, pose in _poses(motion):
        where = f"{_of(motion, phase)}, pose at {pose.time:.2f} s"
        if unknown := [name for name in pose.joints if name not in robot.joint_names]:
            raise ValueError(
                f"{where}: joints names {unknown[0]!r}, which {robot.name!r} does not have. It has "
                f"{list(robot.joint_names)}."
            )
        if robot.base is None and (pose.base_height is not None or pose.base_pitch or any(pose.base_velocity)):
            raise ValueError(
                f"{where}: {robot.name!r} is bolted down, but its base is to be at base_height {pose.base_height}, "
                f"base_pitch {pose.base_pitch}, base_velocity {pose.base_velocity}. Leave these out."
            )


def _check_limits(motion: Motion, robot: Robot) -> None:
    """Between key poses joints only rise or fall, so that the key poses tell whether all is within the limits."""
    for phase, pose in _poses(motion):
        for joint, (name, (low, high)) in enumerate(zip(robot.joint_names, robot.position_limit, strict=True)):
            if not low <= (position := joint_position(pose, robot, joint)) <= high:
                raise ValueError(
                    f"{_of(motion, phase)}: {name} is at {position:.3f} rad at {pose.time:.2f} s, but its limits are "
                    f"{low:.3f} and {high:.3f} rad. Give a value between them."
                )


def _check_speeds(motion: Motion, robot: Robot) -> None:
    for phase in motion.phases:
        for before, after in pairwise(phase.poses):
            duration = after.time - before.time
            for joint, (name, limit) in enumerate(zip(robot.joint_names, robot.velocity_limit, strict=True)):
                way = abs(joint_position(after, robot, joint) - joint_position(before, robot, joint))
                if (speed := PEAK_SPEED * way / duration) > limit:
                    raise ValueError(
                        f"{_of(motion, phase)}: {name} moves at {speed:.2f} rad/s at {before.time + duration / 2:.2f} "
                        f"s, but its limit is {limit:.2f} rad/s. Give it at least {PEAK_SPEED * way / limit:.3f} s "
                        "between these two poses, or a shorter way."
                    )


def _check_joins(motion: Motion, posed: PosedRobot) -> None:
    robot = posed.robot
    what = [*robot.joint_names, "base_height", "base_pitch", *(f"base_velocity[{k}]" for k in range(3))]
    before, end = "the default pose", posed.rows(PhaseMotion("default", (KeyPose(0.0),)))[0]
    for phase in motion.phases:
        rows = posed.rows(phase)
        gap = (rows[0] - end).abs()
        if gap.max() > JUMP:
            worst = int(gap.argmax())
            raise ValueError(
                f"{_of(motion, phase)} starts with {what[worst]} at {rows[0, worst]:.3f}, but {before} has it at "
                f"{end[worst]:.3f}: a jump. Start the phase with that pose, at time = 0.0."
            )
        before, end = f"the end of phase {phase.name!r}", rows[-1]


def _check_ground(motion: Motion, posed: PosedRobot) -> None:
    for phase in motion.phases:
        lows = []
        for number, row in enumerate(sample_phase(phase, posed, DT)):
            posed.place(row)
            name, height = posed.lowest()
            lows.append((height, min(number * DT, phase.duration), name))
        height, time, name = min(lows)
        if height < CLEARANCE:
            raise ValueError(
                f"{_of(motion, phase)}: {name} is at {height:.3f} m over the ground at {time:.2f} s, needed is "
                f"{CLEARANCE} m. Raise the arm or base_height."
            )


def _poses(motion: Motion) -> Iterator[tuple[PhaseMotion, KeyPose]]:
    return ((phase, pose) for phase in motion.phases for pose in phase.poses)


def _of(motion: Motion, phase: PhaseMotion) -> str:
    return f"{motion.name}: phase {phase.name!r}"
