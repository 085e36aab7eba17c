"""Stretches of a long log lie in all of it, and a short one is left as it is."""

import numpy as np
import pytest

from torchrl_athletic.recordings import Recording, cut_stretches, recorded_time


def log(seconds, rate=10.0, joints=("hip",)):
    time = np.arange(int(seconds * rate)) / rate
    ramp = np.tile(time[:, None], (1, len(joints)))
    return Recording(time, joints, ramp, torque_command=ramp)


def test_what_is_short_enough_stays_itself():
    takes = [log(20), log(30)]
    assert cut_stretches(takes, 60.0) == takes


@pytest.mark.parametrize(("seconds", "values", "kept"), [(60.0, np.inf, 60), (1e9, 1200, 120), (1e9, -5, 10)])
def test_time_and_values_bound_what_is_kept(seconds, values, kept):
    parts = cut_stretches([log(3600), log(600)], seconds, values)
    assert sum(r.duration for r in parts) == pytest.approx(kept, rel=0.5)


@pytest.mark.parametrize("seconds", [11, 13, 600])
def test_ten_seconds_are_kept_however_little_is_asked_for(seconds):
    assert 9.5 <= seconds_of(cut_stretches([log(seconds)], 1.0)) <= 12.0


def test_stretches_lie_in_all_takes_in_proportion_and_in_order():
    parts = cut_stretches([log(3000), log(1000)], 240.0)
    starts = [r.time[0] for r in parts]
    assert len(parts) == 40
    assert np.argmax(starts) == 29  # thirty of the first, then ten of the second
    assert starts[29] > 2800
    assert np.diff(starts[:30]).min() > 6.0


def spoken(seconds=600, rate=10.0):
    """Twenty seconds of every hundred were logged."""
    whole = log(seconds, rate)
    return whole.where(whole.time % 100 < 20)


def seconds_of(parts):
    return sum(recorded_time(r)[-1] for r in parts)


def test_pauses_are_no_part_of_a_take():
    parts = cut_stretches([spoken()], 60.0)
    assert len(parts) == 10
    assert all(55 <= r.num_samples <= 61 for r in parts)
    assert seconds_of(parts) == pytest.approx(60.0, rel=0.05)
    assert {int(r.time[0] // 100) for r in parts} == set(range(6))


def test_a_take_with_pauses_gets_its_share_beside_one_without():
    parts = cut_stretches([spoken(), log(120)], 60.0)  # two minutes were logged of each
    assert [r.num_samples > 0 for r in parts] == [True] * 10
    assert {int(r.time[0] // 100) for r in parts[:5]} <= set(range(6))
    assert np.diff([r.time[0] for r in parts[:5]]).min() > 0
    assert parts[5].time[0] < 20 < 90 < parts[9].time[0] < 120
    assert seconds_of(cut_stretches([spoken(), log(120)], 1e9, 1200)) == pytest.approx(120.0, rel=0.1)


def test_bursts_and_uneven_rates_are_no_pauses():
    at = np.repeat(np.arange(0, 600, 0.008), 8) + np.tile(np.arange(8) * 1e-4, 75_000)
    still = np.zeros((len(at), 1))
    assert seconds_of(cut_stretches([Recording(at, ("hip",), still, torque_command=still)], 60.0)) <= 61.0
    fast = np.concatenate([np.arange(0, 60, 0.001), np.arange(60, 600, 0.01)])
    still = np.zeros((len(fast), 1))
    parts = cut_stretches([Recording(fast, ("hip",), still, torque_command=still)], 60.0)
    assert sum(r.duration for r in parts) <= 61.0
    assert np.allclose(np.diff([r.time[0] for r in parts]), 60.0, atol=0.1)


@pytest.mark.parametrize("time", [np.array([0.0, 100.0]), np.arange(0, 1000, 10.0)])
def test_a_stretch_of_a_log_with_few_samples_has_two(time):
    still = np.zeros((len(time), 1))
    parts = cut_stretches([Recording(time, ("hip",), still, torque_command=still)], 60.0)
    assert len(parts) == 10
    assert all(r.num_samples == 2 for r in parts)
