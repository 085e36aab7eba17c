import numpy as np
import pytest
from effects.arm import address, arm, record
from effects.slider import push, slider

from torchrl_athletic.diagnosis.replay import simulate, take_of, windows_of
from torchrl_athletic.effects import EncoderOffset, project_recording
from torchrl_athletic.recordings import Recording


@pytest.mark.parametrize("offset", [-0.2, 0.1])
def test_a_hanging_arm_comes_to_rest_at_the_offset(offset):
    time = np.arange(0.0, 15.0, 0.004)
    still = np.zeros((len(time), 2))
    recording = Recording(time, ("shoulder", "elbow"), still, torque_command=still)
    windows = windows_of(take_of(recording, arm(), np.zeros(2)), None)

    def build(plant, rows):
        EncoderOffset().apply(plant, 0, rows)

    true, shifted = simulate(windows, build, np.array([[0.0], [offset]]))[:, 0, -1]
    np.testing.assert_allclose(shifted - true, [offset, 0.0], atol=1e-3)


def test_a_servo_drives_the_reading_to_its_target():
    (position,) = push(np.full(4000, 0.05), (EncoderOffset(), [0.02]), servo=(60.0, 15.0))
    assert position[-1] == pytest.approx(0.05, abs=1e-4)
    (free,) = push(np.zeros(100), (EncoderOffset(), [0.02]))
    np.testing.assert_allclose(free, 0, atol=1e-12)  # the reading at the start is the recorded one


def test_the_fingerprint_is_the_slope_of_gravity_at_rest():
    time = np.arange(0.0, 3.0, 0.004)
    pose = np.tile([0.4, -0.9], (len(time), 1))
    recording = Recording(time, ("shoulder", "elbow"), pose, torque_command=0 * pose)
    s = project_recording(recording, arm(), np.zeros(2))
    column = EncoderOffset().fingerprint(s, 1, {}).columns[0, :, 0]
    angle, mass, lever = 0.4 - 0.9, 0.8, 0.15
    slope = mass * 9.81 * lever * np.cos(angle)  # of m g l sin(angle), which both joints carry
    np.testing.assert_allclose(column, [slope, slope], rtol=1e-5)


def test_without_a_slope_no_offset_shows():
    time = np.arange(0.0, 3.0, 0.004)
    recording = Recording(time, ("rail",), np.sin(time)[:, None], torque_command=np.zeros((len(time), 1)))
    s = project_recording(recording, slider(), np.zeros(1))
    np.testing.assert_allclose(EncoderOffset().fingerprint(s, 0, {}).columns, 0, atol=1e-9)


def test_the_sentence_carries_the_sign():
    parameters = EncoderOffset().parameters(arm(), address(), 0)
    assert "reads -50 mrad off" in EncoderOffset().sentence("shoulder", {"offset": -0.05}, parameters)
    assert "reads +50 mrad off" in EncoderOffset().sentence("shoulder", {"offset": 0.05}, parameters)


def test_the_simulated_reading_is_the_true_position_and_the_offset():
    given, shifted = record(seconds=2.0), record(EncoderOffset(), 1, [0.3], seconds=2.0)
    assert shifted.position[0] == pytest.approx(given.position[0])
    assert np.abs(shifted.position - given.position).max() > 0.05  # since gravity pulls from another angle
