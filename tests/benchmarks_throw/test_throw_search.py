"""What the search on the arm moves, and how its throws count."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from benchmarks.throw_search import BEGIN, KNOTS, SWINGING, actions, along, distances, starts
from torchrl_athletic.envs.throw import DT, STEPS


def test_targets_move_in_straight_lines_from_the_set_up_on():
    knots = np.random.default_rng(0).normal(size=(2, len(KNOTS), len(SWINGING)))
    planned = actions(knots).double().numpy()
    assert planned.shape == (2, STEPS, 6)
    time = np.arange(STEPS) * DT
    assert not planned[:, time <= BEGIN].any()
    at = [int(np.argmin(np.abs(time - knot))) for knot in KNOTS]
    np.testing.assert_allclose(planned[:, at][:, :, list(SWINGING)], knots, atol=1e-6)
    assert not planned[:, :, [j for j in range(6) if j not in SWINGING]].any()


def test_what_is_planned_is_played_step_by_step_by_every_arm():
    planned = torch.arange(float(3 * 6)).reshape(1, 3, 6)
    act = along(planned)
    played = [act(TensorDict(batch_size=[2]))["action"] for _ in range(3)]
    np.testing.assert_array_equal(torch.stack(played, 1), planned.expand(2, -1, -1))


def test_throws_on_the_arm_count_as_throws_and_a_ball_that_is_lost_as_none():
    nothing = np.zeros((1, len(KNOTS), len(SWINGING)))
    lost = nothing + 4.0  # the bucket swings out of the arm's range
    far = distances(np.concatenate([nothing, lost]), starts(2))
    assert far[0] == pytest.approx(1.26, abs=0.05)  # the throw made by hand
    assert far[1] == 0.0
