"""Classes of what is concealed on real benches: what counts as found, as wrong, and as nobody's knowledge."""

import pytest

from benchmarks.concealed.classes import known, learn, probability, statements, table


def finding(effect, joint, p=0.4, rivals=(), left=0.1, closes=1.0, senseless=False):
    grounds = {"open": left, "closes": closes, "senseless": senseless}
    rivals = [list(r) for r in rivals]
    return {"effect": effect, "joint": joint, "probability": p, "grounds": grounds, "rivals": rivals}


def case(*findings, bench="arm", kind="removed", truth=("coulomb_friction", "elbow")):
    return {"bench": bench, "kind": kind, "truths": [list(truth)], "findings": list(findings)}


CONTROL = {"bench": "arm", "kind": "complete", "truths": [], "findings": [finding("payload", "elbow")]}


def graded(*cases):
    return statements(cases, known([CONTROL]))


def test_an_answer_from_before_laws_were_bounded_is_bounded_by_what_each_closes():
    old = finding("stribeck_friction", "elbow", 0.7, rivals=[("coulomb_friction", "elbow", 0.2)])
    del old["grounds"]["closes"]
    [free] = graded(case(old))
    assert (free.law, free.alike, free.closes) == (0.7, pytest.approx(0.9), 1.0)
    old["grounds"]["closes"] = 0.05
    [bounded] = graded(case(old))
    assert (bounded.law, bounded.alike, bounded.closes) == (0.05, 0.05, 0.05)


def test_a_class_is_right_by_its_joint_and_known_where_the_complete_model_says_it_too():
    said = graded(
        case(
            finding("stribeck_friction", "elbow"),
            finding("coulomb_friction", "shoulder"),
            finding("link_mass", "elbow"),
        )
    )
    assert [s.right for s in said] == [True, False, False]
    assert [s.known for s in said] == [False, False, True]


def test_rivals_of_the_same_class_and_joint_are_on_its_side():
    rivals = [("viscous_friction", "elbow", 0.2), ("viscous_friction", "hip", 0.1), ("payload", "elbow", 0.1)]
    [said] = graded(case(finding("coulomb_friction", "elbow", 0.4, rivals=rivals)))
    assert said.alike == pytest.approx(0.6)


def test_a_class_is_no_likelier_than_what_is_closed_unless_its_law_is():
    likely = {"level": 9.0, "alike": 1.0, "closes": 0.0}
    for told, most in (({"left": 0.7}, 0.3), ({"closes": 0.4}, 0.4), ({"senseless": True, "p": 0.1}, 0.1)):
        [said] = graded(case(finding("coulomb_friction", "elbow", **{"p": 0.1} | told)))
        assert probability(said, likely) == pytest.approx(most)
    [sure] = graded(case(finding("coulomb_friction", "elbow", 0.8, left=0.9)))
    assert probability(sure, likely) == 0.8


def test_the_table_counts_cases_found_and_wrong_classes_and_judges_none_that_nobody_knows():
    cases = [
        case(finding("stribeck_friction", "elbow"), finding("viscous_friction", "elbow", 0.3)),
        case(finding("coulomb_friction", "elbow"), finding("backlash", "elbow")),
        case(finding("payload", "elbow")),  # the complete model's diagnosis says so, too
        case(finding("payload", "elbow"), truth=("link_mass", "elbow")),  # likewise
        case(),
    ]
    stated = dict(zip(graded(*cases), (0.7, 0.6, 0.4, 0.9, 0.9, 0.9), strict=True))
    *_, row = table(cases, {"as told": stated})
    brier = (0.3**2 + 0.4**2 + 0.6**2 + 0.9**2) / 4
    assert row == f"| as told | 5 | 3 | 2 | 2 | 1 | 2 | 1 | {brier:.3f} |"


def test_what_only_the_motion_asks_for_has_its_classes_share_among_what_that_would_take_there():
    likely = {"level": 9.0, "alike": 1.0, "closes": 0.0}
    rivals = [("viscous_friction", "elbow", 0.1), ("payload", "elbow", 0.3)]
    of_motion = finding("coulomb_friction", "elbow", 0.2, rivals=rivals)
    for overruled, expected in ((False, 0.9), (True, 0.5)):
        of_motion["grounds"]["overruled"] = overruled
        [said] = graded(case(of_motion))
        assert probability(said, likely) == pytest.approx(expected)
    del of_motion["grounds"]["overruled"]
    of_motion["grounds"]["asked"] = 0.4  # of an answer from before it was said
    [said] = graded(case(of_motion))
    assert said.overruled


def test_what_is_right_more_often_is_learnt_to_be_likelier():
    said = [
        *graded(*[case(finding("coulomb_friction", "elbow", 0.6))] * 9),
        *graded(*[case(finding("backlash", "elbow", 0.6))] * 1),
        *graded(*[case(finding("backlash", "elbow", 0.1))] * 9),
    ]
    weights = learn(said)
    assert weights["alike"] > 0
    high, low = (probability(s, weights) for s in (said[0], said[-1]))
    assert high > 0.5 > low


def test_what_a_bound_has_cut_teaches_no_more():
    """Wrong classes that explain nothing of the motion do not speak against those that do."""
    right = graded(*[case(finding("coulomb_friction", "elbow", 0.3))] * 9)
    wrong = graded(*[case(finding("backlash", "elbow", 0.3, left=0.9))] * 30)
    bounded, alone = (probability(right[0], learn(said)) for said in ([*right, *wrong], right))
    assert bounded == pytest.approx(alone, abs=0.02)
    free = graded(*[case(finding("backlash", "elbow", 0.3))] * 30)
    assert probability(right[0], learn([*right, *free])) < 0.5 < bounded


def test_what_closes_more_is_learnt_to_be_likelier_where_the_laws_do_not_tell():
    right = graded(*[case(finding("coulomb_friction", "elbow", 0.1, closes=0.95))] * 9)
    wrong = graded(*[case(finding("backlash", "elbow", 0.1, closes=0.6))] * 9)
    weights = learn([*right, *wrong])
    assert weights["closes"] > 0
    assert probability(right[0], weights) > 0.5 > probability(wrong[0], weights)
