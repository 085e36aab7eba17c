"""Episodes start near the keyframe, each elsewhere."""

import mujoco
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.functional import rotations
from torchrl_athletic.robots import Terrain, b2z1
from torchrl_athletic.robots.b2z1 import STAND_HEIGHT
from torchrl_athletic.transforms import InitialState, PDControl, StartRanges

ROBOT = b2z1()
RANGES = StartRanges(base_position=(1.0, 2.0, 0.0), base_linear_velocity=(0.5, 0.0, 0.0))


def make_env(n: int = 3, ranges: StartRanges = RANGES, **kwargs) -> TransformedEnv:
    return TransformedEnv(TorqueEnv(ROBOT, num_envs=n), InitialState(ranges, **kwargs))


def test_specs_hold():
    check_env_specs(make_env())


def test_starts_fill_their_ranges_and_keep_to_the_joints_limits():
    env = make_env(300)
    td = env.reset()
    default, limit = torch.tensor(ROBOT.default_pose), torch.tensor(ROBOT.position_limit)
    away = td["joint_position"] - default
    assert (away.abs() <= 0.2 + 1e-6).all()
    assert away[:, :12].abs().amax(0).min() > 0.18
    assert (td["joint_position"] >= limit[:, 0] - 1e-6).all()
    assert (td["joint_position"] <= limit[:, 1] + 1e-6).all()
    assert td["joint_velocity"].abs().max().item() == pytest.approx(0.5, abs=0.01)
    place = td["base_position"]
    assert place[:, :2].abs().amax(0).tolist() == pytest.approx([1.0, 2.0], abs=0.05)
    assert (place[:, 2] >= STAND_HEIGHT - 1e-6).all()  # those that would have been in the ground are lifted
    torch.testing.assert_close(td["base_quaternion"].norm(dim=-1), torch.ones(300))
    tilt = torch.acos(-td["projected_gravity"][:, 2].clamp(-1, 1))
    assert 0.1 < tilt.max() < 0.1 * 2**0.5 + 1e-3
    heading = rotations.yaw(td["base_quaternion"])
    assert (heading.min() < -3, heading.max() > 3) == (True, True)
    world = env.base_env.physics.qvel[:, :3]
    assert world.abs().amax(0).tolist() == pytest.approx([0.5, 0.0, 0.0], abs=0.01)


def test_where_a_robot_looks_does_not_change_how_it_leans():
    """It is tilted first and then turned about the world's vertical, so that a slope would be the same to it."""
    leaning = [make_env(20, StartRanges(base_turn=(0.3, 0.3, yaw))).reset() for yaw in (0.0, 3.0)]
    torch.testing.assert_close(*(td["projected_gravity"] for td in leaning))
    assert (rotations.yaw(leaning[1]["base_quaternion"]).abs() > 0.5).any()


def test_without_ranges_it_is_the_keyframe():
    none = StartRanges(0.0, 0.0, (0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0))
    start, plain = make_env(2, none).reset(), TorqueEnv(ROBOT, num_envs=2).reset()
    torch.testing.assert_close(start["joint_position"], plain["joint_position"])
    torch.testing.assert_close(start["base_quaternion"], plain["base_quaternion"])


def test_only_rows_that_start_are_moved_and_a_row_alone_starts_as_in_the_batch():
    batch, alone = make_env(3), make_env(1, first_row=1)
    one, two = batch.reset(), alone.reset()
    assert torch.equal(one["joint_position"][1], two["joint_position"][0])
    again = batch.reset(one.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    assert (again["joint_position"] != one["joint_position"]).any(-1).tolist() == [False, True, False]
    assert torch.equal(again["joint_position"][1], alone.reset()["joint_position"][0])
    assert len(again["joint_position"][:, 0].unique()) == 3


def test_a_negative_range_is_refused():
    with pytest.raises(ValueError, match="base_turn is"):
        StartRanges(base_turn=(-0.1, 0.0, 0.0))


def test_no_robot_starts_in_rough_ground_and_none_is_flung_out_of_it():
    robot = b2z1(terrain=Terrain())
    ranges = StartRanges(base_position=(12.0, 12.0, 0.0))
    env = TransformedEnv(TorqueEnv(robot, num_envs=64), Compose(PDControl(robot.kp, robot.kd), InitialState(ranges)))
    td = env.reset()
    model = robot.model()
    ground = {model.geom(name).id for name in robot.ground}
    for qpos in env.base_env.physics.qpos.numpy():
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        assert min([0.0, *(c.dist for c in data.contact if set(c.geom) & ground)]) > -1e-3
    assert (td["foot_height"] > 0.0).all()
    forces = []
    for _ in range(60):
        td = env.step(td.set("action", torch.tensor(robot.default_pose).expand(64, -1)))["next"]
        forces.append(td["foot_force"].amax(-1))
    assert torch.stack(forces).max() < 8000  # a landing; 109 kN before starts were lifted
    assert (forces[-1] < 2000).all()


def test_speeds_are_drawn_apart_for_every_joint_and_every_way_to_move_and_turn():
    ranges = StartRanges(0.1, 0.7, (0.3, 0.0, 0.4), (0.0,) * 3, (0.5, 0.2, 0.6), (0.9, 0.8, 0.4))
    env = make_env(300, ranges)
    td, physics = env.reset(), env.base_env.physics
    speeds = torch.cat((physics.qvel[:, :6].float(), td["joint_velocity"]), -1)
    most = torch.tensor([0.5, 0.2, 0.6, 0.9, 0.8, 0.4, *[0.7] * 19])
    torch.testing.assert_close(speeds.abs().amax(0), most, rtol=0.05, atol=0)
    moved = torch.cat((speeds, td["base_position"][:, :1], td["joint_position"][:, :18]), -1)
    assert (torch.corrcoef(moved.T) - torch.eye(44)).abs().max() < 0.3


def test_what_a_transform_further_in_starts_from_is_moved_and_not_forgotten():
    robot, keys = b2z1(), {"qpos_key": "place", "qvel_key": "speed"}
    start = InitialState(StartRanges(0.0, 0.0, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3), **keys)
    env = TransformedEnv(TorqueEnv(robot, num_envs=2), start)
    env.reset()
    qpos, qvel = env.base_env.physics.qpos - 0.1, torch.full((2, 25), 0.3)
    qpos[:, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    told = start._reset_env_preprocess(TensorDict({"place": qpos, "speed": qvel}, [2]))
    torch.testing.assert_close(told["place"], qpos)
    torch.testing.assert_close(told["speed"], qvel.double())


def test_a_start_that_looks_elsewhere_is_tilted_about_the_robots_own_axes():
    """A roll stays a roll, whatever way the state looked that is moved."""
    start = InitialState(StartRanges(0.0, 0.0, (0.0,) * 3, (0.4, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3), qpos_key="place")
    env = TransformedEnv(TorqueEnv(b2z1(), num_envs=5), start)
    env.reset()
    qpos = env.base_env.physics.qpos.clone()
    qpos[:, 3:7] = rotations.yaw_quaternion(torch.full((5, 1), 1.5)).double()
    tilted = start._reset_env_preprocess(TensorDict({"place": qpos}, [5]))["place"][:, 3:7]
    gravity = rotations.rotate_inverse(tilted, torch.tensor([[0.0, 0.0, -1.0]]).double().expand(5, 3))
    assert gravity[:, 1].abs().max() > 0.05
    assert gravity[:, 0].abs().max() < 1e-6


def test_starts_may_be_higher_and_none_is_in_the_ground():
    """Heights are drawn to both sides, and what would be below the ground is lifted to it."""
    free = (0.0,) * 3
    height = make_env(100, StartRanges(0.0, 0.0, (0.0, 0.0, 0.4), free, free, free)).reset()["base_position"][:, 2]
    over = height - height.min()
    assert over.max().item() == pytest.approx(0.4, abs=0.03)
    assert 0.3 < (over == 0).float().mean() < 0.7
