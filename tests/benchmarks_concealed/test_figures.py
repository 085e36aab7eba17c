"""The figure of the proof says what the committed numbers say."""

from __future__ import annotations

import pytest

from benchmarks.concealed.figures import Config, interval, main


@pytest.mark.parametrize("n", [1, 24, 160])
def test_an_interval_holds_its_rate_and_ends_where_the_binomial_says(n):
    low, high = interval(0.0, n)
    assert low == 0.0
    assert (1 - high) ** n == pytest.approx(0.025)
    assert interval(1.0, n) == pytest.approx((1 - high, 1.0))


def test_the_same_numbers_draw_the_same_picture(tmp_path):
    for name in ("one.svg", "two.svg"):
        main(Config(output=tmp_path / name))
    one, two = ((tmp_path / name).read_bytes() for name in ("one.svg", "two.svg"))
    assert one == two
    assert len(one) > 10_000
