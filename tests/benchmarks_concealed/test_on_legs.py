"""The concealed drives on MuJoCo's bodies against the concealed arm, whose bodies and integrator are others."""

import numpy as np
import pytest
import torch

from benchmarks.concealed.arm import ConcealedArm, bodies
from benchmarks.concealed.harmonic import PERIOD
from benchmarks.concealed.on_legs import SUBSTEPS, ConcealedDrives, put_on, without_drives
from torchrl_athletic.envs import NO_DISTURBANCES, Disturbances, whole_body_env
from torchrl_athletic.robots import b2z1, z1

ROBOT = z1()
START = np.array(ROBOT.default_pose)


def drives(num_envs=2):
    bare = without_drives(ROBOT)
    physics = ConcealedDrives(bare.model(), num_envs, bare)
    physics.reset(qpos=torch.tensor(START).repeat(num_envs, 1))
    return physics


def hold(physics, target):
    """5 ms; the gripper is held by a torque, since only the six joints of the arm have concealed drives."""
    torque = torch.zeros(physics.num_envs, 7, dtype=torch.float64)
    torque[:, 6] = -ROBOT.kp[6] * physics.qpos[:, 6] - ROBOT.kd[6] * physics.qvel[:, 6]
    physics.apply_torque(torque)
    physics.send(torch.as_tensor(target).expand(physics.num_envs, -1))
    physics.step(SUBSTEPS)


def test_links_and_readings_are_those_of_the_arm_on_its_table():
    arm, physics = ConcealedArm(ROBOT), drives()
    arm._tree = bodies(ROBOT)[0]  # masses as in the data sheet: what the arm hides of them is not carried along
    arm.reset(START)
    for _ in range(200):
        hold(physics, START)
    time = PERIOD * np.arange(300)
    target = np.tile(START, (300, 1))
    target[:, :6] += 0.4 * np.sin(2 * np.pi * 0.8 * time)[:, None] * [1, 1, -1, 1, 1, 1]
    way, read = [], []
    for row in target:
        way.append(physics.qpos[0, :6].numpy() - arm.true_state().position[:6])
        read.append(physics.joint_position[0, :6].numpy() - arm._reading().position[:6])
        arm.step(row)
        hold(physics, row)
    assert np.abs(way).max() < 5e-4
    assert np.abs(read).max() < 5e-4
    assert (physics.qpos[0] == physics.qpos[1]).all()


def test_encoders_sit_on_the_rotors_and_not_on_the_links():
    physics = drives()
    for _ in range(100):
        hold(physics, START)
    apart = (physics.joint_position - physics.qpos)[0, :6].abs()
    assert 1e-4 < apart.max() < 0.05  # gravity winds the gears up
    assert (physics.joint_position[0, 6] == physics.qpos[0, 6]).all()


def test_rows_that_are_reset_start_at_rest_and_others_go_on():
    physics = drives(3)
    for _ in range(20):
        hold(physics, START + 0.1)
    before = physics.joint_position.clone()
    physics.reset(torch.tensor([False, True, False]), qpos=torch.tensor(START).repeat(3, 1))
    after = physics.joint_position
    assert (after[[0, 2]] == before[[0, 2]]).all()
    assert (after[1] - before[1]).abs().max() > 0.01
    assert not physics.joint_velocity[1, :6].any()


def test_the_drives_get_a_command_every_five_milliseconds():
    with pytest.raises(ValueError, match="a command every 25"):
        drives().step(1)
    with pytest.raises(ValueError, match=r"the drives need 0\.0002 s"):
        ConcealedDrives(ROBOT.model(), 1, ROBOT)


def test_a_walking_robot_s_arm_is_driven_by_them_and_gets_delayed_targets():
    robot = without_drives(b2z1(cone="pyramidal"))
    chance = Disturbances(None, (), None, (0.0, 0.0), (2, 2))
    assert chance != NO_DISTURBANCES
    env = put_on(whole_body_env(robot, num_envs=2, net=None, disturbances=chance, substeps=SUBSTEPS, history=1), robot)
    shown = env.reset()
    drive = env.base_env.physics
    assert isinstance(drive, ConcealedDrives)
    first = drive._targets[0].copy()
    action = torch.zeros(2, 19)
    action[:, robot.joint_groups["arm"][1]] = 1.0
    shown = env.step(shown.set("action", action))["next"]
    moved = drive._targets[0] - first
    assert (moved[:, 1] > 0.3).all()
    assert np.abs(moved[:, [0, 2, 3, 4, 5]]).max() < 1e-6
    arm = robot.joint_groups["arm"]
    assert shown["joint_position"][:, arm[1]].tolist() == pytest.approx(drive._x[:, 1, 0].tolist(), abs=1e-4)
