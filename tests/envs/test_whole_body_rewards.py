"""The paper's table of rewards, term by term, by hand from what the environment shows."""

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_athletic.envs import whole_body_rewards
from torchrl_athletic.functional.rewards import WBC_SCALES
from torchrl_athletic.robots import b2z1

ROBOT = b2z1()
TERMS, SCALES = whole_body_rewards(ROBOT)
POSE = torch.tensor(ROBOT.default_pose)


def earned(name, terms=TERMS, **shown):
    """Reward of one robot, at a quarter of the clock: the first and last foot stand, the others swing."""
    entries = {key: torch.as_tensor(value, dtype=torch.float32)[None] for key, value in shown.items()}
    step = TensorDict({"gait_cycle": torch.tensor([[0.25]]), **entries}, [1])
    value = terms[name](TensorDict({}, [1]), step)
    assert value.shape == (1, 1)
    return value.item()


def test_only_the_command_s_own_components_are_tracked():
    e = math.exp(-1)
    moves = {"base_linear_velocity": [1.0, 0.5, 9.0], "base_velocity_command": [0.5, 0.5, -7.0]}
    assert earned("linear_velocity_tracking", **moves) == pytest.approx(e)  # 4 * 0.5²
    turns = {"base_angular_velocity": [9.0, 9.0, -0.7], "base_velocity_command": [5.0, 5.0, -0.2]}
    assert earned("angular_velocity_tracking", **turns) == pytest.approx(e)
    assert earned("linear_velocity_z", base_linear_velocity=[3.0, 3.0, -0.5]) == pytest.approx(0.25)
    assert earned("angular_velocity_xy", base_angular_velocity=[3.0, -4.0, 9.0]) == pytest.approx(25.0)


def test_the_hand_is_tracked_by_its_four_keypoints():
    way = torch.zeros(4, 3)
    assert earned("ee_pose_tracking", pose_error=way) == pytest.approx(4 / 3)
    way[2, 1] = -0.5
    assert earned("ee_pose_tracking", pose_error=way) == pytest.approx((3 + math.exp(-2 * 0.5)) / 3)


def test_feet_that_should_stand_are_asked_not_to_slide_and_the_others_are_free():
    velocity = torch.tensor([[3.0, 0.0, 1.0], [9.0, 9.0, 9.0], [9.0, 9.0, 9.0], [0.0, 0.0, 0.0]])
    assert earned("foot_slip", foot_velocity=velocity) == pytest.approx(1 - math.exp(-0.1 * 10))
    assert earned("foot_slip", foot_velocity=velocity.flip(0)) == pytest.approx(1 - math.exp(-0.1 * 10))
    velocity[0] = 0.0
    assert earned("foot_slip", foot_velocity=velocity) == 0.0


def test_feet_that_should_swing_are_asked_to_be_a_tenth_of_a_metre_over_where_they_stand():
    """The centre of a foot that stands is 3.2 cm up, its radius."""
    assert earned("foot_clearance", foot_height=[0.5, 0.132, 0.132, 0.5]) == pytest.approx(0.0, abs=1e-9)
    assert earned("foot_clearance", foot_height=[0.5, 0.032, 0.152, 0.5]) == pytest.approx(0.1**2 + 0.02**2)
    assert earned("gait", foot_height=[0.0, 0.042, 0.044, 0.0]) == 1.0  # one that should swing is down
    assert earned("gait", foot_height=[0.0, 0.0, 0.0, 0.0]) == 2.0


def test_feet_of_one_s_own_are_down_and_up_by_their_own_radius():
    small = whole_body_rewards(ROBOT, foot_radius=0.02)[0]
    assert earned("gait", small, foot_height=[0.0, 0.030, 0.032, 0.0]) == 1.0
    assert earned("foot_clearance", small, foot_height=[0.5, 0.12, 0.12, 0.5]) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("key", "width"), [("leg_force", 8), ("arm_force", 3), ("trunk_force", 1)])
def test_a_force_on_any_part_but_a_foot_is_a_collision(key, width):
    still = {"leg_force": [0.0] * 8, "arm_force": [0.0] * 3, "trunk_force": [0.0], "foot_force": [300.0] * 4}
    assert earned("collision", **still) == 0.0
    for part in range(width):
        force = [0.0] * width
        force[part] = 1.0
        assert earned("collision", **(still | {key: force})) == 1.0


def test_joints_pay_for_what_they_do():
    away = torch.zeros(19)
    away[[0, 12]] = torch.tensor([0.1, -0.2])
    assert earned("joint_deviation", joint_position=POSE + away) == pytest.approx(0.3)
    assert earned("joint_limits", joint_position=POSE) == 0.0
    low, high = ROBOT.position_limit[1]
    beyond = POSE.clone()
    beyond[1], beyond[4] = low - 0.25, high + 0.5
    assert earned("joint_limits", joint_position=beyond) == pytest.approx(0.75)
    assert earned("mechanical_power", joint_power=[-30.0, 10.0] + [0.0] * 17) == pytest.approx(20.0)
    assert earned("contact_force", foot_force=[3.0, 4.0, 0.0, 0.0]) == pytest.approx(25.0)


def test_true_positions_are_read_where_they_are_told_to_be():
    terms, _ = whole_body_rewards(ROBOT, "true_joint_position")
    step = TensorDict({"joint_position": POSE[None] + 1.0, "true_joint_position": POSE[None]}, [1])
    assert terms["joint_deviation"](step, step).item() == 0.0
    assert terms["joint_limits"](step, step).item() == 0.0


def test_what_is_left_out_has_neither_term_nor_scale():
    assert TERMS.keys() == SCALES.keys() == WBC_SCALES.keys()
    terms, scales = whole_body_rewards(ROBOT, without=("gait",))
    assert terms.keys() == scales.keys() == WBC_SCALES.keys() - {"gait"}
    with pytest.raises(ValueError, match=r"'gate', which is no term of the reward; there are .*'gait'"):
        whole_body_rewards(ROBOT, without=("gait", "gate"))


def test_an_action_that_changes_costs_and_more_where_its_change_changes():
    history = torch.zeros(3, 19)
    history[2, 4], history[1, 13] = 0.5, 1.0
    assert earned("action_smoothness", action_history=history) == pytest.approx(0.25 + 1.0 + (0.25 + 4.0) / 2)
