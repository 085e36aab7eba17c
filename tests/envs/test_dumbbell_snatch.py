"""The snatch: when the weight comes, and what is rewarded."""

from dataclasses import replace

import mujoco
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from torchrl_athletic.envs import NO_DISTURBANCES, Disturbances, dumbbell_snatch_env, dumbbell_snatch_rewards
from torchrl_athletic.envs.dumbbell_snatch import KNOWN, MASS, hand_height
from torchrl_athletic.envs.whole_body import PRIVILEGED
from torchrl_athletic.functional.phase import Phase, PhaseSchedule, snatch_phases
from torchrl_athletic.robots import Dumbbell, b2z1

ROBOT = b2z1(tool=Dumbbell())
SHORT = PhaseSchedule((Phase("snatch-set-up", 0.06, leave_probability=0.5), Phase("snatch")))


def stand(td):
    return td.set("action", torch.zeros(*td.shape, 19))


@pytest.fixture(scope="module")
def played():
    """Six robots that stand at the default pose, whose set-up is over after three steps, or never."""
    env = dumbbell_snatch_env(
        ROBOT, num_envs=6, net=None, schedule=SHORT, mass=(4.0, 8.0), disturbances=NO_DISTURBANCES, seed=2
    )
    return env, env.rollout(40, stand)


def test_specs_match_data():
    check_env_specs(dumbbell_snatch_env(num_envs=2))


def test_the_weight_comes_with_the_snatch_and_pulls_the_hand_down(played):
    env, steps = played
    lifts = steps["task_phase_index"][:, 5] == 1
    assert 0 < lifts.sum() < 6
    assert (steps["added_mass"][:, :3] == 0).all()
    carried = steps["added_mass"][:, 5]
    assert carried[lifts].min() > 4.0
    assert (carried[~lifts] == 0).all()
    height = hand_height(*(steps["next", key] for key in ("end_effector_position", "base_position", "base_height")))
    sinks = height[:, 2] - height[:, -1]
    assert sinks[lifts].min() > 0.05
    assert sinks[~lifts].max() < sinks[lifts].min()
    model = env.base_env.physics.model
    weights = env.base_env.physics.field("body_mass")[:, model.body("dumbbell").id]
    torch.testing.assert_close(weights[lifts.flatten()].float(), carried[lifts])


def test_the_critic_knows_the_weight_before_it_comes(played):
    _, steps = played
    width = sum(steps[key].shape[-1] for key in KNOWN)
    torch.testing.assert_close(steps["privileged"][:, 0, -width + 1 : -width + 2], steps["load_mass"][:, 0])
    assert steps["load_mass"][:, 0].min() >= 4.0


def test_terms_count_in_their_phases(played):
    _, steps = played
    terms, phase = steps["next", "reward_terms"], steps["task_phase_index"]
    assert terms["hand_height"][phase == 0].abs().max() == 0
    assert terms["ee_pose_tracking"][phase == 1].abs().max() == 0
    height = hand_height(*(steps["next", key] for key in ("end_effector_position", "base_position", "base_height")))
    torch.testing.assert_close(terms["hand_height"][phase == 1], 4 * 0.02 * height[phase == 1])
    joints = steps["next", "joint_position"][..., 15:18]
    bent = joints.square().sum(-1, keepdim=True)
    torch.testing.assert_close(terms["wrist"][phase == 1], -0.02 * bent[phase == 1])


def test_slamming_the_hand_into_the_ground_costs():
    terms, scales = dumbbell_snatch_rewards(ROBOT, snatch_phases())

    def earned(force, phase):
        before = TensorDict(task_phase_index=[[phase]], hand_force=[[0.0]], batch_size=[1])
        return scales["force_smoothness"] * float(
            terms["force_smoothness"](before, TensorDict(hand_force=[[force]], batch_size=[1]))
        )

    assert [earned(200.0, phase) for phase in (0, 1)] == pytest.approx([-1.0, -1.0])


def test_height_is_that_over_the_ground_below_the_base():
    hand, base = torch.tensor([[9.0, 9.0, 2.0]]), torch.tensor([[8.0, 9.0, 1.1]])
    assert hand_height(hand, base, torch.tensor([[0.5]])).item() == pytest.approx(1.4)


def test_the_environment_below_is_told_all_that_the_task_was(monkeypatch):
    """Nothing here is a default."""
    told, below = {}, "torchrl_athletic.envs.dumbbell_snatch"
    monkeypatch.setattr(f"{below}.whole_body_env", lambda robot, **asked: told.update(asked, robot=robot))
    monkeypatch.setattr(f"{below}.references", lambda *motion: [motion])
    off = replace(NO_DISTURBANCES, encoder_offset=(0.0, 0.1))
    given = {"num_envs": 7, "max_steps": 9, "seed": 5, "first_row": 3, "history": 2}
    late = PhaseSchedule((Phase("pause", 1.0), *SHORT.phases))
    dumbbell_snatch_env(ROBOT, schedule=late, disturbances=off, motion="other", mass=(1.0, 2.0), **given)
    assert told.items() >= {**given, "robot": ROBOT, "schedule": late, "disturbances": off}.items()
    assert told["commands"] == [("other", ROBOT, late)]
    assert told["privileged"] == (*PRIVILEGED, *KNOWN)
    [load] = told["extra"]
    assert (load.body, load.mass, load.phase, load.seed, load.first_row) == ("dumbbell", (1.0, 2.0), 2, 5, 3)
    terms, scales = told["terms"]
    assert terms.keys() == scales.keys()
    for name in ("joint_limits", "joint_deviation"):
        assert terms[name].keys == ("true_joint_position",)
    assert terms["wrist"].term.keys == ("true_joint_position",)
    assert (terms["wrist"].phases, terms["hand_height"].phases, terms["ee_pose_tracking"].phases) == ((2,), (2,), (1,))


def test_reaching_for_the_weight_earns_five_thirds_a_second_for_each_key_point():
    terms, scales = dumbbell_snatch_rewards(ROBOT, snatch_phases())
    before, after = TensorDict(task_phase_index=[[0]], batch_size=[1]), TensorDict(pose_error=torch.zeros(1, 4, 3))
    assert scales["ee_pose_tracking"] * terms["ee_pose_tracking"](before, after).item() == pytest.approx(20 / 3)


def test_without_arguments_it_is_the_paper_s_task_for_the_robot_of_the_pre_training(monkeypatch):
    made = []
    below = "torchrl_athletic.envs.dumbbell_snatch.whole_body_env"
    monkeypatch.setattr(below, lambda *robot, **told: made.append((robot, told)))
    dumbbell_snatch_env()
    [([robot], told)] = made
    assert robot.ground == ("floor", "terrain")
    assert "dumbbell" in robot.loads
    assert robot.model().opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert (told["schedule"], told["disturbances"]) == (snatch_phases(), Disturbances())
    assert [told[name] for name in ("num_envs", "max_steps", "seed", "first_row")] == [4096, 500, 0, 0]
    assert told["extra"][0].mass == (0.0, 10.0)


def test_usual_sizes_are_those_of_the_middle_dumbbell_and_of_the_heaviest_one_s_weight():
    assert KNOWN["added_mass"] == KNOWN["load_mass"] == sum(MASS) / 2
    assert KNOWN["hand_force"] == pytest.approx(9.81 * MASS[1], rel=0.05)
