"""A supervised net takes the place of the torque law."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import Compose, Transform, TransformedEnv

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.robots import z1
from torchrl_athletic.testing import TransformContract
from torchrl_athletic.transforms import ActuatorNet, EquivalentTarget, PDControl

Key = Callable[[str], object]
ROBOT = z1()
ENTRIES = {"position": "joint_position", "velocity": "joint_velocity", "target": "position_target"}


class PDNet(nn.Module):
    """What a net that learned the PD law of the newest errors gives, and twice that."""

    def __init__(self, length: int, kp: float = 20.0, kd: float = 0.5, times: float = 1.0) -> None:
        super().__init__()
        weight = torch.zeros(2 * length)
        weight[length - 1], weight[-1] = times * kp, times * kd
        self.weight = nn.Parameter(weight)

    def forward(self, errors: Tensor) -> Tensor:
        return (errors * self.weight).sum(-1, keepdim=True)


class TestActuatorNetContract(TransformContract):
    env_settings: ClassVar = {"action": "torque"}
    joints: ClassVar = None

    def make_transform(self, key: Key = str, first_row: int = 0) -> Transform:
        common = {f"{name}_key": key(ENTRIES.get(name, name)) for name in ("torque", "position", "velocity", "target")}
        noted = {"actuator_key": key("actuator_torque"), "history_key": key("error_history")}
        net = ActuatorNet(PDNet(4, times=0.7), self.joints, length=4, **common, **noted)
        return Compose(net, PDControl(20.0, 0.5, **common, action_key=key("action")))


class TestActuatorNetOfSomeContract(TestActuatorNetContract):
    joints: ClassVar = [0, 2]


def always(action: Tensor) -> TensorDictModule:
    return TensorDictModule(lambda position: action, in_keys=["joint_position"], out_keys=["action"])


def driven(*chain: Transform, action: Tensor, steps: int = 5) -> TensorDict:
    env = TransformedEnv(TorqueEnv(ROBOT, num_envs=len(action)), Compose(*chain))
    return env.rollout(steps, policy=always(action))


def test_a_net_that_learned_the_pd_law_moves_the_arm_as_the_pd_law_does() -> None:
    action = torch.tensor(ROBOT.default_pose) + torch.linspace(-0.2, 0.2, 3)[:, None]
    law = driven(PDControl(20.0, 0.5), action=action)
    net = driven(ActuatorNet(PDNet(20)), PDControl(20.0, 0.5), action=action)
    torch.testing.assert_close(net["next", "joint_position"], law["next", "joint_position"])


def test_only_joints_of_the_group_get_the_nets_torque() -> None:
    action = torch.tensor(ROBOT.default_pose)[None] + 0.1
    shown = driven(ActuatorNet(PDNet(20, times=2.0), joints="arm"), PDControl(20.0, 0.5), action=action, steps=1)
    torque = shown["next", "applied_torque"][0, 0]
    assert torque[:6] == pytest.approx([4.0] * 6, rel=1e-5)  # twice 20 N·m/rad times 0.1 rad, at rest
    assert torque[6] == pytest.approx(2.0, rel=1e-5)


def test_the_action_that_is_learnt_from_is_the_one_that_the_policy_gave() -> None:
    """It is a torque here, which the net's replaces on its way to the motor only."""
    action = torch.full((2, len(ROBOT.joint_names)), 3.0)
    shown = driven(ActuatorNet(PDNet(20)), EquivalentTarget(20.0, 0.5), action=action, steps=2)
    assert torch.equal(shown["action"], torch.full_like(shown["action"], 3.0))
    assert torch.equal(action, torch.full_like(action, 3.0))
