"""The environment in which a whole-body controller is pre-trained: track a base velocity and an end-effector pose."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded
from torchrl.envs import (
    ActionScaling,
    CatTensors,
    Compose,
    EnvBase,
    StepCounter,
    Transform,
    TransformedEnv,
    UnaryTransform,
)

from torchrl_athletic.envs.actuation_chain import actuation_chain, shipped_net
from torchrl_athletic.envs.torque_env import TorqueEnv
from torchrl_athletic.envs.whole_body_rewards import whole_body_rewards
from torchrl_athletic.functional.commands import CommandRanges
from torchrl_athletic.functional.phase import PhaseSchedule
from torchrl_athletic.robots import Robot, Terrain, b2z1
from torchrl_athletic.transforms import (
    B2Z1_PUSHES,
    ActionHistory,
    CommandSampler,
    Decimation,
    DomainRandomization,
    EncoderOffset,
    ExternalPush,
    GaitClock,
    InitialState,
    ObservationHistory,
    PoseError,
    Push,
    RandomizationRanges,
    RewardTerm,
    RewardTerms,
    StaggeredEpisodes,
    StartRanges,
    TaskPhase,
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


def phase_inputs(env: EnvBase, *, frames: int | None = None) -> list[int]:
    """Where an observation tells the phase, in each of its frames: zeros alone in the pre-training.

    A controller that is told a phase without having learnt what to make of it acts by weights as they were drawn;
    :func:`~torchrl_athletic.networks.open_inputs` at these columns makes it deaf to them.

    Args:
        env: Of a task.
        frames: How many to look at; None takes all of ``observation``, 1 is what ``privileged`` begins with.

    Example:
        >>> from torchrl_athletic.envs import sled_pull_env
        >>> phase_inputs(sled_pull_env(num_envs=1))[:4]
        [73, 74, 75, 76]
    """
    shown = env.observation_spec
    widths = {key: shown[key].shape[-1] for key in FRAME}
    first, width = sum(widths[key] for key in FRAME[: FRAME.index("task_phase")]), sum(widths.values())
    frames = shown["observation"].shape[-1] // width if frames is None else frames
    return [frame * width + first + column for frame in range(frames) for column in range(widths["task_phase"])]


PRIVILEGED = (
    "base_linear_velocity",
    "base_angular_velocity",
    "base_height",
    "foot_height",
    "foot_force",
    "pose_error",
    "true_joint_position",
    "encoder_offset",
    "randomization",
    "push",
)
"""What the critic sees besides the newest frame, as far as the environment shows it. The paper does not say whether its
critic knows more than the policy; that of its authors' earlier work does (Portela et al. 2024)."""

ACTION_SCALE = {"leg": 0.25, "arm": 0.5, "gripper": 0.1}
"""By how much an action of 1 moves the position targets of a group of joints [rad]: after Portela et al. 2024."""

FALL_HEIGHT, FALL_UPRIGHT = 0.25, 0.5
"""A robot whose base is lower over the ground [m], or tilted beyond 60° (cosine [1]), has fallen: our figures."""


@dataclass(frozen=True)
class Disturbances:
    """What differs from one episode to the next, and what happens within one. Defaults are the paper's pre-training.

    The roughness of the ground is the robot's: ``b2z1(terrain=Terrain())``.

    Source:
        Fey et al. 2025, section II-B and table of domain randomisation.
    """

    randomization: RandomizationRanges | None = RandomizationRanges()  # noqa: RUF009  frozen
    """Ranges for links, ground and the legs' drives."""
    pushes: tuple[Push, ...] = B2Z1_PUSHES
    """Pushes at base, hips, feet and end effector."""
    starts: StartRanges | None = StartRanges(base_position=(12.0, 12.0, 0.0))  # noqa: RUF009  frozen
    """Around the default pose, spread over the terrain's tiles."""
    encoder_offset: tuple[float, float] = (-0.05, 0.05)
    """Least and greatest, joint by joint [rad]."""
    delay: tuple[int, int] = (0, 6)
    """Least and greatest delay of actions [steps of 5 ms]."""


NO_DISTURBANCES = Disturbances(None, (), None, (0.0, 0.0), (0, 0))
"""Nothing is disturbed: one robot on one ground, from one pose."""


def whole_body_env(
    robot: Robot | None = None,
    *,
    num_envs: int = 4096,
    device: torch.device | str = "cpu",
    net: nn.Module | str | None = "uan",
    chain: Sequence[Transform] | None = None,
    commands: CommandRanges | Sequence[Transform] | None = None,
    schedule: PhaseSchedule | None = None,
    terms: tuple[Mapping[str, RewardTerm], Mapping[str, float]] | None = None,
    terminate: Callable[[TensorDictBase], Tensor] | None = None,
    disturbances: Disturbances | None = None,
    privileged: Sequence[NestedKey] = PRIVILEGED,
    action_offset: Sequence[float] | None = None,
    action_scale: Mapping[str, float] | Sequence[float] | float | None = None,
    arm_power: float | None = 300.0,
    history: int = 10,
    max_steps: int = 1000,
    task_width: int = 4,
    objects: Sequence[Transform] = (),
    extra: Sequence[Transform] = (),
    staggered: bool = False,
    substeps: int = 1,
    seed: int = 0,
    first_row: int = 0,
) -> TransformedEnv:
    """Compose the paper's pre-training environment, at 50 Hz over physics at 200 Hz.

    Without arguments it is that environment: a B2 with a Z1 on rough ground, whose arm a shipped actuator net corrects,
    with everything randomised that the paper randomises. Where the paper leaves a number open, docs/whole_body.md says
    what was chosen and what others use.

    The policy reads ``observation``, the last ``history`` frames of :data:`FRAME`, and writes ``action``: 0 is the
    default pose. The critic reads ``privileged``, the newest frame and what no robot can sense. Each term of the reward
    is shown under ``reward_terms``.

    Args:
        robot: With legs and an arm; None takes ``b2z1(terrain=Terrain(), cone="pyramidal")``.
        num_envs: N.
        device: ``"cpu"`` or ``"cuda"``.
        net: Unsupervised Actuator Net of the arm, or the name of a shipped one; None leaves the arm's motors ideal.
        chain: What stands between position targets and motors, from the joint outwards, in place of that with the net:
            that of a :class:`~torchrl_athletic.identification.Simulator`, say. It delays actions itself.
        commands: What is commanded; or transforms that write ``base_velocity_command`` and ``end_effector_command`` in
            place of the :class:`~torchrl_athletic.transforms.CommandSampler`, after the phases of the task.
        schedule: Phases of a task; None shows zeros in their places.
        terms: Of the reward, by name, and their scales; None takes :func:`whole_body_rewards`.
        terminate: Whether an episode has failed; None takes :func:`fallen`.
        disturbances: None takes the paper's; see :data:`NO_DISTURBANCES`.
        privileged: What the critic sees besides a frame; names that the environment lacks are passed over.
        action_offset: Position targets of the action zero [rad]; None takes the default pose.
        action_scale: Of an action [rad], by group of joints, by joint, or for all; None takes :data:`ACTION_SCALE`.
        arm_power: Greatest power of the arm [W]. The paper gives no figure.
        history: Frames that the policy sees.
        max_steps: Length of an episode [policy steps]: 20 s.
        task_width: Places kept for the embedding of tasks to come.
        objects: Transforms that run at every step of the physics, a ball or a rope: sensors that they name in
            ``every_step`` are shown to them.
        extra: More transforms, after those that command; they see phases and commands.
        staggered: Whether the first episodes begin at random ages, as a training wants.
        substeps: Physics steps that each torque is held for: 5 for a robot whose time step is 1 ms.
        seed: Of all draws.
        first_row: Number of the first row, for parts of a larger batch.

    Raises:
        ValueError: If the robot lacks a base, ground, sensors of its hand or those that an object reads; if
            ``commands``, ``objects`` or ``extra`` count in other steps than the robot's; or a shipped net is that of
            another arm.

    Source:
        Fey et al. 2025, section II-B and appendix A.

    Example:
        >>> env = whole_body_env(num_envs=2)
        >>> shown = env.rollout(2)
        >>> shown["observation"].shape, shown["action"].shape
        (torch.Size([2, 2, 770]), torch.Size([2, 2, 19]))
    """
    robot = b2z1(terrain=Terrain(), cone="pyramidal") if robot is None else robot
    commands = CommandRanges() if commands is None else commands
    chance = Disturbances() if disturbances is None else disturbances
    _refuse_unfit(robot, objects, (*HAND, *REWARDED) if terms is None else HAND)
    rows: dict[str, Any] = {"seed": seed, "first_row": first_row}
    if chain is None:
        net = shipped_net(net, robot) if isinstance(net, str) else net
        least, greatest = chance.delay
        chain = actuation_chain(robot, net=net, arm_power=arm_power, max_delay=greatest, min_delay=least, **rows)
    torque_dt = substeps * float(robot.model().opt.timestep)
    dt = torque_dt * math.prod(part.steps for part in chain if isinstance(part, Decimation))
    _refuse_other_times(objects, torque_dt)
    _refuse_other_times((*(() if isinstance(commands, CommandRanges) else commands), *extra), dt)
    sensing, starting = _sensing(chance, rows), _starting(chance, rows)
    fields = {field for part in (*objects, *chain, *starting, *extra) for field in getattr(part, "fields", ())}
    sensed = [key for key in robot.sensors if key.endswith("_force")]
    sensed += [key for part in objects for key in getattr(part, "every_step", ())]
    base = TorqueEnv(
        robot,
        num_envs=num_envs,
        device=device,
        terminate=fallen if terminate is None else terminate,
        fields=sorted(fields),
        every_step=list(dict.fromkeys(sensed)),
        substeps=substeps,
    )
    position = "true_joint_position" if sensing else "joint_position"
    earned, scales = whole_body_rewards(robot, position) if terms is None else terms
    env = TransformedEnv(
        base,
        Compose(
            *sensing,
            *objects,
            *chain,
            StepCounter(max_steps),
            *([StaggeredEpisodes(max_steps, **rows)] if staggered else []),
            *starting,
            *([ExternalPush(chance.pushes, dt=dt, **rows)] if chance.pushes else []),
            TaskPhase(schedule, dt, width=task_width, **rows),
            *([CommandSampler(commands, dt, **rows)] if isinstance(commands, CommandRanges) else commands),
            GaitClock(dt, **rows),
            *extra,
            PoseError(_frame_height(commands)),
            TrackingErrors(),
            _scaling(robot, action_offset, action_scale),
            ActionHistory(3, before=torch.zeros(len(robot.joint_names))),
            RewardTerms(earned, scales, dt=dt),
            UnaryTransform(["action_history"], ["last_action"], fn=_newest),
            CatTensors(list(FRAME), "frame", del_keys=False, sort=False),
            ObservationHistory(["frame"], history, ["observation"], flatten=True),
        ),
    )
    return env.append_transform(Privileged(_known(env, privileged)))


HAND = ("end_effector_position", "end_effector_quaternion")
"""Sensors that tell where the hand is."""
REWARDED = (
    "base_position",
    "base_quaternion",
    "base_linear_velocity",
    "base_angular_velocity",
    "projected_gravity",
    "foot_position",
    "foot_velocity",
    "foot_force",
    "leg_force",
    "arm_force",
    "trunk_force",
)
"""Sensors beside them that observations and the paper's rewards are made of."""


def _refuse_unfit(robot: Robot, objects: Sequence[Transform], sensors: Sequence[str]) -> None:
    """Raise where a robot lacks what its inputs are read from, or what is to act on it."""
    for part in objects:
        if unread := [key for key in getattr(part, "every_step", ()) if key not in robot.sensors]:
            raise ValueError(
                f"{type(part).__name__} reads {unread}, but {robot.name} has the sensors {sorted(robot.sensors)}. Put "
                "into its hand what this task is about: b2z1(tool=Handle()) for a sled, with_bucket(robot, BUCKET) for "
                "a ball; or give your own robot a site with sensors of these names."
            )
    lacks = [f"sensors {key!r}" for key in sensors if key not in robot.sensors]
    lacks += [] if robot.base else ["a body with a free joint, its base"]
    lacks += [] if robot.ground else ["ground, a plane or a height field of the world, over which heights are measured"]
    if lacks:
        raise ValueError(
            f"{robot.name} lacks {'; '.join(lacks)}: neither commands nor falls could be told. Add them to its MJCF, "
            "and sensors to the robot's by these names; docs/whole_body.md, 'A robot of your own', lists what is read."
        )


def _refuse_other_times(parts: Sequence[Transform], dt: float) -> None:
    """Raise where a part takes its steps for longer or shorter than they are [s]."""
    for part in parts:
        told = getattr(part, "dt", dt)
        if not math.isclose(told, dt, rel_tol=1e-6):
            raise ValueError(
                f"{type(part).__name__} takes a step for {told:g} s, but where it stands one lasts {dt:g} s, so that "
                "its motion would be too fast or too slow. The tasks want a torque each 0.005 s and an action each "
                "0.02 s: give the robot such steps, with_options(robot, timestep=0.005), or finer ones and substeps=, "
                f"or make {type(part).__name__} with dt={dt:g}."
            )


def _frame_height(commands: CommandRanges | Sequence[Transform]) -> float:
    """Height of the frame in which the hand is commanded, by whatever writes the command last [m]."""
    if isinstance(commands, CommandRanges):
        return commands.frame_height
    last = next((part for part in reversed(commands) if "end_effector_command" in part.out_keys), None)
    return (last.ranges if isinstance(last, CommandSampler) else CommandRanges()).frame_height


def _sensing(chance: Disturbances, rows: Mapping[str, Any]) -> list[Transform]:
    """What stands between the joints and all that reads them."""
    if not any(chance.encoder_offset):
        return []
    return [EncoderOffset(*chance.encoder_offset, true_key="true_joint_position", **rows)]


def _starting(chance: Disturbances, rows: Mapping[str, Any]) -> list[Transform]:
    """What each episode starts with."""
    starting: list[Transform] = [] if chance.starts is None else [InitialState(chance.starts, **rows)]
    return starting + ([] if chance.randomization is None else [DomainRandomization(chance.randomization, **rows)])


def _scaling(
    robot: Robot, offset: Sequence[float] | None, scale: Mapping[str, float] | Sequence[float] | float | None
) -> ActionScaling:
    """Transforms from actions to position targets [rad]."""
    count = len(robot.joint_names)
    scale = ACTION_SCALE if scale is None else scale
    if isinstance(scale, Mapping):
        by_joint = {joint: value for group, value in scale.items() for joint in robot.joint_groups.get(group, ())}
        if missing := [name for joint, name in enumerate(robot.joint_names) if joint not in by_joint]:
            raise ValueError(
                f"action_scale knows the groups {sorted(scale)} and so not {missing}, which would never move. Give a "
                f"scale for each of {robot.name}'s groups, {sorted(robot.joint_groups)}, or for each joint."
            )
        scale = [by_joint[joint] for joint in range(count)]
    return ActionScaling(
        loc=torch.tensor(robot.default_pose if offset is None else offset, dtype=torch.float32),
        scale=torch.as_tensor(scale, dtype=torch.float32).expand(count).clone(),
    )


class Privileged(Transform):
    """Show the newest frame and other entries side by side, whatever their shapes. Shape (*B, D).

    Args:
        keys: Of the entries.
        out_key: Where to show them.
    """

    def __init__(self, keys: Sequence[NestedKey], out_key: NestedKey = "privileged") -> None:
        super().__init__(in_keys=["frame", *keys], out_keys=[out_key])

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        start = next_tensordict.batch_dims
        parts = [next_tensordict.get(key).flatten(start).float() for key in self.in_keys]
        return next_tensordict.set(self.out_keys[0], torch.cat(parts, -1))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        batch = observation_spec.shape
        width = sum(observation_spec[key].shape[len(batch) :].numel() for key in self.in_keys)
        observation_spec[self.out_keys[0]] = Unbounded((*batch, width), device=observation_spec.device)
        return observation_spec


class TrackingErrors(Transform):
    """Show how well commands are followed, under ``tracking``, for whoever watches a training. Shapes (*B, 1).

    ``position`` [m] and ``attitude`` [rad] of the end effector, ``keypoints`` [m], the mean distance of its four
    keypoints, ``velocity`` [m/s] in the plane and ``yaw_rate`` [rad/s] of the base.

    Args:
        length: Of the keypoints' axes, as of :class:`~torchrl_athletic.transforms.PoseError` [m].
    """

    def __init__(self, length: float = 0.3) -> None:
        keys = ["pose_error", "base_linear_velocity", "base_angular_velocity", "base_velocity_command"]
        names = ("position", "attitude", "keypoints", "velocity", "yaw_rate")
        super().__init__(in_keys=keys, out_keys=[("tracking", name) for name in names])
        self.length = length

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        way, linear, angular, command = (next_tensordict.get(key) for key in self.in_keys)
        far = torch.linalg.vector_norm(way, dim=-1)
        turned = torch.linalg.vector_norm(way[..., 1:, :] - way[..., :1, :], dim=(-2, -1)) / self.length
        velocity = torch.linalg.vector_norm(linear[..., :2] - command[..., :2], dim=-1)
        attitude = 2 * torch.asin((turned / 8**0.5).clamp(max=1))  # |R - R'| = 8^½ sin(θ / 2)
        yaw_rate = (angular[..., 2] - command[..., 2]).abs()
        errors = (far[..., 0], attitude, far.mean(-1), velocity, yaw_rate)
        for key, error in zip(self.out_keys, errors, strict=True):
            next_tensordict.set(key, error.unsqueeze(-1))
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        for key in self.out_keys:
            observation_spec[key] = Unbounded((*observation_spec.shape, 1), device=observation_spec.device)
        return observation_spec


def _known(env: TransformedEnv, keys: Sequence[NestedKey]) -> list[NestedKey]:
    shown = env.full_observation_spec.keys(True)
    return [key for key in keys if key in shown]


def fallen(tensordict: TensorDictBase) -> Tensor:
    """Whether the base is low over the ground or far from upright. Shape (N, 1)."""
    return (tensordict["base_height"] < FALL_HEIGHT) | (tensordict["projected_gravity"][..., 2:] > -FALL_UPRIGHT)


def _newest(history: Tensor) -> Tensor:
    return history[..., -1, :]
