"""Ground whose bumps are drawn once and then stay."""

import mujoco
import numpy as np
import pytest

from torchrl_athletic.robots import Terrain, b2z1


def test_each_tile_is_as_rough_as_it_says_and_within_the_bounds():
    terrain = Terrain(roughness=(0.005, 0.025), tiles=3)
    per_tile = terrain.heights().reshape(3, 40, 3, 40).max(axis=(1, 3))
    rough = terrain.tile_roughness()
    assert ((rough >= 0.005) & (rough <= 0.025)).all()
    assert (per_tile <= rough).all()
    np.testing.assert_allclose(per_tile, rough, rtol=0.02)  # of 1600 heights the largest is near the bound
    assert terrain.heights().min() >= 0.0


def test_same_seed_same_ground_and_another_seed_another():
    assert (Terrain(seed=3).heights() == Terrain(seed=3).heights()).all()
    assert (Terrain(seed=3).heights() != Terrain(seed=4).heights()).any()
    even = {"roughness": (0.02, 0.02)}
    assert (Terrain(seed=3, **even).heights() != Terrain(seed=4, **even).heights()).any()
    assert (Terrain(seed=3).tile_roughness() != Terrain(seed=4).tile_roughness()).any()


def test_the_simulated_ground_has_these_heights_at_these_places():
    terrain = Terrain(roughness=(0.0, 0.1), tiles=3, tile_size=2.0, spacing=0.5)
    model = b2z1(terrain=terrain).model()
    data = mujoco.MjData(model)
    data.qpos[2] = 50.0
    mujoco.mj_forward(model, data)
    heights = terrain.heights()
    line = np.linspace(-3.0, 3.0, 12)  # MuJoCo spreads rows and columns over the whole field
    for row, column in ((0, 0), (3, 7), (11, 2)):
        inward = [line[column] * 0.99999, line[row] * 0.99999]
        touched = np.zeros(1, np.int32)
        distance = mujoco.mj_ray(
            model, data, np.array([*inward, 5.0]), np.array([0.0, 0.0, -1.0]), None, 1, -1, touched
        )
        assert 5.0 - distance == pytest.approx(heights[row, column], abs=1e-4)
        assert model.geom(int(touched[0])).name == "terrain"


def test_tiles_lie_around_the_origin_in_the_order_of_their_roughness():
    terrain = Terrain(tiles=3, tile_size=2.0)
    centres = terrain.tile_centres()
    assert centres[1, 1].tolist() == [0.0, 0.0]
    assert centres[0, 2].tolist() == [2.0, -2.0]  # rows along y, columns along x


def test_a_flat_terrain_is_a_floor():
    flat = b2z1(terrain=Terrain(roughness=(0.0, 0.0), tiles=1))
    assert flat.model().hfield_data.max() == 0.0
    assert flat.ground == ("floor", "terrain")


@pytest.mark.parametrize(
    ("wrong", "advice"),
    [
        ({"roughness": (0.02, 0.01)}, "least <= largest"),
        ({"roughness": (-0.01, 0.01)}, "least <= largest"),
        ({"tiles": 0}, "at least one tile"),
        ({"spacing": 0.0}, "at least one tile"),
    ],
)
def test_a_ground_that_cannot_be_is_refused(wrong, advice):
    with pytest.raises(ValueError, match=advice):
        Terrain(**wrong)
