"""EMPS as loaded: what the file says arrives in newtons and metres, and the published model follows it."""

import mujoco
import numpy as np
import pytest
from recordings.datasets.replay import open_loop, rmse
from scipy.io import savemat

from torchrl_athletic.recordings.datasets import load_dataset
from torchrl_athletic.robots.benches import slider


@pytest.fixture(scope="module")
def emps(real_recordings):
    return load_dataset("emps")


def test_force_is_the_voltage_times_the_drive_gain(tmp_path, monkeypatch):
    time = np.arange(5)[:, None] * 1e-3
    for name in ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"):
        (tmp_path / "emps").mkdir(exist_ok=True)
        savemat(
            tmp_path / "emps" / name, {"t": time, "qm": 2.0 * time, "vir": 1.0 + time, "gtau": 35.0, "pulses_N": 5.0}
        )
    monkeypatch.setattr("torchrl_athletic.recordings.datasets.emps.fetch", lambda name: tmp_path / name)
    dataset = load_dataset("emps")
    (take,) = dataset.recordings
    assert take.joint_names == ("carriage",)
    np.testing.assert_allclose(take.torque_command, 35.0 * (1.0 + time))
    np.testing.assert_allclose(take.position, 2.0 * time)
    assert take.velocity is None
    np.testing.assert_allclose(dataset.heldout[0].torque_command, take.torque_command)  # the pulses are in the voltage


@pytest.mark.parametrize(("split", "published"), [("recordings", 6.75e-3), ("heldout", 9.22e-3)])
def test_published_model_drifts_as_an_ideal_coulomb_carriage_does(emps, split, published):
    (take,) = getattr(emps, split)
    assert rmse(emps.model, take, velocity=0.0) == pytest.approx(published, abs=1e-4)  # m, over 24.8 s
    np.testing.assert_allclose(open_loop(emps.model, take, velocity=0.0), coulomb_carriage(take), atol=3e-4)


def test_without_the_offset_the_carriage_runs_away(emps):
    """The offset is part of the published model: nothing else holds the carriage on its rail for 25 s."""
    assert rmse(slider(offset=0.0), emps.recordings[0], velocity=0.0) > 0.15


def test_offset_leans_the_rail_the_right_way(emps):
    data = mujoco.MjData(mujoco.MjModel.from_xml_string(emps.model))
    model = mujoco.MjModel.from_xml_string(emps.model)
    mujoco.mj_forward(model, data)
    assert data.qfrc_bias[0] == pytest.approx(-3.1648)  # of M a + Fv v + Fc sign(v) + offset = force


def coulomb_carriage(take, mass=95.1089, damping=203.5034, coulomb=20.3935, offset=-3.1648, substeps=10) -> np.ndarray:
    """M a + Fv v + Fc sign(v) + offset = force by trapezoids, sticking exactly. Shape (T, 1)."""
    h = 1e-3 / substeps
    q, v, path = float(take.position[0, 0]), 0.0, []
    for force in take.torque_command[:, 0].tolist():
        path.append(q)
        for _ in range(substeps):
            push = mass * v + h * (force - offset)
            after = max(abs(push) - h * coulomb, 0.0) / (mass + h * damping) * (1.0 if push > 0 else -1.0)
            q, v = q + h * (v + after) / 2, after
    return np.array(path)[:, None]
