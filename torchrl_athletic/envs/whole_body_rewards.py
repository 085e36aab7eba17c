"""The paper's table of rewards for a whole-body controller, term by term."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import Tensor

from torchrl_athletic.functional import rewards
from torchrl_athletic.functional.gait import TROT, foot_height, in_swing
from torchrl_athletic.robots import Robot
from torchrl_athletic.robots.b2z1 import FOOT_RADIUS
from torchrl_athletic.transforms import RewardTerm, Term

TRACKING = ("ee_pose_tracking", "linear_velocity_tracking", "angular_velocity_tracking")
GAIT = ("gait", "foot_slip", "foot_clearance")
AUXILIARY = tuple(name for name in rewards.WBC_SCALES if name not in (*TRACKING, *GAIT))
"""Terms below the table's dashed line, which serve every task."""


def whole_body_rewards(
    robot: Robot,
    position_key: NestedKey = "joint_position",
    without: Sequence[str] = (),
    foot_radius: float = FOOT_RADIUS,
) -> tuple[dict[str, RewardTerm], dict[str, float]]:
    """Terms by name, and the paper's scales.

    Args:
        robot: Gives the default pose and the ranges of the joints.
        position_key: True positions of the joints [rad].
        without: Names of terms to leave out, for ablations.
        foot_radius: Height of the centre of a foot that stands: a B2's, unless told [m].

    Raises:
        ValueError: If there is no term of a name in ``without``.

    Source:
        Fey et al. 2025, appendix A, table of WBC rewards.
    """
    pose = torch.tensor(robot.default_pose, dtype=torch.float32)
    limits = torch.tensor(robot.position_limit, dtype=torch.float32)
    feet = {"offset": torch.tensor(TROT)}
    swing = {**feet, "radius": foot_radius}
    terms: dict[str, RewardTerm] = {
        "ee_pose_tracking": Term(hand_tracking, "pose_error"),
        "linear_velocity_tracking": Term(_linear_velocity_tracking, "base_linear_velocity", "base_velocity_command"),
        "angular_velocity_tracking": Term(_angular_velocity_tracking, "base_angular_velocity", "base_velocity_command"),
        "gait": Term(_gait, "gait_cycle", "foot_height", **swing),
        "foot_slip": Term(_slip, "gait_cycle", "foot_velocity", **feet),
        "foot_clearance": Term(_clearance, "gait_cycle", "foot_height", **swing),
        "mechanical_power": Term(_power, "joint_power"),
        "action_smoothness": Term(rewards.action_roughness, "action_history"),
        "linear_velocity_z": Term(_square_of_third, "base_linear_velocity"),
        "angular_velocity_xy": Term(_square_of_first_two, "base_angular_velocity"),
        "joint_deviation": Term(rewards.absolute_error, position_key, target=pose),
        "collision": Term(_collision, "leg_force", "arm_force", "trunk_force"),
        "joint_limits": Term(rewards.beyond_limits, position_key, limits=limits),
        "contact_force": Term(rewards.square, "foot_force"),
    }
    if unknown := sorted(set(without) - terms.keys()):
        raise ValueError(f"without names {unknown[0]!r}, which is no term of the reward; there are {sorted(terms)}.")
    kept = {name: term for name, term in terms.items() if name not in without}
    return kept, {name: rewards.WBC_SCALES[name] for name in kept}


def hand_tracking(way: Tensor) -> Tensor:
    """Closeness of the hand's keypoints to those commanded, by the ways that are left. (*B, 4, 3) to (*B, 1)."""
    return rewards.keypoint_tracking(way, torch.zeros_like(way))


def _linear_velocity_tracking(velocity: Tensor, command: Tensor) -> Tensor:
    return rewards.gaussian(velocity[..., :2], command[..., :2], 4.0)


def _angular_velocity_tracking(velocity: Tensor, command: Tensor) -> Tensor:
    return rewards.gaussian(velocity[..., 2:], command[..., 2:], 4.0)


def _gait(cycle: Tensor, height: Tensor, offset: Tensor, radius: float) -> Tensor:
    return rewards.premature_contact(in_swing(cycle, offset), height + (FOOT_RADIUS - radius))  # as if it were a B2's


def _slip(cycle: Tensor, velocity: Tensor, offset: Tensor) -> Tensor:
    return rewards.foot_slip(~in_swing(cycle, offset), velocity)


def _clearance(cycle: Tensor, height: Tensor, offset: Tensor, radius: float) -> Tensor:
    return rewards.foot_clearance(in_swing(cycle, offset), radius + foot_height(cycle, offset), height)


def _power(power: Tensor) -> Tensor:
    return power.sum(-1, keepdim=True).abs()


def _square_of_third(velocity: Tensor) -> Tensor:
    return rewards.square(velocity[..., 2:])


def _square_of_first_two(velocity: Tensor) -> Tensor:
    return rewards.square(velocity[..., :2])


def _collision(*forces: Tensor) -> Tensor:
    return rewards.any_above(torch.cat(forces, -1))
