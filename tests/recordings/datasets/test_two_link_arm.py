"""The two-link arm as loaded, against the numbers of its data sheet and an integrator that is not MuJoCo."""

import gzip

import numpy as np
import pytest
from recordings.datasets.replay import open_loop, window_rmse

from torchrl_athletic.recordings.datasets import load_dataset
from torchrl_athletic.recordings.datasets.two_link_arm import EXCITATION
from torchrl_athletic.robots.benches import two_link_arm

PUBLISHED = two_link_arm(  # model_2.0; its friction is cf atan(100 v), which ends at cf pi / 2
    rotor_inertia=7.659297952841183e-05,
    damping=(0.001, 0.001),
    frictionloss=(0.093 * np.pi / 2, 0.078 * np.pi / 2),
)


@pytest.fixture(scope="module")
def arm(real_recordings):
    return load_dataset("two_link_arm")


def test_each_column_lands_in_its_channel_whatever_else_the_file_holds(tmp_path, monkeypatch):
    names = "time,pos_meas1,pos_meas2,vel_meas1,vel_meas2,pos_filt1,pos_filt2,tau_con1,tau_con2,tau_meas1,tau_meas2"
    rows = np.column_stack([np.arange(3) * 2e-3, *(np.full(3, float(k)) for k in range(1, 11))])
    folder = tmp_path / "two_link_arm"
    earlier = folder / "20220812" / "20220812-055032-PM_measured.csv.gz"
    for path in [folder / "20220815" / f"{name}.csv.gz" for name in EXCITATION] + [
        folder / "20220815" / "noise" / "velocity_measurement" / "trajectory.csv.gz"
    ]:
        write(path, names, rows)
    write(earlier, "time,pos1,pos2,vel1,vel2,tau1,tau2", rows[:, :7])
    monkeypatch.setattr("torchrl_athletic.recordings.datasets.two_link_arm.fetch", lambda name: tmp_path / name)
    dataset = load_dataset("two_link_arm")
    take = dataset.recordings[0]
    assert take.position[0].tolist() == [1.0, 2.0]
    assert take.velocity[0].tolist() == [3.0, 4.0]
    assert take.torque_command[0].tolist() == [7.0, 8.0]
    assert take.torque_measured[0].tolist() == [9.0, 10.0]
    earlier_take = dataset.extra[0]
    assert earlier_take.torque_command[0].tolist() == [5.0, 6.0]
    assert earlier_take.metadata["repeat"] == take.metadata["repeat"] == "00"


def test_fitting_and_held_out_takes_are_of_different_kinds(arm):
    kinds = [{take.metadata["excitation"] for take in split} for split in (arm.recordings, arm.heldout)]
    assert len(arm.recordings) == 6
    assert len(arm.heldout) == 3
    assert not kinds[0] & kinds[1]


@pytest.mark.parametrize(
    ("mjcf", "drive", "data_sheet"),
    [
        (PUBLISHED, "measured", (0.022, 0.061)),
        (PUBLISHED, "commanded", (0.039, 0.125)),
        (two_link_arm(), "measured", (0.082, 0.296)),
    ],
    ids=["published, measured torque", "published, commanded torque", "links alone, measured torque"],
)
def test_median_window_error_is_that_of_the_data_sheet(arm, mjcf, drive, data_sheet):
    takes = arm.recordings + arm.heldout
    driven = [take.driven_by_measured_torque() if drive == "measured" else take for take in takes]
    windows = np.concatenate([window_rmse(mjcf, take) for take in driven])
    np.testing.assert_allclose(np.median(windows, axis=0), data_sheet, rtol=0.2)


def test_mujoco_follows_the_published_equations_of_motion(arm):
    take = arm.heldout[0].driven_by_measured_torque().slice(0, 400)
    np.testing.assert_allclose(open_loop(PUBLISHED, take), equations_of_motion(take), atol=0.02)


def test_the_two_days_repeat_each_other(arm):
    """Same command three days apart: the arm itself differs by 0.02 and 0.05 rad, which no model can beat open loop."""
    earlier = next(take for take in arm.extra if take.metadata.get("repeat") == "00")
    later = next(take for take in arm.recordings if take.metadata.get("repeat") == "00")
    grid = np.arange(0.0, 9.9, 0.01)
    for joint, spread in enumerate((0.02, 0.05)):
        q = [np.interp(grid, take.time, take.position[:, joint]) for take in (earlier, later)]
        assert np.sqrt(np.mean((q[0] - q[1]) ** 2)) == pytest.approx(spread, rel=0.3)


def test_standstill_shows_one_encoder_step_and_no_torque(arm):
    still = arm.extra[-1]
    assert still.metadata["excitation"] == "standstill"
    assert not still.torque_command.any()
    assert np.ptp(still.position) < 1e-3


def write(path, header, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    with gzip.open(path, "wt") as file:
        np.savetxt(file, rows, delimiter=",", header=header, comments="")


def equations_of_motion(take) -> np.ndarray:
    """model_2.0 as printed by its authors, by the midpoint rule at 0.1 ms. Shape (T, 2)."""
    (m1, m2), (i1, i2), (r1, r2), l1 = (0.55938, 0.604346), (0.0534708, 0.0239237), (0.3, 0.183777), 0.3
    rotor, gear, b, cf, g = 7.6593e-5, 6.0, 0.001, np.array([0.093, 0.078]), 9.81

    def acceleration(q, v, torque):
        coupling = m2 * l1 * r2
        m12 = i2 + coupling * np.cos(q[1]) - gear * rotor
        m11 = i1 + i2 + m2 * l1**2 + 2 * coupling * np.cos(q[1]) + (gear**2 + 1) * rotor
        fall = m2 * g * r2 * np.sin(q[0] + q[1])
        h = coupling * np.sin(q[1])
        rest = np.array(
            [(m1 * r1 + m2 * l1) * g * np.sin(q[0]) + fall - h * v[1] * (2 * v[0] + v[1]), fall + h * v[0] ** 2]
        )
        friction = b * v + cf * np.arctan(100 * v)
        return np.linalg.solve([[m11, m12], [m12, i2 + gear**2 * rotor]], torque - rest - friction)

    q, v, path = take.position[0].copy(), take.velocity[0].copy(), []
    for sample, torque in enumerate(take.torque_command[:-1]):
        path.append(q)
        substeps = round((take.time[sample + 1] - take.time[sample]) / 1e-4)
        h = (take.time[sample + 1] - take.time[sample]) / substeps
        for _ in range(substeps):
            middle = v + h / 2 * acceleration(q, v, torque)
            v = v + h * acceleration(q + h / 2 * v, middle, torque)
            q = q + h * middle
    return np.array([*path, q])
