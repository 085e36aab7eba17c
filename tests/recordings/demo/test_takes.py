"""What the log holds is the motion, seen through the sensors that were asked for."""

from itertools import pairwise

import numpy as np
import pytest

from torchrl_athletic.recordings import check_quality
from torchrl_athletic.recordings.demo import Sensors, machine_with, make_recordings, pendulum, simulate, two_link_arm

PERFECT = Sensors(position_noise=0.0, velocity_noise=0.0)


def take(sensors, seed=0, duration=6.0, **options):
    [recording] = make_recordings(pendulum(), seed=seed, duration=duration, sensors=sensors, **options)
    return recording


def test_same_seed_same_data_other_seed_other_data():
    first, again, other = (take(Sensors(loop_jitter=1e-4), seed=seed, duration=2.0) for seed in (1, 1, 2))
    for name in ("time", "position", "velocity", "torque_command"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
        assert not np.array_equal(getattr(first, name), getattr(other, name))


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_noise_has_the_deviation_and_the_correlation_that_were_asked_for(correlation):
    noisy = take(Sensors(2e-3, 1e-2, correlation=correlation), duration=20.0)
    plain = take(PERFECT, duration=20.0)
    for channel, deviation in (("position", 2e-3), ("velocity", 1e-2)):
        noise = (getattr(noisy, channel) - getattr(plain, channel))[:, 0]
        assert noise.std() == pytest.approx(deviation, rel=0.1)
        for lag in (1, 2):
            assert np.corrcoef(noise[lag:], noise[:-lag])[0, 1] == pytest.approx(correlation**lag, abs=0.06)


def test_an_encoder_of_twelve_bits_reads_whole_counts():
    counts = take(Sensors(0.0, None, encoder_bits=12)).position / (2 * np.pi / 2**12)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.ptp(counts) > 100
    assert take(Sensors(0.0, None)).velocity is None


def test_a_jittering_loop_is_stamped_honestly_and_a_jittering_stamp_is_not():
    honest = take(Sensors(0.0, 0.0, loop_jitter=5e-4))
    position, _ = simulate(machine_with(pendulum()), honest.time, honest.torque_command)
    np.testing.assert_allclose(honest.position, position, atol=1e-9)
    assert np.diff(honest.time).std() == pytest.approx(np.sqrt(2) * 5e-4, rel=0.1)

    lying, plain = take(Sensors(0.0, 0.0, stamp_jitter=5e-4)), take(PERFECT)
    np.testing.assert_array_equal(lying.position, plain.position)
    assert (lying.time - plain.time).std() == pytest.approx(5e-4, rel=0.1)
    assert (np.diff(take(Sensors(loop_jitter=1.0, stamp_jitter=1.0)).time) > 0).all()


def test_drop_outs_lose_rows_of_the_log_but_not_of_the_motion():
    lossy, plain = take(Sensors(0.0, 0.0, dropouts=0.1)), take(PERFECT)
    assert 0.1 <= 1 - lossy.num_samples / plain.num_samples < 0.12
    rows = np.searchsorted(plain.time, lossy.time)
    np.testing.assert_array_equal(lossy.position, plain.position[rows])
    np.testing.assert_array_equal(lossy.torque_command, plain.torque_command[rows])
    with pytest.raises(ValueError, match=r"0 to 0.5; came 0.9"):
        take(Sensors(dropouts=0.9))


def test_targets_are_followed_and_come_with_the_gains_of_the_log():
    options = {"field": "position_target", "duration": 8.0, "sensors": PERFECT}
    [soft] = make_recordings(two_link_arm(), [], ["sine"], **options)
    [stiff] = make_recordings(two_link_arm(), [], ["sine"], kp=600.0, kd=[12.0, 10.0], **options)
    assert soft.torque_command is None
    assert soft.kp.tolist() == list(two_link_arm().kp)
    assert (stiff.kp.tolist(), stiff.kd.tolist()) == ([600.0, 600.0], [12.0, 10.0])
    np.testing.assert_array_equal(soft.position_target, stiff.position_target)
    error = [np.sqrt(np.square(r.position - r.position_target).mean(axis=0)) for r in (soft, stiff)]
    assert (error[1] < 0.5 * stiff.position_target.std(axis=0)).all()
    assert (error[1] < 0.5 * error[0]).all()


def test_takes_of_one_session_differ_and_pass_quality_control():
    takes = make_recordings(two_link_arm(), [], ["gaussian", "gaussian", "square", "chirp"], duration=4.0)
    assert [t.metadata["excitation"] for t in takes] == ["gaussian", "gaussian", "square", "chirp"]
    assert len({t.source for t in takes}) == 4
    assert not any(np.array_equal(a.torque_command, b.torque_command) for a, b in pairwise(takes))
    for recording in takes:
        assert recording.rate == pytest.approx(200.0)
        assert check_quality(recording, np.array(two_link_arm().torque_limit)).usable().all()
