"""Scores of answers that are known: the right ones, the wrong ones, and those in between."""

from __future__ import annotations

import json
from dataclasses import replace

from benchmarks.concealed.cases import Case
from benchmarks.concealed.hidden import Truth
from benchmarks.concealed.score import Row, comparison, known_parameters, numbers, same_but_rounding, tables

FRICTION = Truth("coulomb_friction", "elbow", {"torque": 1.0})
OFFSET = Truth("torque_offset", "wrist", {"torque": 0.5})


def row(block, truths, findings, verdict="explained", seen=10.0, **more) -> Row:
    case = Case("tuning", block, 0, 0, "arm2", "torque_command", 200.0, 2, tuple(truths), **more)
    stated = [
        {
            "effect": e,
            "joint": j,
            "probability": p,
            "parameters": {"torque": {"value": 1, "ci95": ci}},
            "rivals": rivals,
        }
        for e, j, p, ci, rivals in findings
    ]
    answer = {"verdict": verdict, "findings": stated, "fit": {"heldout": {"share_closed": 0.9}}}
    result = {"answer": answer, "visibility": [seen] * len(truths), "beyond_nuisance": [True] * len(truths)}
    return Row(case, {**result, "seconds": 10.0, "megabytes": 300.0, "joints": 2})


def said(effect, joint, probability=0.9, interval=(0.9, 1.1), rivals=()):
    return effect, joint, probability, list(interval), [{"effect": e, "joint": j} for e, j in rivals]


def test_the_truth_scores_one_and_another_joint_only_its_class():
    n = numbers([row("single", [FRICTION], [said("coulomb_friction", "elbow")])])
    assert n["single"]["name"] == n["single"]["class"] == n["single"]["joint"] == [1.0, 1]
    assert n["single"]["wrong_name_over_half"] == [0.0, 1]
    assert n["parameter_coverage"] == [1.0, 1]
    assert n["calibration"]["ece"] == 0.1
    n = numbers([row("single", [FRICTION], [said("viscous_friction", "wrist")])])
    assert n["single"]["name"] == n["single"]["joint"] == [0.0, 1]
    assert n["single"]["class"] == [1.0, 1]
    assert n["single"]["wrong_name_over_half"] == [1.0, 1]
    assert n["calibration"]["ece"] == 0.9


def test_a_case_below_the_limit_does_not_count_and_is_not_forgotten():
    n = numbers([row("single", [FRICTION], [], "nothing_missing", seen=2.0)])
    assert n["single"]["name"] == [None, 0]
    assert n["single"]["by_ratio"]["2 to 3"]["name"] == [0.0, 1]


def test_a_law_that_holds_the_truth_is_listed_apart():
    n = numbers([row("single", [FRICTION], [said("stribeck_friction", "elbow")])])
    assert n["single"]["name"] == [0.0, 1]
    assert n["single"]["name_or_superset"] == [1.0, 1]
    assert n["single"]["wrong_name_over_half"] == [0.0, 1]


def test_a_rival_counts_for_the_answer_set_alone():
    findings = [said("viscous_friction", "elbow", 0.4, rivals=[("coulomb_friction", "elbow")])]
    n = numbers([row("single", [FRICTION], findings)])
    assert n["single"]["in_answer_set"] == [1.0, 1]
    assert n["single"]["name_among_findings"] == [0.0, 1]
    assert n["single"]["wrong_name_over_half"] == [0.0, 1]  # it was not stated above one half


def test_another_name_of_the_same_physics_counts_for_the_answer_set_and_a_sum_of_two_does_not():
    def answer(*alternatives: list[str]) -> Row:
        r = row("unidentifiable", [FRICTION], [said("viscous_friction", "elbow", 0.9)])
        names = [[{"effect": name, "joint": "elbow"} for name in group] for group in alternatives]
        r.result["answer"]["findings"][0]["alternatives"] = names
        return r

    held = [numbers([r])["unidentifiable"]["truth_itself_in_answer_set"][0] for r in (
        answer(), answer(["coulomb_friction"]), answer(["coulomb_friction", "torque_offset"])
    )]  # fmt: skip
    assert held == [0.0, 1.0, 0.0]


def test_what_a_rival_is_the_same_as_counts_where_it_holds_for_the_truth():
    def answer(truth: Truth, rival: str, same: str) -> Row:
        r = row("unidentifiable", [truth], [said("actuation_lag", "elbow", 0.5, rivals=[(rival, "elbow")])])
        r.result["answer"]["findings"][0]["rivals"][0]["alternatives"] = [[{"effect": same, "joint": "elbow"}]]
        return r

    def held(r: Row) -> float:
        return numbers([r])["unidentifiable"]["truth_itself_in_answer_set"][0]

    gains = [Truth("gain_mismatch", "elbow", {"kp_scale": kp, "kd_scale": 1.3}) for kp in (1.0, 1.3)]
    assert held(answer(FRICTION, "viscous_friction", "coulomb_friction")) == 1.0
    assert held(answer(FRICTION, "viscous_friction", "torque_offset")) == 0.0
    assert [held(answer(truth, "viscous_friction", "gain_mismatch")) for truth in gains] == [1.0, 0.0]


def test_an_identity_of_the_robot_is_as_right_as_the_truth():
    late = Truth("clock_offset", None, {"offset": 0.01})
    alike = ((("actuation_delay", "elbow"),),)
    rows = [row("unidentifiable", [late], [said("actuation_delay", "elbow")], equivalents=alike)]
    n = numbers(rows)
    assert n["unidentifiable"]["one_of_the_set_named"] == [1.0, 1]
    assert n["unidentifiable"]["truth_itself_in_answer_set"] == [0.0, 1]


def test_any_name_is_a_false_alarm_where_nothing_is_hidden():
    quiet = [row("nothing", [], [], "nothing_missing"), row("nuisance", [], [said("torque_offset", "elbow")])]
    n = numbers(quiet)
    assert n["quiet"]["false_alarm"] == [0.5, 2]
    assert n["quiet"]["false_alarm_nothing"] == [0.0, 1]


def test_outside_the_catalogue_only_doubt_is_right():
    drag = Truth("drag", "elbow", {})
    honest = row("outside", [drag], [], "unexplained")
    part = row(
        "outside", [drag], [said("viscous_friction", "elbow")], "partly_explained", tolerated=("viscous_friction",)
    )
    sure = row("outside", [drag], [said("viscous_friction", "elbow")], "explained", tolerated=("viscous_friction",))
    blaming = row("outside", [drag], [said("torque_offset", "elbow")], "partly_explained")
    unseen = row("outside", [Truth("cable", "elbow", {})], [], "unexplained")
    rows = [honest, part, sure, blaming, unseen]
    n = numbers(rows)
    assert n["open_set"]["outside"] == [0.6, 5]
    assert n["open_set"]["wrong_name_over_half"] == [0.2, 5]
    by_law = n["open_set"]["outside_by_law"]
    assert by_law["drag"] == by_law["all that tuning has, too"] == [0.5, 4]
    assert by_law["cable"] == by_law["all that it has not"] == [1.0, 1]
    assert "| drag | 0.500 (4) |" in tables(rows, n)


def test_two_effects_need_both_names():
    both = [said("coulomb_friction", "elbow"), said("torque_offset", "wrist", interval=(0.6, 0.7))]
    n = numbers([row("pairs", [FRICTION, OFFSET], both), row("pairs", [FRICTION, OFFSET], both[:1])])
    assert n["pairs"]["both_named"] == [0.5, 2]
    assert n["pairs"]["one_named"] == [1.0, 2]
    assert n["parameter_coverage"] == [0.6667, 3]  # 0.5 is not within 0.6 to 0.7


def test_an_answer_that_failed_is_no_right_one():
    case = row("single", [FRICTION], []).case
    failed = Row(case, {"error": "broke", "visibility": [9.0], "beyond_nuisance": [True]})
    n = numbers([failed, row("single", [FRICTION], [said("coulomb_friction", "elbow")])])
    assert n["failed"] == [0.5, 2]
    assert n["single"]["name"] == [0.5, 2]
    assert any("| failed | 0.500 (2) |" in text for text in tables([failed], n))


def test_the_key_knows_no_phase_and_no_sign_of_a_drift():
    drift = Truth("thermal_drift", "arm", {"amplitude": 0.2, "time_constant": 9.0})
    ripple = Truth("torque_ripple", "arm", {"amplitude": 0.2, "phase": 1.0})
    found = {"joint": "arm", "parameters": {name: {"value": -0.3} for name in ("amplitude", "coulomb", "phase")}}
    assert known_parameters(drift, {**found, "effect": "thermal_drift"}) == [({"value": -0.3}, -0.2)]
    assert known_parameters(ripple, {**found, "effect": "torque_ripple"}) == [({"value": -0.3}, 0.2)]
    assert known_parameters(drift, {**found, "effect": "torque_ripple"}) == []


def test_the_diagnosis_stands_beside_a_baseline_on_the_cases_that_both_answered():
    right, wrong = ([said(effect, "elbow")] for effect in ("coulomb_friction", "backlash"))
    first, second = row("single", [FRICTION], wrong), row("single", [FRICTION], right)
    second = replace(second, case=replace(second.case, index=1))
    table = comparison({"diagnosis": [first, second], "naive_bic": [first]})
    named = {line.split("|")[1].strip(): line.split("|")[2].strip() for line in table[2:]}
    assert named == {"diagnosis": "0.500 (2)", "naive_bic": "0.000 (1)", "diagnosis, cases of naive_bic": "0.000 (1)"}


def test_gains_are_viscous_friction_only_where_kd_alone_is_too_large():
    def named(kp: float, kd: float) -> float:
        gains = Truth("gain_mismatch", "elbow", {"kp_scale": kp, "kd_scale": kd})
        r = row("single", [gains], [said("viscous_friction", "elbow")])
        r.result["answer"]["findings"][0]["alternatives"] = [[{"effect": "gain_mismatch", "joint": "elbow"}]]
        return numbers([r])["single"]["name"][0]

    assert [named(1.01, 1.3), named(0.8, 1.3), named(1.01, 0.8)] == [1.0, 0.0, 0.0]


def test_a_wrong_name_of_exactly_one_half_is_counted_apart():
    n = numbers([row("single", [FRICTION], [said("backlash", "elbow", 0.5)])])["single"]
    assert n["wrong_name_over_half"] == [0.0, 1]
    assert n["wrong_name_half_or_more"] == [1.0, 1]


def test_what_stands_in_for_physics_outside_the_catalogue_is_listed_with_what_it_leaves():
    parts = {"elbow": {"after": 4e-3, "floor": 2e-3}, "wrist": {"after": 3e-3, "floor": 1e-3}}
    fit = {"heldout": {"share_closed": 0.9, "per_joint": parts}}
    mistaken, admitted = (
        row("outside", [FRICTION], [said("backlash", "elbow", p)], verdict=verdict)
        for p, verdict in ((0.9, "explained"), (0.4, "partly_explained"))
    )
    mistaken = replace(mistaken, result={**mistaken.result, "answer": {**mistaken.result["answer"], "fit": fit}})
    n = numbers([mistaken, admitted])
    assert n["open_set"]["both"] == [0.5, 2]
    [listed] = n["open_set"]["mistaken"]
    assert listed["over_floor"] == {"train": None, "heldout": 3.0}
    assert "| coulomb_friction | backlash | 0.90 | explained | - | 3.0 |" in tables([mistaken, admitted], n)


def test_six_joints_that_took_long_and_another_excitation_have_figures_of_their_own():
    slow, quick = (
        replace(r, result={**r.result, "joints": 6, "seconds": seconds})
        for r, seconds in ((row("heldout", [FRICTION], [said("coulomb_friction", "elbow")]), 150.0),
                           (row("single", [FRICTION], []), 60.0))
    )  # fmt: skip
    n = numbers([slow, quick, row("single", [FRICTION], [])])
    assert n["six_joints_over_120_s"] == [0.5, 2]
    assert n["single"]["heldout_excitation"] == [1.0, 1]
    assert n["single"]["name"] == [0.3333, 3]


def test_a_key_that_another_machine_draws_differs_by_rounding_alone():
    """One host's sine gave 0.11763082106302336 where the committed key has ...337; another distance is another case."""
    text = '{"cases": [{"truths": [{"distance": 0.11763082106302337}], "index": 3, "effect": "backlash"}]}'
    key = json.loads(text)
    rounded = json.loads(text.replace("302337", "302336"))
    assert rounded != key
    assert same_but_rounding(rounded, key)
    others = (("0.11763", "0.11764"), ("backlash", "compliance"), ('"index": 3', '"index": 4'), ('"index": 3, ', ""))
    for old, new in others:
        assert not same_but_rounding(json.loads(text.replace(old, new)), key)
    assert not same_but_rounding({"cases": []}, key)
