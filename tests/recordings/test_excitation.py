"""The signals are what they claim to be, and never more than was allowed."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_athletic.recordings import (
    ExcitationError,
    Safety,
    amplitude_frequency_pairs,
    chirp,
    gaussian,
    multisine,
    sine,
    square,
)

JOINTS = ("hip", "thigh", "knee")
EVERY_KIND = {
    "square": lambda **k: square(JOINTS, "thigh", amplitude_frequency_pairs(3.0), **k),
    "sine": lambda **k: sine(JOINTS, "thigh", amplitude_frequency_pairs(3.0), **k),
    "gaussian": lambda **k: gaussian(JOINTS, [1.0, 2.0, 3.0], seed=4, seconds=20.0, **k),
    "chirp": lambda **k: chirp(JOINTS, "thigh", 3.0, seconds=20.0, **k),
    "multisine": lambda **k: multisine(JOINTS, None, 3.0, **k),
}


@pytest.fixture(params=EVERY_KIND)
def make(request):
    return EVERY_KIND[request.param]


def test_a_square_and_a_sine_sweep_of_twelve_pairs_take_about_fifty_seconds_a_joint():
    pairs = amplitude_frequency_pairs(5.0)
    assert len(set(pairs)) == 12
    assert len(square(JOINTS, "hip", pairs).time) + len(sine(JOINTS, "hip", pairs).time) == 48 * 200


@pytest.mark.parametrize("wave", [square, sine])
def test_each_pair_has_its_amplitude_and_frequency_and_the_other_joints_rest(wave):
    pairs = amplitude_frequency_pairs(3.0)
    made = wave(JOINTS, "thigh", pairs)
    assert not made.command[:, [0, 2]].any()
    segments = made.command[:, 1].reshape(12, -1)
    for segment, (amplitude, frequency), noted in zip(segments, pairs, made.metadata["segments"], strict=True):
        assert np.abs(segment).max() == pytest.approx(amplitude, rel=0.003)  # 50 samples a period
        assert segment.mean() == pytest.approx(0, abs=1e-9)
        assert np.argmax(np.abs(np.fft.rfft(segment))) / 2.0 == frequency  # 2 s: bins of 0.5 Hz
        assert (noted["amplitude"], noted["frequency"]) == (amplitude, frequency)
        power = 1.0 if wave is square else 0.5
        assert np.mean(segment**2) == pytest.approx(power * amplitude**2)
    assert (segments[:, 1] > 0).all()  # both begin upwards


@given(frequency=st.integers(1, 8), rate=st.sampled_from([100.0, 200.0, 500.0, 1000.0]))
def test_rounding_of_the_stamps_moves_no_edge_of_a_square_wave(frequency, rate):
    if (rate / frequency) % 2 == 0:  # half a period is a whole number of samples
        wave = square(("hinge",), "hinge", [(1.0, float(frequency))], rate=rate, seconds=3.0).command[:, 0]
        edges = np.flatnonzero(np.diff(wave)) + 1
        assert set(np.diff(edges)) == {rate / frequency / 2}


def test_gaussian_torques_are_held_for_5_to_400_ms_on_all_joints_at_once():
    made = gaussian(JOINTS, [1.0, 2.0, 4.0], seed=0)
    assert made.time[-1] == pytest.approx(300 - 0.005)
    changes = np.flatnonzero(np.diff(made.command, axis=0).all(axis=1))
    assert len(changes) == len(np.flatnonzero(np.diff(made.command, axis=0).any(axis=1)))
    holds = np.diff(changes) * 0.005
    assert (holds.min(), holds.max()) == pytest.approx((0.005, 0.4))
    assert holds.mean() == pytest.approx(0.2025, rel=0.05)
    draws = made.command[changes]
    assert draws.std(axis=0) == pytest.approx([1.0, 2.0, 4.0], rel=0.06)
    assert np.corrcoef(draws.T)[np.triu_indices(3, 1)] == pytest.approx([0, 0, 0], abs=0.1)


def test_a_seed_is_a_signal():
    first, again, other = (gaussian(JOINTS, 1.0, seed=seed, seconds=5.0).command for seed in (0, 0, 1))
    assert (first == again).all()
    assert (first != other).any()


@pytest.mark.parametrize(
    ("method", "cycles"),
    [
        ("linear", lambda t: t + 15 / 32 * t**2 / 2),  # integral of 1 + 15 t / 32
        ("logarithmic", lambda t: (16 ** (t / 32) - 1) * 32 / np.log(16)),  # integral of 16^(t / 32)
    ],
)
def test_a_chirp_counts_the_cycles_of_its_frequency_law(method, cycles):
    made = chirp(JOINTS, "knee", 2.0, (1.0, 16.0), seconds=32.0, rate=1000.0, method=method)
    wave = made.command[:, 2]
    upward = made.time[1:][(wave[:-1] < 0) & (wave[1:] >= 0)]
    assert cycles(upward) == pytest.approx(np.arange(1, len(upward) + 1), abs=0.02)
    assert len(upward) == int(cycles(32.0)) - (cycles(32.0) % 1 < 0.02)
    assert wave[0] == pytest.approx(0.0, abs=1e-9)
    assert wave[1] > 0
    assert np.abs(wave).max() == pytest.approx(2.0, rel=1e-3)


def test_a_multisine_fills_its_band_evenly_leaks_nothing_and_has_a_low_crest():
    made = multisine(JOINTS, ["hip"], 3.0, band=(0.5, 10.0), period=20.0, periods=2)
    wave = made.command[:4000, 0]
    assert (made.command[:4000] == made.command[4000:]).all()
    spectrum = np.abs(np.fft.rfft(wave))
    inside = np.zeros(len(spectrum), dtype=bool)
    inside[10:201] = True
    assert np.ptp(spectrum[inside]) < 1e-9 * spectrum.max()
    assert spectrum[~inside].max() < 1e-9 * spectrum.max()
    assert np.abs(wave).max() == pytest.approx(3.0)
    crest = np.abs(wave).max() / wave.std()
    assert crest == pytest.approx(made.metadata["crest_factor"]["hip"])
    assert crest < 1.9  # 191 cosines in phase: sqrt(2 * 191) = 19.5


def test_joints_of_one_multisine_share_no_frequency():
    made = multisine(JOINTS, None, 1.0)
    spectra = np.abs(np.fft.rfft(made.command, axis=0)) > 1e-6 * 4000
    assert spectra.any(axis=0).all()
    assert spectra.sum(axis=1).max() == 1


def test_beyond_the_limit_is_refused_and_clipped_only_when_asked(make):
    with pytest.raises(ExcitationError, match=r"its limit is -1\.5 to 1\.5 .*clip=True"):
        make(safety=Safety(limit=1.5))
    clipped = make(safety=Safety(limit=1.5, clip=True))
    free = make()
    assert (clipped.command == np.clip(free.command, -1.5, 1.5)).all()
    assert clipped.metadata["clipped_samples"] == (np.abs(free.command) > 1.5).any(axis=1).sum() > 0
    assert free.metadata["clipped_samples"] == 0
    wide = make(safety=Safety(limit=[20.0, 20.0, 20.0]))
    assert (wide.command == free.command).all()


def test_the_slew_limit_holds_from_the_first_sample(make):
    slow = make(safety=Safety(slew=[30.0, 20.0, 10.0], centre=0.5))
    steps = np.abs(np.diff(slow.command, axis=0, prepend=np.full((1, 3), 0.5)))
    assert (steps.max(axis=0) <= np.array([30.0, 20.0, 10.0]) / 200 + 1e-12).all()
    assert steps.max() > 0.04


def test_a_fade_begins_and_ends_at_the_centre(make):
    faded, free = make(safety=Safety(fade=0.5, centre=0.25)), make(safety=Safety(centre=0.25))
    assert faded.command[[0, -1]] == pytest.approx(np.full((2, 3), 0.25))
    assert (np.abs(faded.command - 0.25) <= np.abs(free.command - 0.25) + 1e-12).all()
    assert (faded.command[110:290] == free.command[110:290]).all()  # between the fades of the shortest segment


def test_position_targets_move_about_a_pose_within_joint_limits(make):
    limits = [[0.0, 9.0], [-2.0, 8.0], [-9.0, 0.0]]
    safety = Safety(limit=limits, clip=True, centre=[4.0, 3.0, -4.0])
    made = make(field="position_target", safety=safety)
    assert made.field == "position_target"
    low, high = np.transpose(limits)
    assert ((made.command >= low) & (made.command <= high)).all()
    assert np.median(made.command, axis=0) == pytest.approx([4.0, 3.0, -4.0], abs=1.0)


def test_what_was_sent_can_be_written_down(make):
    made = make(safety=Safety(limit=[[-9.0, 20.0]] * 3, slew=1000.0, fade=0.1, clip=True))
    assert json.loads(json.dumps(made.metadata)) == made.metadata
    assert made.metadata["excitation"] == made.kind
    assert made.command.shape == (len(made.time), 3)
    np.testing.assert_allclose(np.diff(made.time), 0.005)


@pytest.mark.parametrize(
    ("build", "advice"),
    [
        (lambda: sine(JOINTS, "elbow", [(1.0, 1.0)]), "no joint 'elbow'. Known are hip, thigh, knee"),
        (lambda: sine(JOINTS, "hip", [(1.0, 100.0)]), "below half the rate, 100 Hz"),
        (lambda: sine(JOINTS, "hip", []), "pairs is empty"),
        (lambda: chirp(JOINTS, "hip", 1.0, (0.1, 120.0)), "below half the rate, 100 Hz"),
        (lambda: multisine(JOINTS, None, 1.0, band=(0.1, 100.0)), "below half the rate, 100 Hz"),
        (lambda: multisine(JOINTS, None, 1.0, band=(1.0, 1.05), period=10.0), "no harmonic .* is left for thigh"),
        (lambda: multisine(JOINTS, None, 1.0, period=1.2345), "whole number of samples"),
        (lambda: gaussian(JOINTS, 1.0, seed=0, hold=(0.001, 0.4)), "at least one sample each"),
        (lambda: gaussian(JOINTS, 1.0, seed=0, safety=Safety(limit=[1.0, 2.0])), r"limit has shape \(2,\)"),
        (lambda: gaussian(JOINTS, 1.0, seed=0, safety=Safety(limit=-1.0)), "limit leaves no room"),
        (lambda: gaussian(JOINTS, 1.0, seed=0, safety=Safety(slew=0.0)), "slew must be positive"),
        (lambda: sine(JOINTS, "hip", [(1.0, 1.0)], safety=Safety(fade=1.5)), "does not fit into 2.000 s"),
        (lambda: sine(JOINTS, "hip", [(1.0, 1.0)], rate=0.0), "Give at least two"),
    ],
)
def test_what_cannot_be_made_is_refused_with_the_mend(build, advice):
    with pytest.raises(ExcitationError, match=advice):
        build()
