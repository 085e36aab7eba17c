"""Episodes that do not all start alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from torchrl_athletic.functional import randomization, rotations, streams
from torchrl_athletic.transforms.stateful import RandomTransform, base_env_of

Axes = tuple[float, float, float]


@dataclass(frozen=True)
class StartRanges:
    """How far a start may lie from the keyframe, either way, each number being drawn by itself.

    The paper randomises the initial joint and body states and states no figures: the defaults are ours.
    """

    joint_position: float = 0.2
    """Within the joint's limits [rad]."""
    joint_velocity: float = 0.5
    """[rad/s]."""
    base_position: Axes = (0.0, 0.0, 0.0)
    """World axes [m]. With a terrain, half of its edge spreads the starts over its tiles."""
    base_turn: Axes = (0.1, 0.1, 3.14159)
    """About the base's x and y axes, then about the vertical [rad]."""
    base_linear_velocity: Axes = (0.5, 0.5, 0.2)
    """World axes [m/s]."""
    base_angular_velocity: Axes = (0.3, 0.3, 0.3)
    """The base's axes [rad/s]."""

    def __post_init__(self) -> None:
        for name, size in vars(self).items():
            if min(size if isinstance(size, tuple) else (size,)) < 0:
                raise ValueError(f"{name} is {size}: it is a distance to both sides. Give 0 or more.")


class InitialState(RandomTransform):
    """Start each episode near the robot's keyframe, or near what a transform after this one in Compose chose.

    It hands ``reset_qpos`` and ``reset_qvel`` to the environment's reset. Bodies other than the robot's base and joints
    start as they were to.

    Args:
        ranges: How far from the keyframe.
        qpos_key: As the environment's reset reads it. Shape (N, nq).
        qvel_key: Shape (N, nv).
        seed: Of the draws.
        first_row: As of :class:`RandomTransform`.
        reset_key: As of :class:`StatefulTransform`.

    Source:
        Fey et al. 2025, section II-B.

    Example:
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> from torchrl.envs import TransformedEnv
        >>> env = TransformedEnv(TorqueEnv(z1(), num_envs=3), InitialState())
        >>> env.reset()["joint_position"][:, 1].unique().numel()
        3
    """

    def __init__(
        self,
        ranges: StartRanges | None = None,
        *,
        qpos_key: NestedKey = "reset_qpos",
        qvel_key: NestedKey = "reset_qvel",
        seed: int = 0,
        first_row: int = 0,
        reset_key: NestedKey | None = None,
    ) -> None:
        super().__init__([], [], seed=seed, first_row=first_row, reset_key=reset_key)
        self.ranges = StartRanges() if ranges is None else ranges
        self.qpos_key, self.qvel_key = qpos_key, qvel_key

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        env = base_env_of(self.parent)
        if tensordict is None:
            tensordict = TensorDict(batch_size=env.batch_size, device=env.device)
        key = self.upcoming(tensordict)
        robot, physics = env.robot, env.physics
        default = physics.model.key(robot.keyframe)
        qpos, qvel = (
            torch.as_tensor(start, dtype=physics.dtype, device=physics.device).expand(*env.batch_size, -1)
            if given is None
            else given.to(physics.dtype)
            for start, given in (
                (default.qpos, tensordict.get(self.qpos_key, None)),
                (default.qvel, tensordict.get(self.qvel_key, None)),
            )
        )
        qpos, qvel = self._near(qpos.clone(), qvel.clone(), key.to(physics.device), robot, physics.model)
        return tensordict.set(self.qpos_key, qpos).set(self.qvel_key, qvel)

    def _near(self, qpos: Tensor, qvel: Tensor, key: Tensor, robot: Any, model: Any) -> tuple[Tensor, Tensor]:
        ranges, joints = self.ranges, len(robot.joint_names)
        drawn = streams.uniform(key, 2 * joints + 12, -1.0, 1.0).to(qpos.dtype)
        angle, speed, place, turn, linear, angular = drawn.split([joints, joints, 3, 3, 3, 3], -1)
        at = [int(model.joint(name).qposadr[0]) for name in robot.joint_names]
        dof = [int(model.joint(name).dofadr[0]) for name in robot.joint_names]
        low, high = qpos.new_tensor(robot.position_limit).unbind(-1)
        qpos[:, at] = torch.clamp(qpos[:, at] + ranges.joint_position * angle, low, high)
        qvel[:, dof] += ranges.joint_velocity * speed
        if robot.base is None:
            return qpos, qvel
        free = model.body(robot.base).jntadr[0]
        pose, motion = int(model.jnt_qposadr[free]), int(model.jnt_dofadr[free])
        qpos[:, pose : pose + 3] += place * qpos.new_tensor(ranges.base_position)
        tilt = turn * qpos.new_tensor((*ranges.base_turn[:2], 0.0))
        heading = rotations.yaw_quaternion(ranges.base_turn[2] * turn[:, 2:])
        attitude = rotations.multiply(qpos[:, pose + 3 : pose + 7], randomization.turn(tilt))
        qpos[:, pose + 3 : pose + 7] = rotations.multiply(heading, attitude)
        qvel[:, motion : motion + 3] += linear * qpos.new_tensor(ranges.base_linear_velocity)
        qvel[:, motion + 3 : motion + 6] += angular * qpos.new_tensor(ranges.base_angular_velocity)
        return qpos, qvel

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        return {}  # all of it happens before the reset

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        """Nothing to remember."""

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        return {}
