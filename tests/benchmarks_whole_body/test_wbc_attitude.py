"""Errors are sorted by where the hand is to point."""

import math

import pytest
import torch
from tensordict import TensorDict

from benchmarks.wbc_attitude import binned, elevation, tilt
from torchrl_athletic.functional import rotations

X = (1.0, 0.0, 0.0)


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
    base = torch.stack([turn(0.1, X), turn(-0.2, X), turn(3.0, X)]).unsqueeze(0)
    shown = TensorDict(
        end_effector_command=command, tracking=entries, counts=counts, base_quaternion=base, batch_size=[1, 3]
    )
    found = {words: tuple(round(x, 3) for x in figures) for words, *figures in binned(shown)}
    assert found == {"-90 to -20°": (0.5, 0.1, 0.2), "20 to 90°": (0.5, 0.3, 0.1), "all": (1.0, 0.2, 0.15)}


def test_a_base_that_turns_about_the_vertical_does_not_tilt():
    heading = turn(2.0, (0.0, 0.0, 1.0))
    assert float(tilt(heading)) == pytest.approx(0.0, abs=1e-3)
    assert float(tilt(rotations.multiply(heading, turn(0.3, X)))) == pytest.approx(0.3, abs=1e-4)


def turn(angle, axis):
    return torch.tensor([math.cos(angle / 2), *(math.sin(angle / 2) * x for x in axis)])
