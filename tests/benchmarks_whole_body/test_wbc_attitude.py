"""Errors are sorted by where the hand is to point."""

import pytest
import torch
from tensordict import TensorDict

from benchmarks.wbc_attitude import binned, elevation
from torchrl_athletic.functional import rotations


def test_a_hand_that_points_up_is_told_by_its_command():
    half = torch.tensor([0.0, -60.0, 30.0]).deg2rad() / 2  # turns about y, which lower the x axis where positive
    quaternion = torch.stack((half.cos(), torch.zeros(3), half.sin(), torch.zeros(3)), -1)
    command = torch.cat((torch.zeros(3, 3), rotations.two_columns(quaternion)), -1)
    assert elevation(command).tolist() == pytest.approx([0.0, 60.0, -30.0], abs=1e-3)


def test_what_does_not_count_is_in_no_bin():
    command = torch.zeros(1, 3, 9)
    command[0, :, 5] = torch.tensor([0.5, -0.5, 0.5])
    entries = {"attitude": torch.tensor([0.3, 0.1, 9.0]).reshape(1, 3, 1)}
    counts = torch.tensor([[[True], [True], [False]]])
    shown = TensorDict(end_effector_command=command, tracking=entries, counts=counts, batch_size=[1, 3])
    found = {words: (share, round(error, 3)) for words, share, error in binned(shown)}
    assert found == {"-90 to -20°": (0.5, 0.1), "20 to 90°": (0.5, 0.3), "all": (1.0, 0.2)}
