"""A ball in a bucket, without contacts: carried by the bottom, guided by the walls, then in free flight.

The same few lines serve every simulator and every robot that can tell where its bucket is: none needs a contact solver
that others lack. What this leaves out: bounces (the bottom catches the ball without one), friction, the slack between
ball and walls, the ball's spin, and its weight on the arm, which carries it as part of the bucket.
"""

from __future__ import annotations

import torch
from torch import Tensor

GRAVITY = 9.81
"""[m/s²], downwards along z."""


def carry(
    position: Tensor,
    velocity: Tensor,
    bucket_position: Tensor,
    bucket_velocity: Tensor,
    axis: Tensor,
    axis_before: Tensor,
    depth: float,
    dt: float,
) -> tuple[Tensor, Tensor, Tensor]:
    r"""A ball in its bucket, one step later.

    Left alone it would fall freely for the step. How far it would then be above the bottom, along the axis,

    .. math:: s = (p + v\,dt + \tfrac{1}{2} g\,dt^2 - p_b) \cdot n,

    decides: at s ≤ 0 the bottom pushes, which is to say that the bucket's acceleration less gravity points out of the
    opening, and the ball moves with the bucket, or faster out of it if it already did. At 0 < s the ball slides out
    along the axis, the walls pushing it sideways alone; should the bottom catch up with it, it is carried again. At
    s ≥ depth it has left, with the velocity that it then has.

    Args:
        position: Of the ball [m]. Shape (*B, 3).
        velocity: Of the ball [m/s]. Shape (*B, 3).
        bucket_position: Where a ball that lies on the bottom has its centre, after the step [m]. Shape (*B, 3).
        bucket_velocity: Of that point, after the step [m/s]. Shape (*B, 3).
        axis: Where the bucket opens to, after the step, of unit length [1]. Shape (*B, 3).
        axis_before: Before the step. Shape (*B, 3).
        depth: Way of the ball's centre from the bottom to the rim [m].
        dt: [s].

    Returns:
        Position [m] and velocity [m/s], shape (*B, 3) each, and whether it has left, bool of shape (*B, 1).

    Example:
        >>> up, start = torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3)
        >>> def lift(speed):  # from rest, within 10 ms
        ...     bucket_velocity = torch.tensor([[0.0, 0.0, speed]])
        ...     return carry(start, start, 0.005 * bucket_velocity, bucket_velocity, up, up, depth=0.045, dt=0.01)
        >>> [round(float(lift(speed)[1][0, 2]), 3) for speed in (1.0, -0.05, -1.0)]  # the last falls behind its bucket
        [1.0, -0.05, -0.098]
    """
    free_position, free_velocity = fall(position, velocity, dt)
    above = ((free_position - bucket_position) * axis).sum(-1, keepdim=True)
    carried = above <= 0
    left = above >= depth
    above = above.clamp(min=0)
    walls = bucket_velocity + above * (axis - axis_before) / dt
    out = ((free_velocity - walls) * axis).sum(-1, keepdim=True)
    out = torch.where(carried, out.clamp(min=0), out)
    inside = bucket_position + above * axis, walls + out * axis
    return torch.where(left, free_position, inside[0]), torch.where(left, free_velocity, inside[1]), left


def fall(position: Tensor, velocity: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Free flight for a while, without drag.

    Args:
        position: [m]. Shape (*B, 3).
        velocity: [m/s]. Shape (*B, 3).
        dt: [s].

    Returns:
        Position [m] and velocity [m/s]. Shape (*B, 3) each.

    Example:
        >>> [round(float(x[2]), 3) for x in fall(torch.zeros(3), torch.tensor([0.0, 0.0, 9.81]), dt=1.0)]
        [4.905, 0.0]
    """
    gained = torch.zeros_like(velocity)
    gained[..., 2] = -GRAVITY * dt
    return position + (velocity + 0.5 * gained) * dt, velocity + gained


def landing(position: Tensor, velocity: Tensor, height: float = 0.0) -> Tensor:
    r"""Where a ball in free flight comes down to a height.

    .. math:: t = \frac{v_z + \sqrt{v_z^2 + 2 g (z - h)}}{g}, \quad (x, y) + (v_x, v_y)\,t

    Args:
        position: [m]. Shape (*B, 3).
        velocity: [m/s]. Shape (*B, 3).
        height: h [m]. A ball below it counts as landed where it is highest.

    Returns:
        x and y [m]. Shape (*B, 2).

    Example:
        >>> landing(torch.tensor([0.0, 0.0, 1.0]), torch.tensor([2.0, 0.0, 0.0]))[0] / 2  # sqrt(2 h / g)
        tensor(0.4515)
    """
    upwards = velocity[..., 2:]
    fallen = (upwards.square() + 2 * GRAVITY * (position[..., 2:] - height)).clamp(min=0).sqrt()
    return position[..., :2] + velocity[..., :2] * ((upwards + fallen) / GRAVITY)


def fly(position: Tensor, velocity: Tensor, dt: float, height: float = 0.0) -> tuple[Tensor, Tensor]:
    """Free flight until the ball comes down to a height, where it stays.

    Args:
        position: [m]. Shape (*B, 3).
        velocity: [m/s]. Shape (*B, 3).
        dt: [s].
        height: [m].

    Returns:
        Position [m] and velocity [m/s]. Shape (*B, 3) each.
    """
    later, gained = fall(position, velocity, dt)
    down = later[..., 2:] <= height
    place = torch.cat((landing(position, velocity, height), torch.full_like(position[..., 2:], height)), -1)
    return torch.where(down, place, later), gained.masked_fill(down, 0.0)
