from dataclasses import replace

import pytest
from diagnosis.sample import SAMPLES, arm, nothing_missing
from hypothesis import given
from hypothesis import strategies as st

from torchrl_athletic.diagnosis.report.shares import energy_shares
from torchrl_athletic.diagnosis.result import Answer, Score

ERRORS = st.floats(1e-6, 1.0)


def score(before: float, after: float, floor: float) -> Score:
    return Score(before, after, floor, 0.0, {"elbow": {"before": before, "after": after, "floor": floor}})


@given(ERRORS, ERRORS, ERRORS, ERRORS)
def test_shares_are_shares(before, after, learned, floor):
    fit = {"train": score(before, after, floor), "train_uan": score(before, learned, floor)}
    shares = energy_shares(Answer("explained", (), fit=fit), "train")
    assert sum(shares.values()) == pytest.approx(1.0)
    assert min(shares.values()) >= 0
    without = energy_shares(Answer("explained", (), fit={"train": fit["train"]}), "train")
    assert shares["uan"] + shares["unexplained"] == pytest.approx(without["unexplained"])  # it takes of what is left


def test_energies_add_and_not_amplitudes():
    answer = Answer("explained", (), fit={"heldout": score(5.0, 3.0, 1.0), "heldout_uan": score(5.0, 2.0, 1.0)})
    assert energy_shares(answer, "heldout") == pytest.approx(
        {"physics": 16 / 25, "uan": 5 / 25, "unexplained": 3 / 25, "noise": 1 / 25}
    )


def test_a_model_that_is_right_errs_by_noise():
    shares = energy_shares(nothing_missing().answer, "heldout")
    assert shares["physics"] == 0
    assert shares["noise"] == pytest.approx((127 / 131) ** 2)


def test_a_joint_that_stood_still_and_a_simulation_that_ran_away_divide_nothing_by_zero():
    assert sum(energy_shares(Answer("explained", (), fit={"train": score(0.0, 0.0, 0.0)}), "train").values()) == 1.0
    ran_away = Answer("explained", (), fit={"train": score(float("nan"), 1.0, 0.1)})
    assert all(share == share for share in energy_shares(ran_away, "train").values())


def test_metres_and_radians_are_not_added():
    answer = arm().answer
    small = {
        k: {**v, **{n: v[n] * (1e-3 if k == "elbow" else 1) for n in v}}
        for k, v in answer.fit["train"].per_joint.items()
    }
    other = replace(answer, fit={"train": replace(answer.fit["train"], per_joint=small)})
    assert energy_shares(other, "train") == pytest.approx(energy_shares(answer, "train"))


@pytest.mark.parametrize("name", SAMPLES)
def test_the_parts_are_drawn_from_explained_to_noise(name):
    answer = SAMPLES[name]().answer
    assert list(energy_shares(answer, "train")) == ["physics", "unexplained", "noise"]
