from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_athletic.envs import PoseGoal, TorqueEnv, draw_goal, reach_errors, reachable_poses
from torchrl_athletic.envs.reach import KEYPOINT_LENGTH
from torchrl_athletic.functional import rotations
from torchrl_athletic.robots import b2z1, from_mjcf, z1

POSES = torch.tensor([[0.4, 0.1, 0.3, 1.0, 0.0, 0.0, 0.0], [0.3, -0.2, 0.5, 0.5**0.5, 0.0, 0.0, 0.5**0.5]])


def goal_env(num_envs=2, poses=POSES, **options):
    return TransformedEnv(TorqueEnv(z1(), num_envs=num_envs), PoseGoal(poses, **options))


def test_a_joint_position_exists_for_every_pose():
    """Found here by descending the distance from the joint positions that inverse kinematics starts from."""
    robot = z1()
    model = robot.model()
    data = mujoco.MjData(model)
    site = model.site("end_effector").id
    for pose in reachable_poses(robot, count=3, spread=0.6, seed=4).double().numpy():
        mujoco.mj_resetDataKeyframe(model, data, 0)
        jacobian = np.zeros((6, model.nv))
        for _ in range(100):
            mujoco.mj_fwdPosition(model, data)
            here, turn = np.zeros(4), np.zeros(3)
            mujoco.mju_mat2Quat(here, data.site_xmat[site])
            mujoco.mju_subQuat(turn, pose[3:], here)
            error = np.concatenate([pose[:3] - data.site_xpos[site], data.site_xmat[site].reshape(3, 3) @ turn])
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
            arm = jacobian[:, :6]
            data.qpos[:6] += 0.5 * arm.T @ np.linalg.solve(arm @ arm.T + 1e-4 * np.eye(6), error)
        assert np.abs(error).max() < 1e-3
        assert (np.abs(data.qpos[:6] - robot.default_pose[:6]) < 0.6 + 1e-2).all()


def test_poses_stay_near_the_default_if_asked_to():
    robot = z1()
    start = goal_env().reset()["end_effector_position"][0]
    near, anywhere = (reachable_poses(robot, count=200, spread=spread, seed=1) for spread in (0.1, np.inf))
    assert (near[:, :3] - start).norm(dim=-1).max() < 0.25
    assert (anywhere[:, :3] - start).norm(dim=-1).max() > 0.8
    assert (anywhere[:, 2] > 0.05).all()
    torch.testing.assert_close(anywhere[:, 3:].norm(dim=-1), torch.ones(200))


def test_poses_are_repeatable_and_differ_with_the_seed():
    robot = z1()
    first, again, other = (reachable_poses(robot, count=4, seed=seed) for seed in (1, 1, 2))
    assert (first == again).all()
    assert (first != other).any(-1).all()


def test_a_walking_robot_is_refused():
    with pytest.raises(ValueError, match="bolted to the world"):
        reachable_poses(b2z1(), count=1)


def test_specs_match_the_data():
    check_env_specs(goal_env())


def test_a_goal_stays_for_an_episode_and_changes_with_the_next():
    env = goal_env(num_envs=64, poses=reachable_poses(z1(), count=1000))
    first = env.rollout(3)["command"]
    assert (first == first[:, :1]).all()
    second = env.reset()["command"]
    assert (first[:, 0] != second).any(-1).float().mean() > 0.95
    assert len(second.unique(dim=0)) > 55  # rows draw apart


def test_by_row_every_goal_has_its_turn():
    env = goal_env(num_envs=3, by_row=True)
    part = goal_env(num_envs=2, by_row=True, first_row=1)
    for _ in range(2):
        assert (env.reset()["command"] == POSES[[0, 1, 0]]).all()
        assert (part.reset()["command"] == POSES[[1, 0]]).all()  # the batch's last two rows


def test_at_the_goal_the_way_is_zero_and_off_it_points_there():
    env = goal_env()
    shown = env.reset()
    here = torch.cat((shown["end_effector_position"], shown["end_effector_quaternion"]), -1)[0]
    above = here + torch.tensor([0.0, 0.0, 0.02, 0.0, 0.0, 0.0, 0.0])
    seen = goal_env(poses=torch.stack((here, above)), by_row=True).reset()["goal_observation"]
    torch.testing.assert_close(seen[0, :24], torch.zeros(24), atol=1e-6, rtol=0)
    way, near = seen[1, :12].reshape(4, 3), seen[1, 12:24].reshape(4, 3)
    torch.testing.assert_close(way, torch.tensor([0.0, 0.0, 0.02]).expand(4, 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(near, torch.tensor([0.0, 0.0, 0.2]).expand(4, 3), atol=1e-5, rtol=0)


def test_a_turned_goal_moves_only_the_points_on_its_axes():
    shown = goal_env(by_row=True).reset()
    points = shown["goal_keypoints"][1]
    torch.testing.assert_close(points[0], POSES[1, :3])
    quarter_turn_about_z = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(points[1:] - points[0], KEYPOINT_LENGTH * quarter_turn_about_z, atol=1e-6, rtol=0)


def test_errors_are_taken_at_the_end_of_episodes():
    steps, half = 50, torch.tensor(0.5)
    goal = torch.tensor([0.3, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0]).expand(3, steps, 7)
    position = goal[..., :3].clone()
    position[0, :30] += 1.0  # far at first, there at the end
    position[1, :, 0] += 0.02
    position[2, :, 2] -= torch.tensor([0.05, 0.15]).repeat(steps // 2)  # 10 cm in the mean
    turned = rotations.yaw_quaternion(half.reshape(1)).expand(3, steps, 4)
    after = {"end_effector_position": position, "end_effector_quaternion": -turned, "command": goal}
    errors = reach_errors(TensorDict(next=after, batch_size=[3, steps]), last=20)
    assert errors["error_cm"] == pytest.approx((0 + 2 + 10) / 3, abs=1e-4)
    assert errors["median_cm"] == pytest.approx(2.0, abs=1e-4)
    assert errors["share_below_3cm"] == pytest.approx(2 / 3)
    assert errors["attitude_deg"] == pytest.approx(float(half.rad2deg()), abs=1e-2)  # q and -q are one attitude


@pytest.mark.parametrize("shape", [(3, 6), (7,), (0, 7)])
def test_a_table_of_another_shape_is_refused(shape):
    with pytest.raises(ValueError, match=r"\(M, 7\).*reachable_poses"):
        PoseGoal(torch.zeros(shape))


@pytest.mark.parametrize("turn", [0.0, 0.02, 3.0])
def test_angles_are_right_from_none_to_almost_half_a_turn(turn):
    goal = torch.tensor([0.3, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0]).expand(1, 30, 7)
    turned = rotations.yaw_quaternion(torch.tensor([turn])).expand(1, 30, 4)
    after = {"end_effector_position": goal[..., :3], "end_effector_quaternion": turned, "command": goal}
    found = reach_errors(TensorDict(next=after, batch_size=[1, 30]))["attitude_deg"]
    assert found == pytest.approx(np.rad2deg(turn), abs=0.1)


def test_a_step_shows_the_way_from_where_it_led_to():
    env = goal_env()
    shown = env.reset()
    after = env.step(shown.set("torque", torch.full((2, 7), 20.0)))["next"]
    torch.testing.assert_close(after["keypoints"][:, 0], after["end_effector_position"])
    assert (after["end_effector_position"] - shown["end_effector_position"]).abs().max() > 1e-4
    way = after["goal_observation"][:, :12].reshape(2, 4, 3)
    torch.testing.assert_close(after["keypoints"] + way, after["goal_keypoints"])


LIFT = """<mujoco><worldbody><body><joint name="turn" axis="0 0 1" range="-3 3"/><geom size="0.01"/>
  <body pos="0 0 1"><joint name="lift" type="slide" axis="0 0 1" range="0.2 0.3"/><geom size="0.01"/>
  <site name="hand"/></body></body></worldbody><sensor><framepos name="place" objtype="site" objname="hand"/>
  <framequat name="attitude" objtype="site" objname="hand"/></sensor></mujoco>"""


def test_an_arm_that_does_not_begin_with_the_first_joint_reaches_what_its_own_ranges_allow():
    sensors = {"end_effector_position": ("place",), "end_effector_quaternion": ("attitude",)}
    lift = from_mjcf(LIFT, kp=1.0, kd=0.0, torque_limit=1.0)
    lift = replace(lift, joint_groups={"arm": (1,)}, sensors=sensors)
    poses = reachable_poses(lift, count=20)
    assert ((poses[:, 2] >= 1.2) & (poses[:, 2] <= 1.3)).all()
    assert poses[:, 2].unique().numel() == 20
    torch.testing.assert_close(poses[:, 3:], torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(20, 4))  # it does not turn


def test_the_goal_is_drawn_as_three_arrows():
    model = z1().model()
    scene = mujoco.MjvScene(model, maxgeom=10)
    draw_goal(scene, goal_env(by_row=True).reset()[0])
    assert scene.ngeom == 3
    np.testing.assert_allclose(scene.geoms[0].pos, POSES[0, :3], atol=1e-6)
    assert scene.geoms[0].size[2] == pytest.approx(KEYPOINT_LENGTH / 2, rel=1e-3)  # half as long as what is tracked
    for axis in range(3):  # of a pose that is not turned
        np.testing.assert_allclose(scene.geoms[axis].mat[:, 2], np.eye(3)[axis], atol=1e-6)


def test_every_pose_of_the_table_is_a_goal_as_often_as_any_other():
    commands = goal_env(num_envs=300).reset()["command"]
    assert torch.isclose(commands, POSES[1]).all(-1).float().mean().item() == pytest.approx(0.5, abs=0.1)


def test_poses_are_those_of_joints_drawn_evenly_that_touch_nothing_and_are_over_the_clearance():
    robot = z1()
    model = robot.model()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    generator, expected, touched = np.random.default_rng(3), [], 0
    low, high = np.array(robot.position_limit)[:6].T
    while len(expected) < 100:
        data.qpos[:6] = generator.uniform(low, high)
        mujoco.mj_forward(model, data)
        place = data.sensor("end_effector_position").data
        touched += data.ncon > 0 and place[2] > 0.0
        if data.ncon == 0 and place[2] > 0.0:
            expected.append(place.copy())
    found = reachable_poses(robot, count=100, seed=3, clearance=0.0)
    np.testing.assert_allclose(found[:, :3], expected, atol=1e-6)
    assert touched > 0


def test_far_away_the_near_sight_is_full_and_the_goal_itself_is_shown_behind():
    far = POSES + torch.tensor([9.0, -9.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    shown = goal_env(poses=far, by_row=True).reset()
    way, near, place, turn = shown["goal_observation"].split((12, 12, 3, 6), -1)
    assert torch.equal(near, (10 * way).clamp(-1, 1))
    assert near.min() == -1
    assert near.max() == 1
    torch.testing.assert_close(place, far[:, :3])
    torch.testing.assert_close(turn, rotations.two_columns(far[:, 3:]))


def test_goals_are_those_of_the_seed_and_of_the_row():
    env = TorqueEnv(z1(), num_envs=1)
    table = torch.arange(7000.0).reshape(1000, 7)
    key = torch.arange(3)
    shown = env.reset().expand(3)

    def drawn(**told):
        goal = PoseGoal(table, **told)
        return goal.draw(goal.upcoming(shown), shown)["command"][:, 0]

    whole, part, other = drawn(seed=4), drawn(seed=4, first_row=1), drawn(seed=5)
    assert whole.unique().numel() == len(key)
    assert part[:2].equal(whole[1:])
    assert not other.equal(whole)


def test_a_degree_of_attitude_counts_as_five_millimetres():
    assert KEYPOINT_LENGTH * np.deg2rad(1.0) == pytest.approx(5e-3, rel=0.1)


def test_near_the_default_is_near_the_robots_own_keyframe():
    keys = '<keyframe><key name="low" qpos="0 0.21"/><key name="high" qpos="0 0.28"/></keyframe></mujoco>'
    lift = from_mjcf(LIFT.replace("</mujoco>", keys), kp=1.0, kd=0.0, torque_limit=1.0)
    sensors = {"end_effector_position": ("place",), "end_effector_quaternion": ("attitude",)}
    lift = replace(lift, joint_groups={"arm": (0, 1)}, sensors=sensors, keyframe="high")
    height = reachable_poses(lift, count=20, spread=0.01)[:, 2]
    assert ((height >= 1.27) & (height <= 1.29)).all()


def test_an_attitude_that_is_met_is_met_though_its_square_is_a_little_more_than_one_to_a_computer():
    """The arccosine of that would be no number."""
    turned = torch.tensor([[0.5, 0.5, 0.5, 0.5 + 1e-6]]).expand(1, 30, 4)
    assert (turned * turned).sum(-1).max() > 1
    place = torch.zeros(1, 30, 3)
    after = {"end_effector_position": place, "end_effector_quaternion": turned}
    after["command"] = torch.cat((place, turned), -1)
    assert reach_errors(TensorDict(next=after, batch_size=[1, 30]))["attitude_deg"] == 0.0


def test_a_single_goal_is_a_table_too():
    assert (goal_env(poses=POSES[1:]).reset()["command"] == POSES[1]).all()
