"""What was learnt counts, and for what it was learnt."""

import pytest

from torchrl_athletic.diagnosis import calibration
from torchrl_athletic.diagnosis.calibration import Grounds, class_probability, probability, widened

GROUNDS = Grounds(share=0.9, left=0.2, excess=2, scatter=0.1, open=0.1, energy=0.6, terms=2, strain=1, sure=5)


def test_an_effect_that_stands_in_for_others_is_believed_less(monkeypatch):
    learnt = calibration.learnt
    told = {"effects": {"backlash": -1.0, "payload": 1.0}}
    monkeypatch.setattr(calibration, "learnt", lambda part: told.get(part, learnt(part)))
    low, plain, high = (probability(GROUNDS, name) for name in ("backlash", "coulomb_friction", "payload"))
    assert low < plain < high
    odds = [p / (1 - p) for p in (low, plain)]
    assert odds[1] / odds[0] == pytest.approx(2.718, rel=1e-3)


def test_an_interval_is_widened_on_each_side_by_what_it_has_there_and_by_a_share_of_the_value(monkeypatch):
    told = {"interval": {"widen": 2.0, "relative": 0.1}}
    monkeypatch.setattr(calibration, "learnt", told.get)
    assert widened(30.0, 28.0, 30.5) == pytest.approx((30 - 5.0, 30 + 10**0.5))
    assert widened(-30.0, -30.5, -28.0) == pytest.approx((-30 - 10**0.5, -30 + 5.0))
    assert widened(0.0, 0.0, 0.5) == pytest.approx((0.0, 1.0))
    assert widened(1.0, 1.5, 0.5) == pytest.approx((0.9, 1.1))  # a bootstrap that missed the estimate


@pytest.mark.parametrize(("closed", "energy"), [(0.3, 1.0), (1.0, 0.3)])
def test_a_class_is_no_likelier_than_what_is_closed_and_accounted_for_but_as_likely_as_its_law(closed, energy):
    assert class_probability(0.1, 0.99, 1.0, 1.0) > 0.5
    assert class_probability(0.1, 0.99, closed, energy) == 0.3
    assert class_probability(0.6, 0.99, closed, energy) == 0.6
