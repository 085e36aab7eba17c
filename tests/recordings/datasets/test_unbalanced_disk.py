"""The unbalanced disk as loaded: torque from volts, the split, and the data sheet's free-run errors."""

from dataclasses import replace

import numpy as np
import pytest
from recordings.datasets.replay import rmse

from torchrl_athletic.recordings.datasets import load_dataset
from torchrl_athletic.robots.benches import DISK_INERTIA, unbalanced_disk


@pytest.fixture(scope="module")
def disk(real_recordings):
    return load_dataset("unbalanced_disk")


def test_volts_become_torque_and_the_split_is_one_instant(tmp_path, monkeypatch):
    (tmp_path / "unbalanced_disk").mkdir()
    voltage, angle = np.linspace(-3, 3, 4100), np.linspace(0, 1, 4100)
    np.savez(tmp_path / "unbalanced_disk" / "training-val-test-data.npz", u=voltage, th=angle)
    monkeypatch.setattr("torchrl_athletic.recordings.datasets.unbalanced_disk.fetch", lambda name: tmp_path / name)
    dataset = load_dataset("unbalanced_disk")
    (fit,), (rest,) = dataset.recordings, dataset.heldout
    assert (fit.num_samples, rest.num_samples) == (4000, 100)
    assert rest.time[0] - fit.time[-1] == pytest.approx(0.025)
    np.testing.assert_allclose(fit.torque_command[:, 0], 28.136158 * 2.4421e-4 * voltage[:4000])
    np.testing.assert_allclose(rest.position[:, 0], angle[4000:])


def test_source_parameters_free_run_error_is_that_of_the_data_sheet(disk):
    assert rmse(disk.model, disk.recordings[0]) == pytest.approx(0.1113, rel=0.02)
    assert rmse(disk.model, disk.heldout[0].slice(0, 4000)) == pytest.approx(0.1113, rel=0.02)


def test_a_delay_of_one_sample_and_a_shifted_zero_explain_nearly_everything(disk):
    """The refit of the data sheet, simulated: 0.0230 rad over the samples that it never saw."""
    refit = unbalanced_disk(
        gravity_torque=11.65**2 * DISK_INERTIA, damping=1.071 * DISK_INERTIA, frictionloss=6.52 * DISK_INERTIA
    )
    take = disk.heldout[0].slice(0, 4000)
    late = np.concatenate((take.torque_command[:1], take.torque_command[:-1])) * 28.42 / 28.136158
    shifted = {
        offset: replace(take, torque_command=late, position=take.position + offset) for offset in (-0.0333, 0.0333)
    }
    assert rmse(refit, shifted[-0.0333]) < 0.03
    assert rmse(refit, shifted[0.0333]) > 0.06
