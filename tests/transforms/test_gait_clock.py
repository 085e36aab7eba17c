import math

import pytest
import torch
from torchrl.envs import TransformedEnv

from torchrl_athletic.testing import ToyEnv, TransformContract
from torchrl_athletic.transforms import GaitClock


class TestContract(TransformContract):
    def make_transform(self, key=str, first_row=0):
        keys = {"phase_key": key("gait_phase"), "cycle_key": key("gait_cycle")}
        return GaitClock(0.02, cosine=True, random_start=True, first_row=first_row, **keys)


def rollout(steps: int, num_envs: int = 2, **settings):
    env = TransformedEnv(ToyEnv(num_envs, shortest=steps + 10), GaitClock(0.02, **settings))
    return env.rollout(steps)


def test_the_policy_sees_the_sine_of_the_time_since_the_episode_began():
    seen = rollout(1000)["gait_phase"]  # 20 s
    time = 0.02 * torch.arange(1000, dtype=torch.float64)
    torch.testing.assert_close(seen[0, :, 0].double(), torch.sin(2 * math.pi * 2.2 * time), atol=1e-3, rtol=0)


def test_an_episode_starts_the_clock_anew():
    steps = TransformedEnv(ToyEnv(3), GaitClock(0.02)).rollout(12, break_when_any_done=False)
    starts = torch.zeros_like(steps["done"])
    starts[:, 0] = True
    starts[:, 1:] = steps["next", "done"][:, :-1]
    assert starts.sum() > 6
    assert (steps["gait_phase"][starts] == 0).all()
    assert (steps["gait_phase"][~starts] != 0).all()


def test_cosine_and_sine_lie_on_a_circle_and_turn_forwards():
    seen = rollout(20, cosine=True)["gait_phase"]
    torch.testing.assert_close(seen.square().sum(-1), torch.ones(2, 20))
    sine, cosine = seen[..., 1:, :].unbind(-1)
    before_sine, before_cosine = seen[..., :-1, :].unbind(-1)
    assert (sine * before_cosine - cosine * before_sine > 0).all()


def test_random_starts_fill_the_cycle_evenly():
    cycle = rollout(1, num_envs=4000, random_start=True)["gait_cycle"][:, 0]
    assert cycle.mean().item() == pytest.approx(0.5, abs=0.02)
    assert cycle.var().item() == pytest.approx(1 / 12, rel=0.05)


def test_a_clock_too_fast_for_its_steps_is_refused():
    for dt, frequency in ((20.0, 2.2), (0.02, 25.0), (0.02, 40.0), (0.02, 0.0), (0.02, -1.0)):  # from half a cycle on
        with pytest.raises(ValueError, match="dt in seconds"):
            GaitClock(dt, frequency)
    assert GaitClock(0.02, 24.9).frequency == 24.9
