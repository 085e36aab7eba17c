"""A motion reads back as it was written, says what is wrong with its file, and follows what was recorded."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from torchrl_athletic.functional.reference import interpolate_poses
from torchrl_athletic.recordings import Recording
from torchrl_athletic.robots import (
    KeyPose,
    Motion,
    PhaseMotion,
    b2z1,
    motion_from_table,
    motion_tables,
    read_motion,
    write_motion,
)

SOUND = """
robot = "b2z1"
[[phase]]
name = "reach"
[[phase.pose]]
time = 0.0
[[phase.pose]]
time = 1.2
joints = { joint2 = 0.8 }
base_height = 0.55
base_pitch = -0.1
base_velocity = [0.5, 0, 0.0]
"""


def read(text, folder):
    path = folder / "mine.toml"
    path.write_text(text)
    return read_motion(path)


def test_a_file_is_read_as_it_stands(tmp_path):
    first, second = KeyPose(0.0), KeyPose(1.2, {"joint2": 0.8}, 0.55, -0.1, (0.5, 0.0, 0.0))
    assert read(SOUND, tmp_path) == Motion("mine", (PhaseMotion("reach", (first, second)),), "b2z1")


@pytest.mark.parametrize("name", ["throw", "snatch", "sled"])
def test_a_shipped_motion_reads_back_as_written(name, tmp_path):
    motion = read_motion(name)
    assert read_motion(write_motion(motion, tmp_path / "new" / f"{name}.toml")) == motion


def test_odd_names_and_numbers_read_back_as_written(tmp_path):
    poses = (KeyPose(0), KeyPose(1 / 3, {'a "joint"\\é': 1e-17, "b.c": -2e22}, 1e-5, -math.pi / 3, (1, -0.1, 2.5)))
    motion = Motion("odd", (PhaseMotion('up\n"and" down', poses), PhaseMotion("stay", (KeyPose(0.0),))))
    assert read_motion(write_motion(motion, tmp_path / "odd.toml")) == motion


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("time = 0.0", "time = 0.1", r"phase 'reach': its first pose is at 0.1 s, needed is one at time = 0.0"),
        (
            "time = 1.2",
            "time = 0.0",
            r"phase 'reach': after the pose at time = 0.0 s comes one at 0.0 s. Times have to",
        ),
        ("time = 1.2", "", r"phase 'reach', pose 2 has no time. Give seconds"),
        ("time = 1.2", "time = nan", r"time is nan, needed is a finite number"),
        ("time = 1.2", "time = '1.2'", r"phase 'reach': key pose at 1.2 s: time is '1.2', needed is a finite number"),
        ("0.8", "inf", r"phase 'reach': key pose at 1.2 s: joints.joint2 is inf, needed is a finite number"),
        ("0.8", "true", r"joints.joint2 is True, needed is a finite number"),
        ("{ joint2 = 0.8 }", "[0.8]", r"joints is \[0.8\], needed are positions by name"),
        ("base_height = 0.55", "base_height = 0", r"base_height is 0.0 m, in the ground. Give more than 0"),
        ("-0.1", "-10", r"base_pitch is -10.0 rad, which turns the heading round. .* in radians"),
        ("[0.5, 0, 0.0]", "[0.5, 0]", r"base_velocity is \[0.5, 0\], needed are three numbers"),
        ("[0.5, 0, 0.0]", "0.5", r"base_velocity is 0.5, needed are three numbers"),
        ("[0.5, 0, 0.0]", "[0.5, 0, nan]", r"base_velocity is nan, needed is a finite number"),
        ("base_pitch", "base_roll", r"phase 'reach', pose 2 has 'base_roll', .* 'base_pitch', .*: correct it"),
        ('name = "reach"', "", r"phase 1 has no name. Give the name that the task has"),
        ('name = "reach"', "name = 3", r"a phase's name is 3. Give the name"),
        ('name = "reach"', 'name = "reach"\nlength = 2', r"phase 1 has 'length', .* \['name', 'pose'\]"),
        ('robot = "b2z1"', 'robots = "b2z1"', r"the file has 'robots', .* \['robot', 'phase'\]"),
        ('robot = "b2z1"', "robot = 1", r"robot is 1, needed is a robot's name"),
        ("joint2 = 0.8 }", "joint2 = }", r"[Ii]nvalid value"),
    ],
)
def test_what_is_wrong_with_a_file_is_named_with_its_mend(old, new, message, tmp_path):
    with pytest.raises(ValueError, match=rf"(?s)mine\.toml: .*{message}"):
        read(SOUND.replace(old, new, 1), tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"the file has \[\] for 'phase', .* Begin it with \[\[phase\]\]"),
        ("phase = 3", r"the file has 3 for 'phase'"),
        ('[[phase]]\nname = "reach"', r"phase 'reach' has \[\] for 'pose', .* Begin it with \[\[phase.pose\]\]"),
        (SOUND + SOUND.replace('robot = "b2z1"', ""), r"phases are \['reach', 'reach'\]. .* a name of its own"),
    ],
)
def test_a_file_without_phases_or_poses_is_refused(text, message, tmp_path):
    with pytest.raises(ValueError, match=rf"mine\.toml: {message}"):
        read(text, tmp_path)


def test_a_motion_that_is_not_shipped_is_refused_with_those_that_are():
    with pytest.raises(ValueError, match=r"no motion 'jump' is shipped. Take one of \['sled', 'snatch', 'throw'\]"):
        read_motion("jump")


def test_a_motion_is_written_to_toml_only(tmp_path):
    with pytest.raises(ValueError, match=r"throw.json: a motion is a .toml file"):
        write_motion(read_motion("throw"), tmp_path / "throw.json")


def along(motion, times):
    """Joints of a motion of one phase, all of them named. Shape (T, J)."""
    poses = motion.phases[0].poses
    rows = torch.tensor([list(pose.joints.values()) for pose in poses], dtype=torch.float64)
    keys = torch.tensor([pose.time for pose in poses], dtype=torch.float64)
    return interpolate_poses(keys, rows, torch.as_tensor(times)).numpy()


def test_key_poses_of_a_recording_stay_within_the_tolerance_of_it_and_are_fewer_for_a_wider_one():
    time = 7.0 + np.arange(0.0, 6.0, 0.01)
    spline = CubicSpline(7.0 + np.arange(7.0), np.random.default_rng(0).uniform(-0.5, 0.5, (7, 3)), bc_type="clamped")
    recording = Recording(time, ("a", "b", "c"), spline(time), torque_command=np.zeros((len(time), 3)))
    counts = []
    for tolerance in (0.005, 0.02, 0.1):
        found = motion_from_table(recording.time, recording.position, recording.joint_names, "taken", "all", tolerance)
        assert np.abs(along(found, time - 7.0) - recording.position).max() <= tolerance + 1e-9
        assert found.phases[0].duration == pytest.approx(5.99)
        counts.append(len(found.phases[0].poses))
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] < 20


def test_the_key_poses_of_a_motion_are_found_again_in_its_samples():
    keys = np.array([0.0, 0.6, 1.5, 2.0])
    poses = np.array([[0.1, -0.3], [1.0, -0.3], [-0.5, 0.4], [0.0, 0.0]])
    time = np.arange(201) * 0.01
    samples = interpolate_poses(*(torch.from_numpy(given) for given in (keys, poses, time))).numpy()
    found = motion_from_table(time, samples, ["a", "b"], "taken", "all", 0.001).phases[0].poses
    assert [pose.time for pose in found] == pytest.approx(keys, abs=0.03)


def test_a_robot_that_stands_still_has_two_key_poses_and_one_sample_has_one():
    still = np.full((500, 2), 0.3)
    assert len(motion_from_table(np.arange(500) * 0.01, still, ["a", "b"], "taken", "all").phases[0].poses) == 2
    assert len(motion_from_table([3.0], still[:1], ["a", "b"], "taken", "all").phases[0].poses) == 1


def test_a_recorded_base_comes_along():
    time = np.linspace(0.0, 1.0, 51)
    down = 0.589 - 0.1 * time
    found = motion_from_table(
        time, np.zeros((51, 1)), ["joint1"], "taken", "all", base_height=down, base_pitch=0.2 * time
    )
    heights = [pose.base_height for pose in found.phases[0].poses]
    assert heights[0] == 0.589
    assert heights[-1] == 0.489
    assert found.phases[0].poses[-1].base_pitch == 0.2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tolerance": 0.0}, "tolerance is 0.0, needed is 0.001 or more"),
        ({"joint_names": ["a", "b", "c"]}, r"joint_position \(5, 2\) for 3 joint_names; needed are"),
        ({"time": [0.0, 1.0, 1.0, 2.0, 3.0]}, "time does not rise"),
        ({"joint_position": np.full((5, 2), np.nan)}, "a sample that is not finite"),
        ({"base_height": [0.5]}, r"base_height has the shape \(1,\), needed is that of time, \(5,\)"),
    ],
)
def test_samples_that_make_no_motion_are_refused(change, message):
    sound = {"time": np.arange(5.0), "joint_position": np.zeros((5, 2)), "joint_names": ["a", "b"]}
    with pytest.raises(ValueError, match=message):
        motion_from_table(**{**sound, "name": "taken", "phase": "all", **change})


def test_a_recorded_throw_is_a_motion_of_the_robot_again():
    """Through tables and back: what the shipped file says, from its samples alone."""
    robot = b2z1()
    table = motion_tables(read_motion("throw"), robot)["joint_position"][0].double().numpy()
    found = motion_from_table(np.arange(len(table)) * 0.02, table, robot.joint_names, "again", "throw-set-up", 0.002)
    again = motion_tables(found, robot)["joint_position"][0].numpy()
    assert np.abs(again - table).max() < 0.0021
