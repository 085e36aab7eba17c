"""What an encoder reads is off by the same all episode long."""

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.robots import z1
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


def test_outside_decimation_it_may_not_hide_the_position():
    env = TransformedEnv(TorqueEnv(ROBOT), Compose(Decimation(4), EncoderOffset()))
    with pytest.raises(ValueError, match="before Decimation, or give it an out_key"):
        env.reset()
    beside = Compose(Decimation(4), EncoderOffset(out_key="reading"))
    assert "reading" in TransformedEnv(TorqueEnv(ROBOT), beside).reset().keys()
    with pytest.raises(ValueError, match="low <= high"):
        EncoderOffset(0.1, -0.1)
