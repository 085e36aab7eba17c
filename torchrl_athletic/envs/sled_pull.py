"""The sled pull: a sled on a rope is tied to the hand, and the robot walks backwards on a straight line."""

from __future__ import annotations

from typing import Any

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from torchrl_athletic.envs.task_parts import (
    PHYSICS_DT,
    POLICY_DT,
    auxiliary_rewards,
    bent_wrist,
    pose_tracking,
    position_key_of,
    references,
)
from torchrl_athletic.envs.whole_body import PRIVILEGED, Disturbances, whole_body_env
from torchrl_athletic.functional import commands, rewards
from torchrl_athletic.functional.commands import CommandRanges, sled_commands
from torchrl_athletic.functional.phase import PhaseSchedule, sled_phases
from torchrl_athletic.robots import Handle, Robot, Terrain, b2z1
from torchrl_athletic.transforms import CommandSampler, InPhase, RewardTerm, SledRope, StartLine, Term

MASS, FRICTION = (20.0, 180.0), (0.1, 0.2)
"""Mass of the sled [kg] and friction of its runners [1]. The paper names 150 kg as what was pulled at most, and
friction of 113 N and 230 N of its real carts; it gives no ranges. Ours goes beyond 150 kg."""
KNOWN = {"rope_tension": 100.0, "sled_mass": 100.0, "sled_friction": 0.2}
"""What the critic sees besides, and the usual sizes [N, kg, 1]."""
FAILURE = -1000.0
"""Scale of a failure, which lasts one step of 0.02 s. At half the price a robot that is told to pull a heavy sled fast
saves as much by a fall: 29 of 100 fell at 150 kg. At four times the price 36 minutes of training led to 73 of 100
that pull 150 kg for 10 m; masses and the price of drift were lower, too."""


def sled_pull_env(
    robot: Robot | None = None,
    *,
    num_envs: int = 4096,
    mass: tuple[float, float] = MASS,
    friction: tuple[float, float] = FRICTION,
    velocity: CommandRanges | None = None,
    schedule: PhaseSchedule | None = None,
    disturbances: Disturbances | None = None,
    motion: str = "sled",
    as_printed: bool = False,
    max_steps: int = 1000,
    seed: int = 0,
    first_row: int = 0,
    **told: Any,
) -> TransformedEnv:
    """The task, around the environment of the pre-training: same inputs, same actions, same disturbances.

    The rope pulls at every step of the physics (:class:`~torchrl_athletic.transforms.SledRope`).

    Args:
        robot: That holds a :class:`~torchrl_athletic.robots.Handle`; None takes that of the pre-training, with it.
        num_envs: N.
        mass: Least and greatest of the sled [kg].
        friction: Least and greatest coefficient of its runners [1].
        velocity: Of the base, to command; None takes :func:`~torchrl_athletic.functional.commands.sled_commands`.
        schedule: None takes :func:`~torchrl_athletic.functional.phase.sled_phases`.
        disturbances: None takes the paper's.
        motion: Of the hand to go by, as of :func:`~torchrl_athletic.robots.read_motion`.
        as_printed: Take the paper's terms and scales, see :func:`sled_pull_rewards`.
        max_steps: Length of an episode [policy steps]: 20 s.
        seed: Of all draws.
        first_row: Number of the first row, for parts of a larger batch.
        told: To :func:`~torchrl_athletic.envs.whole_body_env`.

    Source:
        Fey et al. 2025, appendix B-C.

    Example:
        >>> shown = sled_pull_env(num_envs=2).rollout(2)
        >>> shown["observation"].shape, shown["rope_tension"].shape
        (torch.Size([2, 2, 770]), torch.Size([2, 2, 1]))
    """
    robot = b2z1(terrain=Terrain(), cone="pyramidal", tool=Handle()) if robot is None else robot
    schedule = sled_phases() if schedule is None else schedule
    chance = Disturbances() if disturbances is None else disturbances
    rows: dict[str, Any] = {"seed": seed, "first_row": first_row}
    walk = CommandSampler(sled_commands() if velocity is None else velocity, POLICY_DT, **rows)
    hold = references(motion, robot, schedule, {"end_effector_command": "end_effector_command"})
    return whole_body_env(
        robot,
        num_envs=num_envs,
        commands=[walk, *hold],
        schedule=schedule,
        terms=sled_pull_rewards(robot, schedule, position_key_of(chance.encoder_offset), as_printed=as_printed),
        disturbances=chance,
        privileged=(*PRIVILEGED, *KNOWN),
        objects=[SledRope(PHYSICS_DT, mass=mass, friction=friction, **rows)],
        extra=[StartLine()],
        max_steps=max_steps,
        **rows,
        **told,
    )


def sled_pull_rewards(
    robot: Robot, schedule: PhaseSchedule, position_key: NestedKey = "joint_position", *, as_printed: bool = False
) -> tuple[dict[str, RewardTerm], dict[str, float]]:
    """Terms by name, and their scales.

    The paper prints the set-up's reward under the pull's name, and the drifts without their signs: here the pose is
    tracked in the set-up, and drift to either side costs alike. Three scales are ours: the wrong velocity costs 20, not
    5, or a heavy sled is left to stand; drift to the side costs 4, not 1; and a failure costs :data:`FAILURE`.
    ``as_printed`` takes the paper's, and a failure costs nothing.

    Source:
        Fey et al. 2025, appendix B-C.
    """
    set_up, pull = (schedule.index(name) for name in ("sled-set-up", "pull"))
    terms: dict[str, RewardTerm] = {
        "ee_pose_tracking": pose_tracking([set_up]),
        "velocity": InPhase([pull], Term(_off_velocity, "base_linear_velocity", "base_velocity_command")),
        "lateral_drift": InPhase([pull], lambda before, after: sled_drift(after)[0].abs()),
        "heading_drift": InPhase([pull], lambda before, after: sled_drift(after)[1].abs()),
        "wrist": bent_wrist([pull], robot, position_key),
    }
    scales = {"ee_pose_tracking": 5.0, "velocity": -20.0, "lateral_drift": -4.0, "heading_drift": -1.0, "wrist": -1.0}
    shared, shared_scales = auxiliary_rewards(robot, position_key)
    terms, scales = terms | shared, scales | shared_scales
    if as_printed:
        del terms["failure"], scales["failure"]
        return terms, scales | {"velocity": -5.0, "lateral_drift": -1.0}
    return terms, scales | {"failure": FAILURE}


def sled_drift(step: TensorDictBase) -> tuple[Tensor, Tensor]:
    """How far the base has left its first line: to the left [m] and counter-clockwise [rad]. Shape (*B, 1) each."""
    return commands.deviation_from_line(step["start_line"], step["base_position"], step["base_quaternion"])


def _off_velocity(velocity: Tensor, command: Tensor) -> Tensor:
    return rewards.square(velocity[..., :1] - command[..., :1])
