"""The ball throw: a B2 with a Z1 takes its arm back, gets a ball of 100 g into its bucket, and throws it far."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from torchrl_athletic.envs.task_parts import (
    PHYSICS_DT,
    arm_brake,
    auxiliary_rewards,
    off_reference,
    overspeed,
    position_key_of,
    references,
    stance,
)
from torchrl_athletic.envs.throw import BUCKET, PLACED_AT
from torchrl_athletic.envs.whole_body import PRIVILEGED, Disturbances, whole_body_env
from torchrl_athletic.functional import ball, rotations
from torchrl_athletic.functional.phase import PhaseSchedule, throw_phases
from torchrl_athletic.robots import Robot, Terrain, b2z1, with_bucket
from torchrl_athletic.transforms import (
    BallFlight,
    EarlyTermination,
    InPhase,
    PeakPower,
    RewardTerm,
    StartLine,
    Term,
)

KNOWN = {"ball_launch_velocity": 5.0, "ball_away": 1.0, "bucket_linear_velocity": 5.0, "bucket_axis": 1.0}
"""What the critic sees besides, and the usual sizes [m/s, 1]."""

LOST_BALL = -1000.0
"""Scale of a ball lost in the set-up, which ends the episode after one step of 0.02 s: 20 besides the 20 of a failure,
more than it costs to hold the ball as far off the motion as the untuned controller does."""
OVERSPEED = -20.0
"""Scale of the speed of an arm's joint beyond its motor's [s/rad]: a throw has it for some 0.1 s, so that 1 rad/s costs
as much as 0.2 m of the throw bring."""
FAILURE = -1000.0
"""Scale of a failure, likewise: as much as two metres of the throw."""


def ball_throw_env(
    robot: Robot | None = None,
    *,
    num_envs: int = 4096,
    schedule: PhaseSchedule | None = None,
    disturbances: Disturbances | None = None,
    motion: str = "throw",
    as_printed: bool = False,
    max_steps: int = 300,
    seed: int = 0,
    first_row: int = 0,
    **told: Any,
) -> TransformedEnv:
    """The task, around the environment of the pre-training: same inputs, same actions, same disturbances.

    The ball's flight is computed beside the simulation (:mod:`torchrl_athletic.functional.ball`); its weight is the
    bucket's. An episode whose ball is lost in the set-up ends. The arm's motors brake where the body swings their
    joints faster than they can turn (:class:`~torchrl_athletic.transforms.OverspeedBrake`): the paper leaves that open.

    Args:
        robot: That holds :data:`BUCKET`; None takes that of the pre-training, with it.
        num_envs: N.
        schedule: None takes :func:`~torchrl_athletic.functional.phase.throw_phases`.
        disturbances: None takes the paper's.
        motion: To go by, as of :func:`~torchrl_athletic.robots.read_motion`.
        as_printed: Take the paper's terms and scales, see :func:`ball_throw_rewards`.
        max_steps: Length of an episode [policy steps]: 6 s.
        seed: Of all draws.
        first_row: Number of the first row, for parts of a larger batch.
        told: To :func:`~torchrl_athletic.envs.whole_body_env`.

    Source:
        Fey et al. 2025, appendix B-A.

    Example:
        >>> shown = ball_throw_env(num_envs=2).rollout(2)
        >>> shown["observation"].shape, shown["task_phase"].shape
        (torch.Size([2, 2, 770]), torch.Size([2, 2, 4]))
    """
    robot = with_bucket(b2z1(terrain=Terrain(), cone="pyramidal"), BUCKET) if robot is None else robot
    schedule = throw_phases() if schedule is None else schedule
    chance = Disturbances() if disturbances is None else disturbances
    set_up = schedule.index("throw-set-up")
    flight = BallFlight(PHYSICS_DT, rim=BUCKET.rim, radius=BUCKET.ball_radius, placed_at=PLACED_AT, phase=set_up)
    return whole_body_env(
        robot,
        num_envs=num_envs,
        commands=references(motion, robot, schedule),
        schedule=schedule,
        terms=ball_throw_rewards(robot, schedule, position_key_of(chance.encoder_offset), as_printed=as_printed),
        disturbances=chance,
        privileged=(*PRIVILEGED, *KNOWN),
        objects=[arm_brake(robot), flight, PeakPower("leg")],
        extra=[StartLine(), EarlyTermination(lambda before, after: _lost(before, after, set_up))],
        max_steps=max_steps,
        seed=seed,
        first_row=first_row,
        **told,
    )


def ball_throw_rewards(
    robot: Robot, schedule: PhaseSchedule, position_key: NestedKey = "joint_position", *, as_printed: bool = False
) -> tuple[dict[str, RewardTerm], dict[str, float]]:
    """Terms by name, and their scales.

    The paper prints the distance from the motion with a plus; a reward for leaving it cannot be meant. Forward and
    lateral are those of the episode's start, since robots start with any heading.

    Four things are ours. Printed is the ball's velocity forward and upward in each step of the throw. It pays for early
    throws, gravity takes the reward for a ball that goes up, and one that goes down costs nothing: throws went level or
    downwards. Here a launch is paid once, by how far it will go; velocity across costs in each step, as printed. A lost
    ball costs :data:`LOST_BALL`: at the price of a fall it is cheaper to drop it than to learn to hold it. A failure
    costs :data:`FAILURE`. And an arm's joint that turns faster than its motor can costs: no motor drives it there, but
    the swing of the body does. ``as_printed`` leaves these four out and
    pays the ball's velocity; signs and axes stay as told above.

    Source:
        Fey et al. 2025, appendix B-A.
    """
    set_up, throw, settle = (schedule.index(name) for name in ("throw-set-up", "throw", "settle"))
    terms: dict[str, RewardTerm] = {
        "stance": stance([set_up, settle]),
        "reference": off_reference([set_up], list(robot.joint_groups["arm"]), position_key),
        "lateral": InPhase([throw], Term(_lateral, "ball_launch_velocity", "start_line")),
    }
    scales = {"stance": -5.0, "reference": -5.0, "lateral": -0.5}
    shared, shared_scales = auxiliary_rewards(robot, position_key)
    terms, scales = terms | shared, scales | shared_scales
    if as_printed:
        del terms["failure"], scales["failure"]
        terms["forward"] = InPhase([throw], Term(_forward, "ball_linear_velocity", "start_line"))
        terms["upward"] = InPhase([throw], Term(_upward, "ball_linear_velocity"))
        terms["lateral"] = InPhase([throw], Term(_lateral, "ball_linear_velocity", "start_line"))
        return terms, scales | {"forward": 20.0, "upward": 20.0}
    terms["distance"] = InPhase([throw], _launched)
    terms["overspeed"] = overspeed(robot, "arm")
    terms["lost_ball"] = lambda before, after: _lost(before, after, set_up).float()
    own = {"distance": 500.0, "overspeed": OVERSPEED, "lost_ball": LOST_BALL}  # 10 a metre, in one step of 0.02 s
    return terms, scales | own | {"failure": FAILURE}


def ball_throw_distance(step: TensorDictBase) -> Tensor:
    """How far ahead of the robot's start the ball comes down, to where it looked then [m]; 0 where it never left.

    Args:
        step: As the environment shows it, after the throw; the ball may still fly.

    Returns:
        Shape (*B, 1).
    """
    place = ball.landing(step["ball_position"], step["ball_linear_velocity"], BUCKET.ball_radius)
    line = step["start_line"]
    way = place - line[..., :2]
    ahead = way[..., :1] * line[..., 2:].cos() + way[..., 1:] * line[..., 2:].sin()
    return torch.where(step["ball_away"], ahead, 0.0)


def _lost(before: TensorDictBase, after: TensorDictBase, set_up: int) -> Tensor:
    return after["ball_away"] & (before["task_phase_index"] == set_up)


def _launched(before: TensorDictBase, after: TensorDictBase) -> Tensor:
    """How far a ball that has just left will go [m]."""
    return ball_throw_distance(after).clamp(min=0) * (after["ball_away"] & ~before["ball_away"])


def _lateral(velocity: Tensor, line: Tensor) -> Tensor:
    """Square of the velocity across where the robot looked at its start [m²/s²]."""
    return _ahead(velocity, line)[..., 1:2].square()


def _forward(velocity: Tensor, line: Tensor) -> Tensor:
    """Velocity to where the robot looked at its start, 0 backwards [m/s]."""
    return _ahead(velocity, line)[..., :1].clamp(min=0)


def _upward(velocity: Tensor) -> Tensor:
    """Velocity upwards, 0 downwards [m/s]."""
    return velocity[..., 2:].clamp(min=0)


def _ahead(velocity: Tensor, line: Tensor) -> Tensor:
    """Velocity in the axes of the start: ahead, to the left, upwards [m/s]. Shape (*B, 3)."""
    return rotations.rotate_inverse(rotations.yaw_quaternion(line[..., 2:]), velocity)
