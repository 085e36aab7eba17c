"""The XL330 bench as loaded: the firmware's gains, the free swings, and the error that its authors' model leaves."""

import gzip
import json

import numpy as np
import pytest
from recordings.datasets.replay import open_loop

from torchrl_athletic.recordings.datasets import load_dataset

KT, RESISTANCE = 0.3866957639281311, 4.017129222290597


@pytest.fixture(scope="module")
def xl330(real_recordings):
    return load_dataset("xl330")


def test_firmware_gain_becomes_newton_metres_and_a_cut_motor_a_take_of_its_own(tmp_path, monkeypatch):
    entry = {"position": 0.1, "speed": 0.2, "goal_position": 0.3, "input_volts": 7.0, "torque_enable": True}
    entries = [{**entry, "timestamp": 0.005 * k, "torque_enable": k < 4} for k in range(9)]
    (tmp_path / "xl330_bench").mkdir()
    for kp in (100, 400):
        log = {"mass": 0.49, "length": 0.1, "kp": kp, "vin": 7.4, "trajectory": "lift_and_drop", "entries": entries}
        with gzip.open(tmp_path / "xl330_bench" / f"{kp}.json.gz", "wt") as file:
            json.dump(log, file)
    monkeypatch.setattr("torchrl_athletic.recordings.datasets.xl330.fetch", lambda name: tmp_path / name)
    dataset = load_dataset("xl330")
    driven, swing = dataset.recordings
    assert (driven.num_samples, swing.num_samples) == (4, 5)
    # 4096 counts a turn, divisor 256, 885 for full duty: one radian at gain 100 is 28.8 % of 7.4 V
    assert driven.kp.item() == pytest.approx(0.28774 * 7.4 * KT / RESISTANCE, rel=1e-4)
    assert driven.kd.item() == pytest.approx(KT**2 / RESISTANCE)
    assert driven.position_target[0, 0] == 0.3
    assert swing.position_target is None
    assert not swing.torque_command.any()
    assert [take.metadata["firmware_kp"] for take in dataset.heldout] == [400, 400]


def test_twelve_takes_and_three_free_swings_to_fit_four_and_one_kept_aside(xl330):
    assert len(xl330.recordings) == 15
    assert len(xl330.heldout) == 5
    assert {take.metadata["firmware_kp"] for take in xl330.recordings} == {100, 200, 800}


def test_published_m1_leaves_the_error_of_the_data_sheet(xl330):
    """0.0819 rad by the authors' integrator, whose step damps; 0.0861 rad by MuJoCo's, which does not."""
    errors, end = [], {}
    for take in xl330.recordings + xl330.heldout:
        swinging = take.source in end  # the free swing goes on from where the simulated lift ended
        start = end[take.source] if swinging else (take.position[0], take.velocity[0])
        path = open_loop(xl330.model, take, *start)
        end[take.source] = (path[-1], (path[-1] - path[-2]) / 0.005)
        errors.append(np.abs(path - take.position))
    assert np.concatenate(errors).mean() == pytest.approx(0.0819, rel=0.08)


def test_published_m1_by_the_authors_own_step_reproduces_their_error(xl330):
    """Through the step of bam/simulate.py: gains, offset and masses arrive as the authors mean them."""
    errors, end = [], {}
    for take in xl330.recordings + xl330.heldout:
        q, v = end.get(take.source, (take.position[0, 0], take.velocity[0, 0]))
        path, end[take.source] = bam_step(take, q, v)
        errors.append(np.abs(path - take.position[:, 0]))
    assert np.concatenate(errors).mean() == pytest.approx(0.0819, abs=2e-4)


def bam_step(take, q, v, dt=0.005):
    """Positions under m1 by BAM's integrator, and the state after the last sample."""
    inertia, path = 0.49 * 0.1**2 + 0.0018141672784458866, []
    for sample in range(take.num_samples):
        path.append(q)
        motor = 0.0
        if take.position_target is not None:
            push = take.kp[0] * (take.position_target[sample, 0] - q)
            motor = np.clip(push, -KT / RESISTANCE * 7.4, KT / RESISTANCE * 7.4) - take.kd[0] * v
        torque = motor - 0.49 * 9.80665 * 0.1 * np.sin(q + 0.030871000250528358)
        stop = inertia / dt * v + torque
        torque -= np.sign(stop) * min(abs(stop), 0.01283272036582759 + 0.003661672282824312 * abs(v))
        v += torque / inertia * dt
        q += v * dt + torque / inertia * dt**2 / 2
    return np.array(path), (q, v)
