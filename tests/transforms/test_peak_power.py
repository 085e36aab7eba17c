"""The most that joints gave at once, within an action too."""

import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.robots import z1
from torchrl_athletic.testing import ToyEnv, TransformContract
from torchrl_athletic.transforms import Decimation, PeakPower


class TestContract(TransformContract):
    env_settings = {"extra": {"joint_power": (3,)}}  # noqa: RUF012

    def make_transform(self, key=str, first_row=0):
        return PeakPower([0, 2], power_key=key("joint_power"), peak_key=key("peak_power"))


def test_it_is_the_greatest_sum_since_the_episode_s_start():
    env = TransformedEnv(ToyEnv(3, shortest=4, extra={"joint_power": (3,)}), PeakPower([0, 2]))
    steps = env.rollout(14, break_when_any_done=False)["next"]
    peak = torch.zeros(3, 1)
    for time in range(14):
        peak = torch.maximum(peak, steps["joint_power"][:, time, [0, 2]].sum(-1, keepdim=True))
        torch.testing.assert_close(steps["peak_power"][:, time], peak)
        peak = torch.where(steps["done"][:, time], 0.0, peak)


def test_what_a_joint_gives_back_feeds_another_and_a_brake_is_no_power():
    peak = PeakPower([0, 1])
    before = TensorDict(peak_power=torch.zeros(2, 1), batch_size=[2])
    after = TensorDict(joint_power=torch.tensor([[5.0, -3.0], [-5.0, 3.0]]), batch_size=[2])
    peak.advance(before, after)
    assert after["peak_power"].tolist() == [[2.0], [0.0]]


def test_an_episode_starts_with_no_power_however_little_its_joints_give():
    env = TransformedEnv(TorqueEnv(z1(), num_envs=2), PeakPower("arm"))
    assert env.reset()["peak_power"].tolist() == [[0.0], [0.0]]
    at_rest = env.step(env.reset().set("torque", torch.zeros(2, 7)))["next"]
    assert (at_rest["peak_power"] < 0.1).all()


def test_it_reads_every_step_of_the_physics_and_not_the_mean_of_an_action():
    torque = torch.tensor([[0.0, 30.0, 20.0, 0.0, 0.0, 0.0, 0.0]])
    act = lambda td: td.set("torque", torque)  # noqa: E731
    inside = TransformedEnv(TorqueEnv(z1()), Compose(PeakPower("arm"), Decimation(4)))
    alone = TransformedEnv(TorqueEnv(z1()), PeakPower("arm"))
    few, many = inside.rollout(8, act)["next"], alone.rollout(32, act)["next"]
    torch.testing.assert_close(few["peak_power"], many["peak_power"][:, 3::4])
    assert (few["peak_power"] > few["joint_power"][..., :6].sum(-1, keepdim=True).cummax(1).values + 1e-3).any()
