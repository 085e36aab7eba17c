"""What the tasks share: a motion to go by, terms of their rewards, and what is left of a controller's own."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from torchrl_athletic.envs.whole_body_rewards import GAIT, TRACKING, hand_tracking, whole_body_rewards
from torchrl_athletic.functional import rewards
from torchrl_athletic.functional.phase import PhaseSchedule
from torchrl_athletic.robots import Motion, Robot, motion_tables, read_motion
from torchrl_athletic.transforms import InPhase, OverspeedBrake, ReferenceKeys, ReferenceTrajectory, RewardTerm, Term

POLICY_DT, PHYSICS_DT = 0.02, 0.005
"""Duration of a policy's step and of a step of the physics [s]."""
PHASE_KEYS: tuple[NestedKey, NestedKey] = ("task_phase_index", "task_phase_step")
FAILURE = -500.0
"""Scale of a failure, which lasts one step of 0.02 s: it costs 10 where a task does not say otherwise."""
WRIST = slice(3, 6)
"""Of the arm's joints: the paper's 4, 5 and 6."""


def references(
    motion: Motion | str | Path, robot: Robot, schedule: PhaseSchedule, shown: Mapping[str, str] | None = None
) -> list[Transform]:
    """Transforms that command what a motion has in the phase that is on, at the phase's own time.

    Args:
        motion: Or its file, or the name of a shipped one.
        robot: Whose motion it is.
        schedule: Phases of the task, as the motion has them.
        shown: Where to show which of :func:`~torchrl_athletic.robots.motion_tables`; None commands the base's velocity
            and the hand's pose, and shows the joints as ``joint_reference`` to rewards.

    Raises:
        ValueError: If the motion has other phases.

    Example:
        >>> from torchrl_athletic.functional.phase import throw_phases
        >>> from torchrl_athletic.robots import b2z1
        >>> [transform.out_keys for transform in references("throw", b2z1(), throw_phases())]
        [['base_velocity_command'], ['end_effector_command'], ['joint_reference']]
    """
    motion = motion if isinstance(motion, Motion) else read_motion(motion)
    names = tuple(phase.name for phase in motion.phases)
    if names != schedule.names:
        raise ValueError(
            f"motion {motion.name!r} has the phases {list(names)}, the task {list(schedule.names)}: a phase would be "
            "shown another one's motion. Give both the same, in one order."
        )
    if shown is None:
        shown = {
            "base_velocity_command": "base_velocity_command",
            "end_effector_command": "end_effector_command",
            "joint_reference": "joint_position",
        }
    tables = motion_tables(motion, robot, POLICY_DT)
    by_phase = partial(ReferenceTrajectory, table_dt=POLICY_DT, dt=POLICY_DT, phase_keys=PHASE_KEYS)
    return [by_phase({name: tables[name]}, keys=ReferenceKeys(key)) for key, name in shown.items()]


def auxiliary_rewards(
    robot: Robot, position_key: NestedKey = "joint_position"
) -> tuple[dict[str, RewardTerm], dict[str, float]]:
    """Those terms of the controller's that serve every task, and their scales; and what a failure costs.

    The last is ours. The sled's reward, and that of the throw's set-up, are penalties alone: an episode that ends early
    has fewer of them, so that a fall would pay.

    Source:
        Fey et al. 2025, appendix A, table of WBC rewards, below the dashed line; appendix B.
    """
    terms, scales = whole_body_rewards(robot, position_key, without=(*TRACKING, *GAIT))
    return {**terms, "failure": Term(_as_number, "terminated")}, {**scales, "failure": FAILURE}


def stance(phases: list[int], height: float = 0.6) -> InPhase:
    r"""How far the base is from standing upright at its height [m], a B2's unless told.

    .. math:: (p_z - h)^2 + g_x^2 + g_y^2
    """
    return InPhase(phases, Term(_off_stance, "base_height", "projected_gravity", wanted=height))


def pose_tracking(phases: list[int]) -> InPhase:
    """Closeness of the hand's keypoints to those commanded."""
    return InPhase(phases, Term(hand_tracking, "pose_error"))


def off_reference(phases: list[int], joints: list[int], position_key: NestedKey) -> InPhase:
    """Sum of the distances of some joints from those of the motion [rad]."""
    return InPhase(phases, Term(_off_reference, position_key, "joint_reference", joints=torch.tensor(joints)))


def bent_wrist(phases: list[int], robot: Robot, position_key: NestedKey) -> InPhase:
    """Sum of the squares of the wrist's joints [rad²], which are 0 where it is straight."""
    joints = torch.tensor(robot.joint_groups["arm"][WRIST])
    return InPhase(phases, Term(_square_of, position_key, joints=joints))


def arm_brake(robot: Robot) -> OverspeedBrake:
    """The arm's motors brake where the body turns its joints faster than they can turn themselves."""
    joints = robot.joint_groups["arm"]
    return OverspeedBrake([robot.torque_limit[j] for j in joints], [robot.velocity_limit[j] for j in joints], joints)


def overspeed(robot: Robot, group: str) -> Term:
    """Sum over a group of joints of the speed beyond what their motors reach without load [rad/s]."""
    joints = robot.joint_groups[group]
    limit = torch.tensor([robot.velocity_limit[j] for j in joints])
    return Term(_beyond, "joint_velocity", joints=torch.tensor(joints), limit=limit)


def change_of(phases: list[int], key: NestedKey) -> InPhase:
    """Length of the change of a vector since the last action, of a force [N] say."""

    def change(before: TensorDictBase, after: TensorDictBase) -> Tensor:
        return torch.linalg.vector_norm(after[key] - before[key], dim=-1, keepdim=True)

    return InPhase(phases, change)


def position_key_of(encoder_offset: tuple[float, float]) -> str:
    """Where rewards read the true positions of the joints."""
    return "true_joint_position" if any(encoder_offset) else "joint_position"


def _as_number(flag: Tensor) -> Tensor:
    return flag.float()


def _off_stance(height: Tensor, gravity: Tensor, wanted: float) -> Tensor:
    return (height - wanted).square() + rewards.square(gravity[..., :2])


def _off_reference(position: Tensor, reference: Tensor, joints: Tensor) -> Tensor:
    return rewards.absolute_error(position.index_select(-1, joints), reference.index_select(-1, joints))


def _beyond(velocity: Tensor, joints: Tensor, limit: Tensor) -> Tensor:
    return (velocity.index_select(-1, joints).abs() - limit).clamp(min=0).sum(-1, keepdim=True)


def _square_of(position: Tensor, joints: Tensor) -> Tensor:
    return rewards.square(position.index_select(-1, joints))
