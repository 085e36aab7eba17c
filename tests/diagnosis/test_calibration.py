"""What was learnt counts, and for what it was learnt."""

import math
import warnings
from dataclasses import replace

import pytest

from torchrl_athletic.diagnosis import calibration
from torchrl_athletic.diagnosis.calibration import Grounds, class_probability, probability, rival_probability, widened
from torchrl_athletic.diagnosis.thresholds import STATEMENT

GROUNDS = Grounds(share=0.9, left=0.2, excess=2, scatter=0.1, open=0.1, energy=0.6, terms=2, strain=1, sure=5)


def test_an_effect_that_stands_in_for_others_is_believed_less(monkeypatch):
    learnt = calibration.learnt
    told = {"effects": {"backlash": -1.0, "payload": 1.0}}
    monkeypatch.setattr(calibration, "learnt", lambda part: told.get(part, learnt(part)))
    low, plain, high = (probability(GROUNDS, name) for name in ("backlash", "coulomb_friction", "payload"))
    assert low < plain < high
    odds = [p / (1 - p) for p in (low, plain)]
    assert odds[1] / odds[0] == pytest.approx(2.718, rel=1e-3)


def test_a_probability_is_the_logistic_of_what_is_learnt_of_each_ground_and_of_nothing_else(monkeypatch):
    """Grounds that nothing was learnt of do not count; odds without end are told as odds of e to the 20."""
    told = {"weights": {"intercept": 0.5, "left": -2.0, "terms": 0.25}, "effects": {"backlash": -1.0}}
    monkeypatch.setattr(calibration, "learnt", told.get)
    sure = replace(GROUNDS, left=0.0999, terms=4)  # a decade and two doublings from where they are usual
    assert probability(sure) == pytest.approx(1 / (1 + math.exp(-(0.5 - 2.0 + 0.5))))
    assert probability(sure, "backlash") == pytest.approx(1 / (1 + math.exp(-(0.5 - 2.0 + 0.5 - 1.0))))
    for odds, expected in ((1e4, sure.most), (-1e4, math.exp(-20))):
        told["weights"]["intercept"] = odds
        with warnings.catch_warnings(action="error"):
            assert probability(sure) == pytest.approx(expected)


def test_a_class_is_as_likely_as_its_laws_together_and_as_it_closes_by_what_was_learnt(monkeypatch):
    monkeypatch.setattr(calibration, "learnt", lambda part: {"level": 0.0, "alike": 1.0, "closes": 0.0})
    with warnings.catch_warnings(action="error"):
        for alike, expected in ((0.3, 0.3), (0.9, 0.9), (1.0, 0.999), (0.0, 0.001)):
            assert class_probability(0.0, alike, 1.0, 1.0) == pytest.approx(expected)
    monkeypatch.setattr(calibration, "learnt", lambda part: {"level": math.log(2.0), "alike": 2.0, "closes": 0.5})
    odds_of_three, odds_of_four = 0.75, 0.8
    assert class_probability(0.0, odds_of_three, 1.0, odds_of_four) == pytest.approx(min(36 / 37, odds_of_four))
    assert class_probability(0.0, 0.1, 1.0, odds_of_four) == pytest.approx(4 / 85)  # two, over 81, times two
    with warnings.catch_warnings(action="error"):
        assert class_probability(0.0, 0.5, 1.0, 0.0) == 0.0
        assert class_probability(0.0, 0.5, 1.0, 1.0) == pytest.approx(6 / 7)  # as of what closes nine tenths
        assert class_probability(0.0, 0.5, 1.0, None) == pytest.approx(2 / 3)  # nobody asked: nothing is said


def test_nothing_is_learnt_of_what_is_not_in_the_file():
    assert calibration.learnt("no such part") == {}


def test_an_interval_is_widened_on_each_side_by_what_it_has_there_and_by_a_share_of_the_value(monkeypatch):
    told = {"interval": {"widen": 2.0, "relative": 0.1}}
    monkeypatch.setattr(calibration, "learnt", told.get)
    assert widened(30.0, 28.0, 30.5) == pytest.approx((30 - 5.0, 30 + 10**0.5))
    assert widened(-30.0, -30.5, -28.0) == pytest.approx((-30 - 10**0.5, -30 + 5.0))
    assert widened(0.0, 0.0, 0.5) == pytest.approx((0.0, 1.0))
    assert widened(1.0, 1.5, 0.5) == pytest.approx((0.9, 1.1))  # a bootstrap that missed the estimate


@pytest.mark.parametrize(("closed", "closes"), [(0.3, 1.0), (1.0, 0.3)])
def test_a_class_is_no_likelier_than_what_it_explains_but_as_likely_as_its_law(closed, closes):
    assert class_probability(0.1, 0.99, 1.0, 1.0) > 0.5
    assert class_probability(0.1, 0.99, 1.0, 1.0) > class_probability(0.1, 0.11, 1.0, 1.0) + 0.1
    assert class_probability(0.1, 0.99, closed, closes) == pytest.approx(0.3)
    assert class_probability(0.6, 0.99, closed, closes) == 0.6


def test_a_law_is_no_likelier_than_what_it_closes_of_the_simulations_error():
    sure = replace(GROUNDS, share=0.99, left=0.0, excess=0.0, scatter=0.01, open=0.0, energy=1.0, terms=1, sure=30)
    assert probability(sure) > 0.8
    assert probability(replace(sure, closes=0.04)) == 0.04
    assert probability(replace(sure, closes=0.04, senseless=True)) == 0.04
    assert probability(replace(sure, closes=0.99)) == probability(sure)


@pytest.mark.parametrize("doubt", ["plain", "leans", "far"])
def test_a_doubt_takes_away_what_was_learnt_of_it_and_teaches_nothing_where_there_is_none(doubt, monkeypatch):
    told = {"weights": {"intercept": 1.0, doubt: -0.7}}
    monkeypatch.setattr(calibration, "learnt", lambda part: told.get(part, {}))
    assert probability(replace(GROUNDS, share=0.99)) == pytest.approx(1 / (1 + math.exp(-1.0)))
    assert probability(replace(GROUNDS, share=0.99, **{doubt: True})) == pytest.approx(1 / (1 + math.exp(-0.3)))


def test_rivals_are_there_until_they_are_refuted():
    at, below = (replace(GROUNDS, share=share).features() for share in (STATEMENT.refutes, 0.99 * STATEMENT.refutes))
    assert (at["rivals"], below["rivals"]) == (0.0, 1.0)


def test_every_doubt_in_force_takes_something_away_or_nothing_and_adds_nothing():
    assert all(calibration.learnt("weights")[doubt] <= 0 for doubt in ("plain", "leans", "far", "rivals"))


@pytest.mark.parametrize(
    ("ground", "value", "feature"),
    [
        ("share", 0.5, 0.0),
        ("share", 0.999, 6.9068 / 3),
        ("share", 1.0, 6.9068 / 3),  # no evidence is without end
        ("share", 0.0, -6.9068 / 3),
        ("left", 0.0099, 0.0),
        ("left", 0.9999, 2.0),
        ("left", 0.0, -2.0),
        ("excess", 0.9, 0.0),
        ("excess", 0.0, -1.0),
        ("excess", 99.9, 2.0),
        ("scatter", 0.09, 0.0),
        ("scatter", 0.0, -1.0),
        ("open", 0.0099, 0.0),
        ("open", 0.0, -2.0),
        ("energy", 0.999, 0.0),
        ("energy", 0.0, -3.0),
        ("terms", 1, 0.0),
        ("terms", 8, 3.0),
        ("strain", 0.0, 0.0),
        ("strain", 9.0, 1.0),
        ("sure", 10.0, 0.0),
        ("sure", 100.0, 1.0),
        ("sure", 1e4, 1.0),
        ("sure", 0.0, -2.0),
    ],
)
def test_grounds_count_by_decades_from_where_they_are_usual_to_where_more_says_no_more(ground, value, feature):
    """The number of findings counts by its doublings, a share by its log odds."""
    assert replace(GROUNDS, **{ground: value}).features()[ground] == pytest.approx(feature, abs=1e-3)


@pytest.mark.parametrize(
    ("doubt", "most"),
    [
        ({}, 0.95),
        ({"plain": True, "leans": True, "far": True}, 0.95),  # what is learnt tells how much that takes away
        ({"share": 0.51}, 0.51),
        ({"senseless": True}, STATEMENT.senseless),
        ({"senseless": True, "far": True}, STATEMENT.senseless),
        ({"refused": True}, STATEMENT.refused),
        ({"refused": True, "senseless": True}, STATEMENT.refused),
        ({"refused": True, "share": 0.05}, 0.05),
    ],
)
def test_no_finding_has_more_than_its_share_of_the_evidence_nor_more_than_nonsense_may_have(doubt, most, monkeypatch):
    sure = replace(GROUNDS, **({"share": 0.95} | doubt))
    assert sure.most == most
    monkeypatch.setattr(calibration, "learnt", lambda part: {"intercept": 9.0} if part == "weights" else {})
    assert probability(sure) == pytest.approx(most)


def test_a_rival_has_its_share_of_what_the_finding_has_or_leaves_and_never_more_than_the_finding():
    assert rival_probability(likely=0.6, own=0.75, share=0.25) == pytest.approx(0.25 * 0.6 / 0.75)
    assert rival_probability(likely=0.9, own=0.75, share=0.25) == pytest.approx(0.1)  # what is left in all
    assert rival_probability(likely=0.2, own=0.2, share=0.7) == 0.2
