"""The reward tables, term by term, by hand and by what each is meant to encourage."""

import math

import pytest
import torch

from torchrl_athletic.functional import rewards, rotations


def row(*values: float) -> torch.Tensor:
    return torch.tensor([values])


def test_keypoints_on_their_goal_earn_a_third_each_and_an_attitude_error_costs_as_a_distance_does():
    frame = rotations.keypoints(torch.zeros(1, 3), torch.eye(3)[None])
    assert rewards.keypoint_tracking(frame, frame).item() == pytest.approx(4 / 3)
    turned = rotations.keypoints(torch.zeros(1, 3), rotations.matrix(rotations.yaw_quaternion(row(math.pi))))
    by_hand = (1 + 1 + 2 * math.exp(-2 * 2)) / 3  # origin and z axis stay, x and y tips move by 2 m
    assert rewards.keypoint_tracking(frame, turned).item() == pytest.approx(by_hand, abs=1e-6)


@pytest.mark.parametrize(
    ("value", "by_hand"),
    [
        (rewards.gaussian(row(1.0, 0.0), row(0.5, 0.5), 4.0), math.exp(-4 * 0.5)),
        (rewards.gaussian(row(0.1, 0.0), row(0.0, 0.0), 300.0), math.exp(-3)),
        (rewards.square(row(-2.0, 1.0)), 5.0),
        (rewards.absolute_error(row(0.1, -0.2), row(0.0, 0.0)), 0.3),
        (rewards.premature_contact(row(1, 0, 1, 1), row(0.04, 0.04, 0.05, 0.03)), 2.0),
        (rewards.foot_slip(row(1, 0), torch.tensor([[[3.0, 0, 1.0], [9.0, 9, 9]]])), 1 - math.exp(-1)),
        (rewards.foot_clearance(row(1, 0), row(0.1, 0.1), row(0.04, 0.0)), 0.0036),
        (rewards.mechanical_power(row(2.0, -3.0), row(1.0, 2.0)), 4.0),
        (rewards.action_roughness(torch.tensor([[[0.0], [1.0], [3.0]]])), 4 + 0.5),
        (rewards.action_steadiness(torch.tensor([[[9.0, 9], [0.0, 1], [1.0, 0]]])), math.exp(-1)),
        (rewards.beyond_limits(row(-1.5, 0.2, 1.25), torch.tensor([[-1.0, 1.0]] * 3)), 0.75),
        (rewards.any_above(row(0.3, -0.4)), 1.0),  # 0.16 N² above 0.1
        (rewards.any_above(row(0.3, -0.3)), 0.0),
    ],
)
def test_terms_by_hand(value, by_hand):
    assert value.shape == (1, 1)
    assert value.item() == pytest.approx(by_hand, abs=1e-6)


def test_a_foot_that_stands_still_is_not_punished_and_a_faster_slide_is_punished_more():
    speeds = torch.tensor([0.0, 1.0, 3.0])[:, None, None] * torch.tensor([1.0, 0.0, 0.0])
    slip = rewards.foot_slip(torch.ones(3, 1), speeds).flatten()
    assert slip[0] == 0
    assert (slip.diff() > 0).all()
    assert rewards.WBC_SCALES["foot_slip"] < 0


def test_a_constant_action_is_smooth_a_ramp_costs_its_slope_and_a_zigzag_most():
    constant, ramp, zigzag = ([[[float(x)] for x in path]] for path in ((1, 1, 1), (0, 1, 2), (0, 1, 0)))
    cost = [rewards.action_roughness(torch.tensor(path)).item() for path in (constant, ramp, zigzag)]
    assert cost == [0.0, 1.0, 1.0 + 0.5 * 4]


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_terms_keep_the_batch_and_one_column(batch):
    q, feet, velocity = torch.rand(*batch, 7), torch.rand(*batch, 4), torch.rand(*batch, 4, 3)
    points, past = torch.rand(*batch, 4, 3), torch.rand(*batch, 3, 7)
    values = [
        rewards.keypoint_tracking(points, points), rewards.gaussian(q, q, 4.0), rewards.square(q),
        rewards.absolute_error(q, q), rewards.premature_contact(feet > 0.5, feet), rewards.foot_slip(feet, velocity),
        rewards.foot_clearance(feet, feet, feet), rewards.mechanical_power(q, q), rewards.action_roughness(past),
        rewards.action_steadiness(past), rewards.beyond_limits(q, torch.rand(7, 2)), rewards.any_above(feet),
    ]  # fmt: skip
    assert {value.shape for value in values} == {(*batch, 1)}
    assert {value.dtype for value in values} == {torch.float32}


def test_scales_are_those_of_the_paper_s_two_tables():
    """Fey et al. 2025, appendix A: WBC and UAN rewards."""
    assert rewards.WBC_SCALES == {
        "ee_pose_tracking": 5.0, "linear_velocity_tracking": 2.0, "angular_velocity_tracking": 1.0,
        "gait": -0.5, "foot_slip": -0.5, "foot_clearance": -40.0,
        "mechanical_power": -1e-4, "action_smoothness": -0.05, "linear_velocity_z": -2.0, "angular_velocity_xy": -0.05,
        "joint_deviation": -0.25, "collision": -5.0, "joint_limits": -10.0, "contact_force": -4e-6,
    }  # fmt: skip
    tracking = ("joint_position_relaxed", "joint_position_moderate", "joint_position_strict")
    assert [rewards.UAN_SCALES[name] for name in tracking] == [4.0, 4.0, 5.0]
    assert (rewards.UAN_SCALES["joint_position_error"], rewards.UAN_SCALES["action_smoothness"]) == (-1.5, 0.5)
