"""The dumbbell snatch: the hand goes down to the ground, gets a weight of up to 10 kg, and lifts it overhead."""

from __future__ import annotations

from typing import Any

from tensordict import NestedKey
from torch import Tensor
from torchrl.envs import TransformedEnv

from torchrl_athletic.envs.task_parts import (
    auxiliary_rewards,
    bent_wrist,
    change_of,
    pose_tracking,
    position_key_of,
    references,
)
from torchrl_athletic.envs.whole_body import PRIVILEGED, Disturbances, whole_body_env
from torchrl_athletic.functional.phase import PhaseSchedule, snatch_phases
from torchrl_athletic.robots import Dumbbell, Robot, Terrain, b2z1
from torchrl_athletic.transforms import AddedMass, InPhase, RewardTerm, Term

MASS = (0.0, 10.0)
"""Mass of the dumbbell [kg]. Fey et al. 2025, section III, dumbbell snatch."""
KNOWN = {"added_mass": 5.0, "load_mass": 5.0, "hand_force": 100.0}
"""What the critic sees besides, and the usual sizes [kg, N]."""


def dumbbell_snatch_env(
    robot: Robot | None = None,
    *,
    num_envs: int = 4096,
    mass: tuple[float, float] = MASS,
    schedule: PhaseSchedule | None = None,
    disturbances: Disturbances | None = None,
    motion: str = "snatch",
    as_printed: bool = False,
    max_steps: int = 500,
    seed: int = 0,
    first_row: int = 0,
    **told: Any,
) -> TransformedEnv:
    """The task, around the environment of the pre-training: same inputs, same actions, same disturbances.

    The dumbbell's mass is added to the hand when the set-up is over, where the hand is lowest. It touches nothing.

    Args:
        robot: That holds a :class:`~torchrl_athletic.robots.Dumbbell`; None takes that of the pre-training, with it.
        num_envs: N.
        mass: Least and greatest of the dumbbell [kg].
        schedule: None takes :func:`~torchrl_athletic.functional.phase.snatch_phases`.
        disturbances: None takes the paper's.
        motion: To go by, as of :func:`~torchrl_athletic.robots.read_motion`.
        as_printed: Take the paper's terms and scales, see :func:`dumbbell_snatch_rewards`.
        max_steps: Length of an episode [policy steps]: 10 s, of which the weight is carried for 7.5 s.
        seed: Of all draws.
        first_row: Number of the first row, for parts of a larger batch.
        told: To :func:`~torchrl_athletic.envs.whole_body_env`.

    Source:
        Fey et al. 2025, appendix B-B.

    Example:
        >>> shown = dumbbell_snatch_env(num_envs=2).rollout(2)
        >>> shown["observation"].shape, shown["added_mass"].max().item()
        (torch.Size([2, 2, 770]), 0.0)
    """
    robot = b2z1(terrain=Terrain(), cone="pyramidal", tool=Dumbbell()) if robot is None else robot
    schedule = snatch_phases() if schedule is None else schedule
    chance = Disturbances() if disturbances is None else disturbances
    rows: dict[str, Any] = {"seed": seed, "first_row": first_row}
    return whole_body_env(
        robot,
        num_envs=num_envs,
        commands=references(motion, robot, schedule),
        schedule=schedule,
        terms=dumbbell_snatch_rewards(robot, schedule, position_key_of(chance.encoder_offset), as_printed=as_printed),
        disturbances=chance,
        privileged=(*PRIVILEGED, *KNOWN),
        extra=[AddedMass("dumbbell", mass, phase=schedule.index("snatch"), **rows)],
        max_steps=max_steps,
        **rows,
        **told,
    )


def dumbbell_snatch_rewards(
    robot: Robot, schedule: PhaseSchedule, position_key: NestedKey = "joint_position", *, as_printed: bool = False
) -> tuple[dict[str, RewardTerm], dict[str, float]]:
    """Terms by name, and their scales.

    The hand's height is that over the ground under the robot. Its force is what its touch sensor feels.
    That a failure costs something is ours; ``as_printed`` leaves it out.

    Source:
        Fey et al. 2025, appendix B-B.
    """
    set_up, snatch = (schedule.index(name) for name in ("snatch-set-up", "snatch"))
    terms: dict[str, RewardTerm] = {
        "ee_pose_tracking": pose_tracking([set_up]),
        "force_smoothness": change_of([set_up, snatch], "hand_force"),
        "hand_height": InPhase([snatch], Term(hand_height, "end_effector_position", "base_position", "base_height")),
        "wrist": bent_wrist([snatch], robot, position_key),
    }
    scales = {"ee_pose_tracking": 5.0, "force_smoothness": -0.005, "hand_height": 4.0, "wrist": -1.0}
    shared, shared_scales = auxiliary_rewards(robot, position_key)
    terms, scales = terms | shared, scales | shared_scales
    if as_printed:
        del terms["failure"], scales["failure"]
    return terms, scales


def hand_height(hand: Tensor, base: Tensor, base_height: Tensor) -> Tensor:
    """Height of the hand over the ground below the base [m]. Positions (*B, 3), height (*B, 1) to (*B, 1)."""
    return hand[..., 2:] - (base[..., 2:] - base_height)
