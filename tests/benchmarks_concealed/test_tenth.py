"""The tenth of the proof that runs for every change: the same cases each time, held against their committed answers."""

from __future__ import annotations

import json

import pytest

from benchmarks.concealed.cases import Case, prepare
from benchmarks.concealed.hidden import Truth
from benchmarks.concealed.score import Row
from benchmarks.concealed.tenth import TABLE, TRIED, changes, chosen, compared, kept, losses


def row(*findings, verdict="explained", block="single", index=0) -> Row:
    """A case that hides dry friction at the elbow, or something that no name fits."""
    effect = "coulomb_friction" if block == "single" else "drag"
    truth = Truth(effect, "elbow", {})
    case = Case("tuning", block, index, 0, "flap", "torque_command", 200.0, 2, (truth,))
    said = [{"effect": e, "joint": j, "probability": p} for e, j, p in findings]
    return Row(case, {"answer": {"verdict": verdict, "findings": said}})


RIGHT = ("coulomb_friction", "elbow", 0.9)


def of_every_block() -> list[Row]:
    return [row(RIGHT, block=block) for block in TRIED]


def test_the_cases_are_the_same_each_time_of_one_joint_and_of_every_block():
    cases = chosen(10)
    assert cases == chosen(10)
    assert len(set(cases)) == len(cases) >= 12
    assert {block for block, _ in cases} == set(TRIED)
    session = prepare("tuning", *cases[0])
    assert session.robot.joints == 1
    assert len(chosen(5)) > 1.6 * len(cases)


def test_the_committed_table_holds_the_cases_that_are_run():
    table = json.loads(TABLE.read_text(encoding="utf-8"))["cases"]
    assert set(table) == {f"tuning-{block}-0-{index:04d}" for block, index in chosen(10)}


def test_the_same_answers_are_no_change():
    rows = of_every_block()
    assert compared(rows, {r.case.name: kept(r) for r in rows}) == ([], [])


@pytest.mark.parametrize(
    ("now", "words"),
    [
        (row(("coulomb_friction", "elbow", 0.75)), []),
        (row(("coulomb_friction", "elbow", 0.65)), ["coulomb_friction@elbow 0.90 -> 0.65"]),
        (row(), ["coulomb_friction@elbow 0.90 is gone"]),
        (row(RIGHT, ("backlash", "elbow", 0.1)), ["backlash@elbow 0.10 has come"]),
        (row(("coulomb_friction", "hip", 0.9)),
         ["coulomb_friction@elbow 0.90 is gone", "coulomb_friction@hip 0.90 has come"]),
        (row(RIGHT, verdict="unexplained"), ["explained -> unexplained"]),
    ],
)  # fmt: skip
def test_names_that_come_and_go_and_probabilities_that_move_are_told(now, words):
    assert changes(row(RIGHT), now) == words


def test_a_true_name_lost_and_a_wrong_one_won_are_worse_and_their_reverse_is_not():
    right, wrong = row(RIGHT), row(("backlash", "elbow", 0.6))
    assert losses(right, wrong) == ["coulomb_friction@elbow is no longer named", "backlash is stated wrongly"]
    assert losses(wrong, right) == []
    assert losses(right, row(RIGHT, ("backlash", "elbow", 0.4))) == []


def test_doubt_that_is_no_longer_said_is_worse_where_no_name_is_right():
    doubt, sure = (row(block="outside", verdict=v) for v in ("unexplained", "explained"))
    assert losses(doubt, sure) == ["nothing is said to be unexplained"]
    assert losses(sure, doubt) == []


def test_one_case_may_become_worse_and_two_may_not():
    rows = [*of_every_block(), row(RIGHT, index=1)]
    table = {r.case.name: kept(r) for r in rows}
    told, broken = compared([row(), *rows[1:]], table)
    assert (len(told), broken) == (1, [])
    told, broken = compared([row(), *rows[1:-1], row(index=1)], table)
    assert (len(told), len(broken)) == (2, 2)


def test_an_empty_block_and_a_case_without_an_answer_break_the_proof():
    rows = of_every_block()
    assert compared(rows[1:], {})[1] == ["single: no case"]
    crashed = Row(rows[0].case, {"error": "ValueError: broke"})
    (broken,) = compared([crashed, *rows[1:]], {})[1]
    assert broken.startswith("tuning-single-0-0000: no answer: ValueError: broke")


def test_a_case_without_a_committed_answer_is_told():
    assert "tuning-single-0-0000: is new" in compared(of_every_block(), {})[0]
