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
from torchrl_athletic.transforms.simulated import once_per_model, simulated_env
from torchrl_athletic.transforms.stateful import RandomTransform

Axes = tuple[float, float, float]


@dataclass(frozen=True)
class StartRanges:
    """How far a start may lie from the keyframe, either way, each number being drawn by itself.

    The paper randomises the initial joint and body states and states no figures: the defaults are ours.
    :class:`~torchrl_athletic.envs.TorqueEnv` lifts a floating robot whose start would be in the ground.
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


@dataclass(frozen=True, eq=False)
class _OfModel:
    """What the draws need of the model, on its device."""

    qpos: Tensor
    qvel: Tensor
    joints: Tensor
    """Columns of the joints in ``qpos``."""
    dofs: Tensor
    """Columns of the joints in ``qvel``."""
    limit: Tensor
    size: Tensor
    """How far each drawn number reaches."""
    base: tuple[int, int] | None
    """First column of the base in ``qpos``, and in ``qvel``."""

    @property
    def numbers(self) -> int:
        """How many random numbers a start takes."""
        return len(self.size)


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
        env, model = simulated_env(self), once_per_model(self, self._of_model)
        if tensordict is None:
            tensordict = TensorDict(batch_size=env.batch_size, device=env.device)
        key = self.upcoming(tensordict)
        qpos, qvel = tensordict.get(self.qpos_key, None), tensordict.get(self.qvel_key, None)
        qpos = model.qpos if qpos is None else qpos.to(model.qpos)
        qvel = model.qvel if qvel is None else qvel.to(model.qvel)
        qpos, qvel = (state.expand(*env.batch_size, -1).clone() for state in (qpos, qvel))
        self._move(qpos, qvel, streams.uniform(key, model.numbers, -1.0, 1.0).to(qpos), model)
        return tensordict.set(self.qpos_key, qpos).set(self.qvel_key, qvel)

    def _move(self, qpos: Tensor, qvel: Tensor, drawn: Tensor, model: _OfModel) -> None:
        """Move states in place. Drawn numbers are within [-1, 1]."""
        joints = len(model.joints)
        angle, speed, place, turn, linear, angular = (drawn * model.size).split([joints, joints, 3, 3, 3, 3], -1)
        moved = qpos[:, model.joints] + angle
        qpos[:, model.joints] = torch.minimum(torch.maximum(moved, model.limit[:, 0]), model.limit[:, 1])
        qvel[:, model.dofs] += speed
        if model.base is None:
            return
        at, dof = model.base
        qpos[:, at : at + 3] += place
        tilt = randomization.turn(torch.cat((turn[:, :2], torch.zeros_like(turn[:, 2:])), -1))
        attitude = rotations.multiply(qpos[:, at + 3 : at + 7], tilt)
        qpos[:, at + 3 : at + 7] = rotations.multiply(rotations.yaw_quaternion(turn[:, 2:]), attitude)
        qvel[:, dof : dof + 3] += linear
        qvel[:, dof + 3 : dof + 6] += angular

    def _of_model(self, env: Any) -> _OfModel:
        physics, robot, ranges = env.physics, env.robot, self.ranges
        model, joints = physics.model, len(robot.joint_names)
        sizes = [*[ranges.joint_position] * joints, *[ranges.joint_velocity] * joints, *ranges.base_position]
        sizes += [*ranges.base_turn, *ranges.base_linear_velocity, *ranges.base_angular_velocity]
        base = None
        if robot.base is not None:
            free = model.body(robot.base).jntadr[0]
            base = int(model.jnt_qposadr[free]), int(model.jnt_dofadr[free])

        def tensor(values: Any, dtype: torch.dtype = physics.dtype) -> Tensor:
            return torch.tensor(values, dtype=dtype, device=physics.device)

        at = [model.joint(name) for name in robot.joint_names]
        return _OfModel(
            qpos=tensor(model.key(robot.keyframe).qpos),
            qvel=tensor(model.key(robot.keyframe).qvel),
            joints=tensor([int(joint.qposadr[0]) for joint in at], torch.int64),
            dofs=tensor([int(joint.dofadr[0]) for joint in at], torch.int64),
            limit=tensor(robot.position_limit),
            size=tensor(sizes),
            base=base,
        )

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        return {}  # all of it happens before the reset

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        """Nothing to remember."""

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        return {}
