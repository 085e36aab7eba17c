"""What the tasks share."""

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from torchrl_athletic.envs import references
from torchrl_athletic.envs.task_parts import (
    auxiliary_rewards,
    bent_wrist,
    change_of,
    off_reference,
    pose_tracking,
    position_key_of,
    stance,
)
from torchrl_athletic.envs.whole_body_rewards import AUXILIARY
from torchrl_athletic.functional.phase import sled_phases, snatch_phases, throw_phases
from torchrl_athletic.robots import b2z1, read_motion

ROBOT = b2z1()


def value(term, phase=1, before=None, **after):
    """A term, of one row."""
    first = TensorDict({"task_phase_index": torch.tensor([[phase]]), **(before or {})}, [1])
    return float(term(first, TensorDict({key: torch.tensor([entry]) for key, entry in after.items()}, [1])))


def test_terms_count_in_their_phases_alone():
    parts = {"base_height": [0.5], "projected_gravity": [0.6, 0.0, -0.8]}
    assert [round(value(stance([0, 2]), phase, **parts), 5) for phase in (0, 1, 2)] == [0.37, 0.0, 0.37]


def test_a_smaller_robot_stands_at_its_own_height():
    upright = {"base_height": [0.3], "projected_gravity": [0.0, 0.0, -1.0]}
    assert value(stance([1], height=0.3), **upright) == 0.0
    assert value(stance([1]), **upright) == pytest.approx(0.09)


def test_the_arm_is_compared_with_its_own_joints_and_not_with_the_legs():
    term = off_reference([1], list(ROBOT.joint_groups["arm"]), "joint_position")
    position, reference = [0.0] * 19, [0.0] * 19
    position[0], position[13], reference[14] = 5.0, 0.2, -0.3
    assert value(term, joint_position=position, joint_reference=reference) == pytest.approx(0.5)


def test_a_straight_wrist_costs_nothing():
    position = [0.0] * 19
    position[12:15] = [1.0, 1.0, -1.0]  # the joints before the wrist
    assert value(bent_wrist([1], ROBOT, "joint_position"), joint_position=position) == 0.0
    position[15:18] = [0.1, -0.2, 0.3]
    assert value(bent_wrist([1], ROBOT, "joint_position"), joint_position=position) == pytest.approx(0.14)


def test_the_wrist_of_an_arm_of_one_s_own_is_found_by_its_place_in_the_arm():
    own = replace(ROBOT, joint_names=tuple(f"my_{name}" for name in ROBOT.joint_names))
    position = [0.0] * 15 + [0.1, -0.2, 0.3] + [9.0]  # the last is the gripper's
    assert value(bent_wrist([1], own, "joint_position"), joint_position=position) == pytest.approx(0.14)


def test_a_force_that_stays_costs_nothing():
    before = {"hand_force": torch.tensor([[3.0, 0.0]])}
    assert value(change_of([1], "hand_force"), before=before, hand_force=[3.0, 0.0]) == 0.0
    assert value(change_of([1], "hand_force"), before=before, hand_force=[0.0, 4.0]) == pytest.approx(5.0)


def test_the_pose_that_is_asked_for_earns_a_third_for_each_of_four_key_points():
    assert value(pose_tracking([1]), pose_error=[[0.0] * 3] * 4) == pytest.approx(4 / 3)
    assert value(pose_tracking([1]), pose_error=[[0.5, 0.0, 0.0]] * 4) == pytest.approx(4 / 3 * math.exp(-1), rel=1e-4)


def test_what_stands_below_the_dashed_line_of_the_paper_s_table_serves_every_task():
    terms, scales = auxiliary_rewards(ROBOT)
    assert set(terms) == set(scales) == {*AUXILIARY, "failure"}
    assert "gait" not in terms
    assert "ee_pose_tracking" not in terms


def test_a_failure_costs_as_much_as_many_steps_of_other_penalties():
    """The sled's reward was -0.056 a step: at a discount of 0.99 an early end saved at most 100 steps of it."""
    terms, scales = auxiliary_rewards(ROBOT)
    step = TensorDict(terminated=torch.tensor([[True], [False]]), batch_size=[2])
    cost = 0.02 * scales["failure"] * terms["failure"](step, step)
    assert cost.flatten().tolist() == pytest.approx([-10.0, 0.0])
    assert -cost[0] > 0.056 / (1 - 0.99)


def test_rewards_read_the_joints_behind_their_encoders():
    for offset in ((-0.05, 0.05), (0.0, 0.05), (-0.05, 0.0)):
        assert position_key_of(offset) == "true_joint_position"
    assert position_key_of((0.0, 0.0)) == "joint_position"


def test_a_motion_of_another_task_is_refused():
    with pytest.raises(ValueError, match=r"has the phases \['throw-set-up'.*the task \['sled-set-up', 'pull'\]"):
        references("throw", ROBOT, sled_phases())


def test_commands_are_those_of_the_motion():
    made = {part.keys[0]: part for part in references("throw", ROBOT, throw_phases())}
    assert made["end_effector_command"].table.shape[-1] == 9
    assert made["base_velocity_command"].table.shape[-1] == 3
    assert made["joint_reference"].table.shape[-1] == 19
    torch.testing.assert_close(
        made["joint_reference"].table[0, 0], torch.tensor(ROBOT.default_pose, dtype=torch.float32)
    )


def test_a_motion_runs_at_its_own_speed_beside_the_phases_of_the_task():
    """The set-up takes 2.5 s and the throw one: the tables' last rows are read when they are over."""
    for part in references("throw", ROBOT, throw_phases()):
        assert part.phase_keys == ("task_phase_index", "task_phase_step")
        assert part.lengths[:2].tolist() == [126, 51]
        for phase, steps in ((0, 125), (1, 50)):
            here = [torch.tensor([[phase]]), torch.tensor([[steps]])]
            [(_, shown)] = part._values(*here).items()
            torch.testing.assert_close(shown[0], part.table[phase, steps])


def test_a_base_that_stands_level_at_its_height_costs_nothing():
    assert value(stance([1]), base_height=[0.6], projected_gravity=[0.0, 0.0, -1.0]) == pytest.approx(0.0, abs=1e-9)


def test_shared_terms_read_the_joints_that_they_are_told():
    terms, _ = auxiliary_rewards(ROBOT, "true_joint_position")
    assert terms["joint_limits"].keys == terms["joint_deviation"].keys == ("true_joint_position",)


def test_a_motion_that_was_read_before_is_taken_and_one_of_other_phases_is_refused_however_many_it_has():
    motion = read_motion("sled")
    one, other = ([part.table for part in references(given, ROBOT, sled_phases())] for given in (motion, "sled"))
    for ours, theirs in zip(one, other, strict=True):
        torch.testing.assert_close(ours, theirs, equal_nan=True)
    with pytest.raises(ValueError, match=r"has the phases \['sled-set-up', 'pull'\], the task \['snatch-set-up'"):
        references(motion, ROBOT, snatch_phases())
    backwards = replace(sled_phases(), phases=sled_phases().phases[::-1])
    with pytest.raises(ValueError, match="in one order"):
        references(motion, ROBOT, backwards)
