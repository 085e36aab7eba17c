"""Stretches of a long log lie in all of it, and a short one is left as it is."""

import numpy as np
import pytest

from torchrl_athletic.recordings import Recording, cut_stretches


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


def test_stretches_lie_in_all_takes_in_proportion_and_in_order():
    parts = cut_stretches([log(3000), log(1000)], 240.0)
    starts = [r.time[0] for r in parts]
    assert len(parts) == 40
    assert np.argmax(starts) == 29  # thirty of the first, then ten of the second
    assert starts[29] > 2800
    assert np.diff(starts[:30]).min() > 6.0


def test_pauses_are_no_part_of_a_take():
    whole = log(600)
    spoke = whole.where((whole.time % 100 < 20) | (whole.time > 590))  # twenty seconds, then a pause of eighty
    parts = cut_stretches([spoke], 60.0)
    assert len(parts) == 10
    assert all(55 <= r.num_samples <= 61 for r in parts)
    assert sum(r.num_samples for r in parts) == pytest.approx(600, rel=0.05)
    assert {int(r.time[0] // 100) for r in parts} == set(range(6))
