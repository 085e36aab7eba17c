"""Heights under a robot against MuJoCo's own rays and contacts."""

import mujoco
import numpy as np
import pytest
import torch

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.physics import BatchPhysics
from torchrl_athletic.physics.ground import Clearance, ground_of
from torchrl_athletic.robots import Terrain, b2z1, z1

ROUGH = Terrain(roughness=(0.05, 0.3), tiles=3, slope=0.1)
TILTED = """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1" pos="1 2 .3" euler="5 -8 40"/>
  <body pos="0 0 3"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("model", "names"),
    [(b2z1(terrain=ROUGH).model(), ("floor", "terrain")), (mujoco.MjModel.from_xml_string(TILTED), ("floor",))],
    ids=["rough slope", "tilted plane"],
)
def test_the_ground_is_as_high_as_a_ray_from_above_finds_it(model, names):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ground, rng = ground_of(model, names), np.random.default_rng(0)
    for x, y in rng.uniform(-5.5, 5.5, (300, 2)):
        distances = [
            mujoco.mj_ray(
                model, data, np.array([x, y, 9.0]), np.array([0.0, 0, -1]), None, 1, body, np.zeros(1, np.int32)
            )
            for body in range(1, model.nbody)
        ]
        lowest = max(distance for distance in distances if distance >= 0)  # past the robot, whichever body is left out
        assert float(ground.height(torch.tensor([x, y]))) == pytest.approx(9.0 - lowest, abs=1e-4)


def test_other_shapes_and_tilted_fields_are_no_ground_whose_height_is_known():
    with pytest.raises(ValueError, match=r"'trunk' is ground, but neither a plane nor an upright height field"):
        ground_of(b2z1().model(), ("trunk",))


def test_clear_robots_touch_nothing_and_the_clearance_is_not_wasted():
    robot = b2z1(terrain=Terrain(tiles=3))
    model = robot.model()
    physics, clearance = BatchPhysics(model, 60), Clearance.of(model, robot.ground)
    generator = torch.Generator().manual_seed(0)
    physics.reset(keyframe="stand")
    physics.qpos[:, :2] = 8 * torch.rand(60, 2, generator=generator, dtype=torch.float64) - 4
    physics.qpos[:, 3:7] += 0.2 * torch.randn(60, 4, generator=generator, dtype=torch.float64)
    physics.qpos[:, 3:7] /= physics.qpos[:, 3:7].norm(dim=1, keepdim=True)
    physics.qpos[:, 7:] += 0.3 * torch.randn(60, 19, generator=generator, dtype=torch.float64)
    for name in ("xpos", "xmat"):
        physics.data(name)
    physics.forward()
    physics.raise_up(-clearance(physics.data("xpos"), physics.data("xmat")))
    assert clearance(physics.data("xpos"), physics.data("xmat")).abs().max() < 0.03  # bumps near the new place differ
    physics.raise_up((-clearance(physics.data("xpos"), physics.data("xmat"))).clamp(min=0))
    lowest = []
    for qpos in physics.qpos.numpy():
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        ground = [model.geom(name).id for name in robot.ground]
        touches = [c.dist for c in data.contact if set(c.geom) & set(ground)]
        assert not touches
        data.qpos[2] -= 0.045
        mujoco.mj_forward(model, data)
        lowest.append(any(set(c.geom) & set(ground) for c in data.contact))
    assert np.mean(lowest) > 0.95  # a little lower, and they would touch


def test_a_robot_without_anything_that_touches_the_ground_is_clear_of_it():
    model = z1().model()
    physics = BatchPhysics(model, 2)
    clearance = Clearance(
        torch.zeros(0, dtype=torch.int64), torch.zeros(0, 3), torch.zeros(0), ground_of(model, ("floor",))
    )
    assert clearance(physics.data("xpos"), physics.data("xmat")).tolist() == [[np.inf], [np.inf]]


def test_a_base_is_as_high_as_over_the_mean_of_the_heights_below_it():
    """The square of 0.5 m holds heights up to 0.3 m to each side, every 0.1 m: 7 by 7 of them."""
    terrain = Terrain(roughness=(0.1, 0.1), tiles=3)
    env = TorqueEnv(b2z1(terrain=terrain))
    heights = terrain.heights()
    line = np.linspace(-6.0, 6.0, len(heights))
    for row, column in ((10, 20), (60, 61), (100, 33)):
        mean = heights[row - 3 : row + 4, column - 3 : column + 4].mean()
        base = torch.tensor([[line[column], line[row], 0.7]], dtype=torch.float32)
        assert env.heights(base, None)["base_height"].item() == pytest.approx(0.7 - mean, abs=2e-3)
        assert abs(heights[row, column] - mean) > 5e-3  # or this would say nothing of a mean
        feet = base.reshape(1, 1, 3)
        foot = env.heights(base, feet)["foot_height"].item()
        assert foot == pytest.approx(0.7 - heights[row, column], abs=2e-3)  # a foot stands on a bump


def test_beside_a_field_of_heights_there_is_the_floor():
    terrain = Terrain(roughness=(0.0, 0.0), tiles=1, slope=0.3)
    robot = b2z1(terrain=terrain)
    ground, edge = ground_of(robot.model(), robot.ground), 2 * np.tan(0.3)
    inside = torch.tensor([[1.99, 0.0], [1.99, 1.99], [-1.99, 1.99]])
    torch.testing.assert_close(
        ground.height(inside).flatten(), torch.tensor([edge, edge, -edge]).float(), atol=0.01, rtol=0
    )
    beside = torch.tensor([[2.01, 0.0], [1.99, 2.01], [1.99, -2.01], [-2.01, 0.0]])
    assert ground.height(beside).flatten().tolist() == pytest.approx([-edge - 0.005] * 4, abs=1e-3)
