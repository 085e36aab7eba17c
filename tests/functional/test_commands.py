import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_athletic.functional import rotations, streams
from torchrl_athletic.functional.commands import (
    ATTITUDE,
    PLACE,
    VELOCITY,
    CommandRanges,
    blend_goals,
    command_ranges,
    deviation_from_line,
    draw_goal,
    from_roll_pitch_yaw,
    goal_to_pose,
    line_ahead,
    pose_to_frame,
    pose_to_goal,
    pose_to_world,
    sled_commands,
    straighten,
)

N = 5000
RANGES = CommandRanges(standstill_probability=0.0)


def goals(seed=0, ranges=RANGES):
    return draw_goal(streams.stream(seed, torch.arange(N)), ranges.bounds(), ranges.standstill_probability)


def scipy_rotation(quaternion):
    return Rotation.from_quat(quaternion.double().numpy(), scalar_first=True)


def random_base(seed=0):
    generator = torch.Generator().manual_seed(seed)
    attitude = torch.nn.functional.normalize(torch.randn(N, 4, generator=generator), dim=-1)
    return torch.randn(N, 3, generator=generator), attitude


def test_goals_fill_their_ranges_evenly_and_never_leave_them():
    goal, duration = goals()
    angles = torch.as_tensor(scipy_rotation(goal[:, ATTITUDE]).as_euler("ZYX")[:, ::-1].copy()).float()
    values = torch.cat((goal[:, VELOCITY], goal[:, PLACE], angles, duration), -1)
    low, high = RANGES.bounds()
    assert (values >= low - 1e-5).all()
    assert (values <= high + 1e-5).all()
    unit = (values - low) / (high - low)
    torch.testing.assert_close(unit.mean(0), torch.full((11,), 0.5), atol=0.02, rtol=0)
    torch.testing.assert_close(torch.corrcoef(unit.T), torch.eye(11), atol=0.06, rtol=0, check_dtype=False)


def test_goals_ahead_are_ahead_of_the_shoulder_and_those_around_are_not():
    shoulder = torch.tensor(RANGES.shoulder)
    forward = {}
    for name in ("ahead", "around"):
        goal, _ = goals(ranges=command_ranges(name))
        place = goal_to_pose(goal, shoulder)[:, :3] - shoulder
        forward[name] = place[:, 0]
    assert (forward["ahead"] > 0).all()
    assert (forward["around"] < 0).float().mean() > 0.2
    with pytest.raises(ValueError, match="there are \\['ahead', 'around', 'box'\\]"):
        command_ranges("behind")


def test_goals_in_a_box_fill_it_evenly_and_their_middle_is_the_box_s():
    ranges, shoulder = command_ranges("box"), torch.tensor(RANGES.shoulder)
    goal, _ = draw_goal(streams.stream(0, torch.arange(N)), ranges.bounds(), 0.0, shoulder)
    low, high = torch.tensor(ranges.box).T
    unit = (goal_to_pose(goal, shoulder)[:, :3] - low) / (high - low)
    assert ((unit > -1e-4) & (unit < 1 + 1e-4)).all()
    torch.testing.assert_close(unit.mean(0), torch.full((3,), 0.5), atol=0.02, rtol=0)
    torch.testing.assert_close(torch.corrcoef(unit.T), torch.eye(3), atol=0.06, rtol=0)
    middle = goal_to_pose(ranges.centre(), shoulder)[:3]
    torch.testing.assert_close(middle, (low + high) / 2, atol=1e-5, rtol=0)


def test_one_sled_command_in_five_is_to_stand_and_the_others_go_backwards_only():
    goal, _ = goals(ranges=sled_commands())
    velocity = goal[:, VELOCITY]
    assert (velocity[:, 0] == 0).double().mean().item() == pytest.approx(0.2, abs=0.02)
    walks = velocity[velocity[:, 0] != 0]
    assert (walks[:, 0] < 0).all()
    assert walks[:, 0].mean().item() == pytest.approx(-0.5, abs=0.02)
    assert not velocity[:, 1:].any()


def test_roll_pitch_and_yaw_are_scipys():
    angles = torch.rand(100, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 6 - 3
    expected = Rotation.from_euler("ZYX", angles.flip(-1).numpy()).as_matrix()
    np.testing.assert_allclose(rotations.matrix(from_roll_pitch_yaw(angles)), expected, atol=1e-12)


def test_a_way_begins_at_the_start_and_ends_at_the_goal():
    (start, _), (goal, duration) = goals(0), goals(1)
    torch.testing.assert_close(blend_goals(start, goal, torch.zeros(N, 1), duration), start)
    reached = blend_goals(start, goal, torch.full((N, 1), 5.0), duration)
    torch.testing.assert_close(reached[:, :6], goal[:, :6])
    torch.testing.assert_close(rotations.matrix(reached[:, ATTITUDE]), rotations.matrix(goal[:, ATTITUDE]))


def test_velocity_distance_and_angles_change_at_constant_speed_in_their_own_times():
    (start, _), (goal, duration) = goals(0), goals(1)
    for elapsed in (0.5, 1.5, 3.0):
        command = blend_goals(start, goal, torch.full((N, 1), elapsed), duration)
        share = (elapsed / duration).clamp(max=1)
        for columns, of in ((VELOCITY, share[:, :1]), (PLACE, share[:, 1:])):
            expected = start[:, columns] + of * (goal[:, columns] - start[:, columns])
            torch.testing.assert_close(command[:, columns], expected)


def test_an_attitude_turns_about_one_axis_the_shorter_way():
    (start, _), (goal, duration) = goals(0), goals(1)
    goal[::2, ATTITUDE] *= -1  # the same attitude
    first, last = scipy_rotation(start[:, ATTITUDE]), scipy_rotation(goal[:, ATTITUDE])
    whole = (first.inv() * last).magnitude()
    done = np.zeros(N)
    for share in (0.25, 0.5, 0.75):
        command = blend_goals(start, goal, share * duration[:, 1:], duration)
        attitude = scipy_rotation(command[:, ATTITUDE])
        behind, ahead = (first.inv() * attitude).magnitude(), (attitude.inv() * last).magnitude()
        np.testing.assert_allclose(behind + ahead, whole, atol=1e-3)
        assert (behind > done).all()
        done = behind
        if share == 0.5:
            np.testing.assert_allclose(behind, ahead, atol=1e-3)


def test_the_way_between_two_goals_stays_in_the_ranges():
    (start, _), (goal, duration) = goals(0), goals(1)
    low, high = RANGES.bounds()[:, PLACE]
    command = blend_goals(start, goal, torch.rand(N, 1) * 5, duration)[:, PLACE]
    assert ((command >= low - 1e-6) & (command <= high + 1e-6)).all()


def test_a_pose_goes_to_the_frame_and_back():
    base, attitude = random_base()
    position, quaternion = random_base(1)
    seen = pose_to_frame(position, quaternion, base, attitude, 0.5)
    command = torch.cat((seen[:, :3], rotations.two_columns(seen[:, 3:])), -1)
    there, rotation = pose_to_world(command, base, attitude, 0.5)
    torch.testing.assert_close(there, position, atol=1e-5, rtol=0)
    torch.testing.assert_close(rotation, rotations.matrix(quaternion), atol=1e-5, rtol=0)


def test_a_command_does_not_bob_or_tilt_with_the_base():
    pose = goal_to_pose(goals()[0], torch.tensor(RANGES.shoulder))
    command = torch.cat((pose[:, :3], rotations.two_columns(pose[:, 3:])), -1)
    base, _ = random_base()
    yaw = torch.rand(N, 1) * 2 - 1
    upright = rotations.yaw_quaternion(yaw)
    tilted = rotations.multiply(upright, from_roll_pitch_yaw(torch.cat((0.3 * torch.ones(N, 2), 0 * yaw), -1)))
    high = base + torch.tensor([0.0, 0.0, 0.2])
    there, rotation = pose_to_world(command, base, upright, 0.5)
    torch.testing.assert_close(there[:, 2], command[:, 2] + 0.5)
    there_too, rotation_too = pose_to_world(command, high, tilted, 0.5)
    torch.testing.assert_close(there_too, there, atol=1e-5, rtol=0)
    torch.testing.assert_close(rotation_too, rotation, atol=1e-5, rtol=0)


def test_a_turn_of_the_base_carries_the_command_round_it():
    ahead = torch.tensor([0.6, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    base = torch.tensor([1.0, 2.0, 0.5])
    there, rotation = pose_to_world(ahead, base, rotations.yaw_quaternion(torch.tensor([math.pi / 2])), 0.5)
    torch.testing.assert_close(there, torch.tensor([1.0, 2.6, 0.5]))
    torch.testing.assert_close(rotation[:, 0], torch.tensor([0.0, 1.0, 0.0]), atol=1e-6, rtol=0)


def test_a_base_that_drifted_is_commanded_back():
    origin = torch.zeros(1, 3)
    for angle in (0.0, 2.0, 3.1):
        heading = rotations.yaw_quaternion(torch.tensor([[angle]]))
        line = line_ahead(origin, heading)
        left = rotations.rotate(heading, torch.tensor([[-3.0, 0.2, 0.0]]))
        turned = rotations.yaw_quaternion(torch.tensor([[angle + 0.3]]))
        lateral, yaw = deviation_from_line(line, left, turned)
        torch.testing.assert_close((lateral, yaw), (torch.tensor([[0.2]]), torch.tensor([[0.3]])), atol=1e-5, rtol=0)
        command = straighten(torch.tensor([[-0.5, 0.0, 0.0]]), lateral, yaw)
        torch.testing.assert_close(command, torch.tensor([[-0.5, -0.1, -0.15]]), atol=1e-5, rtol=0)


def test_a_base_that_shall_stand_is_left_where_it_is():
    stands = torch.zeros(1, 3)
    assert torch.equal(straighten(stands, torch.ones(1, 1), torch.ones(1, 1)), stands)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"distance": (0.8, 0.4)}, "lower bound first"),
        ({"duration": (2.0, 8.0)}, "at most the interval"),
        ({"duration": (0.0, 2.0)}, "more than 0"),
        ({"standstill_probability": 1.2}, "0 to 1"),
        ({"box": ((0.5, 0.8), (0.3, -0.3), (0.0, 0.5))}, "box to the left is"),
        ({"box": ((0.5, 0.8), (-0.3, 0.3), (0.0, 0.5)), "distance": (0.1, 0.2)}, "'distance'.* would be ignored"),
    ],
)
def test_ranges_that_cannot_be_drawn_from_are_refused(arguments, told):
    with pytest.raises(ValueError, match=told):
        CommandRanges(**arguments)


SHOULDER = torch.tensor(RANGES.shoulder)


def test_goals_seen_from_the_shoulder_turn_with_the_way_to_them():
    """At the middle of all angles the gripper's x axis points from the shoulder to the goal."""
    middle = replace(RANGES, roll=(0.0, 0.0), pitch=(0.0, 0.0), yaw=(0.0, 0.0))
    goal, _ = goals(ranges=middle)
    pose = goal_to_pose(goal, SHOULDER)
    way = pose[:, :3] - SHOULDER
    axis = rotations.rotate(pose[:, 3:], torch.tensor([1.0, 0.0, 0.0]).expand(N, 3))
    torch.testing.assert_close(axis, way / way.norm(dim=-1, keepdim=True), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(way.norm(dim=-1), goal[:, PLACE][:, 0])


def test_a_gripper_that_goes_overhead_is_not_rolled_over():
    """Its y axis stays to the left all the way to behind the head: the arm's plane does not turn round."""
    goal, _ = goals(ranges=replace(RANGES, roll=(0.0, 0.0), pitch=(0.0, 0.0), yaw=(0.0, 0.0), azimuth=(0.0, 0.0)))
    left = torch.tensor([0.0, 1.0, 0.0]).expand(N, 3)
    torch.testing.assert_close(rotations.rotate(goal_to_pose(goal, SHOULDER)[:, 3:], left), left)


def test_a_goal_becomes_a_pose_and_back():
    goal, _ = goals()
    back = pose_to_goal(goal_to_pose(goal, SHOULDER), SHOULDER)
    far = (goal[:, PLACE][:, 1] - math.pi / 2).abs() > 0.01  # straight overhead any azimuth is as good
    torch.testing.assert_close(back[far, 3:6], goal[far, 3:6], atol=1e-3, rtol=0)
    assert not back[:, VELOCITY].any()
    there = goal_to_pose(back, SHOULDER)
    torch.testing.assert_close(there[:, :3], goal_to_pose(goal, SHOULDER)[:, :3], atol=1e-5, rtol=0)
    turned = rotations.matrix(there[:, 3:])
    torch.testing.assert_close(turned, rotations.matrix(goal_to_pose(goal, SHOULDER)[:, 3:]), atol=1e-4, rtol=0)


def test_any_pose_becomes_a_goal_and_back():
    position, attitude = random_base(3)
    back = goal_to_pose(pose_to_goal(torch.cat((position, attitude), -1), SHOULDER), SHOULDER)
    torch.testing.assert_close(back[:, :3], position, atol=1e-5, rtol=0)
    torch.testing.assert_close(rotations.matrix(back[:, 3:]), rotations.matrix(attitude), atol=1e-4, rtol=0)


def test_no_way_leads_through_the_shoulder():
    """From the ground ahead to behind the head a straight line would pass it by a few centimetres."""
    start, goal = torch.zeros(2, 10)
    start[3:], goal[3:] = torch.tensor([0.85, -0.8, 0, 1, 0, 0, 0]), torch.tensor([0.8, 2.3, 0, 1, 0, 0, 0])
    for elapsed in (0.5, 1.0, 1.5):
        command = blend_goals(start, goal, torch.tensor([elapsed]), torch.tensor([2.0, 2.0]))
        assert (goal_to_pose(command, SHOULDER)[:3] - SHOULDER).norm() > 0.79


def test_a_frame_stands_on_the_ground_under_the_base():
    position, base = torch.tensor([[0.6, 0.0, 1.3]]), torch.tensor([[0.0, 0.0, 1.05]])
    ahead = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    seen = pose_to_frame(position, ahead, base, ahead, 0.5, torch.tensor([[0.5]]))
    assert seen[0, :3].tolist() == pytest.approx([0.6, 0.0, 0.3])
    command = torch.cat((seen[:, :3], rotations.two_columns(ahead)), -1)
    torch.testing.assert_close(pose_to_world(command, base, ahead, 0.5, torch.tensor([[0.5]]))[0], position)


def test_commands_are_drawn_from_what_the_robot_can_do():
    """Degrees; elevations go from the ground ahead to behind the head."""
    turns = {"elevation": (-48, 135), "azimuth": (-30, 30), "roll": (-45, 45), "pitch": (-20, 45), "yaw": (-30, 30)}
    others = {"forward": (-1.0, 1.0), "lateral": (-0.5, 0.5), "yaw_rate": (-1.0, 1.0), "distance": (0.5, 0.9)}
    ranges = CommandRanges()
    for name, between in turns.items():
        assert np.degrees(getattr(ranges, name)) == pytest.approx(between), name
    for name, between in others.items():
        assert getattr(ranges, name) == between, name
    assert (ranges.standstill_probability, ranges.interval, ranges.duration) == (0.1, 7.0, (2.0, 5.0))
    assert (ranges.frame_height, ranges.straighten, ranges.shoulder) == (0.5, 0.0, (0.15, 0.0, 0.25))
    ahead = command_ranges("ahead")
    assert ahead == replace(ranges, distance=(0.4, 0.8), elevation=ahead.elevation)
    assert np.degrees(ahead.elevation) == pytest.approx((-50, 35))
