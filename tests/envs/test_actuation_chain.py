"""The chain in its order, against the same written as a loop."""

from dataclasses import replace

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv

from torchrl_athletic.envs import TorqueEnv, actuation_chain, whole_body_env
from torchrl_athletic.envs.actuation_chain import shipped_net
from torchrl_athletic.functional import actuation
from torchrl_athletic.networks import digest_of, pretrained, uan
from torchrl_athletic.robots import b2z1, z1
from torchrl_athletic.transforms import ActionDelay

ARM = z1()


def column(values):
    return torch.tensor(values, dtype=torch.float32)


def test_the_chain_is_a_pd_law_two_clips_and_a_net_at_every_physics_step():
    torch.manual_seed(0)
    net = uan()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.normal_(std=0.3)  # a new one corrects nothing
    env = TransformedEnv(TorqueEnv(ARM, num_envs=2), Compose(*actuation_chain(ARM, net=net, arm_power=2.0)))
    plain = TorqueEnv(ARM, num_envs=2)
    shown, seen = env.reset(), plain.reset()
    errors = torch.zeros(2, 6, 2, 20)
    power_met = net_matters = False
    for k in range(5):
        target = column(ARM.default_pose) + 0.4 * torch.sin(torch.tensor(float(k))) * torch.ones(2, 7)
        shown = env.step(shown.set("action", target))["next"]
        for _ in range(4):
            position, velocity = seen["joint_position"], seen["joint_velocity"]
            torque = actuation.pd_torque(target, position, velocity, column(ARM.kp), column(ARM.kd))
            new = torch.stack((target - position, -velocity), -1)[:, :6]
            errors = torch.cat((errors[..., 1:], new.unsqueeze(-1)), -1)
            torque = actuation.clip_torque_speed(torque, velocity, column(ARM.torque_limit), column(ARM.velocity_limit))
            power = (torque[:, :6] * velocity[:, :6]).abs().sum(-1, keepdim=True)
            power_met |= bool((power > 2.0).any())
            torque[:, :6] *= torch.clamp(2.0 / power.clamp(min=1e-9), max=1.0)
            with torch.no_grad():
                correction = net(errors.flatten(-2)).squeeze(-1)
            net_matters |= bool((correction.abs() > 0.1).any())
            torque[:, :6] += correction  # at the joint, past the motor's limits
            seen = plain.step(seen.set("torque", torque))["next"]
    torch.testing.assert_close(shown["joint_position"], seen["joint_position"], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(shown["applied_torque"], seen["applied_torque"], atol=1e-3, rtol=1e-4)
    assert power_met
    assert net_matters


def test_delays_lie_between_the_two_that_are_asked_for():
    chain = actuation_chain(ARM, max_delay=6, min_delay=4)
    delays = TransformedEnv(TorqueEnv(ARM, num_envs=64), Compose(*chain)).reset()["action_delay"]
    assert set(delays.flatten().tolist()) == {4, 5, 6}


def test_delays_are_those_of_the_seed_and_of_the_row_and_hold_the_default_pose_at_first():
    told = {"max_delay": 60, "min_delay": 20, "decimation": 7}
    delay, decimation = actuation_chain(ARM, seed=5, first_row=3, **told)[-2:]
    assert (delay.seed, delay.first_row, decimation.steps) == (5, 3, 7)
    torch.testing.assert_close(delay.before, column(ARM.default_pose))


def test_what_is_not_asked_for_is_not_there():
    names = [type(transform).__name__ for transform in actuation_chain(ARM)]
    assert names == ["TorqueSpeedClip", "PDControl", "Decimation"]


def test_a_delay_is_part_of_the_chain_wherever_one_can_be_drawn():
    delays = [[p for p in actuation_chain(ARM, max_delay=most) if isinstance(p, ActionDelay)] for most in (0, 3)]
    assert delays[0] == []
    assert [(p.min_steps, p.max_steps) for p in delays[1]] == [(0, 3)]


def test_the_shipped_net_is_for_its_own_arm():
    """An arm of one's own may have as many joints, and even joints of the same names."""
    for robot in (ARM, b2z1()):
        assert digest_of(shipped_net("uan", robot)) == digest_of(pretrained("uan"))
    others = {
        r"has my_joint1 \(kp 64": replace(ARM, joint_names=tuple(f"my_{name}" for name in ARM.joint_names)),
        r"has joint1 \(kp 128": replace(ARM, kp=tuple(2 * kp for kp in ARM.kp)),
        "has no joints": replace(ARM, joint_groups={}),
    }
    for told, robot in others.items():
        with pytest.raises(ValueError, match=f"{told}.*net=None or --actuation ideal"):
            shipped_net("uan", robot)


def test_an_environment_of_another_arm_does_not_take_the_shipped_net_in_silence():
    robot = b2z1()
    with pytest.raises(ValueError, match="would push another arm"):
        whole_body_env(replace(robot, kd=tuple(2 * kd for kd in robot.kd)), num_envs=1)
