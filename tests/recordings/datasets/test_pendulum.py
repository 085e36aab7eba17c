"""The simple pendulum as loaded: which torque drives it, and that friction is what its geometry lacks."""

import numpy as np
import pytest
from recordings.datasets.replay import window_rmse

from torchrl_athletic.recordings.datasets import load_dataset
from torchrl_athletic.robots.benches import pendulum


@pytest.fixture(scope="module")
def dataset(real_recordings):
    return load_dataset("pendulum")


def test_measured_torque_drives_where_the_drive_closed_the_loop_and_the_command_where_it_did_not(tmp_path, monkeypatch):
    for run in ("ddp", "direct_collocation", "ilqr", "pd_identification"):
        folder = tmp_path / "pendulum" / run
        folder.mkdir(parents=True)
        for file, torque in (("data_measured.csv", 4.0), ("data_desired.csv", 7.0)):
            rows = [[0.0, 1.0, 2.0, torque], [0.01, 1.0, 2.0, torque]]
            np.savetxt(folder / file, rows, delimiter=",", header="time,position,velocity,torque", comments="")
    monkeypatch.setattr("torchrl_athletic.recordings.datasets.pendulum.fetch", lambda name: tmp_path / name)
    dataset = load_dataset("pendulum")
    (ddp,), ilqr = dataset.recordings, dataset.extra[0]
    assert (ddp.position[0, 0], ddp.velocity[0, 0], ddp.torque_command[0, 0]) == (1.0, 2.0, 4.0)
    assert ddp.torque_measured is None
    assert (ilqr.torque_command[0, 0], ilqr.torque_measured[0, 0]) == (7.0, 4.0)


def test_published_coulomb_friction_halves_the_error_of_every_controller(dataset):
    for take in (*dataset.recordings, *dataset.heldout, dataset.extra[0]):
        bare = np.median(window_rmse(dataset.model, take))
        rough = np.median(window_rmse(pendulum(frictionloss=0.1839), take))
        assert rough < 0.5 * bare


def test_fitting_and_held_out_run_swing_up_under_different_controllers(dataset):
    for take in (*dataset.recordings, *dataset.heldout):
        assert np.abs(take.position).max() == pytest.approx(np.pi, abs=0.05)  # rad, from hanging to upright
        assert abs(take.position[0, 0]) < 0.01
    assert dataset.recordings[0].metadata["excitation"] != dataset.heldout[0].metadata["excitation"]
