import math

import pytest
from diagnosis.sample import arm, slider
from hypothesis import given
from hypothesis import strategies as st

from torchrl_athletic.diagnosis.report.quantity import (
    estimate,
    joint_units,
    number,
    percent,
    quantities,
    quantity,
    share_closed,
)
from torchrl_athletic.diagnosis.result import Estimate

SI = {"mrad": 1e-3, "µrad": 1e-6, "mm": 1e-3, "µm": 1e-6, "ms": 1e-3, "µs": 1e-6, "g": 1e-3}
DIGITS = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹−", "-0123456789-")


def in_si(text: str) -> float:
    """Read a printed quantity back, independently of how it was made."""
    value, _, unit = text.translate(DIGITS).partition(" ")
    power, _, _ = unit.partition(" ")
    return float(value) * (10.0 ** int(power[3:]) if power.startswith("×10") else SI.get(unit, 1.0))


UNITS = st.sampled_from(["rad", "m", "s", "kg", "N·m", "kg·m²", "1"])
SIZES = st.floats(1e-9, 1e7).flatmap(lambda v: st.sampled_from([v, -v]))


@given(SIZES, UNITS)
def test_a_printed_quantity_reads_back_to_half_a_percent(value, unit):
    assert in_si(quantity(value, unit)) == pytest.approx(value, rel=0.00501)


@given(SIZES, UNITS)
def test_a_printed_number_is_short(value, unit):
    digits = quantity(value, unit).split(" ")[0].translate(DIGITS).strip("-")
    assert len(digits) <= 8


@given(st.lists(st.floats(1e-7, 10.0), min_size=1, max_size=4), st.sampled_from(["rad", "m"]))
def test_values_side_by_side_share_a_unit_and_none_rounds_to_nothing(values, unit):
    texts, name = quantities(values, unit)
    for text, value in zip(texts, values, strict=True):
        assert in_si(f"{text} {name}") == pytest.approx(value, rel=0.51)
        assert float(text) > 0
    assert in_si(f"{texts[values.index(max(values))]} {name}") == pytest.approx(max(values), rel=0.00501)


@given(SIZES, st.floats(1e-6, 10.0), UNITS)
def test_an_interval_is_printed_finer_than_a_tenth_of_its_half_width(value, relative, unit):
    half = abs(value) * relative
    texts = estimate(Estimate(value, (value - half, value + half), unit))
    printed = [in_si(f"{text} {texts[3]}") for text in texts[:3]]
    step = max(half / 10, abs(value) * 1e-5)
    assert printed == pytest.approx([value, value - half, value + half], abs=0.501 * step)
    decimals = {len(text.partition(".")[2]) for text in texts[:3]}
    assert len(decimals) == 1


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.0225, "rad", "22.5 mrad"),
        (0.52, "rad", "0.520 rad"),
        (0.0041, "m", "4.10 mm"),
        (2e-6, "m", "2.00 µm"),
        (0.025, "s", "25.0 ms"),
        (-3.1648, "N", "−3.16 N"),
        (0.9, "1", "0.900"),
        (2.5e-4, "rad", "0.250 mrad"),
        (2.5e-4, "m", "0.250 mm"),
        (2.5e-4, "s", "0.250 ms"),
        (9.9e-5, "s", "99.0 µs"),
        (0.4, "kg", "0.400 kg"),
        (0.04, "kg", "40.0 g"),
        (4e-5, "kg", "0.0400 g"),
        (0.1, "rad", "0.100 rad"),
        (1e-4, "m", "0.100 mm"),
        (1e-3, "N", "0.00100 N"),
        (1e5, "N", "100 ×10³ N"),
        (2e5, "N", "200 ×10³ N"),
        (2e4, "N", "20000 N"),
        (5e-4, "N", "500 ×10⁻⁶ N"),
        (5e-3, "N", "0.00500 N"),
        (0.0, "rad", "0.00 rad"),
        (-0.0, "N", "0.00 N"),
        (math.nan, "rad", "– rad"),
    ],
)
def test_angles_lengths_and_times_are_printed_at_a_readable_scale(value, unit, text):
    assert quantity(value, unit) == text


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.97, "97 %"),
        (1.0, "100 %"),
        (0.0, "0 %"),
        (0.999, "> 99 %"),
        (0.994, "99 %"),
        (0.001, "< 1 %"),
        (0.006, "1 %"),
        (-0.2, "−20 %"),
        (math.nan, "–"),
    ],
)
def test_a_probability_below_one_never_reads_as_certainty(share, text):
    assert percent(share) == text


def test_the_gap_is_closed_when_the_error_reaches_the_floor():
    assert share_closed(5.0, 1.0, 1.0) == 1.0
    assert share_closed(5.0, 5.0, 1.0) == 0.0
    assert share_closed(5.0, 6.0, 1.0) < 0.0
    assert math.isnan(share_closed(1.0, 1.0, 1.0))


def test_slides_are_told_from_hinges_by_the_answer_or_by_their_forces():
    s = slider()
    assert joint_units(s.answer) == {"carriage": "m"}
    unsaid = type(s.answer)("explained", (), fit=s.answer.fit)
    assert joint_units(unsaid, s.maps) == {"carriage": "m"}
    assert joint_units(type(s.answer)("explained", ()), s.maps) == {"carriage": "m"}  # before anything was simulated
    assert joint_units(arm().answer, arm().maps) == {"shoulder": "rad", "elbow": "rad"}


def test_digits_are_significant_and_never_an_exponent():
    assert [number(v) for v in (240.424, 20.144, 0.0783, 123456.0)] == ["240", "20.1", "0.0783", "123456"]


def test_values_side_by_side_are_at_the_scale_of_their_geometric_mean():
    assert quantities([0.5, 0.002], "rad") == (["500", "2"], "mrad")
    assert quantities([0.5, 0.2, 0.0], "rad") == (["0.500", "0.200", "0.000"], "rad")
    assert quantities([math.nan, 0.005], "m") == (["–", "5.00"], "mm")
    assert quantities([0.0], "m") == (["0.00"], "m")
    assert quantities([-5.0, 0.05], "rad") == (["−5.00", "0.05"], "rad")  # by their sizes, whatever their signs


@pytest.mark.parametrize(
    ("value", "interval", "unit", "texts"),
    [
        (166.706, (163.24, 170.11), "N·s/m", ("166.7", "163.2", "170.1", "N·s/m")),
        (1234.0, (834.0, 1634.0), "N", ("1230", "830", "1630", "N")),
        (0.0021, (0.0020, 0.0022), "s", ("2.10", "2.00", "2.20", "ms")),
        (0.5, (2e-5, 1.0), "rad", ("0.50", "0.00", "1.00", "rad")),
        (2.0, (math.nan, math.nan), "N", ("2.00", "–", "–", "N")),
        (2.0, (2.0, 2.0), "N", ("2.00", "2.00", "2.00", "N")),
        (2.0, (2.0, 2.0000001), "N", ("2.00000", "2.00000", "2.00000", "N")),
    ],
)
def test_a_value_has_two_digits_of_its_half_width_and_one_without_it_three(value, interval, unit, texts):
    assert estimate(Estimate(value, interval, unit)) == texts
