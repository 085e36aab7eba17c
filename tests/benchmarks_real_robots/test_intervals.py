"""Intervals of ratios whose truth is known."""

import numpy as np
import pytest

from benchmarks.real_robots.intervals import apart, interval


def test_windows_that_are_all_alike_leave_no_doubt():
    assert interval(np.ones(9), 4 * np.ones(9), np.random.default_rng(0)) == pytest.approx((0.5, 0.5))


def test_the_true_ratio_lies_in_nineteen_intervals_of_twenty():
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(200):
        low, high = interval(rng.exponential(1.0, 100), rng.exponential(4.0, 100), rng)
        held += low <= 0.5 <= high
    assert 180 <= held <= 199


def test_windows_that_overlap_tell_but_once():
    square = np.array([1.0, 3.0, 2.0, 4.0, 7.0])
    assert apart(square, 2).tolist() == [2.0, 3.0, 7.0]
    assert apart(square, 1).tolist() == square.tolist()
