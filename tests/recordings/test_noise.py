"""Noise that was put in comes out, whatever the motion, the encoder and the clock."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from torchrl_athletic.recordings import Recording, RecordingError, noise_correlation, repeat_noise, sensor_noise
from torchrl_athletic.recordings.datasets import load_dataset
from torchrl_athletic.recordings.noise import encoder_step


def swing(time, position, velocity=None, **fields):
    zero = {"torque_command": np.zeros((len(time), 1))}
    velocity = None if velocity is None else velocity[:, None]
    return Recording(time, ("hinge",), position[:, None], velocity, **{**zero, **fields})


@pytest.mark.parametrize("jitter", [0.0, 0.3], ids=["even clock", "jittered clock"])
@pytest.mark.parametrize("sigma", [1e-4, 3e-3])
def test_white_noise_on_a_motion_is_measured(sigma, jitter):
    rng = np.random.default_rng(1)
    time = (np.arange(8000) + jitter * rng.uniform(-1, 1, 8000)) / 500
    position = 1.5 * np.sin(6 * time) + rng.normal(0, sigma, 8000)
    velocity = 9.0 * np.cos(6 * time) + rng.normal(0, 20 * sigma, 8000)
    position_noise, velocity_noise = sensor_noise(swing(time, position, velocity))
    assert position_noise == pytest.approx([sigma], rel=0.05)
    assert velocity_noise == pytest.approx([20 * sigma], rel=0.05)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("bits", [None, 16], ids=["continuous", "16 bits"])
@pytest.mark.parametrize("rho", [0.0, 0.3, 0.6, 0.85])
def test_the_memory_of_noise_is_measured_and_none_of_it_is_missed(rho, bits, seed):
    rng = np.random.default_rng(seed)
    time, sigma = np.arange(8000) / 200, 3e-4
    noise = lfilter([np.sqrt(1 - rho**2)], [1, -rho], rng.normal(0, sigma, 8000))
    position = 0.8 * np.sin(6 * time) + noise
    if bits is not None:
        position = np.round(position * 2**bits / (2 * np.pi)) * (2 * np.pi) / 2**bits
    take = swing(time, position)
    assert noise_correlation(take) == pytest.approx([rho], abs=0.12)
    if (
        rho < 0.8
    ):  # a longer memory is told from a random walk by less than these takes show; what passes a filter is not
        assert sensor_noise(take)[0] == pytest.approx([sigma], rel=0.3)


@pytest.mark.parametrize("frequency", [20.0, 35.0, 60.0])
def test_a_gear_that_rings_is_no_noise_with_a_memory(frequency):
    rng = np.random.default_rng(1)
    time = np.arange(8000) / 200
    ringing = 1e-3 * np.sin(2 * np.pi * frequency * time) + rng.normal(0, 1e-4, 8000)
    assert noise_correlation(swing(time, ringing)) == pytest.approx([0.0])


@pytest.mark.parametrize("frequency", [21.0, 25.0, 28.0])
def test_a_gear_that_rings_near_half_the_rate_is_not_mistaken_for_white_noise(frequency):
    rng = np.random.default_rng(1)
    time = np.arange(4000) / 60
    ringing = 2e-2 * np.sin(2 * np.pi * frequency * time) + rng.normal(0, 1e-4, 4000)
    assert sensor_noise(swing(time, ringing))[0] < 2e-3  # by fourth differences alone it is twenty times the noise


def test_a_take_too_short_to_tell_has_white_noise():
    time = np.arange(60) / 200
    assert noise_correlation(swing(time, np.random.default_rng(0).normal(size=60))) == pytest.approx([0.0])


@given(step=st.floats(1e-5, 1e-2), offset=st.floats(-3, 3), seed=st.integers(0, 99))
def test_the_encoder_step_is_the_common_spacing_of_the_values(step, offset, seed):
    counts = np.cumsum(np.random.default_rng(seed).integers(-3, 4, 2000))
    assert encoder_step(offset + step * counts) == pytest.approx(step, rel=1e-6)


def test_an_encoder_that_only_shows_multiples_of_two_and_three_steps_has_a_step_of_one():
    counts = np.concatenate(([0], np.cumsum(np.tile([2, 3], 300))))
    assert encoder_step(0.01 * counts) == pytest.approx(0.01)


def test_continuous_values_have_no_step():
    rng = np.random.default_rng(0)
    assert encoder_step(rng.normal(size=5000)) is None
    assert encoder_step(np.sin(np.linspace(0, 9, 5000))) is None
    assert encoder_step(np.sin(np.linspace(0, 9, 5000)).astype(np.float32).astype(np.float64)) is None
    assert encoder_step(np.full(5000, 0.3)) is None


@pytest.mark.parametrize("moving", [60, 5000])
@pytest.mark.parametrize("resting", [20, 3000])
def test_two_poses_in_which_a_joint_rests_are_no_step_of_its_encoder(moving, resting):
    """A Kinova's joint went 2.1 rad to and fro at 1 kHz: its noise was said to be 0.6 rad."""
    swing = 1.05 * (1 - np.cos(np.pi * np.linspace(0, 1, moving)))
    there = [np.zeros(resting), swing, np.full(resting, swing[-1]), swing[::-1], np.zeros(resting)]
    assert encoder_step(np.concatenate(there)) is None


def test_a_joint_at_rest_behind_an_encoder_is_as_uncertain_as_rounding():
    time = np.arange(2000) / 500
    step = 2 * np.pi / 4096
    rng = np.random.default_rng(0)
    resting = step * np.round(rng.normal(0, 0.15 * step, 2000) / step)  # 0 and now and then one count
    assert 0 < np.count_nonzero(resting) < 100
    assert sensor_noise(swing(time, resting))[0] == pytest.approx([step / np.sqrt(12)], rel=0.1)


def test_rounding_of_a_fast_joint_is_uniform_noise():
    time = np.arange(5000) / 500
    step = 2e-3
    moving = step * np.round(np.sin(5 * time) / step)
    assert sensor_noise(swing(time, moving))[0] == pytest.approx([step / np.sqrt(12)], rel=0.3)


def test_too_short_a_take_says_how_much_is_needed():
    with pytest.raises(RecordingError, match=r"8 samples hold 4 windows of 5 samples.*Record for longer"):
        sensor_noise(swing(np.arange(8) / 100, np.arange(8.0)))


def repeats(count, scatter, jitter=0.0, **fields):
    rng = np.random.default_rng(3)
    takes = []
    for i in range(count):
        time = np.arange(4000) / 200 + jitter * rng.uniform(-1, 1, 4000) / 200 + 10 * i
        phase = time - time[0]
        takes.append(
            swing(
                time,
                np.sin(phase) + rng.normal(0, scatter, 4000),
                torque_command=np.sin(2 * phase)[:, None],
                metadata={"repeat_id": i, **fields},
            )
        )
    return takes


@pytest.mark.parametrize("count", [2, 5])
def test_repeats_scatter_by_what_was_added(count):
    assert repeat_noise(repeats(count, 0.01)) == pytest.approx([0.01], rel=0.05)


def test_repeats_are_found_although_no_two_takes_are_stamped_alike():
    noise = repeat_noise(repeats(2, 0.01, jitter=0.3))
    assert noise is not None
    assert 0.007 < noise[0] < 0.0105  # reading between stamps averages a little of the noise away


def test_takes_that_are_no_repeats_are_not_compared():
    one, two = repeats(2, 0.01)
    assert repeat_noise([one]) is None
    assert repeat_noise([one, replace(two, metadata={})]) is None
    assert repeat_noise([one, replace(two, metadata={"repeat_id": 1, "payload": "1 kg"})]) is None
    assert repeat_noise([one, replace(two, torque_command=1.1 * two.torque_command)]) is None
    assert repeat_noise([one, two.slice(0, 2000)]) is None
    assert repeat_noise([one, replace(two, joint_names=("knee",))]) is None


@pytest.mark.usefixtures("real_recordings")
def test_the_arms_encoders_have_16_bits_over_four_turns_and_its_repeats_differ_by_far_more():
    data = load_dataset("two_link_arm")
    for take in data.recordings:
        # 16 bit over -12.5..12.5 rad, the position range of the CAN protocol of these drives
        assert [encoder_step(joint) for joint in take.position.T] == pytest.approx([25 / 65535] * 2, rel=1e-4)
        assert (sensor_noise(take)[0] < 2 * 25 / 65535).all()  # the shoulder wanders by more than a step
    scatter = repeat_noise([*data.recordings, *data.extra])
    assert scatter == pytest.approx([0.011, 0.029], rel=0.1)  # 10 s open loop


@pytest.mark.usefixtures("real_recordings")
@pytest.mark.parametrize(
    ("name", "step"),
    [
        ("unbalanced_disk", 2 * np.pi / 2000),
        ("xl330", 2 * np.pi / 4096),  # interpolated to 200 Hz by its authors: found where the reading rests
        ("pendulum", 191 / 65535),  # 16 bit over -95.5..95.5 rad, the range of this drive's firmware
    ],
)
def test_the_known_encoder_steps_are_found(name, step):
    takes = load_dataset(name).recordings
    found = [encoder_step(take.position[:, 0]) for take in takes]
    assert sum(value == pytest.approx(step, rel=1e-3) for value in found) >= 0.6 * len(takes), found
