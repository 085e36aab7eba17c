"""The sled: what pulls on the hand, what is commanded, what is rewarded."""

import math
from dataclasses import replace

import mujoco
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from torchrl_athletic.envs import NO_DISTURBANCES, Disturbances, sled_drift, sled_pull_env, sled_pull_rewards
from torchrl_athletic.envs.sled_pull import FRICTION, KNOWN, MASS
from torchrl_athletic.envs.whole_body import PRIVILEGED
from torchrl_athletic.functional.commands import CommandRanges, sled_commands
from torchrl_athletic.functional.phase import sled_phases
from torchrl_athletic.networks import pretrained
from torchrl_athletic.robots import Handle, b2z1
from torchrl_athletic.training import whole_rollout
from torchrl_athletic.transforms import Decimation, SledRope

ROBOT = b2z1(tool=Handle())
BACK = CommandRanges(
    forward=(-0.5, -0.5), lateral=(0.0, 0.0), yaw_rate=(0.0, 0.0), standstill_probability=0.0, straighten=0.5
)


def test_specs_match_data():
    check_env_specs(sled_pull_env(num_envs=2))


@pytest.fixture(scope="module")
def pulled():
    """Eight seconds of the untuned controller, told to walk backwards."""
    env = sled_pull_env(
        ROBOT, num_envs=2, mass=(20.0, 20.0), velocity=BACK, disturbances=NO_DISTURBANCES, max_steps=400
    )
    keys = [
        "base_velocity_command", "end_effector_command", "rope_tension", "sled_position", "task_phase_index",
        "base_position", "start_line", "base_quaternion", "reward_terms",
    ]  # fmt: skip
    return whole_rollout(env, pretrained("wbc"), keys, 400)


def test_a_robot_that_walks_backwards_pulls_the_sled_along(pulled):
    moved = pulled["sled_position"][:, -1] - pulled["sled_position"][:, 0]
    walked = pulled["base_position"][:, -1, :2] - pulled["base_position"][:, 0, :2]
    assert walked[:, 0].max() < -0.8
    assert moved[:, 0].max() < -0.3
    assert pulled["rope_tension"].amax(1).min() > 10.0
    assert pulled["rope_tension"][:, 0].max() < 1.0


def test_velocities_are_commanded_by_the_sampler_and_the_hand_by_the_motion(pulled):
    command, phase = pulled["base_velocity_command"], pulled["task_phase_index"].squeeze(-1)
    assert command[:, -1, 0].tolist() == pytest.approx([-0.5, -0.5])
    lateral, heading = sled_drift(pulled[:, -1])
    torch.testing.assert_close(command[:, -1, 1:], -0.5 * torch.cat((lateral, heading), -1))
    hand = pulled["end_effector_command"][phase == 1]
    assert (hand == hand[0]).all()
    assert hand[0, 0] > 0.6  # stretched out ahead


def test_terms_count_in_their_phases(pulled):
    terms, phase = pulled["reward_terms"], pulled["task_phase_index"].roll(1, 1)  # of the action
    phase[:, 0] = 0
    assert terms["velocity"][phase == 0].abs().max() == 0
    assert terms["ee_pose_tracking"][phase == 1].abs().max() == 0
    lateral, _ = sled_drift(pulled)
    torch.testing.assert_close(terms["lateral_drift"][phase == 1], -0.08 * lateral[phase == 1].abs())


def test_drift_to_either_side_costs_alike_and_the_wrong_speed_by_its_square():
    terms, scales = sled_pull_rewards(ROBOT, sled_phases())
    before = TensorDict(task_phase_index=[[1]], batch_size=[1])

    def earned(name, y=0.0, turn=0.0, speed=0.0):
        after = TensorDict(
            start_line=[[1.0, 0.0, 0.0]],
            base_position=[[-3.0, y, 0.5]],
            base_quaternion=[[math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]],
            base_linear_velocity=[[speed, 0.7, 0.7]],
            base_velocity_command=[[-0.5, 0.0, 0.0]],
            batch_size=[1],
        )
        return scales[name] * float(terms[name](before, after))

    assert [earned("lateral_drift", y) for y in (0.4, -0.4)] == pytest.approx([-1.6, -1.6])
    assert [earned("heading_drift", turn=turn) for turn in (0.3, -0.3)] == pytest.approx([-0.3, -0.3], abs=1e-6)
    assert earned("velocity", speed=-0.5) == 0.0
    assert earned("velocity", speed=0.5) == pytest.approx(-20.0)


def test_the_rope_pulls_at_the_rate_of_the_physics_and_the_critic_knows_the_sled():
    env = sled_pull_env(ROBOT, num_envs=2)
    kinds = [type(part) for part in env.transform]
    assert kinds.index(SledRope) < kinds.index(Decimation)
    shown = env.reset()
    torch.testing.assert_close(shown["privileged"][:, -3:], torch.cat([shown[key] for key in KNOWN], -1))


def test_the_environment_below_is_told_all_that_the_task_was(monkeypatch):
    """Nothing here is a default."""
    told, below = {}, "torchrl_athletic.envs.sled_pull"
    monkeypatch.setattr(f"{below}.whole_body_env", lambda robot, **asked: told.update(asked, robot=robot))
    monkeypatch.setattr(f"{below}.references", lambda *motion: [motion])
    off, phases = replace(NO_DISTURBANCES, encoder_offset=(0.0, 0.1)), sled_phases()
    given = {"num_envs": 7, "max_steps": 9, "seed": 5, "first_row": 3, "history": 2}
    sleds = {"mass": (21.0, 22.0), "friction": (0.3, 0.4)}
    sled_pull_env(ROBOT, schedule=phases, disturbances=off, motion="other", velocity=BACK, **sleds, **given)
    assert told.items() >= {**given, "robot": ROBOT, "schedule": phases, "disturbances": off}.items()
    assert told["privileged"] == (*PRIVILEGED, *KNOWN)
    walk, hold = told["commands"]
    assert (walk.ranges, walk.dt, walk.seed, walk.first_row) == (BACK, 0.02, 5, 3)
    assert hold == ("other", ROBOT, phases, {"end_effector_command": "end_effector_command"})
    [rope] = told["objects"]
    assert (rope.dt, rope.mass, rope.friction, rope.seed, rope.first_row) == (0.005, (21.0, 22.0), (0.3, 0.4), 5, 3)
    assert [type(part).__name__ for part in told["extra"]] == ["StartLine"]
    terms, _ = told["terms"]
    for name in ("joint_limits", "joint_deviation"):
        assert terms[name].keys == ("true_joint_position",)
    assert terms["wrist"].term.keys == ("true_joint_position",)


def test_each_term_has_its_phase_and_its_scale():
    terms, scales = sled_pull_rewards(ROBOT, sled_phases())
    own = ("ee_pose_tracking", "velocity", "lateral_drift", "heading_drift", "wrist")
    assert {name: terms[name].phases for name in own} == dict.fromkeys(own, (1,)) | {"ee_pose_tracking": (0,)}
    assert [scales[name] for name in own] == [5.0, -20.0, -4.0, -1.0, -1.0]
    assert scales["failure"] == -1000.0
    _, printed = sled_pull_rewards(ROBOT, sled_phases(), as_printed=True)
    assert [printed[name] for name in own] == [5.0, -5.0, -1.0, -1.0, -1.0]
    assert printed.keys() == scales.keys() - {"failure"}


def test_without_arguments_it_is_the_paper_s_task_for_the_robot_of_the_pre_training(monkeypatch):
    made = []
    below = "torchrl_athletic.envs.sled_pull.whole_body_env"
    monkeypatch.setattr(below, lambda *robot, **told: made.append((robot, told)))
    sled_pull_env()
    [([robot], told)] = made
    assert robot.ground == ("floor", "terrain")
    assert "handle" in robot.loads
    assert robot.model().opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert (told["schedule"], told["disturbances"]) == (sled_phases(), Disturbances())
    assert [told[name] for name in ("num_envs", "max_steps", "seed", "first_row")] == [4096, 1000, 0, 0]
    assert told["commands"][0].ranges == sled_commands()
    assert (told["objects"][0].mass, told["objects"][0].friction) == ((20.0, 180.0), (0.1, 0.2))


def test_usual_sizes_lie_within_what_is_drawn_and_the_rope_pulls_as_hard_as_such_a_sled_rubs():
    assert MASS[0] < KNOWN["sled_mass"] < MASS[1]
    assert FRICTION[0] <= KNOWN["sled_friction"] <= FRICTION[1]
    rubs = [9.81 * least * KNOWN["sled_mass"] for least in FRICTION]
    assert rubs[0] <= KNOWN["rope_tension"] * 1.05 <= rubs[1]
