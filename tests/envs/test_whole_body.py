"""The paper's pre-training environment: what it shows, what it rewards, when it ends."""

import pytest
import torch
from torchrl.envs import check_env_specs

from torchrl_athletic.envs import whole_body_env
from torchrl_athletic.envs.whole_body import fallen
from torchrl_athletic.functional.rewards import WBC_SCALES
from torchrl_athletic.networks import uan
from torchrl_athletic.robots import b2z1

ROBOT = b2z1()
POSE = torch.tensor(ROBOT.default_pose, dtype=torch.float32)


@pytest.fixture(scope="module")
def standing():
    """Half a second at the default pose, two robots."""
    env = whole_body_env(ROBOT, num_envs=2, net=uan(), max_steps=20)
    return env.rollout(25, lambda td: td.set("action", POSE.expand(2, -1)), break_when_any_done=False)


def test_specs_match_data():
    check_env_specs(whole_body_env(ROBOT, num_envs=2, max_steps=3), break_when_any_done="both")


def test_every_term_of_the_paper_s_table_is_there_and_they_add_up(standing):
    terms = standing["next", "reward_terms"]
    assert set(terms.keys()) == set(WBC_SCALES)
    total = sum(terms.values(include_nested=True))
    torch.testing.assert_close(standing["next", "reward"], total, atol=1e-5, rtol=1e-5)


def test_a_robot_that_stands_neither_collides_nor_falls_nor_breaks_limits(standing):
    terms = standing["next", "reward_terms"]
    assert terms["collision"].abs().max() == 0
    assert terms["joint_limits"].abs().max() < 0.1
    assert not standing["next", "terminated"].any()
    assert terms["ee_pose_tracking"][:, 0].min() > 2.5  # the first command is the pose that the arm has


def test_episodes_end_at_their_length_and_start_anew(standing):
    assert standing["next", "truncated"].squeeze(-1).nonzero()[:, 1].unique().tolist() == [19]
    assert standing["step_count"][:, 20].unique().tolist() == [0]


def test_the_policy_sees_ten_frames_the_newest_last(standing):
    frame = standing["frame"]
    assert (standing["observation"][:, 12].unflatten(-1, (10, -1)) == frame[:, 3:13]).all()


def test_the_frame_holds_the_action_before():
    env = whole_body_env(ROBOT, num_envs=1)
    actions = iter([POSE + 0.01, POSE + 0.02, POSE + 0.03])
    steps = env.rollout(3, lambda td: td.set("action", next(actions).unsqueeze(0)))
    assert steps["last_action"][0, :, 0].tolist() == pytest.approx([float(POSE[0]) + x for x in (0.0, 0.01, 0.02)])


def test_a_robot_without_torque_falls_and_its_episode_ends():
    env = whole_body_env(ROBOT, num_envs=1, arm_power=None, max_delay=0)
    for module in env.transform.modules():
        if hasattr(module, "kp"):
            module.kp.zero_()
            module.kd.zero_()
    steps = env.rollout(200, lambda td: td.set("action", POSE.unsqueeze(0)))
    assert steps["next", "terminated"][0, -1]
    assert fallen(steps["next"][:, -1]).all()
    assert len(steps[0]) < 100
