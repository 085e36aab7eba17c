"""What a probability is learnt from: right is what scores as right, and nothing is learnt from what scores."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest

from benchmarks.concealed import run
from benchmarks.concealed.calibrate import (
    FEATURES,
    SIGNS,
    WIDTH,
    Stated,
    bootstrap,
    chance,
    columns,
    crossed,
    current,
    figures,
    findings,
    fit,
    in_force,
    intervals,
    widening,
)
from benchmarks.concealed.cases import Case, source_digest
from benchmarks.concealed.hidden import Truth
from benchmarks.concealed.score import Row, reliability
from torchrl_athletic.diagnosis.calibration import Grounds, learnt, probability, widened

NOTHING = np.zeros(1 + WIDTH)
GROUNDS = Grounds(
    **{f.name: 1 for f in fields(Grounds)}
    | {"share": 0.9, "left": 0.1, "energy": 0.8, "plain": False, "senseless": False, "leans": False}
    | {"far": False, "refused": False, "overruled": False}
)


FRICTION = Truth("coulomb_friction", "elbow", {"torque": 1.0})


def row(truth: Truth, *names: str, interval=(0.9, 1.1), tolerated: tuple[str, ...] = ()) -> Row:
    case = Case("tuning", "single", 0, 0, "arm2", "torque_command", 200.0, 2, (truth,), tolerated=tolerated)
    stated = [
        {"effect": name, "joint": "elbow", "probability": 0.9 - 0.1 * k, "grounds": GROUNDS.to_json(),
         "parameters": {"torque": {"value": 1.0, "ci95": list(interval)}}}
        for k, name in enumerate(names)
    ]  # fmt: skip
    return Row(case, {"answer": {"findings": stated}})


def drawn(count: int = 400, seed: int = 0) -> Stated:
    """Findings that are right as often as their first feature says, three to a case."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(count, WIDTH))
    right = rng.random(count) < 1 / (1 + np.exp(-2 * features[:, 0]))
    grade = np.where(right, "right", "wrong")
    return Stated(features, np.full(count, 0.999), grade, np.ones(count), np.arange(count) // 3, count // 3 + 1)


def told(features, most, right) -> Stated:
    """Each of a case of its own."""
    grade = np.where(np.asarray(right) > 0, "right", "wrong")
    return Stated(features, most, grade, np.ones(len(most)), np.arange(len(most)), len(most))


def test_a_name_that_is_true_of_a_part_only_does_not_count_as_right():
    part = row(Truth("drag", "elbow", {}), "viscous_friction", tolerated=("viscous_friction",))
    stated = findings([part, row(FRICTION, "coulomb_friction", "stribeck_friction")])
    assert stated.grade.tolist() == ["tolerated", "right", "superset"]
    assert stated.right.tolist() == [0.0, 1.0, 1.0]
    assert stated.case.tolist() == [0, 1, 1]


@pytest.mark.parametrize("why", ["senseless", "refused"])
def test_a_senseless_or_refused_finding_teaches_nothing_since_its_probability_is_not_learnt(why):
    odd = row(FRICTION, "stribeck_friction", "coulomb_friction")
    odd.findings[0]["grounds"][why] = True
    assert findings([odd]).grade.tolist() == ["right"]


def test_blocks_count_as_they_do_in_the_proof_however_many_of_their_cases_were_run():
    one, two, three = (row(FRICTION, "coulomb_friction") for _ in range(3))
    three = replace(three, case=replace(three.case, block="leave_one_out"))
    weight = findings([one, two, three]).weight
    assert weight[0] == weight[1]
    assert 2 * weight[0] / weight[2] == pytest.approx(run.COUNTS["single"] / run.COUNTS["leave_one_out"])


def test_what_is_fitted_is_what_the_diagnosis_states():
    weights = in_force()
    for share in (0.95, 0.7, 0.2):
        grounds = replace(GROUNDS, share=share)
        features = np.array([columns(grounds, "backlash")])
        stated = probability(grounds, "backlash")
        assert chance(weights, features, np.array([grounds.most]))[0] == pytest.approx(stated)


def test_a_finding_has_its_share_of_the_evidence_at_most_and_one_with_all_of_it_may_have_it_all():
    sure = np.full((1, WIDTH), 0.0)
    weights = np.array([9.0] + [0.0] * WIDTH)
    most = [replace(GROUNDS, share=share).most for share in (0.01, 0.5, 0.7, 0.8, 1.0)]
    stated = [chance(weights, sure, np.array([m]))[0] for m in most]
    np.testing.assert_allclose(stated, [0.01, 0.5, 0.7, 0.8, 1.0], atol=2e-4)


def test_findings_that_the_share_caps_teach_nothing_about_the_others():
    # half of them are capped at 0.5 and right so often; of the others nine in ten are right
    share = np.repeat([0.5, 0.999], 100)
    right = np.concatenate([np.arange(100) < 50, np.arange(100) < 90]).astype(float)
    features = np.zeros((200, WIDTH))
    stated = chance(fit(told(features, share, right), 1.0, NOTHING), features, share)
    np.testing.assert_allclose(stated[:100], 0.5)
    np.testing.assert_allclose(stated[100:], 0.9, atol=0.005)


def test_an_effect_that_often_stands_in_for_others_is_stated_less():
    features = np.array([columns(GROUNDS, name) for name in ("backlash", "compliance")]).repeat(50, axis=0)
    right = np.concatenate([np.arange(50) < 45, np.arange(50) < 5]).astype(float)
    share = np.full(100, 0.999)
    stated = chance(fit(told(features, share, right), 0.1, NOTHING), features, share)
    assert stated[0] > 0.8
    assert stated[-1] < 0.2


def test_weights_have_their_signs_and_the_ridge_pulls_them_to_zero():
    stated = drawn()
    loose, tight = (fit(stated, ridge, NOTHING) for ridge in (0.01, 100.0))
    assert loose[1] == pytest.approx(2.0, abs=0.5)
    assert 0 < tight[1] < loose[1]
    against = fit(replace(stated, features=-stated.features), 0.01, NOTHING)
    assert against[1] == 0.0


def test_what_was_learnt_before_stays_where_new_findings_say_nothing_and_gives_way_where_they_do():
    """Two thousand findings are right as the first feature says; the second is the same in all of them."""
    assert SIGNS[FEATURES[1]] < 0
    start = NOTHING.copy()
    start[1:3] = 1.0, -3.0
    stated = drawn(2000)
    stated.features[:, 1] = 0.0
    weights = fit(stated, 0.5, start)
    assert weights[1] == pytest.approx(2.0, abs=0.3)
    assert weights[2] == -3.0
    assert np.abs(weights[3:]).max() < 0.5
    few = fit(drawn(9), 1e4, start)  # held fast
    np.testing.assert_allclose(few[1:3], start[1:3], atol=1e-2)


def test_no_case_is_judged_by_weights_that_have_seen_it():
    stated = drawn(120)
    of_first = stated.case == 0
    turned = np.where(of_first, np.where(stated.grade == "right", "wrong", "right"), stated.grade)
    other = replace(stated, grade=turned)
    before, after = crossed(stated, 0.5, 3, NOTHING), crossed(other, 0.5, 3, NOTHING)
    np.testing.assert_array_equal(before[of_first], after[of_first])
    assert np.abs(before - after).max() > 1e-3


def test_wrong_names_are_counted_by_cases_those_without_findings_included():
    grade = np.array(["wrong", "wrong", "tolerated", "right"])
    stated = Stated(np.zeros((4, WIDTH)), np.ones(4), grade, np.ones(4), np.array([0, 0, 1, 2]), 10)
    told = figures(stated, np.array([0.9, 0.8, 0.7, 0.6]))
    assert told["cases with a wrong name over 0.5"] == pytest.approx(0.1)
    assert told["right findings over 0.5"] == 1.0


def test_a_calibration_error_is_the_mean_distance_of_stated_and_true():
    assert reliability(np.array([1.0, 0.0]), np.array([True, False]))["ece"] == 0.0
    three_to_one = reliability(np.full(4, 0.95), np.array([True, True, True, False]))
    assert three_to_one["ece"] == pytest.approx(0.2)
    assert reliability(np.zeros(0), np.zeros(0, dtype=bool))["ece"] is None


def test_an_interval_that_was_widened_is_taken_back_to_the_bootstraps():
    low, high = widened(2.0, 1.5, 2.2)
    estimate = {"value": 2.0, "ci95": [low, high]}
    assert bootstrap(estimate, learnt("interval")) == pytest.approx((2.0, 1.5, 2.2))


def test_learning_twice_widens_no_further():
    r = row(FRICTION, "coulomb_friction")
    r.result["calibration"] = {"interval": {"widen": 2.0, "relative": 0.0}}  # type: ignore[index]
    np.testing.assert_allclose(intervals([r]), [[1.0, 0.95, 1.05, 1.0]])


def test_the_factor_is_the_least_with_which_intervals_hold_nearly_all_truths():
    off = np.linspace(-3, 3, 101)
    rows = np.column_stack([np.zeros(101), -np.ones(101), np.ones(101), off])
    assert widening(rows, 0.0) == 3.0  # within 2.85 lie 95 of 101


def test_answers_of_another_program_and_failed_ones_are_left_out_and_counted(capsys):
    mine, other = (row(FRICTION, "coulomb_friction") for _ in range(2))
    mine.result["program"], other.result["program"] = "now", "before"  # type: ignore[index]
    failed = Row(mine.case, {"program": "now", "error": "broke"})
    assert current([mine, other, failed], "now") == [mine]
    assert "1 of another state of the diagnosis, 1 that failed" in capsys.readouterr().out


def test_an_answer_is_done_if_generator_and_program_are_those_of_now(tmp_path):
    path = tmp_path / "case.json"
    assert not run.is_done(path)
    kept = {"source": source_digest(), "program": run.program_digest("diagnosis")}
    path.write_text(json.dumps(kept), encoding="utf-8")
    assert run.is_done(path)
    assert not run.is_done(path, "naive_bic")  # whose program is another
    path.write_text(json.dumps(kept | {"source": "older"}), encoding="utf-8")
    assert not run.is_done(path)
