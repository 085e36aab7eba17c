"""What a whole-body controller is told to do: a velocity of its base and a pose of its end effector."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchrl_athletic.functional import rotations, streams

Range = tuple[float, float]
Place = tuple[float, float, float]
VELOCITY, PLACE, ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 10)
"""Columns of a goal: base velocity; the hand's distance from the shoulder, elevation and azimuth; its attitude from the
line of sight (wxyz)."""

PLACES = ("distance", "elevation", "azimuth")


@dataclass(frozen=True)
class CommandRanges:
    """What commands are drawn from, and when.

    The paper gives the times and no ranges. Those of the velocity are round figures within what the robot can do.
    Places of the hand are drawn about the arm's shoulder, by distance and two angles, as Fu et al. do: the way from one
    to another leads around the robot, where a straight line would lead through it. Elevations go from the ground ahead
    to behind the head, since athletic tasks take the hand to both. Attitudes are drawn about the line of sight from the
    shoulder, which is how an arm points: ``benchmarks/command_reach.py`` says how many goals can be reached.
    """

    forward: Range = (-1.0, 1.0)
    """Velocity along the base's heading [m/s]."""
    lateral: Range = (-0.5, 0.5)
    """Velocity to the left [m/s]."""
    yaw_rate: Range = (-1.0, 1.0)
    """Counter-clockwise [rad/s]."""
    standstill_probability: float = 0.1
    """Probability that a goal's velocity is 0 instead."""
    distance: Range = (0.5, 0.9)
    """Distance of the hand from the shoulder [m]."""
    elevation: Range = (math.radians(-48), math.radians(135))
    """Elevation of the hand over the shoulder's horizon [rad]; more than a right angle is behind it."""
    azimuth: Range = (-math.pi / 6, math.pi / 6)
    """Azimuth of the plane in which the hand is elevated, counter-clockwise [rad]."""
    roll: Range = (-math.pi / 4, math.pi / 4)
    """Roll of the end effector about its own x axis [rad]; last of the three turns in its own axes."""
    pitch: Range = (-math.pi / 9, math.pi / 4)
    """Pitch from the line of sight, nose down [rad]."""
    yaw: Range = (-math.pi / 6, math.pi / 6)
    """Yaw from the line of sight, about the axis that a forearm along it would have upwards [rad]."""
    shoulder: Place = (0.15, 0.0, 0.25)
    """Where it is in the commands' frame [m]: that of the Z1 on a B2."""
    frame_height: float = 0.5
    """Height of the commands' frame above the ground [m]; it follows the base's place and heading and stays upright."""
    interval: float = 7.0
    """Time between goals [s]."""
    duration: Range = (2.0, 5.0)
    """Duration of the way from the command before to a goal [s], drawn for velocity and pose apart."""
    straighten: float = 0.0
    """While the robot is told to walk, command it back to the line on which its episode began, at this rate [1/s]."""
    box: tuple[Range, Range, Range] | None = None
    """Draw places from a box in the commands' frame, and not by distance, elevation and azimuth: ahead, to the left and
    upwards [m]."""

    def __post_init__(self) -> None:
        if self.box and (told := [name for name in PLACES if getattr(self, name) != getattr(CommandRanges, name)]):
            raise ValueError(f"places are drawn from the box {self.box}, so {told} would be ignored. Give one of both.")
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
        """Lower and upper bounds of what :func:`draw_goal` draws, which needs ``box_from`` for a box. Shape (2, 11)."""
        return torch.tensor(list(self._ranges().values())).T.contiguous()

    def draw(self, key: Tensor) -> tuple[Tensor, Tensor]:
        """Goals and durations as :func:`draw_goal` gives them, from a box where there is one. ``key``: shape (*B,)."""
        shoulder = torch.tensor(self.shoulder) if self.box else None
        return draw_goal(key, self.bounds(), self.standstill_probability, shoulder)

    def centre(self) -> Tensor:
        """A goal in the middle of the ranges, at rest, pointing away from the shoulder. Shape (10,)."""
        middle = self.bounds().mean(0)[PLACE]
        if self.box:
            middle = place_of(middle, torch.tensor(self.shoulder))
        return torch.cat((torch.zeros(3), middle, torch.tensor([1.0, 0.0, 0.0, 0.0])))

    def _ranges(self) -> dict[str, Range]:
        sides = ("box ahead", "box to the left", "box upwards")
        place = dict(zip(sides, self.box, strict=True)) if self.box else self._named(PLACES)
        return {
            **self._named(("forward", "lateral", "yaw_rate")),
            **place,
            **self._named(("roll", "pitch", "yaw")),
            "duration of velocity": self.duration,
            "duration of pose": self.duration,
        }

    def _named(self, names: Sequence[str]) -> dict[str, Range]:
        return {name: getattr(self, name) for name in names}


CommandName = Literal["around", "ahead", "box"]


def command_ranges(name: str) -> CommandRanges:
    """Ranges of a pre-training, by name.

    Args:
        name: ``"around"``, the defaults, which reach from the ground ahead to behind the head; ``"ahead"``, from the
            ground to a little over the shoulder, which is where pre-trainings of others have the hand; or ``"box"``,
            ahead of the robot, but no nearer than 0.5 m, on which the shipped ``wbc`` was trained.

    Raises:
        ValueError: If there are no such ranges.

    Source:
        Fu, Cheng and Pathak 2023, section 3: at most 0.8 m from the shoulder (``"ahead"``).

    Example:
        >>> command_ranges("ahead").distance
        (0.4, 0.8)
    """
    ahead = CommandRanges(distance=(0.4, 0.8), elevation=(math.radians(-50), math.radians(35)))
    box = CommandRanges(box=((0.5, 0.8), (-0.3, 0.3), (-0.25, 0.5)))
    known = {"around": CommandRanges(), "ahead": ahead, "box": box}
    if name not in known:
        raise ValueError(f"there are no commands {name!r}; there are {sorted(known)}.")
    return known[name]


def sled_commands() -> CommandRanges:
    """Backwards at 0 to 1 m/s four times in five, otherwise stand; kept on a straight line.

    Source:
        Fey et al. 2025, appendix B-C.
    """
    return CommandRanges(
        forward=(-1.0, 0.0), lateral=(0.0, 0.0), yaw_rate=(0.0, 0.0), standstill_probability=0.2, straighten=0.5
    )


def draw_goal(
    key: Tensor, bounds: Tensor, standstill_probability: float = 0.0, box_from: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """A goal, and how long the way to it takes.

    Args:
        key: Of :func:`~.streams.stream`. Shape (*B,).
        bounds: Of :meth:`CommandRanges.bounds`. Shape (2, 11).
        standstill_probability: That the velocity is 0.
        box_from: The shoulder [m], where the bounds are those of a box. Shape (3,).

    Returns:
        Goal: base velocity [m/s, m/s, rad/s]; the hand's distance [m], elevation and azimuth [rad]; its quaternion
        (wxyz) from the line of sight. :func:`goal_to_pose` says where that is. Shape (*B, 10). Durations for velocity
        and for pose [s]. Shape (*B, 2).

    Source:
        Fu, Cheng and Pathak 2023, Deep Whole-Body Control, section 3 (distances and angles of goals).

    Example:
        >>> goal, duration = draw_goal(streams.stream(0, torch.arange(100)), CommandRanges().bounds())
        >>> goal.shape, bool(((duration >= 2) & (duration < 5)).all())
        (torch.Size([100, 10]), True)
    """
    unit = streams.uniform(key, 12)
    drawn = bounds[0] + (bounds[1] - bounds[0]) * unit[..., 1:]
    velocity, place, angles, duration = drawn.split((3, 3, 3, 2), -1)
    velocity = torch.where(unit[..., :1] < standstill_probability, torch.zeros_like(velocity), velocity)
    if box_from is not None:
        place = place_of(place, box_from)
    return torch.cat((velocity, place, from_roll_pitch_yaw(angles)), -1), duration


def goal_to_pose(goal: Tensor, shoulder: Tensor) -> Tensor:
    """Where a goal has the hand; :func:`pose_to_goal` undoes it.

    Args:
        goal: As of :func:`draw_goal`. Shape (*B, 10).
        shoulder: In the commands' frame [m]. Shape (3,).

    Returns:
        Position [m] and quaternion (wxyz) in the commands' frame. Shape (*B, 7).

    Example:
        >>> overhead = torch.tensor([0, 0, 0, 0.8, math.pi / 2, 0, 1, 0, 0, 0])
        >>> goal_to_pose(overhead, torch.tensor([0.1, 0.0, 0.2]))[:3].round(decimals=3).tolist()
        [0.10000000149011612, 0.0, 1.0]
    """
    distance, elevation, azimuth = goal[..., PLACE].split(1, -1)
    ahead, up = elevation.cos(), elevation.sin()
    sight = torch.cat((ahead * azimuth.cos(), ahead * azimuth.sin(), up), -1)
    attitude = rotations.multiply(_aim(elevation, azimuth), goal[..., ATTITUDE])
    return torch.cat((shoulder + distance * sight, attitude), -1)


def pose_to_goal(pose: Tensor, shoulder: Tensor) -> Tensor:
    """A pose of the hand as a goal at rest.

    Args:
        pose: Position [m] and quaternion (wxyz) in the commands' frame. Shape (*B, 7).
        shoulder: There too [m]. Shape (3,).

    Returns:
        Shape (*B, 10).
    """
    place = place_of(pose[..., :3], shoulder)
    _, elevation, azimuth = place.split(1, -1)
    attitude = rotations.multiply(rotations.conjugate(_aim(elevation, azimuth)), pose[..., 3:])
    return torch.cat((torch.zeros_like(place), place, attitude), -1)


def place_of(position: Tensor, shoulder: Tensor) -> Tensor:
    """Distance [m], elevation and azimuth [rad] of a place, seen from the shoulder.

    Azimuths lie within a right angle, so that what is behind the shoulder is elevated by more than one; what is behind
    and below is told by elevations of up to one and a half half-turns.

    Args:
        position: In the commands' frame [m]. Shape (*B, 3).
        shoulder: There too [m]. Shape (3,).

    Returns:
        Shape (*B, 3).

    Example:
        >>> place_of(torch.tensor([0.0, 0.0, 0.8]), torch.zeros(3)).tolist()  # overhead
        [0.800000011920929, 1.5707963705062866, 0.0]
    """
    way = position - shoulder
    x, y, z = way.split(1, -1)
    behind = x < 0
    level = torch.where(behind, -1.0, 1.0) * torch.hypot(x, y)
    azimuth = torch.atan2(torch.where(behind, -y, y), x.abs())
    elevation = torch.atan2(z, level)
    elevation = torch.where(behind & (z < 0), elevation + 2 * math.pi, elevation)
    return torch.cat((torch.linalg.vector_norm(way, dim=-1, keepdim=True), elevation, azimuth), -1)


def _aim(elevation: Tensor, azimuth: Tensor) -> Tensor:
    """Attitude whose x axis is the line of sight. Angles (*B, 1), quaternion (*B, 4)."""
    return from_roll_pitch_yaw(torch.cat((torch.zeros_like(azimuth), -elevation, azimuth), -1))


def blend_goals(start: Tensor, goal: Tensor, elapsed: Tensor, duration: Tensor) -> Tensor:
    r"""The command on the way from one goal to the next.

    Velocity, distance and angles change at constant speed. The attitude turns with the line of sight, and from it about
    one axis, the shorter way (normalised linear interpolation of quaternions: the path of slerp, in the middle faster
    by 5 % on a quarter turn and by 27 % on half a turn).

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
    alike = (start[..., ATTITUDE] * goal[..., ATTITUDE]).sum(-1, keepdim=True)
    nearer = torch.where(alike < 0, -of_pose, of_pose)  # q and -q are one attitude: take the nearer
    left, reached = _for_each((1 - share).split(1, -1), (3, 7)), _for_each((of_velocity, of_pose, nearer), (3, 3, 4))
    blended = start * left + goal * reached
    attitude = torch.nn.functional.normalize(blended[..., ATTITUDE], dim=-1)
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
