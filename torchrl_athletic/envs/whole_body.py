"""The environment in which a whole-body controller is pre-trained: track a base velocity and an end-effector pose."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import CatTensors, Compose, StepCounter, Transform, TransformedEnv, UnaryTransform

from torchrl_athletic.envs.actuation_chain import actuation_chain
from torchrl_athletic.envs.torque_env import TorqueEnv
from torchrl_athletic.functional import rewards, rotations
from torchrl_athletic.functional.commands import CommandRanges, pose_to_world
from torchrl_athletic.functional.gait import TROT, foot_height
from torchrl_athletic.robots import Robot
from torchrl_athletic.robots.b2z1 import FOOT_RADIUS
from torchrl_athletic.transforms import (
    ActionHistory,
    CommandSampler,
    GaitClock,
    ObservationHistory,
    RewardTerm,
    RewardTerms,
    TaskPhase,
    Term,
)

FRAME = (
    "projected_gravity",
    "base_velocity_command",
    "end_effector_command",
    "joint_position",
    "joint_velocity",
    "last_action",
    "gait_phase",
    "task_phase",
)
"""What the policy observes of one step.

Source:
    Fey et al. 2025, section II-B, observation space.
"""


def whole_body_env(
    robot: Robot,
    *,
    num_envs: int,
    device: torch.device | str = "cpu",
    net: nn.Module | None = None,
    arm_power: float | None = 300.0,
    max_delay: int = 6,
    history: int = 10,
    max_steps: int = 1000,
    task_width: int = 4,
    sensing: tuple[Transform, ...] = (),
    extra: tuple[Transform, ...] = (),
    seed: int = 0,
) -> TransformedEnv:
    """Compose the paper's pre-training environment, at 50 Hz over physics at 200 Hz.

    The policy reads ``observation``, the last ``history`` frames of :data:`FRAME`, and writes ``action``, position
    targets [rad]. Each term of the reward is shown under ``reward_terms``.

    Args:
        robot: With legs and an arm, such as :func:`~torchrl_athletic.robots.b2z1`.
        num_envs: N.
        device: ``"cpu"`` or ``"cuda"``.
        net: Unsupervised Actuator Net of the arm.
        arm_power: Greatest power of the arm [W]. The paper gives no figure.
        max_delay: Of the action [physics steps].
        history: Frames that the policy sees.
        max_steps: Length of an episode [policy steps]: 20 s.
        task_width: Places kept for the embedding of tasks to come, zero here.
        sensing: Transforms between the robot and the chain: an encoder's offset, say.
        extra: More transforms, put before the observation: a reference trajectory, or
            :class:`~torchrl_athletic.transforms.DomainRandomization`.
        seed: Of commands and delays.

    Source:
        Fey et al. 2025, section II-B and appendix A.

    Example:
        >>> from torchrl_athletic.robots import b2z1
        >>> env = whole_body_env(b2z1(), num_envs=2)
        >>> env.rollout(2)["observation"].shape
        torch.Size([2, 2, 770])
    """
    commands = CommandRanges()
    fields = {field for transform in (*sensing, *extra) for field in getattr(transform, "fields", ())}
    base = TorqueEnv(robot, num_envs=num_envs, device=device, terminate=fallen, fields=sorted(fields))
    dt = 4 * base.physics.timestep
    return TransformedEnv(
        base,
        Compose(
            *sensing,
            *actuation_chain(robot, net=net, arm_power=arm_power, max_delay=max_delay, seed=seed),
            StepCounter(max_steps),
            CommandSampler(commands, dt, seed=seed + 1),
            GaitClock(dt),
            TaskPhase(None, dt, width=task_width),
            ActionHistory(3, before=robot.default_pose),
            *extra,
            RewardTerms(*whole_body_rewards(robot, commands)),
            UnaryTransform(["action_history"], ["last_action"], fn=_newest),
            CatTensors(list(FRAME), "frame", del_keys=False, sort=False),
            ObservationHistory(["frame"], history, ["observation"], flatten=True),
        ),
    )


def fallen(tensordict: TensorDictBase) -> Tensor:
    """Whether the base is low or far from upright. Shape (N, 1)."""
    low = tensordict["base_position"][..., 2:] < 0.25
    return low | (tensordict["projected_gravity"][..., 2:] > -0.5)


def whole_body_rewards(robot: Robot, commands: CommandRanges) -> tuple[dict[str, RewardTerm], dict[str, float]]:
    """Terms of the paper's table by name, and their scales.

    Args:
        robot: Gives the default pose and the ranges of the joints.
        commands: Give the height of the frame in which poses are commanded.

    Source:
        Fey et al. 2025, appendix A, table of WBC rewards.
    """
    terms: dict[str, RewardTerm] = {
        "ee_pose_tracking": PoseTracking(commands.frame_height),
        "linear_velocity_tracking": _linear_velocity_tracking,
        "angular_velocity_tracking": _angular_velocity_tracking,
        "gait": Term(_gait, "gait_cycle", "foot_position", offset=torch.tensor(TROT)),
        "foot_slip": Term(_slip, "gait_cycle", "foot_velocity", offset=torch.tensor(TROT)),
        "foot_clearance": Term(_clearance, "gait_cycle", "foot_position", offset=torch.tensor(TROT)),
        "mechanical_power": Term(rewards.mechanical_power, "applied_torque", "joint_velocity"),
        "action_smoothness": Term(rewards.action_roughness, "action_history"),
        "linear_velocity_z": lambda _, after: rewards.square(after["base_linear_velocity"][..., 2:]),
        "angular_velocity_xy": lambda _, after: rewards.square(after["base_angular_velocity"][..., :2]),
        "joint_deviation": Term(
            rewards.absolute_error, "joint_position", target=torch.tensor(robot.default_pose, dtype=torch.float32)
        ),
        "collision": Term(_collision, "leg_force", "arm_force", "trunk_force"),
        "joint_limits": Term(
            rewards.beyond_limits, "joint_position", limits=torch.tensor(robot.position_limit, dtype=torch.float32)
        ),
        "contact_force": Term(rewards.square, "foot_force"),
    }
    return terms, dict(rewards.WBC_SCALES)


class PoseTracking(nn.Module):
    """Closeness of the end effector's keypoints to those of its command, which is given in a frame at the base.

    Args:
        frame_height: Of that frame above the ground [m].
    """

    def __init__(self, frame_height: float) -> None:
        super().__init__()
        self.frame_height = frame_height

    def forward(self, _: TensorDictBase, after: TensorDictBase) -> Tensor:
        goal = pose_to_world(
            after["end_effector_command"], after["base_position"], after["base_quaternion"], self.frame_height
        )
        pose = after["end_effector_position"], after["end_effector_quaternion"]
        return rewards.keypoint_tracking(_keypoints(*pose), rotations.keypoints(*goal))


def _keypoints(position: Tensor, quaternion: Tensor) -> Tensor:
    return rotations.keypoints(position, rotations.matrix(quaternion))


def _linear_velocity_tracking(_: TensorDictBase, after: TensorDictBase) -> Tensor:
    velocity, command = after["base_linear_velocity"][..., :2], after["base_velocity_command"][..., :2]
    return rewards.gaussian(velocity, command, 4.0)


def _angular_velocity_tracking(_: TensorDictBase, after: TensorDictBase) -> Tensor:
    velocity, command = after["base_angular_velocity"][..., 2:], after["base_velocity_command"][..., 2:]
    return rewards.gaussian(velocity, command, 4.0)


def _gait(cycle: Tensor, foot_position: Tensor, offset: Tensor) -> Tensor:
    return rewards.premature_contact(in_swing(cycle, offset), foot_position[..., 2])


def _slip(cycle: Tensor, foot_velocity: Tensor, offset: Tensor) -> Tensor:
    return rewards.foot_slip(~in_swing(cycle, offset), foot_velocity)


def _clearance(cycle: Tensor, foot_position: Tensor, offset: Tensor) -> Tensor:
    height = FOOT_RADIUS + foot_height(cycle, offset)
    return rewards.foot_clearance(in_swing(cycle, offset), height, foot_position[..., 2])


def in_swing(cycle: Tensor, offset: Tensor, duty: float = 0.5) -> Tensor:
    """Whether each foot should be in the air: as :func:`~.gait.foot_height` has it. Bool, shape (*B, F)."""
    return torch.remainder(cycle + offset, 1.0) >= duty


def _collision(*forces: Tensor) -> Tensor:
    return rewards.any_above(torch.cat(forces, -1))


def _newest(history: Tensor) -> Tensor:
    return history[..., -1, :]
