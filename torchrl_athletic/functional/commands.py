"""What a whole-body controller is told to do: a velocity of its base and a pose of its end effector."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_athletic.functional import rotations, streams

Range = tuple[float, float]
Place = tuple[float, float, float]
VELOCITY, POSITION, QUATERNION = slice(0, 3), slice(3, 6), slice(6, 10)
"""Columns of a goal: base velocity, end effector's position and attitude (wxyz)."""


@dataclass(frozen=True)
class CommandRanges:
    """What commands are drawn from, and when.

    The paper gives the times and no ranges. Those of the velocity are round figures within what the robot can do. The
    box of positions is what the Z1 on a B2 reaches with some help of the legs; Fu et al. draw from a part of a sphere
    shell instead, 0.2 to 0.7 m about the arm's base for a smaller robot. A box is convex: the straight way from one of
    its points to another lies in it, so that no command leads through the robot. A gripper that points away from the
    shoulder reaches low goals from above and high ones from below: with attitudes about this line of sight, 95 % of the
    goals bring the hand's key points to a mean distance of under 2 cm, by the arm on a base that moves by 0.1 m and
    tilts by 0.25 rad; with attitudes about the base's heading, 72 % (``benchmarks/command_reach.py``).
    """

    forward: Range = (-1.0, 1.0)
    """Velocity along the base's heading [m/s]."""
    lateral: Range = (-0.5, 0.5)
    """To the left [m/s]."""
    yaw_rate: Range = (-1.0, 1.0)
    """Counter-clockwise [rad/s]."""
    standstill_probability: float = 0.1
    """That a goal's velocity is 0 instead."""
    x: Range = (0.5, 0.8)
    """Ahead of the base's origin [m]."""
    y: Range = (-0.3, 0.3)
    """To its left [m]."""
    z: Range = (-0.25, 0.5)
    """Above ``frame_height`` [m]."""
    roll: Range = (-math.pi / 4, math.pi / 4)
    """Of the end effector about its own x axis [rad]; last of the three turns in its own axes."""
    pitch: Range = (-math.pi / 9, math.pi / 4)
    """Nose down, from the line of sight [rad]."""
    yaw: Range = (-math.pi / 6, math.pi / 6)
    """About the vertical, from the line of sight [rad]."""
    shoulder: Place | None = (0.15, 0.0, 0.25)
    """Where lines of sight to goals begin, in the commands' frame [m]: the Z1's on a B2. None looks ahead."""
    frame_height: float = 0.5
    """Of the commands' frame above the ground [m]. It follows the base's place and heading, and stays upright."""
    interval: float = 7.0
    """Between goals [s]."""
    duration: Range = (2.0, 5.0)
    """Of the way from the command before to a goal [s], drawn for velocity and pose apart."""
    straighten: float = 0.0
    """While the robot is told to walk, command it back to the line on which its episode began, at this rate [1/s]."""

    def __post_init__(self) -> None:
        for name, (low, high) in self._ranges().items():
            if not low <= high:
                raise ValueError(f"{name} is ({low}, {high}): nothing lies between. Give the lower bound first.")
        if not 0 < self.duration[0] <= self.duration[1] <= self.interval:
            raise ValueError(
                f"a way of {self.duration} s to a goal that is replaced after {self.interval} s: needed is more than 0 "
                "and at most the interval, or goals would never be reached."
            )
        if not 0 <= self.standstill_probability <= 1:
            raise ValueError(f"standstill_probability is {self.standstill_probability}, needed is 0 to 1.")

    def bounds(self) -> Tensor:
        """Lower and upper bounds of what :func:`draw_goal` draws. Shape (2, 11)."""
        return torch.tensor(list(self._ranges().values())).T.contiguous()

    def centre(self) -> Tensor:
        """A goal in the middle of the box, at rest, pointing ahead. Shape (10,)."""
        middle = self.bounds().mean(0)[POSITION]
        return torch.cat((torch.zeros(3), middle, torch.tensor([1.0, 0.0, 0.0, 0.0])))

    def _ranges(self) -> dict[str, Range]:
        names = ("forward", "lateral", "yaw_rate", "x", "y", "z", "roll", "pitch", "yaw")
        ranges: dict[str, Range] = {name: getattr(self, name) for name in names}
        return ranges | {"duration of velocity": self.duration, "duration of pose": self.duration}


def sled_commands() -> CommandRanges:
    """Backwards at 0 to 1 m/s four times in five, otherwise stand; kept on a straight line.

    Source:
        Fey et al. 2025, appendix B-C.
    """
    return CommandRanges(
        forward=(-1.0, 0.0), lateral=(0.0, 0.0), yaw_rate=(0.0, 0.0), standstill_probability=0.2, straighten=0.5
    )


def draw_goal(
    key: Tensor, bounds: Tensor, standstill_probability: float = 0.0, shoulder: Place | None = None
) -> tuple[Tensor, Tensor]:
    """A goal, and how long the way to it takes.

    Args:
        key: Of :func:`~.streams.stream`. Shape (*B,).
        bounds: Of :meth:`CommandRanges.bounds`. Shape (2, 11).
        standstill_probability: That the velocity is 0.
        shoulder: Where the line of sight begins about which attitudes are drawn [m]; None for the heading.

    Returns:
        Goal: base velocity [m/s, m/s, rad/s], end effector's position [m] and quaternion (wxyz) in the commands' frame.
        Shape (*B, 10). Durations for velocity and for pose [s]. Shape (*B, 2).

    Example:
        >>> goal, duration = draw_goal(streams.stream(0, torch.arange(100)), CommandRanges().bounds())
        >>> goal.shape, bool(((duration >= 2) & (duration < 5)).all())
        (torch.Size([100, 10]), True)
    """
    unit = streams.uniform(key, 12)
    drawn = bounds[0] + (bounds[1] - bounds[0]) * unit[..., 1:]
    velocity, position, angles, duration = drawn.split((3, 3, 3, 2), -1)
    velocity = torch.where(unit[..., :1] < standstill_probability, torch.zeros_like(velocity), velocity)
    if shoulder is not None:
        angles = angles + line_of_sight(position, shoulder)
    return torch.cat((velocity, position, from_roll_pitch_yaw(angles)), -1), duration


def line_of_sight(position: Tensor, shoulder: Place) -> Tensor:
    """Roll, pitch and yaw of what points from the shoulder to a place [rad]. Shape (*B, 3).

    Args:
        position: In the commands' frame [m]. Shape (*B, 3).
        shoulder: There too [m].

    Example:
        >>> line_of_sight(torch.tensor([1.0, 0.0, -1.0]), (0.0, 0.0, 0.0)).tolist()  # half a right angle down
        [0.0, 0.7853981852531433, 0.0]
    """
    x, y, z = (position[..., k] - shoulder[k] for k in range(3))
    return torch.stack((torch.zeros_like(x), torch.atan2(-z, torch.hypot(x, y)), torch.atan2(y, x)), -1)


def blend_goals(start: Tensor, goal: Tensor, elapsed: Tensor, duration: Tensor) -> Tensor:
    r"""The command on the way from one goal to the next.

    Velocity and position move on a straight line at constant speed. The attitude turns about one axis, the shorter way
    (normalised linear interpolation of quaternions: the path of slerp, in the middle faster by 5 % on a quarter
    turn and by 27 % on half a turn).

    Args:
        start: What was commanded before. Shape (*B, 10), as of :func:`draw_goal`.
        goal: Shape (*B, 10).
        elapsed: Since the goal was set [s]. Shape (*B, 1).
        duration: Of the way, for velocity and pose [s]. Shape (*B, 2).

    Returns:
        Shape (*B, 10).

    Example:
        >>> start, goal = CommandRanges().centre(), CommandRanges().centre()
        >>> goal[0] = 1.0
        >>> blend_goals(start, goal, torch.tensor([1.0]), torch.tensor([4.0, 2.0]))[0].item()
        0.25
    """
    share = (elapsed / duration).clamp(max=1.0)
    of_velocity, of_pose = share.split(1, -1)
    alike = (start[..., QUATERNION] * goal[..., QUATERNION]).sum(-1, keepdim=True)
    nearer = torch.where(alike < 0, -of_pose, of_pose)  # q and -q are one attitude: take the nearer
    left, reached = _for_each((1 - share).split(1, -1), (3, 7)), _for_each((of_velocity, of_pose, nearer), (3, 3, 4))
    blended = start * left + goal * reached
    attitude = torch.nn.functional.normalize(blended[..., QUATERNION], dim=-1)
    return torch.cat((blended[..., :6], attitude), -1)


def straighten(velocity: Tensor, lateral: Tensor, heading: Tensor, rate: float = 0.5) -> Tensor:
    r"""Velocity command that leads back to a line, where it commands to walk.

    .. math:: v_y = -k\,\delta y, \quad \omega_z = -k\,\delta\theta \quad \text{if } v_x \ne 0

    Args:
        velocity: Command [m/s, m/s, rad/s]. Shape (*B, 3).
        lateral: Deviation to the left of the line [m]. Shape (*B, 1).
        heading: Deviation from its direction, counter-clockwise [rad]. Shape (*B, 1).
        rate: k [1/s].

    Returns:
        Shape (*B, 3).

    Source:
        Fey et al. 2025, appendix B-C.

    Example:
        >>> straighten(torch.tensor([-0.5, 0.0, 0.0]), torch.tensor([0.2]), torch.tensor([-0.4])).tolist()
        [-0.5, -0.10000000149011612, 0.20000000298023224]
    """
    forward = velocity[..., :1]
    back = torch.cat((forward, -rate * lateral, -rate * heading), -1)
    return torch.where(forward != 0, back, velocity)


def deviation_from_line(line: Tensor, position: Tensor, quaternion: Tensor) -> tuple[Tensor, Tensor]:
    """How far a base has left the line on which it began.

    Args:
        line: Of :func:`line_ahead`. Shape (*B, 3).
        position: Of the base, in the world [m]. Shape (*B, 3).
        quaternion: Its attitude. Shape (*B, 4).

    Returns:
        To the left of the line [m], and counter-clockwise from its direction, -π to π [rad]. Shape (*B, 1) each.
    """
    x, y, angle = line.split(1, -1)
    lateral = (position[..., 1:2] - y) * angle.cos() - (position[..., :1] - x) * angle.sin()
    turned = rotations.yaw(quaternion) - angle
    return lateral, torch.remainder(turned + math.pi, 2 * math.pi) - math.pi


def line_ahead(position: Tensor, quaternion: Tensor) -> Tensor:
    """Where a base stands and where it heads: x, y [m] and yaw [rad]. Shape (*B, 3)."""
    return torch.cat((position[..., :2], rotations.yaw(quaternion)), -1)


def pose_to_frame(
    position: Tensor,
    quaternion: Tensor,
    base_position: Tensor,
    base_quaternion: Tensor,
    frame_height: float,
    ground_height: Tensor | float = 0.0,
) -> Tensor:
    """A pose in the world as the commands' frame sees it; :func:`pose_to_world` undoes it.

    The frame stands above the ground at a fixed height, at the base's place and heading, and stays upright.

    Args:
        position: In the world [m]. Shape (*B, 3).
        quaternion: wxyz. Shape (*B, 4).
        base_position: [m]. Shape (*B, 3).
        base_quaternion: Shape (*B, 4).
        frame_height: Above the ground [m].
        ground_height: Of the ground under the base, in the world [m]. Shape (*B, 1) or ().

    Returns:
        Position and quaternion. Shape (*B, 7).
    """
    heading = rotations.yaw_quaternion(rotations.yaw(base_quaternion))
    seen = rotations.rotate_inverse(heading, position - _origin(base_position, frame_height + ground_height))
    return torch.cat((seen, rotations.multiply(rotations.conjugate(heading), quaternion)), -1)


def pose_to_world(
    command: Tensor,
    base_position: Tensor,
    base_quaternion: Tensor,
    frame_height: float,
    ground_height: Tensor | float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Where an end-effector command is in the world, as rewards need it.

    Args:
        command: Position [m] and the first two columns of the rotation matrix, in the commands' frame. Shape (*B, 9).
        base_position: [m]. Shape (*B, 3).
        base_quaternion: Shape (*B, 4).
        frame_height: Above the ground [m].
        ground_height: Of the ground under the base, in the world [m]. Shape (*B, 1) or ().

    Returns:
        Position [m], shape (*B, 3), and rotation matrix, shape (*B, 3, 3), as :func:`~.rotations.keypoints` takes them.

    Source:
        Fey et al. 2025, section II-B, task specification.

    Example:
        >>> ahead = torch.tensor([0.5, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
        >>> left = rotations.yaw_quaternion(torch.tensor([math.pi / 2]))
        >>> pose_to_world(ahead, torch.tensor([2.0, 0.0, 0.3]), left, 0.5)[0].round(decimals=3).tolist()
        [2.0, 0.5, 0.6000000238418579]
    """
    heading = rotations.yaw(base_quaternion)
    cosine, sine = heading.cos(), heading.sin()
    x, y, z = command.unflatten(-1, (3, 3)).unbind(-1)  # of the position and the two columns at once
    turned = torch.stack((cosine * x - sine * y, sine * x + cosine * y, z), -1)
    position = _origin(base_position, frame_height + ground_height) + turned[..., 0, :]
    return position, rotations.from_two_columns(turned[..., 1:, :].flatten(-2))


def from_roll_pitch_yaw(angles: Tensor) -> Tensor:
    """Quaternion of a turn by yaw about z, then by pitch about the new y, then by roll about the new x [rad].

    Args:
        angles: Roll, pitch, yaw. Shape (*B, 3).

    Returns:
        wxyz. Shape (*B, 4).
    """
    (cr, cp, cy), (sr, sp, sy) = (half.unbind(-1) for half in ((angles / 2).cos(), (angles / 2).sin()))
    return torch.stack(
        (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ),
        -1,
    )


def _for_each(shares: Sequence[Tensor], widths: Sequence[int]) -> Tensor:
    """Each share, shape (*B, 1), as often as its part of a goal is wide. Shape (*B, sum of widths)."""
    return torch.cat([share.expand(*share.shape[:-1], width) for share, width in zip(shares, widths, strict=True)], -1)


def _origin(base_position: Tensor, height: Tensor | float) -> Tensor:
    return torch.cat((base_position[..., :2], torch.zeros_like(base_position[..., :1]) + height), -1)
