"""What an encoder reads is off by the same all episode long."""

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.robots import z1
from torchrl_athletic.testing import ToyEnv
from torchrl_athletic.transforms import Decimation, EncoderOffset, PDControl

ROBOT = z1()


def make_env(n: int = 3, **kwargs) -> TransformedEnv:
    chain = PDControl(ROBOT.kp, ROBOT.kd), EncoderOffset(**kwargs), Decimation(4)
    return TransformedEnv(TorqueEnv(ROBOT, num_envs=n), Compose(*chain))


@pytest.mark.parametrize("out_key", [None, "reading"])
def test_specs_hold(out_key):
    check_env_specs(make_env(out_key=out_key))


def test_the_reading_is_the_position_plus_an_offset_that_lasts_an_episode():
    env = make_env()
    td = env.reset()
    offset = td["encoder_offset"]
    assert (0 < offset.abs()).all()
    assert (offset.abs() <= 0.05).all()
    for _ in range(4):
        true = env.base_env.physics.joint_position.float()
        torch.testing.assert_close(td["joint_position"], true + offset)
        assert torch.equal(td["encoder_offset"], offset)
        td = env.step(td.set("action", torch.zeros(3, 7)))["next"]
    again = env.reset(td.clone().set("_reset", torch.tensor([[True], [False], [False]])))
    assert (again["encoder_offset"] != offset).any(-1).tolist() == [True, False, False]
    true = env.base_env.physics.joint_position.float()
    torch.testing.assert_close(again["joint_position"], true + again["encoder_offset"])


def test_a_drive_holds_the_reading_at_its_target():
    env = make_env(2, low=0.05, high=0.05, joints=[0])
    target = torch.tensor(ROBOT.default_pose).repeat(2, 1)
    td = env.reset()
    for _ in range(150):
        td = env.step(td.set("action", target))["next"]
    true = env.base_env.physics.joint_position
    torch.testing.assert_close(true[:, 0].float(), target[:, 0] - 0.05, atol=0.02, rtol=0)
    assert (td["encoder_offset"][:, 1:] == 0).all()


def test_offsets_are_even_in_their_range():
    offset = TransformedEnv(TorqueEnv(ROBOT, num_envs=300), EncoderOffset(-0.02, 0.04)).reset()["encoder_offset"]
    assert offset.mean().item() == pytest.approx(0.01, abs=0.002)
    assert offset.std().item() == pytest.approx(0.06 / 12**0.5, rel=0.05)


def test_each_joint_has_an_offset_of_its_own():
    offset = TransformedEnv(TorqueEnv(ROBOT, num_envs=4), EncoderOffset()).reset()["encoder_offset"]
    assert all(len(set(row)) == 7 for row in offset.tolist())


def test_outside_decimation_it_may_not_hide_the_position():
    env = TransformedEnv(TorqueEnv(ROBOT), Compose(Decimation(4), EncoderOffset()))
    with pytest.raises(ValueError, match="before Decimation, or give it an out_key"):
        env.reset()
    beside = Compose(Decimation(4), EncoderOffset(out_key="reading"))
    assert "reading" in TransformedEnv(TorqueEnv(ROBOT), beside).reset().keys()
    with pytest.raises(ValueError, match="low <= high"):
        EncoderOffset(0.1, -0.1)


def test_the_true_position_is_shown_beside_a_reading_in_place_from_the_first_moment_on():
    env = make_env(3, true_key="true")
    td = env.reset()
    for k in range(4):
        torch.testing.assert_close(td["true"], env.base_env.physics.joint_position.float(), rtol=0, atol=0)
        torch.testing.assert_close(td["joint_position"], td["true"] + td["encoder_offset"], rtol=0, atol=0)
        assert (td["true"] != td["joint_position"]).all()
        if k == 2:
            td = env.reset(td.set("_reset", torch.tensor([[True], [False], [True]])))
        else:
            td = env.step(td.set("action", torch.ones(3, 7)))["next"]


def test_the_true_position_is_shown_where_the_environment_resets_itself():
    shown, plain = (
        TransformedEnv(ToyEnv(native_autoreset=True, groups=()), part).rollout(
            12, lambda td: td.set("action", torch.ones(3, 3)), break_when_any_done=False
        )
        for part in (EncoderOffset(-1.0, 1.0, true_key="true"), Compose())
    )
    torch.testing.assert_close(shown["true"], plain["joint_position"])
    torch.testing.assert_close(shown["joint_position"], shown["true"] + shown["encoder_offset"])
    assert (shown["encoder_offset"].diff(dim=1) != 0).any()


@pytest.mark.parametrize("joints", [[2], [2, 0], slice(1, 3)])
def test_encoders_of_other_joints_read_true(joints):
    shown = TransformedEnv(ToyEnv(4), EncoderOffset(joints=joints)).reset()["encoder_offset"]
    chosen = torch.zeros(3, dtype=torch.bool)
    chosen[joints] = True
    assert (shown[:, chosen] != 0).all()
    assert (shown[:, ~chosen] == 0).all()


@pytest.mark.parametrize("out_key", [None, "reading"])
def test_rows_that_reset_themselves_in_the_step_get_another_offset_and_the_others_keep_theirs(out_key):
    env = TransformedEnv(ToyEnv(3), EncoderOffset(out_key=out_key))
    before = env.reset()
    starts = torch.tensor([[True], [False], [True]])
    shown = before.select("joint_position") if out_key is None else before.select("joint_position", "reading")
    after = env.transform._reset_on_native_autoreset(before.copy().set("_reset", starts), shown.clone())
    changed = (after["encoder_offset"] != before["encoder_offset"]).all(-1, keepdim=True)
    assert changed.equal(starts)
    true = before["joint_position"] - (before["encoder_offset"] if out_key is None else 0.0)
    torch.testing.assert_close(after[out_key or "joint_position"], true + after["encoder_offset"])
