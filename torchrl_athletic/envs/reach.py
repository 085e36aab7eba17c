"""Reaching: bring the end effector to a pose and hold it there."""

from __future__ import annotations

import math
from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from torchrl_athletic.envs.drawing import draw_frame
from torchrl_athletic.functional import rotations, streams
from torchrl_athletic.robots import Robot
from torchrl_athletic.transforms import RandomTransform

KEYPOINT_LENGTH = 0.3
"""Length of the axes on which the frame's points stand [m]: 1° of attitude counts as 5 mm."""


def reachable_poses(
    robot: Robot, count: int, *, spread: float = math.inf, seed: int = 0, clearance: float = 0.05
) -> Tensor:
    """Poses of the end effector at random joint positions, each within its limits: all can be reached.

    Those are left out where the arm touches something, or the end effector is lower than ``clearance``.

    Args:
        robot: Bolted to the world, with the sensors ``end_effector_position`` and ``end_effector_quaternion``.
        count: M.
        spread: Greatest distance of each joint from its default [rad]; by default it may be anywhere.
        seed: Of the draws.
        clearance: Above the ground [m].

    Returns:
        Position [m] and quaternion (w, x, y, z). Shape (M, 7).

    Raises:
        ValueError: If the robot walks about, so that its arm's reach is nowhere fixed.

    Example:
        >>> from torchrl_athletic.robots import z1
        >>> reachable_poses(z1(), count=5).shape
        torch.Size([5, 7])
    """
    if robot.base is not None:
        raise ValueError(
            f"{robot.name} has a floating base {robot.base!r}: what it can reach moves with it. Take a robot that is "
            "bolted to the world, such as z1()."
        )
    model = robot.model()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(robot.keyframe).id)
    moved = [robot.joint_names[j] for j in robot.joint_groups["arm"]]
    address = [int(model.joint(name).qposadr[0]) for name in moved]
    low, high = model.jnt_range[[model.joint(name).id for name in moved]].T
    low, high = np.maximum(low, data.qpos[address] - spread), np.minimum(high, data.qpos[address] + spread)
    position, quaternion = (
        data.sensor(robot.sensors[f"end_effector_{name}"][0]) for name in ("position", "quaternion")
    )
    generator, poses = np.random.default_rng(seed), np.empty((count, 7))
    for pose in poses:
        while True:
            data.qpos[address] = generator.uniform(low, high)
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_sensorPos(model, data)
            if data.ncon == 0 and position.data[2] > clearance:
                break
        pose[:3], pose[3:] = position.data, quaternion.data
    return torch.from_numpy(poses).float()


class PoseGoal(RandomTransform):
    """A pose to reach, drawn from a table when an episode starts.

    Writes, in world axes:

    - ``command`` (N, 7), the goal's position [m] and quaternion;
    - ``keypoints`` and ``goal_keypoints`` (N, 4, 3), the frames as points
      (:func:`~torchrl_athletic.functional.rotations.keypoints`) [m], for a reward;
    - ``goal_observation`` (N, 33) for a policy: the way from the former to the latter; the same in tenths of a metre,
      cut off at 1, so that millimetres are seen as well; the goal's position and attitude, as two columns.

    Args:
        poses: Position [m] and quaternion. Shape (M, 7).
        by_row: Row i always gets pose i, modulo M, so that a policy is measured on each of them.
        seed: Of the draws.
        first_row: As of :class:`~torchrl_athletic.transforms.RandomTransform`.

    Raises:
        ValueError: If the table has another shape.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> robot = z1()
        >>> env = TransformedEnv(TorqueEnv(robot, num_envs=2), PoseGoal(reachable_poses(robot, count=5)))
        >>> env.rollout(3)["goal_observation"].shape
        torch.Size([2, 3, 33])
    """

    poses: Tensor

    def __init__(self, poses: Tensor, *, by_row: bool = False, seed: int = 0, first_row: int = 0) -> None:
        if poses.ndim != 2 or poses.shape[-1] != 7 or not len(poses):
            raise ValueError(
                f"poses has shape {tuple(poses.shape)}, needed is (M, 7) with M > 0: position and quaternion of each "
                "goal. reachable_poses makes such a table."
            )
        super().__init__(
            in_keys=["end_effector_position", "end_effector_quaternion"],
            out_keys=["command", "keypoints", "goal_keypoints", "goal_observation"],
            seed=seed,
            first_row=first_row,
        )
        self.by_row = by_row
        self.register_buffer("poses", poses, persistent=False)

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        row = torch.arange(key.numel(), device=key.device).reshape(key.shape)
        drawn = (
            (row + self.first_row) % len(self.poses)
            if self.by_row
            else streams.integers(key, 1, len(self.poses)).squeeze(-1)
        )
        return self._shown(self.poses[drawn], tensordict_reset)

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        for key, value in self._shown(tensordict.get("command"), next_tensordict).items():
            next_tensordict.set(key, value)

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        position = observation_spec["end_effector_position"]
        sizes = {"command": (7,), "keypoints": (4, 3), "goal_keypoints": (4, 3), "goal_observation": (33,)}
        return {
            key: Unbounded(shape=(*position.shape[:-1], *size), device=position.device) for key, size in sizes.items()
        }

    def _shown(self, goal: Tensor, shown: TensorDictBase) -> dict[NestedKey, Tensor]:
        position, quaternion = shown.get("end_effector_position"), shown.get("end_effector_quaternion")
        here = rotations.keypoints(position, rotations.matrix(quaternion), KEYPOINT_LENGTH)
        there = rotations.keypoints(goal[..., :3], rotations.matrix(goal[..., 3:]), KEYPOINT_LENGTH)
        way = (there - here).flatten(-2)
        near = (10 * way).clamp(-1, 1)
        seen = torch.cat((way, near, goal[..., :3], rotations.two_columns(goal[..., 3:])), -1)
        return {"command": goal, "keypoints": here, "goal_keypoints": there, "goal_observation": seen}


def reach_errors(episodes: TensorDictBase, last: int = 25) -> dict[str, float]:
    """How near the end effector was to its goal at the end of episodes.

    The error of an episode is the mean over its last steps of the distance between the end effector and its goal.

    Args:
        episodes: With ``end_effector_position``, ``end_effector_quaternion`` and ``command`` under ``next``. Shape
            (N, T).
        last: Steps that count, from the end.

    Returns:
        Over the episodes, ``error_cm``, their mean error, and ``median_cm`` [cm]; ``share_below_3cm`` of them [1];
        ``attitude_deg``, the mean angle between the attitudes [°].

    Example:
        >>> from tensordict import TensorDict
        >>> pose = torch.tensor([0.3, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0]).expand(2, 40, 7)
        >>> after = {"end_effector_position": pose[..., :3] + 0.01, "end_effector_quaternion": pose[..., 3:]}
        >>> errors = reach_errors(TensorDict(next={**after, "command": pose}, batch_size=[2, 40]))
        >>> round(errors["error_cm"], 2), errors["share_below_3cm"]
        (1.73, 1.0)
    """
    end = episodes["next"][:, -last:]
    goal = end["command"]
    error = torch.linalg.vector_norm(end["end_effector_position"] - goal[..., :3], dim=-1).mean(-1)
    overlap = (end["end_effector_quaternion"] * goal[..., 3:]).sum(-1).abs()
    angle = 2 * torch.acos(overlap.clamp(max=1.0))
    return {
        "error_cm": 100 * float(error.mean()),
        "median_cm": 100 * float(error.median()),
        "share_below_3cm": float((error < 0.03).float().mean()),
        "attitude_deg": float(angle.mean().rad2deg()),
    }


def draw_goal(scene: mujoco.MjvScene, step: TensorDictBase) -> None:
    """Add the goal's frame to a picture, red, green and blue for x, y and z.

    Args:
        scene: To draw into.
        step: With ``goal_keypoints`` (4, 3).
    """
    origin, *tips = step["goal_keypoints"].double().cpu().numpy()
    draw_frame(scene, origin, origin + 0.5 * (np.array(tips) - origin))
