"""Chance in one transform tells nothing of chance in another."""

import torch
from torchrl.envs import Compose, TransformedEnv

from torchrl_athletic.testing import ToyEnv
from torchrl_athletic.transforms import EncoderOffset, GaitClock


def test_draws_of_two_kinds_of_transforms_with_one_seed_have_nothing_to_do_with_each_other():
    """Or robots whose encoders read too much would all begin late in their cycle."""
    chain = Compose(EncoderOffset(seed=5), GaitClock(0.02, random_start=True, seed=5))
    shown = TransformedEnv(ToyEnv(num_envs=2000), chain).reset()
    drawn = torch.cat((shown["encoder_offset"], shown["gait_cycle"]), -1)
    assert drawn.std(0).min() > 0
    assert torch.corrcoef(drawn.T)[:-1, -1].abs().max() < 0.1
