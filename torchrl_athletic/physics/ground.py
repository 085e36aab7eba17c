"""The ground under a robot: how high it is, and how far above it the robot's lowest point is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_athletic.functional import terrain

_GEOM = mujoco.mjtGeom


@dataclass(frozen=True, eq=False)
class HeightField:
    """Uneven ground, upright in the world."""

    heights: Tensor
    """Heights of the surface in the world [m]. Shape (R, C), rows along y."""
    centre: Tensor
    """x and y [m]. Shape (2,)."""
    half_size: tuple[float, float]
    """Along x and along y [m]."""

    def around(self, change: Callable[[Tensor, int, int], Tensor], width: float) -> HeightField:
        """Each height replaced by what ``change`` makes of those within half a width to each side."""
        rows, columns = self.heights.shape
        spacing = 2 * self.half_size[0] / (columns - 1), 2 * self.half_size[1] / (rows - 1)
        across, along = (round(np.ceil(width / (2 * size) - 1e-9)) for size in (spacing[1], spacing[0]))
        return replace(self, heights=change(self.heights, across, along))


@dataclass(frozen=True, eq=False)
class Ground:
    """Planes and height fields to stand on.

    Example:
        >>> from torchrl_athletic.robots import Terrain, b2z1
        >>> robot = b2z1(terrain=Terrain(roughness=(0.02, 0.02)))
        >>> ground = ground_of(robot.model(), robot.ground)
        >>> bool((ground.height(torch.rand(9, 2)) <= 0.02).all()), float(ground.height(torch.tensor([99.0, 0.0])))
        (True, -0.004999999888241291)
    """

    planes: tuple[tuple[float, float, float], ...]
    """Height at the origin [m], and rise along x and along y [1], of each plane."""
    fields: tuple[HeightField, ...]

    def height(self, place: Tensor) -> Tensor:
        """Height of the highest surface under each point, x and y in the world [m]. Shape (*B, 2) to (*B, 1)."""
        x, y = place.unbind(-1)
        surface = torch.full_like(x, -torch.inf)
        for level, along, across in self.planes:
            surface = torch.maximum(surface, level + along * x + across * y)
        for field in self.fields:
            local = place - field.centre
            within = (local[..., 0].abs() <= field.half_size[0]) & (local[..., 1].abs() <= field.half_size[1])
            found = terrain.surface_height(field.heights, local, field.half_size)
            surface = torch.where(within, torch.maximum(surface, found), surface)
        return surface.unsqueeze(-1)

    def averaged(self, width: float) -> Ground:
        """The ground with its bumps rounded off over squares of a width [m]."""
        return replace(self, fields=tuple(field.around(terrain.averaged, width) for field in self.fields))

    def highest(self, width: float) -> Ground:
        """Ground that is everywhere as high as its highest point within a square of a width [m]."""
        return replace(self, fields=tuple(field.around(terrain.highest, width) for field in self.fields))


def ground_of(model: mujoco.MjModel, names: Sequence[str], device: torch.device | str = "cpu") -> Ground:
    """The ground that geoms of a model make.

    Args:
        model: The whole scene.
        names: Of the geoms, planes and height fields that do not move.
        device: Of its tensors.

    Raises:
        ValueError: If a geom has another shape, or a height field is tilted: its height is not known then.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    planes, fields = [], []
    for name in names:
        geom = model.geom(name).id
        place, turn, kind = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3), model.geom_type[geom]
        if kind == _GEOM.mjGEOM_PLANE:
            along, across = -turn[:2, 2] / turn[2, 2]
            planes.append((float(place[2] - along * place[0] - across * place[1]), float(along), float(across)))
        elif kind == _GEOM.mjGEOM_HFIELD and np.allclose(turn, np.eye(3)):
            fields.append(_height_field(model, geom, place, device))
        else:
            raise ValueError(
                f"geom {name!r} is ground, but neither a plane nor an upright height field, so that its height under a "
                "robot is not known. Name only such geoms in the robot's ground."
            )
    return Ground(tuple(planes), tuple(fields))


def _height_field(model: mujoco.MjModel, geom: int, place: np.ndarray, device: torch.device | str) -> HeightField:
    number = model.geom_dataid[geom]
    rows, columns, start = model.hfield_nrow[number], model.hfield_ncol[number], model.hfield_adr[number]
    along, across, top, _ = model.hfield_size[number]
    heights = place[2] + top * model.hfield_data[start : start + rows * columns].reshape(rows, columns)
    return HeightField(
        torch.tensor(heights, dtype=torch.float32, device=device),
        torch.tensor(place[:2], dtype=torch.float32, device=device),
        (float(along), float(across)),
    )


@dataclass(frozen=True, eq=False)
class Clearance:
    """How far above the ground the lowest point of all that may touch it is.

    Shapes are taken as points with a radius: a capsule's two ends, a box's corners. The ground is taken as high as it
    is anywhere near a point, so that what is far above it there does not touch it, but a long shape may touch a bump
    between two of its points.
    """

    bodies: Tensor
    """Which each point is fixed to. Shape (P,)."""
    points: Tensor
    """Points in the body's frame [m]. Shape (P, 3)."""
    radius: Tensor
    """[m]. Shape (P,)."""
    ground: Ground
    """As high as it is anywhere near."""

    @classmethod
    def of(
        cls, model: mujoco.MjModel, ground: Sequence[str], device: torch.device | str = "cpu", margin: float = 0.05
    ) -> Clearance:
        """Clearance of the bodies of a model.

        Args:
            model: The whole scene.
            ground: Names of the geoms to stand on.
            device: Of the tensors.
            margin: How far to each side of a point the ground counts [m]; 5 cm cover a robot's foot.
        """
        below = [model.geom(name).id for name in ground]
        bodies, points, radius = [], [], []
        for geom in range(model.ngeom):
            body = model.geom_bodyid[geom]
            if model.body_weldid[body] == 0 or not any(_may_touch(model, geom, other) for other in below):
                continue
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
            for corner, size in _corners(model.geom_type[geom], model.geom_size[geom], model.geom_rbound[geom]):
                bodies.append(int(body))
                points.append(model.geom_pos[geom] + turn.reshape(3, 3) @ corner)
                radius.append(float(size))
        return cls(
            torch.tensor(bodies, dtype=torch.int64, device=device),
            torch.tensor(np.array(points).reshape(-1, 3), dtype=torch.float32, device=device),
            torch.tensor(radius, dtype=torch.float32, device=device),
            ground_of(model, ground, device).highest(2 * margin),
        )

    def __call__(self, position: Tensor, rotation: Tensor) -> Tensor:
        """Clearance of each env; negative if something is in the ground.

        Args:
            position: Of all bodies, ``xpos`` [m]. Shape (N, B, 3).
            rotation: Of all bodies, ``xmat`` [1]. Shape (N, B, 9).

        Returns:
            [m]. Shape (N, 1).
        """
        if not len(self.bodies):
            return torch.full_like(position[:, :1, 0], torch.inf, dtype=torch.float32)
        turn = rotation[:, self.bodies].float().unflatten(-1, (3, 3))
        place = position[:, self.bodies].float() + (turn * self.points.unsqueeze(-2)).sum(-1)
        above = place[..., 2:] - self.radius.unsqueeze(-1) - self.ground.height(place[..., :2])
        return above.amin(-2)


def _may_touch(model: mujoco.MjModel, first: int, second: int) -> bool:
    kinds, others = model.geom_contype, model.geom_conaffinity
    return bool(kinds[first] & others[second] or kinds[second] & others[first])


def _corners(kind: int, size: np.ndarray, bound: float) -> list[tuple[np.ndarray, float]]:
    """Points with radii within which a shape lies, in its own frame."""
    if kind == _GEOM.mjGEOM_BOX:
        signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
        return [(sign * size, 0.0) for sign in signs]
    if kind in (_GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_CYLINDER):
        return [(np.array([0.0, 0.0, end * size[1]]), size[0]) for end in (-1.0, 1.0)]
    return [(np.zeros(3), float(bound))]  # a ball, or one around anything else
