"""Tables of a motion agree with kinematics done by hand, and a motion that a robot cannot make is refused."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_athletic.functional import rotations
from torchrl_athletic.functional.commands import from_roll_pitch_yaw, pose_to_world
from torchrl_athletic.functional.phase import sled_phases, snatch_phases, throw_phases
from torchrl_athletic.robots import (
    Bucket,
    Dumbbell,
    KeyPose,
    Motion,
    PhaseMotion,
    Terrain,
    b2z1,
    check_motion,
    motion_tables,
    read_motion,
    with_bucket,
    z1,
)
from torchrl_athletic.robots.arm import ARM_JOINTS, GRIP, LINKS
from torchrl_athletic.robots.b2z1 import MOUNT, STAND_HEIGHT
from torchrl_athletic.robots.motion_tables import PosedRobot

QUADRUPED, ARM = b2z1(), z1()
BUCKET = with_bucket(b2z1(), Bucket(opening=(0.0, 0.0, -1.0)))
STRETCHED = {"joint1": 0.4, "joint2": 2.0, "joint3": -1.4, "joint4": 0.3, "joint5": -0.5, "joint6": 0.7}
BENT = KeyPose(2.0, STRETCHED, base_height=0.5, base_pitch=0.2, base_velocity=(-0.5, 0.1, 0.3))


def motion(*poses, name="reach", robot=None):
    return Motion("mine", (PhaseMotion(name, (KeyPose(0.0), *poses)),), robot)


def hand_by_hand(joints, mount, height, pitch):
    """Position and attitude of the grip in the world, link by link."""
    turn, place = Rotation.from_euler("Y", pitch), np.array([0.0, 0.0, height])
    place = place + turn.apply(mount)
    for (offset, _), joint in zip(list(LINKS.values())[1:7], ARM_JOINTS, strict=False):
        place = place + turn.apply(offset)
        turn = turn * Rotation.from_rotvec(np.array(joint.axis) * joints.get(joint.name, joint.default))
    return place + turn.apply(GRIP), turn.as_matrix()


@pytest.mark.parametrize("frame_height", [0.5, 0.3])
def test_the_command_is_where_the_links_lead_to(frame_height):
    table = motion_tables(motion(BENT), QUADRUPED, frame_height=frame_height)["end_effector_command"][0]
    for row, place in ((0, hand_by_hand({}, MOUNT, STAND_HEIGHT, 0.0)), (-1, hand_by_hand(STRETCHED, MOUNT, 0.5, 0.2))):
        position, turn = place
        np.testing.assert_allclose(table[row, :3], position - [0, 0, frame_height], atol=1e-6)
        np.testing.assert_allclose(table[row, 3:], turn[:, :2].T.ravel(), atol=1e-6)


def test_an_arm_on_the_floor_has_its_frame_over_the_origin():
    table = motion_tables(motion(KeyPose(2.0, STRETCHED)), ARM)["end_effector_command"][0]
    position, turn = hand_by_hand(STRETCHED, (0.0, 0.0, 0.0), 0.0, 0.0)
    np.testing.assert_allclose(table[-1, :3], position - [0, 0, 0.5], atol=1e-6)
    np.testing.assert_allclose(table[-1, 3:], turn[:, :2].T.ravel(), atol=1e-6)


def test_the_command_leads_back_to_the_hand_wherever_the_base_stands_and_heads():
    command = motion_tables(motion(BENT), QUADRUPED)["end_effector_command"][0][-1].double()
    model = QUADRUPED.model()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    base = torch.tensor([3.0, -2.0, 0.5], dtype=torch.float64)
    attitude = from_roll_pitch_yaw(torch.tensor([0.0, 0.2, 2.1], dtype=torch.float64))
    data.qpos[:7] = torch.cat((base, attitude))
    for name, value in STRETCHED.items():
        data.joint(name).qpos[0] = value
    mujoco.mj_forward(model, data)
    position, turn = pose_to_world(command, base, attitude, 0.5)
    np.testing.assert_allclose(position, data.sensor("end_effector_position").data, atol=1e-6)
    hand = rotations.matrix(torch.tensor(data.sensor("end_effector_quaternion").data))
    np.testing.assert_allclose(turn, hand, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "robot", "schedule"),
    [
        ("throw", QUADRUPED, throw_phases()),
        ("throw", BUCKET, throw_phases()),
        ("snatch", QUADRUPED, snatch_phases()),
        ("snatch", b2z1(tool=Dumbbell()), snatch_phases()),
        ("sled", QUADRUPED, sled_phases()),
    ],
)
def test_a_shipped_motion_has_the_phases_of_its_task_and_the_robot_can_make_it(name, robot, schedule):
    shipped = read_motion(name)
    assert tuple(phase.name for phase in shipped.phases) == schedule.names
    for phase, timed in zip(shipped.phases, schedule.phases, strict=True):
        assert math.isinf(timed.duration) or phase.duration == timed.duration
    tables = motion_tables(shipped, robot)
    speeds = [table.diff(dim=0).abs() / 0.02 for table in tables["joint_position"] if len(table) > 1]
    assert (torch.cat(speeds).amax(0) <= torch.tensor(robot.velocity_limit)).all()
    limits = torch.tensor(robot.position_limit)
    for table in tables["joint_position"]:
        assert ((table >= limits[:, 0]) & (table <= limits[:, 1])).all()


def test_the_bucket_is_open_upwards_when_the_ball_is_put_in_and_until_the_throw():
    posed, set_up = PosedRobot(BUCKET), read_motion("throw").phases[0]
    for row in posed.rows(set_up)[1:]:
        posed.place(row)
        assert posed.data.sensor("bucket_axis").data[2] > 0.7  # at most 46° off the vertical


def test_the_snatch_goes_from_the_floor_to_overhead_with_a_straight_wrist():
    tables = motion_tables(read_motion("snatch"), QUADRUPED)
    low, high = tables["end_effector_command"][0][-1], tables["end_effector_command"][1][-1]
    assert 0.06 < low[2] + 0.5 < 0.1
    assert low[0] > 0.5  # ahead of the front feet
    assert high[2] + 0.5 > 1.6
    assert abs(high[0] - MOUNT[0]) < 0.05
    assert (tables["joint_position"][1][-1, 15:18] == 0).all()


def test_the_pull_holds_a_straight_wrist_low_ahead():
    tables = motion_tables(read_motion("sled"), QUADRUPED)
    [command], [joints] = tables["end_effector_command"][1], tables["joint_position"][1]
    assert command[0] > 0.75
    assert command[2] < 0
    assert (joints[15:18] == 0).all()


def test_joints_and_velocity_rest_at_key_poses_and_joints_not_named_stay_at_home():
    dt = 0.001
    tables = motion_tables(motion(BENT, KeyPose(3.5, {"joint2": 1.0})), QUADRUPED, dt)
    for name in ("joint_position", "base_velocity_command"):
        speed = tables[name][0].double().diff(dim=0) / dt
        for row in (0, 1999, 2000, -1):
            assert speed[row].abs().max() < 1e-3
        assert speed.abs().max() > 0.1
    home = torch.tensor(QUADRUPED.default_pose)
    joints = tables["joint_position"][0]
    assert torch.equal(joints[-1], home.index_fill(0, torch.tensor([13]), 1.0))
    assert torch.equal(joints[:, :12], home[:12].expand(len(joints), -1))
    torch.testing.assert_close(tables["base_velocity_command"][0][2000], torch.tensor(BENT.base_velocity))


def test_a_table_ends_at_the_last_pose_even_between_two_steps():
    tables = motion_tables(motion(KeyPose(1.01, {"joint2": 1.0})), QUADRUPED)
    assert len(tables["joint_position"][0]) == 52
    assert tables["joint_position"][0][-1, 13] == 1.0


def test_the_stand_is_that_on_flat_ground_whatever_the_ground():
    assert PosedRobot(QUADRUPED).stand == pytest.approx(STAND_HEIGHT, abs=1e-6)
    assert PosedRobot(b2z1(terrain=Terrain(), payload=5.0)).stand == pytest.approx(STAND_HEIGHT, abs=1e-6)
    assert PosedRobot(ARM).stand == 0.0


def test_a_ball_that_flies_freely_is_no_load_of_the_hand():
    posed = PosedRobot(z1(tool=Bucket()))
    posed.data.joint("ball").qpos[:3] = (3.0, 0.0, -5.0)
    posed.place(posed.rows(PhaseMotion("stay", (KeyPose(0.0),)))[0])
    assert posed.lowest()[1] > 0.1


def test_the_lowest_point_of_each_shape_is_that_of_its_surface():
    """Against many points of the surface, at a slant."""
    posed, rng = PosedRobot(QUADRUPED), np.random.default_rng(0)
    posed.place(posed.rows(PhaseMotion("lie", (BENT,) if BENT.time == 0 else (replace(BENT, time=0.0),)))[0])
    tried = set()
    for geom in posed._geoms():
        kind, size = int(posed.model.geom_type[geom]), posed.model.geom_size[geom]
        ball = rng.normal(size=(200_000, 3))
        ball /= np.linalg.norm(ball, axis=1, keepdims=True)
        circle = ball[:, :2] / np.linalg.norm(ball[:, :2], axis=1, keepdims=True)
        shapes = mujoco.mjtGeom
        if kind == shapes.mjGEOM_BOX:
            surface = size * np.sign(ball)
        elif kind == shapes.mjGEOM_CAPSULE:
            surface = size[0] * ball + np.outer(np.sign(ball[:, 2]), [0, 0, size[1]])
        elif kind == shapes.mjGEOM_CYLINDER:
            surface = np.column_stack([size[0] * circle, size[1] * np.sign(ball[:, 2])])
        else:
            assert kind == shapes.mjGEOM_SPHERE
            surface = size[0] * ball
        tried.add(kind)
        world = surface @ posed.data.geom_xmat[geom].reshape(3, 3).T + posed.data.geom_xpos[geom]
        assert posed._lowest_point(geom) == pytest.approx(world[:, 2].min(), abs=2e-4)
    assert len(tried) == 4


@pytest.mark.parametrize(
    ("poses", "robot", "message"),
    [
        ([KeyPose(1.0, {"joint9": 0.0})], QUADRUPED, r"pose at 1.00 s: joints names 'joint9', which 'b2z1' does"),
        ([KeyPose(3.0, {"joint2": 3.1})], QUADRUPED, r"joint2 is at 3.100 rad at 3.00 s, but its limits are 0.000"),
        ([KeyPose(1.0, {"joint3": -2.9})], QUADRUPED, r"joint3 is at -2.900 rad at 1.00 s"),
        ([KeyPose(0.4, {"joint2": 0.5})], QUADRUPED, r"joint2 moves at 4.69 rad/s at 0.20 s, .* 3.14 rad/s.* 0.597 s"),
        (
            [KeyPose(2.0, {"joint2": 2.9, "joint3": -1.4}, base_height=0.2, base_pitch=0.3)],
            QUADRUPED,
            r"the end effector is at -\d\.\d+ m over the ground at 2.00 s, needed is 0.02 m. Raise the arm",
        ),
        ([KeyPose(2.0, base_height=0.5)], ARM, r"'z1' is bolted down, but .* base_height 0.5, .* Leave these out"),
        ([KeyPose(2.0, base_pitch=0.1)], ARM, r"'z1' is bolted down"),
        ([KeyPose(2.0, base_velocity=(0.1, 0, 0))], ARM, r"'z1' is bolted down"),
    ],
)  # fmt: skip
def test_what_a_robot_cannot_do_is_refused_with_phase_time_and_mend(poses, robot, message):
    with pytest.raises(ValueError, match=f"mine: phase 'reach'.*{message}"):
        check_motion(motion(*poses), robot)


def test_the_speed_that_the_refusal_advises_is_allowed():
    check_motion(motion(KeyPose(0.597, {"joint2": 0.5})), QUADRUPED)


def test_what_the_hand_holds_must_not_meet_the_ground_either():
    low = motion(KeyPose(2.0, {"joint2": 2.85, "joint3": -1.5, "joint4": -0.15}, 0.385, 0.2))
    check_motion(low, QUADRUPED)
    with pytest.raises(ValueError, match=r"dumbbell is at 0\.01\d m over the ground at 2.00 s"):
        check_motion(low, b2z1(tool=Dumbbell()))


def test_a_jump_between_phases_is_refused_with_both():
    first = PhaseMotion("set-up", (KeyPose(0.0), KeyPose(1.0, {"joint2": 1.0})))
    second = PhaseMotion("throw", (KeyPose(0.0, {"joint2": 1.2}), KeyPose(1.0)))
    with pytest.raises(
        ValueError, match=r"phase 'throw' starts with joint2 at 1.200, but the end of phase 'set-up' has it at 1.000"
    ):
        check_motion(Motion("mine", (first, second)), ARM)


@pytest.mark.parametrize(
    ("start", "what"),
    [
        (KeyPose(0.0, {"joint2": 1.0}), "joint2 at 1.000, but the default pose has it at 1.500"),
        (KeyPose(0.0, base_height=0.5), r"base_height at 0.500, but the default pose has it at 0.589"),
        (KeyPose(0.0, base_velocity=(0.0, 0.0, 1.0)), r"base_velocity\[2\] at 1.000"),
    ],
)
def test_a_motion_that_does_not_start_at_the_default_pose_is_refused(start, what):
    with pytest.raises(ValueError, match=f"phase 'reach' starts with {what}.*Start the phase with that pose"):
        check_motion(Motion("mine", (PhaseMotion("reach", (start,)),)), QUADRUPED)


def test_a_motion_of_another_robot_is_refused_unless_it_is_of_any():
    with pytest.raises(ValueError, match=r"throw: robot is 'b2z1', but it is to be made by 'z1'. Give that robot, or"):
        check_motion(read_motion("throw"), ARM)
    upright = replace(read_motion("throw"), robot=None, phases=(PhaseMotion("stay", (KeyPose(0.0),)),))
    check_motion(upright, ARM)


def test_time_that_stands_still_and_a_robot_without_a_hand_are_refused():
    with pytest.raises(ValueError, match=r"dt is 0.0 s, needed is more than 0"):
        motion_tables(motion(), QUADRUPED, 0.0)
    sensors = {key: names for key, names in ARM.sensors.items() if key != "end_effector_position"}
    with pytest.raises(ValueError, match=r"'z1' has no 'end_effector_position' among its sensors.*Add framepos"):
        motion_tables(motion(), replace(ARM, sensors=sensors))
