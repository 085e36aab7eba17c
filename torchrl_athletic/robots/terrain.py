"""Uneven and sloping ground."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Terrain:
    """A field of square tiles, each rough to its own degree: an env that starts on a tile has drawn a roughness.

    Heights are independent and even between 0 and the tile's roughness, which is even between the two bounds. Around
    the field the floor goes on, flat.
    """

    roughness: tuple[float, float] = (0.0, 0.025)
    """Least and largest height of bumps [m]. Paper, table of domain randomisation: 0 to 2.5 cm."""
    tiles: int = 7
    """Tiles on an edge of the field; an odd number puts a tile's centre at the origin."""
    tile_size: float = 4.0
    """[m]."""
    spacing: float = 0.1
    """Distance of neighbouring heights [m]."""
    slope: float = 0.0
    """Slope by which the whole field rises along x [rad]; it is at height 0 in its middle."""
    seed: int = 0

    def __post_init__(self) -> None:
        low, high = self.roughness
        if not 0 <= low <= high < np.inf:
            raise ValueError(
                f"roughness is {self.roughness} m, but heights are drawn from 0 up to a value between the two. "
                "Give two numbers with 0 <= least <= largest."
            )
        if not abs(self.slope) < np.pi / 2:
            raise ValueError(f"slope is {self.slope} rad, which no field of heights has. Give less than pi / 2.")
        if self.tiles < 1 or not 0 < self.spacing <= self.tile_size:
            raise ValueError(
                f"{self.tiles} tiles of {self.tile_size} m with heights every {self.spacing} m hold no heights. Take "
                "at least one tile, and a spacing between 0 and the tile's size."
            )

    def tile_roughness(self) -> NDArray[np.float64]:
        """Largest height of each tile [m]. Shape (tiles, tiles): rows along y, columns along x."""
        return np.random.default_rng(self.seed).uniform(*self.roughness, size=(self.tiles, self.tiles))

    def tile_centres(self) -> NDArray[np.float64]:
        """Positions of the tiles in the world, x and y [m]. Shape (tiles, tiles, 2), as :meth:`tile_roughness`."""
        line = (np.arange(self.tiles) - 0.5 * (self.tiles - 1)) * self.tile_size
        return np.stack(np.meshgrid(line, line), axis=-1)

    def heights(self) -> NDArray[np.float64]:
        """Heights of the ground above the floor [m]. Shape (tiles * n, tiles * n), n heights on a tile's edge.

        Example:
            >>> heights = Terrain(roughness=(0.0, 0.02)).heights()
            >>> bool(0 <= heights.min() < heights.max() <= 0.02)
            True
        """
        n = round(self.tile_size / self.spacing)
        bound = np.kron(self.tile_roughness(), np.ones((n, n)))
        half = 0.5 * self.tiles * self.tile_size
        rise = np.tan(self.slope) * np.linspace(-half, half, bound.shape[1])
        return rise + bound * np.random.default_rng([self.seed, 1]).uniform(size=bound.shape)


def add_terrain(spec: mujoco.MjSpec, terrain: Terrain) -> None:
    """Lay a terrain on the floor, as geom ``terrain`` with the floor's friction."""
    heights = terrain.heights()
    low, high = float(heights.min()), float(heights.max())
    half = 0.5 * terrain.tiles * terrain.tile_size
    # MuJoCo stretches the data to 0..1 and scales it by the third size, which must not be zero.
    spec.add_hfield(
        name="terrain",
        nrow=heights.shape[0],
        ncol=heights.shape[1],
        size=[half, half, max(high - low, 1e-6), 0.1],
        userdata=heights.ravel().tolist(),
    )
    floor = spec.geom("floor")
    spec.worldbody.add_geom(
        name="terrain",
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="terrain",
        pos=[0, 0, low],
        contype=floor.contype,
        conaffinity=floor.conaffinity,
        priority=floor.priority,
        friction=floor.friction,
        solref=floor.solref,
        material=floor.material,
    )
    floor.pos = [0, 0, min(low, 0.0) - 0.005]  # below the deepest dent, or feet would touch both
