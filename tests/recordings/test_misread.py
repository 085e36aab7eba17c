"""Brief misreadings are told by their neighbours, and nothing else changes."""

from __future__ import annotations

import numpy as np

from torchrl_athletic.recordings import Recording
from torchrl_athletic.recordings.misread import bridged, brief

TIME = np.arange(400) / 100
MOTION = np.stack([np.sin(2 * np.pi * TIME), np.cos(np.pi * TIME)], -1)
SPEED = np.stack([2 * np.pi * np.cos(2 * np.pi * TIME), -np.pi * np.sin(np.pi * TIME)], -1)


def take(position: np.ndarray, velocity: np.ndarray | None = None) -> Recording:
    return Recording(TIME, ("a", "b"), position, velocity, torque_command=np.zeros_like(position))


def test_a_run_is_brief_by_the_good_readings_around_it_and_never_at_an_end():
    misread = np.zeros((400, 2), dtype=bool)
    misread[[0, 50, 399], 0] = misread[100:103, 1] = True
    assert np.argwhere(brief(TIME, misread, 0.02)).tolist() == [[50, 0]]
    assert np.argwhere(brief(TIME, misread, 0.04)).tolist() == [[50, 0], [100, 1], [101, 1], [102, 1]]
    late = TIME.copy()
    late[101:] += 1.0  # a pause inside
    assert np.argwhere(brief(late, misread, 0.04)).tolist() == [[50, 0]]


def test_stale_readings_go_where_the_motion_was_and_others_stay_to_the_bit():
    misread = np.zeros((400, 2), dtype=bool)
    misread[5:390:7, 0] = True
    stale, slow = MOTION.copy(), SPEED.copy()
    rows = misread[:, 0]
    stale[rows, 0], slow[rows, 0] = stale[np.flatnonzero(rows) - 1, 0], slow[np.flatnonzero(rows) - 1, 0]
    mended = bridged(take(stale, slow), misread, brief(TIME, misread, 0.02))
    assert np.abs(stale - MOTION).max() > 0.05
    np.testing.assert_allclose(mended.position, MOTION, atol=2e-5)
    np.testing.assert_allclose(mended.velocity, SPEED, atol=2e-4)
    np.testing.assert_array_equal(mended.position[~misread], stale[~misread])
    np.testing.assert_array_equal(stale[rows, 0], MOTION[np.flatnonzero(rows) - 1, 0])  # the log itself is untouched


def test_without_brief_ones_it_is_the_recording_itself():
    recording, misread = take(MOTION), np.zeros((400, 2), dtype=bool)
    misread[100:200, 0] = True
    assert bridged(recording, misread, brief(TIME, misread, 0.05)) is recording
