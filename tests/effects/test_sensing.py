import numpy as np
import pytest
from effects.arm import JOINTS, address, arm, record
from effects.explained import explained, projected
from effects.slider import MASS, STEP, push, slider, speed

from torchrl_athletic.diagnosis.replay import simulate, take_of, windows_of
from torchrl_athletic.effects import ActuationDelay, EncoderOffset, project_recording
from torchrl_athletic.effects.sensing import ClockOffset, EncoderScale
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


# --- scale ---


@pytest.mark.parametrize("scale", [0.8, 1.25])
def test_a_scaled_encoder_reads_the_motion_larger(scale):
    force = 3.0 * np.sin(np.arange(500) * 0.02)
    (position,) = push(force, (EncoderScale(), [scale]))
    np.testing.assert_allclose(np.diff(speed(position)) / STEP, scale * force[2:] / MASS, atol=1e-6)


def test_a_servo_with_a_scaled_encoder_drives_the_reading_to_its_target():
    (position,) = push(np.full(4000, 0.05), (EncoderScale(), [1.1]), servo=(60.0, 15.0))
    assert position[-1] == pytest.approx(0.05, abs=1e-4)


def test_the_fingerprint_of_a_scale_is_the_position_times_the_slope_of_gravity_at_rest():
    time = np.arange(0.0, 3.0, 0.004)
    pose = np.tile([0.4, -0.9], (len(time), 1))
    recording = Recording(time, JOINTS, pose, torque_command=0 * pose)
    s = project_recording(recording, arm(), np.zeros(2))
    np.testing.assert_allclose(
        EncoderScale().fingerprint(s, 1, {}).columns, -0.9 * EncoderOffset().fingerprint(s, 1, {}).columns, atol=1e-5
    )


@pytest.mark.parametrize(("joint", "scale"), [(0, 1.03), (1, 0.96)], ids=JOINTS)
def test_the_fingerprint_of_a_scale_is_what_the_simulation_misses(joint, scale):
    share, factor = explained(EncoderScale(), joint, (scale,), projected(EncoderScale(), joint, (scale,)))
    assert share > 0.97
    assert factor == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("scale", [0.7, 1.0, 1.4])
def test_the_scale_comes_back_from_its_coefficient(scale):
    (p,) = EncoderScale().parameters(arm(), address(), 0)
    assert EncoderScale().value(p, EncoderScale().change(p, scale)) == pytest.approx(scale)
    assert np.sign(EncoderScale().change(p, scale)) == np.sign(scale - 1)


@pytest.mark.parametrize(("scale", "words"), [(1.02, "2 % too much"), (0.95, "5 % too little")])
def test_a_scaled_encoder_is_told_as_too_much_or_too_little(scale, words):
    text = EncoderScale().sentence("elbow", {"scale": scale}, EncoderScale().parameters(arm(), address(), 1))
    assert f"The encoder of elbow reads {words}" in text


# --- clock ---

TIME = STEP * np.arange(800)
FORCE = 4.0 * np.sin(2 * np.pi * 3.0 * TIME) * (TIME > 0.1)


@pytest.mark.parametrize("steps", [1, 25])
def test_a_late_clock_shows_commands_late_and_an_early_one_early(steps):
    (now,) = push(FORCE)
    late, early = push(FORCE, (ClockOffset(), [[steps * STEP], [-steps * STEP]]))
    np.testing.assert_allclose(late[steps:], now[:-steps], atol=1e-12)
    np.testing.assert_allclose(early[:-steps], now[steps:], atol=1e-12)


@pytest.mark.parametrize("offset", [0.01, -0.01])
def test_the_fingerprint_of_a_clock_is_what_the_simulation_misses_on_all_joints(offset):
    s = projected(ClockOffset(), 0, (offset,))
    share, factor = explained(ClockOffset(), 0, (offset,), s)
    assert share > 0.98
    assert factor == pytest.approx(1, abs=0.06)
    shown = ClockOffset().fingerprint(s, 0, {"offset": offset}).constant
    assert (np.abs(shown).max(0) > 0.05).all()


def test_on_each_joint_a_late_clock_is_a_delay():
    s = project_recording(record(seconds=3.0), arm(), np.zeros(2))
    clock = ClockOffset().fingerprint(s, 0, {"offset": 0.02}).constant
    delays = [ActuationDelay().fingerprint(s, joint, {"delay": 0.02}).constant for joint in (0, 1)]
    np.testing.assert_allclose(clock, sum(delays), atol=1e-12)
    assert ClockOffset.identical_to == (frozenset({"actuation_delay"}),)
    assert ClockOffset.whole_robot


def test_offsets_of_both_signs_are_tried():
    s = project_recording(record(seconds=2.0), arm(), np.zeros(2))
    offsets = np.array([point["offset"] for point in ClockOffset().grid(s, 0)])
    np.testing.assert_allclose(np.sort(offsets), np.sort(-offsets))
    (p,) = ClockOffset().parameters(arm(), address(), 0)
    assert p.lower < offsets.min() < -0.029
    assert any(abs(offset) == pytest.approx(1 / 250.0) for offset in offsets)


@pytest.mark.parametrize(("offset", "words"), [(0.004, "4 ms late"), (-0.012, "12 ms early")])
def test_a_clock_is_told_as_late_or_early(offset, words):
    assert words in ClockOffset().sentence("", {"offset": offset}, ClockOffset().parameters(arm(), address(), 0))
