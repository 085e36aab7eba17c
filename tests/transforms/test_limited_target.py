"""A target moved within the motor's limits commands what the limits leave, and one within them stays."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, Transform

from torchrl_athletic.functional.actuation import clip_torque_speed, pd_torque
from torchrl_athletic.testing import TransformContract
from torchrl_athletic.transforms import LimitedTarget, PDControl

Key = Callable[[str], object]


class TestLimitedTargetContract(TransformContract):
    env_settings: ClassVar = {"action": "torque"}

    def make_transform(self, key: Key = str, first_row: int = 0) -> Transform:
        seen = {"position_key": key("joint_position"), "velocity_key": key("joint_velocity")}
        law = PDControl(20.0, 0.5, torque_key=key("torque"), action_key=key("action"), target_key=key("target"), **seen)
        return Compose(law, LimitedTarget(20.0, 0.5, 0.4, 2.0, action_key=key("action"), **seen))


def test_the_law_commands_what_the_limits_leave() -> None:
    torch.manual_seed(0)
    names = ("action", "joint_position", "joint_velocity")
    seen = TensorDict({name: 2 * torch.randn(200, 2) for name in names}, batch_size=[200])
    kp, kd, limit, fastest = torch.tensor([10.0, 20.0]), torch.tensor([0.5, 1.0]), torch.tensor([8.0, 5.0]), 3.0
    near = LimitedTarget(kp, kd, limit, fastest).inv(seen)["action"]
    position, velocity = seen["joint_position"], seen["joint_velocity"]
    asked = pd_torque(seen["action"], position, velocity, kp, kd)
    left = clip_torque_speed(asked, velocity, limit, torch.tensor(fastest))
    torch.testing.assert_close(pd_torque(near, position, velocity, kp, kd), left, atol=1e-4, rtol=1e-4)
    within = asked == left
    assert 0.05 < within.float().mean() < 0.9
    torch.testing.assert_close(near[within], seen["action"][within], atol=0, rtol=0)


def test_a_law_without_stiffness_has_no_targets() -> None:
    with pytest.raises(ValueError, match="or leave LimitedTarget out"):
        LimitedTarget([1.0, 0.0], 1.0, 1.0, 1.0)


def test_a_motor_drawn_weaker_moves_the_target_nearer_and_a_stiffer_drive_too() -> None:
    near = LimitedTarget(20.0, 0.5, 4.0, 10.0)
    seen = TensorDict(
        action=torch.ones(1, 2), joint_position=torch.zeros(1, 2), joint_velocity=torch.ones(1, 2), batch_size=[1]
    )
    seen["torque_limit_scale"] = torch.tensor([[1.0, 0.5]])
    seen["kp_scale"], seen["kd_scale"] = torch.tensor([[1.0, 2.0]]), torch.tensor([[4.0, 3.0]])
    target = near.inv(seen.clone())["action"]
    kp, kd = torch.tensor([[20.0, 40.0]]), torch.tensor([[2.0, 1.5]])
    torque = pd_torque(target, seen["joint_position"], seen["joint_velocity"], kp, kd)
    assert torque.tolist() == [[pytest.approx(4.0 * 0.9), pytest.approx(2.0 * 0.9)]]


@pytest.mark.parametrize("missing", ["action", "joint_position"])
def test_data_that_do_not_tell_how_far_off_a_target_is_are_refused(missing: str) -> None:
    seen = TensorDict({name: torch.zeros(1, 2) for name in ("action", "joint_position", "joint_velocity")}, [1])
    with pytest.raises(KeyError, match="cannot tell how far off"):
        LimitedTarget(20.0, 0.5, 4.0, 10.0).inv(seen.exclude(missing))


def test_motors_without_load_turn_at_speeds_of_their_own() -> None:
    near = LimitedTarget(20.0, 0.0, 4.0, [10.0, 2.0])
    seen = TensorDict(
        action=torch.ones(1, 2), joint_position=torch.zeros(1, 2), joint_velocity=torch.ones(1, 2), batch_size=[1]
    )
    target = near.inv(seen)["action"]
    torch.testing.assert_close(target, torch.tensor([[4.0 * 0.9 / 20.0, 4.0 * 0.5 / 20.0]]))
