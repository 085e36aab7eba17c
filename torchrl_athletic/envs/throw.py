"""Throwing: an arm on the floor, with a bucket at its flange, sends a ball of 100 g as far as it can."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import CatTensors, Compose, StepCounter, Transform, TransformedEnv, UnaryTransform

from torchrl_athletic.envs.actuation_chain import actuation_chain
from torchrl_athletic.envs.torque_env import TorqueEnv
from torchrl_athletic.functional import ball, rewards
from torchrl_athletic.functional.phase import throw_phases
from torchrl_athletic.functional.reference import interpolate_poses
from torchrl_athletic.robots import Bucket, Robot
from torchrl_athletic.transforms import (
    ActionHistory,
    BallFlight,
    InitialState,
    ObservationHistory,
    ReferenceTrajectory,
    RewardTerm,
    RewardTerms,
    TaskPhase,
    Term,
)
from torchrl_athletic.transforms.initial_state import StartRanges
from torchrl_athletic.transforms.stateful import StatefulTransform, unbounded_like

BUCKET = Bucket(opening=(0.0, 0.0, -1.0))
"""Opens upwards where the arm is stretched backwards, whence an overhead swing throws forward."""
DT = 0.02
"""Duration of a policy's step [s]."""
STEPS = 200
"""Policy's steps per episode: 4 s."""
ARM_POWER = 300.0
"""Power of the arm's supply [W]. The paper gives no figure."""
PLACED_AT = 1.5
"""When the ball is put into the bucket [s]. Fey et al. 2025, appendix B-A."""
FRAME = ("arm_position", "arm_velocity", "last_action", "reference", "task_phase")
"""What the policy observes of one step.

Source:
    Fey et al. 2025, section II-B and II-C, less what belongs to legs.
"""
PRIVILEGED = ("ball_position", "ball_linear_velocity", "bucket_position", "bucket_linear_velocity")
"""What the critic sees besides."""

_WAYPOINTS = (  # [s], then the joints of the arm [rad]
    (0.0, None),
    (1.9, (0.0, 0.8, -2.3, -0.8, 0.0, 0.0)),
    (2.5, (0.0, 0.8, -2.3, -0.8, 0.0, 0.0)),
    (2.9, (0.0, 1.8, -1.9, -0.8, 0.0, 0.0)),
    (3.5, (0.0, 1.8, -1.9, -0.8, 0.0, 0.0)),
    (4.0, None),
)


def throw_reference(robot: Robot, waypoints: Sequence[tuple[float, Sequence[float] | None]] = _WAYPOINTS) -> Tensor:
    """A throw made by hand: the arm goes back, waits for the ball, swings overhead in half a second and comes home.

    Between waypoints the joints follow the quintic that starts and ends at rest.

    Args:
        robot: With six joints in the group ``"arm"``.
        waypoints: Times from 0 on [s] and positions of the arm's joints [rad], None for the default pose.

    Returns:
        Positions of the arm's joints every :data:`DT`, within their limits [rad]. Shape (T, 6).

    Example:
        >>> from torchrl_athletic.robots import z1
        >>> throw_reference(z1()).shape
        torch.Size([201, 6])
    """
    arm = list(robot.joint_groups["arm"])
    home = torch.tensor(robot.default_pose)[arm]
    poses = torch.stack([home if pose is None else torch.tensor(pose) for _, pose in waypoints])
    times = torch.tensor([time for time, _ in waypoints])
    return interpolate_poses(times, poses, torch.arange(round(float(times[-1]) / DT) + 1) * DT)


def throw_env(
    robot: Robot,
    *,
    num_envs: int,
    device: torch.device | str = "cpu",
    chain: Sequence[Transform] | None = None,
    sensing: Sequence[Transform] = (),
    extra: Sequence[Transform] = (),
    privileged: Sequence[str] = (),
    spread: float = 0.05,
    tolerance: float = 0.01,
    ends: bool = True,
    seed: int = 0,
    first_row: int = 0,
) -> TransformedEnv:
    """The task in a simulation: physics at 200 Hz, a policy at 50 Hz.

    Args:
        robot: That holds :data:`BUCKET`, of :func:`~torchrl_athletic.robots.with_bucket`.
        num_envs: N.
        device: ``"cpu"`` or ``"cuda"``.
        chain: Between position targets and motors, with :class:`~torchrl_athletic.transforms.Decimation` in it, such
            as an identified simulator's; None takes :func:`~torchrl_athletic.envs.actuation_chain`.
        sensing: Transforms between the robot and the chain: an encoder's offset, say.
        extra: More transforms, put before the observation:
            :class:`~torchrl_athletic.transforms.DomainRandomization`.
        privileged: What the critic sees besides :data:`PRIVILEGED`.
        spread: How far the joints may be from the default pose at the start [rad].
        tolerance: How far joints may be beyond their ranges [rad].
        ends: Whether a failed throw ends the episode.
        seed: Of starts.
        first_row: As of :class:`~torchrl_athletic.transforms.RandomTransform`.

    Example:
        >>> from torchrl_athletic.robots import with_bucket, z1
        >>> env = throw_env(with_bucket(z1(), BUCKET), num_envs=2)
        >>> env.rollout(3)["observation"].shape
        torch.Size([2, 3, 340])
    """
    chain = actuation_chain(robot, arm_power=ARM_POWER) if chain is None else chain
    fields = {field for transform in (*sensing, *chain, *extra) for field in getattr(transform, "fields", ())}
    base = TorqueEnv(robot, num_envs=num_envs, device=device, fields=sorted(fields), every_step=BallFlight.every_step)
    still = StartRanges(spread, 0.0, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3)
    return TransformedEnv(
        base,
        Compose(
            *sensing,
            InitialState(still, seed=seed, first_row=first_row),
            BallFlight(base.physics.timestep, rim=BUCKET.rim, radius=BUCKET.ball_radius, placed_at=PLACED_AT),
            *chain,
            *extra,
            *throw_task(robot, tolerance=tolerance, ends=ends, privileged=privileged),
        ),
    )


def throw_task(
    robot: Robot, *, tolerance: float = 0.01, ends: bool = True, privileged: Sequence[str] = ()
) -> list[Transform]:
    """The task alone, for any environment that takes position targets and shows joints and ``BallFlight.every_step``.

    Phases, timer and reward are the paper's. The set-up is never prolonged and no episode starts with settling, which
    the paper does so that a robot on legs learns not to fall: this one is bolted to the floor.

    Args:
        robot: Gives the pose at rest, the limits and the joints of the arm.
        tolerance: How far joints may be beyond their ranges [rad].
        ends: Whether a failed throw ends the episode.
        privileged: What the critic sees besides :data:`PRIVILEGED`.

    Source:
        Fey et al. 2025, appendix B-A.
    """
    arm = robot.joint_groups["arm"]
    columns = slice(arm[0], arm[-1] + 1)
    schedule = throw_phases(stay_probability=0.0, settle_probability=0.0)
    terms, scales = throw_rewards(robot)
    return [
        StepCounter(STEPS),
        TaskPhase(schedule, DT),
        ReferenceTrajectory({"arm": throw_reference(robot)}, table_dt=DT, dt=DT, lookahead=(0, 5)),
        ActionHistory(3, before=robot.default_pose),
        ThrowFailure(robot, tolerance=tolerance, ends=ends),
        RewardTerms(terms, scales, dt=DT),
        UnaryTransform(["joint_position"], ["arm_position"], fn=lambda position: position[..., columns]),
        UnaryTransform(["joint_velocity"], ["arm_velocity"], fn=lambda velocity: velocity[..., columns]),
        UnaryTransform(["action_history"], ["last_action"], fn=lambda history: history[..., -1, columns]),
        CatTensors(list(FRAME), "frame", del_keys=False, sort=False),
        ObservationHistory(["frame"], 10, ["observation"], flatten=True),
        CatTensors([*PRIVILEGED, *privileged], "privileged", del_keys=False, sort=False),
        AroundReference(robot),
    ]


def throw_rewards(robot: Robot) -> tuple[dict[str, RewardTerm], dict[str, float]]:
    """Terms by name, and their scales.

    Of the paper's terms those for base and feet are left out, and so the settle phase has only the terms that all
    phases share. What it prints with a plus, the distance from the reference, is taken as the penalty that it must be.
    ``failure`` is ours: all else that is lost with the rest of an episode may be worth less than nothing.

    Args:
        robot: Gives the default pose and the limits.

    Source:
        Fey et al. 2025, appendix B-A, and appendix A, table of WBC rewards, below the dashed line.
    """
    schedule, arm = throw_phases(), list(robot.joint_groups["arm"])
    set_up, throw = schedule.index("throw-set-up"), schedule.index("throw")
    shared = ("mechanical_power", "action_smoothness", "joint_deviation", "collision", "joint_limits")
    terms: dict[str, RewardTerm] = {
        "reference": lambda before, after: _in_phase(set_up, before, _off_reference(after, arm)),
        "forward": lambda before, after: _in_phase(throw, before, _ball_speed(after, 0).clamp(min=0)),
        "upward": lambda before, after: _in_phase(throw, before, _ball_speed(after, 2).clamp(min=0)),
        "lateral": lambda before, after: _in_phase(throw, before, _ball_speed(after, 1).square()),
        "mechanical_power": Term(rewards.mechanical_power, "applied_torque", "joint_velocity"),
        "action_smoothness": Term(rewards.action_roughness, "action_history"),
        "joint_deviation": Term(
            rewards.absolute_error, "joint_position", target=torch.tensor(robot.default_pose, dtype=torch.float32)
        ),
        "collision": Term(rewards.any_above, "arm_force"),
        "joint_limits": Term(
            rewards.beyond_limits, "joint_position", limits=torch.tensor(robot.position_limit, dtype=torch.float32)
        ),
        "failure": lambda before, after: (after["throw_failed"] & ~before["throw_failed"]).float(),
    }
    scales = {"reference": -5.0, "forward": 20.0, "upward": 20.0, "lateral": -0.5, "failure": -1000.0}
    return terms, scales | {name: rewards.WBC_SCALES[name] for name in shared}


def _in_phase(index: int, before: TensorDictBase, value: Tensor) -> Tensor:
    """The value where the action was taken in a phase, else 0."""
    return (before["task_phase_index"] == index) * value


def _off_reference(after: TensorDictBase, arm: Sequence[int]) -> Tensor:
    now = after["reference"][..., : len(arm)]  # that of later stands behind it
    return rewards.absolute_error(after["joint_position"][..., arm[0] : arm[-1] + 1], now)


def _ball_speed(after: TensorDictBase, axis: int) -> Tensor:
    return after["ball_linear_velocity"][..., axis : axis + 1]


class AroundReference(Transform):
    """The action is added to the reference, and both together are the position targets; other joints stay at home.

    So a policy that knows nothing throws as the reference does. The paper's starts from one that tracks references.
    Outside of the throw only a share of the action counts: what a policy has to try there, to find a better throw,
    would here shake the ball out of the bucket.

    Args:
        robot: With joints in the group ``"arm"``, one after another, that the reference is of.
        share: Of the action outside of the throw [1].
        action_key: Targets of all J joints further in, of the arm's for the policy [rad]. Shape (N, J).
        reference_key: The reference as the policy sees it, now first [rad].
        phase_key: Number of the task's phase.
    """

    home: Tensor

    def __init__(
        self,
        robot: Robot,
        share: float = 0.25,
        *,
        action_key: NestedKey = "action",
        reference_key: NestedKey = "reference",
        phase_key: NestedKey = "task_phase_index",
    ) -> None:
        super().__init__(in_keys=[], out_keys=[], in_keys_inv=[action_key], out_keys_inv=[action_key])
        arm = robot.joint_groups["arm"]
        self.arm, self.width = slice(arm[0], arm[-1] + 1), len(arm)
        self.share, self.throw = share, throw_phases().index("throw")
        self.action_key, self.reference_key, self.phase_key = action_key, reference_key, phase_key
        self.register_buffer("home", torch.tensor(robot.default_pose, dtype=torch.float32), persistent=False)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.parent is None:  # on its way into a buffer
            return tensordict
        action = tensordict.get(self.action_key)
        counts = torch.where(tensordict.get(self.phase_key) == self.throw, 1.0, self.share)
        target = self.home.expand(*action.shape[:-1], -1).clone()
        target[..., self.arm] = tensordict.get(self.reference_key)[..., : self.width] + counts * action
        return tensordict.set(self.action_key, target)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves data as it is: the transform acts on the way in."""
        return tensordict

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        action = input_spec["full_action_spec"]
        targets = action[self.action_key]
        action[self.action_key] = unbounded_like(targets, (*targets.shape[:-1], self.width))
        return input_spec


class ThrowFailure(StatefulTransform):
    """Tell throws that do not count: the ball was lost in the set-up, a joint left its range, the bucket came too low.

    In a simulation, the stop at the end of a joint's range is a fine brake to launch a ball with; a real arm breaks.
    Writes ``throw_failed`` (N, 1), which stays until the episode's end.

    Args:
        robot: Gives the ranges of its joints.
        tolerance: How far a joint may be beyond its range [rad].
        clearance: Least height of the bucket's point [m]: its farthest corner is 0.1 m away.
        ends: Whether this ends the episode.
    """

    limits: Tensor

    def __init__(self, robot: Robot, *, tolerance: float = 0.01, clearance: float = 0.1, ends: bool = True) -> None:
        super().__init__(["joint_position", "bucket_position", "ball_away"], ["throw_failed"])
        arm = list(robot.joint_groups["arm"])
        limits = torch.tensor(robot.position_limit, dtype=torch.float32)[arm]
        self.register_buffer("limits", limits + torch.tensor([-tolerance, tolerance]), persistent=False)
        self.arm, self.clearance, self.ends = slice(arm[0], arm[-1] + 1), clearance, ends

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        return {"throw_failed": torch.zeros_like(tensordict_reset.get("ball_away"))}

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        position, bucket, away = (next_tensordict.get(key) for key in self.in_keys)
        beyond = rewards.beyond_limits(position[..., self.arm], self.limits) > 0
        lost = away & (tensordict.get("task_phase_index") == 0)
        failed = tensordict.get("throw_failed") | beyond | lost | (bucket[..., 2:] < self.clearance)
        next_tensordict.set("throw_failed", failed)
        if self.ends:
            for key in ("done", "terminated"):
                next_tensordict.set(key, next_tensordict.get(key) | failed)

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        return {"throw_failed": observation_spec["ball_away"].clone()}


def throw_distance(step: TensorDictBase) -> Tensor:
    """How far forward of the base's axis the ball comes down, the arm standing on the floor [m].

    Args:
        step: With what :class:`BallFlight` and :class:`ThrowFailure` write, after the throw; the ball may still fly.

    Returns:
        x of the place, negative behind the base; 0 where the ball never left, or the throw failed. Shape (*B,).
    """
    where = ball.landing(step["ball_position"], step["ball_linear_velocity"], BUCKET.ball_radius)[..., 0]
    counts = step["ball_away"] & ~step["throw_failed"]
    return torch.where(counts.squeeze(-1), where, 0.0)


def throw_summary(step: TensorDictBase) -> dict[str, float]:
    """Summarise many throws, those that failed counting as 0 m.

    Args:
        step: As of :func:`throw_distance`. Shape (N,).

    Returns:
        ``distance_m`` and ``spread_m``, mean and standard deviation [m]; ``failed``, the share of throws [1].
    """
    distance = throw_distance(step)
    return {
        "distance_m": float(distance.mean()),
        "spread_m": float(distance.std(correction=0)),
        "failed": float(step["throw_failed"].float().mean()),
    }
