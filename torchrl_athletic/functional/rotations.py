"""Attitudes as unit quaternions (w, x, y, z), MuJoCo's order; ``body_to_world`` turns body axes into world axes."""

from __future__ import annotations

import torch
from torch import Tensor


def conjugate(quaternion: Tensor) -> Tensor:
    """The opposite turn. Shape (*B, 4)."""
    return torch.cat((quaternion[..., :1], -quaternion[..., 1:]), -1)


def multiply(second: Tensor, first: Tensor) -> Tensor:
    """Turn by ``first``, then by ``second``. Shape (*B, 4).

    Example:
        >>> quarter = torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5])
        >>> multiply(quarter, quarter).round(decimals=3).tolist()  # half a turn about z
        [0.0, 0.0, 0.0, 1.0]
    """
    w, v = second[..., :1], second[..., 1:]
    w_, v_ = first[..., :1], first[..., 1:]
    return torch.cat((w * w_ - (v * v_).sum(-1, keepdim=True), w * v_ + w_ * v + torch.linalg.cross(v, v_, dim=-1)), -1)


def rotate(body_to_world: Tensor, vector: Tensor) -> Tensor:
    """A vector of the body in world axes.

    Args:
        body_to_world: Shape (*B, 4).
        vector: Shape (*B, 3), in body axes.

    Returns:
        Shape (*B, 3).

    Example:
        >>> quarter = torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5])  # about z
        >>> rotate(quarter, torch.tensor([1.0, 0.0, 0.0])).round(decimals=3).tolist()
        [0.0, 1.0, 0.0]
    """
    w, v = body_to_world[..., :1], body_to_world[..., 1:]
    twice = 2 * torch.linalg.cross(v, vector, dim=-1)
    return vector + w * twice + torch.linalg.cross(v, twice, dim=-1)


def rotate_inverse(body_to_world: Tensor, vector: Tensor) -> Tensor:
    """A vector of the world in body axes. Shapes as of :func:`rotate`."""
    return rotate(conjugate(body_to_world), vector)


def projected_gravity(body_to_world: Tensor) -> Tensor:
    """Which way is down, seen from the body: (0, 0, -1) when it stands upright. Shape (*B, 3).

    Example:
        >>> upright = torch.tensor([1.0, 0.0, 0.0, 0.0])
        >>> projected_gravity(upright).abs().tolist()
        [0.0, 0.0, 1.0]
    """
    w, x, y, z = body_to_world.unbind(-1)
    return torch.stack((2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1), -1)


def yaw(body_to_world: Tensor) -> Tensor:
    """Heading about the vertical [rad]. Shape (*B, 1)."""
    w, x, y, z = body_to_world.unbind(-1)
    sine, cosine = 2 * (w * z + x * y), 1 - 2 * (y * y + z * z)
    angle = torch.atan2(sine.double(), cosine.double())  # in float32 its last bit depends on the size of the batch
    return angle.to(body_to_world.dtype).unsqueeze(-1)


def yaw_quaternion(angle: Tensor) -> Tensor:
    """The turn about the vertical by an angle [rad]. Shape (*B, 1) to (*B, 4)."""
    half, zero = angle / 2, torch.zeros_like(angle)
    return torch.cat((half.cos(), zero, zero, half.sin()), -1)


def matrix(body_to_world: Tensor) -> Tensor:
    """Rotation matrix, whose columns are the body's axes in the world. Shape (*B, 4) to (*B, 3, 3).

    Example:
        >>> matrix(torch.tensor([1.0, 0.0, 0.0, 0.0])).tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    xx, xy, xz, yy, yz, zz, wx, wy, wz = _twice_products(body_to_world)
    rows = (1 - (yy + zz), xy - wz, xz + wy, xy + wz, 1 - (xx + zz), yz - wx, xz - wy, yz + wx, 1 - (xx + yy))
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def two_columns(body_to_world: Tensor) -> Tensor:
    """First two columns of :func:`matrix`, a continuous code of the attitude. Shape (*B, 4) to (*B, 6).

    Source:
        Zhou et al. 2019, https://arxiv.org/abs/1812.07035; Fey et al. 2025, section II-B.
    """
    xx, xy, xz, yy, yz, zz, wx, wy, wz = _twice_products(body_to_world)
    return torch.stack((1 - (yy + zz), xy + wz, xz - wy, xy - wz, 1 - (xx + zz), yz + wx), -1)


def from_two_columns(columns: Tensor) -> Tensor:
    """Rotation matrix of :func:`two_columns`, made orthonormal. Shape (*B, 6) to (*B, 3, 3)."""
    first, second = columns[..., :3], columns[..., 3:]
    x = torch.nn.functional.normalize(first, dim=-1)
    y = torch.nn.functional.normalize(second - (x * second).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack((x, y, torch.linalg.cross(x, y, dim=-1)), -1)


def keypoints(position: Tensor, rotation: Tensor, length: float = 1.0) -> Tensor:
    """A frame as four points: its origin and one on each axis, so that one distance holds position and attitude.

    Args:
        position: Of the origin [m]. Shape (*B, 3).
        rotation: Shape (*B, 3, 3).
        length: Of the axes [m].

    Returns:
        [m]. Shape (*B, 4, 3).

    Source:
        Fey et al. 2025, section II-B, reward function.
    """
    axes = position.unsqueeze(-2) + length * rotation.transpose(-2, -1)
    return torch.cat((position.unsqueeze(-2), axes), -2)


def _twice_products(quaternion: Tensor) -> tuple[Tensor, ...]:
    """2xx, 2xy, 2xz, 2yy, 2yz, 2zz, 2wx, 2wy, 2wz: all that a rotation matrix is made of. Shape (*B,) each."""
    w, x, y, z = quaternion.unbind(-1)
    _, x2, y2, z2 = (2 * quaternion).unbind(-1)
    return x * x2, x * y2, x * z2, y * y2, y * z2, z * z2, w * x2, w * y2, w * z2
