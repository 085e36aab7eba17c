"""Intervals of ratios whose truth is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.real_robots.intervals import back_to_back, interval


def test_windows_that_are_all_alike_leave_no_doubt():
    assert interval(np.ones(9), 4 * np.ones(9), np.random.default_rng(0)) == pytest.approx((0.5, 0.5))


def test_the_true_ratio_lies_in_nineteen_intervals_of_twenty():
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(200):
        low, high = interval(rng.exponential(1.0, 100), rng.exponential(4.0, 100), rng)
        held += low <= 0.5 <= high
    assert 180 <= held <= 199


@pytest.mark.parametrize("times", [1, 4, 10])
def test_windows_that_overlap_tell_but_once(times):
    """Of two recordings with windows of ten samples those are drawn from that share none."""
    one, other = object(), object()
    firsts = np.arange(0, 91, 10 // times)
    windows = [SimpleNamespace(recording=r, first=k, measured=range(10)) for r in (one, other) for k in firsts]
    drawn = [w.first for w, kept in zip(windows, back_to_back(windows), strict=True) if kept]
    assert drawn == 2 * list(range(0, 91, 10))
