"""Columns at the wrong joint: found where all of an exchange gain, and nowhere else."""

import numpy as np
import pytest

from torchrl_athletic.recordings.mixed_up import exchange_sentence, mixed_up


@pytest.mark.parametrize("order", [(1, 0, 2, 3), (1, 2, 0, 3), (1, 0, 3, 2), (3, 0, 1, 2)])
def test_finds_every_exchange(order):
    left = np.full((4, 4), 1.0)
    left[np.arange(4), order] = 0.1
    assert dict(mixed_up(left)) == {j: k for j, k in enumerate(order) if j != k}


def test_leaves_what_is_in_order():
    left = np.array([[0.1, 0.06], [0.06, 0.1]])
    assert not mixed_up(left)
    assert not mixed_up(np.eye(3) * 0.0 + 1.0)
    assert not mixed_up(np.zeros((2, 2)))
    assert not mixed_up(np.ones((1, 1)))


def test_no_joint_is_exchanged_that_does_not_gain():
    left = np.array([[1.0, 0.01], [0.9, 1.0]])  # the first follows the second's column by chance
    assert not mixed_up(left)


def test_the_sentence_says_which_follows_which():
    assert "elbow's follows the motion of hip" in exchange_sentence(("hip", "elbow"), "torque_command", [(0, 1)])
