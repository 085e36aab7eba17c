"""Mass, centre of mass and inertia of a rigid body, and what happens to them when bodies are bolted together."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Inertial:
    """Mass, centre and inertia of one rigid body, in its own frame."""

    mass: float
    """[kg]."""
    centre: Vector
    """Centre of mass [m]."""
    tensor: tuple[float, float, float, float, float, float]
    """Moments xx, yy, zz and products xy, xz, yz about the centre of mass, on axes parallel to the frame [kg·m²]."""

    def matrix(self) -> NDArray[np.float64]:
        """The tensor as a symmetric matrix [kg·m²]. Shape (3, 3)."""
        xx, yy, zz, xy, xz, yz = self.tensor
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def mirrored(self, axis: int) -> Inertial:
        """The body's image in the plane through the origin across an axis: 0 swaps front and rear, 1 left and right."""
        flip = np.ones(3)
        flip[axis] = -1.0
        return _inertial(self.mass, flip * self.centre, flip[:, None] * self.matrix() * flip)


def combine(*parts: Inertial) -> Inertial:
    r"""Bolt bodies together that share a frame.

    .. math:: I = \sum_i I_i + m_i (|d_i|^2 1 - d_i d_i^\top), \qquad d_i = c_i - c

    Args:
        parts: At least one.

    Returns:
        Total mass m, common centre of mass c and the tensor I about it.

    Source:
        Parallel-axis theorem of Steiner and Huygens, in tensor form.

    Example:
        >>> left, right = (Inertial(1.0, (0.0, y, 0.0), (0.0,) * 6) for y in (-2.0, 2.0))
        >>> combine(left, right).tensor[:3]  # two point masses: 2 m r² about x and z, nothing about y
        (8.0, 0.0, 8.0)
    """
    mass = sum(part.mass for part in parts)
    centre = sum((part.mass * np.array(part.centre) for part in parts), np.zeros(3)) / mass
    matrix = np.zeros((3, 3))
    for part in parts:
        d = np.array(part.centre) - centre
        matrix += part.matrix() + part.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return _inertial(mass, centre, matrix)


def box(mass: float, size: Vector, centre: Vector, hollow: Vector = (0.0, 0.0, 0.0)) -> Inertial:
    """Box of even density with an optional hole of a box's shape at its centre: a tube is a hole as long as the box.

    Args:
        mass: Of what is left [kg].
        size: Edge lengths [m].
        centre: [m].
        hollow: Edge lengths of the hole [m].

    Example:
        >>> box(12.0, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0)).tensor[:3]
        (13.0, 10.0, 5.0)
    """
    outer, inner = np.prod(size), np.prod(hollow)
    moments = mass * (outer * _box_moments(size) - inner * _box_moments(hollow)) / (outer - inner)
    return _inertial(mass, np.array(centre), np.diag(moments))


def set_inertial(body: mujoco.MjsBody, inertial: Inertial) -> None:
    """Give a body of a spec this inertia, whatever its geoms are."""
    body.mass, body.ipos, body.fullinertia = inertial.mass, inertial.centre, inertial.tensor
    body.explicitinertial = True


def _box_moments(size: Vector) -> NDArray[np.float64]:
    squares = np.square(size)
    return (squares.sum() - squares) / 12  # per unit of mass


def _inertial(mass: float, centre: NDArray[np.float64], matrix: NDArray[np.float64]) -> Inertial:
    upper = (*np.diag(matrix), matrix[0, 1], matrix[0, 2], matrix[1, 2])
    x, y, z = map(float, centre)
    xx, yy, zz, xy, xz, yz = map(float, upper)
    return Inertial(float(mass), (x, y, z), (xx, yy, zz, xy, xz, yz))
