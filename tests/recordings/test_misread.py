"""Brief misreadings are told by their neighbours, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from torchrl_athletic.recordings import Recording, check_quality
from torchrl_athletic.recordings.misread import _no_noisier, bridged, brief, mended

TIME = np.arange(400) / 100
MOTION = np.stack([np.sin(2 * np.pi * TIME), np.cos(np.pi * TIME)], -1)
SPEED = np.stack([2 * np.pi * np.cos(2 * np.pi * TIME), -np.pi * np.sin(np.pi * TIME)], -1)


def take(position: np.ndarray, velocity: np.ndarray | None = None, time: np.ndarray = TIME) -> Recording:
    return Recording(time, ("a", "b"), position, velocity, torque_command=np.zeros_like(position))


def test_a_run_is_brief_by_the_good_readings_around_it_and_only_between_two_on_each_side():
    misread = np.zeros((400, 2), dtype=bool)
    misread[[0, 2, 50, 397, 399], 0] = misread[100:103, 1] = True
    assert np.argwhere(brief(TIME, misread, 0.02)).tolist() == [[50, 0]]
    assert np.argwhere(brief(TIME, misread, 0.04)).tolist() == [[50, 0], [100, 1], [101, 1], [102, 1]]
    late = TIME.copy()
    late[101:] += 0.06  # a gap inside, and next to nothing beyond it
    assert np.argwhere(brief(late, misread, 0.2)).tolist() == [[50, 0]]


def test_stale_readings_go_where_the_motion_was_and_others_stay_to_the_bit():
    misread = np.zeros((400, 2), dtype=bool)
    misread[5:390:7, 0] = True
    stale, slow = MOTION.copy(), SPEED.copy()
    rows = misread[:, 0]
    stale[rows, 0], slow[rows, 0] = stale[np.flatnonzero(rows) - 1, 0], slow[np.flatnonzero(rows) - 1, 0]
    done = bridged(take(stale, slow), misread, brief(TIME, misread, 0.02))
    assert np.abs(stale - MOTION).max() > 0.05
    np.testing.assert_allclose(done.position, MOTION, atol=2e-5)
    np.testing.assert_allclose(done.velocity, SPEED, atol=2e-4)
    np.testing.assert_array_equal(done.position[~misread], stale[~misread])
    np.testing.assert_array_equal(stale[rows, 0], MOTION[np.flatnonzero(rows) - 1, 0])  # the log itself is untouched


def test_a_bridge_beside_a_gap_does_not_look_across_it():
    position = MOTION.copy()
    position[200:] += 0.5  # moved while nothing was logged
    time = np.where(np.arange(400) < 200, TIME, TIME + 0.07)
    misread = np.zeros((400, 2), dtype=bool)
    misread[197, 0] = True
    truth, position[197, 0] = position[197, 0], 9.0
    done = bridged(take(position, time=time), misread, brief(time, misread, 0.02))
    assert done.position[197, 0] == pytest.approx(truth, abs=1e-4)


def test_without_brief_ones_it_is_the_recording_itself():
    recording, misread = take(MOTION), np.zeros((400, 2), dtype=bool)
    misread[100:200, 0] = True
    assert bridged(recording, misread, brief(TIME, misread, 0.05)) is recording
    quality = check_quality(recording)
    assert mended(recording, quality, 0.02) == (recording, quality)


def test_a_log_is_looked_at_again_once_what_hid_the_others_is_mended():
    rng = np.random.default_rng(0)
    time, noise = np.arange(20000) / 1000, 1e-4
    truth = np.stack([np.sin(2 * np.pi * time), np.cos(np.pi * time)], -1)
    position = truth + rng.normal(0, noise, truth.shape)
    stale = np.flatnonzero(rng.random(20000) < 0.05)[1:]
    for k in stale:
        position[k, 0] = position[k - 1, 0]
    log = take(position, time=time)
    raw = check_quality(log)
    done, quality = mended(log, raw, 0.02)
    assert raw.position_noise[0] > 3 * noise
    assert quality.position_noise[0] == pytest.approx(noise, rel=0.3)
    assert quality.bridged[0] > 1.2 * raw.masks["frozen"][:, 0].sum()
    assert quality.bridged[1] == 0
    assert np.std(done.position[:, 0] - truth[:, 0]) < 0.5 * np.std(position[:, 0] - truth[:, 0])
    assert not quality.masks["frozen"].any()
    assert quality.warnings == raw.warnings
    assert quality.report()["bridged"] == {"a": quality.bridged[0], "b": 0}
    assert quality.report()["masked"]["frozen"] == 0


def test_a_mended_log_is_no_noisier_and_keeps_its_encoder():
    """Two poses in which a joint rests between bridges are no encoder of half a radian."""
    quality = check_quality(take(MOTION))
    found = replace(
        quality, encoder_step=(1.0, None), position_noise=np.array([0.3, 1e-9]), noise_correlation=np.ones(2)
    )
    told = _no_noisier(found, quality)
    assert told.encoder_step == quality.encoder_step
    assert told.position_noise.tolist() == [quality.position_noise[0], 1e-9]
    assert told.noise_correlation.tolist() == [quality.noise_correlation[0], 1.0]
